#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Compare the cost of this checkout with that of a release, and fail where it is higher.

    make performance-check                     # with the last tag
    make performance-check REF=<commit>

The release is checked out into a temporary worktree.  Both run in one environment, so with the
same libraries, and take turns; nodes of a pair run at once.  Costs are processor time, which
other programs disturb least.  Every row is the median of the ratios within rounds.  It fails
above the factor in ROWS, which is more than the ratios of a commit to itself scatter.  The exit
code is then 1, and 2 if there is nothing to compare with.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import node_cpu
import offline
import processes
import startup
from processes import ROOT, Process, median
from report import table

BEFORE, NOW = 'before', 'now'
NODE, TICK_A_SAMPLE = 'sim_node, 200 ticks, recording', 'sim_node, recording'
SIMULATED_S = 300.0         # three streams at 1 kHz: 1.2 million messages

Costs = dict[str, list[float]]


class Comparison:
    """Measures both checkouts; `rounds` scales the rounds of every row."""

    def __init__(self, checkouts: dict[str, Path], folder: Path, rounds: float) -> None:
        self.checkouts, self.folder, self.rounds = checkouts, folder, rounds

    def node(self, kind: str, rate: float) -> Costs:
        """Return the processor time over elapsed time of nodes with a subscriber."""
        def program(namespace: str) -> list[str]:
            return node_cpu.program(kind, rate, namespace, self.folder)
        return node_cpu.together(dict.fromkeys(self.checkouts, program), self.count(6), 5.0,
                                 subscribers=1, checkouts=self.checkouts)

    def start_up(self) -> Costs:
        """Return the processor time [s] of a node that ends at its first sample."""
        numbers = itertools.count()
        return self.in_turns(15, lambda checkout: startup.one_sample(
            startup.RECORDING, f'/r{next(numbers)}', self.folder, checkout)[1])

    def simulate(self) -> Costs:
        """Return the processor time [s] of `simulate` from start to exit."""
        log = self.folder / 'run.mcap'

        def simulate(checkout: Path) -> float:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            processes.simulate(
                ('-o', str(log), '--duration', str(SIMULATED_S), *offline.PARAMETERS), checkout)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            log.unlink()
            return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return self.in_turns(9, simulate)

    def arrays(self, method: str) -> Costs:
        """Return the processor time [s] of `solve`."""
        with contextlib.ExitStack() as running:
            solvers = {checkout: running.enter_context(Process(
                processes.script('array_job.py'), talks=True, checkout=checkout))
                for checkout in self.checkouts.values()}

            def solve(checkout: Path) -> float:
                solvers[checkout].tell(method)
                return float(solvers[checkout].line())
            self.in_turns(2, solve)             # the first ones load what is needed
            return self.in_turns(41, solve)

    def in_turns(self, rounds: int, cost: Callable[[Path], float]) -> Costs:
        """Measure both in every round; another one begins each time."""
        found: Costs = {name: [] for name in self.checkouts}
        for number in range(self.count(rounds)):
            for name in list(self.checkouts)[::-1 if number % 2 else 1]:
                found[name].append(cost(self.checkouts[name]))
        return found

    def count(self, rounds: int) -> int:
        return max(1, round(rounds * self.rounds))


# Name of a row: its unit, the factor to the unit, how it is measured, and the ratio it may have.
ROWS: dict[str, tuple[str, float, Callable[[Comparison], Costs], float]] = {
    'node at 200 Hz': ('% of a core', 100.0, lambda both: both.node(NODE, 200), 1.2),
    'node at 1 kHz': ('% of a core', 100.0, lambda both: both.node(NODE, 1000), 1.2),
    'node at 1 kHz, a tick a sample':
        ('% of a core', 100.0, lambda both: both.node(TICK_A_SAMPLE, 1000), 1.2),
    'start-up': ('s', 1.0, Comparison.start_up, 1.15),
    'simulate': ('s', 1.0, Comparison.simulate, 1.15),
    'solve, exact': ('ms', 1e3, lambda both: both.arrays('exact'), 1.15),
    'solve, rk45': ('ms', 1e3, lambda both: both.arrays('rk45'), 1.15),
}


@contextlib.contextmanager
def worktree(reference: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder.  Raises SystemExit with the reason."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'before'
        git('worktree', 'add', '--quiet', '--detach', str(path), reference)
        try:
            yield path
        finally:
            git('worktree', 'remove', '--force', str(path))


def git(*arguments: str) -> str:
    """Return what git prints.  Raises SystemExit with code 2."""
    run = subprocess.run(['git', *arguments], cwd=ROOT, capture_output=True, text=True,
                         timeout=60.0, check=False)
    if run.returncode:
        print(f'git {" ".join(arguments)}: {run.stderr.strip()}', file=sys.stderr)
        raise SystemExit(2)
    return run.stdout.strip()


def last_tag() -> str:
    """Return the last tag before this commit.  Raises SystemExit with code 2 if there is none."""
    if not git('tag', '--merged'):
        print('No release to compare with: this history has no tag; say make performance-check '
              'REF=<commit>', file=sys.stderr)
        raise SystemExit(2)
    return git('describe', '--tags', '--abbrev=0')


def row(name: str, both: Comparison) -> tuple[tuple[str, ...], bool]:
    """Measure a row; return its cells, and whether it is within its factor."""
    unit, scale, measure, allowed = ROWS[name]
    costs = measure(both)
    ratios = [now / before for now, before in zip(costs[NOW], costs[BEFORE], strict=True)]
    good = median(ratios) <= allowed
    return (name, f'{scale * median(costs[BEFORE]):.3g} {unit}',
            f'{scale * median(costs[NOW]):.3g} {unit}',
            *(f'{value:.3f}' for value in (median(ratios), min(ratios), max(ratios))),
            f'{allowed:g}', 'ok' if good else 'SLOWER'), good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('reference', nargs='?', help='a commit; default: the last tag')
    parser.add_argument('--rows', nargs='+', choices=ROWS, default=list(ROWS), metavar='ROW',
                        help=f'of {list(ROWS)}')
    parser.add_argument('--rounds', type=float, default=1.0, help='times as many rounds')
    arguments = parser.parse_args()
    reference = arguments.reference or last_tag()
    with worktree(reference) as before, tempfile.TemporaryDirectory() as name:
        both = Comparison({BEFORE: before, NOW: ROOT}, Path(name), arguments.rounds)
        found = []
        for row_name in arguments.rows:
            found.append(row(row_name, both))
            print(' | '.join(found[-1][0]), flush=True)
    print(f'\nThis checkout compared with {reference}, {git("describe", "--always", reference)}:\n'
          + table(('', BEFORE, NOW, 'ratio', 'smallest', 'largest', 'allowed', ''),
                  [cells for cells, _ in found]))
    return 0 if all(good for _, good in found) else 1


if __name__ == '__main__':
    sys.exit(main())
