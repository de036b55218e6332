# SPDX-License-Identifier: Apache-2.0
"""The clock that dates a simulation."""

import time
from collections.abc import Callable
from typing import cast

from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

PATIENCE_S = 2.0        # a /clock that does not change for longer has stopped


class StampClock:
    """
    The clock of the system or, with `use_sim_time`, the /clock of another node.

    publishers : returns how many nodes publish on the /clock that is followed; None if none is
    """

    def __init__(self, node: Node, publishes_clock: bool) -> None:
        self.publishers: Callable[[], int] | None = None
        self._ros_clock = cast(ROSClock, node.get_clock())
        self._clock = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._newest_ns, self._changed_at = 0, time.monotonic()
        if node.get_parameter('use_sim_time').value:
            for subscription in [*node.subscriptions]:
                if subscription.msg_type is ClockMessage:   # it raises an error for times before 0
                    node.destroy_subscription(subscription)
            topic = node.create_subscription(
                ClockMessage, '/clock', self._take,
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)).topic_name
            if not publishes_clock:                         # a node does not follow its own
                self._clock = self._ros_clock
                self.publishers = lambda: int(node.count_publishers(topic))

    def _take(self, message: ClockMessage) -> None:
        if message.clock.sec >= 0:
            self._ros_clock.set_ros_time_override(Time.from_msg(message.clock))

    def now_ns(self) -> int:
        """Return the date [ns]; 0 before the first message on /clock."""
        return int(self._clock.now().nanoseconds)

    def is_missing(self) -> bool:
        """Return whether the /clock that is followed has not begun, or has stopped."""
        date_ns, now = self.now_ns(), time.monotonic()
        if date_ns != self._newest_ns:
            self._newest_ns, self._changed_at = date_ns, now
        return self.publishers is not None and (
            date_ns == 0 or now > self._changed_at + PATIENCE_S)
