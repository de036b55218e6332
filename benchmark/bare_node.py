#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A node that only publishes constant bytes, for `node_cpu.py` and `startup.py`.

A thread that sleeps until absolute deadlines publishes the same bytes at each tick.  Nothing is
computed.  On request the node has the parameters (a JSON file of name, value, description and
range), the services and the subscription of `sim_node`.

    python benchmark/bare_node.py --ros-args -p rate:=1000.0
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, JointState


class Bare(Node):
    """Publishes pose, joint_states and imu/data_raw at one rate, all of them constant."""

    def __init__(self) -> None:
        super().__init__('spinning_top')
        rate = self.declare_parameter('rate', 100.0).value
        like = self.declare_parameter('like', '').value
        self.once = self.declare_parameter('once', False).value
        self.sinks = []
        if like:
            self._pretend(Path(like))
        self._add(PoseStamped, 'pose', PoseStamped())
        self._add(JointState, 'joint_states',
                  JointState(name=['precession_joint', 'nutation_joint', 'spin_joint'],
                             position=3 * [0.0], velocity=3 * [0.0]))
        self._add(Imu, 'imu/data_raw', Imu())
        self.rate, self.stopped = rate, False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _add(self, kind, topic, message) -> None:
        message.header.frame_id = 'imu_link'
        self.sinks.append((self.create_publisher(kind, topic, 10).publish,
                           serialize_message(message)))

    def _pretend(self, path: Path) -> None:
        """Have what sim_node has besides."""
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import Odometry
        from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
        from std_msgs.msg import Float64MultiArray
        from std_srvs.srv import SetBool, Trigger

        rows = []
        for name, value, description, bounds in json.loads(path.read_text()):
            descriptor = ParameterDescriptor(description=description, dynamic_typing=True)
            if bounds and isinstance(value, float):
                descriptor.floating_point_range = [FloatingPointRange(
                    from_value=float(bounds[0]), to_value=float(bounds[1]))]
            elif bounds and isinstance(value, int):
                descriptor.integer_range = [IntegerRange(from_value=bounds[0],
                                                         to_value=bounds[1])]
            if not self.has_parameter(name):
                rows.append((name, value, descriptor))
        self.declare_parameters('', rows)
        for kind, topic in ((Imu, 'ground_truth/imu_bias'), (Imu, 'ground_truth/imu'),
                            (Odometry, 'ground_truth/odom'),
                            (Float64MultiArray, '~/invariants'),
                            (DiagnosticArray, '/diagnostics')):
            self.create_publisher(kind, topic, 10)
        self.create_subscription(Float64MultiArray, '~/commands', lambda _: None, 10)
        for name, service in (('set_pause', SetBool), ('step', Trigger), ('reset', Trigger),
                              ('record', SetBool)):
            self.create_service(service, f'~/{name}', lambda request, response: response)

    def _publish(self) -> None:
        for publish, data in self.sinks:
            publish(data)
        if self.once:
            rclpy.try_shutdown()

    def _run(self) -> None:
        deadline, period = time.monotonic(), 1.0 / self.rate
        while not self.stopped:
            deadline = max(deadline + period, time.monotonic())
            time.sleep(max(0.0, deadline - time.monotonic()))
            if not self.stopped and rclpy.ok():
                with contextlib.suppress(RuntimeError):     # the context has just gone down
                    self._publish()


def main() -> None:
    rclpy.init(args=sys.argv)
    node = Bare()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:       # rclpy found the context gone down in the midst of a wait
        if rclpy.ok():
            raise
    finally:
        node.stopped = True
        node.thread.join(1.0)
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
