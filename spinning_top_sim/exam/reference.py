# SPDX-License-Identifier: Apache-2.0
"""A filter without the faults that the exam looks for: it is what the exam itself is tested on."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam.scenarios import CALIBRATED, FIELD, GRAVITY, Reals

# A specific force whose size is this far from gravity [standard deviations] is no gravity.
LARGEST_DEVIATION = 5.0
# What is assumed of it then [m/s^2], and for how long [s].
DISTURBED, DISTURBED_S = 0.5 * GRAVITY, 2.0
UP = np.array((0.0, 0.0, GRAVITY))


class ReferenceFilter:
    """
    A multiplicative extended Kalman filter of attitude and bias (Markley 2003).

    The rates are integrated in closed form.  Specific force and field are compared with gravity
    and the known field; a force of another size than gravity is hardly believed.  The covariance
    is of the error's rotation vector in the frame of the sensor.

    Parameters
    ----------
    gyroscope_density : float
        Of its white noise [rad/s/sqrt(Hz)].
    accelerometer_density : float
        Of its white noise [m/s^2/sqrt(Hz)].
    field : tuple of three float
        In the world, east, north, up [T].
    field_density : float
        Of the white noise of the magnetometer [T/sqrt(Hz)].
    bias_stddev : float
        Standard deviation of the gyroscope's bias before it is estimated [rad/s].
    """

    is_gravity_trusted = False      # every specific force is taken for gravity

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
        """Of the rotation vector from the estimate to the truth, sensor frame (3, 3) [rad^2]."""
        covariance: Reals = self._p[:3, :3]
        return covariance

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """
        Take the readings of a step, as `Filter.update`.

        Parameters
        ----------
        gyroscope, accelerometer : (3,) array
            Mean angular velocity [rad/s], and specific force at the end [m/s^2].
        magnetometer : (3,) array or None
            Field at the end [T].
        dt : float
            Length of the step [s].

        Returns
        -------
        (4,) array
            q(world <- sensor) as x, y, z, w.
        """
        if not len(self._quaternion):
            self._quaternion = from_two_vectors(accelerometer, magnetometer)
        else:
            self.predict(gyroscope - self.bias, dt)
        gyroscope_density, accelerometer_density = self._densities
        variance = accelerometer_density ** 2 / dt
        deviation = abs(math.sqrt(accelerometer @ accelerometer) - GRAVITY)
        self._disturbed_s -= dt
        if deviation > LARGEST_DEVIATION * math.sqrt(variance) and not self.is_gravity_trusted:
            self._disturbed_s = DISTURBED_S
        if self._disturbed_s > 0.0:
            variance = DISTURBED ** 2
        pairs = [(accelerometer, UP, variance)]
        if magnetometer is not None:
            pairs.append((magnetometer, self._field, self._field_density ** 2 / dt))
        self._correct(pairs)
        return self._quaternion.copy()

    def predict(self, rates: Reals, dt: float) -> None:
        """Turn by the rates [rad/s] for dt [s]."""
        turn = rates * dt
        self._quaternion = self.integrate(self._quaternion, turn)
        transition = np.eye(6)
        transition[:3, :3] = matrix_of(exponential(-turn))
        transition[:3, 3:] = -dt * np.eye(3)
        self._p = transition @ self._p @ transition.T
        self._p[:3, :3] += self._densities[0] ** 2 * dt * np.eye(3)

    def integrate(self, quaternion: Reals, turn: Reals) -> Reals:
        """Return a quaternion after a turn by a rotation vector in the frame of the sensor."""
        return product(quaternion, exponential(turn))

    def _correct(self, pairs: Sequence[tuple[Reals, Reals, float]]) -> None:
        """Compare readings with the vectors in the world that they are of; each has a variance."""
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
        self._p = 0.5 * (p + p.T)       # else rounding makes it indefinite


def product(p: Reals, q: Reals) -> Reals:
    """Return the quaternion product p q, x, y, z, w, of norm 1."""
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
    """Return the matrix of a unit quaternion (3, 3)."""
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
    Return the attitude in which a vector points up, and the field has no east component (TRIAD).

    Without a field any heading will do.
    """
    z = up / np.linalg.norm(up)
    north = magnetometer if magnetometer is not None else np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(north, z)
    x /= np.linalg.norm(x)
    rows: NDArray[np.float64] = np.stack((x, np.cross(z, x), z))
    # Shepperd's method, by the largest of the four.
    squares = np.append(2.0 * np.diag(rows) - np.trace(rows), np.trace(rows))   # 4 q^2 - 1
    k = int(np.argmax(squares))
    odd = np.array((rows[2, 1] - rows[1, 2], rows[0, 2] - rows[2, 0], rows[1, 0] - rows[0, 1]))
    if k == 3:
        q = np.array((*odd, 1.0 + squares[3]))
    else:
        q = np.array((*(rows[k] + rows[:, k]), odd[k]))
        q[k] = 1.0 + squares[k]
    unit: Reals = q / np.linalg.norm(q)
    return unit
