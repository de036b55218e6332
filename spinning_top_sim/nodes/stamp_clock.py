# SPDX-License-Identifier: Apache-2.0
"""The clock that dates a simulation."""

import time
from typing import cast

from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMessage

PATIENCE_S = 2.0        # a /clock that does not change for longer has stopped


class StampClock:
    """The clock of the system or, with `use_sim_time`, the /clock of another node."""

    def __init__(self, node: Node, publishes_clock: bool) -> None:
        uses_clock = node.get_parameter('use_sim_time').value
        # Whether it is a /clock; a node does not follow its own.
        self.follows = bool(uses_clock) and not publishes_clock
        self._node, self._topic = node, ''
        self._ros_clock = cast(ROSClock, node.get_clock())
        self._clock = (node.get_clock() if self.follows
                       else Clock(clock_type=ClockType.SYSTEM_TIME))
        self._newest_ns, self._changed_at = 0, time.monotonic()
        if uses_clock:          # rclpy's subscription raises an error for times before 0
            for subscription in [*node.subscriptions]:
                if subscription.msg_type is ClockMessage:
                    node.destroy_subscription(subscription)
            self._topic = node.create_subscription(
                ClockMessage, '/clock', self._take,
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)).topic_name

    def _take(self, message: ClockMessage) -> None:
        if message.clock.sec >= 0:
            self._ros_clock.set_ros_time_override(Time.from_msg(message.clock))

    def now_ns(self) -> int:
        """Return the date [ns]; 0 before the first message on /clock."""
        return int(self._clock.now().nanoseconds)

    def publishers(self) -> int:
        """Return how many nodes publish on the /clock that is followed."""
        return int(self._node.count_publishers(self._topic))

    def is_missing(self) -> bool:
        """Return whether the /clock that is followed has not begun, or has stopped."""
        date_ns, now = self.now_ns(), time.monotonic()
        if date_ns != self._newest_ns:
            self._newest_ns, self._changed_at = date_ns, now
        return self.follows and (date_ns == 0 or now > self._changed_at + PATIENCE_S)
