# SPDX-License-Identifier: Apache-2.0
"""
The bandwidth of a sensor: a low pass of the true signal, as data sheets state it.

A reading is the convolution of the signal with the impulse response of the analog filter, by
Gauss-Legendre panels over the time that the filter remembers.  It needs no state that is carried
along, so it depends on its own time only.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.integrals import fastest_rate
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.path import Path, Segment

# The filter forgets what is older than so many time constants: e^-25 = 1e-11 is left.
TIME_CONSTANTS = 25.0
# A panel has 8 nodes and spans this angle [rad] of signal and filter: its error is below 1e-12.
NODES, ANGLE = 8, 4.0
# So many panels follow a motion that is some 20 times as fast as the corner.
MOST_PANELS = 256
MOST_TOGETHER = 200_000     # states
# Returns the signals of some states, (columns, n).
Signal = Callable[[States], NDArray[np.float64]]


class LowPass:
    """
    A filter with the gain -3 dB at `frequency` [Hz]: of first order, or Butterworth's of second.

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

    def filtered(self, path: Path, times: range, signal: Signal) -> NDArray[np.float64]:
        """Return the filtered signal at times [ns] within a segment, (columns, n)."""
        # Samples that see this segment alone have the same nodes.
        start_ns = path.after(times.start).start_ns
        mixed = len(range(times.start, start_ns + self.memory_ns, times.step))
        parts = [self._sum(path, part, signal) for part in (times[:mixed], times[mixed:])
                 if len(part)]
        return np.concatenate(parts, axis=1)

    def _sum(self, path: Path, times: range, signal: Signal) -> NDArray[np.float64]:
        oldest_ns = max(times[0] - self.memory_ns, 0)
        pieces = path.pieces(oldest_ns, times[-1] + 1)
        together = max(1, MOST_TOGETHER // max(
            NODES * len(self._edges(segment)) for segment, _, _ in pieces))
        return np.concatenate([
            sum(self._piece(np.array(times[begin:begin + together]), *piece, signal)
                for piece in pieces) for begin in range(0, len(times), together)], axis=1)

    def _edges(self, segment: Segment) -> NDArray[np.float64]:
        """Return how long before a sample the panels begin and end [ns], (panels + 1, 1)."""
        rate = fastest_rate(segment.solver.top, segment.l3, segment.energy)
        # A specific force has squares of rates, thus twice their frequency.
        seconds = ANGLE / (self._corner + 2.0 * rate)
        panels = min(math.ceil(1e-9 * self.memory_ns / seconds), MOST_PANELS)
        return np.linspace(0.0, self.memory_ns, panels + 1)[:, np.newaxis]

    def _piece(self, t_ns: NDArray[np.int64], segment: Segment, from_ns: int, until_ns: int,
               signal: Signal) -> NDArray[np.float64]:
        """Return what the signal between two times contributes to each sample."""
        memory_ns = np.minimum(t_ns, self.memory_ns)
        newest = np.clip(t_ns - until_ns, 0, memory_ns)
        oldest = np.clip(t_ns - from_ns, 0, memory_ns)
        if newest.max() == 0 and oldest.min() == self.memory_ns:    # the same for all samples
            memory_ns, newest, oldest = memory_ns[:1], newest[:1], oldest[:1]
        edges = np.clip(self._edges(segment), newest, oldest)
        lengths = np.diff(edges, axis=0)[:, np.newaxis]
        before = (edges[:-1, np.newaxis] + lengths * self._nodes[:, np.newaxis]).reshape(
            -1, len(newest))
        weights = (lengths * self._weights[:, np.newaxis]).reshape(before.shape)
        weights = 1e-9 * weights * self._impulse_response(1e-9 * before)
        # What is older than the memory, or than the start, is the value there.
        first_ns = t_ns[:len(memory_ns)] - memory_ns
        begins_here = (from_ns <= first_ns) & (first_ns < until_ns)
        rest = np.where(begins_here, self._rest(1e-9 * memory_ns), 0.0)
        before, weights = np.vstack((before, oldest)), np.vstack((weights, rest))
        at_ns = t_ns - np.rint(before).astype(np.int64)
        unique, places = np.unique(at_ns, return_inverse=True)
        values = signal(segment.own_states(unique))[:, places.reshape(at_ns.shape)]
        total = np.zeros((len(values), len(t_ns)))
        for node in range(len(weights)):        # in one order, however many samples there are
            total += weights[node] * values[:, node]
        return total

    def _impulse_response(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        angle = self._decay * seconds
        factor = 1.0 if self._order == 1 else 2.0 * np.sin(angle)
        return self._decay * factor * np.exp(-angle)

    def _rest(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the integral of the impulse response from a time on."""
        angle = self._decay * seconds
        factor = 1.0 if self._order == 1 else np.cos(angle) + np.sin(angle)
        return factor * np.exp(-angle)
