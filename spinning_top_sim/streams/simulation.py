# SPDX-License-Identifier: Apache-2.0
"""A run: the parameters, the motion with its commands, and the samples of its streams."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from spinning_top_sim.physics.pivot import NEVER_NS, REST, PivotPath
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States, relative_drift
from spinning_top_sim.physics.top import ContinuedState, State, Top, pole_momentum
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.solvers.vertical import Posture
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.blocks import Block, blocks, span_of
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.streams.imu import LONGEST_NS, Imu
from spinning_top_sim.streams.path import Path, Segment
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.streams.topics import all_streams

# Limits of a block offline.
OFFLINE_STEPS = 2000            # their interpolants stay in the cache
OFFLINE_BYTES = 4 << 20
LONGEST_OFFLINE_NS = 100 * NANOSECONDS      # for the sake of progress
MOST_BLOCKS = 20_000            # of a run; then they are longer


class Drive(NamedTuple):
    """A velocity of the pivot in the world [m/s], applied at a time, and when it brakes [ns]."""

    t_ns: int
    x: float
    y: float
    z: float
    stop_ns: int


class Simulation:
    """
    One top in motion.  Times are integer nanoseconds since the start.

    values : checked parameters of the run, as it started
    top : the top that they describe
    streams : every stream, whether it is switched on or not
    path : the motion
    now_ns : every sample up to here is sent, or yielded (-1: not even that of t = 0); may be set
    history : what was applied since the start: time [ns], then L3 and Lz of a command, the fields
        of a `State`, the rate of the IMU [Hz], or those of a `Drive`.  Logs have it as lists of
        numbers, told apart by their lengths alone
    pivot_path : of the pivot; None while it rests at the origin
    lz : as last commanded, about the vertical of the world [kg m^2/s]
    epoch_ns : stamp of t = 0 [ns]
    version : counts changes that make samples after `now_ns` other than they would have been; a
        change of `epoch_ns` is not counted

    Raises ValueError where there is no motion from the start state.
    """

    _driven_path: Callable[..., PivotPath]      # of the newest `Drive`, from its `stop_ns`

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        self.version = 0
        self.epoch_ns = epoch_ns
        self._load(values)

    def restart(self, values: Mapping[str, Any]) -> None:
        """
        Go back to the start state of these parameters; counts of steps and stamps go on.

        Raises ValueError where there is no motion from there; then the present one goes on.
        """
        before = self.path
        self._load(values)
        self.path.gone_steps, self.path.gone_evaluations = before.steps, before.evaluations

    def _load(self, values: Mapping[str, Any]) -> None:
        # Whatever may be refused comes first, before anything changes.
        for stamp_ns in (self.epoch_ns, self.epoch_ns + round(values['duration'] * NANOSECONDS)):
            if not 0 <= stamp_ns <= LAST_STAMP_NS:
                raise ValueError(f'the stamp {stamp_ns / NANOSECONDS:.12g} s: must be >= 0 and '
                                 f'< {2 ** 31} s, in January 2038')
        top, start = parameters.top_of(values), parameters.start_state(values)
        pivot = parameters.pivot_path(values)
        segment = _segment(top, start, 0, values, pivot)
        self.imu = Imu(values)
        self.values, self.top = dict(values), top
        self.streams = all_streams(values, self.imu)
        self.history: list[tuple[int, *tuple[float, ...]]] = []
        self.now_ns = -1
        # The trace of the markers, intervals of the IMU and late fixes reach back across commands.
        trace_ns = round(values['markers.trace_length'] * NANOSECONDS)
        self.pivot_path, self.lz = pivot, start.lz
        self.path = Path(segment, self._follow, self.imu.carry,
                         keep_ns=max(trace_ns, LONGEST_NS), keep_steps_ns=self.imu.keep_ns)
        self.version += 1

    @property
    def segment(self) -> Segment:
        """The motion since the last command, or since the pivot last changed its acceleration."""
        return self.path.after(self.now_ns)

    @property
    def l3(self) -> float:
        """L3 as last commanded [kg m^2/s]."""
        return self.segment.l3

    @property
    def steps(self) -> int:
        return self.path.steps

    @property
    def evaluations(self) -> int:
        return self.path.evaluations

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
        """
        The angle between the present attitude and the exact one [rad]; NaN: not known.

        The exact one starts where the segment does.
        """
        return float(self.segment.orientation_error(self.state(), self._now())[0])

    def describe(self) -> Description | None:
        """Return the motion in numbers; None if it has no closed form or the pivot moves."""
        solution = self.segment.closed_form
        if self.segment.ride or not isinstance(solution, ExactSolution):
            return None
        return solution.describe()

    def play(self, streams: Sequence[Stream], until_ns: int) -> Iterator[Block]:
        """
        Move on to `until_ns`; yield the messages of these streams on the way, block by block.

        `now_ns` is the end of the block that is yielded.  Raises IntegrationError behind the last
        block if the motion does not go on.
        """
        span_ns = max(span_of(streams, OFFLINE_BYTES, LONGEST_OFFLINE_NS),
                      (until_ns - self.now_ns) // MOST_BLOCKS)
        for block in blocks(self.path, streams, self.epoch_ns, self.now_ns, until_ns,
                            span_ns=span_ns, most_steps=OFFLINE_STEPS):
            if block is not None:
                self.now_ns = block.until_ns
                yield block
                self.path.release(self.now_ns)

    def apply(self, changes: Mapping[str, Any]) -> None:
        """Take over new rates of streams after `now_ns`."""
        imu, rate = self.imu, changes.get('imu.rate')
        if rate is not None and imu.set_rate(rate, max(self.now_ns, 0)):
            self.path.keep_steps_ns = imu.keep_ns
            self.history.append((max(self.now_ns, 0), rate))
        for stream in self.streams:
            stream.apply(changes)
        self.version += 1

    def command(self, l3: float, lz: float) -> None:
        """
        Let L3 and Lz jump now [kg m^2/s]: an impulsive torque.  Angles and theta' stay.

        Raises ValueError naming what is off; the motion goes on unchanged.
        """
        for name, value in (('l3', l3), ('lz', lz)):
            if not math.isfinite(value):
                raise ValueError(f'{name} = {value!r} kg m^2/s: must be finite')
        self._settle()
        now = self.state()
        theta = float(now.theta[0])
        pole = pole_momentum(abs(theta), l3)
        if pole is not None and lz != pole:
            raise ValueError(
                f'lz = {lz!r} kg m^2/s with l3 = {l3!r}: the axis is at a pole (theta = '
                f'{theta!r} rad), where lz must equal {pole!r}; command both together')
        self._continue(ContinuedState(
            theta=theta, theta_dot=float(now.theta_dot[0]), phi=float(now.phi[0]),
            psi=float(now.psi[0]), l3=l3, lz=lz))
        self.history.append((self.now_ns, l3, lz))

    def set_state(self, state: State) -> None:
        """
        Let the top be in another state from now on; the simulated time goes on.

        Raises ValueError if no motion begins there; then the present one goes on unchanged.
        """
        self._settle()
        self._continue(state)
        self.history.append((self.now_ns, *astuple(state)))

    def drive(self, velocity: Sequence[float], stop_ns: int | None = None) -> int | None:
        """
        Let the pivot go to a velocity in the world [m/s] from now on.

        It accelerates by `pivot.max_acceleration`, and brakes to rest at a time.  To repeat a
        command before that only puts this off.

        stop_ns : when it begins to brake [ns]; None: after `pivot.cmd_timeout`
        Returns that time; None if the pivot rests and is to rest.

        Raises ValueError naming what is off; the motion goes on unchanged.
        """
        target = checked_velocity(velocity)
        self._settle()
        if self.pivot_path is None and not any(target):
            return None
        if stop_ns is None:
            timeout_ns = round(self.values['pivot.cmd_timeout'] * NANOSECONDS)
            stop_ns = self.now_ns + timeout_ns if timeout_ns else NEVER_NS
        last = self.history[-1] if self.history else None
        if isinstance(last, Drive) and last[1:4] == target and self.now_ns < last.stop_ns:
            # The motion up to now is the same.
            self.pivot_path, segment = self._driven_path(stop_ns=stop_ns), self.segment
            segment.solution = segment.solution.with_ride(
                self.pivot_path.lasting(segment.start_ns))
            if self.path.end_after(self.now_ns):
                self.version += 1
            self.history[-1] = last._replace(stop_ns=stop_ns)
            return stop_ns
        pivot = self.segment.pivot(np.array([self.now_ns]))
        self._driven_path = partial(
            PivotPath.to_velocity, target, position=pivot.position[:, 0].tolist(),
            velocity=pivot.velocity[:, 0].tolist(), start_ns=self.now_ns,
            most_acceleration=self.values['pivot.max_acceleration'])
        self._continue(self.segment.posture(self.now_ns), self._driven_path(stop_ns=stop_ns))
        self.history.append(Drive(self.now_ns, *target, stop_ns))
        return stop_ns

    def _settle(self) -> None:
        """Let the solver reach `now_ns`, and be at t = 0 at least."""
        self.now_ns = max(self.now_ns, 0)
        self.segment.reach(self.now_ns)

    def _continue(self, start: State | Posture, pivot: PivotPath | None = None) -> None:
        """Go on from another state, or from the present posture on another path of the pivot."""
        pivot = pivot or self.pivot_path
        segment = _segment(self.top, start, self.now_ns, self.values, pivot)
        self.pivot_path = pivot
        if isinstance(start, State):
            self.lz = start.lz
        self.path.go_on_with(segment)
        self.version += 1

    def _follow(self, last: Segment) -> Segment:
        """Return the segment behind the end of one: the pivot changes its acceleration."""
        last.reach(last.end_ns)
        return _segment(self.top, last.posture(last.end_ns), last.end_ns, self.values,
                        self.pivot_path)


def checked_velocity(velocity: Sequence[float]) -> tuple[float, float, float]:
    """Return a velocity of the pivot [m/s].  Raises ValueError."""
    x, y, z = target = tuple(map(float, velocity))
    if not all(abs(part) <= parameters.FASTEST for part in target):
        raise ValueError(f'linear = {list(target)!r} m/s: each must be finite and within '
                         f'{parameters.FASTEST:g} m/s')
    return x, y, z


def _segment(top: Top, start: State | Posture, start_ns: int, values: Mapping[str, Any],
             pivot: PivotPath | None) -> Segment:
    """Return the motion from a start.  Raises ValueError if there is none."""
    settings = {name: values[f'solver.{name}'] for name in ('method', 'equations', 'rtol', 'atol')}
    ride = REST if pivot is None else pivot.lasting(start_ns)
    return Segment(Piece(top, start, start_ns, ride, **settings), jumps=isinstance(start, State))
