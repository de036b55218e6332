# SPDX-License-Identifier: Apache-2.0
"""The clock that dates a simulation."""

import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from spinning_top_sim.nodes.tick_loop import EPOCH_GRID_NS

PATIENCE_S = 2.0        # a /clock that does not change for longer has stopped


class StampClock:
    """The clock of the system or, with `use_sim_time`, the /clock of another node."""

    def __init__(self, node: Node, publishes_clock: bool) -> None:
        # Whether it is a /clock; a node does not follow its own.
        self.follows = bool(node.get_parameter('use_sim_time').value) and not publishes_clock
        self._clock = (node.get_clock() if self.follows
                       else Clock(clock_type=ClockType.SYSTEM_TIME))
        self._newest_ns, self._changed_at = 0, time.monotonic()
        for subscription in node.subscriptions:
            if subscription.msg_type is ClockMessage:
                subscription.callback = _without_negative_times(subscription.callback)

    def now_ns(self) -> int:
        """Return the date [ns]; 0 before the first message on /clock."""
        return int(self._clock.now().nanoseconds)

    def first_ns(self) -> int:
        """Return the date of a t = 0 that begins now [ns]."""
        date_ns = self.now_ns()
        # Stamps are never ahead of a /clock that is followed, and 0 means "no time".
        return max(date_ns // EPOCH_GRID_NS, 1) * EPOCH_GRID_NS if self.follows else date_ns

    def is_missing(self) -> bool:
        """Return whether the /clock that is followed has not begun, or has stopped."""
        date_ns, now = self.now_ns(), time.monotonic()
        if date_ns != self._newest_ns:
            self._newest_ns, self._changed_at = date_ns, now
        return self.follows and (date_ns == 0 or now > self._changed_at + PATIENCE_S)


def _without_negative_times(take: Callable[[ClockMessage], object],
                            ) -> Callable[[ClockMessage], None]:
    """Return a callback that ignores times before 0, for which rclpy raises an error."""
    def call(message: ClockMessage) -> None:
        if message.clock.sec >= 0:
            take(message)
    return call
