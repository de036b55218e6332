# SPDX-License-Identifier: Apache-2.0
"""
Numbers from the data of a log alone: nutation, mean rates, constants of the motion, errors.

Everything here takes columns of samples, wherever they come from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial.transform import Rotation

from spinning_top_sim.physics.regimes import regime
from spinning_top_sim.physics.top import State, Top

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Number = TypeVar('Number', np.float64, np.complex128)

# Samples through which the interpolating polynomial goes: with 10 of them in a nutation the error
# is sin(pi/10)^24 of its amplitude.
POINTS = 24
LEAST_SAMPLES = 9.0         # in a nutation, for an interpolation as good as the data
# A tilt that changes less than this is at rest: rounding would decide the results [rad].
RESTS = 1e-9
# Largest difference between the rate in the data and that of the polynomial, relative to the
# largest rate.
RATE_TOLERANCE = 1e-3
# Largest step of an angle that can be unwrapped safely [rad].
LARGEST_STEP = 2.5
# Relative difference from a special motion below which measured numbers are taken for it.
SNAP = 1e-9


@dataclass
class Attitudes:
    """
    Samples of the body's attitude.

    Attributes
    ----------
    stamps_ns : NDArray[np.int64], shape (n,)
        Log times [ns].
    quaternion : NDArray[np.float64], shape (n, 4)
        q(world <- body): x, y, z, w.
    rates : NDArray[np.float64], shape (3, n), or None
        Angular velocity in the body frame [rad/s].
    angles : NDArray[np.float64], shape (6, n), or None
        theta, phi, psi [rad], theta', phi', psi' [rad/s].
    """

    stamps_ns: NDArray[np.int64]
    quaternion: Reals
    rates: Reals | None = None
    angles: Reals | None = None

    def part(self, piece: slice | NDArray[np.bool_]) -> Attitudes:
        """Return some of the samples."""
        return Attitudes(self.stamps_ns[piece], self.quaternion[piece],
                         None if self.rates is None else self.rates[:, piece],
                         None if self.angles is None else self.angles[:, piece])

    def valid(self) -> Attitudes:
        """Return the samples whose quaternion is one: not zero, and finite."""
        norm = np.linalg.norm(self.quaternion, axis=1)
        return self.part(np.isfinite(norm) & (norm > 0.0))


def join(parts: list[Attitudes]) -> Attitudes:
    """Return consecutive samples of one topic as one."""
    rates = [part.rates for part in parts if part.rates is not None]
    angles = [part.angles for part in parts if part.angles is not None]
    return Attitudes(np.concatenate([part.stamps_ns for part in parts]),
                     np.concatenate([part.quaternion for part in parts]),
                     np.concatenate(rates, axis=1) if rates else None,
                     np.concatenate(angles, axis=1) if angles else None)


def from_joint_states(stamps_ns: NDArray[np.int64], positions: Reals,
                      velocities: Reals) -> Attitudes:
    """
    Return the attitudes of joint states.

    Parameters
    ----------
    stamps_ns : NDArray[np.int64], shape (n,)
        Log times [ns].
    positions, velocities : NDArray[np.float64], shape (n, 3)
        phi, theta, psi [rad] and their rates [rad/s].
    """
    order = [1, 0, 2]
    return Attitudes(stamps_ns, Rotation.from_euler('ZYZ', positions).as_quat(),
                     angles=np.concatenate((positions[:, order], velocities[:, order]), axis=1).T)


def constants(top: Top, data: Attitudes) -> tuple[Reals, Reals, Reals] | None:
    """
    Return the constants of the motion in each sample.

    Returns
    -------
    energy, l3, lz : NDArray[np.float64], shape (n,)
        [J] and [kg m^2/s]; None where the data have no rates.
    """
    if data.angles is not None:
        theta, _, _, theta_dot, phi_dot, psi_dot = data.angles
        height = np.cos(theta)
        spin = psi_dot + phi_dot * height
        horizontal = phi_dot * np.sin(theta)
        transverse_square = theta_dot ** 2 + horizontal ** 2
        turning = horizontal * np.sin(theta)
    elif data.rates is not None:
        one, two, spin = data.rates
        up_1, up_2, height = _vertical(data.quaternion)
        transverse_square = one ** 2 + two ** 2
        turning = one * up_1 + two * up_2
    else:
        return None
    l3 = top.lambda3 * spin
    energy = (0.5 * top.lambda1 * transverse_square + 0.5 * l3 * spin
              + top.gravity_torque * height)
    return energy, l3, top.lambda1 * turning + l3 * height


def angle_between(p: Reals, q: Reals) -> Reals:
    """Return the angles (n,) [rad] between attitudes (n, 4), accurate near 0."""
    return (Rotation.from_quat(p).inv() * Rotation.from_quat(q)).magnitude()


def _vertical(quaternion: Reals) -> Reals:
    """Return the upward vertical in the body frame, (3, n)."""
    return Rotation.from_quat(quaternion).as_matrix()[:, 2].T


class Tilts:
    """
    The axis of the top in a log, as smooth functions of time wherever it goes.

    Parameters
    ----------
    data : Attitudes
        At least two samples on a grid of times, without gaps.

    Attributes
    ----------
    period : float
        Of the grid [s].
    time : NDArray[np.float64], shape (n,)
        Since the first sample [s].
    sin2_half, cos2_half : NDArray[np.float64], shape (n,)
        sin^2(theta/2) and cos^2(theta/2).
    sin2_half_rate : NDArray[np.float64], shape (n,), or None
        Rate of sin2_half [1/s].
    tip : NDArray[np.complex128], shape (n,)
        x + iy of the axis' tip: sin(theta) exp(i phi).
    body_tip : NDArray[np.complex128], shape (n,)
        sin(theta) exp(i psi).
    theta, phi, psi : NDArray[np.float64], shape (n,)
        [rad]; phi and psi are unwrapped.
    theta_dot, phi_dot : NDArray[np.float64], shape (n,), or None
        [rad/s].
    counts_turns : bool
        phi and psi are the log's own, not unwrapped from attitudes.
    """

    def __init__(self, data: Attitudes) -> None:
        self._data = data
        self.stamps_ns = data.stamps_ns
        self.time: Reals = (data.stamps_ns - data.stamps_ns[0]) * 1e-9
        self.period = float(self.time[-1] / (len(self.time) - 1))
        self.theta_dot: Reals | None = None
        self.phi_dot: Reals | None = None
        self.sin2_half_rate: Reals | None = None
        self.counts_turns = data.angles is not None
        if data.angles is not None:
            self._from_angles(data.angles)
        else:
            self._from_quaternion(data.quaternion, data.rates)

    def _from_angles(self, angles: Reals) -> None:
        self.theta, self.phi, self.psi, self.theta_dot, self.phi_dot, _ = angles
        self.sin2_half, self.cos2_half = np.sin(0.5 * self.theta) ** 2, np.cos(
            0.5 * self.theta) ** 2
        sine = np.sin(self.theta)
        self.sin2_half_rate = 0.5 * sine * self.theta_dot
        self.tip = sine * np.exp(1j * self.phi)
        self.body_tip = sine * np.exp(1j * self.psi)

    def _from_quaternion(self, quaternion: Reals, rates: Reals | None) -> None:
        x, y, z, w = quaternion.T
        # Not from the cosine, which loses the digits of a small tilt.
        self.sin2_half, self.cos2_half = x * x + y * y, z * z + w * w
        self.theta = 2.0 * np.arctan2(np.sqrt(self.sin2_half), np.sqrt(self.cos2_half))
        axis = Rotation.from_quat(quaternion).as_matrix()[:, :, 2].T
        up = _vertical(quaternion)
        self.tip = axis[0] + 1j * axis[1]
        self.body_tip = -up[0] + 1j * up[1]
        self.phi, self.psi = (np.unwrap(np.angle(tip)) for tip in (self.tip, self.body_tip))
        if rates is not None:
            sine_square = up[0] ** 2 + up[1] ** 2
            self.sin2_half_rate = 0.5 * (up[1] * rates[0] - up[0] * rates[1])
            with np.errstate(divide='ignore', invalid='ignore'):
                self.phi_dot = (rates[0] * up[0] + rates[1] * up[1]) / sine_square
                self.theta_dot = 2.0 * self.sin2_half_rate / np.sqrt(sine_square)

    def first(self, seconds: float) -> Tilts:
        """Return the samples of the first seconds, two at least."""
        return Tilts(self._data.part(
            slice(max(2, int(np.searchsorted(self.time, seconds, 'right'))))))

    @property
    def height(self) -> Reals:
        """cos(theta)."""
        return self.cos2_half - self.sin2_half


def interpolate(values: NDArray[Number], at: Reals) -> NDArray[Number]:
    """
    Return the values between samples, on the polynomial through the POINTS samples around.

    Parameters
    ----------
    values : NDArray, shape (n,)
        Samples, real or complex.
    at : NDArray[np.float64], shape (m,)
        Fractional indices, in [0, n - 1].

    Notes
    -----
    Berrut & Trefethen, "Barycentric Lagrange interpolation", SIAM Review 46 (2004), eq. 4.2.
    SciPy's BarycentricInterpolator is for one set of nodes, and orders them at random, so that
    the last bits change from run to run; a spline is less accurate at the ends of the data.
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
    """The numbers of `regimes.Description`, from the samples of a motion alone."""

    samples: int
    nutations: int                        # whole ones
    nutation_period: float | None
    theta_min: float
    theta_max: float
    mean_precession_rate: float | None
    mean_spin_rate: float | None
    precession_min: float | None
    precession_max: float | None
    missing: tuple[str, ...] = ()         # why numbers are None


def measure(tilts: Tilts) -> Measured:
    """
    Measure a motion.

    Parameters
    ----------
    tilts : Tilts
        Samples of one motion.

    Notes
    -----
    A nutation lasts from one rise of the tip through its middle height to the next.  There its
    time is known best, and the tip is far from the poles, where phi may jump.
    """
    missing: list[str] = []
    low, high = (_extreme(tilts, sign) for sign in (1.0, -1.0))
    nutations, period, begin, end = 0, None, 0.0, len(tilts.time) - 1.0
    if high - low >= RESTS:
        nutations, begin, end = _crossings(tilts)
        if nutations:
            period = (end - begin) / nutations * tilts.period
            if reason := _unresolved(tilts, period):
                missing.append(reason)
                period = None
        else:
            missing.append('not one whole nutation')
    rates: list[float | None] = [None, None]
    if not missing:
        rates = [_mean_rate(tilts, angle, phasor, begin, end)
                 for angle, phasor in ((tilts.phi, tilts.tip), (tilts.psi, tilts.body_tip))]
        if None in rates:
            missing.append('phi or psi turns too fast between samples to be unwrapped')
    return Measured(
        samples=len(tilts.time), nutations=nutations, nutation_period=period, theta_min=low,
        theta_max=high, mean_precession_rate=rates[0], mean_spin_rate=rates[1],
        precession_min=None if tilts.phi_dot is None else float(np.min(tilts.phi_dot)),
        precession_max=None if tilts.phi_dot is None else float(np.max(tilts.phi_dot)),
        missing=tuple(missing))


def _extreme(tilts: Tilts, sign: float) -> float:
    """Return the least (sign 1) or greatest (-1) tilt [rad], also between samples."""
    index = int(np.argmin(sign * tilts.sin2_half))
    near_top = bool(tilts.sin2_half[index] < 0.5)
    # Of the two squares the smaller one: it keeps the digits of a small angle.
    square = tilts.sin2_half if near_top else tilts.cos2_half
    least = float(square[index])
    if 0 < index < len(square) - 1 and len(square) >= POINTS:
        direction = sign if near_top else -sign
        found = minimize_scalar(
            lambda at: direction * _value(square, at), bounds=(index - 1.0, index + 1.0),
            method='bounded', options={'xatol': 1e-9})
        least = direction * min(direction * least, float(found.fun))
    half = math.asin(math.sqrt(min(max(least, 0.0), 1.0)))
    return 2.0 * half if near_top else math.pi - 2.0 * half


def _value(values: NDArray[Number], at: float) -> Number:
    """Return the interpolated value at one fractional index."""
    return interpolate(values, np.array([at]))[0]


def _crossings(tilts: Tilts) -> tuple[int, float, float]:
    """Return how many whole nutations there are, and the indices at which they begin and end."""
    # Both rise with the axis; the smaller one keeps the digits of a small angle.
    near_top = float(np.mean(tilts.sin2_half)) < 0.5
    values = -tilts.sin2_half if near_top else tilts.cos2_half
    middle = 0.5 * (float(np.min(values)) + float(np.max(values)))
    rising = np.flatnonzero((values[:-1] < middle) & (values[1:] >= middle))
    if len(rising) < 2:
        return 0, 0.0, 0.0
    return (len(rising) - 1, _root(values, middle, int(rising[0])),
            _root(values, middle, int(rising[-1])))


def _root(values: Reals, level: float, index: int) -> float:
    """Return where a curve passes a level between sample `index` and the next."""
    return float(brentq(lambda at: _value(values, at) - level, index, index + 1.0,
                        xtol=1e-15, rtol=1e-15))


def _unresolved(tilts: Tilts, period: float) -> str:
    """Return why the samples are too few for a nutation, '' if they are not."""
    samples, count = period / tilts.period, len(tilts.time)
    if tilts.sin2_half_rate is not None and count > POINTS:
        # Too few samples show a slower nutation, whose rate is not the one in the data.
        at = np.linspace(POINTS // 2, count - POINTS // 2 - 1, 200).astype(int)
        step = 1e-3
        ahead, behind = (interpolate(tilts.sin2_half, at + sign * step) for sign in (1, -1))
        difference = (ahead - behind) / (2.0 * step * tilts.period) - tilts.sin2_half_rate[at]
        if np.max(np.abs(difference)) > RATE_TOLERANCE * np.max(np.abs(tilts.sin2_half_rate)):
            return ('a nutation takes only a few samples: '
                    'the rates in the data are not those of the curve')
    if samples < LEAST_SAMPLES:
        return f'{samples:.1f} samples in a nutation are too few'
    return ''


def _mean_rate(tilts: Tilts, angle: Reals, phasor: Complexes, begin: float,
               end: float) -> float | None:
    """Return the mean rate of phi or psi [rad/s] between two indices, None if unknown."""
    if end <= begin:
        return None
    turns = np.diff(angle)
    if not tilts.counts_turns and len(turns) and float(np.max(np.abs(turns))) > LARGEST_STEP:
        return None
    if begin == 0.0 and end == len(angle) - 1.0:    # theta rests: so do the rates
        return float((angle[-1] - angle[0]) / (end * tilts.period))
    # The phasor is smooth where the angle jumps, and slow without its mean rate.
    rate = (angle[-1] - angle[0]) / (len(angle) - 1)
    index = np.arange(len(angle))
    ends = []
    for at in (begin, end):
        near = slice(max(0, int(at) - POINTS), int(at) + POINTS + 2)
        here = round(at)
        slow = phasor[near] * np.exp(-1j * rate * (index[near] - here))
        value = _value(slow, at - index[near][0])
        ends.append(angle[here] + rate * (at - here) + np.angle(value * np.conj(phasor[here])))
    return float((ends[1] - ends[0]) / ((end - begin) * tilts.period))


def measured_regime(top: Top, theta: float, theta_dot: float, l3: float, lz: float) -> str:
    """
    Return the name of a motion from numbers that were measured.

    Parameters
    ----------
    top : Top
        Its constants.
    theta, theta_dot : float
        Of one sample [rad], [rad/s].
    l3, lz : float
        [kg m^2/s].

    Notes
    -----
    A motion that differs from a special one by less than SNAP is taken for it.
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
