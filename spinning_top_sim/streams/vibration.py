# SPDX-License-Identifier: Apache-2.0
"""Vibration of a sensor: a sine, and noise with a power spectral density, as a sum of sines."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Vector
from spinning_top_sim.streams import noise
from spinning_top_sim.times import Times

# Sines that a spectral density becomes, for each axis.
LINES = 512
Matrix = NDArray[np.float64]
Response = Callable[[Matrix], NDArray[np.complex128]]


class Vibration:
    """
    A vibration of angular velocity and specific force in the frame of the IMU.

    A sensor with the complex gain `response` at frequencies [Hz] reads it.

    Each axis is a sum of sines: that of `imu.vibration.frequency`, and `LINES` for a spectral
    density, each with the power of a band.  Its place in the middle half of the band and its phase
    follow from the seed.  So no beat is longer than two over the width of a band.

    is_off : whether nothing vibrates

    (S. Rice, "Mathematical analysis of random noise", Bell System Technical Journal 23 (1944) 282;
    M. Shinozuka, C. Jan, Journal of Sound and Vibration 25 (1972) 111)
    """

    def __init__(self, values: Mapping[str, Any], response: Response) -> None:
        self._kinds = [_lines(values, name, kind, response) for name, kind in (
            ('rate', noise.Kind.VIBRATION_RATE), ('force', noise.Kind.VIBRATION_FORCE))]
        self.is_off = not any(map(len, self._kinds))

    def add(self, true: tuple[Vector, Vector], t_ns: Times,
            seconds: Column | float = 0.0) -> tuple[Vector, Vector]:
        """
        Return rates and forces (n,) with the vibration at these times [ns].

        seconds : time before these over which the means are taken [s]
        """
        middle = t_ns.astype(np.float64) * 1e-9 - 0.5 * seconds
        rates, force = (_sum(lines, middle, seconds, one)
                        for lines, one in zip(self._kinds, true, strict=True))
        return rates, force


def _sum(lines: Matrix, middle: Column, seconds: Column | float, vector: Vector) -> Vector:
    if not len(lines):
        return vector
    total = np.zeros((3, len(middle)))
    for line in lines:                          # in one order, however many samples there are
        frequency, amplitude, phase = line[..., np.newaxis]
        turns = frequency * middle + phase
        total += amplitude * np.sinc(frequency * seconds) * np.sin(
            math.tau * (turns - np.floor(turns)))
    x, y, z = vector
    return x + total[0], y + total[1], z + total[2]


def _lines(values: Mapping[str, Any], name: str, kind: noise.Kind,
           response: Response) -> Matrix:
    """Return frequencies [Hz], amplitudes and phases [turns] of the sines, (lines, 3, 3 axes)."""
    lines = np.empty((0, 3, 3))
    amplitude = values[f'imu.vibration.{name}']
    if any(amplitude):
        frequency = 3 * (values['imu.vibration.frequency'],)
        lines = np.array([[frequency, amplitude, 3 * (0.0,)]])
    profile = np.reshape(values[f'imu.vibration.{name}_psd'], (-1, 2))
    if profile.any():
        # The angle of two normal numbers is uniform.
        normal = noise.white(values['seed'], kind, noise.Part.WHITE, np.arange(LINES), 12)
        normal = normal.reshape(2, 2, 3, -1)
        uniform = np.arctan2(normal[0], normal[1]) / math.tau + 0.5
        edges = np.linspace(profile[0, 0], profile[-1, 0], LINES + 1)
        powers = np.diff([power_below(profile.tolist(), edge) for edge in edges.tolist()])
        sines = np.stack((edges[:-1] + (edges[1] - edges[0]) * (0.25 + 0.5 * uniform[0]),
                          np.broadcast_to(np.sqrt(2.0 * powers), (3, LINES)), uniform[1]))
        lines = np.concatenate((lines, sines.transpose(2, 0, 1)))
    gain = response(lines[:, 0])
    lines[:, 1] *= np.abs(gain)
    lines[:, 2] += np.angle(gain) / math.tau
    return lines


def power_below(profile: Sequence[Sequence[float]], frequency: float) -> float:
    """
    Return the integral of a one-sided spectral density up to a frequency [Hz].

    profile : frequencies [Hz] and densities, joined by straight lines in logarithmic scales
    """
    power = 0.0
    for (begin, density), (end, last) in pairwise(profile):
        if frequency <= begin:
            break
        octaves = math.log(min(frequency, end) / begin)
        slope = math.log(last / density) / math.log(end / begin) + 1.0
        # expm1 keeps the digits where the slope is near -1.
        power += density * begin * (math.expm1(slope * octaves) / slope if slope else octaves)
    return power
