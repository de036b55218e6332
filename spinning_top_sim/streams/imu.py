# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit: where it sits on the body, and what it adds to the truth.

Rates and specific force come from the state itself, never from differences; the errors follow
kalibr's model, with its names and units.  Conventions: REP-145
(at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import Columns

# Three, or four, numbers or columns of numbers.
Vector = tuple[Any, Any, Any]
Quaternion = tuple[Any, Any, Any, Any]
Matrix = tuple[Vector, Vector, Vector]
ZERO: Vector = (0.0, 0.0, 0.0)
NO_NOISE = 12 * (0.0,)


class Imu:
    """
    Where the IMU sits: at `imu.lever_arm` [m] and `imu.rpy` [rad] of the body frame.

    What it measures there is `true`; what it reads, `Sensor.read`.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: Vector = values['imu.lever_arm']
        self._turned = values['imu.rpy'] != ZERO
        self._to_sensor = _transposed(_rotation(*values['imu.rpy']))
        self._mounting = _quaternion(*values['imu.rpy'])

    def orientation(self, state: Columns) -> Any:
        """Return q(world <- IMU) as x, y, z, w: four numbers or columns, or (n, 4)."""
        if not self._turned:
            return state.quaternion
        return _product(attitude.quaternion(state.alpha, state.beta), self._mounting)

    def in_body(self, orientation: Quaternion, rates: Vector) -> tuple[Quaternion, Vector]:
        """Return attitude and rates of the body from those of the IMU."""
        if not self._turned:
            return orientation, rates
        x, y, z, w = self._mounting
        return (_product(orientation, (-x, -y, -z, w)),
                _apply(_transposed(self._to_sensor), rates))

    def true(self, state: Columns) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the IMU's frame."""
        rates = state.body_rates
        force = state.specific_force(self._lever_arm)
        if self._turned:
            return _apply(self._to_sensor, rates), _apply(self._to_sensor, force)
        return rates, force


@dataclass(frozen=True)
class Axes:
    """
    The errors of three axes of one kind, in samples `period` [s] apart.

    white: standard deviation of one sample's noise, density/sqrt(period)
    walk: of the bias' change from one sample to the next, random walk x sqrt(period)
    turn_on: of the bias at the start;  limit: largest reading, inf for none
    resolution: readings are multiples of this, 0 for any number
    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140)
    """

    white: float
    walk: float
    turn_on: float
    limit: float
    resolution: float

    @classmethod
    def of(cls, values: Mapping[str, Any], kind: str, period: float) -> Axes:
        """Return those of `imu.<kind>_...`."""
        return cls(white=values[f'imu.{kind}_noise_density'] / math.sqrt(period),
                   walk=values[f'imu.{kind}_random_walk'] * math.sqrt(period),
                   turn_on=values[f'imu.{kind}_turn_on_bias'],
                   limit=values[f'imu.{kind}_range'] or math.inf,
                   resolution=values[f'imu.{kind}_resolution'])

    @property
    def is_random(self) -> bool:
        """Whether anything is drawn."""
        return bool(self.white or self.walk or self.turn_on)

    @property
    def variance(self) -> float:
        """Of what is added to a sample besides the bias: white noise and rounding."""
        return self.white ** 2 + self.resolution ** 2 / 12.0

    def read(self, exact: Vector, white: Sequence[Any], bias: Sequence[Any],
             functions: Functions) -> Vector:
        """Return the readings: noise and bias added, cut at the range, rounded."""
        x, y, z = (functions.clip(value + noise + offset, -self.limit, self.limit)
                   for value, noise, offset in zip(exact, white, bias, strict=True))
        step = self.resolution
        if step:
            nearest = functions.round
            return nearest(x / step) * step, nearest(y / step) * step, nearest(z / step) * step
        return x, y, z


class Functions(NamedTuple):
    """What `Axes.read` takes from Python for one sample, from numpy for many."""

    clip: Callable[[Any, float, float], Any]
    round: Callable[[Any], Any]


ONE = Functions(lambda x, low, high: max(low, min(high, x)), round)
PERFECT = Axes(white=0.0, walk=0.0, turn_on=0.0, limit=math.inf, resolution=0.0)


class Sensor:
    """
    What the IMU reads at a rate: noise of sample k depends on the seed and on k alone.

    gyroscope, accelerometer: their `Axes`;  is_random: whether anything is drawn for them
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        period = period_ns * 1e-9
        self.gyroscope = Axes.of(values, 'gyroscope', period)
        self.accelerometer = Axes.of(values, 'accelerometer', period)
        self._perfect = self.gyroscope == self.accelerometer == PERFECT
        self._noise: Noise | None = None
        self.is_random = self.gyroscope.is_random or self.accelerometer.is_random
        if self.is_random:
            self._noise = Noise(values['seed'], self.gyroscope, self.accelerometer)

    def read(self, exact: tuple[Vector, Vector], index: int | range) -> tuple[Vector, Vector]:
        """Return the readings of rates [rad/s] and force [m/s^2] in sample `index`, or in many."""
        if self._perfect:
            return exact
        row, functions = self._drawn(index), ONE
        if isinstance(index, range):
            import numpy  # noqa: PLC0415
            # Nothing is -0 then, as with whole numbers.
            functions = Functions(numpy.clip, lambda x: numpy.rint(x) + 0.0)
        return (self.gyroscope.read(exact[0], row[0:3], row[6:9], functions),
                self.accelerometer.read(exact[1], row[3:6], row[9:12], functions))

    def bias(self, index: int | range) -> tuple[Sequence[Any], Sequence[Any]]:
        """Return the bias in sample `index`, or in many: [rad/s], [m/s^2]."""
        row = self._drawn(index)
        return tuple(row[6:9]), tuple(row[9:12])

    def _drawn(self, index: int | range) -> Sequence[Any]:
        if self._noise is None:
            return NO_NOISE
        if isinstance(index, range):
            return self._noise.samples(index)
        return self._noise.sample(index)


class Noise:
    """
    White noise and wandering bias of both kinds of axes, by sample number.

    Block b of 512 samples is drawn from a generator keyed by seed and b (Philox, counter-based:
    Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11), so that samples can be
    read from anywhere; the bias at the start of a block is the sum over the blocks before, at hand
    for the newest few: who goes further back begins from the start.
    """

    BLOCK = 512
    STARTS_KEPT = 4

    def __init__(self, seed: int, gyroscope: Axes, accelerometer: Axes) -> None:
        # 80 ms of numpy for those who want noise only.
        import numpy  # noqa: PLC0415

        self._numpy, self._seed = numpy, seed
        kinds = (gyroscope, accelerometer)
        self._white = numpy.repeat([kind.white for kind in kinds], 3)
        self._walk = numpy.repeat([kind.walk for kind in kinds], 3)
        # Where the bias of block b begins; that of block 0 is the turn-on bias.
        self._bias_starts = {0: numpy.repeat([kind.turn_on for kind in kinds], 3)
                                * self._normal(0, 6, turn_on=True)[0]}
        self._block = -1
        self._rows: list[list[float]] = []

    def sample(self, index: int) -> Sequence[float]:
        """Return white noise (rates, force) and bias (rates, force): 12 numbers."""
        block, row = divmod(index, self.BLOCK)
        if block != self._block:
            self._load(block)
        return self._rows[row]

    def samples(self, indices: range) -> Any:
        """Return the same of consecutive samples, (12, n)."""
        numpy = self._numpy
        first, last = indices[0] // self.BLOCK, indices[-1] // self.BLOCK
        drawn = numpy.vstack([numpy.hstack(self._drawn(block))
                              for block in range(first, last + 1)])
        begin = indices[0] - first * self.BLOCK
        return drawn[begin:begin + len(indices)].T

    def _load(self, block: int) -> None:
        self._rows = self._numpy.hstack(self._drawn(block)).tolist()
        self._block = block

    def _drawn(self, block: int) -> tuple[Any, Any]:
        """Return white noise and bias of a block, (512, 6) each, by way of those before it."""
        starts = self._bias_starts
        at = max(b for b in starts if b <= block)
        start = starts[at]
        while True:
            normal = self._normal(at, 12)
            steps = normal[:, 6:] * self._walk
            if at == 0:
                steps[0] = 0.0          # sample 0 has the turn-on bias itself
            bias = start + self._numpy.cumsum(steps, axis=0)
            at, start = at + 1, bias[-1].copy()         # not a view that keeps all
            if at > block:
                break
        starts[at] = starts.pop(at, start)
        if len(starts) > self.STARTS_KEPT:
            del starts[list(starts)[1]]                 # the oldest; that of block 0 stays
        return normal[:, :6] * self._white, bias

    def _normal(self, block: int, columns: int, turn_on: bool = False) -> Any:
        generator = self._numpy.random.Generator(self._numpy.random.Philox(
            key=self._seed, counter=[0, 0, int(turn_on), block]))
        return generator.standard_normal((1 if turn_on else self.BLOCK, columns))


def _rotation(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return R(body <- IMU) = Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return ((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr))


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the same rotation as x, y, z, w."""
    turns = [(math.sin(0.5 * angle), math.cos(0.5 * angle)) for angle in (roll, pitch, yaw)]
    (xr, wr), (yp, wp), (zy, wy) = turns
    return _product(_product((0.0, 0.0, zy, wy), (0.0, yp, 0.0, wp)), (xr, 0.0, 0.0, wr))


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    (a, b, c, d), (x, y, z, w) = p, q
    return (d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z)


def _transposed(m: Matrix) -> Matrix:
    (a, b, c), (d, e, f), (g, h, i) = m
    return (a, d, g), (b, e, h), (c, f, i)


def _apply(m: Matrix, v: Vector) -> Vector:
    x, y, z = v
    (a, b, c), (d, e, f), (g, h, i) = m
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)
