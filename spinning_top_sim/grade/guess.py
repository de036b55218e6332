# SPDX-License-Identifier: Apache-2.0
"""First values of the fit, from attitudes alone or with rates."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
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
