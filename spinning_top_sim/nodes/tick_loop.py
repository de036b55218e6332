# SPDX-License-Identifier: Apache-2.0
"""What a tick does: which samples are sent now, in real time, without ROS."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from enum import Enum
from typing import Any

from spinning_top_sim.nodes.pacing import SimulatedClock
from spinning_top_sim.nodes.recording_session import RecordingSession
from spinning_top_sim.physics.pivot import NEVER_NS
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS, stamp_text
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.simulation import checked_velocity

# The stamp of t = 0 is a multiple of this, so that grids meet across streams and runs.
EPOCH_GRID_NS = 10_000_000
SUBSCRIBERS_PERIOD_NS = 50_000_000      # subscribers are counted so often
# `idle` may fill this share of the time between two ticks.  The look-ahead starts so many ticks,
# or so much time, before it is needed, whichever is shorter.
BUSY_SHARE = 0.35
TICKS_AHEAD, AHEAD_NS = 24, 50_000_000
# One tick works at most this long before services and signals get their turn; so does one step.
TICK_BUDGET_NS = 50_000_000
STEP_BUDGET_NS = 2_000_000_000
LATEST_NS = 500_000_000         # samples later than this are recorded, but not published any more
# A simulation further behind than this lets its clock slip: its real-time factor falls below 1.
LONGEST_LAG_NS = 1_000_000_000
# Velocities of the pivot are applied at most this often, the last of several: each of them begins
# another motion.
DRIVE_PERIOD_NS = 20_000_000
# No motion begins later than a day before the stamps end.
LAST_EPOCH_NS = LAST_STAMP_NS - 86_400 * NANOSECONDS


def next_epoch(date_ns: int) -> int:
    """Return the first stamp from this date on [ns] that t = 0 may have.  Raises ValueError."""
    if date_ns > LAST_EPOCH_NS:
        raise ValueError('the seconds of a ROS stamp, an int32, end in January 2038')
    return -(-date_ns // EPOCH_GRID_NS) * EPOCH_GRID_NS


class LoopState(Enum):
    """
    What a `TickLoop` does; simulated time runs in RUNNING only.

        WAITING --start--> RUNNING --pause--> PAUSED --resume--> RUNNING
        RUNNING, or PAUSED by a step --duration--> ENDED, which is final
        any but ENDED --fail--> FAILED
        any but ENDED --reset--> RUNNING

    `start` and `reset` lead to PAUSED if a pause is asked for.
    """

    WAITING = 'waiting for the start'
    RUNNING = 'running'
    PAUSED = 'paused'
    FAILED = 'failed'
    ENDED = 'all samples of `duration` are sent'


class TickLoop:
    """
    Moves a simulation along with a clock; calls from several threads need a lock around them.

    What is sent does not depend on when ticks come: each sends all samples that are due.

    update_subscribers : sets `publish` of each output that has subscribers
    warn, error : take a text for the log; `error` why the motion has failed
    source : returns the time that simulated time follows [ns]
    steady : returns steady time [ns]; decides which ticks are late and how long one may work
    grid : steady time of a tick, just after samples are due, and the time between ticks [s]
    """

    def __init__(self, simulation: LiveSimulation, values: Mapping[str, Any],
                 recording: RecordingSession, *, warn: Callable[[str], object],
                 error: Callable[[str], object], update_subscribers: Callable[[], object],
                 source: Callable[[], int] = time.monotonic_ns,
                 steady: Callable[[], int] = time.monotonic_ns) -> None:
        self.late_ticks = self.skipped_ticks = self.slipped_ns = 0      # since the start
        self.commands = self.rejected_commands = 0
        self.state = LoopState.WAITING
        self.paused: bool = values['start_paused']      # asked for; a failure does not change it
        self.failure: str | None = None         # why the motion stands still until `reset`
        self.interruptions = 0                  # changes of the state, and resets
        self._simulation, self._recording = simulation, recording
        self._update_subscribers, self._warn, self._error = update_subscribers, warn, error
        self._steady, self._is_steady = steady, source is steady
        self._clock = SimulatedClock(source, values['time_scale'])
        self._subscribers_due_ns = 0            # on the steady clock
        # Asked for the pivot, and not yet applied
        self._velocity: tuple[float, float, float] | None = None
        self._drive_from_ns = 0                 # simulated time of the next velocity
        self._block_unfinished = False          # `idle` goes on with a block of samples
        self.set_pace(values)

    @property
    def now_ns(self) -> int:
        """Simulated time up to which samples are sent [ns], >= 0."""
        return max(self._simulation.now_ns, 0)

    @property
    def time_text(self) -> str:
        """The simulated time for the user, with all its digits."""
        return f'at t = {stamp_text(self.now_ns)} s'

    def start(self) -> None:
        """Let simulated time run from 0 on, unless the motion is paused or has failed."""
        if self.state is LoopState.WAITING:
            self._enter(LoopState.PAUSED if self.paused else LoopState.RUNNING)

    def _enter(self, state: LoopState) -> None:
        """Change the state; time runs, or stands, from where all samples are sent."""
        if self.state not in {state, LoopState.ENDED}:
            self.state = state
            self.interruptions += 1
        self._anchor_clock()

    def _anchor_clock(self) -> None:
        """Let the simulated clock show now what is sent, and run in RUNNING only."""
        self._clock.set(self.now_ns, running=self.state is LoopState.RUNNING)
        self._pace_ticks()

    def _pace_ticks(self) -> None:
        """Set when ticks come; the next one is not late."""
        origin_ns = self._clock.when(0) if self._is_steady else None
        self.grid = (origin_ns or 0) / NANOSECONDS, self._tick_period_ns / NANOSECONDS
        self._late_from_ns = NEVER_NS           # on the steady clock: a tick from then on is late

    def tick(self) -> bool:
        """Send what is due; return whether `idle` has something to do before the next tick."""
        if self.state is not LoopState.RUNNING:
            return False
        steady_ns = self._steady()
        if steady_ns > self._late_from_ns:
            self.late_ticks += 1
            since_last_ns = steady_ns - (self._late_from_ns - self._late_after_ns)
            self.skipped_ticks += round(since_last_ns / self._tick_period_ns) - 1
        self._late_from_ns = steady_ns + self._late_after_ns
        if steady_ns >= self._subscribers_due_ns:
            self._update_subscribers()
            self._subscribers_due_ns = steady_ns + SUBSCRIBERS_PERIOD_NS
        due_ns = self._advance()
        self._apply_velocity()
        now_ns = self._simulation.now_ns
        if now_ns >= self._duration_ns:
            self._enter(LoopState.ENDED)
            return False
        return now_ns >= due_ns and (
            self._block_unfinished or self._simulation.computed_ns < now_ns + self._ahead_ns)

    def idle(self) -> None:
        """Compute some of the samples that are due next, until about the next tick."""
        simulation = self._simulation
        self._block_unfinished = not simulation.prepare(
            simulation.now_ns + self._ahead_ns, int(BUSY_SHARE * self._tick_period_ns))

    def _advance(self) -> int:
        """Send what is due, or what one tick has time for; return the simulated time due [ns]."""
        simulation = self._simulation
        due_ns = self._clock.now()
        target_ns = min(due_ns, self._duration_ns)
        if self.state is not LoopState.RUNNING:
            return target_ns
        if due_ns < simulation.now_ns:          # as where a log is played in a loop
            back_s = (simulation.now_ns - due_ns) / self._time_scale / NANOSECONDS
            self._warn(f'/clock stepped back by {back_s:g} s: the motion and its stamps go on '
                       'from where they are')
            self._anchor_clock()
            return simulation.now_ns
        stop_at_ns, has_room = self._steady() + TICK_BUDGET_NS, self._recording.has_room
        try:
            arrived = has_room() and simulation.advance(
                target_ns, target_ns - self._latest_ns,
                lambda: self._steady() > stop_at_ns or not has_room())
        except IntegrationError as error:
            self.fail(str(error))
            return target_ns
        lag_ns = target_ns - simulation.now_ns
        if not arrived and lag_ns > LONGEST_LAG_NS * self._time_scale:
            self.slipped_ns += lag_ns
            self._anchor_clock()
        return target_ns

    def pause(self) -> None:
        """Send what is due, then hold the motion; does nothing when paused already."""
        self._advance()
        self.paused = True
        if self.state is LoopState.RUNNING:
            self._enter(LoopState.PAUSED)

    def resume(self) -> None:
        """
        Let simulated time run on from where it was held, without catching up.

        Raises RuntimeError if the motion has failed; a pause remains then.
        """
        if self.failure:
            raise RuntimeError(f'the motion stands still: {self.failure}')
        self.paused = False
        if self.state is LoopState.PAUSED:
            self._enter(LoopState.RUNNING)

    def step(self, length_ns: int) -> None:
        """Move a paused motion on, at most to `duration`, or raise RuntimeError."""
        if self.failure:
            raise RuntimeError(f'the motion stands still: {self.failure}')
        if not self.paused:
            raise RuntimeError('running: ~/step works while paused (~/set_pause true)')
        self._update_subscribers()
        self._apply_velocity()
        target_ns = min(self.now_ns + length_ns, self._duration_ns)
        stop_at_ns = self._steady() + STEP_BUDGET_NS

        def give_way() -> bool:
            if not self._recording.has_room():
                self._recording.wait_for_room()
            return self._steady() > stop_at_ns

        try:
            self._simulation.advance(target_ns, give_way=give_way)
        except IntegrationError as error:
            self.fail(str(error))
        self._enter(LoopState.ENDED if self.now_ns >= self._duration_ns else self.state)
        if self.failure:
            raise RuntimeError(self.failure)
        if self.now_ns < target_ns:
            raise RuntimeError(f'{self.time_text}: this takes too long, '
                               f'{(target_ns - self.now_ns) / NANOSECONDS:.9g} s are left')

    def command(self, l3: float, lz: float) -> None:
        """Send what is due, then let L3 and Lz jump [kg m^2/s], or raise ValueError."""
        self._send_before_change()
        self._simulation.command(l3, lz)
        self._recording.write_command(l3, lz)
        self.commands += 1

    def set_state(self, change: Callable[[States], State]) -> None:
        """
        Send what is due, then let the top be in another state, or raise ValueError.

        change : takes the present state (n = 1), and returns the new one
        """
        self._send_before_change()
        state = change(self._simulation.state())
        self._simulation.set_state(state)
        self._recording.write_event('state', **asdict(state))
        self.commands += 1

    def drive(self, velocity: Sequence[float]) -> None:
        """Let the pivot go to a velocity [m/s] from the end of a tick on, or raise ValueError."""
        self._velocity = checked_velocity(velocity)

    def _apply_velocity(self) -> None:
        velocity, now_ns = self._velocity, self.now_ns
        if velocity is None or self.failure or now_ns < self._drive_from_ns:
            return
        self._velocity, self._drive_from_ns = None, now_ns + DRIVE_PERIOD_NS
        try:
            stop_ns = self._simulation.drive(velocity)
        except ValueError as error:
            self.rejected_commands += 1
            self._warn(f'~/cmd_vel: refused: {error}')
            return
        if stop_ns is not None:
            x, y, z = velocity
            self._recording.write_event('drive', x=x, y=y, z=z, stop_ns=stop_ns)
            self.commands += 1

    def _send_before_change(self) -> None:
        if self._simulation.now_ns < 0:         # the change sends the samples of t = 0
            self._update_subscribers()
        self._advance()
        if self.failure:
            raise ValueError(f'the motion stands still: {self.failure}')

    def reset(self, values: Mapping[str, Any], date_ns: int, paused: bool | None = None) -> None:
        """
        Go back to the start state of these parameters, and out of a failure.

        A pause remains, or is as `paused` says.  t = 0 has this date or, as stamps never go back,
        a later one.  Raises RuntimeError in ENDED, and ValueError if no motion begins there; the
        present one goes on then.
        """
        if self.state is LoopState.ENDED:
            raise RuntimeError(f'{self.state.value}: nothing follows')
        simulation, sent_ns = self._simulation, self._simulation.now_ns
        epoch_ns = next_epoch(max(simulation.epoch_ns + sent_ns + 1, date_ns))
        simulation.restart(values)
        simulation.epoch_ns = epoch_ns
        self.failure = self._velocity = None
        self._drive_from_ns = 0
        if paused is not None:
            self.paused = paused
        self.interruptions += 1
        self.set_pace(values)           # a change that failed midway may not have set it
        self._enter(LoopState.PAUSED if self.paused else LoopState.RUNNING)
        self._recording.write_event('reset', sent_ns, epoch_ns=epoch_ns, parameters=values)

    def fail(self, reason: str) -> None:
        """Hold the motion until `reset`."""
        self.failure = reason
        self._enter(LoopState.FAILED)
        self._error(f'{reason}; the motion stands still until ~/reset')

    def set_pace(self, values: Mapping[str, Any]) -> None:
        """Take over tick_rate, time_scale and duration."""
        self._time_scale = values['time_scale']
        self._duration_ns = round(values['duration'] * NANOSECONDS) or NEVER_NS
        # With fewer ticks, some of what is due would be too late to be published.
        self._tick_period_ns = min(NANOSECONDS / values['tick_rate'], LATEST_NS / 2)
        self._late_after_ns = round(1.5 * self._tick_period_ns)
        self._ahead_ns = round(self._time_scale * max(
            1.5 * self._tick_period_ns, min(TICKS_AHEAD * self._tick_period_ns, AHEAD_NS)))
        self._latest_ns = round(self._time_scale * LATEST_NS)
        self._clock.set_scale(self._time_scale)
        self._pace_ticks()
