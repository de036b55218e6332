# SPDX-License-Identifier: Apache-2.0
"""Measures a motion from samples of the attitude alone; `survey` selects them from a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.top import Top
from spinning_top_sim.streams.imu import Imu

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

# Degree of the splines through the samples, and the number of samples in one.  In its middle, with
# 10 samples in a period, the error is 1e-13 of the amplitude.
DEGREE, WINDOW = 15, 64
LEAST_SAMPLES = 9.0         # in a nutation, for a spline as good as the data
RESTS = 1e-9                # a tilt that changes less does not nutate: rounding decides [rad]
LARGEST_STEP = 2.5          # between two samples of an angle that can be unwrapped [rad]
RATES, TURNS = slice(4, 7), slice(7, 10)        # of the rows of Attitudes


class Attitudes:
    """
    Samples of the attitude of the body in the order of time, and what follows from each.

    stamps_ns : (n,) log times [ns]
    rows : (4, n) q(world <- body) as x, y, z, w; then, if the log has them, (3, n) angular
        velocity in the body frame [rad/s]; then, if the log has them, phi and psi, which count
        turns, and phi'
    cos2, sin2 : (n,) squares of the cosine and sine of theta/2; near a pole the smaller one has
        more digits
    tip, body_tip : (n,) sin(theta) exp(i phi) and sin(theta) exp(i psi)
    """

    def __init__(self, stamps_ns: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
        self.stamps_ns, self.rows = stamps_ns, rows
        self.time = (stamps_ns - stamps_ns[:1]) * 1e-9
        self.period = float(np.max(self.time, initial=0.0)) / max(len(stamps_ns) - 1, 1)
        x, y, z, w = self.quaternion = tuple(rows[:4])
        self.cos2, self.sin2 = w * w + z * z, x * x + y * y
        tip_x, tip_y, self.height = attitude.axis_in_world(self.quaternion)
        up_1, up_2, _ = self.up = attitude.vertical_in_body(self.quaternion)
        self.tip, self.body_tip = tip_x + 1j * tip_y, -up_1 + 1j * up_2
        self.omega = tuple(rows[RATES]) or None
        self.phi_dot = None
        if self.omega is not None:
            one, two, _ = self.omega
            with np.errstate(invalid='ignore'):     # NaN at a pole
                self.phi_dot = (one * up_1 + two * up_2) / (up_1 ** 2 + up_2 ** 2)
        self.counts_turns = len(rows) == TURNS.stop
        if self.counts_turns:
            self.phi, self.psi, self.phi_dot = rows[TURNS]
        else:
            self.phi, self.psi = (np.unwrap(np.angle(tip)) for tip in (self.tip, self.body_tip))

    def first(self, count: int) -> Attitudes:
        return Attitudes(self.stamps_ns[:count], self.rows[:, :count])

    def constants(self, top: Top) -> tuple[Column, Column, Column] | None:
        """Return E [J], L3 and Lz [kg m^2/s] of each sample (n,); None without rates."""
        if self.omega is None:
            return None
        (one, two, spin), (up_1, up_2, height) = self.omega, self.up
        l3 = top.lambda3 * spin
        return (0.5 * top.lambda1 * (one ** 2 + two ** 2) + 0.5 * l3 * spin
                + top.gravity_torque * height,
                l3, top.lambda1 * (one * up_1 + two * up_2) + l3 * height)


def attitudes_of(name: str, imu: Imu, stamps_ns: NDArray[np.int64],
                 fields: tuple[NDArray[np.float64], ...]) -> Attitudes | None:
    """Return the attitudes in the decoded fields of a stream, None if it has none."""
    rows = [field.T for field in fields]
    if name in ('ground_truth/imu', 'imu/data'):
        rows = list(map(np.vstack, imu.mounting.to_body(tuple(rows[0]), tuple(rows[1]))))
        if imu.takes_means:         # the rates are not those at the stamps
            del rows[1]
    elif name == 'joint_states':
        (phi, theta, psi), (phi_dot, theta_dot, psi_dot) = rows
        across = phi_dot * np.sin(theta)
        rows = [np.stack((
            *attitude.quaternion_of_angles(phi, theta, psi),
            theta_dot * np.sin(psi) - across * np.cos(psi),
            theta_dot * np.cos(psi) + across * np.sin(psi), psi_dot + phi_dot * np.cos(theta),
            phi, psi, phi_dot))]
    elif name in ('pose', 'ground_truth/odom'):     # position, attitude, velocity, rates
        rows = rows[1::2]
    else:
        return None
    columns = np.vstack(rows)
    norm = np.linalg.norm(columns[:4], axis=0)
    valid = np.isfinite(norm) & (norm > 0.0)
    columns[:4, valid] /= norm[valid]
    return Attitudes(stamps_ns[valid], columns[:, valid])


def longest_run(blocks: list[tuple[NDArray[np.int64], NDArray[np.float64]]]) -> Attitudes:
    """Return the longest part of these blocks of stamps and rows that has one rate and no gap."""
    stamps_ns = np.concatenate([stamps_ns for stamps_ns, _ in blocks])
    rows = np.concatenate([rows for _, rows in blocks], axis=1)
    steps = np.diff(stamps_ns)
    cuts = np.array([0, *(np.flatnonzero(np.diff(steps)) + 1), len(steps)])
    longest = int(np.argmax(np.diff(cuts)))
    part = slice(cuts[longest], cuts[longest + 1] + 1)
    return Attitudes(stamps_ns[part], rows[:, part])


@dataclass(frozen=True)
class Measured:
    """Numbers of `regimes.Description`, measured from samples."""

    samples: int
    nutations: int                        # whole ones
    nutation_period: float | None
    mean_precession_rate: float | None
    mean_spin_rate: float | None
    missing: tuple[str, ...]              # why numbers are None


def measure(data: Attitudes, expected: float | None = None) -> Measured:
    """
    Measure a motion from two or more samples at one rate.

    expected : period of its nutation [s]: too few samples show a slower one

    A nutation lasts from one rise of the tip through its middle height to the next.  The tip is
    fastest there, and far from the poles, where phi may jump.
    """
    count = len(data.stamps_ns)
    nutations, period, begin, end, reason = 0, None, 0.0, count - 1.0, ''
    if np.ptp(2.0 * np.arctan2(np.sqrt(data.sin2), np.sqrt(data.cos2))) >= RESTS:
        nutations, begin, end = _crossings(data)
        period = (end - begin) / nutations * data.period if nutations else None
        in_one = min(period or math.inf, expected or math.inf) / data.period
        if in_one < LEAST_SAMPLES:
            reason = f'{in_one:.1f} samples in a nutation are too few'
        elif period is None:
            reason = 'not one whole nutation'
    precession, spin = (None if reason else _mean_rate(data, angle, tip, begin, end)
                        for angle, tip in ((data.phi, data.tip), (data.psi, data.body_tip)))
    if not reason and None in (precession, spin):
        reason = 'phi or psi cannot be unwrapped: a pole, or too few samples in a turn'
    return Measured(count, nutations, None if reason else period, precession, spin,
                    (reason,) if reason else ())


def _spline(values: NDArray[np.generic], index: float) -> BSpline:
    """Return a spline through the values (n,) around an index, as a function of the index."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415 - slow; --help needs none

    begin = max(0, min(int(index) - WINDOW // 2, len(values) - WINDOW))
    part = values[begin:begin + WINDOW]
    return make_interp_spline(np.arange(begin, begin + len(part)), part,
                              k=min(DEGREE, len(part) - 1))


def _crossings(data: Attitudes) -> tuple[int, float, float]:
    """Return the number of whole nutations, and the indices at which they begin and end."""
    from scipy.optimize import brentq  # noqa: PLC0415

    # Both rise with the axis; the smaller one has the digits of a small angle.
    values = -data.sin2 if np.mean(data.sin2) < 0.5 else data.cos2
    values = values - 0.5 * (float(np.min(values)) + float(np.max(values)))
    rising = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    if len(rising) < 2:
        return 0, 0.0, 0.0
    begin, end = (float(brentq(_spline(values, index), index, index + 1.0, xtol=1e-15,
                               rtol=1e-15)) for index in rising[[0, -1]])
    return len(rising) - 1, begin, end


def _mean_rate(data: Attitudes, angle: Column, tip: NDArray[np.complex128], begin: float,
               end: float) -> float | None:
    """Return the mean rate of phi or psi [rad/s] between two indices, None if unknown."""
    if not data.counts_turns and (
            not tip.all() or np.max(np.abs(np.diff(angle))) > LARGEST_STEP):
        return None
    # The tip is smooth where the angle jumps at a pole, and slow without its mean rate.
    rate = (angle[-1] - angle[0]) / (len(angle) - 1)
    slow = tip * np.exp(-1j * rate * np.arange(len(angle)))
    at = np.array([begin, end])
    here = np.rint(at).astype(int)
    ends = np.array([_spline(slow, index)(index) for index in at])
    turned = angle[here] + rate * (at - here) + np.angle(ends * np.conj(slow[here]))
    return float((turned[1] - turned[0]) / ((end - begin) * data.period))
