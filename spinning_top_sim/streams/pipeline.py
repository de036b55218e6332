# SPDX-License-Identifier: Apache-2.0
"""
The simulation, the same live and offline.

Times are integer nanoseconds since the start.  Three of them move on, each with an owner:

    0 ------ now_ns ---------- reached_ns ---- ready_ns ------> t
      sent            computed               |   first sample that is neither

    now_ns      Simulation  samples up to here are sent; none after it (-1: not even t = 0)
    ready_ns    Schedule    samples before here are sent or computed (-1: dropped, as by a command)
    reached_ns  Segment     the solver has stepped up to here; it may be on either side of ready_ns
                Propagator  the same, since the start of its motion

A tick moves `now_ns` to the time that is due; `prepare` moves the other two ahead of it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States, relative_drift
from spinning_top_sim.physics.top import ContinuedState, State, Top, pole_momentum
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import MOST_TURNS
from spinning_top_sim.solvers.propagator import propagate
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.schedule import Instant, Schedule, check_stamp
from spinning_top_sim.streams.segment import SHORTEST_RUN_NS, Segment
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.streams.topics import ImuIncrements, ImuStream, all_streams

# Steps that the first nanosecond of a motion may take, and steps at a time offline, so that their
# interpolants stay in the cache.
FIRST_STEPS, OFFLINE_STEPS = 500, 2000
# Turns a second whose phases doubles hold for the shortest run.
MOST_RATE = MOST_TURNS / SHORTEST_RUN_NS * NANOSECONDS
# Takes the samples of an instant for a log: numbers of their streams in the log, stamp [ns],
# messages, and the size of these together [bytes].
Log = Callable[[Sequence[int], int, Sequence[bytes], int], object]
# Takes a block of samples of a stream: stamps (n,) [ns], and messages as rows of bytes (n, size),
# valid until it returns.
TakeRows = Callable[[Stream, NDArray[np.int64], NDArray[np.uint8]], object]


class PoleError(ValueError):
    """A command that is impossible with the axis at a pole, where Lz must be L3 or -L3."""


class Simulation:
    """
    One top in motion.

    values, top : checked parameters of the run, and the top that they describe
    streams : every stream; the caller sets `publish` of each, and records them with `log_to`
    now_ns : every sample up to here is sent (-1: not even that of t = 0)
    l3, lz : as last commanded [kg m^2/s]
    history : what was applied since the start: commands as (t_ns, l3, lz), and states that were
        set as t_ns and the fields of `State`
    segment : the motion since the last command

    Raises ValueError where there is no motion from the start state.
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        self._log: Log | None = None
        self._steps_before = self._evaluations_before = 0
        self.streams: list[Stream] = []
        self._load(values, epoch_ns)

    def restart(self, values: Mapping[str, Any]) -> None:
        """
        Go back to the start state of these parameters; sinks, counts and stamps remain.

        Raises ValueError where there is no motion from there; then the present one goes on.
        """
        counts = self.steps, self.evaluations
        self._load(values, self.epoch_ns)
        self._steps_before, self._evaluations_before = counts

    def _load(self, values: Mapping[str, Any], epoch_ns: int) -> None:
        # All that may be refused, before anything changes.
        for stamp_ns in (epoch_ns, epoch_ns + round(values['duration'] * NANOSECONDS)):
            check_stamp(stamp_ns, ValueError)
        top, start = parameters.top_of(values), parameters.start_state(values)
        segment = _segment(top, start, 0, values)
        streams = all_streams(values)
        self.values, self.top = dict(values), top
        self.history: list[tuple[int, *tuple[float, ...]]] = []
        self.now_ns = -1
        for new, old in zip(streams, self.streams, strict=False):
            new.publish, new.log_index = old.publish, old.log_index
            new.sent, new.skipped = old.sent, old.skipped
        self.streams = streams
        self._schedule = Schedule(streams, epoch_ns)
        self._begin(segment)

    def apply(self, changes: Mapping[str, Any]) -> None:
        """Take over new values of parameters that act on samples at once; see `Stream.at_once`."""
        for stream in self.streams:
            stream.apply(changes, self.now_ns)

    def _begin(self, segment: Segment) -> None:
        self.segment = segment
        self.l3, self.lz = segment.l3, segment.lz
        self._schedule.follow(segment)
        for stream in self.streams:
            stream.follow(segment)

    @property
    def open_interval(self) -> tuple[int, int] | None:
        """What the next mean or increment of the IMU begins with; None if that is its period."""
        return self._imu.open_interval(self.now_ns)

    @open_interval.setter
    def open_interval(self, times_ns: tuple[int, int]) -> None:
        self._imu.use_intervals(0).change = times_ns

    @property
    def _imu(self) -> Imu:
        return next(stream.imu for stream in self.streams if isinstance(stream, ImuStream))

    @property
    def epoch_ns(self) -> int:
        """Stamp of t = 0 [ns]."""
        return self._schedule.epoch_ns

    @epoch_ns.setter
    def epoch_ns(self, epoch_ns: int) -> None:
        self._schedule.epoch_ns = epoch_ns
        self._schedule.invalidate()

    @property
    def steps(self) -> int:
        """Integration steps taken so far."""
        return self._steps_before + self.segment.solver.steps

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self._evaluations_before + self.segment.solver.evaluations

    def state(self) -> States:
        """Return the state (n = 1) at `now_ns`, or at the start before the first sample."""
        return self.segment.states(self._now())

    def _now(self) -> range:
        now_ns = max(self.now_ns, self.segment.start_ns)
        return range(now_ns, now_ns + 1)

    @property
    def energy_drift(self) -> float:
        """The energy's relative drift since the segment began, absolute where it was 0."""
        return float(relative_drift(self.state().energy, self.segment.energy)[0])

    @property
    def orientation_error(self) -> float:
        """The angle between the present attitude and the exact one [rad]; NaN: not known."""
        return float(self.segment.orientation_error(self.state(), self._now())[0])

    def describe(self) -> Description | None:
        """Return the present motion in numbers; None where the closed form cannot hold it."""
        exact = self.segment.exact
        return None if exact is None else exact.describe()

    def log_to(self, write: Log | None, streams: Sequence[Stream] = ()) -> None:
        """
        Record these streams from now on, and no others.

        write : takes their samples from `advance`; None if `advance_in_blocks` sends them
        streams : their order here is their number in the log
        """
        self._log = write
        for stream in self.streams:
            stream.log_index = streams.index(stream) if stream in streams else None
            if stream.log_index is not None:
                stream.begin(self.now_ns)
        self._schedule.invalidate()

    def advance(self, target_ns: int, publish_from_ns: int = 0,
                give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every sample due up to `target_ns`; return whether that was reached.

        publish_from_ns : earlier samples are recorded, not published: they are too late
        give_way : asked between samples and between blocks of steps; True ends the call early.
            Nothing is lost: the next call goes on there.

        Raises IntegrationError if the equations cannot go on.
        """
        if self.now_ns < publish_from_ns:
            for stream in self.streams:
                if stream.publish is not None and stream.log_index is None:
                    stream.skip(self.now_ns, publish_from_ns)
        schedule, segment = self._schedule, self.segment
        ready = schedule.ready
        moved = False
        # Invariant: all samples up to `now_ns` are sent; the next one is due later, at `due_ns`.
        while ((due_ns := schedule.next_due(self.now_ns)) <= target_ns
               or segment.reached_ns < target_ns):
            if moved and give_way():
                return False
            moved = True
            if not ready:
                schedule.compute(self.now_ns, target_ns)
                due_ns = schedule.next_due(self.now_ns)     # later, if the first ones are lost
            if ready and due_ns <= target_ns:
                self._send(ready.popleft(), due_ns >= publish_from_ns)
            else:               # the steps do not reach a sample yet, or none is due
                self.now_ns = max(self.now_ns, min(segment.reached_ns, due_ns - 1, target_ns))
                segment.release(self.now_ns)
        self.now_ns = max(self.now_ns, target_ns)
        return True

    def send_ready(self, target_ns: int) -> bool:
        """
        Do what `advance` does if everything due is computed; return False, and do nothing, if not.

        The fast path of a tick touches little: after a rest little is in the processor's caches.
        """
        schedule = self._schedule
        if target_ns >= schedule.ready_ns or target_ns > self.segment.reached_ns:
            return False
        ready = schedule.ready
        while ready and ready[0][0] <= target_ns:
            self._send(ready.popleft())
        if target_ns > self.now_ns:     # noqa: PLR1730 - max() takes twice the time
            self.now_ns = target_ns
        return True

    @property
    def ready_ns(self) -> int:
        """Every sample before this time is sent or computed [ns]."""
        return self._schedule.ready_ns

    def prepare(self, until_ns: int, budget_ns: int | None = None) -> bool:
        """Compute ahead what is due up to `until_ns`; see `Schedule.prepare`."""
        return self._schedule.prepare(self.now_ns, until_ns, budget_ns)

    def readmit(self) -> None:
        """Let samples after `now_ns` be due again: the clock has changed, they are not late."""
        for stream in self.streams:
            stream.readmit(self.now_ns)

    def lowest_imu_rate(self, *, restarted: bool) -> float:
        """
        Return the lowest `imu.rate` [Hz] with which means and increments in use can go on.

        restarted : after `restart`, which may end the means
        """
        uses = (self._imu.takes_means and not restarted) or any(
            isinstance(stream, ImuIncrements) and stream.has_sinks for stream in self.streams)
        return parameters.LOWEST_RATE_OF_INTERVALS if uses else 0.0

    def _send(self, instant: Instant, publishes: bool = True) -> None:
        """Hand out the samples of an instant; count those that are too late to be published."""
        t_ns, delivery, messages = instant
        if self._log is not None and delivery.log_indices:
            logged = delivery.logged
            self._log(delivery.log_indices, self.epoch_ns + t_ns,
                      messages if logged is None else [messages[k] for k in logged],
                      delivery.size)
        # After all is recorded: where it fails, as the node ends, the log has the instant whole.
        # One right after the other: each finds the middleware still awake from the one before.
        self.now_ns = t_ns
        for publish, k, stream in delivery.published:
            if publishes:
                publish(messages[k])
                stream.sent += 1
            else:
                stream.skipped += 1

    def advance_in_blocks(self, target_ns: int, send: TakeRows,
                          give_way: Callable[[], bool] = lambda: False) -> None:
        """
        Send every sample of the recorded streams up to `target_ns`, a block of a stream at a time.

        The same bytes as `advance` sends, in another order; for offline use.  True of `give_way`
        ends the call early.  Raises IntegrationError after the last sample that is reached.
        """
        segment = self.segment
        self._schedule.invalidate()
        check_stamp(self.epoch_ns + target_ns)
        while self.now_ns < target_ns and not give_way():
            try:
                segment.reach(target_ns, OFFLINE_STEPS)
            except IntegrationError:
                if segment.reached_ns <= self.now_ns:   # else what is due before is sent first
                    raise
            until_ns = min(target_ns, segment.reached_ns)
            states = cache(segment.states)
            for stream in self.streams:
                times = stream.times(self.now_ns, until_ns)
                if stream.log_index is not None and times:
                    rows = stream.encode(states(times), self.epoch_ns, times)
                    if len(rows):
                        send(stream, self.epoch_ns + stream.sent_ns(times), rows)
            self.now_ns = max(self.now_ns, until_ns)
            segment.release(self.now_ns)

    def skip_to(self, t_ns: int) -> None:
        """Take every sample up to this time as sent, and none later; only for offline use."""
        self.now_ns = t_ns

    def command(self, l3: float, lz: float) -> None:
        """
        Let L3 and Lz jump now [kg m^2/s]: an impulsive torque.  Angles and theta' stay.

        Raises ValueError naming what is off, at a pole PoleError; the motion goes on unchanged.
        """
        for name, value in (('l3', l3), ('lz', lz)):
            if not math.isfinite(value):
                raise ValueError(f'{name} = {value!r} kg m^2/s: must be finite')
        self.advance(max(self.now_ns, 0))
        now = self.state()
        theta = float(now.theta[0])
        pole = pole_momentum(abs(theta), l3)
        if pole is not None and lz != pole:
            raise PoleError(
                f'lz = {lz!r} kg m^2/s with l3 = {l3!r}: the axis is at a pole (theta = '
                f'{theta!r} rad), where lz must equal {pole!r}; command both together')
        start = ContinuedState(theta=theta, theta_dot=float(now.theta_dot[0]),
                               phi=float(now.phi[0]), psi=float(now.psi[0]), l3=l3, lz=lz)
        self._go_on_from(start)
        self.history.append((self.now_ns, l3, lz))

    def set_state(self, state: State) -> None:
        """
        Let the top be in another state from now on; the simulated time goes on.

        Raises ValueError if no motion begins there; then the present one goes on unchanged.
        """
        self.advance(max(self.now_ns, 0))
        self._go_on_from(state)
        self.history.append((self.now_ns, *astuple(state)))

    def _go_on_from(self, start: State) -> None:
        segment = _segment(self.top, start, self.now_ns, self.values)
        self._steps_before, self._evaluations_before = self.steps, self.evaluations
        self._begin(segment)


def _segment(top: Top, start: State, start_ns: int, values: Mapping[str, Any]) -> Segment:
    """Return the motion from a start.  Raises ValueError if its first nanosecond shows none."""
    try:
        solver = propagate(top, start, method=values['solver.method'],
                           equations=values['solver.equations'], rtol=values['solver.rtol'],
                           atol=values['solver.atol'])
        with np.errstate(over='ignore', invalid='ignore'):
            segment = Segment(solver, start, start_ns)
        if not math.isfinite(segment.energy):
            raise ValueError(f'the energy would be {segment.energy!r} J')
        if not segment.reach(start_ns + 1, FIRST_STEPS):
            raise ValueError(f'it turns too fast: over {FIRST_STEPS} steps a nanosecond')
        spin = abs(start.l3) / top.lambda3 / math.tau
        if spin > MOST_RATE:
            raise ValueError(f'it turns too fast: {spin:.3g} times a second, must be at most '
                             f'{MOST_RATE:.2g}')
        if solver.ns_limit < SHORTEST_RUN_NS:
            raise ValueError(f'it turns too fast: its phases are known for '
                             f'{solver.ns_limit / NANOSECONDS:.3g} s, must be for '
                             f'{SHORTEST_RUN_NS / NANOSECONDS:g} s')
    except (ArithmeticError, RuntimeError, ValueError) as error:
        raise ValueError(f'no motion from theta = {start.theta!r} rad, theta_dot = '
                         f'{start.theta_dot!r} rad/s with l3 = {start.l3!r}, lz = {start.lz!r} '
                         f'kg m^2/s, for {top}: {error}') from error
    return segment
