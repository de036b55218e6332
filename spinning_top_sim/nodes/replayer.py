# SPDX-License-Identifier: Apache-2.0
"""The node `replay`: publishes the messages of a log with their recorded spacing."""

import argparse
import contextlib
import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time as Stamp
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from spinning_top_sim.nodes import ros_parameters
from spinning_top_sim.nodes.executable import tell
from spinning_top_sim.nodes.publishers import create_publisher, message_class, wait_for_all_acked
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS, qos_profiles
from spinning_top_sim.streams.parameter import Range
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.tools.cli import one_line

BUDGET_NS = 20_000_000          # services wait for messages that are due at most so long
ROUND_GAP_NS = 10_000_000       # real time before the first message of a round, and after the last
SHORTEST_WAIT_NS = 300_000      # denser messages are sent together: each wait takes 0.1 ms
LAST_ANSWERS_NS = 300_000_000   # best-effort subscribers read shared memory, which ends with us
PATIENCE_S = 5.0                # Fast DDS asks every 3 s for acknowledgements


class Replayer(Node):
    """
    The node.  It plays an open log, which `stop` closes.  Raises ValueError if it cannot.

    Log time runs `rate` times as fast as steady time; messages are sent when it comes to them.

    options : those that `replay_node.add_arguments` describes
    outputs : the publishers by the number of the channel
    sent, failed : how many messages were sent, and could not be sent
    """

    def __init__(self, log: LogReader, options: argparse.Namespace) -> None:
        super().__init__('replay', automatically_declare_parameters_from_overrides=True)
        overrides = ros_parameters.take_overrides(self)
        self.finished: Future = Future()    # completes with the exit code when all is played
        self.sent = self.failed = 0
        self._log, self._options = log, options
        self._later_ns = 0              # what the rounds before have played
        first = next(log.messages(start=1), None)       # a time of 0 says: no clock yet
        log_begin_ns = first.log_time if first else 0
        self._length_s = (log.span[1] - log_begin_ns) / NANOSECONDS
        for name, value, allowed in (('start', options.start, Range(0.0, self._length_s)),
                                     ('rate', options.rate, Range(1e-6, 1e9)),
                                     ('clock', 1.0 if options.clock is None else options.clock,
                                      Range(1e-6, 1e4))):
            if value not in allowed:
                raise ValueError(f'--{name} {value:g}: must be {allowed}')
        self._begin_ns = log_begin_ns + round(options.start * NANOSECONDS)
        self.outputs = self._open_publishers()
        ros_parameters.warn_of_disobeyed(self, overrides)
        self._paused = options.start_paused
        self._set_log_time(self._begin_ns)
        self._steps = self._play()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(0.02, self._step, clock=steady)
        self._clock_output: Publisher | None = None
        if options.clock:
            self._clock_output = self.create_publisher(ClockMessage, '/clock', 10)
            self.create_timer(1.0 / options.clock, self._publish_clock, clock=steady)
        self.create_service(SetBool, '~/set_pause', self._set_pause)

    def _open_publishers(self) -> dict[int, Publisher]:
        """Return a publisher for each channel; warn of the topics that cannot be played."""
        warn, there = self.get_logger().warning, {topic.name for topic in self._log.topics}
        wanted = set(self._options.topics) or there
        for name in sorted(wanted - there):
            warn(f'the log has no topic {name}')
        outputs: dict[int, Publisher] = {}
        for topic in self._log.topics:
            if topic.name in wanted:
                try:
                    outputs[topic.channel_id] = self._publisher(topic)
                except Exception as error:  # a log may ask for anything; the others are played
                    warn(one_line(f'{topic.name} is not played: {error}'))
        if wanted and not outputs and not self._options.clock:
            raise ValueError('none of the topics can be played; the log has '
                             f'{", ".join(sorted(there)) or "none at all"}')
        return outputs

    def _publisher(self, topic: LogTopic) -> Publisher:
        if topic.name == '/clock' and self._options.clock:
            raise LookupError('--clock publishes another /clock')
        if topic.encoding != 'cdr':
            raise LookupError(f'its messages are encoded as {topic.encoding!r}, not as CDR')
        profiles = qos_profiles(self._log.channels[topic.channel_id]) or (DEFAULT_QOS,)
        # It serves all subscribers that the recorded publishers have served together.
        publisher = create_publisher(self, message_class(topic.type_name), topic.name, QoSProfile(
            reliability=min(one['reliability'] for one in profiles),
            durability=min(one['durability'] for one in profiles),
            history=max(one['history'] for one in profiles),
            depth=min(sum(one['depth'] for one in profiles), 2 ** 31 - 1) or 10))
        if any(one != profiles[0] for one in profiles):
            played = publisher.qos_profile
            self.get_logger().warning(
                f'{topic.name} was recorded with several QoS profiles: it is played as '
                f'{played.reliability.name.lower()} and {played.durability.name.lower()}')
        return publisher

    def _set_log_time(self, log_ns: int) -> None:
        """Let log time be this, until messages are played."""
        self._log_ns = self._next_ns = log_ns       # at `_since_ns`, and of the next message
        self._since_ns = time.monotonic_ns()

    @property
    def now_ns(self) -> int:
        """The log time up to which all messages are sent."""
        passed_ns = 0 if self._paused else time.monotonic_ns() - self._since_ns
        return self._log_ns + int(min(passed_ns * self._options.rate,
                                      self._next_ns - self._log_ns))

    def _left_ns(self) -> float:
        """Return how long it is until the next message is due; nothing is, in a pause."""
        return math.inf if self._paused else self._since_ns + (
            self._next_ns - self._log_ns) / self._options.rate - time.monotonic_ns()

    def _set_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Stand, or go on from here; nothing is caught up."""
        self._log_ns, self._since_ns = self.now_ns, time.monotonic_ns()
        self._paused = request.data
        self._step_after(0.0)
        response.success = True
        response.message = f'at {(self._log_ns - self._begin_ns) / NANOSECONDS:.2f} s'
        return response

    def start(self) -> None:
        """Play when the executor spins."""
        tell(f'playing {self._log.path}')

    def stop(self) -> None:
        self._log.close()
        tell(f'played {self.sent} messages' + (
            f'; {self.failed} not published: a reader that keeps all has stalled'
            if self.failed else ''))

    def _step(self) -> None:
        """Send what is due; a timer calls it when something is."""
        try:
            self._step_after(next(self._steps))
        except StopIteration:
            self._timer.cancel()
        except Exception as error:      # there is no further step then
            self.get_logger().error(f'cannot be played any further: {error}')
            self.finished.set_result(2)

    def _step_after(self, wait_ns: float) -> None:
        self._timer.timer_period_ns = int(min(max(wait_ns, SHORTEST_WAIT_NS), NANOSECONDS))
        self._timer.reset()

    def _play(self) -> Iterator[float]:
        """Play the log; yield how long to wait each time [ns]."""
        for _ in itertools.count() if self._options.loop else range(1):
            self._set_log_time(self._begin_ns)
            self._publish_clock()       # before the messages, since it may go back
            yield ROUND_GAP_NS
            yield from self._play_round()
            yield ROUND_GAP_NS          # the last messages arrive before the clock goes back
            self._later_ns += self._next_ns - self._begin_ns + ROUND_GAP_NS
        yield LAST_ANSWERS_NS
        wait_for_all_acked(self.outputs.values(), PATIENCE_S)
        self.finished.set_result(0)

    def _play_round(self) -> Iterator[float]:
        messages = self._messages()
        first = [*itertools.islice(messages, 1)]        # reading it takes a while
        self._since_ns = time.monotonic_ns()
        stop_ns = self._since_ns + BUDGET_NS
        for self._next_ns, publisher, message in itertools.chain(first, messages):
            while (left_ns := self._left_ns()) > 0 or time.monotonic_ns() > stop_ns:
                yield max(left_ns, 0.0)
                stop_ns = time.monotonic_ns() + BUDGET_NS
            try:
                publisher.publish(message)
                self.sent += 1
            except Exception:       # as with a reader that keeps all and has stopped reading
                self.failed += 1

    def _messages(self) -> Iterator[tuple[int, Publisher, Any]]:
        """Yield log time [ns], publisher and message of the messages of a round."""
        names = {topic.name for topic in self._log.topics if topic.channel_id in self.outputs}
        # Without a /clock that goes back, too, nobody takes stamps that go back.
        later_ns = 0 if self._clock_output or '/clock' in names else self._later_ns
        for message in self._log.messages(names, self._begin_ns if self._options.start else 0):
            if publisher := self.outputs.get(message.channel_id):   # of several with a topic
                data = message.data
                yield (max(message.log_time, self._begin_ns), publisher,
                       stamped_later(data, publisher, later_ns) if later_ns else data)

    def _publish_clock(self) -> None:
        if self._clock_output is not None:
            self._clock_output.publish(ClockMessage(clock=Time(
                nanoseconds=min(self.now_ns, LAST_STAMP_NS)).to_msg()))


def open_log(path: Path, partial: bool) -> LogReader:
    """Open a log.  Raises LogError, and without `partial` ValueError for a damaged log."""
    log = LogReader(path)
    if not partial and not log.whole:
        raise ValueError(f'{path} is damaged: `recover` makes a whole log of it, --partial plays '
                         'what is whole')
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
