# SPDX-License-Identifier: Apache-2.0
"""
Numbers from the data of a log alone: nutation, mean rates, constants of the motion, errors.

Everything here takes columns of samples; where they come from is not its business.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.regimes import regime
from spinning_top_sim.physics.top import State, Top

Column = NDArray[Any]

# Samples on which the polynomial between two of them rests: with 10 of them in a nutation the
# error is sin(pi/10)^24 of its amplitude.
POINTS = 24
LEAST_SAMPLES = 9.0         # in a nutation, for an interpolation as good as the data
# A tilt that changes less than this [rad] rests: rounding would decide the rest.
RESTS = 1e-9
# By how much the slope of the samples may differ from that of the polynomial, over the largest.
SLOPES = 1e-3
SNAP = 1e-9


@dataclass
class Attitudes:
    """
    Samples of an attitude, in the body's frame.

    stamps_ns: (n,) log times [ns];  quaternion: (n, 4) x, y, z, w
    rates: body rates [rad/s], or None
    angles: theta, phi, psi, theta', phi', psi' [rad], [rad/s] where the log has them
    """

    stamps_ns: Column
    quaternion: Column
    rates: tuple[Column, Column, Column] | None = None
    angles: tuple[Column, Column, Column, Column, Column, Column] | None = None


def from_angles(stamps_ns: Column, positions: Column, velocities: Column) -> Attitudes:
    """Return the attitudes of joint states: (n, 3) phi, theta, psi and their rates."""
    phi, theta, psi = (column.copy() for column in positions.T)
    phi_dot, theta_dot, psi_dot = (column.copy() for column in velocities.T)
    alpha = np.cos(0.5 * theta) * np.exp(0.5j * (phi + psi))
    beta = np.sin(0.5 * theta) * np.exp(0.5j * (phi - psi))
    quaternion = np.stack((-beta.imag, beta.real, alpha.imag, alpha.real), axis=1)
    return Attitudes(stamps_ns, quaternion,
                     angles=(theta, phi, psi, theta_dot, phi_dot, psi_dot))


def constants(top: Top, data: Attitudes) -> tuple[Column, Column, Column] | None:
    """Return E [J], L3 and Lz [kg m^2/s] in each sample; None without rates."""
    if data.angles is not None:
        theta, _, _, theta_dot, phi_dot, psi_dot = data.angles
        sine, cosine = np.sin(theta), np.cos(theta)
        l3 = top.lambda3 * (psi_dot + phi_dot * cosine)
        across = phi_dot * sine
        energy = (0.5 * top.lambda1 * (theta_dot ** 2 + across ** 2)
                  + 0.5 * l3 * l3 / top.lambda3 + top.gravity_torque * cosine)
        return energy, l3, top.lambda1 * across * sine + l3 * cosine
    if data.rates is None:
        return None
    one, two, three = data.rates
    z1, z2, z3 = _vertical(data.quaternion)
    l3 = top.lambda3 * three
    energy = (0.5 * top.lambda1 * (one ** 2 + two ** 2) + 0.5 * l3 * three
              + top.gravity_torque * z3)
    return energy, l3, top.lambda1 * (one * z1 + two * z2) + l3 * z3


def angle_between(p: Column, q: Column) -> Column:
    """Return the angles (n,) [rad] between attitudes (n, 4), accurate near 0."""
    apart, opposite = np.linalg.norm(p - q, axis=1), np.linalg.norm(p + q, axis=1)
    return 4.0 * np.arctan2(np.minimum(apart, opposite), np.maximum(apart, opposite))


def _vertical(quaternion: Column) -> tuple[Column, Column, Column]:
    """Return the upward vertical in the body's frame."""
    x, y, z, w = quaternion.T
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), (z * z + w * w) - (x * x + y * y)


class Tilts:
    """
    The axis in a log, as functions of time that are smooth wherever it goes.

    stamps_ns: (n,) on a grid, without gaps;  period [s];  time: (n,) [s] since the first
    square: sin^2(theta/2);  slope: its rate [1/s], None where the log cannot tell
    tip: (x + iy) of the axis' tip;  turned: its counterpart in the body, sin(theta) exp(i psi)
    theta, phi, psi: unwrapped [rad];  theta_dot, phi_dot, psi_dot: None where unknown
    counts_turns: whether phi and psi are the log's own, not put together from the attitude
    """

    def __init__(self, data: Attitudes) -> None:
        self.stamps_ns = data.stamps_ns
        self.time = (data.stamps_ns - data.stamps_ns[0]) * 1e-9
        self.period = float(self.time[-1] / (len(self.time) - 1))
        self.slope: Column | None = None
        self.phi_dot: Column | None = None
        self.theta_dot: Column | None = None
        self.counts_turns = data.angles is not None
        if data.angles is not None:
            self.theta, self.phi, self.psi, self.theta_dot, self.phi_dot, _ = data.angles
            self.square = np.sin(0.5 * self.theta) ** 2
            self.rest = np.cos(0.5 * self.theta) ** 2
            sine = np.sin(self.theta)
            self.slope = 0.5 * sine * self.theta_dot
            self.tip = sine * np.exp(1j * self.phi)
            self.turned = sine * np.exp(1j * self.psi)
            return
        x, y, z, w = data.quaternion.T
        self.square, self.rest = x * x + y * y, z * z + w * w
        self.theta = 2.0 * np.arctan2(np.sqrt(self.square), np.sqrt(self.rest))
        self.tip = 2.0 * ((x * z + w * y) + 1j * (y * z - w * x))
        z1, z2, _ = _vertical(data.quaternion)
        self.turned = -z1 + 1j * z2
        self.phi, self.psi = np.unwrap(np.angle(self.tip)), np.unwrap(np.angle(self.turned))
        if data.rates is not None:
            one, two, _ = data.rates
            self.slope = 0.5 * (z2 * one - z1 * two)
            with np.errstate(divide='ignore', invalid='ignore'):
                self.phi_dot = (one * z1 + two * z2) / (z1 * z1 + z2 * z2)
                self.theta_dot = 2.0 * self.slope / np.sqrt(z1 * z1 + z2 * z2)

    def first(self, seconds: float) -> Tilts:
        """Return the samples of the first seconds, two at least."""
        count = max(2, int(np.searchsorted(self.time, seconds, 'right')))
        part = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(part, name, value[:count])
        return part

    @property
    def height(self) -> Column:
        """cos(theta)."""
        return self.rest - self.square


def interpolate(values: Column, at: Column) -> Column:
    """
    Return the values between samples at fractional indices `at`.

    By the polynomial through the POINTS samples around (Berrut & Trefethen, "Barycentric Lagrange
    interpolation", SIAM Review 46, 2004, eq. 4.2).
    """
    at = np.asarray(at, float)
    points = min(POINTS, len(values))
    first = np.clip(np.floor(at).astype(int) - points // 2 + 1, 0, len(values) - points)
    weights = np.array([(-1.0) ** k * math.comb(points - 1, k) for k in range(points)])
    nodes = first[:, None] + np.arange(points)
    distance = at[:, None] - nodes
    hit = distance == 0.0
    terms = weights / np.where(hit, 1.0, distance)
    terms[hit.any(axis=1)] = 0.0
    terms[hit] = 1.0
    return (terms * values[nodes]).sum(axis=1) / terms.sum(axis=1)


@dataclass(frozen=True)
class Measured:
    """
    A motion in the numbers of `regimes.Description`, from its samples alone.

    nutations: how many whole ones they hold;  missing: why numbers are None, in words
    """

    samples: int
    nutations: int
    nutation_period: float | None
    theta_min: float
    theta_max: float
    mean_precession_rate: float | None
    mean_spin_rate: float | None
    precession_min: float | None
    precession_max: float | None
    missing: tuple[str, ...] = ()


def measure(tilts: Tilts) -> Measured:
    """
    Return what the samples of one motion tell.

    A nutation lasts from one rise of the tip through its middle height to the next: there the
    time is sharpest, and the tip is far from the poles, where phi may leap.
    """
    missing: list[str] = []
    low, high = (_extreme(tilts, sign) for sign in (1.0, -1.0))
    precession: tuple[float | None, float | None] = (None, None)
    if tilts.phi_dot is not None:
        precession = (float(np.min(tilts.phi_dot)), float(np.max(tilts.phi_dot)))
    nutations, period, begin, end = 0, None, 0.0, len(tilts.time) - 1.0
    if high - low < RESTS:
        if len(tilts.time) < 2:
            missing.append('rates need two samples')
    else:
        nutations, begin, end = _crossings(tilts)
        if nutations:
            period = (end - begin) / nutations * tilts.period
            unresolved = _unresolved(tilts, period)
            if unresolved:
                missing.append(unresolved)
                period = None
        else:
            missing.append('not one whole nutation')
    rates: list[float | None] = [None, None]
    if not missing:
        rates = [_mean_rate(tilts, angle, phasor, begin, end)
                 for angle, phasor in ((tilts.phi, tilts.tip), (tilts.psi, tilts.turned))]
        if None in rates:
            missing.append('phi or psi turns too fast between samples to be unwrapped')
    return Measured(
        samples=len(tilts.time), nutations=nutations, nutation_period=period, theta_min=low,
        theta_max=high, mean_precession_rate=rates[0], mean_spin_rate=rates[1],
        precession_min=precession[0], precession_max=precession[1], missing=tuple(missing))


def _extreme(tilts: Tilts, sign: float) -> float:
    """Return the least (sign 1) or greatest (-1) tilt [rad], between samples too."""
    index = int(np.argmin(sign * tilts.square))
    from_top = bool(tilts.square[index] < 0.5)
    curve = tilts.square if from_top else tilts.rest
    best = float(curve[index])
    if 0 < index < len(curve) - 1 and len(curve) >= POINTS:
        direction = sign if from_top else -sign
        centre, width = float(index), 1.0
        for _ in range(3):
            values = direction * interpolate(curve, centre + width * np.linspace(-1.0, 1.0, 65))
            place = int(np.argmin(values))
            centre += width * (place / 32.0 - 1.0)
            best, width = direction * float(values[place]), width / 32.0
    half = math.asin(math.sqrt(min(max(best, 0.0), 1.0)))
    return 2.0 * half if from_top else math.pi - 2.0 * half


def _crossings(tilts: Tilts) -> tuple[int, float, float]:
    """Return how many whole nutations there are, and the indices at which they begin and end."""
    # Of the two squares the smaller one: it keeps the digits of a small tilt.
    near_top = float(np.mean(tilts.square)) < 0.5
    values = -tilts.square if near_top else tilts.rest
    middle = 0.5 * (float(np.min(values)) + float(np.max(values)))
    rising = np.flatnonzero((values[:-1] < middle) & (values[1:] >= middle))
    if len(rising) < 2:
        return 0, 0.0, 0.0
    return (len(rising) - 1, _root(values, middle, int(rising[0])),
            _root(values, middle, int(rising[-1])))


def _root(values: Column, level: float, index: int) -> float:
    """Return where a curve passes a level between sample `index` and the next: by bisection."""
    low, high = float(index), index + 1.0
    for _ in range(60):
        at = np.linspace(low, high, 9)
        above = interpolate(values, at) >= level
        above[0], above[-1] = False, True
        first = int(np.argmax(above))
        low, high = float(at[first - 1]), float(at[first])
        if high - low <= 4e-16 * max(1.0, high):
            break
    return 0.5 * (low + high)


def _unresolved(tilts: Tilts, period: float) -> str:
    """Return why the samples are too few for a nutation, '' if they are not."""
    samples = period / tilts.period
    if tilts.slope is not None:
        count = len(tilts.time)
        at = np.unique(np.linspace(POINTS // 2, max(count - POINTS // 2, 0), 200).astype(int))
        at = at[at < count - 1]
        step = 1e-3
        slope = (interpolate(tilts.square, at + step)
                 - interpolate(tilts.square, at - step)) / (2.0 * step * tilts.period)
        off = float(np.max(np.abs(slope - tilts.slope[at]))) if len(at) else 0.0
        if off > SLOPES * float(np.max(np.abs(tilts.slope))):
            return 'a nutation is over in a few samples: the rates tell of more than they show'
    if samples < LEAST_SAMPLES:
        return f'{samples:.1f} samples in a nutation are too few'
    return ''


def _mean_rate(tilts: Tilts, angle: Column, phasor: Column, begin: float,
               end: float) -> float | None:
    """Return the mean rate of phi or psi [rad/s] between two indices, None if unknown."""
    if end <= begin:
        return None
    turns = np.diff(angle)
    if not tilts.counts_turns and len(turns) and float(np.max(np.abs(turns))) > 2.5:
        return None
    if begin == 0.0 and end == len(angle) - 1.0:    # theta rests: so do the rates
        return float((angle[-1] - angle[0]) / (end * tilts.period))
    # Without its mean rate the phasor is slow, however fast the top spins.
    rate = (angle[-1] - angle[0]) / (len(angle) - 1)
    index = np.arange(len(angle))
    ends = []
    for at in (begin, end):
        near = slice(max(0, int(at) - POINTS), int(at) + POINTS + 2)
        here = round(at)
        slow = phasor[near] * np.exp(-1j * rate * (index[near] - here))
        value = interpolate(slow, np.array([at - index[near][0]]))[0]
        ends.append(angle[here] + rate * (at - here)
                    + float(np.angle(value * np.conj(phasor[here]))))
    return float((ends[1] - ends[0]) / ((end - begin) * tilts.period))


def measured_regime(top: Top, theta: float, theta_dot: float, l3: float, lz: float) -> str:
    """
    Return the motion's name from numbers that were measured.

    What differs from a special motion by less than SNAP is taken for it.
    """
    natural = math.sqrt(top.lambda1 * max(abs(top.gravity_torque),
                                          top.lambda1 * theta_dot * theta_dot))
    scale = max(abs(l3), abs(lz), natural) * SNAP
    l3 = 0.0 if abs(l3) < scale else l3
    lz = 0.0 if abs(lz) < scale else lz
    lz = next((pole for pole in (l3, -l3) if abs(lz - pole) < scale), lz)
    theta = abs(math.remainder(theta, math.tau))
    if math.sin(theta) < SNAP:
        theta = 0.0 if theta < 1.0 else math.pi
        lz = l3 if theta == 0.0 else -l3
    return regime(top, State(theta=theta, theta_dot=theta_dot, l3=l3, lz=lz), SNAP)
