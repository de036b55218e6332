# SPDX-License-Identifier: Apache-2.0
"""
Which share of the spin the transport form should carry, and what projection and dense output do:

    PYTHONPATH=. python benchmark/gauge.py

Evaluations that an error takes, over c/L3 (spinning_top_sim/solvers/transport.py), errors with and
without the projection onto the invariants, and errors at the ends of steps and between them.
"""

from __future__ import annotations

import cmath
import math
import statistics

import numpy as np
import report
from cases import CUSP, HEAVY_TOP, LOOPING, NEAR_POLE, SLOW, TOY_60, TOY_200, Case, grid_ns
from peers import angles_between

from spinning_top_sim.physics import attitude
from spinning_top_sim.solvers.dormand_prince import Integrator, Vector
from spinning_top_sim.solvers.transport import TransportForm

CASES = (CUSP, TOY_60, TOY_200, LOOPING, SLOW, NEAR_POLE, HEAVY_TOP)
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
TARGET = 1e-8
TOLERANCES = tuple(10.0 ** -k for k in range(6, 13))
DEFAULT_TOLERANCE = 1e-11


class Unprojected(TransportForm):
    """The same equations, left to drift."""

    def project(self, y):
        return y


class OnlyNormalized(TransportForm):
    """The same equations with |q| = 1 restored, and nothing else."""

    def project(self, y):
        alpha, beta, m = y
        shrink = (attitude.squared_modulus(alpha) + attitude.squared_modulus(beta)) ** -0.5
        return alpha * shrink, beta * shrink, m


def main() -> None:
    parts = [report.preamble('Forms of the equations'),
             f'## The share of the spin that is carried\n\nEvaluations in 10 s for an error of '
             f'{TARGET:g} rad, over those at c = L3/2.  The worst of 640 samples counts; '
             f'between tolerances of {TOLERANCES[0]:g} to {TOLERANCES[-1]:g} the logarithms are '
             'interpolated.\n']
    rows, ratios = [], []
    for case in CASES:
        taken = [evaluations_for(case, share) for share in SHARES]
        rows.append((case.title, f'{taken[SHARES.index(0.5)]:.0f}',
                     *(f'{n / taken[SHARES.index(0.5)]:.2f}' for n in taken)))
        ratios.append([n / taken[SHARES.index(0.5)] for n in taken])
        print(rows[-1], flush=True)
    rows.append(('geometric mean', '', *(f'{math.exp(statistics.fmean(map(math.log, column))):.2f}'
                                         for column in zip(*ratios, strict=True))))
    parts.append(report.table(('case', 'evaluations, c = L3/2',
                               *(f'c = {share:g} L3' for share in SHARES)), rows))
    parts.append('## Projection\n\nLargest error [rad], and evaluations, at rtol '
                 f'{DEFAULT_TOLERANCE:g} and c = L3/2, with the projection onto |q| = 1, L3 and '
                 'the energy, with |q| = 1 alone, and with none.\n')
    rows = []
    for duration, rate in ((10, 64), (1000, 4)):
        for case in CASES:
            runs = [run(form(case.top, case.start, DEFAULT_TOLERANCE, 0.1 * DEFAULT_TOLERANCE),
                        case, duration, rate)
                    for form in (TransportForm, OnlyNormalized, Unprojected)]
            rows.append((case.title, f'{duration}',
                         *(f'{report.number(error)} / {count}' for error, count in runs),
                         report.number(runs[2][0] / runs[0][0])))
            print(rows[-1], flush=True)
    parts.append(report.table(('case', 'time [s]', 'projected', 'normalized', 'neither',
                               'error ratio'), rows))
    parts.append('## Between the steps\n\nLargest error [rad] over 10 s at rtol '
                 f'{DEFAULT_TOLERANCE:g}, at the ends of the steps and halfway between them, '
                 'there by the quintic\nHermite polynomial, or by the cubic one, which needs no '
                 'curvatures.\n')
    rows = [(case.title, *map(report.number, between_steps(case))) for case in CASES]
    parts.append(report.table(('case', 'ends', 'halfway, quintic', 'halfway, cubic'), rows))
    report.write('gauge.md', '\n'.join(parts))


def evaluations_for(case: Case, share: float) -> float:
    """Return how many evaluations an error of TARGET takes over 10 s."""
    runs = [run(TransportForm(case.top, case.start, rtol, 0.1 * rtol, share), case, 10, 64)
            for rtol in TOLERANCES]
    errors, counts = np.log(np.array(runs)).T
    order = np.argsort(errors)
    return float(np.exp(np.interp(np.log(TARGET), errors[order], counts[order])))


def between_steps(case: Case) -> tuple[float, ...]:
    """Return the largest errors at the ends of steps, halfway, and halfway by cubics."""
    form = TransportForm(case.top, case.start, DEFAULT_TOLERANCE, 0.1 * DEFAULT_TOLERANCE)
    integrator = Integrator(form, form.start, form.first_step)
    ends, middles = [], []
    found: tuple[list, ...] = [], [], []
    while integrator.newest.t1 < 10.0:
        step = integrator.step()
        h, middle = step.t1 - step.t0, 0.5 * (step.t0 + step.t1)
        slopes0, slopes1 = form.rates(*step.y0), form.rates(*step.y1)
        cubic = tuple(0.5 * (a + b) + 0.125 * h * (p - q) for a, b, p, q in zip(
            step.y0, step.y1, slopes0, slopes1, strict=True))
        ends.append(step.t1)
        middles.append(middle)
        for rows, y, t in zip(found, (step.y1, step.interpolate(middle), cubic),
                              (step.t1, middle, middle), strict=True):
            rows.append(attitude_of(form, y, t))
    return tuple(float(angles_between(np.array(rows), case.exact.quaternion(np.array(t))).max())
                 for rows, t in zip(found, (ends, middles, middles), strict=True))


def attitude_of(form: TransportForm, y: Vector, t: float) -> tuple[float, ...]:
    """Return x, y, z, w of the unknowns at t [s], projected, as the simulator reads them."""
    alpha, beta, _ = form.project(y)
    spin = cmath.rect(1.0, 0.5 * form.spin_rate * t)
    return attitude.quaternion(alpha * spin, beta * spin.conjugate())


def run(form: TransportForm, case: Case, duration: int, rate: int) -> tuple[float, int]:
    """Return the largest error of the attitude and the number of evaluations."""
    integrator = Integrator(form, form.start, form.first_step)
    ns = grid_ns(duration, rate)
    attitudes = []
    for t in (ns / 1e9).tolist():
        while integrator.newest.t1 < t:
            integrator.step()
        attitudes.append(attitude_of(form, integrator.newest.interpolate(t), t))
    truth = case.exact.states_at_ns(ns).quaternion
    return float(angles_between(np.array(attitudes), truth).max()), integrator.evaluations


if __name__ == '__main__':
    main()
