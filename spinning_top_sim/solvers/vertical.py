# SPDX-License-Identifier: Apache-2.0
"""
How a motion is handed over to another vertical, in whatever numbers it is given.

In the frame of a pivot with the acceleration a, gravity is g - a: the top is the same top about
another vertical.  A change of a leaves attitude and angular velocity as they are.  The exact
solution hands them over in multiprecision: in doubles every change would move the constants of
the motion by a rounding, and the phase would drift by that much times the angle that follows.
Steps hand them over in doubles.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion
from spinning_top_sim.physics.pivot import Fractions
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top

# Numbers of Python or of gmpy2.
Real = Any
Complex = Any
# An axis nearer to the vertical than this [rad] is vertical.  Lz - L3 keeps as many digits there
# as this has zeros.
POLE_IN_BITS = 1e-30
# If the distance by which a motion misses a pole is less than this share of the largest possible,
# it passes exactly: the set-up squares the share, and keeps some 40 digits.
THROUGH = 1e-19


class Posture(NamedTuple):
    """
    Attitude and angular velocity at one instant.

    alpha, beta : Cayley-Klein parameters of the body in the world, as in `physics.attitude`
    transverse : omega_1 + i omega_2 in the body [rad/s]
    l3 : angular momentum along the axis [kg m^2/s], which no force on the pivot changes
    """

    alpha: Complex
    beta: Complex
    transverse: Complex
    l3: float

    def in_doubles(self) -> Posture:
        return Posture(complex(self.alpha), complex(self.beta), complex(self.transverse), self.l3)


class PreciseState(NamedTuple):
    """
    A state about some vertical.

    sin_half, cos_half : of theta/2, with theta in [0, pi]
    theta_dot : [rad/s]
    alpha, beta : complex numbers of any modulus with the arguments (phi + psi)/2, (phi - psi)/2
    l3, lz : [kg m^2/s]
    """

    sin_half: Real
    cos_half: Real
    theta_dot: Real
    alpha: Complex
    beta: Complex
    l3: Real
    lz: Real

    @classmethod
    def of(cls, state: State) -> PreciseState:
        """Return a state in doubles; theta may be any number."""
        return cls(math.sin(0.5 * state.theta), math.cos(0.5 * state.theta), state.theta_dot,
                   cmath.rect(1.0, 0.5 * state.phi + 0.5 * state.psi),
                   cmath.rect(1.0, 0.5 * state.phi - 0.5 * state.psi), state.l3, state.lz)

    def posture(self, top: Top) -> Posture:
        """Return the posture about the same vertical."""
        alpha, beta = (z / abs(z) for z in (self.alpha, self.beta))
        cosine, sine = self.cos_half, self.sin_half
        across = 2 * sine * cosine * attitude.precession_rate(      # phi' sin(theta)
            top, self.l3, self.lz, cosine * cosine, sine * sine)
        # exp(-i psi)
        return Posture(cosine * alpha, sine * beta,
                       (1j * self.theta_dot - across) * beta * alpha.conjugate(), float(self.l3))

    def rounded(self) -> State:
        """Return the state in doubles."""
        alpha, beta = (math.atan2(float(x.imag), float(x.real)) for x in (self.alpha, self.beta))
        l3 = float(self.l3)
        return State(
            theta=2.0 * math.atan2(float(self.sin_half), float(self.cos_half)),
            theta_dot=float(self.theta_dot), phi=alpha + beta, psi=alpha - beta, l3=l3,
            lz=float(self.lz) if self.sin_half else l3)


class Vertical(NamedTuple):
    """
    The line of effective gravity, and a frame with its z axis along it.

    Of the two directions z is the one on the side of the axis, and gravity has a sign: the axis
    can only meet the pole theta = 0, where floating-point numbers are dense.  Without effective
    gravity z stays the line of the world's vertical.

    gravity : downwards along z positive [m/s^2]
    top : in this gravity
    alpha, beta : Cayley-Klein parameters of the least rotation from the world to the frame
    """

    gravity: Real
    top: Top
    alpha: Complex
    beta: Complex

    @classmethod
    def of(cls, top: Top, posture: Posture, acceleration: Fractions,
           real: Callable[[Any], Real]) -> Vertical:
        """
        Return the vertical of a posture while the pivot accelerates so [m/s^2].

        real : makes a number of a fraction, or of a float
        """
        x, y, z = map(real, acceleration)
        z += real(top.gravity)
        size = (x * x + y * y + z * z) ** 0.5
        x, y, z = (x / size, y / size, z / size) if size else (0 * x, 0 * y, 1 + 0 * z)
        # The axis is (2 alpha beta, |alpha|^2 - |beta|^2).
        level = 2 * posture.alpha * posture.beta
        height = _norm(posture.alpha) - _norm(posture.beta)
        if x * level.real + y * level.imag + z * height < 0:
            x, y, z, size = -x, -y, -z, -size
        return cls(size, replace(top, gravity=float(size)), *_least_rotation(x, y, z))

    @property
    def rotation(self) -> Quaternion:
        """Q(world <- frame), in doubles."""
        x, y, z, w = (np.array([float(part)]) for part in (
            -self.beta.imag, self.beta.real, self.alpha.imag, self.alpha.real))
        return x, y, z, w

    def to_frame(self, posture: Posture) -> Posture:
        """Return a posture in the world as one in this frame."""
        alpha, beta = _product(self.alpha.conjugate(), -self.beta, posture.alpha, posture.beta)
        return posture._replace(alpha=alpha, beta=beta)

    def to_world(self, posture: Posture) -> Posture:
        """Return a posture in this frame as one in the world."""
        alpha, beta = _product(self.alpha, self.beta, posture.alpha, posture.beta)
        return posture._replace(alpha=alpha, beta=beta)

    def state_of(self, posture: Posture, real: Callable[[Any], Real]) -> PreciseState:
        """Return a posture in this frame as a state; real as in `of`."""
        top, (alpha, beta, transverse, _) = self.top, posture
        cosine2, sine2, l3 = _norm(alpha), _norm(beta), real(posture.l3)
        size2 = cosine2 + sine2
        cosine, sine = (cosine2 / size2) ** 0.5, (sine2 / size2) ** 0.5
        if 2 * sine < POLE_IN_BITS:     # all the motion of the axis is nutation: psi from omega
            theta_dot = abs(transverse)
            beta = alpha * (-1j * transverse) if theta_dot else alpha
            return PreciseState(0 * sine, 1 + 0 * sine, theta_dot, alpha, beta, l3, l3)
        # alpha conj(beta) = sin(theta)/2 exp(i psi), omega_1 + i omega_2 = (-phi' sin(theta)
        # + i theta') exp(-i psi)
        rates = transverse * (alpha * beta.conjugate())
        half_tilt = cosine * sine
        tilt, unit, lambda1 = 2 * half_tilt, half_tilt * size2, real(top.lambda1)
        lz = (1 - 2 * sine * sine) * l3 - lambda1 * rates.real / unit * tilt
        most2 = THROUGH ** 2 * tilt * tilt * (l3 * l3 * tilt * tilt + lambda1 * (
            lambda1 * _norm(transverse)
            + abs(self.gravity * real(top.mass) * real(top.com_distance))))
        for pole in (l3, -l3):
            if (lz - pole) ** 2 <= most2:
                lz = pole or 0 * pole
        return PreciseState(sine, cosine, rates.imag / unit, alpha, beta, l3, lz)


def posture_at(states: States) -> Posture:
    """Return the posture of states (n = 1) in the world, as far as doubles know it."""
    x, y, z, w, o1, o2 = (float(part[0]) for part in (
        *states.rows_quaternion, *states.transverse_velocity))
    return Posture(complex(w, z), complex(y, -x), complex(o1, o2), states.start.l3)


def _norm(z: Complex) -> Real:
    return (z * z.conjugate()).real


def _least_rotation(x: Real, y: Real, z: Real) -> tuple[Complex, Complex]:
    """Return the Cayley-Klein parameters of the least rotation of (0, 0, 1) to a unit vector."""
    level = (x * x + y * y) ** 0.5
    if not level:                   # perhaps a half turn, about the x axis
        return (z + 0j, 0j * z) if z > 0 else (0j * z, 1j * z)
    if z > 0:
        cosine = ((1 + z) / 2) ** 0.5
        sine = level / (2 * cosine)
    else:
        sine = ((1 - z) / 2) ** 0.5
        cosine = level / (2 * sine)
    return cosine + 0j, sine / level * (x + 1j * y)


def _product(a: Complex, b: Complex, c: Complex, d: Complex) -> tuple[Complex, Complex]:
    """Return the Cayley-Klein parameters of two rotations: (a, b) after (c, d)."""
    return a * c - b * d.conjugate(), a * d + b * c.conjugate()
