# SPDX-License-Identifier: Apache-2.0
"""The publishers of the channels of a simulation."""

from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from spinning_top_sim.nodes.endpoints import message_class
from spinning_top_sim.nodes.recording import Topic
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.live import Output


class ChannelPublishers:
    """Holds a publisher for each enabled channel, by topic."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.by_topic: dict[str, Publisher] = {}

    def create(self, kind: type, topic: str) -> Publisher:
        """Return a new publisher, whose QoS parameters can override."""
        return self._node.create_publisher(
            kind, topic, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    @staticmethod
    def check(outputs: Sequence[Output], values: Mapping[str, Any]) -> None:
        """Raise ValueError for an enabled channel whose messages are not installed."""
        for channel in (output.channel for output in outputs):
            if parameters.is_enabled(channel.name, values):
                try:
                    message_class(channel.type_name)
                except LookupError as error:
                    raise ValueError(f'{channel.name}.enabled: {error}') from error

    def open(self, outputs: Sequence[Output], values: Mapping[str, Any]) -> None:
        """Create the publishers of enabled channels, and destroy those of disabled ones."""
        for output in outputs:
            topic = output.channel.topic
            enabled = parameters.is_enabled(output.channel.name, values)
            if enabled and topic not in self.by_topic:
                self.by_topic[topic] = self.create(message_class(output.channel.type_name), topic)
            elif topic in self.by_topic and not enabled:
                output.publish = None
                self._node.destroy_publisher(self.by_topic.pop(topic))

    def update_subscribers(self, outputs: Sequence[Output]) -> bool:
        """Connect the outputs that have subscribers; return whether others have some now."""
        changed = False
        for output in outputs:
            publisher = self.by_topic.get(output.channel.topic)
            wanted = publisher is not None and publisher.get_subscription_count() > 0
            if wanted != (output.publish is not None):
                output.publish = publisher.publish if wanted and publisher else None
                changed = True
        return changed

    def topics_to_record(self, channels: Sequence[Channel]) -> list[Topic]:
        """Return name, type and QoS of the topics of these channels, then those of events."""
        topics: list[Topic] = []
        for channel in channels:
            publisher = self.by_topic[channel.topic]
            topics.append((publisher.topic_name, channel.type_name, {
                name: int(getattr(publisher.qos_profile, name)) for name in (
                    'history', 'depth', 'reliability', 'durability', 'liveliness')}))
        return topics + [(self._node.resolve_topic_name(name), type_name, {})
                         for name, type_name in events.TOPICS.items()]
