# SPDX-License-Identifier: Apache-2.0
"""
The simulation itself: solver -> streams -> sinks, the same live and offline.

Time is integer nanoseconds since the start.  The caller says how far to go and who takes what;
every sample due until then is computed in order of time, once for all who take it.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import repeat
from typing import TYPE_CHECKING, Any

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import Columns, OneState
from spinning_top_sim.physics.regimes import Description, describe
from spinning_top_sim.physics.top import State, Top, pole_momentum
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.propagator import (
    ExactPropagator,
    Propagator,
    anchored,
    propagate,
)
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import Invariants, Markers, Stream, all_streams

if TYPE_CHECKING:
    from spinning_top_sim.solvers.motion import ExactGrid

# Integration steps between two looks at whether to give way: about 5 ms.
STEPS_AT_ONCE = 500
# Instants that are computed at most in one go.
MOST_AT_ONCE = 256
# Nor is more computed ahead than this, for a command makes it useless; who has just commanded may
# do so again soon, so it begins with few instants, and goes on with twice as many each time.
FARTHEST_AHEAD_NS = 300_000_000
FEWEST_AHEAD = 16
# Columns of fewer instants cost more than the instants one by one.
FEWEST_IN_COLUMNS = 12
NEVER_NS = 2 ** 63 - 1

# The samples of an instant for a log: numbers of their streams there, stamp [ns], messages, size
# of these together [bytes]; and what takes them.
Messages = tuple[Sequence[int], int, Sequence[bytes], int]
Log = Callable[[Sequence[int], int, Sequence[bytes], int], Any]


class Takers:
    """
    Who takes the messages of an instant, which has those of the same streams as others.

    log: numbers of its streams in the log;  logged: where their messages are among all, None for
    in every place;  size: of these together [bytes]
    records, publications: who else, each with the place of the message
    """

    __slots__ = ('log', 'logged', 'publications', 'records', 'size')

    def __init__(self, streams: Sequence[Stream]) -> None:
        logged = [k for k, stream in enumerate(streams) if stream.log_index is not None]
        self.log = tuple(stream.log_index for stream in streams if stream.log_index is not None)
        self.logged = None if len(logged) == len(streams) else logged
        self.size = sum(len(streams[k].template) for k in logged)
        self.records = [(stream.record, k) for k, stream in enumerate(streams)
                        if stream.record is not None]
        self.publications = [(stream.publish, k, stream) for k, stream in enumerate(streams)
                             if stream.publish is not None]


# Time [ns], who takes the messages, and these.
Instant = tuple[int, Takers, Sequence[bytes]]


class Simulation:
    """
    One top in motion.

    streams: all of them, whose `publish` and `record` the caller sets, besides `log_to`
    now_ns: simulated time up to which every sample has been sent (-1: not even that of t = 0)
    l3, lz: as last commanded;  history: applied commands since the start as (t_ns, l3, lz)
    solver: the present motion, whose t = 0 is anchor_ns
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        """
        Take checked parameters (`parameters.checked`) and the stamp of t = 0 [ns].

        Raises ValueError or IntegrationError where there is no motion from their start state.
        """
        self.epoch_ns = epoch_ns
        # What comes next: the instants that are computed already, and from when on there is more
        # to compute; of each stream that anybody takes, its first sample from there on; what is
        # being computed.
        self._ready: deque[Instant] = deque()
        self._beyond_ns, self._shortest_ns = -1, NEVER_NS
        self._most_ahead = FEWEST_AHEAD
        self._cursors: list[_Cursor] = []
        self._takers: dict[tuple[int, ...], Takers] = {}        # by the numbers of cursors
        self._work: Iterator[None] | None = None
        self._log: Log | None = None
        self._steps_before = self._evaluations_before = 0
        self.streams: list[Stream] = []
        self._load(values)

    def restart(self, values: Mapping[str, Any]) -> None:
        """
        Go back to the start state of these parameters; sinks, counts and stamps remain.

        Raises ValueError or IntegrationError where there is no motion from there; then the one
        there was goes on.
        """
        counts = self.steps, self.evaluations
        self._load(values)
        self._steps_before, self._evaluations_before = counts

    def _load(self, values: Mapping[str, Any]) -> None:
        top = parameters.top_of(values)
        start = parameters.start_state(values)
        solver, state = _first_step(top, start, values)
        self.values, self.top = dict(values), top
        self.history: list[tuple[int, float, float]] = []
        self.now_ns = -1
        streams = all_streams(values, Imu(values))
        for new, old in zip(streams, self.streams, strict=False):
            new.publish, new.record, new.log_index = old.publish, old.record, old.log_index
            new.sent, new.skipped = old.sent, old.skipped
        for stream in streams:
            stream.changed = self._forget
        self.streams = streams
        self._invariants = next(s for s in streams if isinstance(s, Invariants))
        self._past = _Past(top, round(values['markers.trace_length'] * NANOSECONDS))
        self._markers = next(s for s in streams if isinstance(s, Markers))
        self._markers.axis_at = self.axis_at
        self._begin(solver, start, state, 0)

    def _begin(self, solver: Propagator, start: State, state: OneState, at_ns: int) -> None:
        """Let a motion begin at a time."""
        self._forget()
        self.solver, self._anchor, self.anchor_ns, self._first = solver, start, at_ns, state
        self._known_ns = at_ns                  # no further steps are needed up to here
        self._reference: ExactPropagator | None = None
        self._invariants.orientation_error = self.orientation_error
        self.l3, self.lz = state.l3_start, state.lz_start
        self._invariants.start_from(state)

    @property
    def begun(self) -> object:
        """Something that is the same as long as the same motion goes on."""
        return self._first

    @property
    def start_energy(self) -> float:
        """Of the present motion [J], as it began."""
        return self._first.energy

    def energy_drift(self, state: OneState) -> float:
        """Return the energy's relative drift since then (absolute where it was 0)."""
        return (state.energy - self._first.energy) / (abs(self._first.energy) or 1.0)

    @property
    def steps(self) -> int:
        """Integration steps taken so far."""
        return self._steps_before + self.solver.steps

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self._evaluations_before + self.solver.evaluations

    def state(self) -> OneState:
        """Return the state at `now_ns` (at the start before the first sample)."""
        return self.solver.at_ns(self._readable_ns() - self.anchor_ns)

    def _readable_ns(self) -> int:
        """Return `now_ns`, or what steps shorter than 1 ns have left of it."""
        return max(self.now_ns, self.anchor_ns + self.solver.earliest_ns)

    def orientation_error(self, state: Columns, t_ns: int) -> float:
        """
        Return the angle between a state at t_ns and the exact solution there [rad].

        0 for the exact solution itself; NaN for a motion that it cannot hold.
        """
        exact = self.exact()
        if exact is None or exact is self.solver:
            return math.nan if exact is None else 0.0
        return attitude.angle_between(state.quaternion,
                                      exact.at_ns(t_ns - self.anchor_ns).quaternion)

    def describe(self) -> Description | None:
        """Return the present motion in numbers; None where the closed form cannot hold it."""
        exact = self.exact()
        if exact is None:
            return None
        return describe(self.top, exact.solution.start, exact.solution)

    def exact(self) -> ExactPropagator | None:
        """
        Return the closed form of the present motion, set up when first asked for.

        Its t = 0 is `anchor_ns`.  None for a motion that it cannot hold.
        """
        if isinstance(self.solver, ExactPropagator):
            return self.solver
        if self._reference is None:
            self.exact_in_advance()()
        return self._reference

    def axis_at(self, t_ns: int) -> tuple[float, float, float]:
        """
        Return e3 in the world by the exact solution, at a time within the trace of `now_ns`.

        Each motion is followed from its anchor to the command that ended it, that instant
        included.  One that the closed form cannot hold stands at its anchor.
        """
        if t_ns <= self.anchor_ns and self._past:
            return self._past.axis_at(t_ns)
        return _axis(self.exact(), self._anchor, t_ns - self.anchor_ns)

    def exact_in_advance(self) -> Callable[[], None]:
        """
        Return what sets up `exact` for the present motion, if it is not there yet.

        That may run in another thread than the simulation: it takes milliseconds, 30 ms at the
        first time for its modules.
        """
        motion = self._first

        def set_up() -> None:
            if self._reference is None and not isinstance(self.solver, ExactPropagator):
                with contextlib.suppress(ValueError):
                    reference = ExactPropagator(top, anchor)
                    if motion is self._first:
                        self._reference = reference
        top, anchor = self.top, self._anchor
        return set_up

    def log_to(self, write: Log, streams: Sequence[Stream]) -> None:
        """
        Have the samples of these streams taken by a log from now on, those of an instant at once.

        write: see `Log`; a stream has the number that it has in `streams`.  No streams: no log.
        """
        self._log = write
        for stream in self.streams:
            stream.log_index = streams.index(stream) if stream in streams else None
        self._forget()

    def advance(self, target_ns: int, publish_from_ns: int = 0,
                give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every sample due up to `target_ns`; return whether that was reached.

        publish_from_ns: earlier samples are recorded, not published (they come too late)
        give_way: asked between samples, and within long integrations; True ends the call early,
            with nothing lost: the next call goes on there.
        Raises IntegrationError where the equations cannot go on.
        """
        if self.now_ns < publish_from_ns:
            self._skip(publish_from_ns)
        ready = self._ready
        sent = False
        while True:
            if not ready:
                due_ns = self._next_due()
                if due_ns > target_ns:
                    break
                if due_ns > self._known_ns and not self._reach(due_ns, give_way):
                    return False
                if self._work is None:
                    self._work = self._computation(target_ns)
                self._go_on()
            instant = ready[0]
            if instant[0] > target_ns:
                break
            if sent and give_way():
                return False
            ready.popleft()
            self._send(instant, instant[0] >= publish_from_ns)
            sent = True
        if target_ns > self._known_ns and not self._reach(target_ns, give_way):
            return False
        if target_ns > self.now_ns:     # noqa: PLR1730 - max() takes twice the time
            self.now_ns = target_ns
        return True

    def send_ready(self, target_ns: int) -> bool:
        """
        Do what `advance` does if everything due is computed; return False, and do nothing, if not.

        For the tick that comes in time: what it touches is little, for little of it is in the
        processor's caches after a rest.
        """
        if target_ns >= self._beyond_ns or target_ns > self._known_ns:
            return False
        ready = self._ready
        while ready and ready[0][0] <= target_ns:
            self._send(ready.popleft())
        if target_ns > self.now_ns:     # noqa: PLR1730 - max() takes twice the time
            self.now_ns = target_ns
        return True

    @property
    def ready_ns(self) -> int:
        """Before this time everything due is sent or computed [ns]."""
        return self._beyond_ns

    def prepare(self, until_ns: int, instants: int, budget_ns: int | None = None) -> bool:
        """
        Compute now what is due up to `until_ns`, if it is not yet: many at once are cheap.

        instants: compute so many, or FARTHEST_AHEAD_NS, where any are to be computed; fewer at
            first, and after a command
        budget_ns: stop after about this time, and go on with the next call
        Return whether all that is done.  What is sent does not depend on it, a command finds the
        state that it would have found; what then no longer holds is forgotten.
        """
        if self._work is None:
            due_ns = self._next_due()
            if due_ns > until_ns:
                return True
            instants = min(instants, self._most_ahead)
            self._most_ahead = min(2 * self._most_ahead, MOST_AT_ONCE)
            self._work = self._computation(max(until_ns, due_ns + min(
                (instants - 1) * self._shortest_ns, FARTHEST_AHEAD_NS)))
        return self._go_on(None if budget_ns is None else time.monotonic_ns() + budget_ns)

    @property
    def in_columns(self) -> bool:
        """Whether many instants are computed in little more time than one."""
        return self.solver.in_columns

    def advance_in_columns(self, target_ns: int,
                           send: Callable[[Stream, Any, Any], None]) -> None:
        """
        Send every sample due up to `target_ns`, whole columns of a stream at a time.

        For the exact solution, which knows all times at once; offline only.
        send: takes the stream, its stamps (n,) int64 [ns], and the messages as rows of bytes
            (n, size) uint8, valid until the next call
        Raises ValueError for a solver that takes steps.
        """
        import numpy  # noqa: PLC0415

        if not isinstance(self.solver, ExactPropagator):
            raise ValueError("solver.method: columns need 'exact'")
        self._forget()
        grids: dict[tuple[int, int], ExactGrid] = {}
        for stream in self.streams:
            if not stream.wanted:
                continue
            if stream.next_ns <= self.now_ns:
                stream.resume(self.now_ns)
            first, period = stream.next_ns, stream.period_ns
            count = (target_ns - first) // period + 1
            if count <= 0:
                continue
            if (first, period) not in grids:
                grids[first, period] = self.solver.grid(first - self.anchor_ns, period, count)
            stamps = self.epoch_ns + first + period * numpy.arange(count, dtype=numpy.int64)
            send(stream, stamps, stream.encode_many(grids[first, period], stamps))
            stream.next_ns += count * period
        self.now_ns = target_ns

    def _reach(self, t_ns: int, give_way: Callable[[], bool]) -> bool:
        local_ns = t_ns - self.anchor_ns
        while not self.solver.reach_ns(local_ns, STEPS_AT_ONCE):
            if give_way():
                # Nothing is due before t_ns, and the steps taken cannot be taken back.
                reached_ns = self.anchor_ns + self.solver.latest_ns
                self.now_ns = max(self.now_ns, min(reached_ns, t_ns - 1))
                return False
        self._known_ns = self.anchor_ns + self.solver.latest_ns
        return True

    def _forget(self) -> None:
        """Drop what is computed ahead: it is not what comes next any more."""
        self._ready.clear()
        self._work = None
        self._beyond_ns = -1
        self._most_ahead = FEWEST_AHEAD

    def _next_due(self) -> int:
        """Return when there is more to compute than what is ready [ns]."""
        if self._beyond_ns <= self.now_ns:
            now_ns, due_ns = self.now_ns, NEVER_NS
            streams = [stream for stream in self.streams if stream.wanted]
            for stream in streams:
                if stream.next_ns <= now_ns:
                    stream.resume(now_ns)
                due_ns = min(due_ns, stream.next_ns)
            self._cursors = [_Cursor(stream) for stream in streams]
            self._shortest_ns = min((stream.period_ns for stream in streams), default=NEVER_NS)
            self._takers.clear()
            self._ready.clear()
            self._work, self._beyond_ns = None, due_ns
        return self._beyond_ns

    def _skip(self, until_ns: int) -> None:
        """Leave out the samples before a time that are not recorded, and count them."""
        for stream in self.streams:
            if stream.publish is None or stream.recorded:
                continue
            first_ns = max(stream.next_ns, (self.now_ns // stream.period_ns + 1)
                           * stream.period_ns)
            if first_ns < until_ns:
                stream.resume(until_ns - 1)
                stream.skipped += (stream.next_ns - first_ns) // stream.period_ns

    def _go_on(self, end_ns: int | None = None) -> bool:
        """Go on with the computation under way, at most to that time; return whether it ended."""
        assert self._work is not None
        try:
            for _ in self._work:
                if end_ns is not None and time.monotonic_ns() >= end_ns:
                    return False
        except BaseException:
            self._forget()
            raise
        self._work = None
        return True

    def _computation(self, until_ns: int) -> Iterator[None]:
        """
        Compute the messages of what is due next, up to a time or as far as the steps allow.

        In pieces of some 0.1 ms.
        """
        until_ns = min(until_ns, self._beyond_ns + (MOST_AT_ONCE - 1) * self._shortest_ns)
        solver, anchor_ns = self.solver, self.anchor_ns
        # What cannot go on may not concern anybody; `advance` meets it in its time.
        with contextlib.suppress(IntegrationError):
            while solver.step_ahead(until_ns - anchor_ns, self.now_ns - anchor_ns,
                                    self._shortest_ns):
                yield
        self._known_ns = max(self._known_ns, anchor_ns + solver.latest_ns)
        until_ns = min(until_ns, self._known_ns)
        states = _States(solver, anchor_ns)
        found = []
        for number, cursor in enumerate(self._cursors):
            if times := cursor.take(until_ns):
                messages: list[bytes] = []
                found.append((number, times, messages))
                for some in self._messages(cursor.stream, times, states):
                    messages += some
                    yield
        if found and all(times == found[0][1] for _, times, _ in found):
            takers = self._takers_of(tuple(number for number, _, _ in found))
            self._ready.extend(zip(found[0][1], repeat(takers),
                                   zip(*(messages for _, _, messages in found), strict=True),
                                   strict=False))
        else:
            instants: dict[int, tuple[list[int], list[bytes]]] = {}
            for number, times, messages in found:
                for t_ns, data in zip(times, messages, strict=True):
                    numbers, all_data = instants.setdefault(t_ns, ([], []))
                    numbers.append(number)
                    all_data.append(data)
            self._ready.extend((t_ns, self._takers_of(tuple(numbers)), all_data)
                               for t_ns, (numbers, all_data) in sorted(instants.items()))
        self._beyond_ns = min(cursor.due_ns for cursor in self._cursors)

    def _takers_of(self, numbers: tuple[int, ...]) -> Takers:
        """Return who takes the messages of the streams of these cursors."""
        takers = self._takers.get(numbers)
        if takers is None:
            takers = self._takers[numbers] = Takers([self._cursors[k].stream for k in numbers])
        return takers

    def _messages(self, stream: Stream, times: range, states: _States,
                  ) -> Iterator[Sequence[bytes]]:
        """Yield the messages of a stream at these times [ns], in order, as many as are made."""
        if stream.one_by_one or len(times) < FEWEST_IN_COLUMNS or not self.solver.in_columns:
            for t_ns in times:
                yield (stream.encode(states.at(t_ns), self.epoch_ns + t_ns, t_ns),)
        else:
            columns = states.columns(times)
            yield ()
            yield from stream.encode_columns(columns, self.epoch_ns, times)

    def _send(self, instant: Instant, publishes: bool = True) -> None:
        """Hand out the samples of an instant; count those that are too late to be published."""
        t_ns, takers, messages = instant
        stamp_ns = self.epoch_ns + t_ns
        if takers.log:
            assert self._log is not None
            logged = takers.logged
            self._log(takers.log, stamp_ns, messages if logged is None
                      else [messages[k] for k in logged], takers.size)
        for record, k in takers.records:
            record(stamp_ns, messages[k])
        # After all is recorded: where it fails, as the node ends, the log has the instant whole.
        # One right after the other: each finds the middleware still awake from the one before.
        self.now_ns = t_ns
        for publish, k, stream in takers.publications:
            if publishes:
                publish(messages[k])
                stream.sent += 1
            else:
                stream.skipped += 1

    def command(self, l3: float, lz: float) -> None:
        """
        Let L3 and Lz jump now [kg m^2/s]: an impulsive torque.  Angles and theta' stay.

        Raises ValueError naming what is off; then the motion goes on unchanged.
        """
        for name, value in (('l3', l3), ('lz', lz)):
            if not math.isfinite(value):
                raise ValueError(f'{name} = {value!r} kg m^2/s: must be finite')
        at_ns = max(self._readable_ns(), 0)
        if at_ns > max(self.now_ns, 0):
            self.advance(at_ns)
        state = self.solver.at_ns(at_ns - self.anchor_ns)
        pole = pole_momentum(abs(state.theta), l3)
        if pole is not None and lz != pole:
            raise ValueError(
                f'lz = {lz!r} kg m^2/s with l3 = {l3!r}: the axis is at a pole (theta = '
                f'{state.theta!r} rad), where lz must equal {pole!r}; command both together')
        start = anchored(state, l3, lz)
        try:
            solver, state_after = _first_step(self.top, start, self.values)
        except (ArithmeticError, ValueError, RuntimeError) as error:
            raise ValueError(f'l3 = {l3!r}, lz = {lz!r} kg m^2/s: no motion from theta = '
                             f'{state.theta!r} rad: {error}') from error
        self._steps_before, self._evaluations_before = self.steps, self.evaluations
        self._past.end(self.anchor_ns, self._anchor, at_ns)
        self._begin(solver, start, state_after, at_ns)
        self._markers.forget_after(at_ns)
        self.history.append((at_ns, l3, lz))


class _Cursor:
    """Where a stream that somebody takes will go on: due_ns, its first sample not computed."""

    def __init__(self, stream: Stream) -> None:
        self.stream, self.due_ns = stream, stream.next_ns

    def take(self, until_ns: int) -> range:
        """Go on behind a time; return when samples are due up to there."""
        times = range(self.due_ns, until_ns + 1, self.stream.period_ns)
        self.due_ns += len(times) * self.stream.period_ns
        return times


class _States:
    """The states of a motion at some times, each computed once for all streams."""

    def __init__(self, solver: Propagator, anchor_ns: int) -> None:
        self._solver, self._anchor_ns = solver, anchor_ns
        self._single: dict[int, OneState] = {}
        self._columns: dict[range, Columns] = {}

    def at(self, t_ns: int) -> OneState:
        """Return the state at a time."""
        state = self._single.get(t_ns)
        if state is None:
            state = self._single[t_ns] = self._solver.at_ns(t_ns - self._anchor_ns)
        return state

    def columns(self, times: range) -> Columns:
        """Return the states at these times, which `in_columns` has to allow."""
        states = self._columns.get(times)
        if states is None:
            states = self._columns[times] = self._solver.columns_ns(
                range(times.start - self._anchor_ns, times.stop - self._anchor_ns, times.step))
        return states


class _Past:
    """The motions that commands have ended, as far back as the trace goes."""

    def __init__(self, top: Top, length_ns: int) -> None:
        self._top, self._length_ns = top, length_ns
        self._motions: deque[tuple[int, int, State]] = deque()      # begin, end, start
        self._followed: tuple[State, ExactPropagator | None] | None = None

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._motions)

    def end(self, begin_ns: int, start: State, end_ns: int) -> None:
        """Add the motion that a command ends; forget those that no trace reaches any more."""
        self._motions.append((begin_ns, end_ns, start))
        while self._motions[0][1] < end_ns - self._length_ns:
            self._motions.popleft()

    def axis_at(self, t_ns: int) -> tuple[float, float, float]:
        """Return e3 in the world at a time up to the newest command."""
        begin_ns, start = next((begin, start) for begin, end, start in self._motions
                               if t_ns <= end)
        if self._followed is None or self._followed[0] is not start:
            exact = None
            with contextlib.suppress(ValueError):
                exact = ExactPropagator(self._top, start)
            self._followed = start, exact
        return _axis(self._followed[1], start, t_ns - begin_ns)


def _axis(exact: ExactPropagator | None, start: State, ns: int) -> tuple[float, float, float]:
    """Return e3 in the world at a time after the start of a motion."""
    if exact is None:
        across = math.sin(start.theta)
        return across * math.cos(start.phi), across * math.sin(start.phi), math.cos(start.theta)
    xy, z = exact.at_ns(ns).axis
    return xy.real, xy.imag, z


def _first_step(top: Top, start: State, values: Mapping[str, Any]) -> tuple[Propagator, OneState]:
    """Return the motion from `start` and its first state; the first step shows if there is one."""
    def begin() -> Propagator:
        return propagate(top, start, method=values['solver.method'],
                         equations=values['solver.equations'], rtol=values['solver.rtol'],
                         atol=values['solver.atol'])

    solver = begin()
    state = solver.at_ns(0)
    if not math.isfinite(state.energy):
        raise ValueError(f'the energy would be {state.energy!r} J with {_rates(start)}')
    if not solver.reach_ns(1, STEPS_AT_ONCE):
        raise ValueError(f'{_rates(start)} turn the top too fast: over {STEPS_AT_ONCE} steps a '
                         'nanosecond')
    if solver.earliest_ns:              # steps shorter than 1 ns have left t = 0 behind
        solver = begin()
    return solver, state


def _rates(start: State) -> str:
    return f'theta_dot = {start.theta_dot!r} rad/s, l3 = {start.l3!r}, lz = {start.lz!r} kg m^2/s'
