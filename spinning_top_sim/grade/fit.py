# SPDX-License-Identifier: Apache-2.0
"""
Fits the exact motion of a top to attitudes, and the place of an IMU to its readings.

A fit begins with a short part of the attitudes and goes on to longer ones, each three times as
long, so that no phase is ever off by half a turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import unknowns
from spinning_top_sim.grade.scenes import Reals, Start, rotation_of
from spinning_top_sim.grade.unknowns import L3, MOTION, SENSOR, SPIN, P, Problem, Samples, turned
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.verdict import number

FEWEST = 32                 # attitudes that can be fitted
GROWTH, LEAST_GROWTH = 3.0, 1.1     # of the parts
LOST = 0.05                 # residual of a part that is too long to begin with [rad]
TURN_AND_RATES = MOTION[:6]     # of the unknowns: without L3 and P
FIRST, ENOUGH = 16, 1500    # attitudes of the first part; in a longer one, every k-th is taken
# Unit of each value; the value has the natural size of a rate to this power.
NAMES = {'theta': ('rad', 0.0), 'theta_dot': ('rad/s', 1.0), 'phi': ('rad', 0.0),
         'psi': ('rad', 0.0), 'L3/lambda1': ('rad/s', 1.0), 'Lz/lambda1': ('rad/s', 1.0),
         'lambda3/lambda1': ('1', 0.0), 'P/lambda1': ('1/s^2', 2.0),
         **{f'mounting_{axis}': ('rad', 0.0) for axis in 'xyz'},
         **{f'lever_arm_{axis}': ('m', 0.0) for axis in 'xyz'}, 'stamp_offset': ('s', -1.0)}
# Of NAMES: the angles that may change by a turn, lambda3/lambda1, P/lambda1.
ANGLES, RATIO, TORQUE = (2, 3), 6, 7
EXACT = 1e-7                # residual that needs no noise: quaternions in single precision [rad]
NEGLIGIBLE = 1e-5           # of readings: errors of a simulator's steps
LARGEST = 0.3               # noise [rad]
ONCE_IN = 10000.0           # residuals of noise alone, one is judged not to be noise
SEEN = 6.0                  # standard deviations of its amplitude: a smaller nutation may be noise
STEP = 1e-6                 # of an unknown's natural size: for derivatives of the values
VAGUE = 0.2                 # of its natural size: an unknown is not told by the readings
INTERVAL = 1.96             # standard deviations: 95 %
OFF = 0.05                  # rad, and of the angle turned since: another start


@dataclass(frozen=True)
class Fit:
    """
    A fitted motion; `lines` tells it.

    Parameters
    ----------
    top, start : Top, State
        At the first attitude.  lambda1 is as given: attitudes tell ratios only.
    mounting, lever_arm : tuple of float
        Of the IMU, as `Body` has them.
    values, deviations : dict
        Estimates and standard deviations by the names of NAMES; inf where the readings do not
        tell the value.
    undetermined : tuple of str
        What the readings cannot tell apart.
    residual, noise : float
        Root mean square of a component of the attitude residual, and of its white part [rad].
    reached : bool
        Whether the fit has converged and the residuals are noise.  If not, the intervals mean
        nothing.
    """

    top: Top
    start: State
    mounting: tuple[float, float, float, float]
    lever_arm: tuple[float, float, float]
    values: Mapping[str, float]
    deviations: Mapping[str, float]
    undetermined: tuple[str, ...]
    residual: float
    noise: float
    reached: bool

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON can hold; null: not told by the readings."""
        return {'values': dict(self.values), 'undetermined': list(self.undetermined),
                'deviations': {name: number(value) for name, value in self.deviations.items()},
                'residual': self.residual, 'noise': self.noise, 'reached': self.reached}

    def lines(self) -> Iterator[str]:
        """Yield lines for a reader."""
        yield (f'fit: residual {self.residual:.3g} rad, noise {self.noise:.3g} rad' + (
            '' if self.reached else ': the residual is not noise, or the fit has not converged; '
            'what follows is of the nearest motion, and the intervals mean nothing'))
        for name, value in self.values.items():
            spread = INTERVAL * self.deviations[name]
            yield f'  {name:<16}{value:>16.9g} ' + (
                f'+- {spread:.2g} {NAMES[name][0]}' if math.isfinite(spread) else '(not told)')
        yield from (f'  the file does not tell {what}' for what in self.undetermined)


class _Guess(NamedTuple):
    l3: float
    p: float
    size: int = FIRST                   # attitudes of the first part
    free: Sequence[int] = MOTION        # unknowns that are fitted to all parts but the last


class _Trial(NamedTuple):
    problem: Problem
    x: Reals
    residual: float
    noise: float
    explained: bool                     # the residual is noise
    reached: bool                       # the same, and the fit has converged
    frozen: Sequence[int] = ()          # unknowns that the attitudes cannot tell


def fit(parts: Mapping[str, tuple[Reals, Reals]], *, lambda1: float = 1.0,
        gravity: float = 9.80665, imu: bool = False) -> Fit:
    """
    Fit a top and its start to attitudes, and on request the place of an IMU to its readings.

    Parameters
    ----------
    parts : mapping
        Times (n,), ascending [s], and values (n, k) by name, as of a `Trajectory`: `attitudes`,
        whose third axis is that of the top; `gyroscope` and `accelerations`; `rates` or
        `gyroscope` also tell how many whole turns the top makes between two attitudes.
    lambda1, gravity : float
        Scale of the inertia [kg m^2] and gravity [m/s^2], which attitudes do not tell.
    imu : bool
        Whether mounting, lever arm and offset of the stamps of the IMU are fitted.

    Raises
    ------
    ValueError
        If there are too few attitudes, or no readings.
    """
    times, attitudes = parts['attitudes']
    if len(times) < FEWEST:
        raise ValueError(f'{len(times)} attitudes: must be {FEWEST} at least for a fit')
    if not np.any(np.ptp(attitudes, axis=0)):
        raise ValueError('the attitude never changes: there is no motion to fit')
    turns = rotation_of(attitudes)
    samples = Samples('attitude', times - times[0], np.ascontiguousarray(turns.as_quat().T))
    told = parts.get('rates', parts.get('gyroscope'))
    spin, sure = unknowns.spin_rate(samples.times, samples.values,
                                    told and float(np.median(told[1][:, 2])))
    across = np.cross(*turns[:2].apply((0.0, 0.0, 1.0))) / samples.times[1]
    rates = (*turns[0].inv().apply(across)[:2], spin)
    small = [_Guess(l3, p, free=TURN_AND_RATES)
             for l3, p in unknowns.small_nutation(samples.times, samples.values)]
    trials: list[_Trial] = []
    for guess in _Guess(spin, 0.0), *small[:4], _Guess(spin, 0.0, 4 * FIRST):
        x = np.array((0.0, 0.0, 0.0, *rates, guess.l3, guess.p, *np.zeros(len(SENSOR))))
        trials.append(_fit_from(samples, x, guess.size, guess.free, gravity))
        if trials[-1].explained:
            break                               # another guess finds the same
    best = min(trials, key=lambda trial: trial.residual)
    if not sure:
        best.x[SPIN] += unknowns.turns_added(best.x, samples.times)
    best.problem.readings = [replace(samples, sigma=max(best.residual, 1e-15))]
    if best.reached:
        at, frozen = _without_unseen_nutation(best.problem, best.x, best.residual)
        free = [k for k in MOTION if k not in frozen]
        best = best._replace(frozen=frozen, x=_descend(best.problem, at, free)[0]
                             if frozen else best.x)
    if imu:
        best = _with_imu(best, parts)
    return _conclude(best, lambda1, gravity)


def state_of_known_top(found: Fit, parts: Mapping[str, tuple[Reals, Reals]], top: Top) -> State:
    """Return the start of a known top: the fitted one, or if none was found that of the begin."""
    if not found.reached:
        times, attitudes = parts['attitudes']
        found = fit({**parts, 'attitudes': (times[:4 * FIRST], attitudes[:4 * FIRST])})
    return replace(Start.of(found.top, found.start), state=None).state_of(top)


def far_start(parts: Mapping[str, tuple[Reals, Reals]], top: Top, start: State) -> str:
    """Return how far the first attitudes are from a motion, '' if they are near it."""
    times, attitudes = (part[:FIRST] for part in parts['attitudes'])
    right = ExactSolution(top, start).states_at_seconds(times)
    apart = (Rotation.from_quat(right.quaternion).inv()
             * rotation_of(attitudes)).magnitude()
    angle = np.linalg.norm(right.angular_velocity[0]) * (times - times[0])
    return '' if np.all(apart < OFF * (1.0 + angle)) else (
        f'at its begin the attitude is up to {math.degrees(np.max(apart)):.3g} deg off')


def _fit_from(samples: Samples, x: Reals, size: int, free: Sequence[int],
              gravity: float) -> _Trial:
    """Fit longer parts, from `size` attitudes on; before the last only the unknowns `free`."""
    problem = Problem([samples], samples.values[:, 0], gravity)
    done, growth, level, last = size / GROWTH, GROWTH, math.inf, len(samples.times)
    converged = False
    while done < last:
        count = min(math.ceil(done * growth), last)
        chosen = slice(0, count, math.ceil(count / ENOUGH) if count < last else 1)
        problem.readings = [replace(samples, times=samples.times[chosen],
                                    values=samples.values[:, chosen])]
        found, converged = (_descend(problem, x, MOTION) if count == last else
                            _descend(problem, x, free, 8, 1e-3))
        left = float(np.std(problem.residuals(found)))
        if left > max(LOST, 3.0 * level) and growth > LEAST_GROWTH:
            growth = math.sqrt(growth)
            continue
        x, done, level, growth = found, count, left, min(growth * growth, GROWTH)
        if left > LARGEST:          # no motion of a top
            break
    return _judged(problem, x, converged)


def _judged(problem: Problem, x: Reals, converged: bool, frozen: Sequence[int] = ()) -> _Trial:
    """Return unknowns with what the residuals show."""
    rests = [problem.residual(x, samples) for samples in problem.readings]
    levels, white = zip(*map(whiteness, rests), strict=True)
    small = [np.std(rest) < EXACT + NEGLIGIBLE * (samples.kind != 'attitude')
             * np.std(samples.values)
             for rest, samples in zip(rests, problem.readings, strict=True)]
    residual = math.sqrt(float(np.sum(rests[0] ** 2)) / (rests[0].size - len(MOTION)))
    explained = residual < LARGEST and all(np.logical_or(white, small))
    return _Trial(problem, x, residual, levels[0], explained,
                  explained and (converged or all(small)), frozen)


def _descend(problem: Problem, x: Reals, free: Sequence[int], evaluations: int = 30,
             tolerance: float = 1e-8) -> tuple[Reals, bool]:
    """Return the unknowns at the least sum of squares, and whether it was reached."""
    chosen = [*free]

    def at(y: Reals) -> Reals:
        moved = x.copy()
        moved[chosen] = y
        return moved

    found = least_squares(
        lambda y: problem.residuals(at(y)), x[chosen], lambda y: problem.jacobian(at(y), chosen),
        method='lm', x_scale='jac', max_nfev=evaluations, ftol=tolerance, xtol=1e-15, gtol=1e-15)
    return at(found.x), found.status > 0


def whiteness(rest: Reals) -> tuple[float, bool]:
    """Return the level of the white part of residuals (rows, n), and whether they are white."""
    n = rest.shape[1]
    # Without the mean and the Nyquist frequency, whose lines are real: their power scatters more.
    power = np.abs(np.fft.rfft(rest, axis=1)[:, 1:(n + 1) // 2]) ** 2 / n
    level = float(np.median(power)) / math.log(2.0)
    # A line of white noise exceeds the mean by the factor ln(lines/p) with the probability p.
    strongest = float(np.max(power)) / max(float(np.mean(power)), 1e-300)
    return math.sqrt(level), strongest < math.log(ONCE_IN * power.size)


def _with_imu(trial: _Trial, parts: Mapping[str, tuple[Reals, Reals]]) -> _Trial:
    """Fit the readings of an IMU, first with the motion as it is, then together."""
    problem, x, streams = trial.problem, trial.x, []
    for name, kind in (('gyroscope', 'rates'), ('accelerations', 'force')):
        if name not in parts:
            raise ValueError(f'the file has no {name}: the place of the IMU cannot be fitted')
        streams.append(Samples(kind, parts[name][0] - parts['attitudes'][0][0],
                               np.ascontiguousarray(parts[name][1].T)))
        streams[-1].sigma = float(np.std(streams[-1].values)) or 1.0
    (attitudes,), problem.readings = problem.readings, streams
    _, model = problem.motion(x, streams[0])
    problem.mounting = Rotation.align_vectors(model.T, streams[0].values.T)[0].as_quat()
    x, _ = _descend(problem, x, SENSOR)
    problem.readings = [attitudes, *streams]
    free = [k for k in (*MOTION, *SENSOR) if k not in trial.frozen]
    for _ in range(2):          # noise of each, then all with it
        for stream in problem.readings:
            stream.sigma = max(float(np.std(problem.residual(x, stream))), 1e-15)
        x, converged = _descend(problem, x, free)
    return _judged(problem, x, trial.reached and converged, trial.frozen)


def _conclude(trial: _Trial, lambda1: float, gravity: float) -> Fit:
    """Return the fit in public parameters, with what the readings do not tell."""
    problem, x = trial.problem, trial.x
    values, deviations, hidden = _deviations_of(problem, x, trial.residual)
    names = [*NAMES][:len(values)]
    top, start = _top_and_start(values, lambda1, gravity)
    mx, my, mz, mw = turned(problem.mounting, x[unknowns.MOUNTING]).as_quat().tolist()
    arm_x, arm_y, arm_z = x[unknowns.PLACE].tolist()
    return Fit(top, start, (mw, mx, my, mz), (arm_x, arm_y, arm_z),
               dict(zip(names, values.tolist(), strict=True)),
               dict(zip(names, deviations.tolist(), strict=True)),
               tuple(_not_told(names, values, deviations, hidden)), trial.residual, trial.noise,
               trial.reached)


def _deviations_of(problem: Problem, x: Reals,
                   residual: float) -> tuple[Reals, Reals, NDArray[np.bool_]]:
    """Return public values (k,), their deviations (k,), and what is not told apart (k, m)."""
    free = [*MOTION, *SENSOR] if len(problem.readings) > 1 else [*MOTION]
    rate = float(max(np.linalg.norm(x[unknowns.RATES]), abs(x[L3]), math.sqrt(abs(x[P]))))
    sizes = rate ** unknowns.RATE_POWERS[free]
    at, frozen = _without_unseen_nutation(problem, x, residual)
    problem.jacobian(at, free)          # sets the steps
    jacobian = problem.jacobian(at, free, central=True) * sizes
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    told = singular > max(1.0 / VAGUE, (1e-6 if frozen else 1e-9) * singular[0])
    values = _public(problem, x)[free]
    steps = STEP * sizes[:, np.newaxis] * np.eye(len(free), len(x))
    slopes = np.stack([(_public(problem, x + step) - _public(problem, x - step))[free]
                       for step in steps], axis=1)
    slopes[[*ANGLES]] = np.remainder(slopes[[*ANGLES]] + math.pi, math.tau) - math.pi
    slopes *= 0.5 / STEP
    half = slopes @ (directions[told].T / singular[told])
    deviations = np.sqrt(np.sum(half * half, axis=1))
    allowed = VAGUE * rate ** np.array([power for _, power in NAMES.values()])[free]
    allowed[RATIO] *= abs(values[RATIO])
    hidden = np.abs(slopes @ directions[~told].T) > 0.01 * allowed[:, np.newaxis]
    deviations[np.any(hidden, axis=1) | ~(deviations < allowed)] = math.inf
    return values, deviations, hidden


def _top_and_start(values: Reals, lambda1: float, gravity: float) -> tuple[Top, State]:
    theta, theta_dot, phi, psi, l3, lz, ratio, p = values[:8].tolist()
    # Of mass and com_distance only the product counts.
    distance = math.copysign(min(0.1, gravity / (4.0 * max(abs(p), 1e-9))), p) or 0.1
    top = Top(lambda1=lambda1, lambda3=(ratio if ratio > 0.0 else 1.0) * lambda1, gravity=gravity,
              com_distance=distance, mass=abs(p * lambda1 / (gravity or math.inf) / distance))
    return top, State(theta=theta, theta_dot=theta_dot, phi=phi, psi=psi, l3=l3 * lambda1,
                      lz=lz * lambda1)


def _not_told(names: Sequence[str], values: Reals, deviations: Reals,
              hidden: NDArray[np.bool_]) -> Iterator[str]:
    """Yield what the readings do not tell; `hidden`: the names of each combination (k, m)."""
    for column in hidden.T:
        several = [name for name, part in zip(names, column, strict=True) if part]
        yield f'{", ".join(several)}' + (' apart' if len(several) > 1 else '')
    if np.all(np.isinf(deviations[[*ANGLES]])):
        yield f'phi and psi, but for their {"sum" if values[0] < 1.0 else "difference"}'
    if math.isinf(deviations[RATIO]) and not np.any(hidden[RATIO]):
        yield 'lambda3, because the top does not spin'
    no_torque = abs(values[TORQUE]) < 3.0 * deviations[TORQUE] < math.inf
    yield 'mass and com_distance, ' + ('because no torque acts' if no_torque else
                                       'but for P = mass gravity com_distance')
    yield 'the scale of lambda1, lambda3, mass, L3 and Lz'


def _without_unseen_nutation(problem: Problem, x: Reals,
                             residual: float) -> tuple[Reals, tuple[int, ...]]:
    """
    Return x and (), or where the nutation may be noise, the nearest motion without it.

    That is steady or sleeping, with lambda3 = lambda1; the unknowns that it does not tell follow.
    """
    motion = ExactSolution(*problem.start(x))
    low, high = motion.theta_min, motion.theta_max
    small = SEEN * residual * math.sqrt(2.0 / len(problem.readings[0].times))
    if high - low > 2.0 * small:
        return x, ()
    start, rate, theta = motion.start, motion.mean_precession_rate, 0.5 * (low + high)
    upright = min(high, math.pi - low) < small
    if upright:
        theta, rate = (0.0 if high < 1.0 else math.pi), 0.0
    q = Rotation.from_euler('ZYZ', (start.phi, theta, start.psi))
    x = x.copy()
    x[unknowns.TURN] = (Rotation.from_quat(problem.reference).inv() * q).as_rotvec()
    x[unknowns.RATES] = (*(rate * q.inv().apply((0.0, 0.0, 1.0))[:2]), x[SPIN])
    x[L3] = x[SPIN]
    x[P] = x[L3] * rate - rate * rate * math.cos(theta)
    return x, (L3, P) if upright else (L3,)


def _public(problem: Problem, x: Reals) -> Reals:
    """Return the values of NAMES."""
    _, state = problem.start(x)
    mounting = turned(problem.mounting, x[unknowns.MOUNTING])
    return np.array([state.theta, state.theta_dot, state.phi, state.psi, state.l3, state.lz,
                     state.l3 / (float(x[SPIN]) or 1e-300), x[P], *mounting.as_rotvec(),
                     *x[unknowns.PLACE], x[unknowns.LATE]])
