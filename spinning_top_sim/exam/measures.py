# SPDX-License-Identifier: Apache-2.0
"""What is measured of an attitude filter; docs/exam.md has the definitions and their sources."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

Reals = NDArray[np.float64]
CONVERGED_DEG = 1.0


class Errors(NamedTuple):
    """Of attitudes: tilt (n,) >= 0, and heading (n,), continuous in time [rad]."""

    tilt: Reals
    heading: Reals

    def attitude(self, absolute: bool) -> Reals:
        """Return tilt and heading together (n,); without a reference, the heading's change."""
        return np.hypot(self.tilt, self.turned(absolute))

    def turned(self, absolute: bool) -> Reals:
        """Return the heading in [-pi, pi] (n,), relative to its mean unless it is absolute."""
        phase = np.exp(1j * self.heading)
        turned: Reals = np.angle(phase if absolute else phase * np.conj(np.mean(phase)))
        return turned


def errors_of(estimates: Reals, truth: Reals) -> Errors:
    """
    Split q_est q_true^-1 into a turn about the vertical and a tilt (Laidig et al. 2021, eq. 2-4).

    estimates, truth : q(world <- sensor) as x, y, z, w (n, 4)
    """
    x, y, z, w = (Rotation.from_quat(estimates) * Rotation.from_quat(truth).inv()).as_quat().T
    heading = np.unwrap(2.0 * np.arctan2(z, w))
    # Of equal headings that nearest to zero at the end.
    heading -= 2.0 * np.pi * np.rint(heading[-1] / (2.0 * np.pi))
    return Errors(2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w)), heading)


def rms(values: Reals) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def convergence_time(t: Reals, tilt: Reals) -> float:
    """Return when the tilt error falls below CONVERGED_DEG for good [s]; inf: never."""
    above = np.flatnonzero(np.degrees(tilt) > CONVERGED_DEG)
    end = above[-1] + 1 if len(above) else 0
    return float(t[end]) if end < len(t) else math.inf


def drift(t: Reals, heading: Reals) -> float:
    """Return the slope of the line of least squares [rad/s]."""
    return float(np.polyfit(t - t[0], heading, 1)[0])


def convergence_order(rates: Sequence[float], errors: Sequence[float]) -> float:
    """Return p of errors proportional to rate^-p; NaN for one rate or mere rounding."""
    if len(rates) < 2 or min(errors) < 1e-9:
        return math.nan
    return float(-np.polyfit(np.log(rates), np.log(errors), 1)[0])


def moved(estimates: Reals, truth: Reals) -> Reals:
    """
    Return the angles (n,) [rad] between attitudes after the first ones are turned into each other.

    For a filter that cannot know where it starts, this is the error of its integration.
    """
    est, true = Rotation.from_quat(estimates), Rotation.from_quat(truth)
    aligned: Reals = ((true[0] * est[0].inv()) * est * true.inv()).magnitude()
    return aligned


class Offset(NamedTuple):
    """A constant error in time [s], and the rms error [rad] before and after it is taken out."""

    seconds: float
    before: float
    after: float


def time_offset(estimates: Reals, truth: Reals, rates: Reals, absolute: bool) -> Offset:
    """
    Fit errors proportional to the angular velocity, as those of a wrong stamp are.

    The rotation vector e from truth to estimate, in the frame of the sensor, is fitted by
    e = -s w + h z: a delay s, and the heading h that a filter without reference may choose.

    rates : true angular velocity w in the frame of the sensor (n, 3) [rad/s]
    absolute : False lets the heading be free
    """
    true = Rotation.from_quat(truth)
    est = Rotation.from_quat(estimates)
    if not absolute:
        heading = errors_of(estimates, truth).heading
        mean = math.atan2(np.mean(np.sin(heading)), np.mean(np.cos(heading)))
        est = Rotation.from_rotvec((0.0, 0.0, -mean)) * est
    vector = (true.inv() * est).as_rotvec()
    columns = [-rates.ravel()]
    if not absolute:
        columns.append(true.inv().apply((0.0, 0.0, 1.0)).ravel())
    matrix = np.stack(columns, axis=1)
    found = np.linalg.lstsq(matrix, vector.ravel(), rcond=None)[0]
    rest = vector.ravel() - matrix @ found
    heading_only = vector.ravel() - (matrix[:, 1:] @ found[1:] if len(found) > 1 else 0.0)
    return Offset(float(found[0]), math.sqrt(3.0) * rms(heading_only), math.sqrt(3.0) * rms(rest))


class Nees(NamedTuple):
    """
    Normalised estimation error squared, divided by its expectation: 1 for a consistent filter.

    degrees : of freedom that the mean has, as many independent errors as there are in the runs
    """

    ratio: float
    degrees: float

    def band(self, probability: float = 0.95) -> tuple[float, float]:
        """Return where the ratio of a consistent filter is with this probability."""
        tail = 0.5 * (1.0 - probability)
        low, high = chi2.ppf((tail, 1.0 - tail), self.degrees) / self.degrees
        return float(low), float(high)


def nees_of(runs: Sequence[tuple[Reals, Reals, Reals]], absolute: bool) -> Nees | None:
    """
    Compare errors with the covariances that a filter states (Bar-Shalom et al. 2001, 5.4.2).

    Errors of one run are correlated.  Tilts count for fewer independent ones by the integrated
    autocorrelation time; the heading moves so slowly that attitudes of a run count as one.  The
    covariance may be about the axes of the sensor or of the world: what suits it better counts.

    runs : estimates (n, 4), truth (n, 4) and covariances (n, 3, 3) [rad^2] of each
    absolute : False leaves out the heading

    Returns None for covariances that cannot be inverted, as of a filter that knows no heading.
    """
    dimensions = 3 if absolute else 2
    found = []
    for in_sensor in (True, False):
        try:
            parts = [_normalised_squares(*run, absolute, in_sensor) for run in runs]
        except np.linalg.LinAlgError:
            continue
        shortest = min(len(squares) for squares, _ in parts)
        values = np.stack([squares[:shortest] for squares, _ in parts])
        mean = max(float(np.mean(values)), 1e-300)
        independent = len(runs) if absolute else values.size / autocorrelation_time(values)
        # The better axes have the greater likelihood, whatever factor the covariances are off by.
        unlikely = dimensions * math.log(mean) + float(np.mean([size for _, size in parts]))
        found.append((unlikely, Nees(mean / dimensions, dimensions * independent)))
    return min(found)[1] if found else None


def _normalised_squares(estimates: Reals, truth: Reals, covariances: Reals, absolute: bool,
                        in_sensor: bool) -> tuple[Reals, float]:
    """Return e^T P^-1 e of the errors (n,), and the mean logarithm of the determinant of P."""
    est, true = Rotation.from_quat(estimates), Rotation.from_quat(truth)
    if in_sensor:
        turn = est.as_matrix()
        covariances = turn @ covariances @ turn.transpose(0, 2, 1)
    if absolute:
        vector = (true * est.inv()).as_rotvec()
    else:
        # The true vertical in the world of the estimate, and the turn that takes z there.
        vertical = est.apply(true.inv().apply((0.0, 0.0, 1.0)))
        vector = np.stack((-vertical[:, 1], vertical[:, 0]), axis=1)
        covariances = covariances[:, :2, :2]
    eigenvalues = np.linalg.eigvalsh(covariances)
    if np.any(eigenvalues[:, 0] <= 1e-12 * eigenvalues[:, -1]):
        raise np.linalg.LinAlgError('no inverse')
    solved = np.linalg.solve(covariances, vector[:, :, np.newaxis])[:, :, 0]
    return np.sum(vector * solved, axis=1), float(np.mean(np.sum(np.log(eigenvalues), axis=1)))


def autocorrelation_time(values: Reals) -> float:
    """
    Return the integrated autocorrelation time of rows (runs, n), in samples, at least 1.

    The sum ends at the first lag of 5 such times (Sokal 1997, sect. 3).
    """
    centred = values - np.mean(values)
    largest = float(np.max(np.abs(centred)))
    if not largest > 0.0:
        return 1.0
    n = values.shape[1]
    # By a transform, since the sums take n^2; with zeros, else the end goes on with the begin.
    size = next_fast_len(2 * n - 1, real=True)
    power = np.mean(np.abs(rfft(centred / largest, size)) ** 2, axis=0)
    correlations = irfft(power, size)[:n] / np.arange(n, 0, -1)
    times = 2.0 * np.cumsum(correlations / correlations[0]) - 1.0
    ends = np.flatnonzero(np.arange(n) >= 5.0 * times)
    ends = ends[ends > 0]
    return max(float(times[ends[0] if len(ends) else -1]), 1.0)
