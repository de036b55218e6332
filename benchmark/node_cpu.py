#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the processor time of `sim_node`, compared with other nodes.

    python benchmark/node_cpu.py                                # everything, takes 20 minutes
    python benchmark/node_cpu.py --rates 1000 --subscribers 1 --rounds 5 --no-report

Each node publishes three streams (pose, joint_states, imu/data_raw) at the same rate, for 1 and 3
other processes that subscribe to all of them.  `sim_node` runs with one tick per sample, and with
its default of 200 ticks per second, where a tick publishes several samples at higher rates.  It
is compared with `straightforward_node.py` (a timer, SciPy's RK45, message objects), which runs
under the executor of `rclpy.spin` and under rclpy's EventsExecutor, the best that plain rclpy
has, and with `bare_node.py` ("floor": constant bytes, one tick per sample, by a thread).  All
take turns in every round.  The tables have medians of rounds, and of ratios within
a round.  Processor time is that of the whole process with its DDS threads, relative to the
elapsed time.  An arrival is the reception of a message by the middleware of a subscriber.  Jitter
is the difference between the period and the time between two arrivals on a topic.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
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

STREAMS = ('pose', 'joint_states', 'imu')
OTHERS = ('ground_truth_imu', 'ground_truth_odom', 'invariants')
RATES = (200, 1000, 2000)
SUBSCRIBERS = (1, 3)
KINDS = {
    'sim_node, 200 ticks, recording': (False, True), 'sim_node, 200 ticks': (False, False),
    'sim_node, recording': (True, True), 'sim_node': (True, False),
    'straightforward': None, 'straightforward, EventsExecutor': None, 'floor, thread': None,
}
STRAIGHT, EVENTS, FLOOR = 'straightforward', 'straightforward, EventsExecutor', 'floor, thread'
PAIRS = (('sim_node, 200 ticks, recording', EVENTS), ('sim_node, recording', FLOOR),
         ('sim_node', FLOOR))


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
    ours = KINDS[kind]
    if ours is not None:
        tick_a_sample, records = ours
        parameters = {'status_period': 0.0,
                      **({'tick_rate': float(rate)} if tick_a_sample else {}),
                      'record.enabled': records, 'record.uri': str(folder) + '/',
                      **{f'{name}.rate': float(rate) for name in STREAMS},
                      **{f'{name}.enabled': False for name in OTHERS}}
        return sim_node(namespace, parameters)
    if kind in (STRAIGHT, EVENTS):
        executor = 'events' if kind == EVENTS else 'single'
        return [*script('straightforward_node.py'),
                *ros_arguments(namespace, {'rate': float(rate), 'executor': executor})]
    return [*script('bare_node.py'),
            *ros_arguments(namespace, {'rate': float(rate), 'pacing': 'thread'})]


def measure(kind: str, rate: float, subscribers: int, seconds: float, warm_up: float,
            folder: Path) -> Result | None:
    """Run one node with its subscribers; return None if one did not start."""
    namespace = next(namespaces)
    listeners = [Process((*script('listener.py'), namespace), talks=True)
                 for _ in range(subscribers)]
    try:
        for listener in listeners:
            listener.line()
        with Process(program(kind, rate, namespace, folder)) as node:
            if not settled(listeners, warm_up):
                return None
            for listener in listeners:
                listener.tell('report')
                listener.line()
            cpu, begin = node.cpu_ns(), time.monotonic_ns()
            time.sleep(seconds)
            cpu, taken = node.cpu_ns() - cpu, time.monotonic_ns() - begin
            for listener in listeners:
                listener.tell('report')
            said = [json.loads(listener.line()) for listener in listeners]
            if not node.alive:
                return None
        return result(cpu / taken, said, rate, kind)
    finally:
        for listener in listeners:
            listener.end()
        for path in folder.iterdir():
            path.unlink()


def settled(listeners: list[Process], warm_up: float) -> bool:
    """Wait until every listener has received every topic, and for the warm-up."""
    give_up = time.monotonic() + 30.0
    for listener in listeners:
        heard: set[str] = set()
        while len(heard) < len(STREAMS):
            if time.monotonic() > give_up:
                return False
            time.sleep(0.05)
            listener.tell('report')
            heard |= {topic for topic, got in json.loads(listener.line()).items() if got[0]}
    time.sleep(warm_up if listeners else 1.5 + warm_up)     # a start takes a second
    return True


def result(share: float, said: list[dict], rate: float, kind: str) -> Result:
    """Return the result of the reports of the listeners."""
    found = Result(share)
    period_ns = 1e9 / rate
    for times, numbers, stamps in (got for one in said for got in one.values()):
        if len(times) < 2:
            found.rates.append(0.0)
            continue
        found.rates.append((len(times) - 1) / (times[-1] - times[0]) * 1e9)
        found.jitter_ms += [abs(b - a - period_ns) / 1e6 for a, b in itertools.pairwise(times)]
        found.lost += numbers[-1] - numbers[0] + 1 - len(numbers)
        if KINDS[kind] is not None:
            found.gaps += round((stamps[-1] - stamps[0]) / period_ns) + 1 - len(stamps)
    return found


def cases(arguments: argparse.Namespace) -> Iterator[tuple[int, int]]:
    yield from itertools.product(arguments.rates, arguments.subscribers)


def measured(arguments: argparse.Namespace) -> dict:
    """Return {(rate, subscribers): {kind: [Result of each round]}}."""
    found: dict = {case: {kind: [] for kind in arguments.kinds} for case in cases(arguments)}
    folder = Path(tempfile.mkdtemp(prefix='node_cpu_'))
    try:
        for number_ in range(arguments.rounds):
            for case in cases(arguments):
                for kind in arguments.kinds:
                    one = measure(kind, *case, arguments.seconds, arguments.warm_up, folder)
                    found[case][kind].append(one)
                    print(f'round {number_ + 1}, {case[0]} Hz, {case[1]} subscribers, {kind}: '
                          + ('failed' if one is None else
                             f'{100 * one.share:.1f} %, {mean_rate(one):.0f} Hz')
                          + f', load {load():.1f}', flush=True)
    except KeyboardInterrupt:
        print('interrupted: the tables are incomplete, and are not written')
        arguments.no_report = True
    finally:
        shutil.rmtree(folder)
    return found


def pair_row(shares: dict[str, list[float]]) -> tuple[str, ...]:
    """Return the processor time of two nodes, and the median of their ratios with its range."""
    one, other = shares.values()
    ratios = [a / b for a, b in zip(one, other, strict=True)]
    return (f'{100 * median(one):.1f}', f'{100 * median(other):.1f}',
            *(number(value, 3) for value in (median(ratios), min(ratios), max(ratios))))


def idle(rounds: int, seconds: float) -> str:
    """Return the table of the cost of streams without subscribers."""
    switches = [f'{name}.enabled' for name in (*STREAMS, 'imu_data', *OTHERS, 'clock')]

    def node(enabled: bool) -> tuple[Callable[[str], list[str]], Path]:
        return lambda namespace: sim_node(namespace, {
            'tick_rate': 1000.0, 'status_period': 0.0, **dict.fromkeys(switches, enabled)}), ROOT

    return table(
        ('all streams enabled [%]', 'none enabled [%]', 'ratio', 'smallest', 'largest'),
        [pair_row(together({'all': node(True), 'none': node(False)}, rounds, seconds))])


def in_pairs(rounds: int, seconds: float) -> str:
    """Return the table of `sim_node` and another node that run at once, at 1 kHz."""
    with tempfile.TemporaryDirectory() as name:
        def node(kind: str) -> tuple[Callable[[str], list[str]], Path]:
            return lambda namespace: program(kind, 1000, namespace, Path(name)), ROOT

        return table(
            ('node', 'other', 'node [%]', 'other [%]', 'ratio', 'smallest', 'largest'),
            [(kind, other, *pair_row(together({kind: node(kind), other: node(other)}, rounds,
                                              seconds, subscribers=1)))
             for kind, other in PAIRS])


def mean_rate(one: Result) -> float:
    return sum(one.rates) / len(one.rates) if one.rates else float('nan')


def ratio(runs: dict, kind: str, to: str, per_sample: bool) -> float:
    """Return the median of the ratios within rounds; NaN where one is missing."""
    def cost(one: Result) -> float:
        return one.share / mean_rate(one) if per_sample else one.share
    return median([cost(a) / cost(b) for a, b in zip(runs[kind], runs[to], strict=True)
                   if a and b and (not per_sample or (mean_rate(a) and mean_rate(b)))])


def share_table(found: dict) -> str:
    """Return the processor time of every kind in every case."""
    kinds = list(next(iter(found.values())))
    rows = [(str(rate), str(subscribers),
             *(f'{100 * median([run.share for run in runs[kind] if run]):.1f}'
               for kind in kinds)) for (rate, subscribers), runs in found.items()]
    return table(('Hz', 'subscribers', *kinds), rows)


COMPARED = (*((kind, EVENTS) for kind, ours in KINDS.items() if ours), (STRAIGHT, EVENTS),
            ('sim_node, recording', FLOOR), ('sim_node', FLOOR))


def ratio_table(found: dict, per_sample: bool = False) -> str:
    """Return the ratios of processor time, of a second or of a sample that arrived."""
    kinds = next(iter(found.values()))
    pairs = [pair for pair in COMPARED if set(pair) <= set(kinds)]
    rows = [(str(rate), str(subscribers), *(number(ratio(runs, *pair, per_sample))
                                          for pair in pairs))
            for (rate, subscribers), runs in found.items() if subscribers or not per_sample]
    return table(('Hz', 'subscribers', *(f'{a} / {b}' for a, b in pairs)), rows)


def arrival_table(found: dict) -> str:
    """Return rate, jitter and loss of the messages of one subscriber."""
    rows = []
    for (rate, subscribers), kinds in found.items():
        for kind, all_runs in kinds.items():
            runs = [run for run in all_runs if run and run.rates]
            if not runs:
                continue
            rows.append((
                str(rate), str(subscribers), kind, f'{median([mean_rate(r) for r in runs]):.1f}',
                *(f'{median([quantile(r.jitter_ms, share) for r in runs]):.3f}'
                  for share in (0.5, 0.99, 1.0)),
                str(sum(run.lost for run in runs)),
                str(sum(run.gaps for run in runs)) if KINDS[kind] else '–'))
    return table(('Hz', 'subscribers', 'node', 'arrived [Hz]', 'jitter p50 [ms]', 'p99 [ms]',
                  'max [ms]', 'lost on the way', 'missing in the stamps'), rows)


def figure(found: dict, path: Path) -> None:
    """Draw processor time over rate, a panel for each number of subscribers."""
    from matplotlib.figure import Figure

    subscribers = sorted({case[1] for case in found})
    drawing = Figure(figsize=(4.0 * len(subscribers), 3.6), layout='constrained')
    axes = drawing.subplots(1, len(subscribers), sharey=True, squeeze=False)[0]
    for panel, count in zip(axes, subscribers, strict=True):
        rates = [rate for rate, n in found if n == count]
        for kind in next(iter(found.values())):
            style = {'floor': ':', STRAIGHT: '--'}.get(kind.split(',')[0], '-')
            panel.plot(rates, [100 * median([run.share for run in found[rate, count][kind] if run])
                               for rate in rates], style, marker='.', label=kind)
        panel.set(xscale='log', yscale='log', xlabel='rate of three streams [Hz]',
                  title=f'{count} subscribing process{"" if count == 1 else "es"}')
        panel.set_xticks(rates, [str(rate) for rate in rates])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    axes[0].set_ylabel('processor time [% of a core]')
    axes[0].legend(fontsize=7)
    drawing.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rates', type=int, nargs='+', default=RATES, help='Hz')
    parser.add_argument('--subscribers', type=int, nargs='+', default=SUBSCRIBERS)
    parser.add_argument('--kinds', nargs='+', default=list(KINDS), choices=KINDS, metavar='KIND',
                        help=f'of {list(KINDS)}')
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--seconds', type=float, default=2.0, help='measured in each run')
    parser.add_argument('--warm-up', type=float, default=1.5, help='before that')
    parser.add_argument('--pair-rounds', type=int, default=6,
                        help='of the tables of nodes that run at once')
    parser.add_argument('--no-report', action='store_true', help='print the tables only')
    arguments = parser.parse_args()
    head = preamble('Processor time of the node')        # with the commit that is there now
    at_first = load()
    unheard = idle(arguments.pair_rounds, 2.0 * arguments.seconds)
    print(unheard, flush=True)
    pairs = in_pairs(arguments.pair_rounds, 2.0 * arguments.seconds)
    print(pairs, flush=True)
    found = measured(arguments)
    text = '\n'.join((
        f'Load average at the start {at_first:.1f}, at the end {load():.1f} (including the '
        f'benchmark itself); {arguments.rounds} rounds of {arguments.seconds:g} s.\n',
        '## Processor time [% of a core]\n', share_table(found),
        '## Ratios of processor time\n', ratio_table(found),
        '## Ratios of processor time per received sample\n',
        ratio_table(found, per_sample=True),
        '## In pairs\n',
        'Processor time at 1 kHz with one subscriber each.  Both nodes of a pair run at once, so '
        f'that they meet the same load of the machine; {arguments.pair_rounds} rounds.\n', pairs,
        '## Streams without subscribers\n',
        'Processor time at 1000 ticks per second, default rates, no subscriber; both nodes of a '
        f'pair run at once, {arguments.pair_rounds} rounds.\n', unheard,
        '## Arrivals\n', arrival_table(found)))
    print(text)
    if not arguments.no_report:
        figure(found, ROOT / 'docs' / 'node_cpu.png')
        write_section('node_cpu', head, __doc__, '![Processor time over rate](node_cpu.png)\n',
                      text)


if __name__ == '__main__':
    sys.exit(main())
