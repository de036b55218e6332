# SPDX-License-Identifier: Apache-2.0
"""
Which motion is this?  The classical names, from the constants of the motion alone.

With u = cos(theta) the axis obeys u'^2 = f(u), a cubic; it swings between the two roots of f in
[-1, 1].  The precession phi' = (Lz - L3 u)/(lambda1 (1 - u^2)) changes sign at u = Lz/L3: inside
the swing the tip draws loops, outside it waves, at its end cusps (Goldstein, *Classical
Mechanics*, 3rd ed., sect. 5.7; Klein & Sommerfeld, *Theorie des Kreisels*, ch. IV).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import TypeVar

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top

Real = TypeVar('Real', float, Decimal)


@dataclass(frozen=True)
class Description:
    """
    A motion in the numbers that a physicist asks for.

    name: see `regime`;  nutation_period [s], None where theta rests
    theta_min, theta_max [rad]: between which the axis swings
    mean_precession_rate, mean_spin_rate [rad/s]: <phi'>, <psi'> over a nutation
    precession_min, precession_max [rad/s]: extremes of phi'
    separatrix_distance: 1 - m of the elliptic functions; 0 is the motion that rises for ever
    gyroscopic_ratio: L3^2/(4 lambda1 |P|); an upright top sleeps above 1; inf without gravity
    """

    name: str
    nutation_period: float | None
    theta_min: float
    theta_max: float
    mean_precession_rate: float
    precession_min: float
    precession_max: float
    mean_spin_rate: float
    separatrix_distance: float
    gyroscopic_ratio: float

    def __str__(self) -> str:
        low, high = math.degrees(self.theta_min), math.degrees(self.theta_max)
        swing_text = (f'theta = {low:.4g} deg' if self.nutation_period is None else
                      f'theta from {low:.4g} to {high:.4g} deg every '
                      f'{self.nutation_period:.6g} s')
        return (f'{self.name}: {swing_text}; precession {self.mean_precession_rate:.6g} rad/s '
                f'({self.precession_min:.4g} to {self.precession_max:.4g}), spin '
                f'{self.mean_spin_rate:.6g} rad/s; L3^2/(4 lambda1 |P|) = '
                f'{self.gyroscopic_ratio:.4g}, 1 - m = {self.separatrix_distance:.3g}')


def precession_extremes(top: Top, state: State, theta_min: float,
                        theta_max: float) -> tuple[float, float]:
    """
    Return the least and the greatest phi' [rad/s] while theta swings between two tilts.

    They lie at the ends, or where d phi'/du = 0: L3 u^2 - 2 Lz u + L3 = 0.
    """
    tilts = [theta_min, theta_max]
    l3, lz = state.l3, state.lz
    if abs(lz) > abs(l3) > 0.0:
        inner = math.acos(l3 / (lz + math.copysign(math.sqrt(lz * lz - l3 * l3), lz)))
        if theta_min < inner < theta_max:
            tilts.append(inner)
    rates = []
    for theta in tilts:
        cos2, sin2 = math.cos(0.5 * theta) ** 2, math.sin(0.5 * theta) ** 2
        if theta == math.pi:
            cos2 = 0.0
        singular = (cos2 == 0.0 and lz + l3 != 0.0) or (sin2 == 0.0 and lz - l3 != 0.0)
        rates.append(math.copysign(math.inf, lz - l3 * math.cos(theta)) if singular
                     else attitude.precession_rate(top, l3, lz, cos2, sin2))
    return min(rates), max(rates)


# How many units in the last place count as rounding.
REST_ULPS = 2.0
# And how far the axis may swing all the same, in cos(theta) over sin^2(theta).
REST_SWING = 1e-12


def nutation_rests(top: Top, start: State) -> bool:
    """
    Whether theta stays as it is: sleeping, hanging at a pole, or steady precession.

    Steady means theta'' = 0, eq. (30), as nearly as its terms and the given L3 and Lz, doubles
    all, can say.  Next to a pole they say so little that the axis may swing far; then it is not.
    """
    if start.theta_dot != 0.0:
        return False
    sine, cosine = math.sin(start.theta), math.cos(start.theta)
    half_cosine, half_sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
    phi_dot = attitude.precession_rate(top, start.l3, start.lz, half_cosine ** 2, half_sine ** 2)
    gyroscopic = start.l3 / top.lambda1
    terms = (phi_dot * phi_dot * sine * cosine, -gyroscopic * phi_dot * sine,
             top.gravity_torque / top.lambda1 * sine)
    doubt = sum(map(abs, terms))
    if start.lz - start.l3 * cosine:
        rounded_rate = (abs(start.lz) + abs(start.l3)) / (top.lambda1 * sine * sine)
        doubt += abs((2.0 * phi_dot * cosine - gyroscopic) * sine) * rounded_rate
    if abs(math.fsum(terms)) > REST_ULPS * math.ulp(1.0) * doubt:
        return False
    # From theta' = 0 cos(theta) swings by f1/f2, where that is small.
    s0, c0 = half_sine ** 2, half_cosine ** 2
    _, f1, f2, _ = _cubic_of(top, start)
    return abs(f1) <= REST_SWING * 4.0 * s0 * c0 * abs(f2)


# Relative distance below which two roots, or a root and Lz/L3, are said to coincide.
COINCIDE = 1e-12


@dataclass(frozen=True)
class Swing:
    """Between which tilts the axis swings: cosines low <= high, and f's third root beyond 1."""

    low: float
    high: float
    beyond: float


def swing(top: Top, state: State) -> Swing:
    """Return the roots of u'^2 = f(u) around the state, in doubles."""
    u0 = math.cos(state.theta)
    s0, c0 = math.sin(0.5 * state.theta) ** 2, math.cos(0.5 * state.theta) ** 2
    f0, f1, f2, f3 = _cubic_of(top, state)
    if f0 == 0.0 and f1 == 0.0:
        return Swing(u0, u0, math.inf if f3 == 0.0 else max(u0 - f2 / f3, u0))
    if f0 == 0.0:                       # theta' = 0: u0 is one end, the others from a quadratic
        ends = [0.0, *_quadratic_roots(f1, f2, f3)]
        inside = [y for y in ends if -2.0 * c0 * (1.0 + COINCIDE) <= y
                  <= 2.0 * s0 * (1.0 + COINCIDE) + COINCIDE]
        other = inside[1] if len(inside) > 1 else 0.0
        beyond = max([y for y in ends if y not in inside], default=math.inf)
        return Swing(u0 + min(0.0, other), u0 + max(0.0, other), u0 + beyond)
    low = _bisect(f0, f1, f2, f3, -2.0 * c0)
    high = _bisect(f0, f1, f2, f3, 2.0 * s0)
    beyond = math.inf if f3 == 0.0 else -f2 / f3 - low - high
    return Swing(u0 + low, u0 + high, u0 + beyond)


def nutation_cubic(lambda1: Real, torque: Real, l3: Real, lz: Real, theta_dot: Real,
                   sin_half: Real, cos_half: Real) -> tuple[Real, Real, Real, Real]:
    """
    Return f0 .. f3 of u'^2 = f0 + f1 y + f2 y^2 + f3 y^3, y = u - u0, u = cos(theta).

    Parameters
    ----------
    lambda1, torque, l3, lz, theta_dot : constants, and the nutation rate at the start
    sin_half, cos_half : of theta/2 at the start; they stand for theta, so that nothing cancels at
        either pole
    """
    s0, c0 = sin_half * sin_half, cos_half * cos_half
    u0, sine = c0 - s0, 2 * sin_half * cos_half
    # Lz - L3 u0, and phi' sin(theta).
    momentum = (lz - l3) + 2 * l3 * s0 if s0 < c0 else (lz + l3) - 2 * l3 * c0
    across = momentum / lambda1 / sine if sine else 0 * sine
    kinetic = lambda1 * (theta_dot * theta_dot + across * across) / 2     # of the axis
    return (sine * sine * theta_dot * theta_dot,
            2 * momentum * l3 / lambda1 / lambda1
            - 2 / lambda1 * (2 * u0 * kinetic + torque * sine * sine),
            2 / lambda1 * (2 * u0 * torque - kinetic) - (l3 / lambda1) * (l3 / lambda1),
            2 * torque / lambda1)


def _cubic_of(top: Top, state: State) -> tuple[float, float, float, float]:
    return nutation_cubic(top.lambda1, top.gravity_torque, state.l3, state.lz, state.theta_dot,
                          math.sin(0.5 * state.theta), math.cos(0.5 * state.theta))


def _quadratic_roots(a0: float, a1: float, a2: float) -> list[float]:
    """Return the real roots of a0 + a1 y + a2 y^2, without cancellation."""
    if a2 == 0.0:
        return [-a0 / a1] if a1 else []
    square = a1 * a1 - 4.0 * a0 * a2
    if square < 0.0:
        return []
    q = -0.5 * (a1 + math.copysign(math.sqrt(square), a1))
    return sorted({q / a2, a0 / q if q else 0.0})


def _bisect(f0: float, f1: float, f2: float, f3: float, end: float) -> float:
    """Return the root between 0, where f > 0, and `end`, where f <= 0."""
    inside, outside = 0.0, end
    while True:
        middle = 0.5 * (inside + outside)
        if middle in (inside, outside):
            return middle
        if ((f3 * middle + f2) * middle + f1) * middle + f0 > 0.0:
            inside = middle
        else:
            outside = middle


def regime(top: Top, state: State, coincide: float = COINCIDE) -> str:
    """Return the motion's name; coincide: relative distance below which roots are one."""
    l3, lz = state.l3, state.lz
    scale = abs(l3) + abs(lz)
    at = swing(top, state)
    resting = at.high - at.low <= coincide
    if top.gravity_torque == 0.0:
        return 'free top' if scale or state.theta_dot else 'at rest'
    if resting and 1.0 - abs(at.low) <= coincide:
        if scale == 0.0:
            return 'at rest'
        upright = (at.low > 0.0) == (top.gravity_torque > 0.0)
        if not upright:
            return 'hanging'
        stable = l3 * l3 > 4.0 * top.lambda1 * abs(top.gravity_torque)
        return 'sleeping' if stable else 'sleeping, unstable'
    if scale == 0.0:
        return 'planar pendulum, ' + ('rotating' if at.high >= 1.0 - coincide and at.low
                                      <= -1.0 + coincide else 'swinging')
    if resting:
        return 'steady precession'
    if l3 == 0.0:
        return 'spherical pendulum'
    turning = lz / l3
    if lz == l3 and at.high >= 1.0 - coincide:
        return 'through the top'
    if lz == -l3 and at.low <= -1.0 + coincide:
        return 'through the bottom'
    if min(abs(turning - at.low), abs(turning - at.high)) <= coincide * max(1.0, abs(turning)):
        return 'cusps'
    return 'loops' if at.low < turning < at.high else 'waves'
