# SPDX-License-Identifier: Apache-2.0
"""
Fits the exact motion of a top to attitudes, and on request the place of an IMU.

A fit begins with a short part of the readings and goes on to longer ones, each as long as two of
the former, so that no phase is ever off by half a turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from spinning_top_sim.grade import guess
from spinning_top_sim.grade.problem import L3, TURN, P, UNKNOWNS, Problem, Readings, Reals
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution

FEWEST = 32                 # attitudes that can be fitted
FIRST = 16                  # attitudes of the first part
ENOUGH = 1500               # in a part, of which every k-th is taken
ONLY_START, ALL_MOTION = range(6), range(8)
TURNING = 5                 # the unknown omega_3
NAMES = ('theta', 'theta_dot', 'phi', 'psi', 'L3/lambda1', 'Lz/lambda1', 'lambda3/lambda1',
         'P/lambda1', 'mounting_x', 'mounting_y', 'mounting_z', 'lever_arm_x', 'lever_arm_y',
         'lever_arm_z', 'stamp_offset')
ANGLES = (0, 2, 3)          # of the names, those that are the same after a turn
# A residual at or below this [rad] needs no noise to explain it: quaternions in single precision.
EXACT = 1e-7
# Of a periodogram of noise: the strongest line over the mean exceeds ln(lines/0.001) once in 1000.
ONCE_IN = 1000.0
# A nutation below so many standard deviations of its amplitude may be noise.
SEEN = 6.0
# Unknown: an unknown, or a combination, that is uncertain by this share of its natural size.
VAGUE = 0.2
MOST_TRIALS = 8


@dataclass(frozen=True)
class Fit:
    """
    A fitted motion.

    Attributes
    ----------
    top, start : Top, State
        With lambda1 as given: poses tell ratios only.
    names : tuple of str
        Of what was fitted: angles [rad], rates [rad/s], P/lambda1 [1/s^2], lengths [m], offset
        of the stamps [s].
    values, deviations : (k,) array
        Estimates and standard deviations, inf where the readings do not tell the value.
    covariance : (k, k) array
    undetermined : tuple of str
        Combinations that the readings cannot tell apart.
    residual, noise : float
        Root mean square of a component of the attitude residual, and of its white part [rad].
    reached : bool
        Whether the residual is noise.  If not, the intervals mean nothing.
    """

    top: Top
    start: State
    names: tuple[str, ...]
    values: Reals
    deviations: Reals
    covariance: Reals
    undetermined: tuple[str, ...]
    residual: float
    noise: float
    reached: bool


class _Trial(NamedTuple):
    x: Reals
    cost: float             # of the residuals in units of `sigma` of the readings
    residual: float
    noise: float
    reached: bool


def fit(times: Reals, attitudes: Reals, *, rates: Reals | None = None, lambda1: float = 1.0,
        gravity: float = 9.80665) -> Fit:
    """
    Fit a top and its start to attitudes.

    Parameters
    ----------
    times : (n,) array
        Ascending [s]; the start is at t = 0.
    attitudes : (n, 4) array
        q(world <- body) as x, y, z, w, of either sign; the third axis is the axis of the top.
    rates : (n, 3) array, optional
        Angular velocities in the body [rad/s], of any accuracy: they tell how many whole turns
        the top makes between two attitudes.
    lambda1, gravity : float
        Scale of the inertia [kg m^2] and gravity [m/s^2], which no attitudes tell.

    Returns
    -------
    Fit

    Raises
    ------
    ValueError
        If there are fewer than FEWEST attitudes, or no motion of a top comes near them.
    """
    if len(times) < FEWEST:
        raise ValueError(f'{len(times)} attitudes: must be {FEWEST} at least for a fit')
    q = np.ascontiguousarray((attitudes / np.linalg.norm(attitudes, axis=1)[:, np.newaxis]).T)
    one = Readings('attitude', np.asarray(times, float), q)
    best: _Trial | None = None
    for trial in _trials(one, rates, gravity):
        if best is None or trial.cost < best.cost:
            best = trial
        if best.reached:
            break
    if best is None:
        raise ValueError('no motion of a top comes near these attitudes')
    if rates is None:
        _add_turns(best.x, one.times)
    sigma = max(best.residual, 1e-15)
    return _conclude(Problem([replace(one, sigma=sigma)], q[:, 0], gravity), best, lambda1,
                     gravity)


def _add_turns(x: Reals, times: Reals) -> None:
    """
    Make the spin the slowest with 0 < lambda3 <= 2 lambda1.

    A spin that is faster by whole turns between evenly spaced attitudes passes through all of
    them.
    """
    step = float(times[-1] - times[0]) / (len(times) - 1)
    if np.max(np.abs(np.diff(times) - step)) < 1e-5 * step and not (
            0.0 < x[L3] <= 2.02 * x[TURNING] or 0.0 > x[L3] >= 2.02 * x[TURNING]):
        sign, turn = math.copysign(1.0, x[L3]), math.tau / step
        least = 0.5 * abs(x[L3])
        x[TURNING] += sign * turn * math.ceil((least - sign * x[TURNING]) / turn)


def _trials(one: Readings, rates: Reals | None, gravity: float) -> Iterator[_Trial]:
    """Yield fits from one guess after another."""
    times, q = one.times, one.values
    axis = np.stack(attitude.axis_in_world(tuple(q)))
    hint = None if rates is None else float(np.median(rates[:, 2]))
    spin = guess.spin_rate(times, q, hint)
    weak = guess.weak(times, axis)
    small = list(guess.small_nutation(times, axis))
    seeds = [*weak[:1], *((0, *pair) for pair in small[:2]), *weak[1:3],
             *((0, *pair) for pair in small[2:])]
    for size, l3, p in seeds[:MOST_TRIALS]:
        x = np.zeros(UNKNOWNS)
        x[3:5] = guess.transverse_rates(times, q, axis)
        x[TURNING], x[L3], x[P] = spin, l3, p
        try:
            yield _fit_from(one, x, size, gravity)
        except ValueError:          # no motion begins so
            continue


def _fit_from(one: Readings, x: Reals, size: int, gravity: float) -> _Trial:
    """Fit longer and longer parts; with size = 0, L3 and P only when all is there."""
    problem = Problem([one], one.values[:, 0], gravity)
    count, last = FIRST, len(one.times)
    while count < last:
        free = ALL_MOTION if size and count > 2 * size else ONLY_START
        chosen = slice(0, count, math.ceil(count / ENOUGH))
        problem.readings = [replace(one, times=one.times[chosen], values=one.values[:, chosen])]
        x, _ = descend(problem, x, free, 8, 1e-3)
        count *= 2
    problem.readings = [one]
    x, cost = descend(problem, x, ALL_MOTION)
    rest = problem.residuals(x).reshape(3, -1)
    residual = math.sqrt(cost / max(rest.size - len(ALL_MOTION), 1))
    noise, white = whiteness(rest)
    return _Trial(x, cost, residual, noise, residual <= EXACT or (white and residual < 0.3))


def descend(problem: Problem, x: Reals, free: Sequence[int], evaluations: int = 30,
            tolerance: float = 1e-10) -> tuple[Reals, float]:
    """Return the unknowns at the least sum of squares, and that sum."""
    def at(y: Reals) -> Reals:
        moved = x.copy()
        moved[free] = y
        return moved

    def residuals(y: Reals) -> Reals:
        try:
            return problem.residuals(at(y))
        except ValueError:          # no motion begins so: a shorter step
            return far

    far = np.full(len(problem.residuals(x)), 1e9)
    found = least_squares(
        residuals, x[free], lambda y: problem.jacobian(at(y), free), method='lm', x_scale='jac',
        max_nfev=evaluations, ftol=tolerance, xtol=1e-15, gtol=1e-15)
    return at(found.x), 2.0 * float(found.cost)


def whiteness(rest: Reals) -> tuple[float, bool]:
    """Return the level of the white part of residuals (rows, n), and whether they are white."""
    power = np.abs(np.fft.rfft(rest, axis=1)[:, 1:]) ** 2 / rest.shape[1]
    level = float(np.median(power)) / math.log(2.0)
    lines = power / max(float(np.mean(power)), 1e-300)
    return math.sqrt(level), float(np.max(lines)) < math.log(ONCE_IN * power.size)


def _conclude(problem: Problem, trial: _Trial, lambda1: float, gravity: float) -> Fit:
    """Return the fit in public parameters, with what the readings do not tell."""
    x, free = trial.x, list(ALL_MOTION)
    sizes = _natural_sizes(x)[free]
    deviation = trial.residual * math.sqrt(2.0 / len(problem.readings[0].times))
    at = _without_unseen_nutation(problem, x, deviation)
    problem.jacobian(at, free)          # sets the steps
    jacobian = problem.jacobian(at, free, central=True) * sizes
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    told = singular > max(1.0 / VAGUE, (1e-9 if at is x else 1e-6) * singular[0])
    values, slopes = _public(problem, x), _slopes(problem, x, sizes) * sizes
    half = slopes @ (directions[told].T / singular[told])
    covariance = half @ half.T
    deviations = np.sqrt(np.diag(covariance))
    allowed = VAGUE * np.array([1.0, sizes[3], 1.0, 1.0, sizes[3], sizes[3], abs(values[6]),
                                sizes[P]])
    hidden = np.abs(slopes @ directions[~told].T) > 0.1 * allowed[:, np.newaxis]
    deviations[np.any(hidden, axis=1) | ~(deviations < allowed)] = math.inf
    return Fit(*_scaled(problem, x, lambda1, gravity), NAMES[:len(values)], values, deviations,
               covariance, tuple(_not_told(values, deviations, hidden)), trial.residual,
               trial.noise, trial.reached)


def _not_told(values: Reals, deviations: Reals, hidden: NDArray[np.bool_]) -> Iterator[str]:
    """Yield what the readings do not tell; `hidden`: the names of each combination (8, k)."""
    for column in hidden.T:
        yield f'a combination of {", ".join(NAMES[k] for k in np.flatnonzero(column))}'
    if np.all(np.isinf(deviations[[2, 3]])):
        yield f'phi and psi, but for their {"sum" if values[0] < 1.0 else "difference"}'
    if math.isinf(deviations[6]) and not np.any(hidden[6]):
        yield 'lambda3, because the top does not spin'
    if abs(values[P]) < 3.0 * deviations[P] < math.inf:
        yield 'mass and com_distance, because no torque acts'
    else:
        yield 'mass and com_distance, but for P = mass gravity com_distance'
    yield 'the scale of lambda1, lambda3, mass, L3 and Lz'


def _natural_sizes(x: Reals) -> Reals:
    """Return by how much each unknown changes the motion entirely."""
    rate = max(float(np.linalg.norm(x[3:6])), abs(float(x[L3])), math.sqrt(abs(float(x[P]))))
    return np.array([1.0] * 3 + [rate] * 4 + [rate * rate])


def _without_unseen_nutation(problem: Problem, x: Reals, deviation: float) -> Reals:
    """
    Return the steady or sleeping motion next to one whose nutation may be noise.

    deviation : of the amplitude of a nutation [rad]
    """
    motion = ExactSolution(*problem.start(x)[:2])
    low, high = motion.theta_min, motion.theta_max
    if high - low > 2.0 * SEEN * deviation:
        return x
    start, rate = motion.start, motion.mean_precession_rate
    theta = 0.5 * (low + high)
    if min(high, math.pi - low) < SEEN * deviation:
        theta, rate = (0.0 if high < 1.0 else math.pi), 0.0
    q = attitude.quaternion_of_angles(*(np.array([v]) for v in (start.phi, theta, start.psi)))
    x = x.copy()
    x[TURN] = problem.turn_to(q)
    vertical = attitude.vertical_in_body(q)
    x[3:5] = [rate * float(part[0]) for part in vertical[:2]]
    x[P] = x[L3] * rate - rate * rate * math.cos(theta)
    return x


def _public(problem: Problem, x: Reals) -> Reals:
    """Return the values of NAMES."""
    state = problem.start(x).state
    return np.array([state.theta, state.theta_dot, state.phi, state.psi, state.l3, state.lz,
                     state.l3 / (float(x[TURNING]) or 1e-300), x[P]])


def _slopes(problem: Problem, x: Reals, sizes: Reals) -> Reals:
    """Return the derivatives of the values of NAMES by the unknowns."""
    columns = []
    for k, size in enumerate(sizes):
        step = np.zeros(UNKNOWNS)
        step[k] = 1e-6 * size
        change = _public(problem, x + step) - _public(problem, x - step)
        turns = [2, 3]
        change[turns] = np.remainder(change[turns] + math.pi, math.tau) - math.pi
        columns.append(change / (2.0 * step[k]))
    return np.stack(columns, axis=1)


def _scaled(problem: Problem, x: Reals, lambda1: float, gravity: float) -> tuple[Top, State]:
    """Return top and start with this lambda1.  Raises ValueError if lambda3 would not be > 0."""
    state, p, gravity = problem.start(x).state, float(x[P]), gravity or 9.80665
    ratio = state.l3 / float(x[TURNING]) if x[TURNING] else 1.0
    ratio = ratio if ratio > 0.0 else 1.0
    distance = math.copysign(min(0.1, gravity / (4.0 * max(abs(p), 1e-9))), p)
    top = Top(lambda1=lambda1, lambda3=ratio * lambda1, gravity=gravity, com_distance=distance,
              mass=abs(p) * lambda1 / abs(gravity * distance))
    return top, replace(state, l3=state.l3 * lambda1, lz=state.lz * lambda1)
