#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the processor time of waking up `sim_node` for a tick.

    python benchmark/wake_up.py                         # two minutes
    python benchmark/wake_up.py --rates 200 --no-report

One process contains a node with the topics, services and parameters of `sim_node`; its motion
does not run.  A timer on the steady clock with an empty callback is served in turns by rclpy's
`SingleThreadedExecutor` and by its `EventsExecutor`, which `sim_node` uses.  They are compared
with a thread that sleeps until absolute deadlines, which makes the ticks of `sim_node`.  The
table has the processor time of the whole process per wake-up: medians of rounds, and of ratios
within a round.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial

import rclpy
from processes import load, median
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from report import number, preamble, table, write_section

from spinning_top_sim.nodes.simulator import Simulator

SINGLE = 'SingleThreadedExecutor'


class Waits:
    """The ways to wait; each returns the processor time per wake-up [us]."""

    def __init__(self, node: Simulator) -> None:
        self._node = node
        self._executors = {SINGLE: SingleThreadedExecutor(), 'EventsExecutor': EventsExecutor()}
        self.kinds: dict[str, Callable[[float, int], float]] = {
            **{name: partial(self.executed, name) for name in self._executors},
            'a sleeping thread': self.sleep}

    def executed(self, name: str, rate: float, count: int) -> float:
        calls = []
        executor = self._executors[name]
        executor.add_node(self._node)
        timer = self._node.create_timer(1.0 / rate, lambda: calls.append(None),
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        begin = time.process_time()
        while len(calls) < count:
            executor.spin_once(1.0)
        taken = time.process_time() - begin
        self._node.destroy_timer(timer)
        executor.remove_node(self._node)
        return 1e6 * taken / count

    def sleep(self, rate: float, count: int) -> float:
        at, begin = time.monotonic(), time.process_time()
        for _ in range(count):
            at += 1.0 / rate
            time.sleep(max(0.0, at - time.monotonic()))
        return 1e6 * (time.process_time() - begin) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rates', type=float, nargs='+', default=[200.0, 1000.0], help='Hz')
    parser.add_argument('--rounds', type=int, default=11)
    parser.add_argument('--seconds', type=float, default=1.0, help='each run')
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head, at_first = preamble('A wake-up', ('ros-jazzy-rclpy',)), load()
    rclpy.init(args=['wake_up', '--ros-args', '-p', 'status_period:=0.0'])
    node = Simulator()
    waits = Waits(node)
    rows = []
    for rate in arguments.rates:
        count = round(rate * arguments.seconds)
        found: dict[str, list[float]] = {kind: [] for kind in waits.kinds}
        for _ in range(arguments.rounds):
            for kind, wait in waits.kinds.items():
                found[kind].append(wait(rate, count))
        for kind, costs in found.items():
            ratio = median([a / b for a, b in zip(costs, found[SINGLE], strict=True)])
            rows.append((f'{rate:g}', kind, f'{median(costs):.0f}', number(ratio)))
            print(' | '.join(rows[-1]), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    text = (f'{arguments.rounds} rounds of {arguments.seconds:g} s; load average at the start '
            f'{at_first:.1f}, at the end {load():.1f}.\n\n'
            + table(('Hz', 'woken by', 'time per wake-up [us]', f'relative to {SINGLE}'), rows))
    print(text)
    if not arguments.no_report:
        write_section('wake_up', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
