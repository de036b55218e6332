#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A subscriber that keeps no secret of what it got: times and sequence numbers of all arrivals.

    python benchmark/listener.py NAMESPACE      # commands on stdin: 'report' or the end

It takes serialized messages straight from the middleware, without an executor, so that it can
follow 6000 messages a second.  An arrival is when the middleware received the message.  `report`
answers with one line of JSON about what came since the last one:
{topic: [[reception time ns], [publication sequence number], [stamp ns]]}.
"""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, JointState

KINDS = {'pose': PoseStamped, 'joint_states': JointState, 'imu/data_raw': Imu}


class Listener:
    """Subscribes to the three streams of a namespace."""

    def __init__(self, namespace: str, topics: list[str]) -> None:
        self.node = rclpy.create_node(f'listener_{os.getpid()}')
        self.subscriptions = {
            topic: self.node.create_subscription(
                KINDS[topic], f'{namespace}/{topic}', lambda _: None, QoSProfile(depth=5000),
                raw=True) for topic in topics}
        self.clear()

    def clear(self) -> None:
        self.got: dict[str, tuple[list[int], list[int], list[int]]] = {
            topic: ([], [], []) for topic in self.subscriptions}

    def wait(self, seconds: float) -> int:
        """Wait for messages and take all there are; return how many."""
        handles = [subscription.handle for subscription in self.subscriptions.values()]
        with self.node.context.handle:
            waits = _rclpy.WaitSet(len(handles), 0, 0, 0, 0, 0, self.node.context.handle)
            waits.clear_entities()
            for handle in handles:
                waits.add_subscription(handle)
            waits.wait(int(seconds * 1e9))
        count = 0
        for topic, subscription in self.subscriptions.items():
            times, numbers, stamps = self.got[topic]
            while (taken := subscription.handle.take_message(
                    subscription.msg_type, True)) is not None:
                data, info = taken
                times.append(info['received_timestamp'])
                numbers.append(info['publication_sequence_number'])
                sec, nanosec = struct.unpack_from('<iI', data, 4)
                stamps.append(sec * 1_000_000_000 + nanosec)
                count += 1
        return count


def main() -> None:
    # Ends with its standard input: an interrupt is for the node that it listens to.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    listener = Listener(sys.argv[1], list(KINDS))
    print('ready', flush=True)
    while True:
        listener.wait(0.1)
        if select.select([sys.stdin], [], [], 0.0)[0]:
            line = sys.stdin.readline()
            if not line:
                break
            print(json.dumps(listener.got), flush=True)
            listener.clear()
    listener.node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
