# SPDX-License-Identifier: Apache-2.0
"""Offline samples in blocks: how long a block is, and all samples of a block at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.solvers.propagator import ExactPropagator
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Messages, Simulation
from spinning_top_sim.streams.topics import Stream

# Takes a stream, its stamps (n,) [ns], and its serialized messages as rows (n, size).
SendBlock = Callable[[Stream, NDArray[np.int64], NDArray[np.uint8]], None]
Item = TypeVar('Item')

# Bytes of messages in a block, which becomes a chunk: twice as many take no less time, and are
# compressed worse (28 MB of 546 000 messages become 36 MB).
BLOCK_BYTES = 1 << 20
# A longer block would show no progress, and an interrupted run would lose it.
LONGEST_BLOCK_NS = 100 * NANOSECONDS


def block_length(streams: Sequence[Stream]) -> int:
    """Return the simulated time in which these streams fill a block [ns]."""
    bytes_per_ns = sum(len(stream.template) / stream.period_ns for stream in streams)
    return max(int(BLOCK_BYTES / max(bytes_per_ns, BLOCK_BYTES / LONGEST_BLOCK_NS)), 1)


def targets(now_ns: int, stops: Iterable[tuple[int, Item]], block_ns: int,
            ) -> Iterator[tuple[int, Item | None]]:
    """
    Yield the times up to which to advance, one after the other.

    Parameters
    ----------
    now_ns : int
        Simulated time at the beginning [ns].
    stops : iterable of (int, item)
        Times in ascending order [ns], and what happens there.
    block_ns : int
        Longest time between two targets [ns].

    Yields
    ------
    (int, item or None)
        A target [ns], and the item of the stop if it is one.
    """
    for stop_ns, item in stops:
        while stop_ns - now_ns > block_ns:
            now_ns += block_ns
            yield now_ns, None
        now_ns = stop_ns
        yield stop_ns, item


class BlockSource:
    """
    Advances a simulation and sends its samples in blocks.

    Parameters
    ----------
    simulation : Simulation
        Its `log_to` is taken.
    streams : sequence of Stream
        The streams whose samples are sent.
    columns : bool
        Evaluate the exact solution for all times of a block at once, as `simulate` does.  The
        last bits differ from those of the states one by one, which a live node computes.
    """

    def __init__(self, simulation: Simulation, streams: Sequence[Stream], *,
                 columns: bool) -> None:
        self._simulation, self._columns = simulation, columns
        self._taken: list[Messages] = []
        simulation.log_to(lambda *messages: self._taken.append(messages), streams)

    def advance(self, target_ns: int, send: SendBlock) -> None:
        """
        Send every sample due up to a time, at most one block of each stream.

        Where the equations cannot go on, the samples before are sent, then IntegrationError is
        raised.
        """
        if self._columns:
            self._simulation.advance_in_columns(target_ns, send)
            return
        try:
            self._simulation.advance(target_ns)
        finally:
            taken, self._taken[:] = list(self._taken), []
            self._send_rows(taken, send)

    def _send_rows(self, taken: list[Messages], send: SendBlock) -> None:
        stamps: dict[int, list[int]] = {}
        data: dict[int, list[bytes]] = {}
        for numbers, stamp_ns, messages, _ in taken:
            for number, message in zip(numbers, messages, strict=True):
                stamps.setdefault(number, []).append(stamp_ns)
                data.setdefault(number, []).append(message)
        for stream in self._simulation.streams:
            if stream.log_index in stamps:
                rows = np.frombuffer(b''.join(data[stream.log_index]), np.uint8)
                send(stream, np.array(stamps[stream.log_index], np.int64),
                     rows.reshape(len(stamps[stream.log_index]), -1))


def states_at(simulation: Simulation, times_ns: NDArray[np.int64]) -> SimpleNamespace:
    """
    Return the states of the present motion at simulated times, as columns.

    Parameters
    ----------
    simulation : Simulation
        Where it stands.
    times_ns : NDArray[np.int64], shape (n,)
        Times on a grid, ascending [ns].

    Returns
    -------
    namespace
        theta, theta_dot, phi, phi_dot, psi, psi_dot, energy, l3, lz (n,); quaternion (n, 4);
        angular_velocity (n, 3).
    """
    solver, anchor_ns = simulation.solver, simulation.anchor_ns
    names = ('theta', 'theta_dot', 'phi', 'phi_dot', 'psi', 'psi_dot', 'energy', 'l3', 'lz',
             'quaternion')
    if isinstance(solver, ExactPropagator):
        step_ns = int(times_ns[-1] - times_ns[0]) // max(len(times_ns) - 1, 1)
        grid = solver.grid(int(times_ns[0]) - anchor_ns, step_ns, len(times_ns))
        return SimpleNamespace(angular_velocity=grid.angular_velocity,
                               **{name: getattr(grid, name) for name in names})
    states = [solver.at_ns(t_ns - anchor_ns) for t_ns in times_ns.tolist()]
    return SimpleNamespace(
        angular_velocity=np.array([state.body_rates for state in states]),
        **{name: np.array([getattr(state, name) for state in states]) for name in names})
