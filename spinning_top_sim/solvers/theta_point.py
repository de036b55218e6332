# SPDX-License-Identifier: Apache-2.0
"""The motion at one time, in multiprecision; `theta_values` has it at many times, in doubles."""

from gmpy2 import const_pi, mpc, mpfr, norm, rint, sin_cos, sinh, sqrt

from spinning_top_sim.physics.regimes import precession_momentum
from spinning_top_sim.solvers.multiprecision import IMAGINARY, phase
from spinning_top_sim.solvers.theta_series import SIN_ODD
from spinning_top_sim.solvers.theta_setup import Factor, PreciseState, ThetaMotion


def cayley_klein(motion: ThetaMotion, t: mpfr) -> tuple[mpc, mpc, mpfr]:
    """Return alpha, beta and cos(theta)' at t [s] in the frame of a motion."""
    quarters = motion.start_whole + motion.start_offset + motion.quarter_rate * t
    whole = int(rint(quarters))
    rest = (motion.start_whole - whole) + motion.quarter_rate * t + motion.start_offset
    y = const_pi() / 2 * rest
    if motion.stretch:
        sine = sinh(motion.stretch * y)
        xi = -sine * sine
    else:
        sine, _ = sin_cos(y)
        xi = sine * sine
    cosine = sqrt(1 - xi)
    point = sine, cosine, xi
    alpha, beta = (_value(factor, whole, y, t, point) for factor in (motion.alpha, motion.beta))
    size2 = norm(alpha) + norm(beta)
    slope = motion.u_dot_series.at(2 * sine * cosine, 1 - 2 * xi, 4 * xi * (1 - xi))
    u_dot = motion.u_dot[whole % 2] * slope / (size2 * size2)
    scale = 1 / sqrt(size2)
    return scale * alpha, scale * beta, u_dot


def _value(factor: Factor, whole: int, y: mpfr, t: mpfr,
           point: tuple[mpfr, mpfr, mpfr]) -> mpc:
    """Return alpha D or beta D; `whole`, y, `point`: N, y and the arguments of `Series.at`."""
    parts, scale = factor.parts[whole % 2], factor.scales[whole % 2]
    real, imag = (scale * part.at(*point) for part in parts)
    if whole & 2 and any(one.prefactor == SIN_ODD for one, _ in factor.parts):
        real = -real                # it passes a pole
    turn = factor.rate * t + 2 * const_pi() * factor.phase_turns + factor.drift * y
    return (real + IMAGINARY * imag) * phase(turn)


def transverse_velocity(lambda1: mpfr, start: PreciseState, alpha: mpc, beta: mpc,
                        u_dot: mpfr) -> mpc:
    """Return omega_1 + i omega_2 = -((Lz - L3 u)/lambda1 + i u')/(2 alpha conj(beta))."""
    cosine2, sine2 = norm(alpha), norm(beta)
    if not (cosine2 and sine2):
        return mpc(0)               # it rests at a pole
    momentum = precession_momentum(start.l3, start.lz, sine2, cosine2)
    return -(momentum / lambda1 + IMAGINARY * u_dot) / (2 * alpha * beta.conjugate())
