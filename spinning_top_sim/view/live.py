# SPDX-License-Identifier: Apache-2.0
"""The page of a running sim_node: a node that subscribes to it, and calls its services."""

import math
import threading
import time
import traceback
from collections import defaultdict, deque
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray

from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.nodes.status import EPOCH
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view import shapes
from spinning_top_sim.view.controls import Controls
from spinning_top_sim.view.node_client import ANSWER_S, NodeClient, RequestError
from spinning_top_sim.view.page import CATCH_UP_S, RATE, WINDOW_NS, Page
from spinning_top_sim.view.track import Track, empty

# Best effort and a short queue, so that a slow page never makes the node wait.
QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
INBOX = 2000                    # messages that wait for the next picture
SILENT_S = 5.0                  # timeout of /diagnostics, which come every second
RESTART_NS = NANOSECONDS        # a step back of the stamps by more is another run
KEPT_NS = 2 * max(WINDOW_NS, shapes.TRACE_NS)
KIND_OF = {'pose': PoseStamped, 'joint_states': JointState, 'ground_truth/odom': Odometry,
           'ground_truth/imu': Imu, '~/invariants': Float64MultiArray}


class LiveView(Node):
    """
    The node `view`, for the sim_node of the same namespace.

    The thread of the executor takes messages and answers, the thread of the page draws, and the
    threads of the page's controls wait for answers.
    """

    def __init__(self, page: Page) -> None:
        super().__init__('view')
        self.finished: Future = Future()
        self._page = page
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self._arrived = threading.Event()       # something is in the inbox
        self._listeners: dict[str, Subscription] = {}
        self._client = NodeClient(self)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, QOS)
        self.create_timer(0.2, self._listen_as_needed)
        self._track: Track | None = None
        self._epoch_ns: int | None = None      # stamp of t = 0; unknown before /diagnostics
        self._heard_at = math.inf       # when /diagnostics came last, on the monotonic clock
        self._gone = False              # whether the page says that the node has ended
        self._stopped = False
        self._controls = Controls(page, self._client)
        self._thread = threading.Thread(target=self._draw, name='page', daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped = True
        if self._thread.is_alive():
            self._thread.join(2.0 * ANSWER_S)
        if not self._gone:
            self._controls.tell_end('`view` has ended: no more samples come')
        self._page.close()

    def _listen(self, topic: str) -> None:
        def _receive(data: Any) -> None:        # serialized, because of `raw`
            self._inbox.append((topic, data))
            self._arrived.set()
        self._listeners[topic] = self.create_subscription(
            KIND_OF[topic], topic.replace('~', self._client.name), _receive, QOS, raw=True)

    def _listen_as_needed(self) -> None:
        """Subscribe to the topics that are shown only: each message costs the node some time."""
        needed = {'pose', 'joint_states'}
        if self.count_publishers('ground_truth/odom'):     # both in one
            needed = {'ground_truth/odom'}
        needed |= {'~/invariants'}
        if self._page.arrows['specific force'].value:
            needed |= {'ground_truth/imu'}
        for topic in needed - self._listeners.keys():
            self._listen(topic)
        for topic in self._listeners.keys() - needed:
            self.destroy_subscription(self._listeners.pop(topic))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._client.name.lstrip('/'):
                self._heard_at = time.monotonic()
                numbers = {pair.key: pair.value for pair in status.values}
                self._controls.tell_status(status.message, numbers)
                epoch_ns = int(numbers[EPOCH])
                if self._epoch_ns not in (None, epoch_ns):
                    # Not `|=`: that could undo what `choose` writes.
                    self._client.is_stale = True
                self._epoch_ns = epoch_ns

    # The thread of the page.

    def _draw(self) -> None:
        due = time.monotonic()
        while not self._stopped:
            due = max(due + 1.0 / RATE, time.monotonic() - CATCH_UP_S)
            try:
                self._draw_once()
            except Exception:
                if not self.context.ok():       # a signal has ended it
                    return
                self.get_logger().error(traceback.format_exc(), throttle_duration_sec=5.0)
            time.sleep(max(due - time.monotonic(), 0.0))
            # If messages are as frequent as pictures, some pictures would have no new message.
            self._arrived.wait(1.0 / RATE)

    def _draw_once(self) -> None:
        ready = self._client.is_there
        if self._client.is_stale and ready:
            self._read_parameters()
        if self._track is None:
            return
        self._gone = not ready or time.monotonic() > self._heard_at + SILENT_S
        if self._gone:
            self._controls.tell_end(f'{self._client.name} has ended, or does not answer')
        self._take_messages()
        track = self._track
        if not len(track.attitudes.rows):
            return
        newest_ns = track.span[1]
        track.drop_before(max(newest_ns - KEPT_NS, min(self._epoch_ns or 0, newest_ns)))
        track.detect_motion()
        if track.motions:
            self._controls.show_spin(track.motions[-1].l3, track.motions[-1].lz)
        self._page.draw(newest_ns, newest_ns if self._epoch_ns is None else self._epoch_ns)

    def _take_messages(self) -> None:
        """Add the messages of the inbox to the track."""
        assert self._track is not None
        arrived = defaultdict(list)
        self._arrived.clear()
        while self._inbox:
            topic, data = self._inbox.popleft()
            arrived[topic].append(data)
        for topic, messages in arrived.items():
            # Those without a stamp belong to the newest sample.
            samples = self._track.decode(topic, messages, None if topic != '~/invariants' else (
                len(messages) * [self._track.span[1]]))
            known_ns = self._track.samples[topic].stamps_ns
            if len(known_ns) and (samples.stamps_ns[-1:] < known_ns[-1] - RESTART_NS).any():
                self._track.drop_before(known_ns[-1] + 1)        # the sim_node was started again
            self._track.add(topic, samples)
        for topic in KIND_OF.keys() - self._listeners.keys():   # these get old
            self._track.samples[topic] = empty(topic)

    def _read_parameters(self) -> None:
        """Read the parameters of the sim_node, and draw its top."""
        try:
            values = self._client.values()
        except RequestError:
            return
        track = Track('', values)
        if self._track is not None:
            if all(values[name] == self._track.values[name] for name in values.keys() - SPIN):
                return
            track.samples = self._track.samples
        self._track = track
        self._page.set_tracks([track])
        self._controls.set_range(track.top, *(values[name] for name in SPIN))
