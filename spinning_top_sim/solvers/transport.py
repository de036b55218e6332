# SPDX-License-Identifier: Apache-2.0
"""
The form of the equations that the simulator steps by default: regular at every attitude.

Unknowns are the Cayley-Klein parameters and the horizontal angular momentum in the world,
m = i (L_x + i L_y)/(2 lambda1).  From q' = (1/2) omega q and L' = torque,

    alpha' =  i (Lz - c)/(2 lambda1) alpha + m conj(beta)
    beta'  =  i (Lz + c)/(2 lambda1) beta  - m conj(alpha)
    m'     = -(P/lambda1) alpha beta

Here the body frame turns about e3 at its true rate less chi: the known uniform
spin exp(+-i chi t/2), chi = L3/lambda3 - (L3 - c)/lambda1, is put on when a state is read, so the
step size follows the nutation and not the spin.  c = 0 carries the whole transverse rotation,
c = L3 transports the frame parallel; c = L3/2 centres the spectrum of alpha and beta about zero
and takes the fewest evaluations on cusps, the commonest of motions (docs/gauge.md).

The invariants |q| = 1, L.e3 = L3 and the energy are restored after each step and in each sample
(projection, Hairer, Lubich & Wanner, *Geometric Numerical Integration*, sect. IV.4).
"""

from __future__ import annotations

import cmath
import math

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.pairs import Pairs
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import Vector

# The energy error is taken out of the nutation rate where its square is this share of the
# largest |m|^2 or more: at a turning point the energy does not tell the rate.
NUTATION_SHARE = 1e-6
# (sin(theta)/2)^2 below which rounding in L.e3 would spoil the momentum more than it mends it.
POLE_SHARE = 1e-4


class TransportForm:
    """The equations above for one top and one motion; see `dormand_prince.Form`."""

    name = 'transport'
    number = complex

    def __init__(self, top: Top, start: State, rtol: float, atol: float,
                 spin_carried_share: float = 0.5) -> None:
        lambda1, l3, lz, torque = top.lambda1, start.l3, start.lz, top.gravity_torque
        self.top, self.l3, self.lz = top, l3, lz
        self.spin_carried = spin_carried_share * l3                     # c
        self._turn_a = 0.5j * (lz - self.spin_carried) / lambda1
        self._turn_b = 0.5j * (lz + self.spin_carried) / lambda1
        self._fall = complex(-torque / lambda1)
        self.spin_rate = l3 / top.lambda3 - (l3 - self.spin_carried) / lambda1   # chi
        self.start = self._vector(start)
        # What 2 lambda1 |m|^2 + P cos(theta) must stay; the rest of the energy is constant.
        self._energy = self._axis_energy(*self.start)
        # |m| never exceeds this: the scale of its error, as 1 is that of alpha and beta.  Close to
        # hanging the sum is what its rounding leaves.
        above_lowest = max(self._energy + abs(torque), 4.0 * math.ulp(1.0) * abs(torque))
        self._scale = math.sqrt(0.5 * above_lowest / lambda1) or 1.0
        self._tolerance = rtol + atol
        self._large_enough = NUTATION_SHARE * self._scale ** 2

    def _vector(self, start: State) -> Vector:
        top = self.top
        cosine, sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
        phi_dot = attitude.precession_rate(top, self.l3, self.lz, cosine * cosine, sine * sine)
        momentum = attitude.momentum_in_world(
            top, start.theta_dot, phi_dot, 2.0 * sine * cosine, cosine * cosine - sine * sine,
            self.l3, cmath.rect(1.0, start.phi))
        return (cosine * cmath.rect(1.0, 0.5 * (start.phi + start.psi)),
                sine * cmath.rect(1.0, 0.5 * (start.phi - start.psi)),
                0.5j * momentum / top.lambda1)

    @property
    def first_step(self) -> float:
        """A careful first step [s]: the control finds the right one within a few."""
        top = self.top
        rate = (self._scale + (abs(self.l3) + abs(self.lz)) / top.lambda1
                + math.sqrt(abs(top.gravity_torque) / top.lambda1))
        return 0.1 * self._tolerance ** 0.2 / rate

    def rates(self, alpha: complex, beta: complex, m: complex) -> Vector:
        """Return (alpha', beta', m')."""
        return (self._turn_a * alpha + m * beta.conjugate(),
                self._turn_b * beta - m * alpha.conjugate(),
                self._fall * (alpha * beta))

    def curvatures(self, y: Vector, rates: Vector) -> Vector:
        """Return (alpha'', beta'', m''): the equations differentiated once."""
        (a, b, m), (da, db, dm) = y, rates
        return (self._turn_a * da + dm * b.conjugate() + m * db.conjugate(),
                self._turn_b * db - dm * a.conjugate() - m * da.conjugate(),
                self._fall * (da * b + a * db))

    def error(self, y: Vector, y_new: Vector, difference: Vector) -> float:
        """Return the largest of the three errors, each over its scale and the tolerance."""
        da, db, dm = difference
        return max(abs(da), abs(db), abs(dm) / self._scale) / self._tolerance

    def check_step(self, y: Vector, y_new: Vector) -> None:
        """Nothing can go wrong silently in this form."""

    def _axis_energy(self, alpha: complex, beta: complex, m: complex) -> float:
        return (2.0 * self.top.lambda1 * attitude.squared_modulus(m) + self.top.gravity_torque
                * (attitude.squared_modulus(alpha) - attitude.squared_modulus(beta)))

    def project(self, y: Vector) -> Vector:
        """Return y with |q| = 1, then L.e3 = L3, then the energy restored along theta'."""
        alpha, beta, m = y
        cos2 = alpha.real * alpha.real + alpha.imag * alpha.imag
        sin2 = beta.real * beta.real + beta.imag * beta.imag
        shrink = 1.0 / math.sqrt(cos2 + sin2)
        alpha *= shrink
        beta *= shrink
        cos_theta = (cos2 - sin2) * shrink * shrink
        half_axis = alpha * beta                # (e3_x + i e3_y)/2
        share = shrink * shrink
        square = cos2 * sin2 * (share * share)
        if square <= POLE_SHARE:
            return alpha, beta, m
        lambda1 = self.top.lambda1
        # m conj(half_axis) = (u + i v): v carries L.e3, u the nutation rate.
        along = m * half_axis.conjugate()
        v = 0.25 * (self.l3 - self.lz * cos_theta) / lambda1
        u = along.real
        wanted = (self._energy - self.top.gravity_torque * cos_theta) / (2.0 * lambda1) * square
        if u * u > self._large_enough * square:
            root = wanted - v * v
            if root > 0.0:
                u = math.copysign(math.sqrt(root), u)
        return alpha, beta, complex(u, v) * half_axis / square

    def project_columns(self, alpha: Pairs, beta: Pairs, m: Pairs) -> tuple[Pairs, Pairs, Pairs]:
        """Return what `project` does, to the last bit, of columns."""
        import numpy as np  # noqa: PLC0415 - who reads one state at a time does without

        cos2, sin2 = attitude.squared_modulus(alpha), attitude.squared_modulus(beta)
        shrink = 1.0 / np.sqrt(cos2 + sin2)
        alpha, beta = alpha * shrink, beta * shrink
        cos_theta = (cos2 - sin2) * shrink * shrink
        half_axis = alpha * beta
        share = shrink * shrink
        square = cos2 * sin2 * (share * share)
        lambda1 = self.top.lambda1
        v = 0.25 * (self.l3 - self.lz * cos_theta) / lambda1
        u = (m * half_axis.conjugate()).real
        wanted = (self._energy - self.top.gravity_torque * cos_theta) / (2.0 * lambda1) * square
        root = wanted - v * v
        mended = (u * u > self._large_enough * square) & (root > 0.0)
        u = np.where(mended, np.copysign(np.sqrt(np.where(mended, root, 0.0)), u), u)
        at_pole = square <= POLE_SHARE
        if not at_pole.any():
            return alpha, beta, Pairs(u, v) * half_axis / square
        elsewhere = Pairs(u, v) * half_axis / np.where(at_pole, 1.0, square)
        return alpha, beta, Pairs(np.where(at_pole, m.real, elsewhere.real),
                                  np.where(at_pole, m.imag, elsewhere.imag))

    def project_on_lines(self, y: Vector, alpha: tuple[float, float],
                         beta: tuple[float, float]) -> Vector:
        """
        Return what `project` does, for a top that passes a pole: Lz = L3 or Lz = -L3.

        alpha, beta: of y, as signed moduli and phases; of one that can vanish the phase is known
        without the steps.  Then the meridian of the axis is, at a pole too, and m has its place.
        """
        (cosine, phase_a), (sine, phase_b) = alpha, beta
        shrink = 1.0 / math.hypot(cosine, sine)
        cosine *= shrink
        sine *= shrink
        lambda1 = self.top.lambda1
        # As above, with L3 -+ Lz cos(theta) = 2 L3 sin^2(theta/2) or 2 L3 cos^2(theta/2).
        v = 0.0
        if self.l3:
            v = 0.5 * self.l3 / lambda1 * (sine / cosine if self.lz == self.l3 else cosine / sine)
        meridian = cmath.rect(1.0, phase_a + phase_b)
        half_axis = cosine * sine
        if half_axis * half_axis > POLE_SHARE:      # the steps' own meridian goes with their m
            u = (y[2] * (y[0] * y[1]).conjugate()).real / half_axis
        else:
            u = (y[2] * meridian.conjugate()).real
        if u * u > self._large_enough:
            root = (self._energy - self.top.gravity_torque * (cosine - sine) * (cosine + sine)
                    ) / (2.0 * lambda1) - v * v
            if root > 0.0:
                u = math.copysign(math.sqrt(root), u)
        return (cmath.rect(cosine, phase_a), cmath.rect(sine, phase_b),
                complex(u, v) * meridian)
