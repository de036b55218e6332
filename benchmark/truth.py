# SPDX-License-Identifier: Apache-2.0
"""The error of an attitude, and the truth in extended precision."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from cases import Case
from peers import quadratic_rates

BITS = 160


def angles_between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """
    Return the rotation angle [rad] between attitudes (n, 4): q and -q are the same one.

    Quaternions are normalized first, so that a drift of |q| does not count.
    """
    p = p / np.linalg.norm(p, axis=1, keepdims=True)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    apart, opposite = (np.linalg.norm(p - q, axis=1), np.linalg.norm(p + q, axis=1))
    return 4.0 * np.arctan2(np.minimum(apart, opposite), np.maximum(apart, opposite))


def long_attitudes(case: Case, ns: np.ndarray) -> np.ndarray:
    """
    Return (n, 4) x, y, z, w from heyoka in BITS-bit arithmetic: an independent truth.

    The constants are taken as `ExactSolution` takes them: doubles, their products exact.
    """
    import heyoka as hy

    def real(value: Fraction | float) -> Any:
        exact = Fraction(value)
        return (hy.real(str(exact.numerator), BITS) / hy.real(str(exact.denominator), BITS))

    top, start = case.top, case.start
    theta, l3, lz = real(start.theta), real(start.l3), real(start.lz)
    lambda1, zero, half = real(top.lambda1), real(0), real(Fraction(1, 2))
    torque = real(Fraction(top.mass) * Fraction(top.gravity) * Fraction(top.com_distance))
    sine, cosine = np.sin(theta), np.cos(theta)
    phi_dot = (lz - l3 * cosine) / (lambda1 * sine * sine) if start.theta else zero
    across, along = sine * (l3 - lambda1 * phi_dot * cosine), lambda1 * real(start.theta_dot)
    phi, psi = real(start.phi), real(start.psi)
    c, s = np.cos(half * theta), np.sin(half * theta)
    plus, minus = half * (phi + psi), half * (phi - psi)
    state = [c * np.cos(plus), -s * np.sin(minus), s * np.cos(minus), c * np.sin(plus),
             across * np.cos(phi) - along * np.sin(phi),
             across * np.sin(phi) + along * np.cos(phi)]
    unknowns = hy.make_vars('w', 'x', 'y', 'z', 'lx', 'ly')
    rates = quadratic_rates([hy.expression(u) if isinstance(u, str) else u for u in unknowns],
                            half / lambda1, torque, lz)
    integrator = hy.taylor_adaptive(list(zip(unknowns, rates, strict=True)), np.array(state),
                                    fp_type=hy.real)
    spin = half * real(Fraction(start.l3) / Fraction(top.lambda3)
                       - Fraction(start.l3) / Fraction(top.lambda1))
    rows = []
    for n in ns.tolist():
        t = real(Fraction(n, 10 ** 9))
        integrator.propagate_until(t)
        w, x, y, z = integrator.state[:4]
        c, s = np.cos(spin * t), np.sin(spin * t)
        rows.append([float(v) for v in (x * c + y * s, y * c - x * s, z * c + w * s,
                                        w * c - z * s)])
    return np.array(rows)
