#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A ROS node with an attitude filter, for the exam of nodes:

  spinning-top examine --node "python examples/attitude_node.py" --topic imu/data
"""

import contextlib

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu

from spinning_top_sim.exam.adapters import Vqf


class AttitudeNode(Node):
    """Reads `imu/data_raw`, and publishes `imu/data` with the attitude by VQF."""

    def __init__(self) -> None:
        super().__init__('attitude')
        self.filter, self._last_ns = Vqf(magnetic=False), -10 ** 10
        profile = QoSProfile(depth=100)
        self._publisher = self.create_publisher(Imu, 'imu/data', profile)
        self.create_subscription(Imu, 'imu/data_raw', self._take, profile)

    def _take(self, message: Imu) -> None:
        stamp, rate, force = (message.header.stamp, message.angular_velocity,
                              message.linear_acceleration)
        now_ns = stamp.sec * 10 ** 9 + stamp.nanosec
        dt, self._last_ns = (now_ns - self._last_ns) * 1e-9, now_ns
        if dt > 1.0:                # the first: its step is unknown
            return
        q = message.orientation
        q.x, q.y, q.z, q.w = self.filter.update(
            np.array((rate.x, rate.y, rate.z)), np.array((force.x, force.y, force.z)), None,
            dt).tolist()
        message.orientation_covariance[0] = 0.0
        self._publisher.publish(message)


if __name__ == '__main__':
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(AttitudeNode())
