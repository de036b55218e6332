# SPDX-License-Identifier: Apache-2.0
"""The publishers of streams, and which of them have subscribers."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from spinning_top_sim.nodes.recording_session import Topic
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.stream import Stream

RECORDED_POLICIES = ('history', 'depth', 'reliability', 'durability', 'liveliness')


class StreamPublishers:
    """Has a publisher for each enabled stream."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.by_topic: dict[str, Publisher] = {}

    def create(self, message_class: type, topic: str) -> Publisher:
        """Create a reliable publisher whose QoS can be overridden by parameters."""
        return self._node.create_publisher(
            message_class, topic, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def open(self, streams: Sequence[Stream], values: Mapping[str, Any]) -> None:
        """Create the publishers of enabled streams; destroy those of others."""
        for stream in streams:
            enabled = journal.is_enabled(stream.parameter, values)
            there = stream.topic in self.by_topic
            if enabled and not there:
                package, _, name = stream.type_name.split('/')
                message_class = getattr(importlib.import_module(f'{package}.msg'), name)
                self.by_topic[stream.topic] = self.create(message_class, stream.topic)
            elif there and not enabled:
                stream.publish = None
                self._node.destroy_publisher(self.by_topic.pop(stream.topic))

    def update_subscribers(self, streams: Sequence[Stream]) -> None:
        """Let a stream publish if anybody subscribes to it; without that, it computes nothing."""
        for stream in streams:
            publisher = self.by_topic.get(stream.topic)
            if publisher is not None:
                heard = publisher.get_subscription_count() > 0
                stream.publish = publisher.publish if heard else None

    def topics_to_record(self, streams: Sequence[Stream]) -> list[Topic]:
        """Return the topics of these streams, and behind them those of the journal."""
        topics: list[Topic] = []
        for stream in streams:
            publisher = self.by_topic[stream.topic]
            topics.append((publisher.topic_name, stream.type_name, {
                name: int(getattr(publisher.qos_profile, name)) for name in RECORDED_POLICIES}))
        return [*topics, *((self._node.resolve_topic_name(name), type_name, {})
                           for name, type_name in journal.TOPICS)]
