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
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.top import State, Top

Real = Any              # float, or a multiprecision number
# Relative distance below which two roots, or a root and Lz/L3, are said to coincide.
COINCIDE = 1e-12


def natural_momentum(top: Top) -> float:
    """Return sqrt(lambda1 |P|) [kg m^2/s]; an upright top sleeps above twice this."""
    return math.sqrt(top.lambda1 * abs(top.gravity_torque))


@dataclass(frozen=True)
class Description:
    """
    A motion in numbers.

    Parameters
    ----------
    name : str
        The classical name, such as 'cusps'.
    nutation_period : float or None
        Period of theta [s], None where it rests.
    theta_min, theta_max : float
        Between which the axis swings [rad].
    mean_precession_rate : float
        Mean over a nutation [rad/s].
    precession_min, precession_max : float
        Least and greatest precession rate [rad/s].
    mean_spin_rate : float
        Mean over a nutation [rad/s].
    separatrix_distance : float
        1 - m of the elliptic functions; 0 is the motion that rises for ever.
    gyroscopic_ratio : float
        L3^2 over 4 lambda1 abs(P); an upright top sleeps above 1; inf without gravity.
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
        tilt, rates = f'theta = {low:.4g} deg', ''
        if self.nutation_period is not None:
            tilt = f'theta from {_span(low, high)} deg every {self.nutation_period:.6g} s'
            rates = f' ({_span(self.precession_min, self.precession_max)})'
        return (f'{self.name}: {tilt}; precession {self.mean_precession_rate:.6g} rad/s{rates}, '
                f'spin {self.mean_spin_rate:.6g} rad/s; spin ratio L3^2/(4 lambda1 |P|) = '
                f'{self.gyroscopic_ratio:.4g} (upright, it sleeps above 1), distance from the '
                f'separatrix 1 - m = {self.separatrix_distance:.3g}')


def _span(low: float, high: float) -> str:
    """Return both ends of a range in words, apart; one that is 0 but for rounding is 0."""
    dust = COINCIDE * min(max(abs(low), abs(high)), 1e300)
    ends = [0.0 if abs(x) <= dust else x for x in (low, high)]
    digits = next((n for n in range(4, 14) if len({f'{x:.{n}g}' for x in ends}) == 2), 4)
    return ' to '.join(f'{x:.{digits}g}' for x in ends)


def swing(top: Top, state: State) -> tuple[float, float]:
    """Return the least and the greatest cos(theta) between which the axis swings."""
    sin_half, cos_half = math.sin(0.5 * state.theta), math.cos(0.5 * state.theta)
    cubic = nutation_cubic(top.lambda1, top.gravity_torque, state.l3, state.lz, state.theta_dot,
                           sin_half, cos_half)
    scale = max(map(abs, cubic))
    if not math.isfinite(scale):        # next to a pole that it cannot reach: thrown far away
        return -1.0, 1.0
    f0, f1, f2, f3 = (x / (scale or 1.0) for x in cubic)
    down, up = -2.0 * cos_half ** 2, 2.0 * sin_half ** 2        # to u = -1 and u = 1
    if f0:
        low, high = _bisect(f0, f1, f2, f3, down), _bisect(f0, f1, f2, f3, up)
    elif f1 > 0.0:      # theta' = 0: one end is here, and f1 says on which side the other is
        low, high = 0.0, _bisect(f1, f2, f3, 0.0, up)
    else:
        low, high = _bisect(-f1, -f2, -f3, 0.0, down) if f1 else 0.0, 0.0
    u0 = math.cos(state.theta)
    return max(u0 + low, -1.0), min(u0 + high, 1.0)


def axis_rests(top: Top, state: State) -> bool:
    """Return whether theta stays as it is: sleeping, hanging at a pole, steady precession."""
    low, high = swing(top, state)
    return high - low <= COINCIDE


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
    moves = state.l3 != 0.0 or state.lz != 0.0
    if top.gravity_torque == 0.0:
        return 'free top' if moves or state.theta_dot else 'at rest'
    low, high = swing(top, state)
    rests = high - low <= coincide
    if rests and 1.0 - abs(low) <= coincide:
        if not moves:
            return 'at rest'
        if (low > 0.0) != (top.gravity_torque > 0.0):       # the centre of mass is below
            return 'hanging'
        stable = state.l3 * state.l3 > 4.0 * top.lambda1 * abs(top.gravity_torque)
        return 'sleeping' if stable else 'sleeping, unstable'
    if not moves:
        rotating = high >= 1.0 - coincide and low <= -1.0 + coincide
        return f'planar pendulum, {"rotating" if rotating else "swinging"}'
    return 'steady precession' if rests else _precessing_regime(state, low, high, coincide)


def _precessing_regime(state: State, low: float, high: float, coincide: float) -> str:
    l3, lz = state.l3, state.lz
    if l3 == 0.0:
        return 'spherical pendulum'
    if lz == l3 and high >= 1.0 - coincide:
        return 'through the top'
    if lz == -l3 and low <= -1.0 + coincide:
        return 'through the bottom'
    reversal = lz / l3          # cos(theta) at which phi' changes sign
    if min(abs(reversal - low), abs(reversal - high)) <= coincide * max(1.0, abs(reversal)):
        return 'cusps'
    return 'loops' if low < reversal < high else 'waves'


def effective_potential(top: Top, l3: float, lz: float, theta: Column) -> Column:
    """
    Return V(theta) [J] of lambda1 theta'^2/2 + V(theta) = E - L3^2/(2 lambda3).

    It is (Lz - L3 cos theta)^2/(2 lambda1 sin^2 theta) + P cos(theta); theta: (n,) [rad].
    """
    phi_dot = attitude.precession_rate(top, l3, lz, np.cos(0.5 * theta) ** 2,
                                       np.sin(0.5 * theta) ** 2)
    return (0.5 * top.lambda1 * (phi_dot * np.sin(theta)) ** 2
            + top.gravity_torque * np.cos(theta))


def precession_extremes(top: Top, state: State, theta_min: float,
                        theta_max: float) -> tuple[float, float]:
    """Return the least and the greatest phi' [rad/s] while theta swings between two tilts."""
    # They lie at the ends, or where d phi'/du = 0: L3 u^2 - 2 Lz u + L3 = 0.
    tilts = [theta_min, theta_max]
    l3, lz = state.l3, state.lz
    if abs(lz) > abs(l3):
        inner = math.acos(l3 / (lz + math.copysign(math.sqrt(lz * lz - l3 * l3), lz)))
        if theta_min < inner < theta_max:
            tilts.append(inner)
    rates = []
    for theta in tilts:
        cos2, sin2 = math.cos(0.5 * theta) ** 2, math.sin(0.5 * theta) ** 2
        singular = (theta == math.pi and lz + l3 != 0.0) or (sin2 == 0.0 and lz - l3 != 0.0)
        rates.append(math.copysign(math.inf, lz - l3 * math.cos(theta)) if singular
                     else attitude.precession_rate(top, l3, lz, cos2, sin2))
    return min(rates), max(rates)
