# SPDX-License-Identifier: Apache-2.0
"""
The bandwidth of a sensor: a low pass of the true signal, as data sheets state it.

A reading is the convolution of the signal with the impulse response, by Gauss-Legendre panels over
the time that the filter remembers.  So it depends on the motion and on its own time only.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.trajectory import Trajectory
from spinning_top_sim.times import Times

# The filter forgets what is older than so many time constants: e^-25 = 1e-11 is left.
TIME_CONSTANTS = 25.0
# A panel has 8 nodes and spans this angle [rad] of signal and filter: its error is below 1e-12.
NODES, ANGLE = 8, 4.0
# So many panels follow a motion that is some 20 times as fast as the corner.
MOST_PANELS = 256
MOST_TOGETHER = 200_000     # states
# Returns the signals of some states (n,); one that is the same for all may be a float.
Signal = Callable[[States], Sequence[Column | float]]


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
        self._nodes, self._weights = 0.5 * (1.0 + nodes), 0.5 * weights

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
            edges = np.linspace(0.0, self.memory_ns, 1 + panels)
            # Samples that see this piece alone have the same nodes, each of the others its own.
            mixed = int(np.searchsorted(times, piece.start_ns + self.memory_ns))
            found += [self._readings(
                trajectory, times[at:at + 1], self._edges(trajectory, int(times[at]), edges),
                signal) for at in range(mixed)]
            together = max(1, MOST_TOGETHER // (NODES * panels))
            found += [self._readings(trajectory, times[at:at + together], edges, signal)
                      for at in range(mixed, len(times), together)]
        return np.concatenate(found, axis=1)

    def _edges(self, trajectory: Trajectory, t_ns: int, edges: Column) -> Column:
        """Return these edges of panels [ns before a sample], and those of pieces."""
        oldest = min(t_ns, self.memory_ns)
        starts = [t_ns - start_ns for start_ns in trajectory.starts(t_ns - oldest, t_ns)]
        return np.unique(np.concatenate((edges[edges < oldest], starts, [oldest])))

    def _readings(self, trajectory: Trajectory, t_ns: Times, edges: Column,
                  signal: Signal) -> NDArray[np.float64]:
        """Return the readings (columns, n) of samples (n,) with these edges [ns before]."""
        lengths = np.diff(edges)[:, np.newaxis]
        before = (edges[:-1, np.newaxis] + lengths * self._nodes).ravel()
        # The signal that was there before t = 0 has the rest of the weight.
        weights = np.append(
            1e-9 * (lengths * self._weights).ravel() * self._response(1e-9 * before),
            self._rest(1e-9 * edges[-1]))
        back_ns = np.append(np.rint(before), edges[-1]).astype(np.int64)
        unique, places = np.unique(t_ns - back_ns[:, np.newaxis], return_inverse=True)
        values = np.stack(np.broadcast_arrays(*signal(trajectory.evaluate(unique)), unique)[:-1])
        values = values[:, places.reshape(len(back_ns), -1)]
        total = np.zeros_like(values[:, 0])
        for node, weight in enumerate(weights):     # in one order, however many there are
            total += weight * values[:, node]
        return total

    def _response(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the impulse response [1/s]."""
        angle = self._decay * seconds
        fade = self._decay * np.exp(-angle)
        return fade if self._order == 1 else 2.0 * fade * np.sin(angle)

    def _rest(self, seconds: float) -> float:
        """Return the integral of the impulse response from a time on."""
        angle = self._decay * seconds
        fade = math.exp(-angle)
        return fade if self._order == 1 else fade * (math.cos(angle) + math.sin(angle))
