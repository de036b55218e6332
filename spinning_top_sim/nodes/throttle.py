# SPDX-License-Identifier: Apache-2.0
"""Few messages of a stream on a topic of their own, for those who only watch."""

import time
from collections.abc import Callable

from rclpy.publisher import Publisher

from spinning_top_sim.streams.live import Output

Publish = Callable[[bytes], object]

RATE = 30.0                     # messages a second of real time, at most
TOPICS = {'ground_truth/odom': 'ground_truth/odom_throttle'}


class Throttle:
    """
    Publishes at most RATE messages of a stream a second.

    A message to a subscriber costs the node more than to compute it.  `flush`, called while the
    motion stands still, publishes the last one.
    """

    def __init__(self, publisher: Publisher) -> None:
        self.publisher = publisher
        self._due = 0.0                         # on the monotonic clock: when one may go out
        self._withheld: bytes | None = None     # the newest message, if it has not gone out
        self._uncounted = False                 # it is not among the stream's messages sent

    def sink(self, output: Output, publish_all: Publish | None) -> Publish | None:
        """
        Return what takes the samples of a stream; None without subscribers.

        publish_all : takes those that are for subscribers of the stream's own topic, or None
        """
        self._output, self._publish_all = output, publish_all
        if self.publisher.get_subscription_count():
            return self._publish
        self._withheld = None
        return publish_all

    def _publish(self, message: bytes) -> None:
        if self._publish_all is not None:
            self._publish_all(message)
        now = time.monotonic()
        if now < self._due:
            self._withheld, self._uncounted = message, self._publish_all is None
            self._output.sent -= self._uncounted        # who calls this counts it
            return
        self._send(message, now)

    def _send(self, message: bytes, now: float) -> None:
        # On the average the rate is RATE, whatever the rate of the stream.
        self._due = max(self._due, now - 1.0 / RATE) + 1.0 / RATE
        self._withheld = None
        self.publisher.publish(message)

    def flush(self, at_once: bool = False) -> None:
        """Publish the newest message if that has not been done; `at_once`: before it is due."""
        if self._withheld is not None:
            now = time.monotonic()
            if at_once or now >= self._due:
                self._output.sent += self._uncounted
                self._send(self._withheld, now)
