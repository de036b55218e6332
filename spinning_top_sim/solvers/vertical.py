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
    Attitude and angular velocity at one instant, in any numbers.

    alpha, beta : Cayley-Klein parameters of the body in the world, as in `physics.attitude`
    transverse : omega_1 + i omega_2 in the body [rad/s]
    l3 : angular momentum along the axis [kg m^2/s], which no force on the pivot changes
    theta_dot, lz : of a `State` about the same vertical, which the others tell less exactly
    """

    alpha: Complex
    beta: Complex
    transverse: Complex
    l3: Real
    theta_dot: Real | None = None
    lz: Real | None = None

    @classmethod
    def of(cls, top: Top, state: State | Posture, real: Callable[[Any], Real] = float,
           sin_cos: Callable[[Real], tuple[Real, Real]] = lambda x: (math.sin(x), math.cos(x)),
           ) -> Posture:
        """Return that of a state, which may be continued, in numbers with this sine and cosine."""
        if isinstance(state, Posture):
            return state
        half, phi, psi = (real(angle) / 2 for angle in (state.theta, state.phi, state.psi))
        (sine, cosine), *others = map(sin_cos, (half, phi + psi, phi - psi))
        alpha, beta = (z / abs(z) for z in (cos + 1j * sin for sin, cos in others))
        theta_dot, l3, lz = map(real, (state.theta_dot, state.l3, state.lz))
        across = 2 * sine * cosine * attitude.precession_rate(      # phi' sin(theta)
            top, l3, lz, cosine * cosine, sine * sine)
        transverse = (1j * theta_dot - across) * beta * alpha.conjugate()   # exp(-i psi)
        return cls(cosine * alpha, sine * beta, transverse, l3,
                   -theta_dot if (sine < 0) != (cosine < 0) else theta_dot, lz)

    def in_doubles(self) -> Posture:
        return Posture(complex(self.alpha), complex(self.beta), complex(self.transverse),
                       float(self.l3))

    def turned(self, a: Complex, b: Complex) -> Posture:
        """Return this posture after a rotation with the Cayley-Klein parameters a and b."""
        return Posture(a * self.alpha - b * self.beta.conjugate(),
                       a * self.beta + b * self.alpha.conjugate(), self.transverse, self.l3)

    def polar(self, top: Top, pole: float = POLE_IN_BITS) -> tuple[Real, ...]:
        """
        Return sin(theta/2), cos(theta/2), theta', Lz and two numbers, about the same vertical.

        theta is in [0, pi], and the arguments of the complex numbers, which have any modulus, are
        (phi + psi)/2 and (phi - psi)/2.  A vertical axis has no precession angle of its own: there
        it is that of the line about which the axis turns, so that all of this motion is nutation.

        pole : within which tilt an axis that is not that of a state is vertical [rad]
        """
        alpha, beta, transverse, l3, theta_dot, lz = self
        cosine, sine, size2 = abs(alpha), abs(beta), 1
        if lz is None:          # after turns the length is 1 but for rounding
            cosine2, sine2 = (alpha * alpha.conjugate()).real, (beta * beta.conjugate()).real
            size2 = cosine2 + sine2
            cosine, sine = (cosine2 / size2) ** 0.5, (sine2 / size2) ** 0.5
        l3 += 0 * sine          # in numbers of the same kind
        tilt = 2 * min(sine, cosine)
        if not tilt or (lz is None and tilt < pole):
            rate = abs(transverse) if theta_dot is None else theta_dot
            turn = -1j * transverse / rate if rate else 1 + 0j      # exp(-i psi)
            zero = 0 * sine
            if sine < cosine:
                return zero, 1 + zero, rate, l3, alpha, alpha * turn
            return 1 + zero, zero, rate, -l3, beta * turn.conjugate(), beta
        if theta_dot is None or lz is None:
            # alpha conj(beta) = sin(theta)/2 exp(i psi), omega_1 + i omega_2 = (-phi' sin(theta)
            # + i theta') exp(-i psi)
            rates = transverse * (alpha * beta.conjugate()) / (cosine * sine * size2)
            theta_dot, lz = rates.imag, (cosine - sine) * (cosine + sine) * l3 - (
                2 * top.lambda1 * rates.real * cosine * sine)
        return sine, cosine, theta_dot, lz, alpha, beta

    def state(self, top: Top, pole: float = POLE_IN_BITS) -> State:
        """Return the state about the same vertical; the arguments are those of `polar`."""
        sine, cosine, theta_dot, lz, *numbers = self.polar(top, pole)
        alpha, beta = (math.atan2(float(x.imag), float(x.real)) for x in numbers)
        theta, l3 = 2.0 * math.atan2(float(sine), float(cosine)), float(self.l3)
        lz_at_pole = pole_momentum(theta, l3)
        return State(theta=theta, theta_dot=float(theta_dot), phi=alpha + beta, psi=alpha - beta,
                     l3=l3, lz=float(lz) if lz_at_pole is None else lz_at_pole)


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
        x, y, z = (x / size, y / size, z / size) if size else (x, y, 1 + z)
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
        return posture.turned(self.alpha.conjugate(), -self.beta)

    def to_world(self, posture: Posture) -> Posture:
        """Return a posture in this frame as one in the world."""
        return posture.turned(self.alpha, self.beta)


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
    return posture.state(top, POLE_IN_DOUBLES)
