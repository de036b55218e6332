# SPDX-License-Identifier: Apache-2.0
"""Limits the rate of a topic that only serves displays."""

import time
from collections.abc import Callable

from rclpy.publisher import Publisher

Publish = Callable[[bytes], object]

RATE = 30.0                     # messages a second of real time, at most
TOPICS = {'ground_truth/odom': 'ground_truth/odom_throttle'}


class Throttle:
    """Publishes at most RATE messages of a stream a second, as sending one is expensive."""

    def __init__(self, publisher: Publisher) -> None:
        self.publisher = publisher
        self._due = 0.0                         # time on the monotonic clock of the next message
        self._withheld: bytes | None = None     # the newest message, until it is published

    def sink(self, publish_all: Publish | None) -> Publish | None:
        """Return what takes the messages of the stream; `publish_all` takes each of them."""
        if not self.publisher.get_subscription_count():
            self._withheld = None
            return publish_all

        def publish(message: bytes) -> None:
            if publish_all is not None:
                publish_all(message)
            self._withheld = message
            self.flush()

        return publish

    def flush(self, at_once: bool = False) -> None:
        """Publish the newest message if it is due, or in any case with `at_once`."""
        now = time.monotonic()
        if self._withheld is not None and (at_once or now >= self._due):
            # On average the rate is RATE, whatever the rate of the stream.
            self._due = max(self._due, now - 1.0 / RATE) + 1.0 / RATE
            self.publisher.publish(self._withheld)
            self._withheld = None
