# SPDX-License-Identifier: Apache-2.0
"""
The bandwidth of a sensor: a low pass of the true signal, as data sheets state it.

A reading is the convolution of the signal with the impulse response of the analog filter, by
Gauss-Legendre panels over the time that the filter remembers.  Each segment of the motion begins
with the state of the filter there, so a reading depends on its own time only.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.path import Segment

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
    A filter with the gain -3 dB at `frequency` [Hz], of `order` 1, or Butterworth's of 2.

    Before t = 0 the signal has been what it is at t = 0.

    memory_ns : how far back a reading reaches [ns]

    (A. Oppenheim, R. Schafer, "Discrete-Time Signal Processing", appendix B; W. Gautschi,
    "Orthogonal Polynomials", 2004, sect. 3.1, for the rule)
    """

    def __init__(self, frequency: float, order: int) -> None:
        self._corner, self._order = math.tau * frequency, order
        self._decay = self._corner / (1.0 if order == 1 else math.sqrt(2.0))
        self._gain = order * self._decay        # of the last component of the state
        self.memory_ns = math.ceil(1e9 * TIME_CONSTANTS / self._decay)
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        self._nodes, self._weights = 0.5 * (1.0 + nodes), 0.5 * weights

    def response(self, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the complex gain at frequencies [Hz]."""
        s = 1j * (math.tau * frequency / self._corner)
        return np.asarray(1.0 / (
            1.0 + s if self._order == 1 else 1.0 + math.sqrt(2.0) * s + s * s), np.complex128)

    def filtered(self, segment: Segment, times: range, signal: Signal) -> NDArray[np.float64]:
        """Return the filtered signal at times [ns] within a segment, (columns, n)."""
        # Samples that see this segment alone have the same nodes.
        mixed = len(range(times.start, segment.start_ns + self.memory_ns, times.step))
        together = max(1, MOST_TOGETHER // (NODES * len(self._edges(segment))))
        return np.concatenate([
            self._state(segment, np.array(some[begin:begin + together]), signal, 1)[-1]
            for some in (times[:mixed], times[mixed:])
            for begin in range(0, len(some), together)], axis=1) * self._gain

    def carried(self, segment: Segment, until_ns: int, signal: Signal) -> NDArray[np.float64]:
        """Return the state where another segment follows (components, columns, 1)."""
        return self._state(segment, np.array([until_ns]), signal, self._order)

    def _edges(self, segment: Segment) -> NDArray[np.float64]:
        """Return how long before a sample the panels begin and end [ns], (panels + 1, 1)."""
        # A specific force has squares of rates, thus twice their frequency.
        seconds = ANGLE / (self._corner + 2.0 * segment.fastest_rate)
        panels = min(math.ceil(1e-9 * self.memory_ns / seconds), MOST_PANELS)
        return np.linspace(0.0, self.memory_ns, panels + 1)[:, np.newaxis]

    def _state(self, segment: Segment, t_ns: NDArray[np.int64], signal: Signal,
               components: int) -> NDArray[np.float64]:
        """
        Return the last components of the filter's state at times, (components, columns, n).

        The state is the integral of the signal times exp(p t), t ago, with the pole p of the
        filter, as its real and, of second order, its imaginary part.

        t_ns : within the segment, all less than `memory_ns` after its start, or none of them
        """
        carried = segment.filter_state if t_ns[0] < segment.start_ns + self.memory_ns else None
        before, weights, back_ns = self._panels(segment, t_ns)
        kernels = [weights * part for part in self._kernel(1e-9 * before)[-components:]]
        at_ns = t_ns - np.rint(np.vstack((before, back_ns))).astype(np.int64)
        unique, places = np.unique(at_ns, return_inverse=True)
        values = signal(segment.own_states(unique))[:, places.reshape(at_ns.shape)]
        # Before that the signal has been what it is there, unless its history is known.
        first = (np.stack(self._order * [values[:, -1] / (self._order * self._decay)])
                 if carried is None else carried)
        real, *imag = self._kernel(1e-9 * back_ns)      # what is left of that state
        totals = [real * first[0]] if not imag else [
            real * first[0] - imag[0] * first[1],
            real * first[1] + imag[0] * first[0]][-components:]
        for node in range(len(before)):         # in one order, however many samples there are
            totals = [total + kernel[node] * values[:, node]
                      for total, kernel in zip(totals, kernels, strict=True)]
        return np.stack(totals)

    def _panels(self, segment: Segment, t_ns: NDArray[np.int64],
                ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
        """
        Return nodes [ns before the times] and weights [s], (nodes, n), and how far back they go.

        Times that see this segment alone share one column.
        """
        back_ns = np.minimum(t_ns - segment.start_ns, self.memory_ns)
        if back_ns.min() == self.memory_ns:
            back_ns = back_ns[:1]
        edges = self._edges(segment)
        edges = np.minimum(edges[:1 + np.searchsorted(edges[:, 0], back_ns.max())], back_ns)
        lengths = np.diff(edges, axis=0)[:, np.newaxis]
        before = (edges[:-1, np.newaxis] + lengths * self._nodes[:, np.newaxis]).reshape(
            -1, len(back_ns))
        weights = 1e-9 * (lengths * self._weights[:, np.newaxis]).reshape(before.shape)
        return before, weights, back_ns

    def _kernel(self, seconds: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return real and, of second order, imaginary part of exp(p t)."""
        angle = self._decay * seconds
        fade = np.exp(-angle)
        return [fade] if self._order == 1 else [fade * np.cos(angle), fade * np.sin(angle)]
