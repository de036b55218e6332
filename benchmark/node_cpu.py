#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the processor time of `sim_node`, compared with other nodes.

    python benchmark/node_cpu.py                                # everything, takes 20 minutes
    python benchmark/node_cpu.py --rates 1000 --subscribers 1 --rounds 5 --no-report

Each node publishes pose, joint_states and imu/data_raw at one rate to 1 and to 3 other processes.
`sim_node` runs with its default of 200 ticks per second and with one tick per sample.  It is
compared with `straightforward_node.py` (a timer, SciPy's RK45, message objects), under the
executor of `rclpy.spin` and under rclpy's EventsExecutor, and with `bare_node.py`, the floor:
constant bytes, one tick per sample, by a thread.  With a pivot that goes to and fro,
and beside it with one at rest, it publishes all default streams at their rates and records them.
All take turns in every round; nodes of a pair run at once.  The tables have medians of rounds, and
of ratios within a round.  Processor time is that of the whole process, relative to the elapsed
time.  An arrival is the reception by the middleware of a subscriber.  Jitter is the difference
between the period and the time between two arrivals on a topic.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from processes import (
    ROOT,
    Process,
    load,
    median,
    namespaces,
    quantile,
    ros_arguments,
    script,
    sim_node,
    together,
)
from report import number, preamble, table, write_section

from spinning_top_sim.tools.scene_file import read_scene

STREAMS = ('pose', 'joint_states', 'imu')
OTHERS = ('ground_truth_imu', 'ground_truth_odom', 'invariants')
SIM, SIM_RECORDING = 'sim_node', 'sim_node, recording'
TICKS_RECORDING = 'sim_node, 200 ticks, recording'
STRAIGHT, EVENTS = 'straightforward', 'straightforward, EventsExecutor'
FLOOR = 'floor'
KINDS = (TICKS_RECORDING, 'sim_node, 200 ticks', SIM_RECORDING, SIM, STRAIGHT, EVENTS, FLOOR)
SHUTTLE = {name: value for name, value in read_scene(ROOT / 'config/shuttle.yaml').items()
           if name.startswith('pivot.')}
PAIRS = ((TICKS_RECORDING, EVENTS), (SIM_RECORDING, FLOOR), (SIM, FLOOR))


@dataclass
class Result:
    """Measurements of one run of one node; arrivals of all subscribers together."""

    share: float                                # processor time over elapsed time
    rates: list[float] = field(default_factory=list)
    jitter_ms: list[float] = field(default_factory=list)
    lost: int = 0
    gaps: int = 0                               # samples missing in the stamps


def program(kind: str, rate: float, namespace: str, folder: Path) -> list[str]:
    """Return the arguments of python for this kind of node."""
    if kind in (STRAIGHT, EVENTS):
        executor = 'events' if kind == EVENTS else 'single'
        return [*script('straightforward_node.py'),
                *ros_arguments(namespace, {'rate': float(rate), 'executor': executor})]
    if kind == FLOOR:
        return [*script('bare_node.py'), *ros_arguments(namespace, {'rate': float(rate)})]
    return sim_node(namespace, {
        'status_period': 0.0, **({} if '200 ticks' in kind else {'tick_rate': float(rate)}),
        'record.enabled': 'recording' in kind, 'record.uri': f'{folder}/',
        **{f'{name}.rate': float(rate) for name in STREAMS},
        **{f'{name}.enabled': False for name in OTHERS}})


def measure(kind: str, rate: float, subscribers: int, seconds: float, folder: Path) -> Result:
    """Run one node with its subscribers."""
    namespace = next(namespaces)
    listeners = [Process((*script('listener.py'), namespace), talks=True)
                 for _ in range(subscribers)]
    try:
        for listener in listeners:
            listener.line()
        with Process(program(kind, rate, namespace, folder)) as node:
            wait_for_all_topics(listeners, kind)
            ask(listeners)
            cpu, begin = node.cpu_ns(), time.monotonic_ns()
            time.sleep(seconds)
            cpu, taken = node.cpu_ns() - cpu, time.monotonic_ns() - begin
            return result(cpu / taken, ask(listeners), rate)
    finally:
        for listener in listeners:
            listener.end()
        for path in folder.iterdir():
            path.unlink()


def ask(listeners: list[Process]) -> list[dict]:
    """Return what the listeners have received since they were asked last."""
    for listener in listeners:
        listener.tell('report')
    return [json.loads(listener.line()) for listener in listeners]


def wait_for_all_topics(listeners: list[Process], kind: str) -> None:
    """Wait until every listener has received every topic, and a little longer."""
    give_up = time.monotonic() + 30.0
    for listener in listeners:
        heard: set[str] = set()
        while len(heard) < len(STREAMS):
            if time.monotonic() > give_up:
                raise SystemExit(f'{kind} did not start')
            time.sleep(0.05)
            heard |= {topic for topic, got in ask([listener])[0].items() if got[0]}
    time.sleep(1.5)


def result(share: float, said: list[dict], rate: float) -> Result:
    """Return the result from the reports of the listeners."""
    found = Result(share)
    period_ns = 1e9 / rate
    for times, numbers, stamps in (got for one in said for got in one.values()):
        if len(times) < 2:
            found.rates.append(0.0)
            continue
        found.rates.append((len(times) - 1) / (times[-1] - times[0]) * 1e9)
        found.jitter_ms += [abs(b - a - period_ns) / 1e6 for a, b in itertools.pairwise(times)]
        found.lost += numbers[-1] - numbers[0] + 1 - len(numbers)
        found.gaps += round((stamps[-1] - stamps[0]) / period_ns) + 1 - len(stamps)
    return found


def in_turns(options: argparse.Namespace) -> str:
    """Return the table of all kinds of nodes at all rates."""
    rows = []
    for rate, subscribers in itertools.product(options.rates, options.subscribers):
        found: dict[str, list[Result]] = {kind: [] for kind in KINDS}
        with tempfile.TemporaryDirectory() as folder:
            for _ in range(options.rounds):
                for kind, runs in found.items():
                    runs.append(measure(kind, rate, subscribers, options.seconds, Path(folder)))
        rows += [(str(rate), str(subscribers), *row(kind, runs, found[EVENTS]))
                 for kind, runs in found.items()]
        print(*rows[-len(KINDS):], sep='\n', flush=True)
    return table(('Hz', 'subscribers', 'node', 'of a core', f'relative to {EVENTS}',
                  'arrived [Hz]', 'jitter p50 [ms]', 'p99 [ms]', 'max [ms]', 'lost on the way',
                  'missing in the stamps'), rows)


def row(kind: str, runs: list[Result], others: list[Result]) -> list[str]:
    """Return the cells of a kind of node."""
    return [kind, f'{median([run.share for run in runs]):.1%}',
            number(median([a.share / b.share for a, b in zip(runs, others, strict=True)])),
            f'{median([sum(run.rates) / len(run.rates) for run in runs]):.1f}',
            *(f'{median([quantile(run.jitter_ms, share) for run in runs]):.3f}'
              for share in (0.5, 0.99, 1.0)),
            str(sum(run.lost for run in runs)),
            str(sum(run.gaps for run in runs)) if kind.startswith(SIM) else '–']


def in_pairs(programs: Mapping[str, Callable[[str], list[str]]], rounds: int, seconds: float,
             subscribers: int = 1) -> tuple[str, ...]:
    """Return the row of two nodes that run at once: their time, and the ratio."""
    shares = together({name: (program, ROOT) for name, program in programs.items()}, rounds,
                      seconds, subscribers)
    one, other = shares.values()
    ratios = [a / b for a, b in zip(one, other, strict=True)]
    cells = (*programs, f'{median(one):.1%}', f'{median(other):.1%}',
             *(number(value, 3) for value in (median(ratios), min(ratios), max(ratios))))
    print(cells, flush=True)
    return cells


def all_pairs(rounds: int, seconds: float) -> str:
    """Return the table of pairs at 1 kHz, of a moving pivot, and without subscribers."""
    def idle(enabled: bool) -> Callable[[str], list[str]]:
        return lambda namespace: sim_node(namespace, {
            'tick_rate': 1000.0, 'status_period': 0.0, **{
                f'{name}.enabled': enabled for name in (*STREAMS, 'imu_data', *OTHERS, 'clock')}})

    with tempfile.TemporaryDirectory() as folder:
        def node(kind: str) -> Callable[[str], list[str]]:
            return lambda namespace: program(kind, 1000, namespace, Path(folder))
        rows = [in_pairs({kind: node(kind) for kind in pair}, rounds, seconds) for pair in PAIRS]

        def exact(pivot: Mapping[str, object]) -> Callable[[str], list[str]]:
            return lambda namespace: sim_node(namespace, {
                'solver.method': 'exact', 'record.enabled': True, 'record.uri': f'{folder}/',
                **pivot})
        rows.append(in_pairs({'pivot to and fro, exact, recording': exact(SHUTTLE),
                              'pivot at rest': exact({})}, 2 * rounds, 2.0 * seconds))
    rows.append(in_pairs({'no subscriber, all streams enabled': idle(True),
                          'none enabled': idle(False)}, rounds, seconds, subscribers=0))
    return table(('node', 'other', 'node', 'other', 'ratio', 'smallest', 'largest'), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rates', type=int, nargs='+', default=(200, 1000, 2000), help='Hz')
    parser.add_argument('--subscribers', type=int, nargs='+', default=(1, 3))
    parser.add_argument('--rounds', type=int, default=3, help='twice as many of pairs')
    parser.add_argument('--seconds', type=float, default=2.0, help='measured in each run')
    parser.add_argument('--no-report', action='store_true', help='print the tables only')
    options = parser.parse_args()
    head = preamble('Processor time of the node')        # with the commit that is there now
    at_first = load()
    pairs = all_pairs(2 * options.rounds, 2.0 * options.seconds)
    text = '\n'.join((
        f'{options.rounds} rounds of {options.seconds:g} s, twice as many of pairs; load average '
        f'at the start {at_first:.1f}.\n',
        '## Pairs, at 1 kHz or default rates\n', pairs, '## All nodes\n', in_turns(options)))
    print(text)
    if not options.no_report:
        write_section('node_cpu', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
