# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: publishes the messages of a log with their recorded spacing."""

import argparse
import contextlib
import itertools
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time as Stamp
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from spinning_top_sim.nodes import ros_parameters
from spinning_top_sim.nodes.endpoints import message_class, wait_for_all_acked
from spinning_top_sim.nodes.executable import short_reason
from spinning_top_sim.nodes.playback import RATE, Message, Playback
from spinning_top_sim.nodes.terminal import Terminal
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.streams.parameter import Range

ROUND_GAP_NS = 10_000_000       # real time before the first message of a round, after the last
SHORTEST_WAIT_NS = 300_000      # denser messages are sent together: each wait takes 0.1 ms
LAST_ANSWERS_NS = 300_000_000   # best-effort subscribers read shared memory, which ends with us
PATIENCE_S = 5.0                # Fast DDS asks every 3 s for acknowledgements


class Replayer(Node):
    """
    The node.  It plays an open log, which `stop` closes, when the executor spins.

    options : those that `replay_node.add_arguments` describes
    outputs : the publishers by the number of the channel

    Raises ValueError if nothing can be played.
    """

    def __init__(self, log: LogReader, options: argparse.Namespace) -> None:
        given = [] if options.rate is None else [Parameter('rate', value=options.rate)]
        super().__init__('replay', parameter_overrides=given,
                         automatically_declare_parameters_from_overrides=True)
        overrides = ros_parameters.take_overrides(self)
        self.finished: Future = Future()    # completes with the exit code when all is played
        self._log, self._options, self._terminal = log, options, Terminal()
        first = next(log.messages(start=1), None)       # a time of 0 says: no clock yet
        log_begin_ns, self._end_ns = first.log_time if first else 0, log.span[1]
        self._length_s = (self._end_ns - log_begin_ns) / NANOSECONDS
        for name, value, allowed in (('start', options.start, Range(0.0, self._length_s)),
                                     ('clock', options.clock or 1.0, Range(1e-6, 1e4))):
            if value not in allowed:
                raise ValueError(f'--{name} {value:g}: must be {allowed}')
        self._begin_ns = log_begin_ns + round(options.start * NANOSECONDS)
        self.outputs = self._open_publishers()
        for warning in ros_parameters.disobeyed_overrides(self, overrides):
            self.get_logger().warning(warning)
        self._playback, self._round = Playback(self._begin_ns), 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._steps = self._play()
        self._timer = self.create_timer(0.02, self._step, clock=steady)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.declare_parameter('rate', RATE.default, ros_parameters.descriptor(RATE))
        self._playback.go_on(self._playback.rate, options.start_paused)
        self._clock_output: Publisher | None = None
        if options.clock:
            self._clock_output = self.create_publisher(ClockMessage, '/clock', 10)
            self.create_timer(1.0 / options.clock, self._publish_clock, clock=steady)
        self.create_timer(1.0, lambda: self._terminal.show(self._status()), clock=steady)
        self.create_service(SetBool, '~/set_pause', self._on_pause)

    def _open_publishers(self) -> dict[int, Publisher]:
        """Return a publisher for each channel; warn of the topics that cannot be played."""
        warn, there = self.get_logger().warning, {topic.name for topic in self._log.topics}
        wanted = set(self._options.topics) or there
        for name in sorted(wanted - there):
            warn(f'the log has no topic {name}')
        outputs: dict[int, Publisher] = {}
        for name in sorted(wanted & there):
            channels = [topic for topic in self._log.topics if topic.name == name]
            profiles = [qos for topic in channels for qos in topic.qos] or [DEFAULT_QOS]
            # It serves all subscribers that the recorded publishers have served together.
            profile = {**profiles[0], 'history': max(qos['history'] for qos in profiles),
                       'depth': sum(qos['depth'] for qos in profiles)}
            profile |= {key: min(qos[key] for qos in profiles)
                        for key in ('reliability', 'durability')}
            try:
                outputs |= {topic.channel_id: self._publisher(topic, profile)
                            for topic in channels}
            except Exception as error:      # a log may ask for anything; the others are played
                warn(short_reason(f'{name} is not played: {error}'))
                continue
            if any(qos != profiles[0] for qos in profiles):
                qos = outputs[channels[0].channel_id].qos_profile
                warn(f'{name} was recorded with several QoS profiles: it is played as '
                     f'{qos.reliability.name.lower()} and {qos.durability.name.lower()}')
        if wanted and not outputs and not self._options.clock:
            raise ValueError('none of the topics can be played; the log has '
                             f'{", ".join(sorted(there)) or "none at all"}')
        return outputs

    def _publisher(self, topic: LogTopic, qos: Mapping[str, Any]) -> Publisher:
        if topic.name == '/clock' and self._options.clock:
            raise LookupError('--clock publishes another /clock')
        if topic.encoding != 'cdr':
            raise LookupError(f'its messages are encoded as {topic.encoding!r}, not as CDR')
        policies = {key: Duration(seconds=value['sec'], nanoseconds=value['nsec'])
                    if isinstance(value, Mapping) else value for key, value in qos.items()}
        policies['depth'] = min(policies['depth'], 2 ** 31 - 1) or DEFAULT_QOS['depth']
        return self.create_publisher(
            message_class(topic.type_name), topic.name, QoSProfile(**policies),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for rate in [parameter.value for parameter in parameters if parameter.name == 'rate']:
            try:
                self._playback.go_on(RATE.check(rate), self._playback.paused)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._step_after(0.0)
        return SetParametersResult(successful=True)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._playback.go_on(self._playback.rate, request.data)
        self._step_after(0.0)
        response.success, response.message = True, self._status()
        return response

    def start(self) -> None:
        """Play when the executor spins."""

    def stop(self) -> None:
        self._log.close()
        self._terminal.end()

    def _step(self) -> None:
        """Send what is due; a timer calls it when something is."""
        try:
            self._step_after(next(self._steps))
        except StopIteration:
            self._timer.cancel()
        except Exception as error:      # there is no further step then
            self._fail(f'cannot be played any further: {error}')

    def _step_after(self, wait_ns: float) -> None:
        self._timer.timer_period_ns = int(min(max(wait_ns, SHORTEST_WAIT_NS), NANOSECONDS))
        self._timer.reset()

    def _fail(self, reason: str) -> None:
        self._terminal.end()
        self.get_logger().error(reason)
        self.finished.set_result(2)

    def _play(self) -> Iterator[float]:
        """Wait for subscribers and the delay, then play the log; yield how long to wait [ns]."""
        senders = {*self.outputs.values(), *filter(None, [self._clock_output])}
        begin = time.monotonic() + self._options.delay
        while time.monotonic() < begin or sum(
                publisher.get_subscription_count() for publisher in senders
                ) < self._options.wait_for_subscribers:
            yield 20e6
        rounds = itertools.count() if self._options.loop else range(1)
        for self._round in rounds:
            steps = self._playback.play(self._begin_ns, self._messages(), ROUND_GAP_NS)
            self._publish_clock()       # before the messages, since it may go back
            yield from steps
            yield ROUND_GAP_NS          # the last messages arrive before the clock goes back
        yield LAST_ANSWERS_NS
        wait_for_all_acked(senders, PATIENCE_S)
        self._terminal.tell(f'played {self._counts()}')
        if self._log.left_out and not self._options.partial:
            self._fail(f'{self._log.path} is damaged inside: `recover` tells what is lost')
        else:
            self.finished.set_result(0)

    def _messages(self) -> Iterator[Message]:
        """Yield the messages of a round."""
        names = {topic.name for topic in self._log.topics if topic.channel_id in self.outputs}
        # Without a /clock that goes back, too, nobody takes stamps that go back.
        goes_back = self._clock_output is not None or '/clock' in names
        later_ns = 0 if goes_back else self._round * (
            self._end_ns - self._begin_ns + ROUND_GAP_NS)
        for message in self._log.messages(names, self._begin_ns if self._options.start else 0):
            publisher, data = self.outputs[message.channel_id], message.data
            yield (max(message.log_time, self._begin_ns), publisher.publish,
                   stamped_later(data, publisher, later_ns) if later_ns else data)

    def _publish_clock(self) -> None:
        if self._clock_output is not None:
            self._clock_output.publish(ClockMessage(clock=Time(
                nanoseconds=min(self._playback.now_ns, LAST_STAMP_NS)).to_msg()))

    def _counts(self) -> str:
        play, topics = self._playback, {one.topic_name for one in self.outputs.values()}
        return f'{play.sent} messages on {len(topics)} topics, {play.late} of them late' + (
            f'; {play.failed} not published: a reader that keeps all has stalled'
            if play.failed else '') + (
            f'; {self._log.left_out} damaged chunks left out' if self._log.left_out else '')

    def _status(self) -> str:
        play, options = self._playback, self._options
        within_s = options.start + (play.now_ns - self._begin_ns) / NANOSECONDS
        which = f' of round {self._round + 1}' if options.loop else ''
        return (f'{within_s:.2f} of {self._length_s:.2f} s{which} | x{play.rate:g} | '
                f'{"paused | " if play.paused else ""}{self._counts()}')


def open_log(path: Path, partial: bool) -> LogReader:
    """Open a log.  Raises LogError, and without `partial` ValueError for a damaged log."""
    log = LogReader(path)
    if not log.whole and (log.damage.torn or log.damage.lost_bytes):
        if not partial:
            raise ValueError(f'{path} is damaged: `recover` makes a whole log of it, --partial '
                             'plays what is whole')
        print(f'spinning-top replay: {path} is damaged, playing what is whole', file=sys.stderr)
    return log


def stamped_later(data: bytes, publisher: Publisher, later_ns: int) -> Any:
    """Return a message with later stamps, or the same bytes if it has none."""
    with contextlib.suppress(Exception):    # recorded with another definition, or too late
        message = deserialize_message(data, publisher.msg_type)
        stamps = [*_stamps(message)]
        for stamp in stamps:
            stamp.sec, stamp.nanosec = divmod(
                stamp.sec * NANOSECONDS + stamp.nanosec + later_ns, NANOSECONDS)
        return message if stamps else data
    return data


def _stamps(message: Any) -> Iterator[Stamp]:
    """Yield all stamps of a message, except those of 0, which is no time."""
    for name in message.get_fields_and_field_types():
        field = getattr(message, name)
        for part in field if isinstance(field, list) else [field]:
            if isinstance(part, Stamp) and (part.sec or part.nanosec):
                yield part
            elif hasattr(part, 'get_fields_and_field_types'):
                yield from _stamps(part)
