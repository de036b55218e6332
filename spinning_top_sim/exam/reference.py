# SPDX-License-Identifier: Apache-2.0
"""A filter without the faults that the exam looks for, used to test the exam itself."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.scenarios import CALIBRATED, FIELD, GRAVITY, Reals

# A specific force whose norm differs from gravity by more standard deviations is not trusted.
LARGEST_DEVIATION = 5.0
# Its standard deviation is then assumed to be this [m/s^2], for so long [s].
DISTURBED, DISTURBED_S = 0.5 * GRAVITY, 2.0
UP = np.array((0.0, 0.0, GRAVITY))


class ReferenceFilter:
    """
    A multiplicative extended Kalman filter of attitude and bias (Markley 2003).

    The rates are integrated in closed form.  Specific force and magnetic field are compared with
    gravity and the known field; a force whose norm is not that of gravity has little weight.

    Parameters
    ----------
    gyroscope_density, accelerometer_density : float
        White noise [rad/s/sqrt(Hz)], [m/s^2/sqrt(Hz)].
    field : tuple of three float
        Magnetic field in the world: east, north, up [T].
    field_density : float
        White noise of the magnetometer [T/sqrt(Hz)].
    bias_stddev : float
        Initial standard deviation of the gyroscope bias [rad/s].
    """

    def __init__(self, gyroscope_density: float = CALIBRATED['imu.gyroscope_noise_density'],
                 accelerometer_density: float = CALIBRATED['imu.accelerometer_noise_density'],
                 field: tuple[float, float, float] = FIELD,
                 field_density: float = CALIBRATED['mag.noise_density'],
                 bias_stddev: float = 0.02) -> None:
        self._densities = gyroscope_density, accelerometer_density
        self._field, self._field_density = np.array(field), field_density
        self._quaternion = np.empty(0)      # before the first update
        self._p = np.diag([0.5 ** 2] * 3 + [bias_stddev ** 2] * 3)
        self._disturbed_s = 0.0
        self.bias = np.zeros(3)

    @property
    def covariance(self) -> Reals:
        """Covariance of the error's rotation vector in the sensor frame (3, 3) [rad^2]."""
        covariance: Reals = self._p[:3, :3]
        return covariance

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Take the readings of a step; return the attitude at its end; see `trial.Filter`."""
        if not len(self._quaternion):
            self._quaternion = from_two_vectors(accelerometer, magnetometer)
        else:
            self.predict(gyroscope - self.bias, dt)
        gyroscope_density, accelerometer_density = self._densities
        variance = accelerometer_density ** 2 / dt
        deviation = abs(math.sqrt(accelerometer @ accelerometer) - GRAVITY)
        self._disturbed_s -= dt
        if deviation > LARGEST_DEVIATION * math.sqrt(variance):
            self._disturbed_s = DISTURBED_S
        if self._disturbed_s > 0.0:
            variance = DISTURBED ** 2
        pairs = [(accelerometer, UP, variance)]
        if magnetometer is not None:
            pairs.append((magnetometer, self._field, self._field_density ** 2 / dt))
        self._correct(pairs)
        return self._quaternion.copy()

    def predict(self, rates: Reals, dt: float) -> None:
        """Advance by a rotation with constant rates [rad/s] for dt [s]."""
        turn = rates * dt
        self._quaternion = product(self._quaternion, exponential(turn))
        transition = np.eye(6)
        transition[:3, :3] = matrix_of(exponential(-turn))
        transition[:3, 3:] = -dt * np.eye(3)
        self._p = transition @ self._p @ transition.T
        self._p[:3, :3] += self._densities[0] ** 2 * dt * np.eye(3)

    def _correct(self, pairs: Sequence[tuple[Reals, Reals, float]]) -> None:
        """Correct by pairs of a reading and its vector in the world, each with its variance."""
        into_sensor = matrix_of(self._quaternion).T
        expected = [into_sensor @ world for _, world, _ in pairs]
        h = np.concatenate([_cross(vector) for vector in expected])
        residual = np.concatenate([reading for reading, _, _ in pairs]) - np.concatenate(expected)
        with_reading = self._p[:, :3] @ h.T
        innovation = h @ with_reading[:3]
        innovation.flat[::len(h) + 1] += np.repeat([variance for _, _, variance in pairs], 3)
        gain = with_reading @ np.linalg.inv(innovation)
        change = gain @ residual
        self._quaternion = product(self._quaternion, exponential(change[:3]))
        self.bias = self.bias + change[3:]
        p = self._p - gain @ with_reading.T
        self._p = 0.5 * (p + p.T)       # keeps it symmetric in spite of rounding


def product(p: Reals, q: Reals) -> Reals:
    """Return the normalised quaternion product p q, as x, y, z, w."""
    a, b, c, d = p.tolist()
    x, y, z, w = q.tolist()
    r = np.array((d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                  d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z))
    unit: Reals = r / math.sqrt(r @ r)
    return unit


def exponential(vector: Reals) -> Reals:
    """Return the quaternion of a rotation vector [rad]."""
    x, y, z = vector.tolist()
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    scale = 0.5 * math.sin(half) / half if half else 0.5
    return np.array((scale * x, scale * y, scale * z, math.cos(half)))


def matrix_of(quaternion: Reals) -> Reals:
    """Return the rotation matrix (3, 3) of a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return np.array((
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))))


def _cross(vector: Reals) -> Reals:
    x, y, z = vector.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def from_two_vectors(up: Reals, magnetometer: Reals | None) -> Reals:
    """
    Return the attitude in which `up` is vertical and the field has no east component (TRIAD).

    Without a field the heading is arbitrary.
    """
    z = up / np.linalg.norm(up)
    north = magnetometer if magnetometer is not None else np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(north, z)
    x /= np.linalg.norm(x)
    quaternion: Reals = Rotation.from_matrix(np.stack((x, np.cross(z, x), z))).as_quat()
    return quaternion
