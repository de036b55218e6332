# SPDX-License-Identifier: Apache-2.0
"""
Compare methods where the equations are difficult, and the growth of errors in an hour:

    PYTHONPATH=. python benchmark/stability.py [--limit SECONDS] [--hour-limit SECONDS]

Each method runs on each situation in its own process with a time limit, because some never return.
Errors are differences from the exact solution.  The error of the exact solution is the difference
from heyoka in extended precision.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import multiprocessing
import resource
import signal
import time
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import report
from cases import (
    CUSP,
    HEAVY_TOP,
    ROOT,
    TOY_200,
    WHEEL,
    Case,
    grid_ns,
    near_pole,
    scene,
)
from peers import (
    FailedError,
    angles_between,
    literal_start,
    long_attitudes,
    peer,
)

from spinning_top_sim import State
from spinning_top_sim.solvers.dormand_prince import IntegrationError

DURATION, RATE = 10, 64
# Limits are processor times; this factor is the limit of real time.
PATIENCE = 20.0
SITUATIONS = (
    Case('at the top, moving', WHEEL, State(theta=0.0, theta_dot=3.0, l3=0.3, lz=0.3)),
    Case('sleeping, stable', *scene('sleeping')),
    Case('sleeping, unstable, from 1e-8 rad', WHEEL, State(theta=1e-8, l3=1.0, lz=1.0)),
    Case('waking sleeper, from 1e-3 rad', *scene('waking_sleeper')),
    Case('hanging', WHEEL, State(theta=math.pi, l3=0.5, lz=-0.5)),
    *(near_pole(theta_min, theta_dot=-6.0) for theta_min in (1e-2, 1e-4, 1e-6, 1e-8)),
    Case('through the top', WHEEL, State(theta=1.0, theta_dot=-6.0, l3=0.3, lz=0.3)),
    Case('pendulum over the top', *scene('planar_pendulum')),
    Case('near the separatrix', *scene('near_separatrix')),
    HEAVY_TOP,
    TOY_200,
)
METHODS = (
    ('exact, any times', 0.0), ('rk45 transport', 1e-11), ('rk45 euler', 1e-11),
    ('SciPy RK45', 1e-6), ('SciPy DOP853', 1e-9), ('SciPy DOP853', 1e-12),
    ('SciPy LSODA', 1e-9), ('heyoka Euler', 2.0 ** -52), ('heyoka quadratic', 2.0 ** -52),
    ('MuJoCo RK4', 2048.0))
# Bounds of right attitudes and angles [rad]: a missed passage of a pole is an error of pi.
LOST_ATTITUDE, LOST_ANGLE = 0.01, 1.0

SENSITIVITY_SPANS = (10, 30, 100)
SENSITIVE = (CUSP, *(case for case in SITUATIONS if case.title.startswith(
    ('sleeping, unstable', 'waking sleeper', 'near the separatrix'))))

HOUR = 3600
HOUR_RATE = 16
CHECKPOINTS = (10, 100, 1000, 3600)
RUNNERS = (
    ('exact, any times', 0.0), ('rk45 transport', 1e-11), ('rk45 transport', 1e-13),
    ('rk45 euler', 1e-11), ('SciPy RK45', 1e-6), ('SciPy DOP853', 1e-9),
    ('SciPy DOP853', 1e-12), ('heyoka Euler', 2.0 ** -52), ('heyoka quadratic', 2.0 ** -52),
    ('MuJoCo RK4', 512.0))


@dataclasses.dataclass
class Outcome:
    """Result of a method in a situation; errors [rad] are the largest over all samples."""

    verdict: str
    attitude: float | None = None
    phi: float | None = None
    psi: float | None = None
    work: int | None = None
    seconds: float | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--limit', type=float, default=10.0, help='for one situation [s]')
    parser.add_argument('--hour-limit', type=float, default=120.0,
                        help='for one hour of the cusp [s]')
    options = parser.parse_args()
    text = [report.preamble('Stability'), INTRODUCTION.format(
        duration=DURATION, rate=RATE, limit=options.limit, attitude=LOST_ATTITUDE,
        angle=LOST_ANGLE)]
    overview = []
    details = []
    for case in SITUATIONS:
        outcomes = [in_child(meet, (case, name, setting), options.limit)
                    for name, setting in METHODS]
        overview.append([case.title, *(outcome.verdict.split(':')[0] for outcome in outcomes)])
        details.append(f'### {case.title}\n\n{_describe(case)}\n\n' + report.table(
            ('method', 'verdict', 'attitude [rad]', 'phi [rad]', 'psi [rad]', 'work', 'time [s]'),
            [_row(*method, outcome) for method, outcome in zip(METHODS, outcomes, strict=True)]))
        print(case.title, [outcome.verdict[:40] for outcome in outcomes], flush=True)
    labels = [_label(*method) for method in METHODS]
    text += ['## Overview\n', report.table(('situation', *labels), overview)]
    text += ['## An hour of cusps\n', hour(options.hour_limit)]
    text += ['## Where errors grow exponentially\n', sensitivity()]
    text += ['## Each situation\n', *details]
    report.write('stability.md', '\n'.join(text))


INTRODUCTION = """
Every situation is {duration} s long with samples at {rate} Hz. A run has at most {limit:g} s of
processor time.

- **right**: the attitude is within {attitude:g} rad at all times, and phi and psi, if the method
  has them, are within {angle:g} rad
- **angles lost**: no error message and the right attitude, but the error of phi or psi exceeds
  {angle:g} rad, because a step has passed over the pole.  Where the axis rests at a pole, only
  phi + psi (phi - psi at the bottom) is defined and compared
- **wrong**: no error message, but the error of the attitude exceeds that bound
- **refused**: stopped with an error message;  **hung**: not finished within the time limit
- **NaN**: returned NaN

Only `exact`, `rk45` and the methods in Euler angles compute phi and psi.
"""


# ------------------------------------------------------------------------------------ situations

def meet(case: Case, name: str, setting: float) -> Outcome:
    """Let a method meet a situation."""
    method = peer(name)
    ns = grid_ns(DURATION, RATE)
    begin = time.process_time()
    try:
        runner = method.ready(case, setting)
        samples = runner.samples(ns)
    except (FailedError, IntegrationError) as error:
        return Outcome(f'refused: {error}'.split(';', maxsplit=1)[0])
    except ArithmeticError as error:
        return Outcome(f'refused: {type(error).__name__}: {error}')
    seconds = time.process_time() - begin
    if not np.all(np.isfinite(samples.quaternion)):
        return Outcome('NaN', seconds=seconds, work=runner.work)
    exact = case.exact.states(ns)
    if name.startswith('exact'):
        if reason := peer('heyoka quadratic').missing():
            return Outcome(f'not judged: {reason}', work=runner.work, seconds=seconds)
        truth = long_attitudes(case, ns[::RATE])
        error = float(angles_between(samples.quaternion[::RATE], truth).max())
    else:
        error = float(angles_between(samples.quaternion, exact.quaternion).max())
    outcome = Outcome('right', error, work=runner.work, seconds=seconds)
    if samples.phi is not None:
        differences = samples.phi - exact.phi, samples.psi - exact.psi
        if case.exact.theta_max < 1e-9:
            differences = (differences[0] + differences[1],)
        elif case.exact.theta_min > math.pi - 1e-9:
            differences = (differences[0] - differences[1],)
        outcome.phi, outcome.psi = (float(np.abs(d).max()) for d in (
            differences[0], differences[-1]))
    if error > LOST_ATTITUDE:
        outcome.verdict = 'wrong'
    elif outcome.phi is not None and max(outcome.phi, outcome.psi) > LOST_ANGLE:
        outcome.verdict = 'angles lost'
    return outcome


def in_child(run: Callable[..., Any], arguments: tuple[Any, ...], limit: float) -> Any:
    """Run in its own process, with a time limit; report crashes."""
    if reason := peer(arguments[1]).missing():
        return Outcome(f'missing: {reason}')
    context = multiprocessing.get_context('fork')
    receiver, sender = context.Pipe(duplex=False)

    def child() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (round(limit), round(limit)))
        sender.send(run(*arguments))

    process = context.Process(target=child)
    process.start()
    sender.close()
    try:
        if receiver.poll(PATIENCE * limit):
            return receiver.recv()
    except EOFError:
        process.join()
        if process.exitcode not in (-signal.SIGXCPU, -signal.SIGKILL):
            return Outcome(f'crashed: exit code {process.exitcode}')
    finally:
        process.kill()
        process.join()
    return Outcome(f'hung: not done in {limit:g} s')


def _describe(case: Case) -> str:
    exact = case.exact
    return (f'theta from {exact.theta_min:.9g} to {exact.theta_max:.9g} rad, '
            f'L3²/(4 λ1 P) = {case.swiftness:.3g}, m1 = {exact.m1:.2g}; starts from theta, '
            f'theta\', phi, psi = {", ".join(f"{value:.9g}" for value in literal_start(case))}')


def _label(name: str, setting: float) -> str:
    return f'{name} {peer(name).setting_text(setting)}'.strip()


def _row(name: str, setting: float, outcome: Outcome) -> tuple[str, ...]:
    return (_label(name, setting), outcome.verdict.replace('|', '/').replace('\n', ' '),
            *(report.number(error) for error in (outcome.attitude, outcome.phi, outcome.psi)),
            f'{outcome.work} {peer(name).unit}' if outcome.work else '–',
            report.number(outcome.seconds))


# ----------------------------------------------------------------------------------- sensitivity

def sensitivity() -> str:
    """Return the table of errors of rk45, and of the effect of one rounding of the start."""
    ns = grid_ns(SENSITIVITY_SPANS[-1], RATE)
    ends = [span * RATE + 1 for span in SENSITIVITY_SPANS]
    lines = []
    for case in SENSITIVE:
        truth = case.exact.states(ns).quaternion
        start = dataclasses.replace(case.start, theta=math.nextafter(case.start.theta, math.inf))
        curves = [('theta one double up, exact',
                   Case(case.title, case.top, start).exact.states(ns).quaternion)]
        curves += [(_label('rk45 transport', rtol),
                    peer('rk45 transport').ready(case, rtol).attitudes(ns))
                   for rtol in (1e-9, 1e-11, 1e-13)]
        for label, attitudes in curves:
            errors = angles_between(attitudes, truth)
            lines.append((case.title, report.number(case.exact.m1), label,
                          *(report.number(errors[:end].max()) for end in ends)))
    return ('Largest difference of the attitude from the exact motion [rad].  m1 is the '
            'distance from the separatrix.\n\n' + report.table(
                ('motion', 'm1', 'what', *(f'{span} s' for span in SENSITIVITY_SPANS)), lines))


# ------------------------------------------------------------------------------------------ hour

def follow(case: Case, name: str, setting: float) -> tuple[np.ndarray, ...] | Outcome:
    """Return the errors of the attitude, E, L3 and Lz over an hour, the last three relative."""
    ns = grid_ns(HOUR, HOUR_RATE)
    samples = peer(name).ready(case, setting).samples(ns)
    truth = case.exact.states(range(0, int(ns[-1]) + 1, int(ns[1]))).quaternion
    energy, l3, lz = samples.invariants(case)
    scale = case.top.gravity_torque, case.start.l3, case.start.lz
    return (angles_between(samples.quaternion, truth),
            *(np.abs(value - value[0]) / abs(unit)
              for value, unit in zip((energy, l3, lz), scale, strict=True)))


def hour(limit: float) -> str:
    """Run the hour with every method, draw it, and return its table."""
    lines, curves = [], {}
    for name, setting in RUNNERS:
        begin = time.perf_counter()
        result = in_child(follow, (CUSP, name, setting), limit)
        print(_label(name, setting), f'{time.perf_counter() - begin:.0f} s', flush=True)
        if isinstance(result, Outcome):
            lines.append((_label(name, setting), result.verdict, *['–'] * 6))
            continue
        curves[name, setting] = result
        reached = [np.maximum.accumulate(values)[[t * HOUR_RATE for t in CHECKPOINTS]]
                   for values in result]
        lines.append((_label(name, setting), *(report.number(value) for value in reached[0]),
                      *(report.number(values[-1]) for values in reached[1:])))
    draw(curves)
    heads = ('method', *(f'attitude, {t} s [rad]' for t in CHECKPOINTS), 'E/P', 'L3', 'Lz')
    return (f'The scene `cusp` at {HOUR_RATE} Hz; the last three columns are relative and over '
            'the whole hour.  The row of the exact solution compares two evaluations of it, '
            'at any times and\non a grid; the tables of work and precision have its error '
            'against others.\n\n' + report.table(heads, lines)
            + '\n![Errors over an hour](stability.png)\n')


COLOURS = {'exact, any times': '#000000', 'rk45 transport': '#D55E00', 'rk45 euler': '#E69F00',
           'SciPy RK45': '#56B4E9', 'SciPy DOP853': '#0072B2', 'heyoka Euler': '#009E73',
           'heyoka quadratic': '#009E73', 'MuJoCo RK4': '#666666'}
DASHED = ('heyoka Euler', ('rk45 transport', 1e-13), ('SciPy DOP853', 1e-12))


def draw(curves: dict[tuple[str, float], tuple[np.ndarray, ...]]) -> None:
    """Draw error and energy over time, with the slopes of the theory."""
    mpl.use('Agg')
    figure, panels = plt.subplots(1, 2, figsize=(13.5, 6.4))
    t = grid_ns(HOUR, HOUR_RATE)[1:] / 1e9
    at = np.unique(np.geomspace(1, len(t), 300).round().astype(int)) - 1
    for panel, column, title in zip(
            panels, (0, 1), ('error of the attitude [rad]', 'error of the energy, of P'),
            strict=True):
        ends = []
        for key, result in curves.items():
            worst = np.maximum(np.maximum.accumulate(result[column][1:]), 1e-17)[at]
            panel.plot(t[at], worst, color=COLOURS[key[0]], linewidth=1.6, linestyle='--'
                       if key[0] in DASHED or key in DASHED else '-')
            ends.append((math.log10(worst[-1]), _label(*key), COLOURS[key[0]]))
        _label_ends(panel, ends)
        panel.set_xscale('log')
        panel.set_yscale('log')
        panel.set_xlim(0.1, 3600)
        panel.set_title(title, fontsize=11)
        panel.set_xlabel('simulated time [s]')
        panel.grid(which='major', color='#DDDDDD', linewidth=0.6)
        panel.set_axisbelow(True)
    _slopes(panels[0], ((2.0, 3e-8, 't²'), (1.0, 1e-12, 't')))
    _slopes(panels[1], ((1.0, 3e-9, 't'), (0.5, 3e-16, '√t')))
    figure.suptitle('An hour of the scene `cusp`: largest error so far; thin lines: slopes',
                    fontsize=12)
    figure.tight_layout()
    path = ROOT / 'docs/stability.png'
    figure.savefig(path, dpi=120)
    plt.close(figure)
    print(f'wrote {path.relative_to(ROOT)}')


def _slopes(panel: plt.Axes, slopes: tuple[tuple[float, float, str], ...]) -> None:
    t = np.array([1.0, 3600.0])
    for power, start, text in slopes:
        panel.plot(t, start * t ** power, color='#888888', linewidth=0.8, linestyle=':')
        panel.text(t[0], start, f'{text} ', ha='right', va='center', color='#666666', fontsize=10)


def _label_ends(panel: plt.Axes, ends: list[tuple[float, str, str]]) -> None:
    """Write each curve's name at its right end, apart from its neighbours."""
    low, high = min(y for y, _, _ in ends) - 1.0, max(y for y, _, _ in ends) + 1.0
    gap, last = (high - low) / 26.0, -math.inf
    for y, text, colour in sorted(ends):
        place = max(y, last + gap)
        last = place
        panel.annotate(text, (3600.0, 10.0 ** y), xytext=(1.03, (place - low) / (high - low)),
                       textcoords='axes fraction', va='center', fontsize=9, color=colour,
                       arrowprops={'arrowstyle': '-', 'color': colour, 'linewidth': 0.5})
    panel.set_ylim(10.0 ** low, 10.0 ** high)


if __name__ == '__main__':
    main()
