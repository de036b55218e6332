# SPDX-License-Identifier: Apache-2.0
"""
Both solvers on random tops: what must hold for every one of them, with each bound and its reason.

    python test/stress tops --count 100000 [--first SEED] [--processes N]

prints its progress and what failed; its exit code says whether.
"""

import collections
import math
import multiprocessing
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from helpers import taylor
from helpers.random_tops import random_case
from helpers.taylor import LONG

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.solvers.transport import NUTATION_SHARE

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
# Where the judge's own error is larger it says nothing.
JUDGE = 1e-9
SECONDS_PER_CASE = 20.0
BLOCK = 250                 # tops integrated together


class Findings:
    """What failed, and how often each check was made."""

    def __init__(self):
        self.failures, self.counts = [], collections.Counter()

    def check(self, case, name, value, bound):
        """Note whether value <= bound, which a NaN is not."""
        with np.errstate(invalid='ignore', divide='ignore'):
            ratios = np.where(value == 0.0, 0.0, np.asarray(value) / bound)
        ratio = float(np.max(np.where(np.isnan(ratios), np.inf, ratios), initial=0.0))
        self.count(name)
        if ratio > 1.0:
            self.failures.append(f'{name}: {ratio:.3g} times its bound: {case}')

    def count(self, name):
        self.counts[name] += 1


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


def rates_across(top, start):
    """Return theta' and phi' sin(theta) [rad/s]: how the axis moves."""
    around = taylor.around_the_axis(LONG(start.theta), LONG(start.l3), LONG(start.lz))
    return start.theta_dot, float(around / LONG(top.lambda1))


def natural_rate(top, start):
    """Return the fastest rate of the axis [rad/s]: of momentum, of gravity, of itself."""
    return (math.hypot(start.l3 / top.lambda1, *rates_across(top, start))
            + math.sqrt(abs(top.gravity_torque) / top.lambda1))


def period_of(solution):
    return solution.nutation_period or 2.0 * math.pi / (
        natural_rate(solution.top, solution.start) or 1.0)


COLUMNS = ('quaternion', 'theta', 'theta_dot', 'phi', 'psi', 'phi_dot', 'psi_dot',
           'angular_velocity', 'angular_acceleration', 'energy')


def check_columns(found, case, motion):
    """No NaN, unit quaternions, and the constants of the motion from attitude and rates alone."""
    top, start = case.top, case.start
    finite = all(np.all(np.isfinite(getattr(motion, name))) for name in COLUMNS)
    found.check(case, 'finite', 0.0 if finite else math.inf, 1.0)
    x, y, z, w = motion.quaternion.T.astype(LONG)
    found.check(case, '|q| = 1', abs(np.sqrt(x * x + y * y + z * z + w * w) - 1), UNIT)

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
    theta = LONG(start.theta)
    around = taylor.around_the_axis(theta, LONG(start.l3), LONG(start.lz))
    energy = across2 / (2 * lambda1) + torque * height
    energy_at_start = ((lambda1 * LONG(start.theta_dot)) ** 2 + around ** 2) / (
        2 * lambda1) + torque * np.cos(theta)
    found.check(case, 'E', abs(energy - energy_at_start),
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


def check_integrations(found, cases, motions, times):
    """
    The exact solution against an independent integration, within the integration's own error.

    That is told by two more, of longer steps, from starts 64 roundings away: more than the first
    one makes in its 100 steps or so.  Four times their distance is taken, and the largest so far:
    at an unstable pole they meet again, wherever they come from.
    """
    path = taylor.Path(cases, times, math.exp(-2.3))
    others = [taylor.Path(cases, times, math.exp(-2.0), 64.0, way) for way in (0, 1)]
    q, (theta, rate) = path.quaternions(), path.tilt()
    apart = np.max([np.abs(q - other.quaternions()) for other in others], axis=0)
    rate_apart = np.max([np.abs(rate - other.tilt()[1]) for other in others], axis=0)
    for i, (case, motion) in enumerate(zip(cases, motions, strict=True)):
        own = 4.0 * np.maximum.accumulate(apart[i].max(axis=1))
        # theta turns as far as the axis, twice as far as q; the direction of theta' turns with the
        # axis about the vertical.
        sine = np.sin(motion.theta)
        unit = natural_rate(case.top, case.start)
        with np.errstate(divide='ignore', invalid='ignore'):
            own_rate = 4.0 * rate_apart[i] + own * unit / np.abs(sine)
        told = own < JUDGE
        found.count('integrated' if told.all() else 'integrated, in part')
        found.check(case, 'integration: q', np.abs(motion.quaternion - q[i]).max(axis=1)[told],
                    (EXACT + own)[told])
        found.check(case, 'integration: theta', np.abs(motion.theta_folded - theta[i])[told],
                    (EXACT + 4.0 * own)[told])
        # Folded, theta' has the sign of sin(theta); at a pole it has none.
        told &= np.abs(sine) > 1e-9
        found.check(case, "integration: theta'",
                    np.abs(motion.theta_dot * np.sign(sine) - rate[i])[told],
                    (EXACT * unit + own_rate)[told])


MAGNIFIED = 'rk45: magnified where the nutation turns back'


def neighbours(top, start, size):
    """Return starts with the axis elsewhere or moving otherwise, by `size` in its own units."""
    rate, around = rates_across(top, start)
    unit = natural_rate(top, start)

    def neighbour(theta, theta_dot, around):
        lz = float(start.l3 * np.cos(LONG(theta))
                   + LONG(top.lambda1) * LONG(around) * np.sin(LONG(theta)))
        return replace(start, theta=theta, theta_dot=theta_dot, lz=lz)
    aside = start.theta + size if start.theta < 1.5 else start.theta - size
    yield neighbour(aside, rate, around)
    if 0.0 < start.theta < math.pi:
        yield neighbour(start.theta, rate + size * unit, around)
        yield neighbour(start.theta, rate, around + size * unit)


def state_of(case, motion, i):
    """Return the i-th state of a motion as a start, or None: at a pole rounding makes it none."""
    theta = motion.theta_folded[i]
    if not 1e-6 < theta < math.pi - 1e-6:
        return None
    turned = math.pi if math.sin(motion.theta[i]) < 0.0 else 0.0
    return State(theta=theta, theta_dot=motion.theta_dot[i] * (-1.0 if turned else 1.0),
                 phi=motion.phi[i] + turned, psi=motion.psi[i] - turned,
                 l3=case.start.l3, lz=case.start.lz)


def amplification(case, times, states):
    """Return how far neighbouring exact solutions part, over how far apart they were."""
    size, most = 1e-8, 1.0
    for begin, start in states:
        rest = times[times >= begin] - begin
        middle = solve(case.top, start, rest).quaternion
        for other in neighbours(case.top, start, size):
            apart = solve(case.top, other, rest).quaternion - middle
            most = max(most, float(np.abs(apart).max()) / size)
    return most


def check_steps(found, case, solution, motion, times):
    """
    rk45 against the exact solution: every step's error is tolerated, and grows as neighbours do.

    A step is accepted by an estimate of its error, which may be short by a factor of 2.  So the
    sum of all steps is within twice their count times the tolerance times the largest growth from
    any of them to the end, of which some are tried; the growth is 1 or more.
    """
    integration = motion_of(case.top, case.start, method='rk45', rtol=RTOL, atol=0.1 * RTOL)
    stepped = integration.states_at_seconds(times)
    finite = all(np.all(np.isfinite(getattr(stepped, name))) for name in COLUMNS)
    found.check(case, 'rk45: finite', 0.0 if finite else math.inf, 1.0)
    x, y, z, w = stepped.quaternion.T.astype(LONG)
    found.check(case, 'rk45: |q| = 1', abs(np.sqrt(x * x + y * y + z * z + w * w) - 1), UNIT)
    tolerated = 2.0 * RTOL * (integration.steps + 1)
    error = np.abs(stepped.quaternion - motion.quaternion).max(axis=1)
    growth = 1.0
    if error.max() > tolerated:
        states = [(0.0, case.start)]
        for i in (1, 2, 3):
            start = state_of(case, motion, i)
            if start is not None:
                states.append((times[i], start))
        growth = amplification(case, times, states)
    bound = tolerated * growth
    if bound > 0.05:
        found.count('rk45: too sensitive')
        return
    if bound < error.max():
        # Where the nutation turns back the energy tells little of its rate: what is wrong with
        # one step there counts up to 1/(2 sqrt(NUTATION_SHARE)) times.  Rare, so it is counted.
        turns = 2.0 * math.ceil(INSTANTS[-1])
        magnified = RTOL * growth * turns / (2.0 * math.sqrt(NUTATION_SHARE))
        if error.max() <= bound + magnified:
            found.count(MAGNIFIED)
            bound += magnified
    found.check(case, 'rk45: q', error, bound)
    # In an angle, the same error over the sine of the tilt; angles within a turn's fraction.
    sine = np.sin(motion.theta_folded)
    told = sine > 20.0 * bound
    sine = np.where(told, sine, 1.0)
    for name in ('theta', 'phi', 'psi'):
        found.check(case, f'rk45: {name}',
                    np.abs(getattr(stepped, name) - getattr(motion, name))[told],
                    (4.0 * bound / sine + EXACT * np.abs(getattr(motion, name)))[told])
    # Each nutation takes as many steps as its quickest part asks for, and near a separatrix it
    # takes longer the closer it is: K grows with ln(16/m1)/2.
    if solution.nutation_period and integration.steps:
        waiting = max(1.0, 0.5 * math.log(16.0 / max(solution.m1, 1e-300)))
        turned = natural_rate(case.top, case.start) * times[-1]
        found.check(case, 'rk45: evaluations', integration.evaluations,
                    200.0 + 60.0 * max(turned, 2.0 * math.pi * INSTANTS[-1] * waiting))


def check_symmetries(found, case, motion, times):
    """Motions that must be the same but for a rotation, a mirror, a direction or a scale."""
    top, start = case.top, case.start

    def compare(name, other, pairs):
        for column, wanted in pairs.items():
            got = getattr(other, column)
            scale = (natural_rate(top, start) if column == 'theta_dot'
                     else np.maximum(1.0, np.maximum(np.abs(got), np.abs(wanted))))
            found.check(case, f'{name}: {column}', np.abs(got - wanted), 2.0 * EXACT * scale)

    angles = {name: getattr(motion, name) for name in ('theta', 'theta_dot', 'phi', 'psi')}
    turned = replace(start, phi=start.phi + 0.75, psi=start.psi - 1.25)
    compare('turned', solve(top, turned, times), {
        **angles, 'phi': motion.phi + (turned.phi - start.phi),
        'psi': motion.psi + (turned.psi - start.psi)})
    mirrored = replace(start, phi=-start.phi, psi=-start.psi, l3=-start.l3, lz=-start.lz)
    compare('mirrored', solve(top, mirrored, times), {
        **angles, 'phi': -motion.phi, 'psi': -motion.psi})
    backward = replace(start, theta_dot=-start.theta_dot, l3=-start.l3, lz=-start.lz)
    compare('backward', solve(top, backward, -times), {**angles, 'theta_dot': -motion.theta_dot})
    # Powers of two scale without rounding.
    heavier = Top(lambda1=8.0 * top.lambda1, lambda3=8.0 * top.lambda3, mass=8.0 * top.mass,
                  com_distance=top.com_distance, gravity=top.gravity)
    compare('heavier', solve(heavier, replace(start, l3=8.0 * start.l3, lz=8.0 * start.lz),
                             times), angles)
    faster = replace(top, gravity=16.0 * top.gravity)
    quick = replace(start, theta_dot=4.0 * start.theta_dot, l3=4.0 * start.l3, lz=4.0 * start.lz)
    other = solve(faster, quick, 0.25 * times)
    compare('faster', other, {'theta': motion.theta, 'phi': motion.phi, 'psi': motion.psi})
    found.check(case, "faster: theta'", np.abs(0.25 * other.theta_dot - motion.theta_dot),
                2.0 * EXACT * natural_rate(top, start))


def check_block(seeds):
    """Make every check on these tops."""
    found = Findings()
    cases, motions, times = [], [], []
    for seed in seeds:
        case = random_case(seed)
        try:
            with time_limit(SECONDS_PER_CASE):
                solution = ExactSolution(case.top, case.start)
                span = period_of(solution) * INSTANTS
                motion = solution.states_at_seconds(span)
                check_case(found, case, solution, motion, span)
        except Exception as error:      # whatever it is, it is the finding
            found.failures.append(f'{error!r}: {case}')
            continue
        cases.append(case)
        motions.append(motion)
        times.append(span)
    if cases:
        check_integrations(found, cases, motions, np.array(times))
    return found


def check_case(found, case, solution, motion, times):
    check_columns(found, case, motion)
    check_start(found, case, motion)
    check_derivatives(found, case, solution)
    far = FAR * period_of(solution)
    far = far[np.abs(far) < solution.time_limit]
    check_columns(found, case, solution.states_at_seconds(far))
    check_symmetries(found, case, motion, times)
    check_steps(found, case, solution, motion, times)


def blocks(first, count):
    return [range(at, min(at + BLOCK, first + count)) for at in range(first, first + count, BLOCK)]


def stress(first, count, processes=None):
    """Check so many tops; return the exit code."""
    failures, counts, work = 0, collections.Counter(), blocks(first, count)
    with multiprocessing.Pool(processes) as pool:
        for done, part in enumerate(pool.imap_unordered(check_block, work), start=1):
            failures += len(part.failures)
            counts += part.counts
            for failure in part.failures:
                print(f'\r{failure}', flush=True)
            print(f'\r{min(done * BLOCK, count)} of {count} tops, {failures} failures ', end='',
                  flush=True)
    print(*(f'{name}: {number}' for name, number in counts.items()), sep='\n')
    if counts[MAGNIFIED] > 2 + count / 10_000:
        print(f'too often: {MAGNIFIED}')
        return 1
    return 1 if failures else 0
