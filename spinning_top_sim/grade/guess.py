# SPDX-License-Identifier: Apache-2.0
"""First values of the fit, from attitudes alone or with rates: balance laws that are linear."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude

Reals = NDArray[np.float64]


def spin_rate(times: Reals, q: Reals, hint: float | None) -> tuple[float, bool]:
    """
    Return omega_3 [rad/s] from attitudes (4, n), and whether the hint tells its whole turns.

    Evenly sampled attitudes tell it up to whole turns per sample: without a hint that is near
    one of these values, the slowest is returned.
    """
    x, y, z, w = q[:, :-1]
    _, _, dz, dw = attitude.product((-x, -y, -z, w), tuple(q[:, 1:]))
    turn, dt = 2.0 * np.arctan2(dz, dw), np.diff(times)
    step = float(np.median(dt))
    usual = np.abs(dt - step) < 0.1 * step
    rate = float(np.angle(np.mean(np.exp(1j * turn[usual])))) / step
    turns = 0.0 if hint is None else (hint - rate) * step / math.tau
    sure = hint is not None and abs(turns - round(turns)) < 0.1
    rate += math.tau / step * round(turns) if sure else 0.0
    rest = np.remainder(turn - rate * dt + math.pi, math.tau) - math.pi
    return rate + float(np.sum(rest) / np.sum(dt)), sure


def weak(times: Reals, axis: Reals) -> list[tuple[int, float, float]]:
    """
    Return estimates (samples, L3/lambda1, P/lambda1), the best determined first.

    The balance of angular momentum over lambda1, (L3 n + n x n')' = P z x n with the axis n, is
    multiplied by functions of compact support and integrated by parts: no derivative of a reading
    is left, and a and P are linear in it.  Odd samples are the instruments of even ones, which
    removes the bias by noise in the regressors.
    """
    found = []
    size = 12
    while size <= len(times) // 2:
        halves = [_balance(times[first::2], axis[:, first::2], size // 2) for first in (0, 1)]
        rows = min(len(half) for half in halves)
        (a, y), (b, _) = ((half[:rows, :2], half[:rows, 2]) for half in halves)
        scale = np.linalg.norm(a, axis=0) + 1e-300
        normal = (b / scale).T @ (a / scale)
        solution = np.linalg.lstsq(normal, (b / scale).T @ y, rcond=1e-12)[0]
        rest = y - a / scale @ solution
        with np.errstate(all='ignore'):
            spread = np.linalg.pinv(normal) @ ((b / scale).T @ (b / scale)) @ np.linalg.pinv(
                normal).T * np.mean(rest * rest)
            error = math.sqrt(abs(float(np.trace(spread)))) / (
                float(np.linalg.norm(solution)) + 1e-300)
        l3, p = (solution / scale).tolist()
        found.append((error, size, l3, p))
        size = math.ceil(1.5 * size)
    return [(size, l3, p) for _, size, l3, p in sorted(found)]


def _balance(times: Reals, axis: Reals, size: int) -> Reals:
    """Return the integrals (rows, 3) of the balance against bumps of `size` samples."""
    stride = max(1, size // 4)
    t = sliding_window_view(times, size)[::stride]
    n = sliding_window_view(axis, size, axis=1)[:, ::stride]
    begin, end = t[:, :1], t[:, -1:]
    half = 0.5 * (end - begin)
    weights = np.gradient(t, axis=1)

    def bump(at: Reals) -> tuple[Reals, Reals]:
        s = (at - begin) / half - 1.0
        return (1.0 - s * s) ** 3, -6.0 * s * (1.0 - s * s) ** 2 / half

    value, slope = bump(t)
    _, middle = bump(0.5 * (t[:, 1:] + t[:, :-1]))
    turned = np.cross(n[:, :, :-1], n[:, :, 1:], axis=0)
    sine = np.linalg.norm(turned, axis=0)
    cosine = np.sum(n[:, :, :-1] * n[:, :, 1:], axis=0)
    turned = turned * np.arctan2(sine, cosine) / np.where(sine > 1e-12, sine, 1.0)
    torque = np.stack((-n[1], n[0]))
    return np.stack([np.concatenate(part) for part in (
        np.sum(slope * weights * n, axis=2), (*np.sum(value * weights * torque, axis=2),
                                              np.zeros(len(t))),
        -np.sum(middle * turned, axis=2))], axis=1)


def small_nutation(times: Reals, axis: Reals) -> Iterator[tuple[float, float]]:
    """
    Yield (L3/lambda1, P/lambda1) of a small nutation, from its strongest frequency.

    About a steady precession W at the tilt theta, W^2 sin^2 theta + (L3 - 2 W cos theta)^2 is the
    square of the frequency, and P = L3 W - W^2 cos theta.
    """
    phi = np.unwrap(np.arctan2(axis[1], axis[0]))
    rate, first = np.polyfit(times, phi, 1)
    height = float(np.mean(axis[2]))
    sine = math.sqrt(max(1.0 - height * height, 0.0))
    dt = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1], dt)
    rest = (np.interp(even, times, height - axis[2]) / max(sine, 1e-3)
            + 1j * sine * np.interp(even, times, phi - first - rate * times))
    power = np.abs(np.fft.fft((rest - np.mean(rest)) * np.hanning(len(even)), 4 * len(even)))
    frequency = math.tau * np.fft.fftfreq(len(power), dt)
    best = abs(float(frequency[np.argmax(power)]))
    for alias in (best, math.tau / dt - best, math.tau / dt + best):
        within = alias * alias - (rate * sine) ** 2
        for sign in (1.0, -1.0) if within > 0.0 else ():
            l3 = 2.0 * rate * height + sign * math.sqrt(within)
            yield l3, l3 * rate - rate * rate * height


def transverse_rates(times: Reals, q: Reals, axis: Reals) -> tuple[float, float, float]:
    """
    Return omega_1 and omega_2 at the first time, and their standard deviation [rad/s].

    They are those of a cubic through the first attitudes of the axis.
    """
    size = min(16, len(times))
    t = times[:size] - times[0]
    powers = np.vander(t / t[-1], 4, increasing=True)
    found = np.linalg.lstsq(powers, axis[:, :size].T, rcond=None)[0]
    rest = float(np.sqrt(np.mean((axis[:, :size].T - powers @ found) ** 2)))
    slope = found[1] / t[-1]
    error = rest * math.sqrt(float(np.linalg.inv(powers.T @ powers)[1, 1])) / float(t[-1])
    x, y, z = np.cross(axis[:, 0], slope).tolist()
    w1, w2, _ = attitude.in_body(tuple(q[:, :1]), (x, y, z))
    return float(w1[0]), float(w2[0]), error
