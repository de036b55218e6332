# SPDX-License-Identifier: Apache-2.0
"""The exam of a ROS node, in lockstep: it gets a sample when it has answered the one before."""

import contextlib
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, MagneticField

from spinning_top_sim.exam.examiner import examine
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Reals
from spinning_top_sim.exam.trial import INTERRUPTED, NodeError
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools.foreign_messages import NO_ORIENTATION

try:                            # takes least processor time
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:
    from rclpy.executors import SingleThreadedExecutor as Executor

IMU_TOPIC, FIELD_TOPIC = 'imu/data_raw', 'imu/mag'
PATIENCE_S = 20.0               # for a node to start, and for an answer
DISCOVERY_S = 3.0               # other publishers are found later than the node
FIRST_PATIENCE_S, UNANSWERED = 1.0, 5       # some nodes do not answer their first samples
START_NS = NANOSECONDS          # in ROS a stamp of 0 means "no time"
# A running node must never see time go back, not even from one exam to the next.  So the first
# stamp of an exam is the uptime of the machine multiplied by the greatest speed-up of an exam.
FASTEST, LAST_NS = 50, 2 * 10 ** 9 * NANOSECONDS
NAME, FRAME = 'examine', 'imu_link'


def examine_node(topic: str, command: str | None = None, level: str = 'quick',
                 imu: Mapping[str, Any] | str | Path | None = None,
                 seeds: int | Iterable[int] | None = None) -> Report:
    """
    Examine a ROS node.

    Parameters
    ----------
    topic : str
        Topic of its attitudes, sensor_msgs/Imu, each with the stamp of its sample.
    command : str, optional
        Command that starts the node for each run, without a shell; default: the node runs.
    level, imu, seeds : optional
        As for `examine`.

    Raises
    ------
    NodeError
        If the node is not found, or other nodes publish on its topics.
    """
    with NodeExam(topic, command) as node:
        return examine(node.start, level, imu, seeds, subject=command or topic,
                       isolated=False, restart=command is not None)


class NodeExam(contextlib.AbstractContextManager['NodeExam']):
    """A node under examination, which is also a `trial.Filter`; arguments as `examine_node`."""

    def __init__(self, topic: str, command: str | None = None) -> None:
        expand_topic_name(topic, NAME, '/')         # raises ValueError
        self._command = None if command is None else shlex.split(command)
        self._topic = topic
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node(NAME, context=self._context, parameter_overrides=[
            Parameter('use_sim_time', value=False)])
        self._executor = Executor(context=self._context)
        self._executor.add_node(self._node)
        profile = QoSProfile(depth=100)
        self._clock, self._imu, self._field = (
            self._node.create_publisher(kind, name, profile) for kind, name in (
                (Clock, '/clock'), (Imu, IMU_TOPIC), (MagneticField, FIELD_TOPIC)))
        self._subscription = self._node.create_subscription(Imu, topic, self._take, profile)
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: dict[int, Any] = {}          # by stamp [ns]
        self.covariance: Reals | None = None

    def __exit__(self, *exception: object) -> None:
        self._end_process()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def start(self) -> 'NodeExam':
        """Start the node anew, or find the running one; return it as a filter."""
        self._end_process()
        if self._command is not None:
            try:
                self._process = subprocess.Popen(self._command, start_new_session=True)
            except OSError as error:
                raise NodeError(f'cannot start {self._command[0]}: {error.strerror}') from error
        there = self._wait(self.is_there, PATIENCE_S)
        if there and self._process is None:
            self._wait(lambda: False, DISCOVERY_S)
        for name in ('/clock', IMU_TOPIC, FIELD_TOPIC, self._topic):
            if (count := self._node.count_publishers(name)) > 1:
                raise NodeError(f'{name} has {count} publishers: end the others, because the exam '
                                'needs the topic alone')
        if not there:
            text = (f'no node reads {IMU_TOPIC} and publishes {self._topic} within '
                    f'{PATIENCE_S:g} s: check that it runs, its ROS_DOMAIN_ID '
                    f'({os.environ.get("ROS_DOMAIN_ID", "0")} here), namespace and remappings')
            raise RuntimeError(text) if self._process is not None else NodeError(text)
        self._now_ns = (START_NS if self._process is not None else
                        FASTEST * time.monotonic_ns() % LAST_NS + START_NS)
        self._sent = self._answered = 0
        self._answers.clear()
        self.covariance = None
        return self

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Publish the readings, and wait for the attitude with their stamp."""
        self._now_ns += round(dt * NANOSECONDS)
        self._sent += 1
        clock, imu = Clock(), Imu()
        clock.clock.sec, clock.clock.nanosec = divmod(self._now_ns, NANOSECONDS)
        imu.header.stamp, imu.header.frame_id = clock.clock, FRAME
        imu.orientation_covariance[0] = NO_ORIENTATION
        field = MagneticField(header=imu.header)
        for vector, values in ((imu.angular_velocity, gyroscope),
                               (imu.linear_acceleration, accelerometer),
                               (field.magnetic_field, magnetometer)):
            if values is not None:
                vector.x, vector.y, vector.z = values.tolist()
        self._clock.publish(clock)
        if magnetometer is not None:
            self._field.publish(field)
        self._imu.publish(imu)
        patience = PATIENCE_S if self._answered else FIRST_PATIENCE_S
        if not self._wait(lambda: self._now_ns in self._answers, patience):
            if self._command is None and not self.is_there():
                raise NodeError(f'the node that reads {IMU_TOPIC} and publishes {self._topic} '
                                'has gone')
            if self._answered or self._sent > UNANSWERED:
                raise RuntimeError(f'no attitude has the stamp {self._now_ns * 1e-9:.9f} s of its '
                                   f'sample within {patience:g} s')
            return np.array((0.0, 0.0, 0.0, 1.0))
        self._answered += 1
        message = self._answers.pop(self._now_ns)
        self._answers.clear()
        matrix = np.array(message.orientation_covariance).reshape(3, 3)
        self.covariance = None if matrix[0, 0] == NO_ORIENTATION else matrix
        q = message.orientation
        return np.array((q.x, q.y, q.z, q.w))

    def is_there(self) -> bool:
        """Return whether a node reads the samples, and one publishes the attitudes."""
        return bool(self._imu.get_subscription_count()
                    and self._node.count_publishers(self._topic))

    def _wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Spin until a condition holds; return False on timeout.  Raise if the node has ended."""
        end = time.monotonic() + seconds
        while not condition():
            if INTERRUPTED.is_set():
                INTERRUPTED.clear()
                raise KeyboardInterrupt
            if time.monotonic() > end:
                return False
            if self._process is not None and self._process.poll() is not None:
                raise RuntimeError(f'the node has ended with {self._process.returncode}')
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _take(self, message: Any) -> None:
        stamp = message.header.stamp
        self._answers[stamp.sec * NANOSECONDS + stamp.nanosec] = message

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for number in (signal.SIGINT, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5.0)
                break
        # Wait until its endpoints leave the graph, so that they are not taken for the next node's.
        self._wait(lambda: not self._imu.get_subscription_count()
                   and not self._node.count_publishers(self._topic), PATIENCE_S)
