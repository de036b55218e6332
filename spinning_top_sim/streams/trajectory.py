# SPDX-License-Identifier: Apache-2.0
"""The motion of a run as a function of time: solutions, joined by events and by the pivot."""

import contextlib
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from copy import copy
from functools import partial, reduce
from itertools import pairwise
from operator import attrgetter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.physics import integrals
from spinning_top_sim.physics.attitude import Quaternion
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.pivot import REST, Kinematics, PivotPath, kinematics
from spinning_top_sim.physics.states import Point, States, joined
from spinning_top_sim.physics.top import ContinuedState, State, Top, pole_momentum
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.solvers.vertical import Posture
from spinning_top_sim.streams.events import Event
from spinning_top_sim.times import Times

Matrix = NDArray[np.float64]


class Trajectory:
    """
    The motion of a top from t = 0 on.  Times are integer nanoseconds, and ascend.

    A sample at the instant of an event belongs to the motion before it.

    top : in the gravity of the world
    pivot : path of the pivot; None while it rests at the origin
    settings : of the solver, keywords of `Piece`

    Raises ValueError where no motion begins.
    """

    def __init__(self, top: Top, start: State, pivot: PivotPath | None,
                 settings: Mapping[str, Any], *, most_acceleration: float) -> None:
        self.top, self.pivot = top, pivot
        self._settings, self._most_acceleration = settings, most_acceleration
        self._drive: Event | None = None            # the newest
        self._path_until: Callable[..., PivotPath]  # of it, by its `stop_ns`
        self._jumps: tuple[int, ...] = ()           # when the angular velocity jumps
        self._forgotten = 0, 0                      # steps and evaluations of pieces that are gone
        self._pieces = [self._begin(start, 0)]

    def _begin(self, start: State | Posture, start_ns: int) -> Piece:
        ride = self.pivot.lasting(start_ns) if self.pivot else REST
        return Piece(self.top, start, start_ns, ride, **self._settings)

    @property
    def steps(self) -> int:
        """Integration steps taken so far."""
        return self._forgotten[0] + sum(piece.motion.steps for piece in self._pieces)

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self._forgotten[1] + sum(piece.motion.evaluations for piece in self._pieces)

    def evaluate(self, t_ns: Times) -> States:
        """
        Return the states at times (n,), in the world.

        Raises IntegrationError, which says how far the motion goes, if that is not the last time.
        """
        return joined([piece.states(times) for piece, times in self.pieces(t_ns)])

    def pieces(self, t_ns: Times) -> list[tuple[Piece, Times]]:
        """
        Return the pieces in which times lie, with the times in each; one piece without any.

        Raises LookupError for times in a piece that is forgotten.
        """
        if not len(t_ns):
            return [(self._pieces[-1], t_ns)]
        first_ns, last_ns = int(t_ns[0]), int(t_ns[-1])
        if first_ns < self._pieces[0].start_ns:
            raise LookupError(f't = {first_ns} ns: the motion before '
                              f'{self._pieces[0].start_ns} ns is forgotten')
        self._go_on(last_ns)
        near = self._pieces[self._number(first_ns):self._number(last_ns) + 1]
        if len(near) == 1:
            return [(near[0], t_ns)]
        ends = np.searchsorted(t_ns, [piece.start_ns for piece in near[1:]], 'right')
        return [(piece, times) for piece, times in zip(
            near, np.split(t_ns, ends), strict=True) if len(times)]

    def _number(self, t_ns: int) -> int:
        """Return which piece a time lies in: each ends with the event that begins the next one."""
        return max(bisect_left(self._pieces, t_ns, key=attrgetter('start_ns')) - 1, 0)

    def _go_on(self, t_ns: int) -> None:
        """Let pieces follow as far as a time, which lies in the last one."""
        while (end_ns := self._pieces[-1].ride.end_ns) < t_ns:
            try:
                self._pieces.append(self._begin(self._pieces[-1].posture(end_ns), end_ns))
            except ValueError as error:
                raise IntegrationError(str(error), reached_ns=end_ns) from error

    def after(self, t_ns: int) -> Piece:
        """Return the piece in which the motion goes on after a time; the last if it does not."""
        with contextlib.suppress(IntegrationError):
            self._go_on(t_ns + 1)
        return self._pieces[self._number(t_ns + 1)]

    def momenta(self, t_ns: int) -> tuple[float, float]:
        """Return L3, and Lz about the vertical of the world, after a time [kg m^2/s]."""
        piece = self.after(t_ns)
        now = (piece.motion.start if piece.rests
               else piece.posture(t_ns).in_doubles().state(self.top))
        return now.l3, now.lz

    def starts(self, begin_ns: int, end_ns: int) -> list[int]:
        """Return the times in [begin, end) at which another piece begins."""
        return [piece.start_ns for piece in self._pieces[max(self._number(begin_ns), 1):]
                if begin_ns <= piece.start_ns < end_ns]

    def increments(self, begin_ns: int, end_ns: int, point: Point) -> Increments:
        """
        Return the increments over an interval that events may divide (n = 1).

        A velocity that jumps with a command counts toward the interval that begins there.
        """
        parts = []
        for begin, end in pairwise(sorted({begin_ns, *self.starts(begin_ns, end_ns), end_ns})):
            jump, piece, moment = np.zeros((3, 1)), self.after(begin), np.array([begin])
            if begin in self._jumps:
                jump = (np.stack(piece.states(moment).velocity(point))
                        - np.stack(self.evaluate(moment).velocity(point)))
            parts += [integrals.impulse((jump[0], jump[1], jump[2])),
                      increments_within(piece, range(begin, begin + 1), end - begin, point)]
        return reduce(Increments.then, parts or [integrals.impulse(3 * (np.zeros(1),))])

    def _joined(self, of: Callable[[Piece, Times], ArrayLike], t_ns: Times) -> Matrix:
        """Return what a function of pieces and times (n,) in them returns, (..., n)."""
        return np.concatenate([of(piece, times) for piece, times in self.pieces(t_ns)], axis=-1)

    def constants(self, name: str, t_ns: Times) -> Matrix:
        """Return `energy`, `l3` or `lz` as it is at the start of the piece of each time, (n,)."""
        return self._joined(lambda piece, times: np.full(len(times), getattr(piece, name)), t_ns)

    def pivot_at(self, t_ns: Times) -> Kinematics:
        """Return what the pivot does at times (n,), without its motion being solved."""
        return Kinematics(*self._joined(lambda piece, times: kinematics(piece.ride, times), t_ns))

    def exact_attitude(self, t_ns: Times) -> Quaternion:
        """Return q(world <- body) of the exact solution at times (n,); NaN: it is not known."""
        def of(piece: Piece, times: Times) -> ArrayLike:
            exact = piece.exact
            return exact.states(times).rows_quaternion if exact else np.full(
                (4, len(times)), np.nan)

        x, y, z, w = self._joined(of, t_ns)
        return x, y, z, w

    def then(self, event: Event) -> Self:
        """Return the trajectory that follows an event from its time on.  Raises ValueError."""
        changed, now, t_ns = copy(self), self.after(event.t_ns), event.t_ns
        changed._pieces = self._pieces[:self._pieces.index(now) + 1]
        if event.kind == 'drive':
            changed._follow(event, now)
        else:
            start = (State(**event.details) if event.kind == 'state'
                     else commanded(now.states(np.array([t_ns])), **event.details))
            changed._pieces.append(self._begin(start, t_ns))
            changed._jumps = *self._jumps, t_ns
        return changed

    def _follow(self, drive: Event, now: Piece) -> None:
        t_ns, details = drive.t_ns, drive.details
        repeats = self._drive is not None and drive.repeats(self._drive)
        if not repeats:
            at = self.pivot_at(np.array([t_ns]))
            self._path_until = partial(
                PivotPath.to_velocity, [details[axis] for axis in 'xyz'],
                position=at.position[:, 0].tolist(), velocity=at.velocity[:, 0].tolist(),
                start_ns=t_ns, most_acceleration=self._most_acceleration)
        self._drive, self.pivot = drive, self._path_until(stop_ns=details['stop_ns'])
        if repeats:         # the motion up to now is the same
            self._pieces[-1] = now.with_ride(self.pivot.lasting(now.start_ns))
        else:
            self._pieces.append(self._begin(now.posture(t_ns), t_ns))

    def forget(self, before_ns: int, steps_before_ns: int) -> None:
        """Forget the pieces before a time, and integration steps before another one."""
        count = self._number(before_ns)
        gone, self._pieces = self._pieces[:count], self._pieces[count:]
        self._jumps = tuple(t_ns for t_ns in self._jumps if t_ns >= self._pieces[0].start_ns)
        self._forgotten = (self._forgotten[0] + sum(piece.motion.steps for piece in gone),
                           self._forgotten[1] + sum(piece.motion.evaluations for piece in gone))
        for piece in self._pieces:
            piece.forget(steps_before_ns)


def commanded(now: States, l3: float, lz: float) -> ContinuedState:
    """Return the state after `now` (n = 1), with L3 and Lz [kg m^2/s].  Raises ValueError."""
    for name, value in (('l3', l3), ('lz', lz)):
        if not math.isfinite(value):
            raise ValueError(f'{name} = {value!r} kg m^2/s: must be finite')
    theta = float(now.theta[0])
    pole = pole_momentum(abs(theta), l3)
    if pole is not None and lz != pole:
        raise ValueError(
            f'lz = {lz!r} kg m^2/s with l3 = {l3!r}: the axis is at a pole (theta = {theta!r} '
            f'rad), where lz must equal {pole!r}; command both together')
    return ContinuedState(theta=theta, theta_dot=float(now.theta_dot[0]), phi=float(now.phi[0]),
                          psi=float(now.psi[0]), l3=l3, lz=lz)


def increments_within(piece: Piece, begins: range, length_ns: int, point: Point) -> Increments:
    """Return the increments over intervals within a piece, which begin at these times [ns]."""
    count = integrals.panels(piece.fastest_rate, length_ns)
    edges = [length_ns * k // count for k in range(count + 1)]
    return reduce(Increments.then, [integrals.increments(
        piece.states, range(begins.start + begin, begins.stop + begin, begins.step), end - begin,
        point, piece.fastest_rate) for begin, end in pairwise(edges)])
