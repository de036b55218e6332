# SPDX-License-Identifier: Apache-2.0
"""Publishers: of types by name, with the QoS of parameters, and those of a simulation."""

import importlib
import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.type_support import check_for_type_support

from spinning_top_sim.nodes.recording import Topic
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.live import LiveSimulation


def message_class(type_name: str) -> type:
    """Return a class of an installed package of messages.  Raises ValueError."""
    package, _, name = type_name.replace('/msg/', '/').partition('/')
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    try:
        # Other Python packages must not be imported because a log names them.
        if not any(Path(prefix, 'share/ament_index/resource_index/packages', package).is_file()
                   for prefix in prefixes):
            raise LookupError(package)
        kind: type = getattr(importlib.import_module(f'{package}.msg'), name)
        check_for_type_support(kind)
    except Exception as error:      # importing a broken package may raise anything
        raise ValueError(f'{type_name}: must be an installed type of messages') from error
    return kind


def create_publisher(node: Node, kind: type, topic: str, qos: QoSProfile | None = None,
                     ) -> Publisher:
    """Return a new publisher, whose QoS (by default: keep the last 10) parameters override."""
    return node.create_publisher(
        kind, topic, qos or QoSProfile(depth=10),
        qos_overriding_options=QoSOverridingOptions.with_default_policies())


def wait_for_all_acked(publishers: Iterable[Publisher], seconds: float) -> None:
    """Wait at most so long until all subscribers have acknowledged all messages."""
    end = time.monotonic() + seconds
    for publisher in publishers:
        if publisher.get_subscription_count():
            publisher.wait_for_all_acked(Duration(seconds=max(end - time.monotonic(), 0.001)))


class ChannelPublishers:
    """Holds a publisher for each enabled channel of a simulation, by topic."""

    def __init__(self, node: Node, simulation: LiveSimulation) -> None:
        self._node, self._simulation = node, simulation
        self.by_topic: dict[str, Publisher] = {}

    def open(self, values: Mapping[str, Any]) -> None:
        """Create the publishers of enabled channels, destroy the others.  Raises ValueError."""
        for output in self._simulation.outputs:
            topic = output.channel.topic
            enabled = parameters.is_enabled(output.channel.name, values)
            if enabled and topic not in self.by_topic:
                self.by_topic[topic] = create_publisher(
                    self._node, message_class(output.channel.type_name), topic)
            elif topic in self.by_topic and not enabled:
                output.publish = None
                self._simulation.refresh()
                self._node.destroy_publisher(self.by_topic.pop(topic))

    def update_subscribers(self) -> None:
        """Connect the outputs that have subscribers."""
        for output in self._simulation.outputs:
            one = self.by_topic.get(output.channel.topic)
            publish = one.publish if one and one.get_subscription_count() else None
            if publish != output.publish:
                output.publish = publish
                self._simulation.refresh()

    def topics_to_record(self, channels: Sequence[Channel]) -> list[Topic]:
        """Return name, type and QoS of the topics of these channels, then those of events."""
        policies = ('history', 'depth', 'reliability', 'durability', 'liveliness')
        publishers = [(self.by_topic[channel.topic], channel.type_name) for channel in channels]
        return [(one.topic_name, type_name, {
            name: int(getattr(one.qos_profile, name)) for name in policies})
            for one, type_name in publishers] + [
                (self._node.resolve_topic_name(name), type_name, {})
                for name, type_name in events.TOPICS.items()]
