# SPDX-License-Identifier: Apache-2.0
"""The publishers of the streams of a simulation, and those with a limited rate, for displays."""

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from spinning_top_sim.nodes.endpoints import message_class
from spinning_top_sim.nodes.recording_session import Topic
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.live import Output
from spinning_top_sim.streams.stream import Stream

Publish = Callable[[bytes], object]

THROTTLED_RATE = 30.0           # messages a second of real time, at most
THROTTLED = {'ground_truth/odom': 'ground_truth/odom_throttle'}


class Throttle:
    """Publishes at most THROTTLED_RATE messages of a stream a second: to send one is expensive."""

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
            # On average the rate is THROTTLED_RATE, whatever the rate of the stream.
            self._due = max(self._due, now - 1.0 / THROTTLED_RATE) + 1.0 / THROTTLED_RATE
            self.publisher.publish(self._withheld)
            self._withheld = None


class StreamPublishers:
    """Holds a publisher for each enabled stream, and a throttle for the topics that have one."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.by_topic: dict[str, Publisher] = {}
        self._throttles: dict[str, Throttle] = {}       # by the topic of the stream

    def create(self, kind: type, topic: str) -> Publisher:
        """Return a new publisher, whose QoS parameters can override."""
        return self._node.create_publisher(
            kind, topic, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    @staticmethod
    def check(outputs: Sequence[Output], values: Mapping[str, Any]) -> None:
        """Raise ValueError for an enabled stream whose message package is not installed."""
        for output in outputs:
            package, parameter = output.stream.type_name.split('/')[0], output.stream.parameter
            if parameters.is_enabled(parameter, values) and find_spec(package) is None:
                raise ValueError(f'{parameter}.enabled: needs the ROS package {package}, which is '
                                 'not installed')

    def open(self, outputs: Sequence[Output], values: Mapping[str, Any]) -> None:
        """Create the publishers of enabled streams, and destroy those of disabled ones."""
        for output in outputs:
            stream = output.stream
            topic, enabled = stream.topic, parameters.is_enabled(stream.parameter, values)
            if enabled and topic not in self.by_topic:
                kind = message_class(stream.type_name)
                self.by_topic[topic] = self.create(kind, topic)
                if topic in THROTTLED:
                    self._throttles[topic] = Throttle(self.create(kind, THROTTLED[topic]))
            elif topic in self.by_topic and not enabled:
                output.publish = None
                self._node.destroy_publisher(self.by_topic.pop(topic))
                if topic in THROTTLED:
                    self._node.destroy_publisher(self._throttles.pop(topic).publisher)

    def update_subscribers(self, outputs: Sequence[Output]) -> None:
        """Connect the outputs that have subscribers; a stream without any computes nothing."""
        for output in outputs:
            publisher = self.by_topic.get(output.stream.topic)
            if publisher is not None:
                sink = publisher.publish if publisher.get_subscription_count() else None
                throttle = self._throttles.get(output.stream.topic)
                output.publish = throttle.sink(sink) if throttle else sink

    def flush(self, at_once: bool) -> None:
        """Publish what throttles hold back, when their rate allows it or at once."""
        for throttle in self._throttles.values():
            throttle.flush(at_once)

    def topics_to_record(self, streams: Sequence[Stream]) -> list[Topic]:
        """Return name, type and QoS of the topics of these streams, then those of the journal."""
        topics: list[Topic] = []
        for stream in streams:
            publisher = self.by_topic[stream.topic]
            topics.append((publisher.topic_name, stream.type_name, {
                name: int(getattr(publisher.qos_profile, name)) for name in (
                    'history', 'depth', 'reliability', 'durability', 'liveliness')}))
        return topics + [(self._node.resolve_topic_name(name), type_name, {})
                         for name, type_name in journal.TOPICS.items()]
