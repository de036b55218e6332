# SPDX-License-Identifier: Apache-2.0
"""
The attitude of the exact motion as short theta series about even quarter periods.

Away from the separatrix (m1 >= `theta_setup.FULL_CIRCLE_M1`) they are series in the circular
functions of v = (pi/2) Z and hold at every phase.  Near the separatrix they are series in
hyperbolic functions, and reach half a period either way from the nearest even quarter period:

    alpha = (R + i s J)(y)/D(y) exp i(rotation),   D from |alpha|^2 + |beta|^2 = 1.

An attitude is i beta = x + iy = (-s J + i R) exp(i rotation) over D, and i conj(alpha) = z + iw =
(s J + i R) exp(-i rotation) over D, with the R, J, s and rotation of beta and of alpha.
"""

from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.solvers.decimal_math import ONE, pi, sinh_cosh
from spinning_top_sim.solvers.nutation import QUARTER_PERIOD_ANGLE, NutationPhase
from spinning_top_sim.solvers.rotations import STEP_ANGLE, Rotations, Scratch
from spinning_top_sim.solvers.theta_series import Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion
from spinning_top_sim.solvers.times import Times

NEGLIGIBLE = Decimal('1e-18')           # beside the largest term
BLOCK = 16384           # times evaluated together: temporaries stay in the cache
HUGE_PAGE = 2 ** 18     # doubles
_SCRATCH = Scratch()


class AttitudeSeries:
    """The attitude of one motion."""

    def __init__(self, motion: ThetaMotion) -> None:
        self._hyperbolic = motion.alpha.full_circle is None
        v_rate, v_start = motion.quarter_rate / 4, (motion.quarter0 + motion.offset0) / 4
        largest_xi = ONE
        if self._hyperbolic:
            self._phase = NutationPhase(motion)
            self._stretch = float(motion.stretch)
            largest_xi = sinh_cosh(motion.stretch * pi() / 2)[0] ** 2

        def angle(factor: Factor) -> tuple[Decimal, Decimal]:
            rate, start = factor.rate / (2 * pi()), factor.phase_turns
            if self._hyperbolic:
                return rate, start
            # The drift -s y, with y = v, is part of the rotation.
            return rate - factor.sense * v_rate, start - factor.sense * v_start
        (alpha_rate, alpha_start), beta_angle = angle(motion.alpha), angle(motion.beta)
        angles = [beta_angle, (-alpha_rate, -alpha_start)]
        self._rotations = Rotations(angles if self._hyperbolic else
                                    [*angles, (v_rate, v_start)])
        self._drifts = np.array([[float(motion.beta.drift)], [-float(motion.alpha.drift)]])
        # First row of each factor (beta 0, alpha 2) whose sign is (-1)^(N/2).
        self._flipped = [k for k, factor in ((0, motion.beta), (2, motion.alpha))
                         if factor.crosses]
        series = (*_real_and_imaginary(motion.beta, -ONE), *_real_and_imaginary(motion.alpha, ONE))
        polynomials = [_polynomial(one, largest_xi) for one in series]
        coefficients = np.zeros((max(2, *map(len, polynomials)), 4))
        for k, polynomial in enumerate(polynomials):
            coefficients[:len(polynomial), k] = polynomial
        # By power of xi = sin^2 v or -sinh^2 x, then by series.
        self._coefficients = coefficients[:, :, np.newaxis]
        self._prefactors = [one.prefactor for one in series]

    def quaternion(self, times: Times) -> NDArray[np.float64]:
        """Return x, y, z, w at n times, (4, n)."""
        out = _rows_on_huge_pages(4, len(times))
        for first in range(0, len(times), BLOCK):
            block = slice(first, first + BLOCK)
            self._fill(out[:, block], times[block])
        return out

    def _fill(self, out: NDArray[np.float64], times: Times) -> None:
        series, squares, (scale, product, *_) = _SCRATCH.rows(3, 4, len(times))
        if self._hyperbolic:
            y, sin, cos, flip = self._hyperbolic_phase(times)
            cosines, sines = self._rotations.cosines_and_sines(
                times, self._drifts / STEP_ANGLE * y)
            self._series(-sin * sin, sin, cos, series)
            for k in self._flipped:
                series[k:k + 2] *= flip
        else:
            cosines, sines = (self._rotations.cosines_and_sines(times) if times.ns is None
                              else self._rotations.at_ns(times.ns))
            self._series(sines[2] * sines[2], sines[2], cosines[2], series)
        np.multiply(series, series, out=squares)
        np.sqrt(np.add.reduce(squares, out=scale), out=scale)
        series *= np.divide(1.0, scale, out=scale)
        for k in (0, 1):
            real, imag = series[2 * k], series[2 * k + 1]
            np.multiply(real, cosines[k], out=out[2 * k])
            out[2 * k] -= np.multiply(imag, sines[k], out=product)
            np.multiply(real, sines[k], out=out[2 * k + 1])
            out[2 * k + 1] += np.multiply(imag, cosines[k], out=product)

    def _series(self, xi: Column, sin: Column, cos: Column, out: NDArray[np.float64]) -> None:
        """Fill in -s J and R of beta, s J and R of alpha, (4, n)."""
        np.multiply(self._coefficients[-1], xi, out=out)
        for coefficient in self._coefficients[-2:0:-1]:
            out += coefficient
            out *= xi
        out += self._coefficients[0]
        for k, prefactor in enumerate(self._prefactors):
            for factor in ((), (cos,), (sin,), (sin, cos))[prefactor]:
                out[k] *= factor

    def _hyperbolic_phase(self, times: Times) -> tuple[Column, Column, Column, Column]:
        """Return y in [-pi/2, pi/2], sinh x, cosh x and (-1)^(N/2), N even and nearest."""
        quarters, y = self._phase.at(times)
        side = np.copysign(quarters.astype(np.int64) & 1, y)    # 0 at an even quarter period
        y -= QUARTER_PERIOD_ANGLE * side
        flip = 1.0 - ((quarters + side).astype(np.int64) & 2)
        growing = 0.5 * np.exp(self._stretch * y)
        falling = 0.25 / growing
        return y, growing - falling, growing + falling, flip


def _rows_on_huge_pages(count: int, n: int) -> NDArray[np.float64]:
    """Return an uninitialized array (count, n) that begins on a huge page if it fills half."""
    # numpy asks for huge pages for arrays of 4 MiB and more.  Clearing small pages, one by one,
    # takes a quarter of the time of an evaluation.
    size = count * n
    if size < HUGE_PAGE // 2:
        return np.empty((count, n))
    memory = np.empty(size + 2 * HUGE_PAGE)
    begin = -(memory.ctypes.data // memory.itemsize) % HUGE_PAGE
    return memory[begin:begin + size].reshape(count, n)


def _real_and_imaginary(factor: Factor, sense: Decimal) -> tuple[Series, Series]:
    """Return `sense` times s J, and R, of a factor about even quarter periods."""
    branch = factor.full_circle or factor.even
    return branch.imag.scaled(sense * factor.sense), branch.real.scaled(Decimal(factor.sign))


def _polynomial(series: Series, largest_xi: Decimal) -> list[float]:
    """Return the coefficients in xi of a theta series less its prefactor, lowest first."""
    exact = series.polynomial()
    sizes = [abs(x) * largest_xi ** power for power, x in enumerate(exact)]
    while len(exact) > 1 and sizes[len(exact) - 1] < NEGLIGIBLE * max(sizes):
        exact.pop()
    return [float(x) for x in exact]
