#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
What it costs to wake `sim_node` up for a tick, before the tick does anything.

    python benchmark/wake_up.py                         # two minutes
    python benchmark/wake_up.py --rates 200 --no-report

One process holds a node with the topics, services and parameters of `sim_node`, whose motion
stands still.  A timer with an empty callback is waited for in turns by rclpy's
`SingleThreadedExecutor`, by the one that `sim_node` has (`nodes/prompt.py`), and by a wait set of
nothing but that timer; beside them a thread that only sleeps until the time, as with
`pacing: thread`.  Processor time is that of the waiting thread, a wake-up; medians of rounds and
of ratios within a round.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import rclpy
from processes import load, median
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Future
from report import number, preamble, table, write_section

from spinning_top_sim.nodes.prompt import PromptExecutor, PromptGroup
from spinning_top_sim.nodes.simulator import Simulator

RCLPY = "rclpy's executor"


class Waits:
    """The ways to wait, each of which returns the processor time of a wake-up [us]."""

    def __init__(self, node: Simulator) -> None:
        self._node = node
        self._executors = {kind: kind() for kind in (SingleThreadedExecutor, PromptExecutor)}
        self.kinds: dict[str, Callable[[float, int], float]] = {
            RCLPY: self.rclpy_executor, "sim_node's": self.prompt_executor,
            'the timer alone': self.timer_alone, 'a sleeping thread': self.sleep}

    def rclpy_executor(self, rate: float, count: int) -> float:
        return self._executed(SingleThreadedExecutor, rate, count)

    def prompt_executor(self, rate: float, count: int) -> float:
        return self._executed(PromptExecutor, rate, count)

    def _executed(self, kind: type, rate: float, count: int) -> float:
        calls, done = [0], Future()

        def call() -> None:
            calls[0] += 1
            if calls[0] == count:
                done.set_result(None)

        executor = self._executors[kind]
        executor.add_node(self._node)
        timer = self._node.create_timer(1.0 / rate, call, callback_group=PromptGroup())
        begin = time.thread_time()
        if kind is PromptExecutor:
            executor.run_until(done)
        else:
            while not done.done():
                executor.spin_once()
        taken = time.thread_time() - begin
        self._node.destroy_timer(timer)
        executor.remove_node(self._node)
        return 1e6 * taken / count

    def timer_alone(self, rate: float, count: int) -> float:
        timer = self._node.create_timer(1.0 / rate, lambda: None)
        with timer.handle:
            wait_set = rclpy_implementation.WaitSet(0, 0, 1, 0, 0, 0, self._node.context.handle)
            begin = time.thread_time()
            for _ in range(count):
                wait_set.clear_entities()
                wait_set.add_timer(timer.handle)
                wait_set.wait(-1)
                timer.handle.call_timer()
            taken = time.thread_time() - begin
        self._node.destroy_timer(timer)
        return 1e6 * taken / count

    def sleep(self, rate: float, count: int) -> float:
        at, begin = time.monotonic(), time.thread_time()
        for _ in range(count):
            at += 1.0 / rate
            time.sleep(max(0.0, at - time.monotonic()))
        return 1e6 * (time.thread_time() - begin) / count


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
            ratio = median([a / b for a, b in zip(costs, found[RCLPY], strict=True)])
            rows.append((f'{rate:g}', kind, f'{median(costs):.0f}', number(ratio)))
            print(' | '.join(rows[-1]), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    text = (f'{arguments.rounds} rounds of {arguments.seconds:g} s; load average at the begin '
            f'{at_first:.1f}, at the end {load():.1f}.\n\n'
            + table(('Hz', 'waited for by', 'a wake-up [us]', f'ratio to {RCLPY}'), rows))
    print(text)
    if not arguments.no_report:
        write_section('wake_up', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
