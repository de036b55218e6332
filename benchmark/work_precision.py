# SPDX-License-Identifier: Apache-2.0
"""
Compare error and time per state of all methods over their tolerances: `make benchmark` or

    PYTHONPATH=. python benchmark/work_precision.py

Each case runs for 10 s.  The error is the largest rotation angle to the truth over all samples.
The truth is the exact solution, which is itself compared with heyoka in BITS-bit arithmetic.  The
time is the processor time of the whole call over the number of states.  It contains the set-up of
the exact solution, but not the compilation of models; two states show that set-up.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import report
from cases import TOY_200, WORK_PRECISION, Case, grid_ns
from peers import PEERS, FailedError, Peer, Runner
from timing import TimeUpError, interleaved, one_thread, seconds_of, time_limit
from truth import BITS, angles_between, long_attitudes

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.times import NANOSECONDS

CASES = (*WORK_PRECISION, TOY_200)
REFERENCE = ('SciPy DOP853', 1e-9)
DURATION, RATE = 10, 512        # simulated time [s], samples a second
STATES = DURATION * RATE + 1
FEW = grid_ns(1, RATE)[:2]
PROBES = 16             # instants at which the exact solution is compared with extended precision
LONGEST_S = 80.0        # of real time for a run, or for the truth; a method takes 4 s at most
ROUNDS = 5
PROBLEMS = (FailedError, IntegrationError, ArithmeticError, ValueError, RuntimeError, TimeUpError)


@dataclass
class Row:
    """One method at one setting: its error, or why it has none, its time, and that of FEW."""

    peer: Peer
    setting: float
    error: float | None = None
    seconds: float | None = None
    few: float | None = None
    ready: float = 0.0
    work: int | None = None
    failure: str = ''


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[1]).parse_args()
    one_thread()
    results = {}
    for case in CASES:
        begin = time.perf_counter()
        results[case] = measure(case)
        print(f'{case.title}: {time.perf_counter() - begin:.0f} s', flush=True)
    draw(results)
    report.write('work_precision.md', '\n'.join((
        report.preamble(f'Work and precision over {DURATION} s'), INTRODUCTION.format(
            reference=REFERENCE[0], tolerance=REFERENCE[1], longest=LONGEST_S, bits=BITS,
            probes=PROBES, rounds=ROUNDS), _missing(),
        *(_section(case, rows) for case, rows in results.items()))))


INTRODUCTION = """
The error is the largest rotation angle [rad] between an attitude and the true one over all
samples.  The truth is `exact`; its own error is that at {probes} instants against heyoka in
{bits}-bit arithmetic.  The time is the processor time of a whole call over the number of
attitudes, with the set-up of the exact solution; compilation has a column of its own, and so has
a call for two attitudes.  Ratios are relative to {reference} at {tolerance:g}.  Times are medians
over {rounds} interleaved rounds.  A method whose run takes more than {longest:g} s is left out.
SciPy and `rk45 euler` solve equations (29)-(32) of the paper, heyoka quaternion equations without
poles.  The right-hand sides of `rk45` and SciPy are Python.  Every method has one thread.
"""


def _missing() -> str:
    lines = [f'- {peer.name} is missing here: {reason}' for peer in PEERS
             if (reason := peer.missing())]
    return '\n'.join(lines) + '\n' if lines else 'No method is missing.\n'


def measure(case: Case) -> list[Row]:
    """Run every method at every setting once for its error, then ROUNDS times for its time."""
    ns = grid_ns(DURATION, RATE)
    truth = case.exact.states(ns, NANOSECONDS).quaternion
    runs: dict[object, Callable[[], object]] = {}
    rows = []
    for peer, setting in ((p, s) for p in PEERS if not p.missing() for s in p.settings):
        row = Row(peer, setting)
        rows.append(row)
        try:
            row.ready, runner = seconds_of(lambda p=peer, s=setting: _ready(p, case, s))
            with time_limit(LONGEST_S):
                attitudes = runner.attitudes(ns)
        except PROBLEMS as problem:
            row.failure = f'{type(problem).__name__}: {problem}'.split(';', maxsplit=1)[0]
            continue
        row.work = runner.work
        row.error = (_error_of_exact(case, ns, attitudes) if peer.name.startswith('exact')
                     else float(angles_between(attitudes, truth).max()))
        runs[id(row), 'all'] = functools.partial(runner.attitudes, ns)
        runs[id(row), 'few'] = functools.partial(runner.attitudes, FEW)
    seconds = interleaved(runs, ROUNDS)
    for row in rows:
        row.seconds, row.few = (seconds.get((id(row), what)) for what in ('all', 'few'))
    return rows


def _ready(peer: Peer, case: Case, setting: float) -> Runner:
    """Compile what a run needs; some methods compile at their first call."""
    runner = peer.ready(case, setting)
    runner.attitudes(FEW)
    return runner


def _error_of_exact(case: Case, ns: np.ndarray, attitudes: np.ndarray) -> float | None:
    """Return the error at PROBES instants against extended precision, None without it."""
    at = np.linspace(0, len(ns) - 1, PROBES + 1).round().astype(int)
    try:
        with time_limit(LONGEST_S):
            return float(angles_between(attitudes[at], long_attitudes(case, ns[at])).max())
    except (ImportError, TimeUpError):
        return None


def _section(case: Case, rows: list[Row]) -> str:
    unit = next((row.seconds for row in rows
                 if (row.peer.name, row.setting) == REFERENCE and row.seconds), None)
    lines = []
    for row in rows:
        name = row.peer.label(row.setting)
        if row.failure:
            lines.append((name, *5 * ('–',), row.failure.replace('|', '/')))
            continue
        lines.append((name, report.number(row.error),
                      report.number(1e6 * row.seconds / STATES, 3),
                      report.number(unit and row.seconds / unit), f'{1e6 * row.few:.0f}',
                      f'{1e3 * row.ready:.0f}',
                      f'{row.work} {row.peer.unit}' if row.work else ''))
    exact = case.exact
    return (f'## {case.title}, {DURATION} s at {RATE} Hz\n\ntheta from '
            f'{exact.theta_min:.9g} to {exact.theta_max:.9g} rad, nutation period '
            f'{exact.nutation_period:.4g} s, L3²/(4 λ1 P) = {case.swiftness:.3g}\n\n'
            + report.table(('method', 'error [rad]', 'µs a state', 'ratio', 'two states [µs]',
                            'before [ms]', 'work, or what happened'), lines))


# Okabe & Ito's palette, which the colour-blind can tell apart.
COLOURS = {'ours': '#D55E00', 'SciPy': '#0072B2', 'heyoka': '#009E73'}
STYLES = {peer: {'color': COLOURS[peer.family] if peer.settings[0] else 'black',
                 'marker': marker, 'label': peer.name}
          for peer, marker in zip(PEERS, 'Xop^svD', strict=True)}


def draw(results: dict[Case, list[Row]]) -> None:
    """Draw error over time per state, a panel for each case, a line for each method."""
    mpl.use('Agg')
    figure, panels = plt.subplots(2, 3, figsize=(13.5, 8.6), sharex=True, sharey=True,
                                  layout='constrained')
    for panel, (case, rows) in zip(panels.flat, results.items(), strict=True):
        for peer, style in STYLES.items():
            points = [(1e6 * row.seconds / STATES, max(row.error, 1e-16)) for row in rows
                      if row.peer is peer and row.error is not None]
            if points:
                panel.loglog(*zip(*points, strict=True), **style)
        absent = sorted({row.peer.name for row in rows if row.failure}
                        - {row.peer.name for row in rows if row.error is not None})
        if absent:
            panel.text(0.98, 0.12, 'fails, or takes too long:\n' + '\n'.join(absent), ha='right',
                       transform=panel.transAxes, va='bottom', fontsize=8, color='#444444')
        panel.set_title(case.title, fontsize=11)
        panel.grid(color='#DDDDDD', linewidth=0.6)
    for panel in panels[-1]:
        panel.set_xlabel('time per state [µs]')
    figure.supylabel('largest error of the attitude [rad]')
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside lower center', ncols=6)
    figure.suptitle(f'{DURATION} s sampled at {RATE} Hz: left is faster, lower is more accurate')
    report.save(figure, 'work_precision.png')


if __name__ == '__main__':
    main()
