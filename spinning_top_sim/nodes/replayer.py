# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: publishes the messages of a log with their recorded spacing."""

from __future__ import annotations

import importlib
import math
import os
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from rclpy.time import Time
from rclpy.type_support import check_is_valid_msg_type
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from spinning_top_sim.nodes import reports
from spinning_top_sim.nodes.pacing import DeadlineThread
from spinning_top_sim.nodes.playback import ROUND_GAP_NS, Message, Playback, ReadAhead, rounds
from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import DefinitionNotFoundError
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS

NANOSECONDS = 1_000_000_000
# REP-144 and the ROS 2 interface names.
TYPE_NAME = re.compile(
    r'(?P<package>[a-z][a-z0-9_]*)/((?P<folder>msg|srv|action)/)?(?P<name>[A-Z][A-Za-z0-9_]*)')
AMENT_INDEX = 'share/ament_index/resource_index/packages'
SLOWEST, FASTEST = 1e-6, 1e9
# Policies that no publisher can offer.
UNKNOWN = {
    'history': QoSHistoryPolicy.UNKNOWN, 'reliability': QoSReliabilityPolicy.UNKNOWN,
    'durability': QoSDurabilityPolicy.UNKNOWN, 'liveliness': QoSLivelinessPolicy.UNKNOWN}
# Longest wait for the last messages to be acknowledged: Fast DDS asks for it every 3 s.
LAST_WORD_S = 5.0
# Wait for subscribers that acknowledge nothing: shared memory goes with its sender.
UNACKNOWLEDGED_S = 0.3
# How often subscribers are counted, and stops looked for, while waiting.
LOOK_S = 0.02
# The thread that sends gets Python's lock this soon from the one that reads ahead.
SWITCH_INTERVAL_S = 0.0005


@dataclass(frozen=True)
class Options:
    """What to play and how; see the options of `replay_node`."""

    rate: float | None = None           # None: the parameter decides
    loop: bool = False
    start: float = 0.0                  # after the begin of the log [s]
    topics: Sequence[str] = ()          # by their recorded names; none: all
    clock: float = 0.0                  # rate of /clock [Hz]; 0: none
    partial: bool = False               # whether a damaged log is played in part
    start_paused: bool = False
    delay: float = 0.0                  # before the first message [s]
    wait_for_subscribers: int = 0


class Replayer(Node):
    """
    The node: plays a log once it is started.

    Attributes
    ----------
    finished : rclpy.task.Future
        Completes with the exit code when all is played.

    Raises
    ------
    ValueError
        If the log cannot be played at all.

    """

    def __init__(self, log: LogReader, options: Options) -> None:
        super().__init__('replay')
        self.finished: Future = Future()
        self._log, self._options = log, options
        self._terminal = reports.Terminal()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._rate = self._declare_rate()
        self._log_begin_ns, self._end_ns = log.span
        self._begin_ns = self._log_begin_ns + round(options.start * NANOSECONDS)
        if self._begin_ns > self._end_ns:
            raise ValueError(f'--start {options.start:g}: the log lasts '
                             f'{(self._end_ns - self._log_begin_ns) / NANOSECONDS:.3f} s')
        self._span_ns = self._end_ns - self._begin_ns
        self._outputs: dict[int, Publisher] = {}        # by channel
        self._open_publishers()
        self._ahead: ReadAhead | None = None
        self._told_damage = False
        self._playback: Playback
        self._thread = threading.Thread(target=self._play, name='playback', daemon=True)
        self._clock_thread: DeadlineThread | None = None
        self.create_service(SetBool, '~/set_pause', self._on_pause)
        self.create_timer(1.0, self._show_status, clock=self._steady)

    # -------------------------------------------------------------------------- parameters

    def _declare_rate(self) -> float:
        """Declare the parameter `rate`; the command line's own option has the last word."""
        try:
            given = self.declare_parameter('rate', 1.0, ParameterDescriptor(
                description='recorded over real time; a change takes effect at once',
                dynamic_typing=True,
                floating_point_range=[FloatingPointRange(from_value=SLOWEST, to_value=FASTEST)]))
        except ParameterException as error:
            raise ValueError(str(error)) from error
        rate = _checked_rate(given.value if self._options.rate is None else self._options.rate)
        self.set_parameters([Parameter('rate', value=rate)])
        self.add_on_set_parameters_callback(self._on_set_parameters)
        return rate

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == 'rate':
                try:
                    self._rate = _checked_rate(parameter.value)
                except ValueError as error:
                    return SetParametersResult(successful=False, reason=str(error))
                self._playback.set_rate(self._rate)
        return SetParametersResult(successful=True)

    # -------------------------------------------------------------------------- publishers

    def _open_publishers(self) -> None:
        """Make a publisher for every topic to be played; warn of those that cannot be played."""
        wanted = set(self._options.topics)
        there = {topic.name for topic in self._log.topics}
        if wanted and not wanted & there:
            raise ValueError(f'the log has none of the topics {", ".join(sorted(wanted))}; it has '
                             f'{", ".join(sorted(there)) or "none at all"}')
        for name in sorted(wanted - there):
            self.get_logger().warning(f'the log has no topic {name}')
        self._clock_publishers = [self.create_publisher(ClockMessage, '/clock', 10)
                                  ] if self._options.clock else []
        channels: dict[tuple[str, str], list[LogTopic]] = {}
        for channel in self._log.topics:
            if not wanted or channel.name in wanted:
                channels.setdefault((channel.name, channel.type_name), []).append(channel)
        for (name, _), alike in channels.items():
            try:
                publisher = self._publisher(alike)
            except (LookupError, InvalidTopicNameException) as error:
                self.get_logger().warning(f'{name} is not played: {error}')
            else:
                self._outputs.update((channel.channel_id, publisher) for channel in alike)

    def _publisher(self, channels: list[LogTopic]) -> Publisher:
        """Return a publisher for channels of one name and type, or raise LookupError."""
        topic = channels[0]
        if topic.name == '/clock' and self._options.clock:
            raise LookupError('--clock publishes another /clock')
        if topic.encoding != 'cdr':
            raise LookupError(f'its messages are encoded as {topic.encoding!r}, not as CDR')
        kind = message_class(topic.type_name)
        self._compare_types(topic)
        profiles = [profile for channel in channels for profile in channel.qos]
        return self.create_publisher(
            kind, topic.name, self._profile(topic.name, profiles),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _compare_types(self, topic: LogTopic) -> None:
        try:
            installed = find_definition(topic.type_name).type_hash
        except DefinitionNotFoundError:
            return
        if topic.metadata.get('topic_type_hash', installed) not in {'', installed}:
            self.get_logger().warning(
                f'{topic.name} was recorded with another {topic.type_name} than is installed: '
                'subscribers may misread it')

    def _profile(self, name: str, profiles: list[Mapping[str, Any]]) -> QoSProfile:
        """Return the recorded QoS; the default where publishers had different ones."""
        if any(profile != profiles[0] for profile in profiles):
            self.get_logger().warning(f'{name} was recorded from publishers with different QoS: '
                                      'published as reliable, volatile')
            profiles = []
        recorded = {**DEFAULT_QOS, **(profiles[0] if profiles else {})}
        policies: dict[str, Any] = {key: _duration(value) if isinstance(value, Mapping) else value
                                    for key, value in recorded.items()}
        for key, unknown in UNKNOWN.items():
            if policies[key] == unknown:
                policies[key] = DEFAULT_QOS[key]
        return QoSProfile(**{**policies, 'depth': policies['depth'] or DEFAULT_QOS['depth']})

    # ---------------------------------------------------------------------- start and stop

    def start(self) -> None:
        """Begin to play: after `delay`, and when there are enough subscribers."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self._ahead = ReadAhead(
            rounds(self._messages, self._span_ns, self._options.loop))
        publish = {index: publisher.publish for index, publisher in self._outputs.items()}
        self._playback = Playback(self._ahead, self._begin_ns, self._rate,
                                  lambda index, data: publish[index](data),
                                  paused=self._options.start_paused)
        if self._options.clock:
            self._clock_thread = DeadlineThread(self._publish_clock, self._options.clock,
                                                name='clock')
            self._clock_thread.start()
        self._thread.start()

    def stop(self) -> None:
        """End playing, whatever state the context is in."""
        if self._ahead is None:
            return
        self._playback.stop()
        self._ahead.stop()
        if self._clock_thread is not None:
            self._clock_thread.stop()
        self._thread.join(1.0)
        self._log.close()
        self._terminal.end()

    def _play(self) -> None:
        """Play all; the body of a thread beside the executor's."""
        code = 0
        try:
            if self._wait_to_begin():
                self._playback.run()
                self._wait_for_delivery()
            if self._tell_damage():
                code = 2
        except Exception as error:
            self._fail(error)
            return
        if self.context.ok():
            self._terminal.tell(self._summary())
            self._finish(code)

    def _fail(self, error: Exception) -> None:
        if self.context.ok():               # publishing fails once the context is down
            self.get_logger().error(f'cannot be played any further: {error}')
            self._terminal.tell(self._summary())
            self._finish(2)

    def _finish(self, code: int) -> None:
        if not self.finished.done():
            self.finished.set_result(code)

    def _messages(self) -> Iterator[Message]:
        """Yield the messages of a round."""
        names = {channel.name for channel in self._log.topics
                 if channel.channel_id in self._outputs}
        for message in self._log.messages(names, self._begin_ns):
            if message.channel_id in self._outputs:
                yield message.log_time, message.channel_id, message.data

    def _tell_damage(self) -> bool:
        """Return whether messages are missing unexpectedly; say so once."""
        damaged = self._log.left_out > 0 and not self._options.partial
        if damaged and not self._told_damage:
            self._told_damage = True
            self.get_logger().error(f'{self._log.path} is damaged inside, and messages are left '
                                    'out: `recover` tells which')
        return damaged

    def _wait_to_begin(self) -> bool:
        """Wait for subscribers and the delay; return False when stopped meanwhile."""
        begin = time.monotonic() + self._options.delay
        count = self._options.wait_for_subscribers
        while time.monotonic() < begin or self._subscribers() < count:
            if not self._playback.rest(LOOK_S):
                return False
        return True

    def _subscribers(self) -> int:
        publishers = {*self._outputs.values(), *self._clock_publishers}
        return sum(publisher.get_subscription_count() for publisher in publishers)

    def _wait_for_delivery(self) -> None:
        """Wait until all subscribers have the last messages, or for too long."""
        heard = [publisher for publisher in set(self._outputs.values())
                 if publisher.get_subscription_count()]
        now = time.monotonic()
        for publisher in heard:
            reliable = publisher.qos_profile.reliability == QoSReliabilityPolicy.RELIABLE
            end = now + (LAST_WORD_S if reliable else UNACKNOWLEDGED_S)
            while time.monotonic() < end and self._playback.rest(0.0 if reliable else LOOK_S):
                if reliable and publisher.wait_for_all_acked(Duration(seconds=LOOK_S)):
                    break

    # ------------------------------------------------------------------- clock and service

    def _publish_clock(self) -> None:
        try:
            message = ClockMessage(clock=Time(nanoseconds=self._playback.now()).to_msg())
            self._clock_publishers[0].publish(message)
        except Exception as error:
            self._fail(error)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._playback.pause(request.data)
        response.success = True
        response.message = f'{"paused" if request.data else "playing"} at {self._position()}'
        return response

    # ----------------------------------------------------------------------------- reports

    def _position(self) -> str:
        passed = self._playback.now() - self._begin_ns
        number, within = divmod(passed, self._span_ns + ROUND_GAP_NS)
        span = self._end_ns - self._log_begin_ns
        at = min(within, self._span_ns) + self._begin_ns - self._log_begin_ns
        percent = 100.0 * at / span if span else 100.0
        which = f' of round {number + 1}' if self._options.loop else ''
        return (f'{at / NANOSECONDS:.2f} of {span / NANOSECONDS:.2f} s, {percent:.0f} %{which}')

    def _show_status(self) -> None:
        self._tell_damage()
        playback = self._playback
        paused = ' | paused' if playback.paused else ''
        late = f' | {playback.late} late' if playback.late else ''
        self._terminal.show(f'{self._position()} | x{self._rate:g}{paused} | '
                            f'{playback.sent} messages{late}')

    def _summary(self) -> str:
        playback = self._playback
        late = f', {playback.late} of them late' if playback.late else ''
        topics = len(set(self._outputs.values()))
        return f'played {playback.sent} messages on {topics} topics{late}'


def message_class(type_name: str) -> type:
    """
    Return the class of a message type that a log names.

    Parameters
    ----------
    type_name
        Such as 'geometry_msgs/msg/Pose' ('msg' may be left out).

    Raises
    ------
    LookupError
        If it is no message type of an installed ROS package.  No other module is ever imported.

    """
    match = TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise LookupError(f'{type_name!r} is not the name of a message type')
    package, folder, name = match['package'], match['folder'] or 'msg', match['name']
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)),
                sys.prefix]
    if not any(Path(prefix, AMENT_INDEX, package).is_file() for prefix in prefixes):
        raise LookupError(f'{type_name} is not installed')
    try:
        found: type = getattr(importlib.import_module(f'{package}.{folder}'), name)
        check_is_valid_msg_type(found)
    except (ImportError, AttributeError) as error:
        raise LookupError(f'{type_name} is not installed') from error
    except RuntimeError as error:
        raise LookupError(f'{type_name} is no message type') from error
    return found


def _checked_rate(value: object) -> float:
    """Return a rate as a float.  Raises ValueError saying what is allowed."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) \
            or not math.isfinite(value) or not SLOWEST <= value <= FASTEST:
        raise ValueError(f'rate = {value!r}: must be a number in [{SLOWEST:g}, {FASTEST:g}]')
    return float(value)


def _duration(parts: Mapping[str, int]) -> Duration:
    """Return a recorded duration; what is longer than a Duration can be is for ever."""
    nanoseconds = parts['sec'] * NANOSECONDS + parts['nsec']
    return Duration(nanoseconds=min(nanoseconds, 2 ** 63 - 1))
