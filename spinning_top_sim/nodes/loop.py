# SPDX-License-Identifier: Apache-2.0
"""What a tick does: which samples are sent now, in real time, without ROS."""

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

from spinning_top_sim.nodes.clock import LATEST_NS, SimulatedClock
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.times import NANOSECONDS, NEVER_NS, stamp_text

SUBSCRIBERS_PERIOD_NS = 100_000_000     # subscribers are counted so often
AHEAD_NS = 50_000_000                   # of what is due, so much is computed ahead
# One tick works at most this long before services and signals get their turn; so does one step.
TICK_BUDGET_NS = 50_000_000
STEP_BUDGET_NS = 2_000_000_000


class LoopState(Enum):
    """What a `Loop` does; simulated time runs in RUNNING only."""

    WAITING = 'waiting for /clock (use_sim_time is set)'
    RUNNING = 'running'
    PAUSED = 'paused'
    FAILED = 'failed'
    ENDED = 'at the end: nothing follows'


STANDING = LoopState.WAITING, LoopState.FAILED, LoopState.ENDED     # no motion goes on there


class Loop:
    """
    Moves a simulation along with a clock.

    What is sent does not depend on when ticks come: each sends all samples that are due.

    update_subscribers : sets `publish` of each output that has subscribers
    error : takes a text for the log: why the motion has failed, or a recording ends
    """

    def __init__(self, simulation: LiveSimulation, values: Mapping[str, Any],
                 recording: Recording, clock: SimulatedClock, *,
                 error: Callable[[str], object], update_subscribers: Callable[[], object],
                 ) -> None:
        self.late_ticks = self.skipped_ticks = self.slipped_ns = 0      # since the start
        self.commands = self.rejected_commands = 0
        self.paused: bool = values['start_paused']      # asked for; a failure does not change it
        self.failure: str | None = None         # why the motion stands still until `reset`
        self._simulation, self._recording, self._clock = simulation, recording, clock
        self._update_subscribers, self._error = update_subscribers, error
        self._subscribers_due_ns = self._last_tick_ns = 0       # on the steady clock
        self._set_pace(values)

    @property
    def state(self) -> LoopState:
        if self._simulation.sent_ns >= self._duration_ns:
            return LoopState.ENDED              # which is final
        if self.failure:
            return LoopState.FAILED             # until a reset
        if self._simulation.epoch_ns == 0:
            return LoopState.WAITING
        return LoopState.PAUSED if self.paused else LoopState.RUNNING

    @property
    def time_text(self) -> str:
        """The simulated time for the user, with all its digits."""
        return f'at t = {stamp_text(self._simulation.now_ns)} s'

    def _set_pace(self, values: Mapping[str, Any]) -> None:
        """Take over tick_rate, time_scale and duration."""
        self._duration_ns = round(values['duration'] * NANOSECONDS) or NEVER_NS
        # With fewer ticks, some of what is due would be too late to be published.
        self.tick_period_ns = min(NANOSECONDS / values['tick_rate'], LATEST_NS / 2)
        self._ahead_ns = round(values['time_scale'] * max(AHEAD_NS, 1.5 * self.tick_period_ns))
        self._clock.set_scale(values['time_scale'])

    def start(self) -> None:
        """Let simulated time run from 0 on, unless a pause is asked for."""
        self._simulation.epoch_ns = self._clock.next_epoch()
        self._begin()

    def _begin(self) -> None:
        self._clock.begin(self._simulation.epoch_ns)
        self._last_tick_ns = self._clock.steady()

    def tick(self) -> LoopState:
        """Send what is due, then compute some of what is due next; return the state."""
        if self.state is LoopState.RUNNING:
            steady_ns = self._clock.steady()
            since_ns, self._last_tick_ns = steady_ns - self._last_tick_ns, steady_ns
            if since_ns > 1.5 * self.tick_period_ns:
                self.late_ticks += 1
                self.skipped_ticks += round(since_ns / self.tick_period_ns) - 1
            if steady_ns >= self._subscribers_due_ns:
                self._update_subscribers()
                self._subscribers_due_ns = steady_ns + SUBSCRIBERS_PERIOD_NS
            if self._advance():
                self._simulation.look_ahead(self._simulation.sent_ns + self._ahead_ns,
                                            self.tick_period_ns / NANOSECONDS)
        return self.state

    def _advance(self) -> bool:
        """Send what is due, or what one tick has time for; return whether nothing is left."""
        simulation, clock = self._simulation, self._clock
        if self.state is not LoopState.RUNNING:
            return True
        due_ns, late_ns, shift_ns = clock.due(simulation.epoch_ns)
        if shift_ns:
            self._recording.write(
                simulation.apply('epoch', epoch_ns=simulation.epoch_ns + shift_ns))
        target_ns = min(due_ns, self._duration_ns)
        stop_at_ns, has_room = clock.steady() + TICK_BUDGET_NS, self._recording.has_room
        if has_room():
            self._send(target_ns, min(late_ns, target_ns) + 1,
                       lambda: clock.steady() > stop_at_ns or not has_room())
        arrived = simulation.sent_ns >= target_ns
        if not arrived and not self.failure:
            self.slipped_ns += clock.slip(simulation.now_ns)
        return arrived

    def _send(self, until_ns: int, publish_from_ns: int, give_way: Callable[[], bool]) -> None:
        try:
            self._simulation.send(until_ns, publish_from_ns, give_way)
        except IntegrationError as error:
            self.fail(str(error))

    def pause(self) -> None:
        """Send what is due, then hold the motion; does nothing when paused already."""
        self._advance()
        self.paused = True

    def resume(self) -> None:
        """Let simulated time run on, without catching up, or raise RuntimeError if it cannot."""
        self.refuse_in(*STANDING)
        if self.paused:
            self.paused = False
            self._clock.run(self._simulation.now_ns)
            self._last_tick_ns = self._clock.steady()   # the next tick is not late

    def step(self, length_ns: int) -> None:
        """Move a paused motion on, at most to `duration`, or raise RuntimeError."""
        self.refuse_in(*STANDING)
        if not self.paused:
            raise RuntimeError('running: ~/step works while paused (~/set_pause true)')
        self._update_subscribers()
        target_ns = min(self._simulation.now_ns + length_ns, self._duration_ns)
        stop_at_ns = self._clock.steady() + STEP_BUDGET_NS
        # Other than a tick it waits for the recorder.
        self._send(target_ns, 0, lambda: self._clock.steady() > stop_at_ns or (
            not self._recording.has_room(STEP_BUDGET_NS / NANOSECONDS)))
        self.refuse_in(LoopState.FAILED)
        if (left_ns := target_ns - self._simulation.now_ns) > 0:
            raise RuntimeError(f'{self.time_text}: this takes too long, '
                               f'{left_ns / NANOSECONDS:.9g} s are left')

    def change(self, kind: str, details: Callable[[], Mapping[str, Any] | None]) -> None:
        """
        Send what is due, then let an event change the motion.

        details : returns those of the event, of what is the present state then; None: no event

        Raises ValueError for what cannot be, and RuntimeError in STANDING.
        """
        if self._simulation.sent_ns < 0:        # the change sends the samples of t = 0
            self._update_subscribers()
        self._advance()
        self.refuse_in(*STANDING)
        if found := details():
            self._recording.write(self._simulation.apply(kind, **found))
            self.commands += 1

    def set_parameters(self, values: Mapping[str, Any], changes: Mapping[str, Any]) -> None:
        """Send what is due, then take over changes into `values`; raise RuntimeError in ENDED."""
        self.refuse_in(LoopState.ENDED)
        self._advance()     # by the old pace, and over a jump of /clock
        self._recording.write(self._simulation.apply('parameters', **changes))
        self._set_pace(values)

    def refuse_in(self, *states: LoopState) -> None:
        """Raise RuntimeError in these states."""
        if (state := self.state) in states:
            raise RuntimeError(f'the motion stands still: {self.failure}'
                               if state is LoopState.FAILED else state.value)

    def reset(self, values: Mapping[str, Any], paused: bool | None = None) -> None:
        """
        Go back to the start state of these parameters, and out of a failure.

        A pause remains, or is as `paused` says.  Raises RuntimeError in WAITING and ENDED, and
        ValueError if no motion begins there; the present one goes on then.
        """
        self.refuse_in(LoopState.WAITING, LoopState.ENDED)
        simulation = self._simulation
        last_stamp_ns = simulation.epoch_ns + simulation.sent_ns
        event = simulation.apply('reset', parameters=values,
                                 epoch_ns=self._clock.next_epoch(last_stamp_ns))
        self.failure = None
        if paused is not None:
            self.paused = paused
        self._begin()
        if simulation.epoch_ns < last_stamp_ns and self._recording.is_on:
            reason = 'stamps have gone back with /clock, and a log keeps them in order'
            self._recording.end(error=reason)
            self._error(f'recording stopped: {reason}; ~/record starts another')
        self._recording.write(event)

    def end(self) -> None:
        """Let nothing follow what is sent."""
        self._duration_ns = self._simulation.sent_ns

    def fail(self, reason: str) -> None:
        """Hold the motion until `reset`."""
        self.failure = reason
        self._error(f'{reason}; the motion stands still until ~/reset')
