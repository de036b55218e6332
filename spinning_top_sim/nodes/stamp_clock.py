# SPDX-License-Identifier: Apache-2.0
"""The clock that dates a simulation."""

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from spinning_top_sim.nodes.tick_loop import EPOCH_GRID_NS


class StampClock:
    """
    The clock of the system or, with `use_sim_time`, the /clock of another node.

    follows : whether it is a /clock; a node does not follow its own
    """

    def __init__(self, node: Node, publishes_clock: bool) -> None:
        self.follows = bool(node.get_parameter('use_sim_time').value) and not publishes_clock
        self._clock = (node.get_clock() if self.follows
                       else Clock(clock_type=ClockType.SYSTEM_TIME))
        for subscription in node.subscriptions:
            if subscription.msg_type is ClockMessage:
                subscription.callback = _without_negative_times(subscription.callback)

    def now_ns(self) -> int:
        """Return the date [ns]; 0 before the first message on /clock."""
        return int(self._clock.now().nanoseconds)

    def first_ns(self) -> int:
        """
        Return the date of a t = 0 that begins now [ns].

        Stamps are never ahead of a /clock that is followed, and 0 means "no time".
        """
        date_ns = self.now_ns()
        return max(date_ns // EPOCH_GRID_NS, 1) * EPOCH_GRID_NS if self.follows else date_ns


def _without_negative_times(take: Callable[[ClockMessage], object],
                            ) -> Callable[[ClockMessage], None]:
    """Return a callback that ignores times before 0, for which rclpy raises an error."""
    def call(message: ClockMessage) -> None:
        if message.clock.sec >= 0:
            take(message)
    return call
