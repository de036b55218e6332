# SPDX-License-Identifier: Apache-2.0
"""Error measures of an attitude filter; docs/exam.md has the definitions and their sources."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import gammainccinv, gammaincinv, ndtr, stdtrit

from spinning_top_sim.exam.scenarios import Reals, Run

CONVERGED_DEG = 1.0
CONSISTENT = 0.9999             # probability of the NEES band
TOLERATED = 1.1                 # factor by which a covariance may be wrong
WINDOW = 3.0                    # autocorrelation times over which correlations are summed


class Errors(NamedTuple):
    """
    Attitude errors [rad]: tilt (n,) >= 0, and heading (n,) in [-pi, pi].

    The methods take `absolute`: whether the heading is judged against north.
    """

    tilt: Reals
    heading: Reals

    def judged(self, absolute: bool) -> Reals:
        """Return tilt and heading error combined (n,), the tilt alone unless `absolute`."""
        return np.hypot(self.tilt, absolute * self.heading)

    def varying_heading(self, absolute: bool) -> Reals:
        """Return the heading error in [-pi, pi] (n,), relative to its mean unless `absolute`."""
        phase = np.exp(1j * self.heading)
        return self.heading if absolute else np.angle(phase * np.conj(np.mean(phase)))


def errors_of(estimates: Reals, truth: Reals) -> Errors:
    """
    Split q_est q_true^-1 into heading and tilt (Laidig et al. 2021, eq. 2-4).

    estimates, truth : q(world <- sensor) as x, y, z, w (n, 4)
    """
    x, y, z, w = (Rotation.from_quat(estimates) * Rotation.from_quat(truth).inv()).as_quat(
        canonical=True).T
    return Errors(2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w)), 2.0 * np.arctan2(z, w))


class Rmse(NamedTuple):
    """Root mean squares of the whole attitude error, of heading and of tilt [deg]."""

    total: float
    heading: float
    tilt: float


def rmse(estimates: Reals, truth: Reals) -> Rmse:
    """Return what BROAD's evaluation says of attitudes (n, 4); the heading is absolute."""
    total = (Rotation.from_quat(estimates) * Rotation.from_quat(truth).inv()).magnitude()
    errors = errors_of(estimates, truth)
    return Rmse(*(math.degrees(rms(one)) for one in (total, errors.heading, errors.tilt)))


def gyroscope_alone(run: Run, rows: slice | NDArray[np.intp]) -> Rmse:
    """Return the errors, to first order, of the gyroscope integrated from the truth."""
    apart = run.dt[:, np.newaxis] * run.gyroscope - increments(run.truth)
    error = np.cumsum(Rotation.from_quat(run.truth[1:]).apply(apart[1:]), axis=0)
    error = np.concatenate((np.zeros((1, 3)), error))[rows]
    return Rmse(*(math.degrees(rms(np.linalg.norm(part, axis=1)))
                  for part in (error, error[:, 2:], error[:, :2])))


def increments(quaternions: Reals) -> Reals:
    """Return the rotation vectors of the steps (n, 3) about axes of the sensor."""
    turns = Rotation.from_quat(quaternions)
    return np.concatenate((np.zeros((1, 3)), (turns[:-1].inv() * turns[1:]).as_rotvec()))


def rms(values: Reals) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def convergence_time(t: Reals, tilt: Reals) -> float:
    """Return the time [s] from which the tilt error stays below CONVERGED_DEG; inf if never."""
    above = np.flatnonzero(np.degrees(tilt) > CONVERGED_DEG)
    end = above[-1] + 1 if len(above) else 0
    return float(t[end]) if end < len(t) else math.inf


def convergence_order(rates: Sequence[float], errors: Sequence[float]) -> float:
    """Return p where errors fall as rate^-p; NaN for one rate or errors of rounding size."""
    if len(rates) < 2 or min(errors) < 1e-9:
        return math.nan
    return float(-np.polyfit(np.log(rates), np.log(errors), 1)[0])


class Offset(NamedTuple):
    """A constant time offset [s], and the rms error [rad] before and after its removal."""

    seconds: float
    before: float
    after: float


def time_offset(estimates: Reals, truth: Reals, rates: Reals, absolute: bool) -> Offset:
    """
    Fit the delay of the estimates by least squares.

    The model is e = -s w + h z, in the sensor frame: e is the rotation vector from truth to
    estimate, w the true angular velocity, s the delay, z the vertical and h a heading offset.

    rates : w (n, 3) [rad/s]
    absolute : True fixes h to 0; False is for a filter without a heading reference
    """
    true, est = Rotation.from_quat(truth), Rotation.from_quat(estimates)
    heading = errors_of(estimates, truth).heading
    mean = 0.0 if absolute else math.atan2(np.mean(np.sin(heading)), np.mean(np.cos(heading)))
    vector = (true.inv() * Rotation.from_rotvec((0.0, 0.0, -mean)) * est).as_rotvec().ravel()
    vertical = true.inv().apply((0.0, 0.0, 1.0)).ravel()
    matrix = np.stack((-rates.ravel(), vertical)[:2 - absolute], axis=1)
    found = np.linalg.lstsq(matrix, vector, rcond=None)[0]
    before, after = vector - matrix[:, 1:] @ found[1:], vector - matrix @ found
    return Offset(float(found[0]), math.sqrt(3.0) * rms(before), math.sqrt(3.0) * rms(after))


class Nees(NamedTuple):
    """Mean of the NEES divided by its expectation, and its degrees of freedom."""

    ratio: float
    degrees: float
    known: float        # degrees with which the variance of the mean is known; inf: exactly

    @property
    def band(self) -> tuple[float, float]:
        """
        The limits of a ratio that is right.

        A consistent ratio lies between them with the probability CONSISTENT; they are wider by
        the factor TOLERATED.
        """
        # Student's t for the estimate: as many standard deviations of a known chi-squared.
        tail, half = ndtr(-stdtrit(self.known, 0.5 + 0.5 * CONSISTENT)), 0.5 * self.degrees
        return (float(gammaincinv(half, tail) / half) / TOLERATED,
                float(gammainccinv(half, tail) / half) * TOLERATED)


def nees_of(runs: Sequence[tuple[Reals, Reals, Reals]], absolute: bool) -> Nees | None:
    """
    Return the NEES of the runs (Bar-Shalom et al. 2001, 5.4.2).

    The errors of a run are correlated: the number of independent tilts is smaller by the
    integrated autocorrelation time, which is long for errors that are constant in a run, such as
    that of a bias.  The heading changes so slowly that the attitudes of a run count as one.  The
    covariance may refer to the axes of the sensor or of the world: the assumption with the greater
    likelihood counts.

    runs : estimates (n, 4), truth (n, 4) and covariances (n, 3, 3) [rad^2] of each run
    absolute : False leaves out the heading

    Returns None if a covariance is singular, as that of a filter without heading.
    """
    dimensions, found = 2 + absolute, []
    for in_sensor in (True, False):
        try:
            parts = [_normalised_squares(*run, dimensions, in_sensor) for run in runs]
        except np.linalg.LinAlgError:
            continue
        shortest = min(len(squares) for squares, _ in parts)
        values = np.stack([squares[:shortest] for squares, _ in parts])
        mean = max(float(np.mean(values)), 1e-300)
        time = autocorrelation_time(values)
        independent, known = (len(runs), math.inf) if absolute else (
            values.size / time, values.size / (2.0 * WINDOW * time + 1.0))    # Sokal, sect. 3
        # Negative log-likelihood for the best common factor of the covariances.
        unlikely = dimensions * math.log(mean) + float(np.mean([size for _, size in parts]))
        found.append((unlikely, Nees(mean / dimensions, dimensions * independent, known)))
    return min(found)[1] if found else None


def _normalised_squares(estimates: Reals, truth: Reals, covariances: Reals, dimensions: int,
                        in_sensor: bool) -> tuple[Reals, float]:
    """Return e^T P^-1 e of the errors e (n,), and the mean log-determinant of P."""
    est = Rotation.from_quat(estimates)
    if in_sensor:
        turn = est.as_matrix()
        covariances = turn @ covariances @ turn.transpose(0, 2, 1)
    # The true vertical in the estimated world frame, and the small turn that takes z there.
    x, y, _ = (est * Rotation.from_quat(truth).inv()).apply((0.0, 0.0, 1.0)).T
    vector = np.stack((-y, x, -errors_of(estimates, truth).heading), axis=1)[:, :dimensions]
    covariances = covariances[:, :dimensions, :dimensions]
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    eigenvalues = np.linalg.eigvalsh(covariances)
    if np.any(eigenvalues[:, 0] <= 1e-12 * eigenvalues[:, -1]):
        raise np.linalg.LinAlgError('no inverse')
    solved = np.linalg.solve(covariances, vector[:, :, np.newaxis])[:, :, 0]
    return np.sum(vector * solved, axis=1), float(np.mean(np.sum(np.log(eigenvalues), axis=1)))


def autocorrelation_time(values: Reals) -> float:
    """
    Return the integrated autocorrelation time of rows (runs, n) [samples], at least 1.

    The sum ends at the first lag of at least WINDOW times its present value (Sokal 1997, sect. 3).
    """
    centred = values - np.mean(values)
    largest = float(np.max(np.abs(centred)))
    if not largest > 0.0:
        return 1.0
    n = values.shape[1]
    # Zero padding makes the circular correlation of the transform a linear one.
    power = np.mean(np.abs(np.fft.rfft(centred / largest, 2 * n)) ** 2, axis=0)     # no overflow
    correlations = np.fft.irfft(power)[:n] / np.arange(n, 0, -1)
    times = 2.0 * np.cumsum(correlations / correlations[0]) - 1.0
    ends = np.flatnonzero(np.arange(n) >= WINDOW * times)
    return max(float(times[ends[0] if len(ends) else -1]), 1.0)
