# SPDX-License-Identifier: Apache-2.0
"""What a tick does: which samples are sent now, in real time, without ROS and without waiting."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from spinning_top_sim.nodes.pacing import SimulatedClock
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.streams.schedule import NEVER_NS

# How often subscribers are counted; a new one waits at most this long.
SUBSCRIBERS_PERIOD_NS = 50_000_000
# The look-ahead is computed in pieces that fill this share of the time between two ticks, so that
# the next tick finds the processor free.  It begins this many ticks, or this much time, before it
# is needed.
BUSY_SHARE = 0.35
TICKS_AHEAD, AHEAD_NS = 24, 50_000_000
# One tick works at most this long before services and signals get their turn.
TICK_BUDGET_NS = 50_000_000
# One step works at most this long.
STEP_BUDGET_NS = 2_000_000_000
# Samples later than this are recorded, but not published any more.
LATEST_NS = 500_000_000
# A simulation further behind than this lets its clock slip: its real-time factor falls below 1.
LONGEST_LAG_NS = 1_000_000_000


@dataclass
class Counters:
    """Counts since the start of the node."""

    late_ticks: int = 0
    skipped_ticks: int = 0
    slipped_ns: int = 0
    commands: int = 0
    rejected_commands: int = 0


def _nothing(*_: object) -> None:
    pass


@dataclass(frozen=True)
class Hooks:
    """What a tick loop asks of its surroundings."""

    # Sets `publish` of each stream that has subscribers; called every 50 ms.
    update_subscribers: Callable[[], None] = _nothing
    # Returns whether the recording takes more messages; waits a short while until it does.
    has_room: Callable[[], bool] = lambda: True
    wait_for_room: Callable[[], None] = _nothing
    # Returns whether the node is about to end.
    stopping: Callable[[], bool] = lambda: False
    # Takes the source's time [ns] of simulated time 0, whenever simulated time begins to run.
    clock_started: Callable[[int], None] = _nothing
    # Take a text for the log.
    warn: Callable[[str], object] = _nothing
    error: Callable[[str], object] = _nothing
    # Called when all samples of `duration` are sent.
    duration_passed: Callable[[], None] = _nothing


class TickLoop:
    """
    Moves a simulation along with a clock, one tick at a time.

    A tick sends every sample that is due, however late it comes, so no sample depends on how
    ticks fall.  Not thread-safe: calls from several threads need a lock around them.

    Parameters
    ----------
    simulation
        Streams and motion; its samples go where its streams say.
    values
        Checked parameters.
    hooks
        What the loop asks of its surroundings.
    source
        Returns the time that simulated time follows [ns].
    steady
        Returns steady time [ns]; decides which ticks are late and how long one may work.

    Attributes
    ----------
    counters : Counters
    paused : bool
        Whether `pause` holds the motion.
    failure : str or None
        Why the motion stands still until `reset`.

    """

    def __init__(self, simulation: Simulation, values: Mapping[str, Any], hooks: Hooks, *,
                 source: Callable[[], int] = time.monotonic_ns,
                 steady: Callable[[], int] = time.monotonic_ns) -> None:
        self.counters = Counters()
        self.paused: bool = values['start_paused']
        self.failure: str | None = None
        self._simulation, self._hooks, self._steady = simulation, hooks, steady
        self._clock = SimulatedClock(source, values['time_scale'])
        self._started = self._ended = False
        self._warned_overload = False
        self._subscribers_due_ns = 0            # on the steady clock
        self._late_from_ns = NEVER_NS           # on the steady clock
        # Simulated time until which ticks take the fast path.
        self._fast_until_ns = -1
        # Whether a look-ahead is being computed.
        self._computing = False
        self.set_pace(values)

    @property
    def now_ns(self) -> int:
        """Simulated time up to which samples are sent [ns], >= 0."""
        return max(self._simulation.now_ns, 0)

    @property
    def time_text(self) -> str:
        """Simulated time, exact, for people."""
        seconds, nanoseconds = divmod(self.now_ns, NANOSECONDS)
        return f'at t = {seconds}.{nanoseconds:09d} s'

    @property
    def started(self) -> bool:
        """Whether `start` was called."""
        return self._started

    @property
    def running(self) -> bool:
        """Whether simulated time passes."""
        return (self._started and not self._ended and not self.paused and self.failure is None)

    def start(self) -> None:
        """Let simulated time run from 0 on, unless the motion is paused."""
        self._started = True
        if self.running:
            self._start_clock(0)

    # ------------------------------------------------------------------------------- ticks

    def tick(self) -> bool:
        """Send what is due; return whether `idle` has something to do before the next tick."""
        now_ns, late_from_ns = self._steady(), self._late_from_ns
        self._late_from_ns = now_ns + self._late_after_ns
        due_ns = self._clock.now()
        # The fast path touches little memory: after a rest, little of it is in the caches.
        if (due_ns < self._fast_until_ns and now_ns <= late_from_ns
                and self._simulation.send_ready(due_ns)):
            return self._computing
        if not self.running:
            return False
        if now_ns > late_from_ns:
            self._count_late_tick(now_ns - late_from_ns)
        return self._slow_tick(now_ns)

    def idle(self) -> None:
        """Compute some of the samples that are due next, until about the next tick."""
        simulation = self._simulation
        self._computing = not simulation.prepare(
            simulation.now_ns + self._ahead_ns, self._busy_ns)
        self._update_look_ahead()

    def _slow_tick(self, now_ns: int) -> bool:
        """Send what is due, and do all that the fast path leaves out; return as `tick` does."""
        if now_ns >= self._subscribers_due_ns:
            self._hooks.update_subscribers()
            self._subscribers_due_ns = now_ns + SUBSCRIBERS_PERIOD_NS
        simulation, due_ns = self._simulation, self._due()
        self._advance(due_ns)
        if self._duration_ns and simulation.now_ns >= self._duration_ns:
            self._ended = True
            self._hold()
            self._hooks.duration_passed()
            return False
        self._update_look_ahead()
        return simulation.now_ns >= due_ns and (
            self._computing or due_ns >= simulation.ready_ns - self._ahead_ns)

    def _update_look_ahead(self) -> None:
        """Set the time until which ticks take the fast path."""
        simulation = self._simulation
        if self.running:
            self._fast_until_ns = min(
                simulation.now_ns + self._subscribers_period_ns, self._duration_ns or NEVER_NS,
                NEVER_NS if self._computing else simulation.ready_ns - self._ahead_ns)

    def _due(self) -> int:
        """Return the simulated time of the clock, at most the duration [ns]."""
        now_ns = self._clock.now()
        return min(now_ns, self._duration_ns) if self._duration_ns else now_ns

    def _count_late_tick(self, late_ns: int) -> None:
        self.counters.late_ticks += 1
        self.counters.skipped_ticks += round(
            (late_ns + self._late_after_ns) / self._tick_period_ns) - 1

    def _advance(self, target_ns: int) -> None:
        """Send the samples up to a time, or as many as one tick has time for."""
        simulation = self._simulation
        publish_from_ns = target_ns - self._latest_ns
        late = simulation.now_ns < publish_from_ns
        skipped = self._skipped() if late else 0
        stop_at_ns = self._steady() + TICK_BUDGET_NS

        def give_way() -> bool:
            return self._steady() > stop_at_ns or not self._hooks.has_room()

        try:
            arrived = self._hooks.has_room() and simulation.advance(
                target_ns, publish_from_ns, give_way)
        except IntegrationError as error:
            self.fail(str(error))
            return
        lag_ns = target_ns - simulation.now_ns
        if not arrived and lag_ns > self._longest_lag_ns:
            self.counters.slipped_ns += lag_ns
            self._start_clock(simulation.now_ns)
            self._warn_overload('the clock slips')
        elif late and self._skipped() > skipped:
            self._warn_overload('live topics skip samples')

    def _skipped(self) -> int:
        return sum(stream.skipped for stream in self._simulation.streams)

    def _warn_overload(self, consequence: str) -> None:
        if not self._warned_overload:
            self._warned_overload = True
            self._hooks.warn(
                f'this machine cannot keep up with these rates: {consequence}; a recording stays '
                'complete, and /diagnostics counts')

    # ------------------------------------------------------------------- what others ask for

    def pause(self) -> None:
        """Send what is due, then hold the motion; does nothing when paused already."""
        if self.running:
            self._advance(self._due())
        self.paused = True
        self._hold()

    def resume(self) -> None:
        """Let simulated time run on from where it was held, without catching up."""
        if self.paused:
            self.paused = False
            if self.running:
                self._start_clock(self.now_ns)

    def step(self, count: int, dt: float) -> int:
        """
        Move a paused motion on by count x dt [s], rounded to 1 ns.

        Returns
        -------
        int
            Simulated time left to do [ns]: not 0 if the step takes too long, or fails.

        """
        self._hooks.update_subscribers()
        target_ns = self.now_ns + round(count * dt * NANOSECONDS)
        stop_at_ns = self._steady() + STEP_BUDGET_NS

        def give_way() -> bool:
            if not self._hooks.has_room():
                self._hooks.wait_for_room()
            return self._steady() > stop_at_ns or self._hooks.stopping()

        try:
            self._simulation.advance(target_ns, give_way=give_way)
        except IntegrationError as error:
            self.fail(str(error))
        self._hold()
        return target_ns - self.now_ns

    def command(self, l3: float, lz: float) -> int:
        """
        Send what is due, then let L3 and Lz jump [kg m^2/s].

        Returns
        -------
        int
            Simulated time of the command [ns].

        Raises
        ------
        ValueError
            If there is no such motion, or the motion has failed; nothing changes then.

        """
        if self.running:
            self._advance(self._due())
        if self.failure is not None:
            raise ValueError(f'l3 = {l3!r}, lz = {lz!r}: the motion stands still: {self.failure}')
        self._simulation.command(l3, lz)
        self.counters.commands += 1
        return self._simulation.history[-1][0]

    def reset(self, values: Mapping[str, Any], epoch_ns: Callable[[int], int]) -> None:
        """
        Go back to the start state, and out of a failure; a pause remains.

        Parameters
        ----------
        values
            Checked parameters of the motion that begins.
        epoch_ns
            Takes the stamp of the last sample, returns the new stamp of t = 0 [ns].

        Raises
        ------
        ValueError, IntegrationError
            If no motion begins there; the present one goes on then.

        """
        simulation = self._simulation
        last_stamp_ns = simulation.epoch_ns + simulation.now_ns
        simulation.restart(values)
        simulation.epoch_ns = epoch_ns(last_stamp_ns)
        self.failure = None
        self._hold()
        if self.running:
            self._start_clock(0)

    def fail(self, reason: str) -> None:
        """Hold the motion until `reset`."""
        self.failure = reason
        self._hold()
        self._hooks.error(f'{reason}; the motion stands still until ~/reset')

    def _start_clock(self, simulated_ns: int) -> None:
        """Let simulated time run from here on; the first tick after this is never late."""
        self._late_from_ns = NEVER_NS
        self._clock.start(simulated_ns)
        self._tell_origin()

    def _tell_origin(self) -> None:
        origin_ns = self._clock.when(0)
        if origin_ns is not None:
            self._hooks.clock_started(origin_ns)

    def _hold(self) -> None:
        """Let simulated time stand exactly where samples are sent up to."""
        self._clock.stop(self.now_ns)
        self._fast_until_ns = -1

    # -------------------------------------------------------------------------- parameters

    def set_pace(self, values: Mapping[str, Any]) -> None:
        """Take over tick_rate, time_scale and duration."""
        time_scale = values['time_scale']
        self._duration_ns = round(values['duration'] * NANOSECONDS)     # 0: for ever
        self._tick_period_ns = NANOSECONDS / values['tick_rate']
        self._late_after_ns = round(1.5 * self._tick_period_ns)
        self._late_from_ns = NEVER_NS
        self._busy_ns = int(BUSY_SHARE * self._tick_period_ns)
        # The rest is in simulated time.
        self._fast_until_ns = -1
        self._subscribers_period_ns = round(SUBSCRIBERS_PERIOD_NS * time_scale)
        self._ahead_ns = round(time_scale * max(
            1.5 * self._tick_period_ns, min(TICKS_AHEAD * self._tick_period_ns, AHEAD_NS)))
        self._latest_ns = int(LATEST_NS * time_scale)
        self._longest_lag_ns = int(LONGEST_LAG_NS * time_scale)
        self._clock.set_scale(time_scale)
        self._tell_origin()

    def look_for_subscribers(self) -> None:
        """Have the next tick count subscribers, as when publishers have come or gone."""
        self._subscribers_due_ns, self._fast_until_ns = 0, -1
