# SPDX-License-Identifier: Apache-2.0
"""
Compare error and time per state of all methods over their tolerances: `make benchmark` or

    PYTHONPATH=. python benchmark/work_precision.py [--quick] [--output FOLDER]

Each case runs for 10 s and for 1000 s.  The error is the largest rotation angle to the truth over
all samples.  The truth is the exact solution, which is itself compared with heyoka in BITS-bit
arithmetic.  The time is the processor time of the whole call over the number of states.  It
contains the set-up of the exact solution, but not the compilation and loading of models.
"""

from __future__ import annotations

import argparse
import functools
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import report
from cases import ROOT, TOY_200, WORK_PRECISION, Case, grid_ns
from matplotlib.lines import Line2D
from peers import BITS, PEERS, FailedError, Peer, Runner, angles_between, long_attitudes
from timing import TimeUpError, interleaved, one_thread, seconds_of, time_limit

from spinning_top_sim.solvers.dormand_prince import IntegrationError

CASES = (*WORK_PRECISION, TOY_200)
REFERENCE = ('SciPy DOP853', 1e-9)
# Simulated time [s] and samples a second.
SPANS = ((10, 512), (1000, 64))
FEW = grid_ns(1, 1)
# Number of instants at which the exact solution is compared with extended precision.
PROBES = 16
# Time limit of extended precision [s]; beyond it, the error stays unknown.
LONGEST_TRUTH = 60.0
# Real time for a run, over the processor time that it is expected to take at most.
PATIENCE = 20.0
# Runs shorter than this [s] are repeated RETAKES times where the others have one round.
SHORT, RETAKES = 0.5, 3
PROBLEMS = (FailedError, IntegrationError, ArithmeticError, ValueError, RuntimeError)


@dataclass
class Row:
    """One method at one setting: its error, or why it has none, and its time."""

    peer: Peer
    setting: float
    error: float | None = None
    seconds: float | None = None
    ready: float = 0.0
    work: int | None = None
    failure: str = ''


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--quick', action='store_true', help='10 s only, three rounds')
    parser.add_argument('--only', type=int, choices=[span for span, _ in SPANS],
                        help='simulated time [s]; default all')
    parser.add_argument('--output', type=Path, help='folder; default docs, quick: build/benchmark')
    parser.add_argument('--longest', type=float, default=4.0,
                        help='leave out methods that take longer than this for one run [s]')
    options = parser.parse_args()
    one_thread()
    folder = options.output or ROOT / ('build/benchmark' if options.quick else 'docs')
    folder.mkdir(parents=True, exist_ok=True)
    rounds = 3 if options.quick else 5
    for duration, rate in SPANS[:1 if options.quick else 2]:
        if options.only in (None, duration):
            compare(duration, rate, rounds if duration == SPANS[0][0] else 1, options.longest,
                    folder)


def compare(duration: int, rate: int, rounds: int, longest: float, folder: Path) -> None:
    """Measure every case over one time span, and write its page and its figure."""
    results = {}
    for case in CASES:
        begin = time.perf_counter()
        results[case] = measure(case, duration, rate, rounds, longest)
        print(f'{duration} s of {case.title}: {time.perf_counter() - begin:.0f} s', flush=True)
    name = 'work_precision' + ('' if duration == SPANS[0][0] else f'_{duration}s')
    page = [report.preamble(f'Work and precision over {duration} s'),
            INTRODUCTION.format(reference=REFERENCE[0], tolerance=REFERENCE[1], longest=longest,
                                bits=BITS, rounds=rounds,
                                retakes=RETAKES, short=SHORT), _missing()]
    page += [_section(case, duration, rate, rows) for case, rows in results.items()]
    draw(results, duration, rate, folder / f'{name}.png')
    (folder / f'{name}.md').write_text('\n'.join(page))
    print(f'wrote {name}.md and {name}.png in {folder}', flush=True)


INTRODUCTION = """
The error is the largest rotation angle [rad] between an attitude and the true one over all
samples.  The truth is `method='exact'`; its own error is measured at some of the instants against
heyoka in {bits}-bit arithmetic.  The time is the processor time of a whole call that returns all
attitudes, over their number.  It contains the set-up of the exact solution, some milliseconds.
The compilation or loading of a model has its own column, where a later setting may use the cache
of an earlier one.  Ratios are relative to {reference} at {tolerance:g}, if that ran.  Times are
medians over interleaved rounds in one process, {rounds} here (where 1, at least {retakes} for
runs below {short:g} s).  A method whose run would take more than {longest:g} s is left out and
marked.  SciPy, heyoka Euler and `rk45 euler` solve equations (29)-(32) of the paper; heyoka
quadratic and diffrax solve quaternion equations without poles.  The setting of MuJoCo is its
fixed step.

Limits of the comparison: the number of samples per step determines the share of dense output in
the time, which is largest for methods with few steps.  The right-hand sides of `rk45` and of
SciPy are Python and are not compiled.  Every method has one thread.
"""


def _missing() -> str:
    lines = [f'- {peer.name} is missing here: {reason}' for peer in PEERS
             if (reason := peer.missing())]
    return '\n'.join(lines) + '\n' if lines else 'No method is missing.\n'


def measure(case: Case, duration: int, rate: int, rounds: int, longest: float) -> list[Row]:
    """Run every method at every setting once for its error, then `rounds` times for its time."""
    ns = grid_ns(duration, rate)
    truth = case.exact.states(ns).quaternion
    runners: dict[int, Runner] = {}
    rows = []
    for peer in PEERS:
        if peer.missing():
            continue
        for setting in peer.settings:
            row = Row(peer, setting)
            rows.append(row)
            try:
                row.ready, runner = seconds_of(lambda p=peer, s=setting: _ready(p, case, s, ns))
                expected = _expected_seconds(runner, duration)
                if expected > longest:
                    row.failure = f'left out: about {expected:.2g} s a run'
                    continue
                with time_limit(PATIENCE * longest):
                    row.seconds, attitudes = seconds_of(lambda r=runner: r.attitudes(ns))
            except TimeUpError as problem:
                row.failure = f'left out: {problem}'
                continue
            except PROBLEMS as problem:
                row.failure = f'{type(problem).__name__}: {problem}'.split(';', maxsplit=1)[0]
                continue
            row.work = runner.work
            row.error = float(angles_between(attitudes, truth).max())
            if not np.isfinite(row.error):
                row.failure, row.error = 'NaN', None
            runners[id(row)] = runner
            if peer.name.startswith('exact'):
                row.error = _error_of_exact(case, ns, attitudes)
    again = {id(row): functools.partial(runners[id(row)].attitudes, ns) for row in rows
             if id(row) in runners and (rounds > 1 or row.seconds < SHORT)}
    seconds = interleaved(again, max(rounds, RETAKES))
    for row in rows:
        row.seconds = seconds.get(id(row), row.seconds)
    return rows


def _ready(peer: Peer, case: Case, setting: float, ns: np.ndarray) -> Runner:
    """Load and compile what a run over ns needs; some methods compile at their first call."""
    runner = peer.ready(case, setting)
    runner.attitudes(FEW)
    runner.compile(ns)
    return runner


def _expected_seconds(runner: Runner, duration: int) -> float:
    """Extrapolate from the first tenth or hundredth, sparsely sampled."""
    part = max(1, duration // 100)
    probe = grid_ns(part, 8)
    runner.compile(probe)
    runner.attitudes(probe)
    return seconds_of(lambda: runner.attitudes(probe))[0] * duration / part


_LONG: dict[tuple[str, int], tuple[np.ndarray, np.ndarray] | None] = {}


def _error_of_exact(case: Case, ns: np.ndarray, attitudes: np.ndarray) -> float | None:
    """Return the error at PROBES instants against extended precision, None without it."""
    key = case.title, len(ns)
    if key not in _LONG:
        at = np.linspace(0, len(ns) - 1, PROBES + 1).round().astype(int)
        try:
            with time_limit(LONGEST_TRUTH):
                _LONG[key] = at, long_attitudes(case, ns[at])
        except (ImportError, TimeUpError):
            _LONG[key] = None
    if _LONG[key] is None:
        return None
    at, truth = _LONG[key]
    return float(angles_between(attitudes[at], truth).max())


def _section(case: Case, duration: int, rate: int, rows: list[Row]) -> str:
    states = duration * rate + 1
    unit = next((row.seconds for row in rows
                 if (row.peer.name, row.setting) == REFERENCE and row.seconds), None)
    lines = []
    for row in rows:
        name = f'{row.peer.name} {row.peer.setting_text(row.setting)}'.strip()
        if row.failure:
            lines.append((name, '–', '–', '–', '–', row.failure.replace('|', '/')))
            continue
        lines.append((name, report.number(row.error),
                      report.number(1e6 * row.seconds / states, 3),
                      report.number(unit and row.seconds / unit),
                      f'{1e3 * row.ready:.0f}',
                      f'{row.work} {row.peer.unit}' if row.work else ''))
    exact = case.exact
    return (f'## {case.title}, {duration} s at {rate} Hz\n\ntheta from '
            f'{exact.theta_min:.9g} to {exact.theta_max:.9g} rad, nutation period '
            f'{exact.nutation_period:.4g} s, L3²/(4 λ1 P) = {case.swiftness:.3g}\n\n'
            + report.table(('method', 'error [rad]', 'µs a state', 'ratio', 'before [ms]',
                            'work, or what happened'), lines))


# Okabe & Ito's palette, which the colour-blind can tell apart; a colour is a family.
COLOURS = {'ours': '#D55E00', 'SciPy': '#0072B2', 'heyoka': '#009E73', 'diffrax': '#CC79A7',
           'numbalsoda': '#56B4E9', 'MuJoCo': '#666666'}
EXACT = '#000000'
STYLES = {'exact, any times': ('P', '-'), 'exact, grid': ('X', '-'),
          'rk45 transport': ('o', '-'), 'rk45 euler': ('o', ':'),
          'SciPy RK45': ('s', '-'), 'SciPy DOP853': ('^', '-'), 'SciPy LSODA': ('v', '-'),
          'heyoka Euler': ('D', ':'), 'heyoka quadratic': ('D', '-'),
          'diffrax Dopri8 quadratic': ('h', '-'), 'numbalsoda LSODA quadratic': ('v', ':'),
          'numbalsoda DOP853 quadratic': ('^', ':'), 'MuJoCo RK4': ('<', '-'),
          'MuJoCo implicit': ('>', ':')}


def draw(results: dict[Case, list[Row]], duration: int, rate: int, path: Path) -> None:
    """Draw error over time per state, a panel for each case, a line for each method."""
    mpl.use('Agg')
    states = duration * rate + 1
    figure, panels = plt.subplots(2, 3, figsize=(13.5, 8.6), sharex=True, sharey=True)
    for panel, (case, rows) in zip(panels.flat, results.items(), strict=True):
        for peer in PEERS:
            points = [(1e6 * row.seconds / states, max(row.error, 1e-16)) for row in rows
                      if row.peer is peer and row.error is not None]
            if points:
                panel.plot(*zip(*points, strict=True), **_style(peer))
        absent = sorted({row.peer.name for row in rows if row.failure
                         and row.peer.name not in
                         {other.peer.name for other in rows if other.error is not None}})
        panel.set_title(case.title, fontsize=11)
        if absent:
            panel.text(0.98, 0.12, 'fails, or takes too long:\n' + '\n'.join(absent), ha='right',
                       transform=panel.transAxes, va='bottom', fontsize=8, color='#444444')
        panel.set_xscale('log')
        panel.set_yscale('log')
        panel.grid(which='major', color='#DDDDDD', linewidth=0.6)
        panel.set_axisbelow(True)
    for panel in panels[-1]:
        panel.set_xlabel('time per state [µs]')
    for panel in panels[:, 0]:
        panel.set_ylabel('largest error of the attitude [rad]')
    handles = [Line2D([], [], **_style(peer), label=peer.name) for peer in PEERS
               if not peer.missing()]
    figure.legend(handles=handles, loc='lower center', ncols=5, frameon=False, fontsize=9.5)
    figure.suptitle(f'{duration} s sampled at {rate} Hz: left is faster, lower is more accurate',
                    fontsize=12)
    figure.tight_layout(rect=(0.0, 0.1, 1.0, 1.0))
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _style(peer: Peer) -> dict[str, object]:
    marker, line = STYLES[peer.name]
    exact = peer.name.startswith('exact')
    return {'color': EXACT if exact else COLOURS[peer.family], 'marker': marker,
            'linestyle': line, 'markersize': 9 if exact else 5.5,
            'linewidth': 2.0 if peer.family == 'ours' else 1.2}


if __name__ == '__main__':
    main()
