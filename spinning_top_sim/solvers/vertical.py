# SPDX-License-Identifier: Apache-2.0
"""
The exact motion of a top while its pivot accelerates uniformly, and how it is handed over.

In the frame of a pivot with the acceleration a, gravity is g - a: the top is the same top about
another vertical.  A change of a leaves attitude and angular velocity as they are.  They are handed
over in multiprecision: in doubles every change would move the constants of the motion by a
rounding, and the phase would drift by that much times the angle that follows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from gmpy2 import mpc, mpfr, norm, sin_cos, sqrt

from spinning_top_sim.physics.attitude import Column, Quaternion
from spinning_top_sim.physics.pivot import Fractions
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ClosedForm, ThetaStates, axis_rate
from spinning_top_sim.solvers.multiprecision import IMAGINARY, ONE, ZERO, as_mpfr, phase, precision
from spinning_top_sim.solvers.theta_point import cayley_klein, transverse_velocity
from spinning_top_sim.solvers.theta_setup import PreciseState, set_up
from spinning_top_sim.solvers.times import Times

# An axis nearer to the vertical than this [rad] is vertical.  Lz - L3 keeps as many digits there
# as this has zeros.
POLE_IN_BITS = 1e-30
# If the distance by which a motion misses a pole is less than this share of the largest possible,
# it passes exactly: the set-up squares the share, and keeps some 40 digits.
THROUGH = 1e-19


class Posture(NamedTuple):
    """
    Attitude and angular velocity of a top at one instant, in multiprecision.

    alpha, beta : Cayley-Klein parameters of the body in the world, as in `physics.attitude`
    transverse : omega_1 + i omega_2 in the body [rad/s]
    l3 : angular momentum along the axis [kg m^2/s], which no force on the pivot changes
    """

    alpha: mpc
    beta: mpc
    transverse: mpc
    l3: float


class Vertical(NamedTuple):
    """
    The line of effective gravity, and a frame with its z axis along it.

    Of the two directions z is the one on the side of the axis, and gravity has a sign: the axis
    can only meet the pole theta = 0, where floating-point numbers are dense.  Without effective
    gravity z stays the line of the world's vertical.

    gravity : downwards along z positive [m/s^2]
    top : in this gravity
    alpha, beta : Cayley-Klein parameters of the least rotation from the world to the frame
    rotation : the same, q(world <- frame), in doubles
    """

    gravity: mpfr
    top: Top
    alpha: mpc
    beta: mpc
    rotation: Quaternion

    def state_of(self, posture: Posture) -> PreciseState:
        """Return a posture as a state in this frame."""
        top, transverse = self.top, posture.transverse
        alpha, beta = _product(self.alpha.conjugate(), -self.beta, posture.alpha, posture.beta)
        cosine2, sine2 = norm(alpha), norm(beta)
        size2, l3 = cosine2 + sine2, mpfr(posture.l3)
        cosine, sine = sqrt(cosine2 / size2), sqrt(sine2 / size2)
        if 2 * sine < POLE_IN_BITS:     # all the motion of the axis is nutation: psi from omega
            theta_dot = abs(transverse)
            beta = alpha * (-IMAGINARY * transverse) if theta_dot else alpha
            return PreciseState(ZERO, ONE, theta_dot, alpha, beta, l3, l3)
        # alpha conj(beta) = sin(theta)/2 exp(i psi), omega_1 + i omega_2 = (-phi' sin(theta)
        # + i theta') exp(-i psi)
        rates = transverse * (alpha * beta.conjugate())
        half_tilt = cosine * sine
        tilt, unit, lambda1 = 2 * half_tilt, half_tilt * size2, as_mpfr(top.lambda1)
        lz = (1 - 2 * sine * sine) * l3 - lambda1 * rates.real / unit * tilt
        most2 = THROUGH ** 2 * tilt * tilt * (l3 * l3 * tilt * tilt + lambda1 * (
            lambda1 * norm(transverse)
            + abs(self.gravity * as_mpfr(top.mass) * as_mpfr(top.com_distance))))
        for pole in (l3, -l3):
            if (lz - pole) ** 2 <= most2:
                lz = pole or ZERO
        return PreciseState(sine, cosine, rates.imag / unit, alpha, beta, l3, lz)


class AcceleratedMotion(ClosedForm):
    """
    The exact motion while the pivot accelerates uniformly, in the frame of `vertical`.

    `States` of it have their attitude, theta, phi and Lz about that vertical.  Rates in the body
    and specific forces are those of the moving top as they are.

    Parameters
    ----------
    top : Top
        In the gravity of the world.
    posture : Posture
        At t = 0.
    acceleration : (3,)
        Of the pivot in the world [m/s^2].
    """

    def __init__(self, top: Top, posture: Posture, acceleration: Fractions) -> None:
        self.vertical, precise_start = about_vertical(top, posture, acceleration)
        self._posture, self.precise_start = posture, precise_start
        self._motion = set_up(top, self.vertical.gravity, precise_start)
        super().__init__(self.vertical.top, self._motion, precise_start.l3, precise_start.lz)

    @cached_property
    def start(self) -> State:       # type: ignore[override]
        return rounded(self.precise_start)

    def _states_at(self, times: Times) -> States:
        return AcceleratedStates(self, times)

    def posture(self, ns: int) -> Posture:
        """
        Return the posture in the world at a time [ns] since the start.

        It is right to 38 digits, times what the motion makes of such an error.
        """
        if not ns:                  # perhaps at a pole, where the axis does not tell its rates
            return self._posture
        with precision():
            vertical, lambda1 = self.vertical, as_mpfr(self.top.lambda1)
            alpha, beta, u_dot = cayley_klein(self._motion, mpfr(ns) / 10 ** 9)
            transverse = transverse_velocity(lambda1, self.precise_start, alpha, beta, u_dot)
            alpha, beta = _product(vertical.alpha, vertical.beta, alpha, beta)
            return Posture(alpha, beta, transverse, self._posture.l3)


class AcceleratedStates(ThetaStates):
    """States of such a motion."""

    def __init__(self, motion: AcceleratedMotion, times: Times) -> None:
        super().__init__(motion.top, motion.start, motion.arrays, times)
        self._rates = motion.bottom_rate, motion.top_rate

    def _across(self) -> Column:
        (cosine, sine), (bottom_rate, top_rate) = self._rows('half_theta'), self._rates
        if self._arrays.on_line or not self._arrays.u_dot.any():
            return axis_rate(bottom_rate, top_rate, cosine, sine)
        # Of two sums that may cancel, the one with the smaller terms.  The usual one cancels
        # where a fast top hardly precesses.
        one, two = self._rows('across_terms')
        tangent: Column = sine / cosine
        bottom, top = bottom_rate * tangent, top_rate / tangent
        cancels = np.abs(bottom) + np.abs(top) > np.abs(one) + np.abs(two)
        across: Column = np.where(cancels, one + two, bottom + top)
        return across


@lru_cache(64)
def _verticals(top: Top, acceleration: Fractions,
               ) -> tuple[tuple[mpfr, mpfr, mpfr], Vertical, Vertical]:
    """Return the upward line of effective gravity, and the verticals along and against it."""
    x, y, z = (mpfr(a.numerator) / a.denominator for a in acceleration)
    z += mpfr(top.gravity)
    size = sqrt(x * x + y * y + z * z)
    x, y, z = line = (x / size, y / size, z / size) if size else (ZERO, ZERO, ONE)
    return line, _upright(top, size, x, y, z), _upright(top, -size, -x, -y, -z)


def _upright(top: Top, gravity: mpfr, x: mpfr, y: mpfr, z: mpfr) -> Vertical:
    alpha, beta = _least_rotation(x, y, z)
    qx, qy, qz, qw = (np.array([float(part)]) for part in (
        -beta.imag, beta.real, alpha.imag, alpha.real))
    return Vertical(gravity, replace(top, gravity=float(gravity)), alpha, beta, (qx, qy, qz, qw))


def about_vertical(top: Top, posture: Posture, acceleration: Fractions,
                   ) -> tuple[Vertical, PreciseState]:
    """Return the vertical while the pivot accelerates so, and the state there."""
    with precision():
        (x, y, z), up, down = _verticals(top, acceleration)
        # The axis is (2 alpha beta, |alpha|^2 - |beta|^2).
        level = 2 * posture.alpha * posture.beta
        height = norm(posture.alpha) - norm(posture.beta)
        vertical = up if x * level.real + y * level.imag + z * height >= 0 else down
        return vertical, vertical.state_of(posture)


def rounded(start: PreciseState) -> State:
    """Return a state in doubles."""
    alpha, beta = (math.atan2(float(x.imag), float(x.real)) for x in (start.alpha, start.beta))
    l3 = float(start.l3)
    return State(
        theta=min(2.0 * math.asin(float(start.sin_half)), 0.5 * math.pi),
        theta_dot=float(start.theta_dot), phi=alpha + beta, psi=alpha - beta, l3=l3,
        lz=float(start.lz) if start.sin_half else l3)


def posture_of(top: Top, state: State) -> Posture:
    """Return the posture of a state about the vertical of the world."""
    with precision():
        sine, cosine = sin_cos(mpfr(state.theta) / 2)
        half_phi, half_psi = (phase(mpfr(angle) / 2) for angle in (state.phi, state.psi))
        back = half_psi.conjugate()
        l3, lz, two_lambda1 = mpfr(state.l3), mpfr(state.lz), 2 * as_mpfr(top.lambda1)
        across = ZERO               # phi' sin(theta)
        if lz + l3:
            across += (lz + l3) / two_lambda1 * sine / cosine
        if lz - l3:
            across += (lz - l3) / two_lambda1 * cosine / sine
        return Posture(cosine * (half_phi * half_psi), sine * (half_phi * back),
                       (IMAGINARY * mpfr(state.theta_dot) - across) * (back * back), state.l3)


def posture_at(states: States) -> Posture:
    """Return the posture of states (n = 1) in the world, as far as doubles know it."""
    x, y, z, w, o1, o2 = (float(part[0]) for part in (
        *states.rows_quaternion, *states.transverse_velocity))
    return Posture(mpc(complex(w, z)), mpc(complex(y, -x)), mpc(complex(o1, o2)), states.start.l3)


def _least_rotation(x: mpfr, y: mpfr, z: mpfr) -> tuple[mpc, mpc]:
    """Return the Cayley-Klein parameters of the least rotation of (0, 0, 1) to a unit vector."""
    level = sqrt(x * x + y * y)
    if not level:                   # perhaps a half turn, about the x axis
        return (mpc(1), mpc(0)) if z > 0 else (mpc(0), -IMAGINARY)
    if z > 0:
        cosine = sqrt((1 + z) / 2)
        sine = level / (2 * cosine)
    else:
        sine = sqrt((1 - z) / 2)
        cosine = level / (2 * sine)
    return mpc(cosine), sine / level * (x + IMAGINARY * y)


def _product(a: mpc, b: mpc, c: mpc, d: mpc) -> tuple[mpc, mpc]:
    """Return the Cayley-Klein parameters of two rotations: (a, b) after (c, d)."""
    return a * c - b * d.conjugate(), a * d + b * c.conjugate()
