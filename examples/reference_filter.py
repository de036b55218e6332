# SPDX-License-Identifier: Apache-2.0
"""
An attitude filter that needs no settings: a filter to start from.

  spinning-top examine --filter examples/reference_filter.py:ReferenceFilter

finds no fault.
"""

import math

import numpy as np

from spinning_top_sim.exam.measures import from_two_vectors
from spinning_top_sim.exam.motions import GRAVITY, Reals
from spinning_top_sim.physics import attitude

# Initial standard deviations: attitude [rad], biases [rad/s], [m/s^2]; random walks of the biases.
START, GYROSCOPE_WALK, ACCELEROMETER_WALK = (0.5, 0.05, 0.1), 3e-5, 1e-5
# White densities: a first guess, and the least, of rates [rad/s/sqrt(Hz)], force, heading.
GUESSES, LEAST = (1e-4, 1e-3, 1.4e-3), (3e-6, 1e-4, 1e-4)
MEMORY_S, DISTURBED_MEMORY_S = 20.0, 60.0   # of noise and field
# A band-passed residual above LARGEST [m/s^2] is six times the noise of a poor accelerometer.
BAND_S, LARGEST, MOVING_S = 0.1, 0.03, 2.0
# Densities in motion: force [m/s^2/sqrt(Hz)], rates [rad/s/sqrt(Hz)].
MOVING_FORCE, MOVING_RATES = 0.3, 4e-3
TURNING = 0.5               # tells the accelerometer bias from a tilt [rad/s]
FIELD_S, DISTURBED = 1.0, 0.1   # low pass of the field [s], largest relative deviation
# At rest: duration [s], largest mean and change of the rates [rad/s], density with flicker.
REST_S, REST_MEAN, REST_CHANGE, REST_DENSITY = 1.5, 0.005, 0.035, 3e-3
# Fifth differences of white noise have the variance 252; they suppress the motion.
DIFFERENCES = np.array((1.0, -5.0, 10.0, -10.0, 5.0, -1.0)) / math.sqrt(252.0)
# Rows of the state that are corrected: all but the accelerometer bias, and not the tilt.
NO_FORCE_BIAS = np.repeat((1.0, 0.0), (6, 3))[:, np.newaxis]
HEADING_AND_RATES = np.repeat((0.0, 1.0, 0.0), (2, 4, 3))[:, np.newaxis]
RATES = np.eye(9)[3:6]


class _Variance:
    """A mean square over the last seconds."""

    def __init__(self, guess: float) -> None:
        self.value, self._seconds = guess, 0.1      # weight of the guess [s]

    def add(self, square: float, dt: float) -> float:
        """Return the mean with this square, at least a quarter of the square itself."""
        self._seconds = min(self._seconds + dt, MEMORY_S)
        self.value += dt / self._seconds * (square - self.value)
        return max(self.value, 0.25 * square)


class ReferenceFilter:
    """
    A Kalman filter of attitude, gyroscope and accelerometer bias that measures its own noise.

    bias : of the gyroscope (3,) [rad/s]
    """

    def __init__(self) -> None:
        self._quaternion, self._to_world = np.empty(0), np.eye(3)     # before the first update
        self._p = np.diag(np.repeat(np.square(START), 3))
        self.bias, self._force_bias, self._mean_rate, self._turn = np.zeros((4, 3))
        self._slow, self._slower = np.zeros((2, 3))                   # residual of the force
        rates, force, heading = np.square(GUESSES).tolist()
        self._rate_noise, self._force_noise, self._field_noise = map(
            _Variance, (rates, force / (4.0 * BAND_S), heading / (2.0 * FIELD_S)))
        self._readings = np.empty((6, 3))
        self._moving_s = self._disturbed_s = self._rest_s = self._field_s = 0.0
        self._field = self._deviation = 0j                            # horizontal + i vertical

    @property
    def covariance(self) -> Reals:
        """Covariance of the error's rotation vector in the sensor frame (3, 3) [rad^2]."""
        covariance: Reals = self._to_world.T @ self._p[:3, :3] @ self._to_world
        return covariance

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Take the readings of a step; return the attitude at its end; see `examine`."""
        if not len(self._quaternion):
            self._turn_to(from_two_vectors(accelerometer, magnetometer))
            self._readings[:] = gyroscope
        else:
            self._predict(gyroscope, dt)
            self._correct_tilt(gyroscope, accelerometer, dt)
            self._correct_at_rest(gyroscope - self.bias, dt)
            if magnetometer is not None:
                self._correct_heading(magnetometer, dt)
        return self._quaternion.copy()

    def _turn_to(self, quaternion: Reals) -> None:
        self._quaternion, self._to_world = quaternion, matrix_of(quaternion)

    def _predict(self, gyroscope: Reals, dt: float) -> None:
        """Advance by the mean rates of a step and of the one before, which show the coning."""
        last, self._turn = self._turn, (gyroscope - self.bias) * dt
        self._turn_to(product(self._quaternion, exponential(
            # The product of pure quaternions has the vector product.
            self._turn + np.array(attitude.product(
                (*last.tolist(), 0.0), (*self._turn.tolist(), 0.0))[:3]) / 12.0)))
        self._readings = np.concatenate((gyroscope[np.newaxis], self._readings[:-1]))
        change = DIFFERENCES @ self._readings
        density = max(self._rate_noise.add(float(change @ change) / 3.0 * dt, dt), LEAST[0] ** 2)
        density += (self._moving_s > 0.0) * MOVING_RATES ** 2
        effect = -dt * self._to_world
        self._p[:3] += effect @ self._p[3:6]
        self._p[:, :3] += self._p[:, 3:6] @ effect.T
        # The diagonal: attitude, gyroscope bias, accelerometer bias.
        self._p.flat[:30:10] += density * dt
        self._p.flat[30:60:10] += GYROSCOPE_WALK ** 2 * dt
        self._p.flat[60::10] += ACCELEROMETER_WALK ** 2 * dt

    def _correct_tilt(self, gyroscope: Reals, accelerometer: Reals, dt: float) -> None:
        residual = self._to_world @ (accelerometer - self._force_bias)
        residual[2] -= GRAVITY
        self._slow += dt / (BAND_S + dt) * (residual - self._slow)
        self._slower += dt / (BAND_S + dt) * (self._slow - self._slower)
        band = self._slow - self._slower
        square = float(band @ band) / 3.0
        self._moving_s -= dt
        bias_variance = np.trace(self._p[6:, 6:]) / 3.0
        if square > LARGEST ** 2 + bias_variance:
            self._moving_s = MOVING_S
        h = np.zeros((3, 9))
        h[0, 1], h[1, 0] = -GRAVITY, GRAVITY
        if self._moving_s > 0.0:
            self._correct(h, residual, MOVING_FORCE ** 2 / dt, NO_FORCE_BIAS)
            return
        h[:, 6:] = self._to_world
        turns, noise = gyroscope @ gyroscope > TURNING ** 2, self._force_noise
        # In turns, a bias that is not known yet shows in the band as well: it is no noise.
        variance = (max(noise.value, square) if turns and bias_variance > 4.0 * noise.value
                    else noise.add(square, dt))
        # Samples of a white density N leave 2 N^2 BAND_S^2 / (2 BAND_S + dt)^3 in the band.
        density = max((2.0 * BAND_S + dt) ** 3 / (2.0 * BAND_S ** 2) * variance, LEAST[1] ** 2)
        self._correct(h, residual, density / dt, 1.0 if turns else NO_FORCE_BIAS)

    def _correct_at_rest(self, rates: Reals, dt: float) -> None:
        self._mean_rate += dt / (0.5 + dt) * (rates - self._mean_rate)
        change = rates - self._mean_rate
        self._rest_s += dt
        if (self._moving_s > 0.0 or change @ change > REST_CHANGE ** 2
                or self._mean_rate @ self._mean_rate
                > REST_MEAN ** 2 + 9.0 * np.trace(self._p[3:6, 3:6])):
            self._rest_s = 0.0
        elif self._rest_s > REST_S:
            self._correct(RATES, rates, REST_DENSITY ** 2 / dt, NO_FORCE_BIAS)

    def _correct_heading(self, magnetometer: Reals, dt: float) -> None:
        east, north, up = (self._to_world @ magnetometer).tolist()
        field = complex(math.hypot(east, north), up)
        self._field = self._field or field
        deviation = field - self._field
        self._deviation += dt / (FIELD_S + dt) * (deviation - self._deviation)
        self._disturbed_s -= dt
        if abs(self._deviation) > DISTURBED * abs(self._field):
            self._disturbed_s = FIELD_S
        self._field_s = min(self._field_s + dt, MEMORY_S)
        self._field += deviation * dt / (
            DISTURBED_MEMORY_S if self._disturbed_s > 0.0 else self._field_s)
        horizontal = self._field.real
        if self._disturbed_s > 0.0 or not horizontal:
            return
        # East, unknown, deviates as the two other parts.  White noise leaves N^2/(2 FIELD_S + dt).
        density = max((2.0 * FIELD_S + dt) * self._field_noise.add(
            0.5 * (abs(self._deviation) / horizontal) ** 2, dt), LEAST[2] ** 2)
        h = np.zeros((1, 9))
        h[0, 1:3] = -self._field.imag / horizontal, 1.0
        residual = math.atan2(east, north)
        # A residual above three standard deviations has no greater effect than one of three.
        variance = max(density / dt, residual ** 2 / 9.0 - float((h @ self._p @ h.T)[0, 0]))
        self._correct(h, np.array((residual,)), variance, HEADING_AND_RATES)

    def _correct(self, h: Reals, residual: Reals, variance: float, rows: Reals | float) -> None:
        """Correct by a residual with H = h; `rows` (9, 1) are 0 for what is only considered."""
        with_residual = self._p @ h.T
        innovation = h @ with_residual
        innovation.flat[::len(h) + 1] += variance
        gain = rows * (with_residual @ np.linalg.inv(innovation))
        less = gain @ with_residual.T
        p = self._p + gain @ innovation @ gain.T - less - less.T
        self._p = 0.5 * (p + p.T)       # keeps it symmetric in spite of rounding
        change = gain @ residual
        self._turn_to(product(exponential(change[:3]), self._quaternion))
        self.bias = self.bias + change[3:6]
        self._force_bias = self._force_bias + change[6:]


def product(p: Reals, q: Reals) -> Reals:
    """Return the normalised quaternion product p q, as x, y, z, w."""
    x, y, z, w = attitude.product(p.tolist(), q.tolist())
    norm = math.hypot(x, y, z, w)
    return np.array((x / norm, y / norm, z / norm, w / norm))


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
