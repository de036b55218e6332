# SPDX-License-Identifier: Apache-2.0
"""
How a motion is handed over to another vertical, in whatever numbers it is given.

In the frame of a pivot with the acceleration a, gravity is g - a: the top is the same top about
another vertical.  A change of a leaves attitude and angular velocity as they are.  The exact
solution hands them over in multiprecision: rounded to doubles, the constants of the motion would
change, and its phase drift.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion
from spinning_top_sim.physics.pivot import Fractions
from spinning_top_sim.physics.top import State, Top, pole_momentum

# Numbers of Python or of gmpy2.
Real = Any
Complex = Any
# An axis nearer to the vertical than this [rad] is vertical.  In multiprecision, Lz - L3 keeps as
# many digits there as this has zeros; in doubles, the rounding of Lz changes the angular velocity
# of a tilted axis by as much as the tilt that is left out does, relative to L3/lambda1.
POLE_IN_BITS, POLE_IN_DOUBLES = 1e-30, 1.5e-8


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


def _sin_cos(angle: float) -> tuple[float, float]:
    return math.sin(angle), math.cos(angle)


class PreciseState(NamedTuple):
    """
    A state about some vertical, in any numbers.

    sin_half, cos_half : of theta/2, with theta in [0, pi]
    alpha, beta : complex numbers of any modulus with the arguments (phi + psi)/2, (phi - psi)/2
    """

    sin_half: Real
    cos_half: Real
    theta_dot: Real
    alpha: Complex
    beta: Complex
    l3: Real
    lz: Real

    @classmethod
    def of(cls, state: State, real: Callable[[Any], Real] = float,
           sin_cos: Callable[[Real], tuple[Real, Real]] = _sin_cos) -> PreciseState:
        """Return a state, perhaps a continued one, in numbers with this sine and cosine."""
        theta, phi, psi = (real(angle) / 2 for angle in (state.theta, state.phi, state.psi))
        alpha, beta = (cos + 1j * sin for sin, cos in map(sin_cos, (phi + psi, phi - psi)))
        (sine, cosine), theta_dot = sin_cos(theta), real(state.theta_dot)
        if sine < 0:
            sine, beta, theta_dot = -sine, -beta, -theta_dot
        if cosine < 0:
            cosine, alpha, theta_dot = -cosine, -alpha, -theta_dot
        return cls(sine, cosine, theta_dot, alpha, beta, real(state.l3), real(state.lz))

    @classmethod
    def of_posture(cls, top: Top, posture: Posture, pole: float = POLE_IN_BITS) -> PreciseState:
        """
        Return the state of a posture about the same vertical.

        A vertical axis has no precession angle of its own: there the angle is that of the line
        about which the axis turns, so that all of this motion is nutation.

        pole : within which tilt the axis is vertical [rad]
        """
        alpha, beta, transverse, _ = posture
        cosine2, sine2 = _norm(alpha), _norm(beta)
        size2 = cosine2 + sine2
        cosine, sine = (cosine2 / size2) ** 0.5, (sine2 / size2) ** 0.5
        none = 0 * sine
        l3 = posture.l3 + none          # in numbers of the same kind
        if 2 * min(sine, cosine) < pole:
            rate = abs(transverse)
            turn = -1j * transverse if rate else 1 + 0j         # exp(-i psi) theta'
            if sine < cosine:
                return cls(none, 1 + none, rate, alpha, alpha * turn, l3, l3)
            return cls(1 + none, none, rate, beta * turn.conjugate(), beta, l3, -l3)
        # alpha conj(beta) = sin(theta)/2 exp(i psi), omega_1 + i omega_2 = (-phi' sin(theta)
        # + i theta') exp(-i psi)
        rates = transverse * (alpha * beta.conjugate()) / (cosine * sine * size2)
        lz = (cosine - sine) * (cosine + sine) * l3 - (
            2 * top.lambda1 * rates.real * cosine * sine)
        return cls(sine, cosine, rates.imag, alpha, beta, l3, lz)

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
        theta = 2.0 * math.atan2(float(self.sin_half), float(self.cos_half))
        pole = pole_momentum(theta, float(self.l3))
        return State(theta=theta, theta_dot=float(self.theta_dot), phi=alpha + beta,
                     psi=alpha - beta, l3=float(self.l3),
                     lz=float(self.lz) if pole is None else pole)


class Vertical(NamedTuple):
    """
    The line of effective gravity, and a frame with its z axis along it.

    z is the direction that is up in the world, too: gravity has a sign.

    gravity : downwards along z positive [m/s^2]
    top : in this gravity
    alpha, beta : Cayley-Klein parameters of the least rotation from the world to the frame
    """

    gravity: Real
    top: Top
    alpha: Complex
    beta: Complex

    @classmethod
    def of(cls, top: Top, acceleration: Fractions, real: Callable[[Any], Real]) -> Vertical:
        """
        Return the vertical while the pivot accelerates so [m/s^2].

        real : makes a number of a fraction, or of a float
        """
        x, y, z = map(real, acceleration)
        z += real(top.gravity)
        size = (x * x + y * y + z * z) ** 0.5 * (-1 if z < 0 else 1)
        x, y, z = (x / size, y / size, z / size) if size else (0 * x, 0 * y, 1 + 0 * z)
        cosine = ((1 + z) / 2) ** 0.5
        return cls(size, replace(top, gravity=float(size)), cosine + 0j,
                   (x + 1j * y) / (2 * cosine))

    @property
    def rotation(self) -> Quaternion:
        """Q(world <- frame), in doubles."""
        x, y, z, w = (np.array([float(part)]) for part in (
            -self.beta.imag, self.beta.real, self.alpha.imag, self.alpha.real))
        return x, y, z, w

    def to_frame(self, posture: Posture) -> Posture:
        """Return a posture in the world as one in this frame."""
        return _turned(posture, self.alpha.conjugate(), -self.beta)

    def to_world(self, posture: Posture) -> Posture:
        """Return a posture in this frame as one in the world."""
        return _turned(posture, self.alpha, self.beta)


def state_of(top: Top, quaternion: NDArray[np.float64],
             angular_velocity: NDArray[np.float64]) -> State:
    """
    Return the state of a top with this attitude and angular velocity.

    quaternion : (4,) q(world <- body) as x, y, z, w, of any length but 0; the sum and the
        difference of phi and psi belong to its sign
    angular_velocity : (3,) in the world frame [rad/s]
    """
    x, y, z, w = unit = (quaternion / np.linalg.norm(quaternion)).tolist()
    w1, w2, w3 = (float(part) for part in attitude.rotated_back(
        unit, angular_velocity.tolist()))
    posture = Posture(complex(w, z), complex(y, -x), complex(w1, w2), top.lambda3 * w3)
    return PreciseState.of_posture(top, posture, pole=POLE_IN_DOUBLES).rounded()


def _norm(z: Complex) -> Real:
    return (z * z.conjugate()).real


def _turned(posture: Posture, a: Complex, b: Complex) -> Posture:
    """Return a posture after a rotation with the Cayley-Klein parameters a and b."""
    alpha, beta, *rest = posture
    return Posture(a * alpha - b * beta.conjugate(), a * beta + b * alpha.conjugate(), *rest)
