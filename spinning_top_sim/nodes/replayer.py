# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: publishes the messages of a log with their recorded spacing."""

import argparse
import contextlib
import itertools
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from spinning_top_sim.nodes import playback
from spinning_top_sim.nodes.executable import message_class, short_reason, wait_for_all_acked
from spinning_top_sim.nodes.terminal import Terminal
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS


class Replayer(Node):
    """The node.  It plays a log after `start`.  Raises ValueError if nothing can be played."""

    def __init__(self, log: LogReader, options: argparse.Namespace) -> None:
        given = [] if options.rate is None else [Parameter('rate', value=options.rate)]
        super().__init__('replay', parameter_overrides=given)
        self.finished: Future = Future()    # completes with the exit code when all is played
        self._reader, self._options = log, options
        self._terminal = Terminal()
        log_begin_ns, end_ns = log.span
        self._begin_ns = log_begin_ns + round(options.start * NANOSECONDS)
        self._span_ns = end_ns - self._begin_ns
        self._length_s = (end_ns - log_begin_ns) / NANOSECONDS
        if self._span_ns < 0:
            raise ValueError(f'--start {options.start:g}: the log lasts {self._length_s:.3f} s')
        self._by_channel = self._open_publishers()
        self._senders = set(self._by_channel.values())
        self._playback = playback.Playback(self._begin_ns, paused=options.start_paused)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.declare_parameter('rate', 1.0, ParameterDescriptor(
            description='recorded over real time; a change takes effect at once',
            additional_constraints=f'must be {playback.RATES}', dynamic_typing=True))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if options.clock:
            clock = self.create_publisher(ClockMessage, '/clock', 10)
            self._senders.add(clock)
            self.create_timer(1.0 / max(options.clock, playback.SLOWEST), lambda: clock.publish(
                ClockMessage(clock=Time(nanoseconds=min(
                    self._playback.now(), LAST_STAMP_NS)).to_msg())), clock=steady)
        self.create_timer(1.0, self._show_status, clock=steady)
        self.create_service(SetBool, '~/set_pause', self._on_pause)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._play, name='playback', daemon=True)

    def _open_publishers(self) -> dict[int, Publisher]:
        """Return a publisher for each channel; warn of the topics that cannot be played."""
        there = {channel.name for channel in self._reader.topics}
        wanted = set(self._options.topics) or there
        for name in sorted(wanted - there):
            self.get_logger().warning(f'the log has no topic {name}')
        made: dict[tuple[str, str], Publisher] = {}
        outputs: dict[int, Publisher] = {}
        for channel in self._reader.topics:
            key = channel.name, channel.type_name
            try:
                if channel.name in wanted:
                    made[key] = made.get(key) or self._publisher(channel)
                    outputs[channel.channel_id] = made[key]
            except Exception as error:      # a log may ask for anything; the others are played
                self.get_logger().warning(short_reason(f'{channel.name} is not played: {error}'))
        if wanted and not outputs and not self._options.clock:
            raise ValueError('none of the topics can be played; the log has '
                             f'{", ".join(sorted(there)) or "none at all"}')
        return outputs

    def _publisher(self, topic: LogTopic) -> Publisher:
        if topic.name == '/clock' and self._options.clock:
            raise LookupError('--clock publishes another /clock')
        if topic.encoding != 'cdr':
            raise LookupError(f'its messages are encoded as {topic.encoding!r}, not as CDR')
        return self.create_publisher(
            message_class(topic.type_name), topic.name,
            qos_profile((topic.qos or [DEFAULT_QOS])[0]),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for rate in [parameter.value for parameter in parameters if parameter.name == 'rate']:
            if type(rate) not in {int, float} or not playback.SLOWEST <= rate <= playback.FASTEST:
                return SetParametersResult(
                    successful=False, reason=f'rate = {rate!r}: must be {playback.RATES}')
            self._playback.set_rate(rate)
        return SetParametersResult(successful=True)

    def start(self) -> None:
        # The thread that reads ahead releases the interpreter this soon [s] to the one that sends.
        sys.setswitchinterval(0.0005)
        self._thread.start()

    def stop(self) -> None:
        """End playing, whether the context is valid or not."""
        self._stopping.set()
        self._playback.stop()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._reader.close()
        self._terminal.end()

    def _play(self) -> None:
        """Wait for subscribers and the delay, then play the log; runs in a thread of its own."""
        begin = time.monotonic() + self._options.delay
        try:
            while not self._stopping.wait(0.02) and (time.monotonic() < begin or sum(
                    publisher.get_subscription_count() for publisher in self._senders
                    ) < self._options.wait_for_subscribers):
                pass
            with contextlib.closing(playback.read_ahead(self._messages())) as messages:
                self._playback.run(messages)
            # Best-effort subscribers read shared memory, which ends with its sender.
            self._stopping.wait(0.3)
            # Fast DDS asks every 3 s for acknowledgements.
            wait_for_all_acked(self._senders, 5.0, self._stopping.is_set)
            code = 2 if self._tell_damage() else 0
        except Exception as error:
            if self.context.ok():           # publishing fails once the context is down
                self._terminal.end()
                self.get_logger().error(f'cannot be played any further: {error}')
            code = 2
        if self.context.ok():
            self._terminal.tell(
                f'played {self._playback.sent} messages on {len(set(self._by_channel.values()))} '
                f'topics, {self._playback.late} of them late')
            self.finished.set_result(code)

    def _messages(self) -> Iterator[playback.Message]:
        """Yield the messages to play, in endless repetition with --loop."""
        names = {channel.name for channel in self._reader.topics
                 if channel.channel_id in self._by_channel}
        start = self._begin_ns if self._options.start else None
        for number in itertools.count():
            shift_ns, is_empty = number * (self._span_ns + playback.ROUND_GAP_NS), True
            for message in self._reader.messages(names, start):
                at_ns = message.log_time or self._begin_ns      # 0: before the first /clock
                if message.channel_id in self._by_channel:
                    is_empty = False
                    yield (at_ns + shift_ns, self._by_channel[message.channel_id].publish,
                           message.data)
            if is_empty or not self._options.loop:
                return

    def _tell_damage(self) -> bool:
        """Return whether messages are missing unexpectedly; say so once."""
        if self._options.partial or not self._reader.left_out:
            return False
        self._terminal.end()
        self.get_logger().error(f'{self._reader.path} is damaged inside, and messages are left '
                                'out: `recover` tells which', once=True)
        return True

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._playback.pause(request.data)
        response.success = True
        response.message = f'{"paused" if request.data else "playing"} at {self._position()}'
        return response

    def _position(self) -> str:
        number, within = divmod(self._playback.now() - self._begin_ns,
                                self._span_ns + playback.ROUND_GAP_NS)
        at = self._options.start + min(within, self._span_ns) / NANOSECONDS
        which = f' of round {number + 1}' if self._options.loop else ''
        return f'{at:.2f} of {self._length_s:.2f} s{which}'

    def _show_status(self) -> None:
        self._tell_damage()
        paused = ' | paused' if self._playback.paused else ''
        self._terminal.show(f'{self._position()} | x{self.get_parameter("rate").value:g}{paused} '
                            f'| {self._playback.sent} messages | {self._playback.late} late')


def open_log(path: Path, partial: bool) -> LogReader:
    """Open a log.  Raises LogError, and without `partial` ValueError for a damaged log."""
    log = LogReader(path)
    damaged = not log.whole and (log.damage.torn or log.damage.lost_bytes)
    if damaged and not partial:
        raise ValueError(f'{path} is damaged: `recover` makes a whole log of it, --partial plays '
                         'what is whole')
    if damaged:
        print(f'spinning-top replay: {path} is damaged, playing what is whole', file=sys.stderr)
    return log


def qos_profile(recorded: Mapping[str, Any]) -> QoSProfile:
    """Return a recorded QoS.  Raises ValueError if no publisher can offer it."""
    policies = {
        key: Duration(nanoseconds=min(value['sec'] * NANOSECONDS + value['nsec'], 2 ** 63 - 1))
        if isinstance(value, Mapping) else value for key, value in recorded.items()}
    policies['depth'] = min(policies['depth'], 2 ** 31 - 1) or DEFAULT_QOS['depth']
    return QoSProfile(**policies)
