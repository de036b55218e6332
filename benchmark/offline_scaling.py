#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure time and memory of `simulate` over duration and number of streams.

    python benchmark/offline_scaling.py             # up to one hour; takes a minute
    python benchmark/offline_scaling.py --long      # up to ten hours

Each run has its own process, measured from start to exit.  The streams have 100 Hz, the log has
zstd.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from mcap.reader import make_reader
from processes import load, simulate
from report import preamble, table, write_section

STREAMS = ('pose', 'joint_states', 'imu', 'ground_truth_imu', 'ground_truth_odom', 'invariants')
RATE = 100.0
THREE = STREAMS[:3]


def run(method: str, streams: tuple[str, ...], seconds: float, path: Path) -> list[str]:
    """Simulate in its own process; return messages, time, rate and memory as cells."""
    parameters = {'solver.method': method, 'max_error': 0.0,
                  **{f'{name}.enabled': str(name in streams).lower() for name in STREAMS},
                  **{f'{name}.rate': RATE for name in streams}}
    arguments = [item for name, value in parameters.items() for item in ('-p', f'{name}:={value}')]
    taken, peak = simulate(('-o', str(path), '--duration', str(seconds), *arguments))
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary and summary.statistics
    count = summary.statistics.message_count
    path.unlink()
    return [f'{count}', f'{taken:.2f}', f'{count / taken:,.0f}', f'{peak / 1e6:.0f}']


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--long', action='store_true', help='also ten hours')
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('`simulate` over duration and streams')
    heads = ('messages', 'time [s]', 'messages/s', 'peak memory [MB]')
    minutes = (1, 10, 60, 600) if arguments.long else (1, 10, 60)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'run.mcap'
        duration_rows = [[method, str(m), *run(method, THREE, 60.0 * m, path)]
                         for method in ('exact', 'rk45')
                         for m in (minutes if method == 'exact' else minutes[:2])]
        stream_rows = [[str(n), *run('exact', STREAMS[:n], 600.0, path)]
                       for n in range(1, len(STREAMS) + 1)]
    text = '\n'.join((f'Load average at the end {load():.1f}.\n',
                      f'Three streams ({", ".join(THREE)}):\n',
                      table(('solver', 'simulated [min]', *heads), duration_rows),
                      'Ten minutes with the exact solution, over the number of streams:\n',
                      table(('streams', *heads), stream_rows)))
    print(text)
    if not arguments.no_report:
        write_section('offline_scaling', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
