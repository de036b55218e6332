# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: publishes the messages of a log with their recorded spacing."""

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time as Stamp
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from spinning_top_sim.nodes import playback, ros_parameters
from spinning_top_sim.nodes.endpoints import message_class, wait_for_all_acked
from spinning_top_sim.nodes.executable import short_reason
from spinning_top_sim.nodes.terminal import Terminal
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS

ROUND_GAP_NS = 10_000_000       # real time between two rounds, and before the first message
SHORTEST_WAIT_NS = 300_000      # denser messages are sent together: each wait takes 0.1 ms
LAST_ANSWERS_S = 0.3            # best-effort subscribers read shared memory, which ends with us
PATIENCE_S = 5.0                # Fast DDS asks every 3 s for acknowledgements


class Replayer(Node):
    """The node.  It plays a log after `start`.  Raises ValueError if nothing can be played."""

    def __init__(self, log: LogReader, options: argparse.Namespace) -> None:
        given = [] if options.rate is None else [Parameter('rate', value=options.rate)]
        super().__init__('replay', parameter_overrides=given,
                         automatically_declare_parameters_from_overrides=True)
        overrides = ros_parameters.take_overrides(self)
        self.finished: Future = Future()    # completes with the exit code when all is played
        self._reader, self._options = log, options
        self._terminal = Terminal()
        log_begin_ns, self._end_ns = _span(log)
        self._begin_ns = log_begin_ns + round(options.start * NANOSECONDS)
        self._length_s = (self._end_ns - log_begin_ns) / NANOSECONDS
        if self._begin_ns > self._end_ns:
            raise ValueError(f'--start {options.start:g}: the log lasts {self._length_s:.3f} s')
        self.outputs = self._open_publishers()      # by the number of the channel
        for warning in ros_parameters.disobeyed_overrides(self, overrides):
            self.get_logger().warning(warning)
        self._playback = playback.Playback()
        self._playback.pause(options.start_paused)
        self._round = 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._steps = self._play()
        self._timer = self.create_timer(0.02, self._step, clock=steady)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.declare_parameter('rate', 1.0, ParameterDescriptor(
            description='recorded over real time; a change takes effect at once',
            additional_constraints=f'must be {playback.RATES}', dynamic_typing=True))
        self._clock_output: Publisher | None = None
        if options.clock:
            self._clock_output = self.create_publisher(ClockMessage, '/clock', 10)
            self.create_timer(1.0 / max(options.clock, playback.SLOWEST), self._publish_clock,
                              clock=steady)
        self.create_timer(1.0, self._show_status, clock=steady)
        self.create_service(SetBool, '~/set_pause', self._on_pause)

    def _open_publishers(self) -> dict[int, Publisher]:
        """Return a publisher for each channel; warn of the topics that cannot be played."""
        there = {channel.name for channel in self._reader.topics}
        wanted = set(self._options.topics) or there
        for name in sorted(wanted - there):
            self.get_logger().warning(f'the log has no topic {name}')
        outputs: dict[int, Publisher] = {}
        for name in sorted(wanted & there):
            channels = [channel for channel in self._reader.topics if channel.name == name]
            profile, differ = used_qos([channel.qos for channel in channels])
            for channel in channels:
                try:
                    outputs[channel.channel_id] = self._publisher(channel, profile)
                except Exception as error:  # a log may ask for anything; the others are played
                    self.get_logger().warning(short_reason(f'{name} is not played: {error}'))
            if differ and any(channel.channel_id in outputs for channel in channels):
                self.get_logger().warning(f'{name} was recorded with several QoS profiles: it is '
                                          f'played with {shown_qos(profile)}')
        if wanted and not outputs and not self._options.clock:
            raise ValueError('none of the topics can be played; the log has '
                             f'{", ".join(sorted(there)) or "none at all"}')
        return outputs

    def _publisher(self, topic: LogTopic, profile: Mapping[str, Any]) -> Publisher:
        if topic.name == '/clock' and self._options.clock:
            raise LookupError('--clock publishes another /clock')
        if topic.encoding != 'cdr':
            raise LookupError(f'its messages are encoded as {topic.encoding!r}, not as CDR')
        return self.create_publisher(
            message_class(topic.type_name), topic.name, qos_profile(profile),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for rate in [parameter.value for parameter in parameters if parameter.name == 'rate']:
            if type(rate) not in {int, float} or not playback.SLOWEST <= rate <= playback.FASTEST:
                return SetParametersResult(
                    successful=False, reason=f'rate = {rate!r}: must be {playback.RATES}')
            self._playback.set_rate(rate)
            self._step_after(0.0)
        return SetParametersResult(successful=True)

    def start(self) -> None:
        """Play when the executor spins."""

    def stop(self) -> None:
        self._reader.close()
        self._terminal.end()

    def _step(self) -> None:
        """Send what is due; a timer calls it when something is."""
        try:
            wait_ns = next(self._steps, None)
        except Exception as error:
            self._terminal.end()
            self.get_logger().error(f'cannot be played any further: {error}')
            wait_ns = None
            self.finished.set_result(2)
        if wait_ns is None:
            self._timer.cancel()
        else:
            self._step_after(wait_ns)

    def _step_after(self, wait_ns: float) -> None:
        self._timer.timer_period_ns = int(min(max(wait_ns, SHORTEST_WAIT_NS), NANOSECONDS))
        self._timer.reset()

    def _play(self) -> Iterator[float]:
        """Wait for subscribers and the delay, then play the log; yield how long to wait [ns]."""
        senders = {*self.outputs.values(), *filter(None, [self._clock_output])}
        begin = time.monotonic() + self._options.delay
        while time.monotonic() < begin or sum(
                publisher.get_subscription_count() for publisher in senders
                ) < self._options.wait_for_subscribers:
            yield 20e6
        for self._round in itertools.count():
            played = self._playback.sent + self._playback.failed
            self._playback.begin(self._begin_ns, self._messages(), ROUND_GAP_NS)
            self._publish_clock()       # before the messages, since it may go back
            while (left_ns := self._playback.tick()) is not None and self.context.ok():
                yield left_ns
            if played == self._playback.sent + self._playback.failed or not self._options.loop:
                break
            yield ROUND_GAP_NS
        yield LAST_ANSWERS_S * 1e9
        end = time.monotonic() + PATIENCE_S
        while not wait_for_all_acked(senders, 0.0) and time.monotonic() < end:
            yield 50e6
        topics = {publisher.topic_name for publisher in self.outputs.values()}
        self._terminal.tell(f'played {self._playback.sent} messages on {len(topics)} topics, '
                            f'{self._odd()}')
        self.finished.set_result(2 if self._tell_damage() else 0)

    def _messages(self) -> Iterator[playback.Message]:
        """Yield the messages of a round."""
        names = {channel.name for channel in self._reader.topics
                 if channel.channel_id in self.outputs}
        # Without a /clock that goes back, too, nobody takes stamps that go back.
        goes_back = self._clock_output is not None or '/clock' in names
        later_ns = 0 if goes_back else self._round * (
            self._end_ns - self._begin_ns + ROUND_GAP_NS)
        for message in self._reader.messages(names, self._begin_ns if self._options.start else 0):
            if (publisher := self.outputs.get(message.channel_id)) is not None:
                data = (stamped_later(message.data, publisher, later_ns) if later_ns
                        else message.data)
                yield max(message.log_time, self._begin_ns), publisher.publish, data

    def _publish_clock(self) -> None:
        if self._clock_output is not None:
            now_ns = min(self._playback.now(), self._end_ns, LAST_STAMP_NS)
            self._clock_output.publish(ClockMessage(clock=Time(
                nanoseconds=max(now_ns, self._begin_ns)).to_msg()))

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
        self._step_after(0.0)
        response.success = True
        response.message = f'{"paused" if request.data else "playing"} at {self._position()}'
        return response

    def _odd(self) -> str:
        late, failed = self._playback.late, self._playback.failed
        return f'{late} of them late' + (
            f'; {failed} not published: a reader that keeps all has stalled' if failed else '')

    def _position(self) -> str:
        within_ns = min(self._playback.now(), self._end_ns) - self._begin_ns
        which = f' of round {self._round + 1}' if self._options.loop else ''
        return (f'{self._options.start + max(within_ns, 0) / NANOSECONDS:.2f} of '
                f'{self._length_s:.2f} s{which}')

    def _show_status(self) -> None:
        self._tell_damage()
        paused = ' | paused' if self._playback.paused else ''
        self._terminal.show(f'{self._position()} | x{self._playback.rate:g}{paused} '
                            f'| {self._playback.sent} messages, {self._odd()}')


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


def _span(log: LogReader) -> tuple[int, int]:
    """Return the first and the last time of a log [ns]; 0 says that there was no clock yet."""
    begin_ns, end_ns = log.span
    first = next(log.messages(start=1), None) if begin_ns == 0 else None
    return first.log_time if first else begin_ns, end_ns


def used_qos(channels: Sequence[Sequence[Mapping[str, Any]]]) -> tuple[Mapping[str, Any], bool]:
    """
    Return the QoS for the channels of a topic, and whether they were recorded with several.

    channels : the profiles of each channel, which are those of its publishers

    It serves all subscribers that the recorded ones served: it is reliable, keeps all, and keeps
    for late subscribers, if one of them did, and its queue holds those of a channel together.
    """
    profiles = [profile for channel in channels for profile in channel] or [DEFAULT_QOS]
    strongest = {key: value for key, value in (
        ('history', 2), ('reliability', 1), ('durability', 1))
        if any(profile[key] == value for profile in profiles)}
    depth = max(sum(profile['depth'] for profile in channel) for channel in channels)
    return ({**profiles[0], **strongest, 'depth': depth},
            any(profile != profiles[0] for profile in profiles))


def shown_qos(profile: Mapping[str, Any]) -> str:
    """Return the main policies of a QoS for the user."""
    qos = qos_profile(profile)
    names = [getattr(qos, key).name.lower() for key in ('reliability', 'durability', 'history')]
    return f'{", ".join(names)}, depth {qos.depth}'


def qos_profile(recorded: Mapping[str, Any]) -> QoSProfile:
    """Return a recorded QoS.  Raises ValueError if no publisher can offer it."""
    policies = {
        key: Duration(nanoseconds=min(value['sec'] * NANOSECONDS + value['nsec'], 2 ** 63 - 1))
        if isinstance(value, Mapping) else value for key, value in recorded.items()}
    policies['depth'] = min(policies['depth'], 2 ** 31 - 1) or DEFAULT_QOS['depth']
    return QoSProfile(**policies)


def stamped_later(data: bytes, publisher: Publisher, later_ns: int) -> bytes:
    """Return a message with later stamps; a stamp of 0, which is no time, stays."""
    try:
        message = deserialize_message(data, publisher.msg_type)
        stamps = [stamp for stamp in _stamps(message) if stamp.sec or stamp.nanosec]
        for stamp in stamps:
            stamp.sec, stamp.nanosec = divmod(
                stamp.sec * NANOSECONDS + stamp.nanosec + later_ns, NANOSECONDS)
        return serialize_message(message) if stamps else data
    except Exception:       # it was recorded with another definition, or the seconds overflow
        return data


def _stamps(message: Any) -> Iterator[Any]:
    for name in message.get_fields_and_field_types():
        field = getattr(message, name)
        for part in field if isinstance(field, list) else [field]:
            if isinstance(part, Stamp):
                yield part
            elif hasattr(part, 'get_fields_and_field_types'):
                yield from _stamps(part)
