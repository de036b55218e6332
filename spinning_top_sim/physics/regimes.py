# SPDX-License-Identifier: Apache-2.0
"""
Which motion is this?  The classical names, from the constants of the motion alone.

With u = cos(theta) the axis obeys u'^2 = f(u), a cubic; it swings between the two roots of f in
[-1, 1].  The precession phi' = (Lz - L3 u)/(lambda1 (1 - u^2)) changes sign at u = Lz/L3: inside
the swing the tip draws loops, outside it waves, at its end cusps (Goldstein, *Classical
Mechanics*, 3rd ed., sect. 5.7; Klein & Sommerfeld, *Theorie des Kreisels*, ch. IV).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top

Real = Any              # float, or a multiprecision number
# Relative distance below which two roots, or a root and Lz/L3, are said to coincide.
COINCIDE = 1e-10


def natural_momentum(top: Top) -> float:
    """Return sqrt(lambda1 |P|) [kg m^2/s]; an upright top sleeps above twice this."""
    return math.sqrt(top.lambda1 * abs(top.gravity_torque))


@dataclass(frozen=True)
class Description:
    """A motion in numbers: angles in rad, rates in rad/s."""

    name: str                           #: The classical name, such as 'cusps'.
    nutation_period: float | None       #: Period of theta [s], None where it rests.
    theta_min: float                    #: Between which the axis swings.
    theta_max: float                    #: Between which the axis swings.
    mean_precession_rate: float         #: Mean over a nutation.
    precession_min: float               #: Least precession rate.
    precession_max: float               #: Greatest precession rate.
    mean_spin_rate: float               #: Mean over a nutation.
    separatrix_distance: float          #: 1 - m; 0 is the motion that rises for ever.
    gyroscopic_ratio: float             #: L3^2/(4 lambda1 abs(P)); an upright top sleeps above 1.


def axis_rests(top: Top, state: State) -> bool:
    """Return whether theta stays as it is: sleeping, hanging at a pole, steady precession."""
    f0, f1, f2, _ = nutation_cubic(
        top.lambda1, top.gravity_torque, state.l3, state.lz, state.theta_dot,
        math.sin(0.5 * state.theta), math.cos(0.5 * state.theta))
    if not (f0 or f1):
        return True
    # Of so short a swing the cubic is a parabola: the distance of its roots.
    return -math.inf < f2 < 0.0 and math.hypot(f1 / f2, 2.0 * math.sqrt(-f0 / f2)) <= COINCIDE


def nutation_cubic(lambda1: Real, torque: Real, l3: Real, lz: Real, theta_dot: Real,
                   sin_half: Real, cos_half: Real) -> tuple[Real, Real, Real, Real]:
    """
    Return f0 .. f3 of u'^2 = f0 + f1 y + f2 y^2 + f3 y^3, y = u - u0, u = cos(theta).

    sin_half and cos_half of theta/2 stand for theta0, so that nothing cancels at either pole.
    """
    s0, c0 = sin_half * sin_half, cos_half * cos_half
    u0, sine = c0 - s0, 2 * sin_half * cos_half
    momentum = precession_momentum(l3, lz, s0, c0)
    across = momentum / lambda1 / sine if sine else 0 * sine    # phi' sin(theta)
    kinetic = lambda1 * (theta_dot * theta_dot + across * across) / 2     # of the axis
    return (sine * sine * theta_dot * theta_dot,
            2 * momentum * l3 / lambda1 / lambda1
            - 2 / lambda1 * (2 * u0 * kinetic + torque * sine * sine),
            2 / lambda1 * (2 * u0 * torque - kinetic) - (l3 / lambda1) * (l3 / lambda1),
            2 * torque / lambda1)


def precession_momentum(l3: Real, lz: Real, sin2_half: Real, cos2_half: Real) -> Real:
    """Return Lz - L3 cos(theta), without cancellation at either pole."""
    if sin2_half < cos2_half:
        return (lz - l3) + 2 * l3 * sin2_half
    return (lz + l3) - 2 * l3 * cos2_half


def regime(top: Top, state: State, theta_min: float, theta_max: float) -> str:
    """Return the name of the motion that swings between these tilts [rad]."""
    moves = state.l3 != 0.0 or state.lz != 0.0
    if top.gravity_torque == 0.0:
        return 'free top' if moves or state.theta_dot else 'at rest'
    low, high = math.cos(theta_max), math.cos(theta_min)
    rests = high - low <= COINCIDE
    if rests and 1.0 - abs(low) <= COINCIDE:
        if not moves:
            return 'at rest'
        if (low > 0.0) != (top.gravity_torque > 0.0):       # the centre of mass is below
            return 'hanging'
        stable = state.l3 * state.l3 > 4.0 * top.lambda1 * abs(top.gravity_torque)
        return 'sleeping' if stable else 'sleeping, unstable'
    if not moves:
        rotating = high >= 1.0 - COINCIDE and low <= -1.0 + COINCIDE
        return f'planar pendulum, {"rotating" if rotating else "swinging"}'
    return 'steady precession' if rests else _precessing_regime(state, low, high)


def _precessing_regime(state: State, low: float, high: float) -> str:
    l3, lz = state.l3, state.lz
    if l3 == 0.0:
        return 'spherical pendulum'
    if lz == l3 and high >= 1.0 - COINCIDE:
        return 'through the top'
    if lz == -l3 and low <= -1.0 + COINCIDE:
        return 'through the bottom'
    reversal = lz / l3          # cos(theta) at which phi' changes sign
    if min(abs(reversal - low), abs(reversal - high)) <= COINCIDE * max(1.0, abs(reversal)):
        return 'cusps'
    return 'loops' if low < reversal < high else 'waves'


def precession_extremes(top: Top, state: State, theta_min: float,
                        theta_max: float) -> tuple[float, float]:
    """Return the least and the greatest phi' [rad/s] while theta swings between two tilts."""
    # They lie at the ends, or where d phi'/du = 0: L3 u^2 - 2 Lz u + L3 = 0.
    tilts, l3, lz = [theta_min, theta_max], state.l3, state.lz
    if abs(lz) > abs(l3):
        inner = math.acos(l3 / (lz + math.copysign(math.sqrt(lz * lz - l3 * l3), lz)))
        tilts.append(min(max(inner, theta_min), theta_max))
    half = 0.5 * np.array(tilts)
    with np.errstate(divide='ignore'):
        rates = attitude.precession_rate(top, l3, lz, np.cos(half) ** 2, np.sin(half) ** 2)
    return float(rates.min()), float(rates.max())
