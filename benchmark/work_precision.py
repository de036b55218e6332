# SPDX-License-Identifier: Apache-2.0
"""
Compare error and time per state of all methods over their tolerances: `make benchmark` or

    PYTHONPATH=. python benchmark/work_precision.py [--only 10]

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

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import report
from cases import TOY_200, WORK_PRECISION, Case, grid_ns
from peers import PEERS, FailedError, Peer, Runner
from timing import TimeUpError, interleaved, one_thread, seconds_of, time_limit
from truth import BITS, angles_between, long_attitudes

from spinning_top_sim.solvers.dormand_prince import IntegrationError

CASES = (*WORK_PRECISION, TOY_200)
REFERENCE = ('SciPy DOP853', 1e-9)
# Simulated time [s] and samples a second.
SPANS = ((10, 512), (1000, 64))
FEW = grid_ns(1, 1)
PROBES = 16             # instants at which the exact solution is compared with extended precision
LONGEST_TRUTH = 60.0    # [s]; if that takes longer, the error stays unknown
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
    parser.add_argument('--only', type=int, choices=[span for span, _ in SPANS],
                        help='simulated time [s]; default all')
    parser.add_argument('--longest', type=float, default=4.0,
                        help='leave out methods that take longer than this for one run [s]')
    options = parser.parse_args()
    one_thread()
    for duration, rate in SPANS:
        if options.only in (None, duration):
            compare(duration, rate, 5 if duration == SPANS[0][0] else 1, options.longest)


def compare(duration: int, rate: int, rounds: int, longest: float) -> None:
    """Measure every case over one time span, and write its page and its figure."""
    results = {}
    for case in CASES:
        begin = time.perf_counter()
        results[case] = measure(case, duration, rate, rounds, longest)
        print(f'{duration} s of {case.title}: {time.perf_counter() - begin:.0f} s', flush=True)
    name = 'work_precision' + ('' if duration == SPANS[0][0] else f'_{duration}s')
    page = [report.preamble(f'Work and precision over {duration} s'), INTRODUCTION.format(
        reference=REFERENCE[0], tolerance=REFERENCE[1], longest=longest, bits=BITS,
        probes=PROBES, rounds=rounds, retakes=RETAKES, short=SHORT), _missing()]
    page += [_section(case, duration, rate, rows) for case, rows in results.items()]
    draw(results, duration, rate, f'{name}.png')
    report.write(f'{name}.md', '\n'.join(page))


INTRODUCTION = """
The error is the largest rotation angle [rad] between an attitude and the true one over all
samples.  The truth is `exact`; its own error is that at {probes} instants against heyoka in
{bits}-bit arithmetic.  The time is the processor time of a whole call over the number of
attitudes, with the set-up of the exact solution; compilation and loading have a column of their
own.  Ratios are relative to {reference} at {tolerance:g}.  Times are medians over {rounds}
interleaved rounds (where 1, over {retakes} for runs below {short:g} s).  A method whose run would
take more than {longest:g} s is left out.  SciPy, heyoka Euler and `rk45 euler` solve equations
(29)-(32) of the paper, heyoka quadratic and diffrax quaternion equations without poles.  The
setting of MuJoCo is its step.  The right-hand sides of `rk45` and SciPy are Python.  Every method
has one thread.
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
        name = row.peer.label(row.setting)
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


# Okabe & Ito's palette, which the colour-blind can tell apart.
COLOURS = {'ours': '#D55E00', 'SciPy': '#0072B2', 'heyoka': '#009E73', 'diffrax': '#CC79A7',
           'MuJoCo': '#666666'}
STYLES = {peer: {'color': COLOURS[peer.family] if peer.settings[0] else 'black',
                 'marker': marker, 'label': peer.name}
          for peer, marker in zip(PEERS, 'PXop^sv<DDh>', strict=True)}


def draw(results: dict[Case, list[Row]], duration: int, rate: int, name: str) -> None:
    """Draw error over time per state, a panel for each case, a line for each method."""
    mpl.use('Agg')
    states = duration * rate + 1
    figure, panels = plt.subplots(2, 3, figsize=(13.5, 8.6), sharex=True, sharey=True,
                                  layout='constrained')
    for panel, (case, rows) in zip(panels.flat, results.items(), strict=True):
        for peer, style in STYLES.items():
            points = [(1e6 * row.seconds / states, max(row.error, 1e-16)) for row in rows
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
    figure.suptitle(f'{duration} s sampled at {rate} Hz: left is faster, lower is more accurate')
    report.save(figure, name)


if __name__ == '__main__':
    main()
