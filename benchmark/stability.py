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
from cases import CUSP, HEAVY_TOP, TOY_200, WHEEL, Case, grid_ns, near_pole, scene
from peers import FailedError, peer
from truth import angles_between, long_attitudes

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
    ('SciPy LSODA', 1e-9), ('heyoka quadratic', 2.0 ** -52))
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
    ('SciPy DOP853', 1e-12), ('heyoka quadratic', 2.0 ** -52))


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
    for case in SITUATIONS:
        outcomes = [in_child(meet, (case, name, setting), options.limit)
                    for name, setting in METHODS]
        overview.append([case.title, *(outcome.verdict.split(':')[0] for outcome in outcomes)])
        print(case.title, [outcome.verdict[:40] for outcome in outcomes], flush=True)
    labels = [peer(name).label(setting) for name, setting in METHODS]
    text += ['## Overview\n', report.table(('situation', *labels), overview)]
    text += ['## An hour of cusps\n', hour(options.hour_limit)]
    text += ['## Where errors grow exponentially\n', sensitivity()]
    report.write('stability.md', '\n'.join(text))


INTRODUCTION = """
Every situation is {duration} s long with samples at {rate} Hz; a run has at most {limit:g} s of
processor time.

- **right**: the attitude is within {attitude:g} rad at all times, and phi and psi are within
  {angle:g} rad, as far as the method has them and they are defined
- **angles lost**: the right attitude, but phi or psi is off by more, without an error message
- **wrong**: the attitude is off by more, without an error message
- **refused**: stopped with an error message;  **hung**: not finished in time;  **NaN**: all NaN
"""


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
        curves += [(peer('rk45 transport').label(rtol),
                    peer('rk45 transport').ready(case, rtol).attitudes(ns))
                   for rtol in (1e-9, 1e-11, 1e-13)]
        for label, attitudes in curves:
            errors = angles_between(attitudes, truth)
            lines.append((case.title, report.number(case.exact.m1), label,
                          *(report.number(errors[:end].max()) for end in ends)))
    return ('Largest difference of the attitude from the exact motion [rad].  m1 is the '
            'distance from the separatrix.\n\n' + report.table(
                ('motion', 'm1', 'what', *(f'{span} s' for span in SENSITIVITY_SPANS)), lines))


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
        print(peer(name).label(setting), f'{time.perf_counter() - begin:.0f} s', flush=True)
        if isinstance(result, Outcome):
            lines.append((peer(name).label(setting), result.verdict, *['–'] * 6))
            continue
        curves[name, setting] = result
        reached = [np.maximum.accumulate(values)[[t * HOUR_RATE for t in CHECKPOINTS]]
                   for values in result]
        lines.append((peer(name).label(setting), *(report.number(value) for value in reached[0]),
                      *(report.number(values[-1]) for values in reached[1:])))
    draw(curves)
    heads = ('method', *(f'attitude, {t} s [rad]' for t in CHECKPOINTS), 'E/P', 'L3', 'Lz')
    return (f'The scene `cusp` at {HOUR_RATE} Hz; the last three columns are relative and over '
            'the whole hour.\n\n' + report.table(heads, lines)
            + '\n![Errors over an hour](stability.png)\n')


def draw(curves: dict[tuple[str, float], tuple[np.ndarray, ...]]) -> None:
    """Draw error and energy over time, with the slopes of the theory."""
    mpl.use('Agg')
    figure, panels = plt.subplots(1, 2, figsize=(13.5, 5.4))
    t = grid_ns(HOUR, HOUR_RATE)[1:] / 1e9
    at = np.unique(np.geomspace(1, len(t), 300).round().astype(int)) - 1
    slopes = ((2.0, 3e-8, 't²'), (1.0, 1e-12, 't')), ((1.0, 3e-9, 't'), (0.5, 3e-16, '√t'))
    titles = 'error of the attitude [rad]', 'error of the energy, of P'
    for column, (panel, lines) in enumerate(zip(panels, slopes, strict=True)):
        for number, ((name, setting), result) in enumerate(curves.items()):
            worst = np.maximum(np.maximum.accumulate(result[column][1:]), 1e-17)[at]
            panel.loglog(t[at], worst, label=peer(name).label(setting), color=f'C{number}')
        for power, start, text in lines:
            panel.loglog(t[[0, -1]], start * t[[0, -1]] ** power, ':', color='#888888')
            panel.text(t[-1], start * t[-1] ** power, f' {text}', color='#666666')
        panel.set(title=titles[column], xlabel='simulated time [s]')
        panel.grid(color='#DDDDDD', linewidth=0.6)
    panels[0].legend(fontsize=8, ncols=2)
    report.save(figure, 'stability.png')


if __name__ == '__main__':
    main()
