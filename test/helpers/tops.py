# SPDX-License-Identifier: Apache-2.0
"""Both solvers on random tops: what must hold for every one, with each bound and its reason."""

import collections
import math
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from helpers.random_tops import random_case
from spinning_top_sim import solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.solve import motion_of

LONG = np.longdouble
EPS = 2.0 ** -53
# Of |q|: the scale 1/sqrt(sum of squares) is off by 4 roundings at most, and each part by 3 more:
# its sine, and two products.
UNIT = 7.0 * EPS
# What `ExactSolution` promises of each column, over max(1, |value|).
EXACT = 5e-15
# Instants in nutation periods: anything but commensurable, and the start.
INSTANTS = np.array([0.0, 0.1371, 0.533, 0.981, 1.77, 2.9])
# More of them far away: the phase is then all there is to get wrong.
FAR = np.array([-1e9, -12345.678, -3.3, 1e3 + 0.1, 1e6 + 0.2, 1e9 + 0.3])
RTOL = 1e-9
SECONDS_PER_CASE = 20.0
BLOCK = 250
COLUMNS = ('quaternion', 'theta', 'theta_dot', 'phi', 'psi', 'phi_dot', 'psi_dot',
           'angular_velocity', 'angular_acceleration', 'energy')


class Findings:
    """What failed, and how often each check was made."""

    def __init__(self):
        self.failures, self.counts = [], collections.Counter()

    def check(self, case, name, value, bound):
        """Note whether value <= bound, which a NaN is not."""
        with np.errstate(invalid='ignore', divide='ignore'):
            ratios = np.where(value == 0.0, 0.0, np.asarray(value) / bound)
        ratio = float(np.max(np.where(np.isnan(ratios), np.inf, ratios), initial=0.0))
        self.counts[name] += 1
        if ratio > 1.0:
            self.failures.append(f'{name}: {ratio:.3g} times its bound: {case}')


@contextmanager
def time_limit(seconds):
    """Raise TimeoutError after so much processor time: a hang becomes a failure."""
    def stop(signum, frame):
        raise TimeoutError(f'not done after {seconds} s')
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def rate_around(top, start):
    """Return phi' sin(theta) [rad/s], (Lz - L3 cos(theta))/sin(theta) without cancellation."""
    theta, l3, lz = LONG(start.theta), LONG(start.l3), LONG(start.lz)
    c, s = np.cos(theta / 2), np.sin(theta / 2)
    numerator = (lz - l3) + 2 * l3 * s * s if s < c else (lz + l3) - 2 * l3 * c * c
    return numerator / (2 * s * c) / LONG(top.lambda1) if 0.0 < theta < math.pi else LONG(0)


def natural_rate(top, start):
    """Return the fastest rate of the axis [rad/s]: of momentum, of gravity, of itself."""
    return (math.hypot(start.l3 / top.lambda1, start.theta_dot, rate_around(top, start))
            + math.sqrt(abs(top.gravity_torque) / top.lambda1))


def period_of(solution):
    return solution.nutation_period or 2.0 * math.pi / (
        natural_rate(solution.top, solution.start) or 1.0)


def check_sound(found, case, motion, by=''):
    """No NaN, and unit quaternions, which are returned as x, y, z, w."""
    finite = all(np.all(np.isfinite(getattr(motion, name))) for name in COLUMNS)
    found.check(case, f'{by}finite', 0.0 if finite else math.inf, 1.0)
    x, y, z, w = motion.quaternion.T.astype(LONG)
    found.check(case, f'{by}|q| = 1', abs(np.sqrt(x * x + y * y + z * z + w * w) - 1), UNIT)
    return x, y, z, w


def check_columns(found, case, motion):
    """No NaN, unit quaternions, and the constants of the motion from attitude and rates alone."""
    top, start = case.top, case.start
    x, y, z, w = check_sound(found, case, motion)

    # An attitude off by 5e-15 turns L in the body by as much, and rates across, known from it and
    # L, are off by 5e-15 of |L|/lambda1; the energy has the square of the rates across, |L across|
    # times that, and the height of the axis.
    omega = motion.angular_velocity.T.astype(LONG)
    lambda1, lambda3 = LONG(top.lambda1), LONG(top.lambda3)
    torque = LONG(top.mass) * LONG(top.gravity) * LONG(top.com_distance)
    l3 = lambda3 * omega[2]
    across2 = lambda1 ** 2 * (omega[0] ** 2 + omega[1] ** 2)
    height = w * w + z * z - x * x - y * y
    lz = lambda1 * (omega[0] * 2 * (x * z - w * y) + omega[1] * 2 * (y * z + w * x)) + l3 * height
    largest2 = np.max(across2, initial=0)
    total = np.sqrt(largest2 + l3[:1] ** 2) if len(l3) else 0.0
    found.check(case, 'L3', abs(l3 - start.l3), 2.0 * EPS * abs(start.l3))
    found.check(case, 'Lz', abs(lz - start.lz), 2.0 * EXACT * total)
    energy_at_start = lambda1 / 2 * (LONG(start.theta_dot) ** 2 + rate_around(top, start) ** 2
                                     ) + torque * np.cos(LONG(start.theta))
    found.check(case, 'E', abs(across2 / (2 * lambda1) + torque * height - energy_at_start),
                2.0 * EXACT * (np.sqrt(largest2) * total / lambda1 + abs(torque))
                + (EXACT * total) ** 2 / lambda1)


def check_start(found, case, motion):
    """The first instant is 0: there the motion is the start itself."""
    start = case.start
    for name in ('theta', 'phi', 'psi'):
        wanted = getattr(start, name)
        found.check(case, f'start: {name}', abs(getattr(motion, name)[0] - wanted),
                    EXACT * max(1.0, abs(wanted)))
    found.check(case, 'start: theta_dot', abs(motion.theta_dot[0] - start.theta_dot),
                EXACT * natural_rate(case.top, start))


def check_derivatives(found, case, solution):
    """
    theta', phi' and psi' are what theta, phi and psi do: five-point differences.

    The step is 1/500 of the fastest time scale there, so what the formula leaves out, h^4/30 of
    the fifth derivative, is 1e-11 of a rate that is bounded by that scale; and rounding is
    EXACT max(1, |angle|) over h, 1.5 times.
    """
    period = period_of(solution)
    for at in (0.21, 1.43):
        now = solution.states_at_seconds(np.array([at * period]))
        sine = abs(math.sin(now.theta[0]))
        rate = (natural_rate(case.top, case.start) + abs(now.phi_dot[0]) + abs(now.psi_dot[0])
                + abs(now.theta_dot[0]) / sine if sine else 0.0)
        if not rate:
            continue
        t = at * period + np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * (0.002 / rate)
        if t[3] - t[1] < 1e4 * np.spacing(t[2]):
            continue
        h = 0.25 * (t[4] - t[0])
        uneven = np.abs(t - t[2] - h * np.arange(-2, 3)).max() / h
        near = solution.states_at_seconds(t)
        for name in ('theta', 'phi', 'psi'):
            angle = getattr(near, name)
            slope = (angle[0] - angle[4] + 8.0 * (angle[3] - angle[1])) / (12.0 * h)
            rounding = 1.5 * EXACT * max(1.0, abs(angle[2])) / h
            found.check(case, f"{name}' = d {name}/dt",
                        abs(slope - getattr(now, f'{name}_dot')[0]),
                        rounding + (1e-10 + 2.0 * uneven) * rate)


def growth_of(case, times):
    """Return how far exact solutions part, over how far apart they begin."""
    top, start, size = case.top, case.start, 1e-8
    unit, around = natural_rate(top, start), rate_around(top, start)
    middle, most = solve(top, start, times).quaternion, 1.0
    aside = size if start.theta < 1.5 else -size
    for tilt, faster, more in ((aside, 0.0, 0.0), (0.0, size, 0.0), (0.0, 0.0, size)):
        theta = start.theta + tilt
        if 0.0 < theta < math.pi:
            lz = start.l3 * np.cos(LONG(theta)) + LONG(top.lambda1) * (
                around + more * unit) * np.sin(LONG(theta))
            other = replace(start, theta=theta, theta_dot=start.theta_dot + faster * unit,
                            lz=float(lz))
            most = max(most, float(np.abs(
                solve(top, other, times).quaternion - middle).max()) / size)
    return most


def check_steps(found, case, solution, motion, times):
    """
    rk45 against the exact solution: every step's error is tolerated, and grows as neighbours do.

    A step's error is told by an estimate, and magnified where the nutation turns back; so the sum
    of all steps is taken to be within twenty times their count times the tolerance and the growth.
    """
    integration = motion_of(case.top, case.start, method='rk45', rtol=RTOL, atol=0.1 * RTOL)
    stepped = integration.states_at_seconds(times)
    check_sound(found, case, stepped, 'rk45: ')
    error = np.abs(stepped.quaternion - motion.quaternion).max(axis=1)
    bound = 20.0 * RTOL * (integration.steps + 1)
    if error.max() > bound:
        bound *= growth_of(case, times)
    if bound > 0.05:
        return
    found.check(case, 'rk45: q', error, bound)
    # In an angle, the same error over the sine of the tilt; angles within a turn's fraction.
    sine = np.sin(motion.theta_folded)
    told = sine > 20.0 * bound
    for name in ('theta', 'phi', 'psi'):
        angle = getattr(motion, name)[told]
        found.check(case, f'rk45: {name}', np.abs(getattr(stepped, name)[told] - angle),
                    4.0 * bound / sine[told] + EXACT * np.abs(angle))
    # Each nutation takes as many steps as its quickest part asks for, and near a separatrix it
    # takes longer the closer it is: K grows with ln(16/m1)/2.
    if solution.nutation_period and integration.steps:
        waiting = max(1.0, 0.5 * math.log(16.0 / max(solution.m1, 1e-300)))
        turned = natural_rate(case.top, case.start) * times[-1]
        found.check(case, 'rk45: evaluations', integration.evaluations,
                    200.0 + 60.0 * max(turned, 2.0 * math.pi * INSTANTS[-1] * waiting))


def check_block(seeds):
    """Make every check on these tops."""
    found = Findings()
    for seed in seeds:
        case = random_case(seed)
        try:
            with time_limit(SECONDS_PER_CASE):
                check_case(found, case)
        except Exception as error:      # whatever it is, it is the finding
            found.failures.append(f'{error!r}: {case}')
    return found


def check_case(found, case):
    solution = ExactSolution(case.top, case.start)
    period = period_of(solution)
    times, far = period * INSTANTS, period * FAR
    motion = solution.states_at_seconds(times)
    check_columns(found, case, motion)
    check_start(found, case, motion)
    check_derivatives(found, case, solution)
    check_columns(found, case, solution.states_at_seconds(
        far[np.abs(far) < solution.time_limit]))
    check_steps(found, case, solution, motion, times)


def blocks(count):
    return [range(at, min(at + BLOCK, count)) for at in range(0, count, BLOCK)]
