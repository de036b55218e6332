# SPDX-License-Identifier: Apache-2.0
"""Samples of a motion as states, and what is measured from their attitude alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.times import Times

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

# Degree of the splines through the samples, and the number of samples in one.  In its middle, with
# 10 samples in a period, the error is 1e-13 of the amplitude.
DEGREE, WINDOW = 15, 64
LEAST_SAMPLES = 9.0         # in a nutation, for a spline as good as the data
RESTS = 1e-9                # a tilt that changes less does not nutate: rounding decides [rad]
LARGEST_STEP = 2.5          # between two samples of an angle that can be unwrapped [rad]
# Of samples: q(world <- body) as x, y, z, w; angular velocity in the body frame [rad/s]; phi and
# psi, which count turns [rad].  NaN: not known.
QUATERNION, RATES, TURNS, WIDTH = slice(0, 4), slice(4, 7), slice(7, 9), 9


class SampledStates(States):
    """
    States by samples, without forces; what follows from a rate that is not known is NaN.

    t : (n,) times [s]
    rows : (WIDTH, n) samples
    """

    method = 'samples'

    def __init__(self, top: Top, t: Column, rows: NDArray[np.float64]) -> None:
        super().__init__(top, State(theta=0.0, l3=0.0, lz=0.0), len(t))
        (x, y, z, w), (w1, w2, w3), self.turns = rows[QUATERNION], rows[RATES], rows[TURNS]
        self.t, self.rows_quaternion, self.transverse_velocity = t, (x, y, z, w), (w1, w2)
        self._constant_l3 = self.l3 = top.lambda3 * w3
        up_1, up_2, height = self.rows_vertical
        across = w1 * up_1 + w2 * up_2
        self.lz = top.lambda1 * across + self.l3 * height
        with np.errstate(divide='ignore', invalid='ignore'):        # at a pole
            self.phi_dot = across / (up_1 ** 2 + up_2 ** 2)


def attitudes_of(name: str, imu: Imu, stamps_ns: Times, fields: tuple[NDArray[np.float64], ...],
                 ) -> tuple[Times, NDArray[np.float64]]:
    """Return stamps (n,) and samples (WIDTH, n) in the decoded fields of a stream."""
    parts = [field.T for field in fields]
    rows = np.full((WIDTH, len(stamps_ns)), np.nan)
    if name == 'ground_truth/imu':
        rows[QUATERNION], rates = imu.mounting.to_body(tuple(parts[0]), tuple(parts[1]))
        if not imu.takes_means:         # else the rates are not those at the stamps
            rows[RATES] = rates
    elif name == 'joint_states':
        (phi, theta, psi), (phi_dot, theta_dot, psi_dot) = parts
        rows[QUATERNION] = attitude.quaternion_of_angles(phi, theta, psi)
        rows[RATES] = (*attitude.transverse(theta_dot, phi_dot * np.sin(theta), np.cos(psi),
                                            np.sin(psi)), psi_dot + phi_dot * np.cos(theta))
        rows[TURNS] = phi, psi
    else:           # position, attitude, and of ground_truth/odom velocity, rates
        rows[QUATERNION] = parts[1]
        rows[RATES] = parts[3] if len(parts) > 2 else np.nan
    norm = np.linalg.norm(rows[QUATERNION], axis=0)
    valid = np.isfinite(norm) & (norm > 0.0)
    rows[QUATERNION] /= np.where(valid, norm, 1.0)
    return stamps_ns[valid], rows[:, valid]


def longest_run(stamps_ns: Times) -> slice:
    """Return where the longest part is that has one rate and no gap."""
    steps = np.diff(stamps_ns)
    cuts = np.array([0, *(np.flatnonzero(np.diff(steps)) + 1), len(steps)])
    longest = int(np.argmax(np.diff(cuts)))
    return slice(cuts[longest], cuts[longest + 1] + 1)


@dataclass(frozen=True)
class Measured:
    """Numbers of `regimes.Description`, measured from samples."""

    samples: int
    nutations: int                        # whole ones
    nutation_period: float | None
    mean_precession_rate: float | None
    mean_spin_rate: float | None
    missing: str                          # why numbers are None


def measure(data: SampledStates, expected: float | None = None) -> Measured:
    """
    Measure a motion from two or more samples at one rate.

    expected : period of its nutation [s]: too few samples show a slower one

    A nutation lasts from one rise of the tip through its middle height to the next.  The tip is
    fastest there, and far from the poles, where phi may jump.
    """
    count, step = len(data), float(data.t[-1] - data.t[0]) / (len(data) - 1)
    nutations, period, begin, end, reason = 0, None, 0.0, count - 1.0, ''
    if np.ptp(data.theta_folded) >= RESTS:
        nutations, begin, end = _crossings(*data.half_angle_squares)
        period = (end - begin) / nutations * step if nutations else None
        in_one = min(period or math.inf, expected or math.inf) / step
        if in_one < LEAST_SAMPLES:
            reason = f'{in_one:.1f} samples in a nutation are too few'
        elif period is None:
            reason = 'not one whole nutation'
    (x, y, _), (up_1, up_2, _) = data.rows_axis, data.rows_vertical
    precession, spin = (None if reason else _mean_rate(turns, tip, begin, end, step)
                        for turns, tip in zip(data.turns, (x + 1j * y, -up_1 + 1j * up_2),
                                              strict=True))
    if not reason and None in (precession, spin):
        reason = 'phi or psi cannot be unwrapped: a pole, or too few samples in a turn'
    return Measured(count, nutations, None if reason else period, precession, spin, reason)


def _spline(values: NDArray[np.generic], index: float) -> BSpline:
    """Return a spline through the values (n,) around an index, as a function of the index."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415 - slow; --help needs none

    begin = max(0, min(int(index) - WINDOW // 2, len(values) - WINDOW))
    part = values[begin:begin + WINDOW]
    return make_interp_spline(np.arange(begin, begin + len(part)), part,
                              k=min(DEGREE, len(part) - 1))


def _crossings(cos2: Column, sin2: Column) -> tuple[int, float, float]:
    """Return the number of whole nutations, and the indices at which they begin and end."""
    from scipy.optimize import brentq  # noqa: PLC0415

    # Both rise with the axis; the smaller one has the digits of a small angle.
    values = -sin2 if np.mean(sin2) < 0.5 else cos2
    values = values - 0.5 * (float(np.min(values)) + float(np.max(values)))
    rising = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    if len(rising) < 2:
        return 0, 0.0, 0.0
    begin, end = (float(brentq(_spline(values, index), index, index + 1.0, xtol=1e-15,
                               rtol=1e-15)) for index in rising[[0, -1]])
    return len(rising) - 1, begin, end


def _mean_rate(turns: Column, tip: NDArray[np.complex128], begin: float, end: float,
               step: float) -> float | None:
    """Return the mean rate of phi or psi [rad/s] between two indices, None if unknown."""
    angle = turns
    if np.isnan(turns).any():
        angle = np.unwrap(np.angle(tip))
        if not tip.all() or np.max(np.abs(np.diff(angle))) > LARGEST_STEP:
            return None
    # The tip is smooth where the angle jumps at a pole, and slow without its mean rate.
    rate = (angle[-1] - angle[0]) / (len(angle) - 1)
    slow = tip * np.exp(-1j * rate * np.arange(len(angle)))
    at = np.array([begin, end])
    here = np.rint(at).astype(int)
    ends = np.array([_spline(slow, index)(index) for index in at])
    turned = angle[here] + rate * (at - here) + np.angle(ends * np.conj(slow[here]))
    return float((turned[1] - turned[0]) / ((end - begin) * step))
