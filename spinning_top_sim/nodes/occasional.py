# SPDX-License-Identifier: Apache-2.0
"""Entities that an executor looks after now and then only, because each costs at every wake-up."""

from __future__ import annotations

import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup

OPEN_S = 0.02


class OccasionalGroup(ReentrantCallbackGroup):
    """
    A callback group that is left out of the wait set, but for a moment after `open`.

    For events of publishers (rclpy tells of subscriptions with other QoS by them): every handler
    adds some 20 us to each wake-up of the executor.  Such an event waits until it is looked at.
    """

    def __init__(self) -> None:
        super().__init__()
        self._until = 0.0

    def add_entity(self, entity: Any) -> None:
        """See `rclpy.callback_groups.CallbackGroup`, which never forgets one."""
        self.entities = {known for known in self.entities if known() is not None}
        super().add_entity(entity)

    def open(self) -> None:
        """Have the group looked at by the wait that follows."""
        self._until = time.monotonic() + OPEN_S

    def can_execute(self, entity: Any) -> bool:
        """See `rclpy.callback_groups.CallbackGroup`."""
        return time.monotonic() < self._until
