# SPDX-License-Identifier: Apache-2.0
"""The source of a page for a running sim_node: a node that listens to it."""

import math
import threading
import time
from collections import defaultdict, deque
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.nodes.status import EPOCH, SPEED, STATE
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.topics import NODE_NAME
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.page import Page, set_content
from spinning_top_sim.view.samples import TOPICS, SampledTrack
from spinning_top_sim.view.source import WINDOW_NS

# Best effort and a short queue, so that a slow page never makes the node wait.
QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
INBOX = 2000                    # messages that wait for the next picture
ANSWER_S = 5.0                  # timeout of a service call, and of /diagnostics
RESTART_NS = NANOSECONDS        # a step back of the stamps by more is another run
KINDS = dict(zip(TOPICS, (Odometry, JointState, PoseStamped, Imu), strict=True))
SERVICES = {'get_parameters': GetParameters, 'set_pause': SetBool, 'step': Trigger,
            'reset': Trigger}


class NodeView(Node):
    """
    The node `view`, for the sim_node of the same namespace, and the source of its page.

    The thread of the executor takes messages and answers, the thread of the page draws, and
    threads of viser wait for what buttons ask.
    """

    def __init__(self, page: Page) -> None:
        super().__init__('view')
        self.finished: Future = Future()
        self._page, self._name = page, self.resolve_topic_name(NODE_NAME)
        self._clients_of = {name: self.create_client(kind, f'{NODE_NAME}/{name}')
                            for name, kind in SERVICES.items()}
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self._topic = ''                # one of TOPICS
        self._listener: Subscription | None = None
        self._track: SampledTrack | None = None
        self._epoch_ns = 0              # stamp of t = 0; 0 before /diagnostics tell it
        self._read_at: int | None = None        # this stamp when the parameters were read
        self._heard_at = math.inf       # when /diagnostics came last, on the monotonic clock
        self._paused = False
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=page.show, args=(self, self._stopped),
                                        name='page', daemon=True)
        gui = page.gui
        with page.controls:
            self._status = gui.add_markdown('*waiting for sim_node*')
            self._pause = gui.add_button('Pause')
            buttons = gui.add_button_group('time', ('Step', 'Reset'))
        self._pause.on_click(lambda _: self._command('set_pause', not self._paused))
        buttons.on_click(lambda _: self._command(buttons.value.lower()))
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, QOS)
        self.create_timer(0.2, self._listen)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(2.0 * ANSWER_S)
        set_content(self._status, '**`view` has ended: no more samples come**')
        self._page.close()

    def _call(self, name: str, request: object) -> Any:
        """Return the answer of a service of the sim_node.  Raises ConnectionError without one."""
        client = self._clients_of[name]
        answer = client.call(request, ANSWER_S) if client.service_is_ready() else None
        if answer is None:
            raise ConnectionError(f'{self._name}/{name} does not answer')
        return answer

    def _command(self, name: str, *on: bool) -> None:
        """Let the sim_node do something; show its answer, or the reason why not."""
        try:
            answer = self._call(name, SetBool.Request(data=on[0]) if on else Trigger.Request())
        except Exception as error:
            self._page.message.content = f'**refused:** {error}'
            return
        refused = '' if answer.success else '**refused:** '
        self._page.message.content = f'{refused}{name.removeprefix("set_")}: {answer.message}'

    # The thread of the executor.

    def _listen(self) -> None:
        """Listen to the topic that tells most, and to no other: each message costs some time."""
        topic = next((name for name in TOPICS if self.count_publishers(name)), '')
        if not topic or topic == self._topic:
            return
        if self._listener is not None:
            self.destroy_subscription(self._listener)
        self._topic = topic

        def receive(data: Any) -> None:         # serialized, because of `raw`
            self._inbox.append((topic, data))
        self._listener = self.create_subscription(KINDS[topic], topic, receive, QOS, raw=True)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            numbers = {pair.key: pair.value for pair in status.values}
            # Another node may have the name, too.
            if status.name == self._name.lstrip('/') and {
                    STATE, SPEED, EPOCH} <= numbers.keys():
                self._heard_at = time.monotonic()
                self._paused = numbers[STATE] == 'paused'
                self._pause.label = 'Resume' if self._paused else 'Pause'
                set_content(self._status, f'{status.message} · {SPEED} {numbers[SPEED]}')
                self._epoch_ns = int(numbers[EPOCH])

    # The thread of the page.

    def update(self, _: float) -> int:
        ready = (self.context.ok()              # a signal ends it
                 and self._clients_of['get_parameters'].service_is_ready())
        if not ready or time.monotonic() > self._heard_at + ANSWER_S:
            set_content(self._status, f'**{self._name} has ended, or does not answer**')
        elif self._read_at != self._epoch_ns:
            self._read_parameters(self._epoch_ns)
        track = self._track
        if track is None:
            return 0
        self._take_messages(track)
        if not len(track.rows):
            return 0
        newest_ns = int(track.stamps_ns[-1])
        track.epoch_ns = self._epoch_ns or track.epoch_ns or newest_ns
        track.drop_before(max(newest_ns - 2 * WINDOW_NS, min(self._epoch_ns, newest_ns)))
        return track.span[1]

    @property
    def track(self) -> SampledTrack | None:
        return self._track if self._track is not None and len(self._track.rows) else None

    def _take_messages(self, track: SampledTrack) -> None:
        arrived = defaultdict(list)
        while self._inbox:
            topic, data = self._inbox.popleft()
            if len(data) == len(track.templates[topic]):        # else it is none of ours
                arrived[topic].append(data)
        for topic, messages in arrived.items():
            last_ns = int(track.templates[topic].stamps_ns(messages[-1])[0])
            if len(track.rows) and last_ns < track.stamps_ns[-1] - RESTART_NS:
                track.drop_before(int(track.stamps_ns[-1]) + 1)     # the sim_node began again
            track.add_messages(topic, messages)

    def _read_parameters(self, epoch_ns: int) -> None:
        """Read the parameters of the sim_node since a stamp of t = 0, and show its top."""
        # Not those of the spin: the present one need not be possible at the start.
        names = [name for name in parameters.BY_NAME if name not in SPIN]
        try:
            answer = self._call('get_parameters', GetParameters.Request(names=names))
        except ConnectionError:         # it is asked again with the next picture
            return
        track = SampledTrack(parameters.valid(dict(zip(
            names, map(parameter_value_to_python, answer.values), strict=True))))
        if self._track is not None:
            track.stamps_ns, track.rows = self._track.stamps_ns, self._track.rows
        self._track, self._read_at = track, epoch_ns
