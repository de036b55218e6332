#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the time from the start of a process to its first message.

    python benchmark/startup.py                 # two minutes

`sim_node` runs with its defaults and with recording.  It is compared with `bare_node.py` with the
same publishers, subscription, services and parameters (including descriptions and ranges), and
with that node without parameters and services.  All take turns.  The table has medians, and
medians of ratios within a round.  The time to the first message in another process contains DDS
discovery, which takes from 0.1 s to 3 s for every node.  Therefore the table also has the time
from start to exit, and the processor time, of a run without subscriber that ends at the first
sample.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from processes import Process, children_cpu, load, median, ros_arguments, script, sim_node
from report import preamble, table, write_section

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import ANY

OURS, RECORDING, LIKE, BARE = 'sim_node', 'sim_node, recording', 'bare, same interface', 'bare'
KINDS = (OURS, RECORDING, LIKE, BARE)


def parameter_file(path: Path) -> None:
    """Write name, value, description and range of the parameters for the bare node."""
    rows = []
    for parameter in parameters.TABLE:
        value = parameter.default
        reach = parameter.range
        bounds = None if reach is ANY else [0.0 if reach.has_zero else reach.lowest,
                                            reach.highest]
        rows.append([parameter.name, 1.0 if value is None else value, parameter.describe(),
                     bounds])
    path.write_text(json.dumps(rows))


def program(kind: str, namespace: str, folder: Path, once: bool) -> list[str]:
    """Return the arguments of python for this kind of node, for ever or to its first sample."""
    if kind in (OURS, RECORDING):
        return sim_node(namespace, {
            'record.enabled': kind == RECORDING, 'duration': 0.001 if once else 0.0,
            'record.uri': f'{folder}{namespace}{"_once" if once else ""}.mcap'})
    like = {'like': str(folder / 'parameters.json')} if kind == LIKE else {}
    return [*script('bare_node.py'),
            *ros_arguments(namespace, {'rate': 100.0, 'once': once, **like})]


def one_sample(kind: str, namespace: str, folder: Path) -> tuple[float, float]:
    """Return wall and processor time [s] of a run that ends itself at its first sample."""
    before, begin = children_cpu(), time.monotonic()
    with Process(program(kind, namespace, folder, once=True)) as node:
        code = node.wait(30.0)
        wall = time.monotonic() - begin
    if code:
        raise SystemExit(f'{kind} ended with exit code {code}')
    return wall, children_cpu() - before


def seconds_to_first(kind: str, namespace: str, folder: Path) -> float:
    """Return the time [s] to the first message of `pose` elsewhere; NaN if none comes."""
    listener = Process((*script('listener.py'), namespace), talks=True)
    try:
        listener.line()
        time.sleep(0.3)
        begin_wall = time.time_ns()
        with Process(program(kind, namespace, folder, once=False)) as node:
            give_up = time.monotonic() + 30.0
            while time.monotonic() < give_up and node.alive:
                time.sleep(0.02)
                listener.tell('report')
                got = json.loads(listener.line())['pose']
                if got[0]:
                    return (got[0][0] - begin_wall) / 1e9
        return float('nan')
    finally:
        listener.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rounds', type=int, default=11)
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('Start-up')        # with the commit that is there now
    found: dict[str, list[tuple[float, float, float]]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parameter_file(folder / 'parameters.json')
        for number in range(arguments.rounds):
            for i, kind in enumerate(KINDS):
                namespace = f'/s{number}_{i}'
                one = (*one_sample(kind, namespace, folder),
                       seconds_to_first(kind, namespace, folder))
                found[kind].append(one)
                print(kind, *(f'{seconds:.3f} s' for seconds in one), flush=True)
    rows = []
    for kind, runs in found.items():
        cells = [kind]
        for i in range(3):
            values = [run[i] for run in runs]
            ratio = median([a[i] / b[i] for a, b in zip(runs, found[LIKE], strict=True)])
            cells += [f'{median(values):.3f}', f'{ratio:.2f}']
        rows.append(cells)
    text = '\n'.join((
        f'{arguments.rounds} rounds; load average at the end {load():.1f}.\n',
        table(('node', 'start to exit [s]', 'ratio', 'its processor time [s]', 'ratio',
               'first message received after [s]', 'ratio'), rows),
        f'Ratios are relative to "{LIKE}".\n'))
    print(text)
    if not arguments.no_report:
        write_section('startup', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
