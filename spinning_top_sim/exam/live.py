# SPDX-License-Identifier: Apache-2.0
"""The exam of a ROS node, in lockstep: it gets a sample when it has answered the one before."""

import contextlib
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, MagneticField

from spinning_top_sim.exam.examiner import examine
from spinning_top_sim.exam.feeding import ANSWER_S, READ_EVERY, NodeError, feed
from spinning_top_sim.exam.motions import Reals
from spinning_top_sim.times import NANOSECONDS, stamp_text
from spinning_top_sim.tools.foreign_messages import NO_ORIENTATION
from spinning_top_sim.tools.report import Report

IMU_TOPIC, FIELD_TOPIC = 'imu/data_raw', 'imu/mag'
PATIENCE_S = 20.0               # for a node to start, and to answer first
AGAIN_S = 0.3                   # for a node to find topics; then the first sample is sent again
START_NS = NANOSECONDS          # in ROS a stamp of 0 means "no time"
NAME, FRAME, IMU = 'examine', 'imu_link', 'sensor_msgs/msg/Imu'


def examine_node(command: str, topic: str, **options: Any) -> Report:
    """
    Examine a ROS node that `command` starts for each run, without a shell.

    Parameters
    ----------
    command : str
        Starts the node.
    topic : str
        That of its attitudes, sensor_msgs/Imu, each with the stamp of its sample.
    **options
        Of `examine`.

    Raises
    ------
    NodeError
        If other nodes publish on its topics, or messages are lost.
    """
    with NodeExam(command, topic) as node:
        return examine(node.start, subject=command, feed=feed, **options)


class NodeExam(contextlib.AbstractContextManager['NodeExam']):
    """A node under examination, which is also a `feeding.Filter`; arguments as `examine_node`."""

    def __init__(self, command: str, topic: str) -> None:
        expand_topic_name(topic, NAME, '/')         # raises ValueError
        self._command, self._topic = shlex.split(command), topic
        self._lost = f'a message is lost; make {IMU_TOPIC} and {topic} reliable there'
        # Raised within a call of rclpy, KeyboardInterrupt would leave it as another error.
        self._interrupts: list[int] = []
        self._handlers: dict[int, Any] = {}
        with contextlib.suppress(ValueError):       # not in the main thread
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(
                    number, lambda number, _: self._interrupts.append(number))
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(NAME, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        # A reliable publisher that keeps messages serves readers of every kind.
        profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._clock, self._imu, self._field = (
            self._node.create_publisher(kind, name, profile)
            for kind, name in ((Clock, '/clock'), (Imu, IMU_TOPIC), (MagneticField, FIELD_TOPIC)))
        self._subscription: Any = None
        self._process: Any = None
        self._answers: dict[int, Any] = {}          # by stamp [ns]
        self._first = self._used = 0                # samples of a new node until it answers
        self.covariance: Reals | None = None

    def __exit__(self, *exception: object) -> None:
        self._end_process()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._interrupts:
            raise KeyboardInterrupt

    def start(self) -> 'NodeExam':
        """Start the node anew; return it as a filter."""
        if self._process:
            self._end_process()
            # Its endpoints leave the graph, so that they are not taken for the next node's.
            self._wait(lambda: not (self._imu.get_subscription_count()
                                    or self._node.count_publishers(self._topic)), PATIENCE_S)
        try:
            self._process = subprocess.Popen(self._command, start_new_session=True)
        except OSError as error:
            raise NodeError(f'cannot start {self._command[0]}: {error.strerror}') from error
        if not self._wait(lambda: self._imu.get_subscription_count()
                          and self._node.count_publishers(self._topic), PATIENCE_S):
            raise RuntimeError(
                f'no node reads {IMU_TOPIC} and publishes {self._topic} within {PATIENCE_S:g} s: '
                f'check its ROS_DOMAIN_ID ({os.environ.get("ROS_DOMAIN_ID", "0")} here), '
                'namespace and remappings')
        # The attitudes are read with the reliability that they are offered with.
        self._subscription = self._subscription or self._node.create_subscription(
            Imu, self._topic, self._take,
            QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_AVAILABLE))
        self._wait(lambda: False, AGAIN_S)
        self._check_alone()
        for publisher in self._node.get_publishers_info_by_topic(self._topic):
            if publisher.topic_type != IMU:
                raise NodeError(f'{self._topic} is {publisher.topic_type}: must be {IMU}')
        self._now_ns, self._answered, self.covariance = START_NS, 0, None
        self._answers.clear()
        return self

    def _check_alone(self) -> None:
        """Raise NodeError if another node publishes on a topic of the exam."""
        for name in ('/clock', IMU_TOPIC, FIELD_TOPIC, self._topic):
            if (count := self._node.count_publishers(name)) > 1:
                raise NodeError(f'{name} has {count} publishers: end the others')

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Publish the readings, and wait for the attitude with their stamp."""
        publish = partial(self._publish, (gyroscope, accelerometer, magnetometer), dt)
        if not self._answered:
            self._begin(publish)
        elif not publish(ANSWER_S):
            self._check_alone()
            raise NodeError(f'no attitude has the stamp {stamp_text(self._now_ns)} s of its '
                            f'sample within {ANSWER_S:g} s: the node hangs, or {self._lost}')
        message = self._answers.pop(self._now_ns)
        self._answers.clear()
        self._answered += 1
        if self._answered % READ_EVERY == 0:
            self._check_alone()
        matrix = np.array(message.orientation_covariance).reshape(3, 3)
        self.covariance = None if matrix[0, 0] == NO_ORIENTATION else matrix
        q = message.orientation
        return np.array((q.x, q.y, q.z, q.w))

    def _begin(self, publish: Callable[[float], bool]) -> None:
        """Publish the first readings until there is an answer: a node may need two for a step."""
        # An answer may be lost or late: a start that does not use as many as the first goes again.
        for _ in range(5):
            sent, answer = 0, False
            while sent < self._used or not answer:
                if sent * AGAIN_S > PATIENCE_S:
                    raise RuntimeError(f'none of {sent} samples has an answer with its stamp')
                sent += 1
                answer = publish(ANSWER_S if answer or sent == (self._first or 1) else AGAIN_S)
            step_ns = (self._now_ns - START_NS) // sent
            first = min(ns - START_NS for ns in self._answers if ns > START_NS) // step_ns
            self._first, self._used = self._first or first, self._used or sent
            if first < self._first or (first, sent) == (self._first, self._used):
                break
            self.start()
        if first != self._first:
            raise NodeError(f'starts answer sample {self._first} or {first} first: {self._lost}')

    def _publish(self, readings: Sequence[Reals | None], dt: float, seconds: float) -> bool:
        """Publish the readings of the next step; return whether there is an answer in time."""
        self._now_ns += round(dt * NANOSECONDS)
        clock, imu = Clock(), Imu()
        clock.clock.sec, clock.clock.nanosec = divmod(self._now_ns, NANOSECONDS)
        imu.header.stamp, imu.header.frame_id = clock.clock, FRAME
        imu.orientation_covariance[0] = NO_ORIENTATION
        field = MagneticField(header=imu.header)
        vectors = imu.angular_velocity, imu.linear_acceleration, field.magnetic_field
        for vector, values in zip(vectors, readings, strict=True):
            if values is not None:
                vector.x, vector.y, vector.z = values.tolist()
        self._clock.publish(clock)
        if readings[-1] is not None:
            self._field.publish(field)
        self._imu.publish(imu)
        return self._wait(lambda: self._now_ns in self._answers, seconds)

    def _wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Spin until a condition holds; return False on timeout.  Raise if the node has ended."""
        end = time.monotonic() + seconds
        while not condition():
            if self._interrupts:
                raise KeyboardInterrupt
            if time.monotonic() > end:
                return False
            if self._process and self._process.poll() is not None:
                raise RuntimeError(f'the node has ended with {self._process.returncode}')
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _take(self, message: Any) -> None:
        stamp = message.header.stamp
        self._answers[stamp.sec * NANOSECONDS + stamp.nanosec] = message

    def _end_process(self) -> None:
        process, self._process = self._process, None
        for number in (signal.SIGINT, signal.SIGKILL) if process else ():
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(process.pid, number)
                process.wait(ANSWER_S)
                break
