# SPDX-License-Identifier: Apache-2.0
"""
What the page shows: tops as functions of time, wherever they come from.

Times are integer nanoseconds since t = 0, which is the same instant for all tops of a page.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.shape import Shape
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.streams import parameters

Times = NDArray[np.int64]
Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """
    What stays the same while a top moves.

    l3, lz, energy : constants [kg m^2/s], and the energy lambda1 theta'^2/2 + V(theta) [J]
    description : None if it has no closed form
    pivot_moves : whether the pivot moves: then Lz and the energy are not constant
    """

    l3: float
    lz: float
    energy: float
    description: Description | None
    pivot_moves: bool = False

    @classmethod
    def of(cls, top: Top, state: State, description: Description | None, *,
           pivot_moves: bool = False) -> Self:
        """Return the motion that goes through a state."""
        height = effective_potential(top, state.l3, state.lz, np.array([state.theta]))
        energy = 0.5 * top.lambda1 * state.theta_dot ** 2 + float(height[0])
        return cls(state.l3, state.lz, energy, description, pivot_moves)

    @classmethod
    def of_piece(cls, piece: Piece) -> Self:
        """Return the motion of a piece of a run."""
        return cls.of(piece.top, piece.start, piece.describe(), pivot_moves=not piece.rests)


class Track(ABC):
    """
    One top on the page.

    name : shown if there are several
    values : checked parameters of the run
    has_body : whether they are those of the body; in the logs of other programs they are not
    about : where it comes from, in a sentence; '' if the title of the page says it
    epoch_ns : stamp of t = 0 [ns]
    """

    def __init__(self, name: str, values: Mapping[str, Any], *, has_body: bool = True,
                 about: str = '', epoch_ns: int = 0) -> None:
        self.name, self.values, self.has_body, self.about = name, values, has_body, about
        self.epoch_ns = epoch_ns
        self.top = parameters.top_of(values)
        self.shape = Shape(self.top)

    @abstractmethod
    def times(self, begin_ns: int, end_ns: int) -> Times:
        """Return the times (n,) of samples in a span, both ends included."""

    @abstractmethod
    def at(self, times: Times) -> States:
        """Return the states at some of these times."""

    def state(self, t_ns: int) -> States:
        """Return the state (n = 1) at one of these times."""
        return self.at(np.array([t_ns]))

    @abstractmethod
    def newest(self, t_ns: int) -> int | None:
        """Return the time of the newest sample up to a time, None if there is none."""

    @abstractmethod
    def motion_at(self, t_ns: int) -> Motion | None:
        """Return the motion at a time, None if it is not known."""

    def states(self, begin_ns: int, end_ns: int, most: int) -> tuple[Times, States]:
        """Return at most so many evenly chosen samples in a span, with the last one."""
        times = self.times(begin_ns, end_ns)
        stride = max(1, -(-len(times) // most))
        chosen = times[(len(times) - 1) % stride::stride]
        return chosen, self.at(chosen)


class Source(Protocol):
    """What a page shows, and the controls that it has put there."""

    def update(self, seconds: float) -> int:
        """Do what the controls ask for, let real time pass [s]; return the time to draw."""

    def tracks_at(self, t_ns: int) -> Sequence[Track]:
        """Return the tops that are there at a time."""


def effective_potential(top: Top, l3: float, lz: float, theta: Reals) -> Reals:
    """
    Return V(theta) [J] of lambda1 theta'^2/2 + V(theta) = E - L3^2/(2 lambda3); theta: (n,).

    It is (Lz - L3 cos theta)^2/(2 lambda1 sin^2 theta) + P cos(theta).
    """
    phi_dot = attitude.precession_rate(top, l3, lz, np.cos(0.5 * theta) ** 2,
                                       np.sin(0.5 * theta) ** 2)
    return (0.5 * top.lambda1 * (phi_dot * np.sin(theta)) ** 2
            + top.gravity_torque * np.cos(theta))
