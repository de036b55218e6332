#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the throughput of `simulate`, compared with MCAP writers.

    python benchmark/offline.py             # ratios, a few seconds a round
    python benchmark/offline.py --hour      # also one hour at 1 kHz: 14.4 million messages

`simulate` computes three streams at 1 kHz (pose, joint_states, imu/data_raw) with the exact
solution and writes them with zstd.  The other writers, `Writer.add_message` of mcap and the
writer of rosbags, only write the same messages as ready-made bytes.  All take turns in one
process.  The tables have medians, and medians of ratios within a round.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import processes
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from report import preamble, table, write_section
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.tools.simulate import main as simulate

STREAMS = ('pose', 'joint_states', 'imu')
PARAMETERS = [argument for name, value in (
    ('solver.method', 'exact'), ('record.streams', '[pose, joint_states, imu]'),
    ('ground_truth_imu.enabled', 'false'), ('ground_truth_odom.enabled', 'false'),
    ('invariants.enabled', 'false'), *((f'{stream}.rate', '1000.0') for stream in STREAMS),
) for argument in ('-p', f'{name}:={value}')]
# The stream imu also has the topic ground_truth/imu_bias.
TOPICS = ('/pose', '/joint_states', '/imu/data_raw')


def run_ours(path: Path, seconds: float) -> None:
    """Simulate into `path`."""
    if simulate(['-o', str(path), '--duration', str(seconds), '--quiet', *PARAMETERS]):
        raise SystemExit('simulate failed')


def ready_made(path: Path) -> list[tuple[str, str, int, bytes]]:
    """Return topic, type, stamp and bytes of every message of a log."""
    with open(path, 'rb') as file:
        return [(channel.topic, schema.name, message.log_time, message.data)
                for schema, channel, message in make_reader(file).iter_messages()
                if channel.topic.startswith(TOPICS) or 'bias' in channel.topic]


def write_with_mcap(path: Path, messages: list[tuple[str, str, int, bytes]]) -> None:
    """Write them in a loop of `Writer.add_message`."""
    with open(path, 'wb') as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile='ros2', library='benchmark')
        channels = {}
        for topic, type_name, _, _ in messages[:100]:
            if topic not in channels:
                schema = writer.register_schema(type_name, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
        for topic, _, stamp, data in messages:
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def write_with_rosbags(path: Path, messages: list[tuple[str, str, int, bytes]]) -> None:
    """Write them with rosbags' MCAP writer."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, type_name, stamp, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(connections[topic], stamp, data)


def timed(function, *arguments) -> float:
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def rounds(folder: Path, seconds: float, count: int) -> str:
    """Let all take turns; return messages per second and ratios."""
    first = folder / 'first.mcap'
    run_ours(first, seconds)
    messages = ready_made(first)
    times: dict[str, list[float]] = {'simulate': [], 'mcap add_message': [], 'rosbags': []}
    for turn in range(count):
        times['simulate'].append(timed(run_ours, folder / f'ours{turn}.mcap', seconds))
        times['mcap add_message'].append(
            timed(write_with_mcap, folder / f'mcap{turn}.mcap', messages))
        times['rosbags'].append(timed(write_with_rosbags, folder / f'bag{turn}', messages))
    rows = []
    for name, taken in times.items():
        ratios = [other / ours for other, ours in zip(taken, times['simulate'], strict=True)]
        rows.append((name, f'{len(messages) / statistics.median(taken):,.0f}',
                     f'{statistics.median(ratios):.2f}'))
    return (f'{len(messages)} messages a run, {count} rounds.\n\n'
            + table(('', 'messages/s', 'time relative to simulate'), rows))


def in_a_process(folder: Path, seconds: float) -> tuple[str, ...]:
    """Run it in its own process; return the row of the table, with start and exit."""
    path = folder / 'long.mcap'
    taken, peak = processes.simulate(
        ('-o', str(path), '--duration', str(seconds), *PARAMETERS))
    with path.open('rb') as file:
        count = make_reader(file).get_summary().statistics.message_count
    size = path.stat().st_size
    path.unlink()
    return (f'{seconds / 60.0:g}', f'{count}', f'{taken:.1f}', f'{count / taken:,.0f}',
            f'{size / 1e6:.0f}', f'{peak / 1e6:.0f}')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=60.0, help='simulated, a round')
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--hour', action='store_true', help='also one hour, with its memory')
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('`simulate` compared with MCAP writers',
                    ('numpy', 'mcap', 'zstandard', 'rosbags'))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = rounds(folder, arguments.seconds, arguments.rounds)
        if arguments.hour:
            text += '\n' + table(
                ('simulated [min]', 'messages', 'time from start to exit [s]', 'messages/s',
                 'file [MB]', 'peak memory [MB]'),
                [in_a_process(folder, seconds) for seconds in (60.0, 600.0, 3600.0)])
    print(text)
    if not arguments.no_report:
        write_section('offline', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
