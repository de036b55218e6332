#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the throughput of `simulate`, compared with MCAP writers.

    python benchmark/offline.py --no-report --minutes 1 10

`simulate` computes pose, joint_states and imu at 1 kHz with the exact solution and writes them
with zstd.  The other writers, `Writer.add_message` of mcap and the writer of rosbags, only write
the same messages as ready-made bytes.  All take turns in one process.  The first table has
medians, and medians of ratios within a round.  Each run of the second table has a process of its
own, measured from start to exit.
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

STREAMS = 'pose', 'joint_states', 'imu'
ROUND_S, ROUNDS = 60, 5         # simulated time of a round
Messages = list[tuple[str, str, int, bytes]]


def arguments(path: Path, seconds: float, method: str = 'exact') -> list[str]:
    """Return the arguments of `simulate`."""
    return ['-o', str(path), '--duration', str(seconds), '--quiet',
            '-p', f'solver.method:={method}', '-p', f'record.streams:=[{", ".join(STREAMS)}]',
            *(word for name in STREAMS for word in ('-p', f'{name}.rate:=1000.0'))]


def ready_made(path: Path) -> Messages:
    """Return topic, type, stamp and bytes of every message of a log, but for its journal."""
    with path.open('rb') as file:
        return [(channel.topic, schema.name, message.log_time, message.data)
                for schema, channel, message in make_reader(file).iter_messages()
                if not channel.topic.startswith('/spinning_top/')]


def write_with_mcap(path: Path, messages: Messages) -> None:
    with path.open('wb') as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile='ros2', library='benchmark')
        channels: dict[str, int] = {}
        for topic, type_name, stamp, data in messages:
            if topic not in channels:
                schema = writer.register_schema(type_name, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def write_with_rosbags(path: Path, messages: Messages) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, type_name, stamp, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            writer.write(connections[topic], stamp, data)


def compared_with_writers(folder: Path) -> str:
    """Let all take turns; return messages per second and ratios."""
    first = folder / 'first.mcap'
    simulate(arguments(first, ROUND_S))
    messages = ready_made(first)
    writers = {'simulate': lambda path: simulate(arguments(path, ROUND_S)),
               'mcap add_message': lambda path: write_with_mcap(path, messages),
               'rosbags': lambda path: write_with_rosbags(path, messages)}
    times: dict[str, list[float]] = {name: [] for name in writers}
    for turn in range(ROUNDS):
        for name, write in writers.items():
            begin = time.perf_counter()
            write(folder / f'{name}{turn}.mcap')
            times[name].append(time.perf_counter() - begin)
    rows = []
    for name, taken in times.items():
        ratios = [other / ours for other, ours in zip(taken, times['simulate'], strict=True)]
        rows.append((name, f'{len(messages) / statistics.median(taken):,.0f}',
                     f'{statistics.median(ratios):.2f}'))
    return (f'{len(messages)} messages a run, {ROUNDS} rounds.\n\n'
            + table(('', 'messages/s', 'time relative to simulate'), rows))


def in_a_process(folder: Path, method: str, minutes: float) -> tuple[str, ...]:
    """Run it in its own process; return the row of the table."""
    path = folder / 'long.mcap'
    taken, peak = processes.simulate(arguments(path, 60.0 * minutes, method))
    with path.open('rb') as file:
        count = make_reader(file).get_summary().statistics.message_count
    size = path.stat().st_size
    path.unlink()
    return (method, f'{minutes:g}', f'{count}', f'{taken:.1f}', f'{count / taken:,.0f}',
            f'{size / 1e6:.0f}', f'{peak / 1e6:.0f}')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, nargs='+', default=[1, 10, 60])
    parser.add_argument('--no-report', action='store_true', help='print only')
    options = parser.parse_args()
    head = preamble('`simulate`', ('numpy', 'mcap', 'zstandard', 'rosbags'))
    with tempfile.TemporaryDirectory() as name:
        text = compared_with_writers(Path(name)) + '\n' + table(
            ('solver', 'simulated [min]', 'messages', 'time [s]', 'messages/s', 'file [MB]',
             'peak memory [MB]'),
            [in_a_process(Path(name), method, minutes) for method in ('exact', 'rk45')
             for minutes in options.minutes if method == 'exact' or minutes <= 10])
    print(text)
    if not options.no_report:
        write_section('offline', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
