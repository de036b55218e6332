#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
The top as an ordinary rclpy node, with which `node_cpu.py` compares `sim_node`.

A timer has the rate of the streams.  SciPy's RK45 steps up to the present time, and its dense
output gives the sample.  Every sample is a new message object.  The node has no parameters to
change, no services and no recording; a late tick loses a sample.  The equations are (29)-(32) in
Euler angles, at the default tolerance of `sim_node`.  The executor is that of `rclpy.spin`, or
rclpy's EventsExecutor, which takes a fraction of its processor time.

    python benchmark/straightforward_node.py --ros-args -p rate:=1000.0 -p executor:=events
"""

import math
import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from scipy.integrate import RK45
from sensor_msgs.msg import Imu, JointState

MASS, DISTANCE, LAMBDA1, LAMBDA3, GRAVITY = 2.0, 0.15, 0.123, 0.15, 9.80665
THETA, L3 = math.radians(30.0), 1.6
TORQUE = MASS * GRAVITY * DISTANCE
JOINTS = ['precession_joint', 'nutation_joint', 'spin_joint']


class StraightforwardTop(Node):
    """Publishes pose, joint_states and imu/data_raw at one rate."""

    def __init__(self):
        super().__init__('spinning_top')
        rate = self.declare_parameter('rate', 100.0).value
        self.executor_name = self.declare_parameter('executor', 'single').value
        if self.executor_name not in EXECUTORS:
            raise ValueError(f'executor = {self.executor_name!r}: one of {sorted(EXECUTORS)}')
        self.l3, self.lz = L3, L3 * math.cos(THETA)
        self.solver = RK45(self.derivative, 0.0, [THETA, 0.0, 0.0, 0.0], math.inf,
                           rtol=1e-11, atol=1e-11)
        self.solver.step()
        self.read = self.solver.dense_output()
        self.pose = self.create_publisher(PoseStamped, 'pose', 10)
        self.joints = self.create_publisher(JointState, 'joint_states', 10)
        self.imu = self.create_publisher(Imu, 'imu/data_raw', 10)
        self.begin = self.get_clock().now()
        self.create_timer(1.0 / rate, self.tick)

    def rates(self, theta):
        """Return phi' and psi', eqs. (31) and (32)."""
        sine, cosine = math.sin(theta), math.cos(theta)
        phi_dot = (self.lz - self.l3 * cosine) / (LAMBDA1 * sine * sine)
        return phi_dot, self.l3 / LAMBDA3 - phi_dot * cosine

    def derivative(self, t, y):
        theta, theta_dot = float(y[0]), float(y[1])
        sine, cosine = math.sin(theta), math.cos(theta)
        phi_dot, psi_dot = self.rates(theta)
        return [theta_dot, (phi_dot * phi_dot * sine * cosine
                            - self.l3 * phi_dot * sine / LAMBDA1 + TORQUE * sine / LAMBDA1),
                phi_dot, psi_dot]

    def tick(self):
        now = self.get_clock().now()
        t = (now - self.begin).nanoseconds * 1e-9
        if self.solver.t < t:
            while self.solver.t < t:
                self.solver.step()
            self.read = self.solver.dense_output()
        theta, theta_dot, phi, psi = self.read(t).tolist()
        phi_dot, psi_dot = self.rates(theta)
        stamp = now.to_msg()
        self.publish_pose(stamp, theta, phi, psi)
        self.publish_joints(stamp, [phi, theta, psi], [phi_dot, theta_dot, psi_dot])
        self.publish_imu(stamp, theta, psi, theta_dot, phi_dot, psi_dot)

    def publish_pose(self, stamp, theta, phi, psi):
        message = PoseStamped()
        message.header.stamp = stamp
        message.header.frame_id = 'world'
        orientation = message.pose.orientation
        sine, cosine = math.sin(0.5 * theta), math.cos(0.5 * theta)
        orientation.x = -sine * math.sin(0.5 * (phi - psi))
        orientation.y = sine * math.cos(0.5 * (phi - psi))
        orientation.z = cosine * math.sin(0.5 * (phi + psi))
        orientation.w = cosine * math.cos(0.5 * (phi + psi))
        self.pose.publish(message)

    def publish_joints(self, stamp, angles, rates):
        message = JointState()
        message.header.stamp = stamp
        message.name = JOINTS
        message.position = angles
        message.velocity = rates
        self.joints.publish(message)

    def publish_imu(self, stamp, theta, psi, theta_dot, phi_dot, psi_dot):
        message = Imu()
        message.header.stamp = stamp
        message.header.frame_id = 'imu_link'
        message.orientation_covariance[0] = -1.0
        st, ct, sp, cp = math.sin(theta), math.cos(theta), math.sin(psi), math.cos(psi)
        rates = message.angular_velocity
        rates.x = -phi_dot * st * cp + theta_dot * sp
        rates.y = phi_dot * st * sp + theta_dot * cp
        rates.z = psi_dot + phi_dot * ct
        force = message.linear_acceleration
        force.x, force.y, force.z = -GRAVITY * st * cp, GRAVITY * st * sp, GRAVITY * ct
        self.imu.publish(message)


def spin_events(node):
    executor = EventsExecutor()
    executor.add_node(node)
    while rclpy.ok():
        executor.spin_once(1.0)         # Jazzy's hangs without a timeout


EXECUTORS = {'single': rclpy.spin, 'events': spin_events}


def main():
    rclpy.init(args=sys.argv)
    node = StraightforwardTop()
    try:
        EXECUTORS[node.executor_name](node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
