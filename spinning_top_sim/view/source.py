# SPDX-License-Identifier: Apache-2.0
"""
What the page shows: a top as a function of time, wherever it comes from.

Times are integer nanoseconds since t = 0.
"""

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import Description, natural_momentum
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.shape import Shape
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams import parameters
from spinning_top_sim.times import NANOSECONDS, Times

Reals = NDArray[np.float64]
WINDOW_NS = 10 * NANOSECONDS    # of traces and plots; twice this is kept
POINTS, FEWEST, PER_TURN = 2000, 500, 20    # in a span: most and least; in the fastest turn
NUTATIONS = 4               # that a span has room for, however fast phi turns near a pole
SNAP = 1e-9                 # relative distance within which a constant is taken for a special one
SAME = 1e-6                 # relative difference between the constants of one motion


@dataclass(frozen=True)
class Motion:
    """
    What stays the same while a top moves.

    l3, lz, energy : constants [kg m^2/s], and the energy lambda1 theta'^2/2 + V(theta) [J]
    description : None if it has no closed form
    pivot_moves : whether the pivot moves: then L3 alone is constant
    """

    l3: float
    lz: float
    energy: float
    description: Description | None
    pivot_moves: bool

    @classmethod
    def through(cls, sample: States, *, pivot_moves: bool) -> Self:
        """Return the motion through a sample; one that is special but for rounding is special."""
        top = sample.top
        state = state_of(top, sample.quaternion[0], np.ravel(np.broadcast_arrays(
            *attitude.rotated(sample.rows_quaternion, sample.rows_angular_velocity))))
        dust = SNAP * max(abs(state.l3), abs(state.lz), natural_momentum(top))
        l3, lz = (0.0 if abs(value) < dust else value for value in (state.l3, state.lz))
        lz = next((pole for pole in (l3, -l3) if abs(lz - pole) < dust), lz)
        theta_dot = state.theta_dot if top.lambda1 * abs(state.theta_dot) > dust else 0.0
        description = None
        with contextlib.suppress(ArithmeticError, ValueError):
            if not pivot_moves:
                description = ExactSolution(top, State(
                    theta=state.theta, theta_dot=theta_dot, l3=l3, lz=lz)).describe()
        height = effective_potential(top, state.l3, state.lz, np.array([state.theta]))
        return cls(state.l3, state.lz, 0.5 * top.lambda1 * state.theta_dot ** 2
                   + float(height[0]), description, pivot_moves)


class Track(ABC):
    """
    One top on the page.

    values : checked parameters of the run
    about : where it comes from, in a sentence; '' if the title of the page says it
    epoch_ns : stamp of t = 0 [ns]
    least_step_ns : time between two samples, where they are given
    """

    least_step_ns = 1

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        self.values, self.about, self.epoch_ns = values, '', epoch_ns
        self.top = parameters.top_of(values)
        self.shape = Shape(self.top)
        self._known: tuple[tuple[float, ...], Motion] | None = None     # the newest motion

    @abstractmethod
    def times(self, begin_ns: int, end_ns: int, step_ns: int) -> Times:
        """Return times (n,) of samples in a span, a step apart if there are, with the last."""

    @abstractmethod
    def at(self, times: Times) -> States:
        """Return the states at some of these times."""

    @abstractmethod
    def newest(self, t_ns: int) -> int | None:
        """Return the time of the newest sample up to a time, None if there is none."""

    @abstractmethod
    def pivot_moves(self, t_ns: int) -> bool:
        """Return whether the pivot moves at the time of a sample."""

    def state(self, t_ns: int) -> States:
        """Return the state (n = 1) at the time of a sample."""
        return self.at(np.array([t_ns]))

    def states(self, t_ns: int, begin_ns: int, end_ns: int) -> States:
        """Return samples of a span; of a motion too fast for POINTS, in a part around a time."""
        longest_ns, top = max(1, (end_ns - begin_ns) // FEWEST), self.top
        states = self.at(self.times(begin_ns, end_ns, 10 * longest_ns))
        # At most so fast are a nutation, and the axis with its energy.
        w1, w2, _ = states.rows_angular_velocity
        rates = np.abs(states.l3) / top.lambda1 + np.sqrt(
            w1 * w1 + w2 * w2 + 2.0 / top.lambda1 * np.maximum(
                top.gravity_torque * states.rows_axis[2] + abs(top.gravity_torque), 0.0))
        rate = float(np.max(rates, where=np.isfinite(rates), initial=1e-9))
        motion = self.motion_at(end_ns)
        found = motion.description if motion else None
        if found and found.nutation_period:
            most = math.tau / found.nutation_period * POINTS / (PER_TURN * NUTATIONS)
            rate = max(rate, min(most, max(found.precession_max, -found.precession_min)))
        step_ns = max(self.least_step_ns, min(
            longest_ns, int(math.tau / (PER_TURN * rate) * NANOSECONDS)))
        end_ns = min(end_ns, max(t_ns, begin_ns + POINTS * step_ns))
        return self.at(self.times(max(begin_ns, end_ns - POINTS * step_ns), end_ns, step_ns))

    def motion_at(self, t_ns: int) -> Motion | None:
        """Return the motion at a time, by the newest sample; None if its rates are not known."""
        newest_ns = self.newest(t_ns)
        sample = None if newest_ns is None else self.state(newest_ns)
        if newest_ns is None or sample is None or not np.isfinite(sample.energy[0]):
            return None
        moves, natural = self.pivot_moves(newest_ns), natural_momentum(self.top)
        constants = tuple(0.0 if moves and name != 'l3' else float(getattr(sample, name)[0])
                          for name in ('energy', 'l3', 'lz'))
        if self._known is None or moves != self._known[1].pivot_moves or any(
                abs(a - b) > SAME * max(abs(a), abs(b), least) for a, b, least in zip(
                    constants, self._known[0], (abs(self.top.gravity_torque), natural, natural),
                    strict=True)):
            self._known = constants, Motion.through(sample, pivot_moves=moves)
        return self._known[1]


class Source(Protocol):
    """What a page shows, and the controls that it has put there."""

    @property
    def track(self) -> Track | None:
        """The top, None if there is none yet."""

    def update(self, seconds: float) -> int:
        """Do what the controls ask for, let real time pass [s]; return the time to draw."""


def effective_potential(top: Top, l3: float, lz: float, theta: Reals) -> Reals:
    """
    Return V(theta) [J] of lambda1 theta'^2/2 + V(theta) = E - L3^2/(2 lambda3); theta: (n,).

    It is (Lz - L3 cos theta)^2/(2 lambda1 sin^2 theta) + P cos(theta).
    """
    phi_dot = attitude.precession_rate(top, l3, lz, np.cos(0.5 * theta) ** 2,
                                       np.sin(0.5 * theta) ** 2)
    return (0.5 * top.lambda1 * (phi_dot * np.sin(theta)) ** 2
            + top.gravity_torque * np.cos(theta))
