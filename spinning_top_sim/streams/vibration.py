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

LINES = 512             # that a spectral density becomes, for each axis
Matrix = NDArray[np.float64]


class Vibration:
    """
    Vibration of a vector in the frame of the IMU, as a sum of sines for each axis.

    One is that of `imu.vibration.frequency`; a spectral density becomes LINES more, each with the
    power of a band.  Its place in the middle half of the band and its phase follow from the seed.
    So no beat is longer than two over the width of a band.

    name : 'rate' or 'force'
    response : complex gain of the sensor at frequencies [Hz]
    is_off : whether nothing vibrates

    (S. Rice, "Mathematical analysis of random noise", Bell System Technical Journal 23 (1944) 282;
    M. Shinozuka, C. Jan, Journal of Sound and Vibration 25 (1972) 111)
    """

    def __init__(self, values: Mapping[str, Any], name: str,
                 response: Callable[[Matrix], NDArray[np.complex128]]) -> None:
        # Frequencies [Hz], amplitudes and phases [turns] of the lines, (lines, 3, 3 axes).
        self._lines = np.empty((0, 3, 3))
        amplitude = values[f'imu.vibration.{name}']
        if any(amplitude):
            frequency = 3 * (values['imu.vibration.frequency'],)
            self._lines = np.array([[frequency, amplitude, 3 * (0.0,)]])
        profile = np.reshape(values[f'imu.vibration.{name}_psd'], (-1, 2))
        if profile.any():
            kind = noise.Kind[f'VIBRATION_{name.upper()}']
            self._lines = np.concatenate((self._lines, _noise(profile, values['seed'], kind)))
        gain = response(self._lines[:, 0])
        self._lines[:, 1] *= np.abs(gain)
        self._lines[:, 2] += np.angle(gain) / math.tau
        self.is_off = not len(self._lines)

    def add(self, vector: Vector, t_ns: Times, seconds: Column | float = 0.0) -> Vector:
        """
        Return a vector (n,) with its vibration at times (n,) [ns].

        seconds : time before these over which the means are taken [s]
        """
        if self.is_off:
            return vector
        middle = t_ns.astype(np.float64) * 1e-9 - 0.5 * seconds
        total = np.zeros((3, len(middle)))
        for line in self._lines:            # in one order, however many samples there are
            frequency, amplitude, phase = line[..., np.newaxis]
            turns = frequency * middle + phase
            total += amplitude * np.sinc(frequency * seconds) * np.sin(
                math.tau * (turns - np.floor(turns)))
        x, y, z = vector
        return x + total[0], y + total[1], z + total[2]


def _noise(profile: Matrix, seed: int, kind: noise.Kind) -> Matrix:
    # The angle of two normal numbers is uniform.
    normal = noise.white(seed, kind, noise.Part.WHITE, np.arange(LINES), 12)
    place, phase = np.arctan2(*normal.reshape(2, 6, -1)).reshape(2, 3, -1) / math.tau + 0.5
    edges = np.linspace(profile[0, 0], profile[-1, 0], LINES + 1)
    powers = np.diff([power_below(profile.tolist(), edge) for edge in edges.tolist()])
    return np.stack((edges[:-1] + (edges[1] - edges[0]) * (0.25 + 0.5 * place),
                     np.broadcast_to(np.sqrt(2.0 * powers), (3, LINES)), phase)
                    ).transpose(2, 0, 1)


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
