# SPDX-License-Identifier: Apache-2.0
"""
The attitude alone, one state at a time, as fast as Python goes.

Away from the separatrix a factor is a sum of few waves, all round: with v = (pi/2) Z

    alpha D = exp i(rate t + phase) sum of c_k exp(2 i k v),   c_k real

so that three angles, all linear in time, are all that a quaternion takes, without cases; and a sum
of waves is p(cos 2v) + i sin 2v r(cos 2v) with short polynomials.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from math import cos, sin
from typing import NamedTuple

from spinning_top_sim.solvers.long_decimals import (
    FIXED_HALF,
    FRACTION_MASK,
    RADIANS_PER_UNIT,
    FixedRate,
    pi,
)
from spinning_top_sim.solvers.theta_series import Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion

Quaternion = tuple[float, float, float, float]

NEGLIGIBLE = 1e-18      # beside the largest wave
# cos kx and sin kx / sin x as polynomials in cos x [DLMF 18.5.1, 18.5.2].
CHEBYSHEV_T = ((1,), (0, 1), (-1, 0, 2), (0, -3, 0, 4), (1, 0, -8, 0, 8))
CHEBYSHEV_U = ((), (1,), (0, 2), (-1, 0, 4), (0, -4, 0, 8))
# Fractions of a turn are taken from -1/2 on: half the rounding of those from 0 on.
HALF_TURN = Decimal('0.5')
MOST_WAVES = 4          # k of the last, with a nome of exp(-pi)
FEW_WAVES = 2


def modes(real: Series, imag: Series | None) -> dict[int, complex]:
    """Return c_n with R + i J = sum of c_n exp(i n v), for theta series in the real form."""
    found: dict[int, complex] = {}
    for series, unit in ((real, 1.0), (imag, 1.0j)):
        if series is None:
            continue
        is_sine = series.kind.startswith('sin')
        for k, weight in enumerate(series.weights):
            n = 2 * k + series.kind.endswith('odd')
            half = 0.5 * float(weight) * unit * (-1.0j if is_sine else 1.0)
            found[n] = found.get(n, 0.0) + half
            found[-n] = found.get(-n, 0.0) + (-half if is_sine else half)
    largest = max(abs(c) for c in found.values())
    return {n: c for n, c in found.items() if abs(c) > NEGLIGIBLE * largest} or {0: 0.0}


class _Waves(NamedTuple):
    """A factor times D: exp 2 pi i (rotation) (p(cos 2v) + i sin 2v r(cos 2v)), lowest first."""

    rotation: FixedRate
    p: tuple[float, ...]
    r: tuple[float, ...]

    @classmethod
    def of(cls, factor: Factor, v_rate: Decimal, v_start: Decimal) -> _Waves:
        """Take a factor, and v in turns per second and at the start."""
        assert factor.full_circle is not None
        branch = factor.full_circle
        waves = modes(branch.real.scaled(Decimal(factor.sign)),
                      branch.imag and branch.imag.scaled(Decimal(factor.sense)))
        rate, start = factor.rate / (2 * pi()), factor.phase_turns
        # A complex factor turns by -s v as well, which makes its odd waves even ones; those of a
        # real one are made even by a turn of v, and real by a quarter turn where they are sines.
        shift = factor.sense
        if not factor.sense and any(n % 2 for n in waves):
            shift = 1
            rate, start = rate + v_rate, start + v_start
        if all(c.real == 0.0 for c in waves.values()) and any(waves.values()):
            start += Decimal('0.25')
            waves = {n: -1j * c for n, c in waves.items()}
        even = {(n - shift) // 2: c.real for n, c in waves.items()}
        cosines, sines = {0: 0.0}, {0: 0.0}
        for k, c in even.items():
            cosines[abs(k)] = cosines.get(abs(k), 0.0) + c
            sines[abs(k)] = sines.get(abs(k), 0.0) + (c if k > 0 else -c)
        return cls(FixedRate.of(rate, start + HALF_TURN), _chebyshev(cosines, CHEBYSHEV_T),
                   _chebyshev(sines, CHEBYSHEV_U)[:-1])


def _chebyshev(amplitudes: dict[int, float], polynomials: tuple[tuple[int, ...], ...]
               ) -> tuple[float, ...]:
    """Return the coefficients, lowest first, of a sum of amplitudes times polynomials."""
    total = [0.0] * (MOST_WAVES + 1)
    for k, amplitude in amplitudes.items():
        if k <= MOST_WAVES:
            for i, coefficient in enumerate(polynomials[k]):
                total[i] += amplitude * coefficient
    return tuple(total)


def too_late(time: str, time_limit: float) -> ValueError:
    """Return the refusal of a time at which nothing is left of a phase."""
    return ValueError(f't = {time}: must be finite and within {time_limit:.6g} s, '
                      f'where a phase of this motion reaches 2^52 turns')


def attitude_by_waves(motion: ThetaMotion, ns_limit: int, time_limit: float
                      ) -> Callable[[int], Quaternion] | None:
    """
    Return a function of nanoseconds after the start to (x, y, z, w); see `ExactSolution`.

    None where the series would need more waves: m > 1/2.
    """
    if motion.imaginary:
        return None
    v_rate, v_start = motion.quarter_rate / 4, (motion.quarter0 + motion.offset0) / 4
    phase = FixedRate.of(2 * v_rate, 2 * v_start + HALF_TURN)
    assert motion.full_circle is not None
    denominator = _chebyshev(
        {k: float(weight) for k, weight in enumerate(motion.full_circle.weights)}, CHEBYSHEV_T)
    alpha, beta = (_Waves.of(factor, v_rate, v_start) for factor in (motion.alpha, motion.beta))
    few = not any((*alpha.p[FEW_WAVES + 1:], *alpha.r[FEW_WAVES:],
                   *beta.p[FEW_WAVES + 1:], *beta.r[FEW_WAVES:],
                   *denominator[FEW_WAVES + 1:]))
    return (_few_waves if few else _many_waves)(
        alpha, beta, denominator, phase, ns_limit, time_limit)


# The two below differ in the length of the polynomials only: each operation counts.


def _few_waves(alpha: _Waves, beta: _Waves, denominator: tuple[float, ...], phase: FixedRate,
               ns_limit: int, time_limit: float
               ) -> Callable[[int], Quaternion]:
    (alpha_rate, alpha_start), (a0, a1, a2, *_), (b0, b1, *_) = alpha
    (beta_rate, beta_start), (c0, c1, c2, *_), (d0, d1, *_) = beta
    e0, e1, e2, *_ = denominator
    rate, start = phase
    mask, half, unit = FRACTION_MASK, FIXED_HALF, RADIANS_PER_UNIT

    def quaternion_at(ns: int) -> Quaternion:
        if not -ns_limit <= ns <= ns_limit:
            raise too_late(f'{ns} ns', time_limit)
        angle = ((ns * rate + start & mask) - half) * unit
        s, c = sin(angle), cos(angle)
        alpha_real, alpha_imag = (a2 * c + a1) * c + a0, s * (b1 * c + b0)
        beta_real, beta_imag = (c2 * c + c1) * c + c0, s * (d1 * c + d0)
        scale = 1.0 / ((e2 * c + e1) * c + e0)
        angle = ((ns * alpha_rate + alpha_start & mask) - half) * unit
        s, c = scale * sin(angle), scale * cos(angle)
        z, w = alpha_real * s + alpha_imag * c, alpha_real * c - alpha_imag * s
        angle = ((ns * beta_rate + beta_start & mask) - half) * unit
        s, c = scale * sin(angle), scale * cos(angle)
        return -beta_real * s - beta_imag * c, beta_real * c - beta_imag * s, z, w

    return quaternion_at


def _many_waves(alpha: _Waves, beta: _Waves, denominator: tuple[float, ...], phase: FixedRate,
                ns_limit: int, time_limit: float
               ) -> Callable[[int], Quaternion]:
    (alpha_rate, alpha_start), (a0, a1, a2, a3, a4), (b0, b1, b2, b3) = alpha
    (beta_rate, beta_start), (c0, c1, c2, c3, c4), (d0, d1, d2, d3) = beta
    e0, e1, e2, e3, e4 = denominator
    rate, start = phase
    mask, half, unit = FRACTION_MASK, FIXED_HALF, RADIANS_PER_UNIT

    def quaternion_at(ns: int) -> Quaternion:
        if not -ns_limit <= ns <= ns_limit:
            raise too_late(f'{ns} ns', time_limit)
        angle = ((ns * rate + start & mask) - half) * unit
        s, c = sin(angle), cos(angle)
        alpha_real = (((a4 * c + a3) * c + a2) * c + a1) * c + a0
        alpha_imag = s * (((b3 * c + b2) * c + b1) * c + b0)
        beta_real = (((c4 * c + c3) * c + c2) * c + c1) * c + c0
        beta_imag = s * (((d3 * c + d2) * c + d1) * c + d0)
        scale = 1.0 / ((((e4 * c + e3) * c + e2) * c + e1) * c + e0)
        angle = ((ns * alpha_rate + alpha_start & mask) - half) * unit
        s, c = scale * sin(angle), scale * cos(angle)
        z, w = alpha_real * s + alpha_imag * c, alpha_real * c - alpha_imag * s
        angle = ((ns * beta_rate + beta_start & mask) - half) * unit
        s, c = scale * sin(angle), scale * cos(angle)
        return -beta_real * s - beta_imag * c, beta_real * c - beta_imag * s, z, w

    return quaternion_at
