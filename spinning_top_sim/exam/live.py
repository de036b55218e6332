# SPDX-License-Identifier: Apache-2.0
"""
The exam of a ROS node: it gets one sample at a time, and the next one when it has answered.

So the verdict does not depend on the load of the machine.  A node that the exam starts is started
for every run.  One that runs already gets all runs one after the other.
"""

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
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, MagneticField

from spinning_top_sim.exam.examiner import examine
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.trial import NodeError
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools.attitudes import NO_ORIENTATION

try:                            # takes least processor time
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:
    from rclpy.executors import SingleThreadedExecutor as Executor

IMU_TOPIC, FIELD_TOPIC = 'imu/data_raw', 'imu/mag'
PATIENCE_S = 20.0               # for a node to start, and for an answer
FIRST_PATIENCE_S, UNANSWERED = 1.0, 5       # some nodes do not answer their first samples
START_NS = NANOSECONDS          # in ROS a stamp of 0 is "no time"
# A node that runs must never see time go back, not even from one exam to the next.  So the stamp
# of an exam's first sample is the machine's time multiplied by FASTEST: no exam is fed faster than
# that.  The stamps begin anew after 460 days, before their seconds overflow.
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
        Of its attitudes, sensor_msgs/Imu, each with the stamp of its sample.
    command : str, optional
        Starts the node for each run, without a shell; without it the node runs already.
    level : {'quick', 'full'}, optional
        As of `examine`.
    imu : mapping, str or Path, optional
        As of `examine`.
    seeds : int or iterable of int, optional
        As of `examine`.

    Returns
    -------
    Report
        Faults with their evidence, and measures.

    Raises
    ------
    ValueError
        For a topic or command that is none, and as `examine` does.
    NodeError
        If the node is not there, or others publish on its topics.
    """
    with NodeExam(topic, command) as node:
        return examine(node.make_filter, level, imu, seeds, subject=command or topic,
                       isolated=False, restart=command is not None)


class NodeExam(contextlib.AbstractContextManager['NodeExam']):
    """
    Feeds a node: `make_filter` returns it in the form that the exam takes.

    topic : sensor_msgs/Imu with the attitudes that it publishes, each with the stamp of its sample
    command : of the node, which reads `imu/data_raw` and `imu/mag`; None: it runs already

    Raises ValueError for a topic that ROS does not allow, and for a command without words.
    """

    def __init__(self, topic: str, command: str | None = None) -> None:
        try:
            expand_topic_name(topic, NAME, '/')
        except ValueError:          # its text has the place in rcl's source
            raise ValueError(f'{topic!r} is no name of a topic: must be such as imu/data, with '
                             'letters, digits, _ and /') from None
        self._command = None if command is None else _words(command)
        self._topic = topic
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node(NAME, context=self._context, parameter_overrides=[
            Parameter('use_sim_time', value=False)])
        self._executor = Executor(context=self._context)
        self._executor.add_node(self._node)
        profile = QoSProfile(depth=100)
        self.clock, self.imu, self.field = (
            self._node.create_publisher(kind, name, profile) for kind, name in (
                (Clock, '/clock'), (Imu, IMU_TOPIC), (MagneticField, FIELD_TOPIC)))
        self.said: dict[int, Any] = {}
        self._subscription = self._node.create_subscription(Imu, topic, self._take, profile)
        self._process: subprocess.Popen[bytes] | None = None

    def __exit__(self, *exception: object) -> None:
        self._end_process()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def make_filter(self) -> 'NodeFilter':
        """
        Start the node anew, or find the one that runs.

        Raises RuntimeError if it does not start, and NodeError if none runs, or if others publish
        on its topics.
        """
        self.said.clear()
        self._end_process()
        if self._command is not None:
            self._process = subprocess.Popen(self._command, start_new_session=True)
        there = self.wait(self._is_there, PATIENCE_S)
        self._find_others()
        if there:
            return NodeFilter(self, START_NS if self._process is not None else
                              FASTEST * time.monotonic_ns() % LAST_NS + START_NS)
        missing = ' and none '.join(
            [f'reads {IMU_TOPIC}'] * (not self.imu.get_subscription_count())
            + [f'publishes {self._topic}'] * (not self._node.count_publishers(self._topic)))
        text = (f'no node {missing} within {PATIENCE_S:g} s, with ROS_DOMAIN_ID='
                f'{os.environ.get("ROS_DOMAIN_ID", "0")}: check that it runs, its '
                'ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE, its namespace and remappings')
        raise RuntimeError(text) if self._process is not None else NodeError(text)

    def check(self) -> None:
        """Raise NodeError if a node that was not started here is there no more."""
        if self._command is None and not self._is_there():
            raise NodeError(f'the node that reads {IMU_TOPIC} and publishes {self._topic} has '
                                'gone')

    def _is_there(self) -> bool:
        return bool(self.imu.get_subscription_count() and self._node.count_publishers(self._topic))

    def _find_others(self) -> None:
        """Raise NodeError if other nodes publish what the exam does, or several the attitudes."""
        for name in ('/clock', IMU_TOPIC, FIELD_TOPIC, self._topic):
            nodes = [one.node_name for one in self._node.get_publishers_info_by_topic(name)]
            if len(nodes) > 1:
                raise NodeError(f'{name} is published by {" and ".join(sorted(nodes))}: end the '
                                'others, because the exam needs the topic alone')

    def wait(self, condition: Callable[[], object], seconds: float) -> bool:
        """Spin until a condition holds; return False after so long.  A node that ends raises."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            if self._process is not None and self._process.poll() is not None:
                raise RuntimeError(f'the node has ended with {self._process.returncode}')
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _take(self, message: Any) -> None:
        stamp = message.header.stamp
        self.said[stamp.sec * NANOSECONDS + stamp.nanosec] = message

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
        # Its endpoints leave the graph, so that the next node is not taken for this one.
        self.wait(lambda: not self.imu.get_subscription_count()
                  and not self._node.count_publishers(self._topic), PATIENCE_S)


class NodeFilter:
    """A running node as a filter, see `trial.Filter`."""

    slowest = float('inf')      # it waits itself

    def __init__(self, exam: NodeExam, start_ns: int) -> None:
        self._exam = exam
        self._now_ns = start_ns
        self._answered = self._sent = 0
        self.covariance: NDArray[np.float64] | None = None

    def update(self, gyroscope: NDArray[np.float64], accelerometer: NDArray[np.float64],
               magnetometer: NDArray[np.float64] | None, dt: float) -> NDArray[np.float64]:
        """Publish the readings, and wait for the attitude with their stamp."""
        exam, said = self._exam, self._exam.said
        self._now_ns += round(dt * NANOSECONDS)
        self._sent += 1
        clock, imu = Clock(), Imu()
        clock.clock.sec, clock.clock.nanosec = divmod(self._now_ns, NANOSECONDS)
        imu.header.stamp, imu.header.frame_id = clock.clock, FRAME
        imu.orientation_covariance[0] = NO_ORIENTATION
        for vector, values in ((imu.angular_velocity, gyroscope),
                               (imu.linear_acceleration, accelerometer)):
            vector.x, vector.y, vector.z = values.tolist()
        exam.clock.publish(clock)
        if magnetometer is not None:
            field = MagneticField(header=imu.header)
            (field.magnetic_field.x, field.magnetic_field.y,
             field.magnetic_field.z) = magnetometer.tolist()
            exam.field.publish(field)
        exam.imu.publish(imu)
        patience = PATIENCE_S if self._answered else FIRST_PATIENCE_S
        if not exam.wait(lambda: self._now_ns in said, patience):
            if self._answered or self._sent > UNANSWERED:
                exam.check()
                raise RuntimeError(
                    f'no attitude has the stamp {self._now_ns * 1e-9:.9f} s of its sample within '
                    f'{patience:g} s' + (f'; others came, such as {min(said) * 1e-9:.9f} s'
                                         if said else ''))
            return np.array((0.0, 0.0, 0.0, 1.0))
        self._answered += 1
        message = said.pop(self._now_ns)
        said.clear()
        matrix = np.array(message.orientation_covariance).reshape(3, 3)
        self.covariance = None if matrix[0, 0] == NO_ORIENTATION else matrix
        q = message.orientation
        return np.array((q.x, q.y, q.z, q.w))


def _words(command: str) -> list[str]:
    """Return the words of a command line.  Raises ValueError for none, or an open quotation."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ValueError(f'{command!r} is no command: {error}') from None
    if not words:
        raise ValueError(f'{command!r} is no command: must be such as python my_node.py')
    return words
