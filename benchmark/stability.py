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
from spinning_top_sim.times import NANOSECONDS

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
    ('exact', 0.0), ('rk45 transport', 1e-11), ('rk45 euler', 1e-11),
    ('SciPy RK45', 1e-6), ('SciPy DOP853', 1e-9), ('SciPy DOP853', 1e-12),
    ('SciPy LSODA', 1e-9), ('heyoka quadratic', 2.0 ** -52))
# Bounds of right attitudes and angles [rad]: a missed passage of a pole is an error of pi.
LOST_ATTITUDE, LOST_ANGLE = 0.01, 1.0

HOUR = 3600
HOUR_RATE = 16
CHECKPOINTS = (10, 100, 1000, 3600)
RUNNERS = (
    ('exact', 0.0), ('rk45 transport', 1e-11), ('rk45 transport', 1e-13),
    ('rk45 euler', 1e-11), ('SciPy RK45', 1e-6), ('SciPy DOP853', 1e-9),
    ('SciPy DOP853', 1e-12), ('heyoka quadratic', 2.0 ** -52))


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
        overview.append([case.title, *outcomes])
        print(case.title, outcomes, flush=True)
    labels = [peer(name).label(setting) for name, setting in METHODS]
    text += ['## Overview\n', report.table(('situation', *labels), overview)]
    text += ['## An hour of cusps\n', hour(options.hour_limit)]
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


def meet(case: Case, name: str, setting: float) -> str:
    """Let a method meet a situation; return the verdict."""
    method = peer(name)
    ns = grid_ns(DURATION, RATE)
    try:
        samples = method.ready(case, setting).samples(ns)
    except (FailedError, IntegrationError, ArithmeticError):
        return 'refused'
    if not np.all(np.isfinite(samples.quaternion)):
        return 'NaN'
    exact = case.exact.states(ns, NANOSECONDS)
    if name.startswith('exact'):
        if peer('heyoka quadratic').missing():
            return 'not judged'
        truth, every = long_attitudes(case, ns[::RATE]), RATE
    else:
        truth, every = exact.quaternion, 1
    if angles_between(samples.quaternion[::every], truth).max() > LOST_ATTITUDE:
        return 'wrong'
    if samples.phi is None:
        return 'right'
    differences = samples.phi - exact.phi, samples.psi - exact.psi
    if case.exact.theta_max < 1e-9:             # only the sum is defined
        differences = (differences[0] + differences[1],)
    elif case.exact.theta_min > math.pi - 1e-9:
        differences = (differences[0] - differences[1],)
    lost = max(float(np.abs(one).max()) for one in differences) > LOST_ANGLE
    return 'angles lost' if lost else 'right'


def in_child(run: Callable[..., Any], arguments: tuple[Any, ...], limit: float) -> Any:
    """Run in its own process, with a time limit; return a word where that gives no result."""
    if peer(arguments[1]).missing():
        return 'missing'
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
            return 'crashed'
    finally:
        process.kill()
        process.join()
    return 'hung'


def follow(case: Case, name: str, setting: float) -> tuple[np.ndarray, ...]:
    """Return the errors of the attitude, E, L3 and Lz over an hour, the last three relative."""
    ns = grid_ns(HOUR, HOUR_RATE)
    samples = peer(name).ready(case, setting).samples(ns)
    truth = case.exact.states(
        np.arange(0, int(ns[-1]) + 1, int(ns[1])), NANOSECONDS).quaternion
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
        if isinstance(result, str):
            lines.append((peer(name).label(setting), result, *['–'] * 6))
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
