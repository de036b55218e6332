# SPDX-License-Identifier: Apache-2.0
"""What a sensor feels of the motion: its bandwidth, as data sheets state it, and vibration."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Vector
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.trajectory import Trajectory
from spinning_top_sim.times import Times

# The filter forgets what is older than so many time constants: e^-25 = 1e-11 is left.
TIME_CONSTANTS = 25.0
# A panel has 8 nodes and spans this angle [rad] of signal and filter: its error is below 1e-12.
NODES, ANGLE = 8, 4.0
MOST_PANELS = 256           # they follow a motion that is some 20 times as fast as the corner
MOST_TOGETHER = 200_000     # states
# Returns the signals of some states (n,); one that is the same for all may be a float.
Signal = Callable[[States], Sequence[Column | float]]
LINES = 512             # that a spectral density becomes, for each axis
Matrix = NDArray[np.float64]


class LowPass:
    """
    A filter with the gain -3 dB at `frequency` [Hz], of `order` 1, or Butterworth's of 2.

    Before t = 0 the signal has been what it is at t = 0.

    memory_ns : how far back a reading reaches [ns]

    (A. Oppenheim, R. Schafer, "Discrete-Time Signal Processing", appendix B; W. Gautschi,
    "Orthogonal Polynomials", 2004, sect. 3.1, for the rule)
    """

    def __init__(self, frequency: float, order: int) -> None:
        self._corner, self._order = math.tau * frequency, order
        self._decay = self._corner / (1.0 if order == 1 else math.sqrt(2.0))
        self.memory_ns = math.ceil(1e9 * TIME_CONSTANTS / self._decay)
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        self._nodes, self._weights = 0.5 * np.array([1.0 + nodes, weights])[..., np.newaxis]

    def response(self, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the complex gain at frequencies [Hz]."""
        s = 1j * (math.tau * frequency / self._corner)
        return np.asarray(1.0 / (
            1.0 + s if self._order == 1 else 1.0 + math.sqrt(2.0) * s + s * s), np.complex128)

    def filtered(self, trajectory: Trajectory, t_ns: Times, signal: Signal,
                 ) -> NDArray[np.float64]:
        """Return the filtered signal at times (n,) [ns] of a motion, (columns, n)."""
        found = []
        for piece, times in trajectory.pieces(t_ns):
            # A specific force has squares of rates, thus twice their frequency.
            seconds = ANGLE / (self._corner + 2.0 * piece.fastest_rate)
            panels = min(math.ceil(1e-9 * self.memory_ns / seconds), MOST_PANELS)
            edges = np.linspace(0.0, self.memory_ns, 1 + panels)[:, np.newaxis]
            together = max(1, MOST_TOGETHER // (NODES * panels))
            found += [self._readings(trajectory, times[at:at + together], edges, signal)
                      for at in range(0, len(times), together)]
        return np.concatenate(found, axis=1)

    def _readings(self, trajectory: Trajectory, t_ns: Times, edges: Matrix, signal: Signal,
                  ) -> Matrix:
        """Return the readings (columns, n) of samples (n,); `edges` of panels are [ns before]."""
        oldest_ns = np.minimum(t_ns, self.memory_ns)
        starts = trajectory.starts(int(t_ns[0]) - self.memory_ns, int(t_ns[-1]))
        # Each sample has panels of its own, which end where pieces do; empty ones have no weight.
        edges = np.vstack((np.repeat(edges, len(t_ns), axis=1),
                           *(t_ns - start_ns for start_ns in starts)))
        edges = np.sort(np.clip(edges, 0.0, oldest_ns), axis=0)
        lengths = np.diff(edges, axis=0)[:, np.newaxis]
        before = edges[:-1, np.newaxis] + lengths * self._nodes
        weights = 1e-9 * (lengths * self._weights) * self._response(1e-9 * before)
        back_ns = np.vstack((np.rint(before).reshape(-1, len(t_ns)), oldest_ns)).astype(np.int64)
        unique, places = np.unique(t_ns - back_ns, return_inverse=True)
        values = np.stack(np.broadcast_arrays(*signal(trajectory.evaluate(unique)), unique)[:-1])
        values = values[:, places.reshape(back_ns.shape)]
        # The signal that was there before t = 0 has the rest of the weight.
        weights = np.vstack((weights.reshape(-1, len(t_ns)), self._rest(1e-9 * oldest_ns)))
        total = np.zeros_like(values[:, 0])
        for node, weight in enumerate(weights):     # in one order, however many there are
            total += weight * values[:, node]
        return total

    def _response(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the impulse response [1/s]."""
        angle = self._decay * seconds
        fade = self._decay * np.exp(-angle)
        return fade if self._order == 1 else 2.0 * fade * np.sin(angle)

    def _rest(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the integral of the impulse response from a time on."""
        angle = self._decay * seconds
        fade = np.exp(-angle)
        return fade if self._order == 1 else fade * (np.cos(angle) + np.sin(angle))


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
    normal = noise.white(seed, kind, np.arange(LINES), 12)
    place, phase = np.arctan2(*normal.reshape(2, 6, -1)).reshape(2, 3, -1) / math.tau + 0.5
    edges = np.linspace(profile[0, 0], profile[-1, 0], LINES + 1)
    powers = np.diff([power_below(profile.tolist(), edge) for edge in edges.tolist()])
    return np.stack((edges[:-1] + (edges[1] - edges[0]) * (0.25 + 0.5 * place),
                     np.broadcast_to(np.sqrt(2.0 * powers), (3, LINES)), phase)
                    ).transpose(2, 0, 1)


def power_below(profile: Sequence[Sequence[float]], frequency: float) -> float:
    """Return the integral up to a frequency [Hz] of densities, joined in logarithmic scales."""
    power = 0.0
    for (begin, density), (end, last) in pairwise(profile):
        if frequency <= begin:
            break
        octaves = math.log(min(frequency, end) / begin)
        slope = math.log(last / density) / math.log(end / begin) + 1.0
        # expm1 keeps the digits where the slope is near -1.
        power += density * begin * (math.expm1(slope * octaves) / slope if slope else octaves)
    return power
