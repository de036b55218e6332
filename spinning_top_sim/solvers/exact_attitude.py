# SPDX-License-Identifier: Apache-2.0
"""
The attitude of the exact motion as short theta series of one phase, fast and without cases.

Away from the separatrix (m1 >= `theta_setup.FULL_CIRCLE_M1`) the series of the even quarter
periods hold at every phase v = (pi/2) Z:

    alpha = (R + i s J)(v)/D(v) exp i(rotation),   D from |alpha|^2 + |beta|^2 = 1.

An attitude is i beta = x + iy = (-s J + i R) exp(i rotation) over D, and i conj(alpha) = z + iw =
(s J + i R) exp(-i rotation) over D, with the R, J, s and rotation of beta and of alpha.
"""

from __future__ import annotations

from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Quaternion
from spinning_top_sim.solvers.decimal_math import ONE, ZERO, pi
from spinning_top_sim.solvers.rotations import Rotations
from spinning_top_sim.solvers.theta_series import Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion
from spinning_top_sim.solvers.times import Times

NEGLIGIBLE = Decimal('1e-18')           # beside the largest coefficient
BLOCK = 16384           # times evaluated together: temporaries stay in the cache


class AttitudeSeries:
    """The attitude of a motion that has full-circle series; see `ThetaMotion.full_circle`."""

    def __init__(self, motion: ThetaMotion) -> None:
        v_rate, v_start = motion.quarter_rate / 4, (motion.quarter0 + motion.offset0) / 4

        def angle(factor: Factor) -> tuple[Decimal, Decimal]:
            # The drift -s y, with y = v, is part of the rotation.
            return (factor.rate / (2 * pi()) - factor.sense * v_rate,
                    factor.phase_turns - factor.sense * v_start)
        (alpha_rate, alpha_start), beta_angle = angle(motion.alpha), angle(motion.beta)
        self._rotations = Rotations(
            (beta_angle, (-alpha_rate, -alpha_start), (v_rate, v_start)))
        series = (*_real_and_imaginary(motion.beta, -ONE), *_real_and_imaginary(motion.alpha, ONE))
        polynomials = [_polynomial(one) for one in series]
        coefficients = np.zeros((max(2, *map(len, polynomials)), 4))
        for k, polynomial in enumerate(polynomials):
            coefficients[:len(polynomial), k] = polynomial
        # By power of sin^2 v, then by series.
        self._coefficients = coefficients[:, :, np.newaxis]
        self._prefactors = [one.prefactor for one in series]

    def quaternion(self, times: Times) -> Quaternion:
        """Return x, y, z, w at n times."""
        out = np.empty((4, len(times)))
        for first in range(0, len(times), BLOCK):
            block = slice(first, first + BLOCK)
            self._fill(out[:, block], times[block])
        x, y, z, w = out
        return x, y, z, w

    def _fill(self, out: NDArray[np.float64], times: Times) -> None:
        cosines, sines = (self._rotations.cosines_and_sines(times) if times.ns is None
                          else self._rotations.at_ns(times.ns))
        cos_v, sin_v = cosines[2], sines[2]
        square = sin_v * sin_v
        series = self._coefficients[-1] * square
        for coefficient in self._coefficients[-2:0:-1]:
            series += coefficient
            series *= square
        series += self._coefficients[0]
        for k, prefactor in enumerate(self._prefactors):
            for factor in ((), (cos_v,), (sin_v,), (sin_v, cos_v))[prefactor]:
                series[k] *= factor
        squares = series * series
        scale = (squares[0] + squares[1]) + (squares[2] + squares[3])
        series *= 1.0 / np.sqrt(scale)
        for k in (0, 1):
            real, imag = series[2 * k], series[2 * k + 1]
            np.subtract(real * cosines[k], imag * sines[k], out=out[2 * k])
            np.add(real * sines[k], imag * cosines[k], out=out[2 * k + 1])


def _real_and_imaginary(factor: Factor, sense: Decimal) -> tuple[Series, Series]:
    """Return `sense` times s J, and R, of a factor over the full circle."""
    branch = factor.full_circle
    assert branch is not None
    imag = branch.imag or Series('cos even', (ZERO,))
    return imag.scaled(sense * factor.sense), branch.real.scaled(Decimal(factor.sign))


def _polynomial(series: Series) -> list[float]:
    """Return the coefficients in sin^2 v of a theta series less its prefactor, lowest first."""
    exact = series.polynomial()
    largest = max(map(abs, exact))
    while len(exact) > 1 and abs(exact[-1]) < NEGLIGIBLE * largest:
        exact.pop()
    return [float(x) for x in exact]
