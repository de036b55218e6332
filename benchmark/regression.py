#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Compare the cost of this checkout with that of two earlier commits, and fail where it is higher.

    make performance-check                          # the last release, and the parent
    make performance-check REF=<commit> BASE=<commit>

The release is the last tag or, where there is none, the commit that gave the package its present
version.  The parent is HEAD if files have changed since, the merge base with the main branch on
another branch, and the commit before HEAD otherwise.

Each commit is checked out into a temporary worktree.  All checkouts run in one environment, take
turns within every round, and are measured in processor time; nodes run at once.  A figure is the
median over the rounds of the ratio of this checkout to the other one.  The exit code is 1 if a
ratio exceeds LIMIT, and 2 if there is nothing to compare with.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from processes import ROOT, Process, children_cpu, median, run_module, script, sim_node, together
from report import table

LIMIT = 1.10
NOW, PARENT, RELEASE = 'now', 'parent', 'release'
STREAMS = ('pose', 'joint_states', 'imu')
AT_REST = ('-p', 'pivot.path:=[0.0, 0.0, 0.0, 0.0]', '-p', 'pivot.waypoints:=[0.0, 0.0, 0.0]')
ENSEMBLE = """
runs: 200
duration: 1.0
seed: 1
params: [{config}/wavy.yaml, {config}/imu/bmi088.yaml, {{solver.method: exact}}]
sample: {{initial.theta: {{uniform: [0.2, 1.2]}}}}
streams: [imu, ground_truth_imu]
"""

Checkouts = Mapping[str, Path]
Costs = dict[str, list[float]]


def simulate(duration: float, *arguments: str) -> Callable[[Path, Path], float]:
    """Return what measures `simulate` of three streams at 1 kHz."""
    def cost(checkout: Path, folder: Path) -> float:
        return run_module('spinning_top_sim.tools.simulate', (
            '-o', str(folder / 'run.mcap'), '--duration', str(duration), '--quiet',
            *arguments,
            '-p', f'record.streams:=[{", ".join(STREAMS)}]',
            *(item for name in STREAMS for item in ('-p', f'{name}.rate:=1000.0'))), checkout)
    return cost


def over_rest(scene: str) -> Callable[[Path, Path], float]:
    """Return what measures a scene with a moving pivot over the same with its pivot at rest."""
    params = '--params', str(ROOT / 'config' / f'{scene}.yaml')
    moving, resting = simulate(300.0, *params), simulate(300.0, *params, *AT_REST)

    def cost(checkout: Path, folder: Path) -> float:
        if not (checkout / 'config' / f'{scene}.yaml').exists():
            return float('nan')
        costs = []
        for k, one in enumerate((resting, moving, moving, resting)):
            (folder / str(k)).mkdir()
            costs.append(one(checkout, folder / str(k)))
        return (costs[1] + costs[2]) / (costs[0] + costs[3])
    return cost


def start_up(checkout: Path, folder: Path) -> float:
    """Measure a recording node that ends at its first sample."""
    before = children_cpu()
    with Process(sim_node('/start_up', {
            'record.enabled': True, 'record.uri': str(folder / 'run.mcap'), 'duration': 0.001,
            }), checkout=checkout) as node:
        if code := node.wait(30.0):
            raise SystemExit(f'sim_node of {checkout} ended with exit code {code}')
    return children_cpu() - before


def ensemble(checkout: Path, folder: Path) -> float:
    """Measure an ensemble with one worker; NaN where there is no such command."""
    if not (checkout / 'scripts/ensemble').exists():
        return float('nan')
    (folder / 'spec.yaml').write_text(ENSEMBLE.format(config=ROOT / 'config'))
    return run_module('spinning_top_sim.tools.ensemble', (
        str(folder / 'spec.yaml'), '-o', str(folder / 'runs'), '--workers', '1', '--quiet'),
        checkout)


def in_turns(cost: Callable[[Path, Path], float]) -> Callable[[Checkouts, int], Costs]:
    """Return what measures processes that run one after the other."""
    def measure(checkouts: Checkouts, rounds: int) -> Costs:
        def run(name: str) -> float:
            with tempfile.TemporaryDirectory() as folder:
                return cost(checkouts[name], Path(folder))
        return taking_turns(checkouts, rounds, run)
    return measure


def arrays(job: str) -> Callable[[Checkouts, int], Costs]:
    """Return what measures a job of array_job.py, in new processes every ten rounds."""
    def measure(checkouts: Checkouts, rounds: int) -> Costs:
        jobs: dict[str, Process] = {}

        def ask(name: str) -> float:
            jobs[name].tell(job)
            return float(jobs[name].line())

        found: Costs = {name: [] for name in checkouts}
        for _ in range(rounds):
            with contextlib.ExitStack() as running:
                for name, checkout in checkouts.items():
                    jobs[name] = running.enter_context(Process(
                        script('array_job.py'), talks=True, checkout=checkout))
                taking_turns(jobs, 2, ask)          # the first ones load what is needed
                for name, costs in taking_turns(jobs, 10, ask).items():
                    found[name] += costs
        return found
    return measure


def node(rate: float) -> Callable[[Checkouts, int], Costs]:
    """Return what measures recording nodes with a subscriber each, which run at once."""
    def measure(checkouts: Checkouts, rounds: int) -> Costs:
        with tempfile.TemporaryDirectory() as folder:
            parameters = {'status_period': 0.0, 'record.enabled': True,
                          'record.uri': f'{folder}/',
                          **{f'{name}.rate': rate for name in STREAMS},
                          **{f'{name}.enabled': False for name in (
                              'ground_truth_imu', 'ground_truth_odom', 'invariants')}}
            return together({name: (lambda namespace: sim_node(namespace, parameters), checkout)
                             for name, checkout in checkouts.items()},
                            rounds, seconds=6.0, subscribers=1)
    return measure


def taking_turns(names: Mapping[str, object], rounds: int, cost: Callable[[str], float]) -> Costs:
    """Measure all in every round; another one is first each time."""
    found: Costs = {name: [] for name in names}
    for first in range(rounds):
        for k in range(len(names)):
            name = list(names)[(first + k) % len(names)]
            found[name].append(cost(name))
    return found


class Row(NamedTuple):
    """What is measured, in how many rounds, and the unit of what is shown."""

    measure: Callable[[Checkouts, int], Costs]
    rounds: int
    unit: str
    scale: float = 1.0


ROWS = {
    'simulate, exact': Row(in_turns(simulate(300.0, '-p', 'solver.method:=exact')), 15, 's'),
    'simulate, rk45': Row(in_turns(simulate(40.0, '-p', 'solver.method:=rk45')), 15, 's'),
    'shuttle, moving over resting pivot': Row(in_turns(over_rest('shuttle')), 3, ''),
    'free fall, moving over resting pivot': Row(in_turns(over_rest('free_fall')), 3, ''),
    'set-up of an exact motion': Row(arrays('set-up'), 4, 'ms', 1e3),
    'solve 10 s at 512 Hz, exact': Row(arrays('exact'), 4, 'ms', 1e3),
    'solve 10 s at 512 Hz, rk45': Row(arrays('rk45'), 4, 'ms', 1e3),
    'node at 200 Hz': Row(node(200.0), 7, '% of a core', 100.0),
    'node at 1 kHz': Row(node(1000.0), 7, '% of a core', 100.0),
    'start-up': Row(in_turns(start_up), 15, 's'),
    'ensemble': Row(in_turns(ensemble), 9, 's'),
}


def git(*arguments: str) -> str:
    """Return what git prints.  Raises SystemExit with code 2."""
    run = subprocess.run(['git', *arguments], cwd=ROOT, capture_output=True, text=True,
                         timeout=60.0, check=False)
    if run.returncode:
        print(f'git {" ".join(arguments)}: {run.stderr.strip()}', file=sys.stderr)
        raise SystemExit(2)
    return run.stdout.strip()


def last_release() -> str:
    """Return the last tag, or the commit that set the present version."""
    if git('tag', '--merged'):
        return git('describe', '--tags', '--abbrev=0')
    version = (ROOT / 'package.xml').read_text().partition('<version>')[2].partition('<')[0]
    return git('log', '--format=%h', '--reverse', f'-S<version>{version}</version>', '--',
               'package.xml').split('\n')[0]


def parent() -> str:
    """Return the commit from which the present change starts."""
    if git('status', '--porcelain', '--untracked-files=no'):
        return 'HEAD'
    for branch in git('for-each-ref', '--format=%(refname:short)', 'refs/heads/main',
                      'refs/remotes/origin/main').split():
        base = git('merge-base', 'HEAD', branch)
        if base != git('rev-parse', 'HEAD'):
            return base
    return 'HEAD~'


@contextlib.contextmanager
def worktrees(references: Mapping[str, str]) -> Iterator[dict[str, Path]]:
    """Check commits out into a temporary folder.  Raises SystemExit with the reason."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as checked_out:
        paths = {}
        for name, reference in references.items():
            paths[name] = Path(folder) / name
            git('worktree', 'add', '--quiet', '--detach', str(paths[name]), reference)
            checked_out.callback(git, 'worktree', 'remove', '--force', str(paths[name]))
        yield paths


def cells(name: str, costs: Costs) -> tuple[list[str], bool]:
    """Return a row of the table, and whether it is within the limit."""
    shown, good = [name, f'{ROWS[name].scale * median(costs[NOW]):.3g} {ROWS[name].unit}'], True
    for other in (PARENT, RELEASE):
        ratios = [now / before for now, before in zip(costs[NOW], costs[other], strict=True)]
        if ratios[0] != ratios[0]:          # NaN
            shown += ['–', '–']
            continue
        good &= median(ratios) <= LIMIT
        shown += [f'{median(ratios):.3f}', f'{min(ratios):.2f} to {max(ratios):.2f}']
    return [*shown, 'ok' if good else 'SLOWER'], good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--release', metavar='COMMIT', help='default: the last release')
    parser.add_argument('--parent', metavar='COMMIT', help='default: the parent of the change')
    parser.add_argument('--rows', nargs='+', choices=ROWS, default=list(ROWS), metavar='ROW',
                        help=f'of {list(ROWS)}')
    parser.add_argument('--rounds', type=float, default=1.0, help='times as many rounds')
    arguments = parser.parse_args()
    references = {PARENT: arguments.parent or parent(),
                  RELEASE: arguments.release or last_release()}
    begin, found = time.monotonic(), []
    with worktrees(references) as earlier:
        for name in arguments.rows:
            row = ROWS[name]
            costs = row.measure({NOW: ROOT, **earlier},
                                max(1, round(row.rounds * arguments.rounds)))
            found.append(cells(name, costs))
            print(f'{time.monotonic() - begin:4.0f} s', *found[-1][0], sep=' | ', flush=True)
    print('\nThis checkout compared with ' + ' and '.join(
        f'its {name} {git("describe", "--always", reference)}'
        for name, reference in references.items()) + ', at most '
        f'{LIMIT:.2f}:\n\n' + table(('', NOW, PARENT, 'range', RELEASE, 'range', ''),
                                    [row for row, _ in found]))
    return 0 if all(good for _, good in found) else 1


if __name__ == '__main__':
    sys.exit(main())
