# SPDX-License-Identifier: Apache-2.0
"""
Measure the choice of c in the transport equations, the projection and the dense output:

    PYTHONPATH=. python benchmark/gauge.py

The tables have the evaluations for a given error over c/L3
(spinning_top_sim/solvers/equations.py), the errors with and without projection onto the
invariants, and the errors at the ends of steps and between them.
"""

from __future__ import annotations

import math
import statistics

import numpy as np
import report
from cases import CUSP, HEAVY_TOP, LOOPING, NEAR_POLE, SLOW, TOY_60, TOY_200, Case, grid_ns
from truth import angles_between

from spinning_top_sim.solvers.dormand_prince import Integrator, Interpolants, Step
from spinning_top_sim.solvers.equations import TransportEquations

CASES = (CUSP, TOY_60, TOY_200, LOOPING, SLOW, NEAR_POLE, HEAVY_TOP)
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
TARGET = 1e-8
TOLERANCES = tuple(10.0 ** -k for k in range(6, 13))
DEFAULT_TOLERANCE = 1e-11


class Unprojected(TransportEquations):
    """The same equations without projection."""

    def project(self, y):
        return y

    def project_columns(self, y):
        return y


class OnlyNormalized(TransportEquations):
    """The same equations with normalization of the quaternion only."""

    def project(self, y):
        alpha, beta, m = y
        shrink = 1.0 / math.hypot(alpha.real, alpha.imag, beta.real, beta.imag)
        return alpha * shrink, beta * shrink, m

    def project_columns(self, y):
        shrink = 1.0 / np.sqrt(sum(x * x for x in y[:4]))
        return *(x * shrink for x in y[:4]), *y[4:]


def main() -> None:
    parts = [report.preamble('Gauge, projection and dense output of rk45'),
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
            runs = [run(kind(case.top, case.start, DEFAULT_TOLERANCE, 0.1 * DEFAULT_TOLERANCE),
                        case, duration, rate)
                    for kind in (TransportEquations, OnlyNormalized, Unprojected)]
            rows.append((case.title, f'{duration}',
                         *(f'{report.number(error)} / {count}' for error, count in runs),
                         report.number(runs[2][0] / runs[0][0])))
            print(rows[-1], flush=True)
    parts.append(report.table(('case', 'time [s]', 'projected', 'normalized', 'none',
                               'error ratio'), rows))
    parts.append('## Between the steps\n\nLargest error [rad] over 10 s at rtol '
                 f'{DEFAULT_TOLERANCE:g}, at the ends of the steps and halfway between them, '
                 'there by the quintic\nHermite polynomial or by the cubic one, which needs no '
                 'second derivatives.\n')
    rows = [(case.title, *map(report.number, between_steps(case))) for case in CASES]
    parts.append(report.table(('case', 'ends', 'halfway, quintic', 'halfway, cubic'), rows))
    report.write('gauge.md', '\n'.join(parts))


def evaluations_for(case: Case, share: float) -> float:
    """Return how many evaluations an error of TARGET takes over 10 s."""
    runs = [run(TransportEquations(case.top, case.start, rtol, 0.1 * rtol, share), case, 10, 64)
            for rtol in TOLERANCES]
    errors, counts = np.log(np.array(runs)).T
    order = np.argsort(errors)
    return float(np.exp(np.interp(np.log(TARGET), errors[order], counts[order])))


def between_steps(case: Case) -> tuple[float, ...]:
    """Return the largest errors at the ends of steps, halfway, and halfway by cubics."""
    equations = TransportEquations(case.top, case.start, DEFAULT_TOLERANCE,
                                   0.1 * DEFAULT_TOLERANCE)
    steps = steps_to(10.0, Integrator(equations))
    begins, ends = np.array([step.t0 for step in steps]), np.array([step.t1 for step in steps])
    middles = 0.5 * (begins + ends)
    quintic = Interpolants(steps, equations).at(np.arange(len(steps)), middles)
    y0, y1 = (np.array([getattr(step, name) for step in steps]).T for name in ('y0', 'y1'))
    slopes0, slopes1 = (np.array(equations.derivative(*y)) for y in (y0, y1))
    cubic = 0.5 * (y0 + y1) + 0.125 * (ends - begins) * (slopes0 - slopes1)

    def real(y: np.ndarray) -> np.ndarray:          # (6, n) of complex (3, n)
        return np.stack((y.real, y.imag), axis=1).reshape(6, -1)
    return tuple(
        float(angles_between(attitudes_of(equations, rows, t),
                             case.exact.states_at_seconds(t).quaternion).max())
        for rows, t in ((real(y1), ends), (quintic, middles), (real(cubic), middles)))


def attitudes_of(equations: TransportEquations, rows: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return x, y, z, w (n, 4) of unknowns (6, n) at t [s], projected, as the simulator does."""
    a, a_imag, b, b_imag, _, _ = equations.project_columns(rows)
    spin = np.exp(0.5j * equations.spin_rate * t)
    alpha, beta = (a + 1j * a_imag) * spin, (b + 1j * b_imag) * spin.conjugate()
    return np.stack((-beta.imag, beta.real, alpha.imag, alpha.real), axis=1)


def steps_to(end: float, integrator: Integrator) -> list[Step]:
    """Take steps up to a time [s]."""
    steps = [integrator.newest]
    while integrator.newest.t1 < end:
        steps.append(integrator.step())
    return steps[1:]


def run(equations: TransportEquations, case: Case, duration: int, rate: int,
        ) -> tuple[float, int]:
    """Return the largest error of the attitude and the number of evaluations."""
    integrator = Integrator(equations)
    ns = grid_ns(duration, rate)
    t = ns / 1e9
    steps = steps_to(t[-1], integrator)
    numbers = np.searchsorted([step.t1 for step in steps], t)
    found = attitudes_of(equations, Interpolants(steps, equations).at(numbers, t), t)
    return (float(angles_between(found, case.exact.states(ns).quaternion).max()),
            integrator.evaluations)


if __name__ == '__main__':
    main()
