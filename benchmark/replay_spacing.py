#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the spacing of messages of `replay_node` in a subscribing process.

    python benchmark/replay_spacing.py              # three rates; takes half a minute

The log has three topics (50, 100 and 200 Hz) without simultaneous messages.  The spacing error is
the difference between the time between two arrivals on a topic and the recorded time over the
rate.  The drift is the same for the first and the last arrival.  Both contain the delay of the
subscriber.  The line above the table has the delay of a thread that only sleeps, for comparison
on a busy machine.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import McapRecorder
from spinning_top_sim.streams import messages

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('ROS_DOMAIN_ID', '45')

RATES_HZ = (50, 100, 200)
SHIFTS_NS = (3_000_000, 1_500_000, 0)
EPOCH_NS = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
ARRAY = 'std_msgs/msg/Float64MultiArray'


def record(path: Path, seconds: float) -> dict[str, list[int]]:
    """Write the log; return the times on each topic [ns]."""
    topics = [RecordedTopic(f'/replay_spacing/at_{rate}_hz', ARRAY) for rate in RATES_HZ]
    times = {topic.name: [EPOCH_NS + shift + n * SECOND // rate
                          for n in range(int(seconds * rate))]
             for topic, rate, shift in zip(topics, RATES_HZ, SHIFTS_NS, strict=True)}
    data = messages.float64_multi_array(('a', 'b')).encode_one(0, np.array([1.0, 2.0]))
    with contextlib.closing(McapRecorder(path, topics, {}, min_free_bytes=0)) as recorder:
        for at_ns, index in sorted((at_ns, index) for index, stamps in enumerate(times.values())
                                   for at_ns in stamps):
            recorder.write(index, at_ns, data)
    return times


def arrivals(path: Path, rate: float, times: dict[str, list[int]], patience: float
             ) -> dict[str, list[int]]:
    """Replay the log; return when its messages arrived, by topic [ns of the steady clock]."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from std_msgs.msg import Float64MultiArray

    rclpy.init()
    node = rclpy.create_node('replay_spacing')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    found: dict[str, list[int]] = {name: [] for name in times}
    for name, arrived in found.items():
        node.create_subscription(
            Float64MultiArray, name,
            lambda _, arrived=arrived: arrived.append(time.monotonic_ns()),
            QoSProfile(depth=10_000), raw=True)
    player = subprocess.Popen(
        [sys.executable, '-m', 'spinning_top_sim.nodes.replay_node', str(path), '--rate',
         str(rate), '--wait-for-subscribers', str(len(times)), '--delay', '3'],
        stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        end = time.monotonic() + patience
        while player.poll() is None and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
        while sum(map(len, found.values())) < sum(map(len, times.values())) and (
                time.monotonic() < end):
            executor.spin_once(timeout_sec=0.1)
    finally:
        player.kill()
        player.wait()
        node.destroy_node()
        rclpy.try_shutdown()
    return found


def machine() -> str:
    """Return the delays of a thread that sleeps at 200 Hz."""
    late = []
    begin = time.monotonic()
    for deadline in (begin + n / 200.0 for n in range(1, 401)):
        time.sleep(max(0.0, deadline - time.monotonic()))
        late.append(1e3 * (time.monotonic() - deadline))
    late.sort()
    return (f'a sleeper wakes up late by {statistics.median(late):.3f} ms (p50), '
            f'{late[int(0.99 * len(late))]:.3f} ms (p99), {late[-1]:.3f} ms (max)')


def row(rate: float, times: dict[str, list[int]], found: dict[str, list[int]]) -> str:
    """Return the line of the table."""
    missing = sum(map(len, times.values())) - sum(map(len, found.values()))
    if missing:
        return f'| {rate:g} | {missing} messages have not arrived |'
    errors, drifts = [], []
    for name, recorded in times.items():
        arrived = found[name]
        errors += [abs((b - a) - (d - c) / rate) / 1e6 for a, b, c, d in zip(
            arrived, arrived[1:], recorded, recorded[1:], strict=False)]
        drifts.append(((arrived[-1] - arrived[0]) - (recorded[-1] - recorded[0]) / rate) / 1e6)
    errors.sort()
    cells = (f'{rate:g}', str(sum(map(len, times.values()))), f'{statistics.median(errors):.3f}',
             f'{errors[int(0.99 * len(errors))]:.3f}', f'{errors[-1]:.3f}',
             f'{max(drifts, key=abs):+.3f}')
    return '| ' + ' | '.join(cells) + ' |'


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=5.0, help='that each rate plays')
    arguments = parser.parse_args()
    print(f'{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load '
          f'{os.getloadavg()[0]:.1f}; {platform.system()}, Python {platform.python_version()}, '
          f'rclpy {version("rclpy")}, mcap {version("mcap")};\n{machine()}\n')
    print('| rate | messages | spacing error p50 [ms] | p99 [ms] | max [ms] | drift [ms] |')
    print('|---|---|---|---|---|---|')
    with tempfile.TemporaryDirectory() as folder:
        for rate in (1.0, 10.0, 0.1):
            path = Path(folder) / f'{rate:g}.mcap'
            times = record(path, arguments.seconds * rate)
            found = arrivals(path, rate, times, arguments.seconds + 60.0)
            print(row(rate, times, found), flush=True)


if __name__ == '__main__':
    main()
