# SPDX-License-Identifier: Apache-2.0
"""What every solver has."""

from abc import ABC, abstractmethod

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.vertical import Posture, Vertical
from spinning_top_sim.times import Times


class Motion(ABC):
    """
    The motion of `top` that is in the state `start` at t = 0.

    is_exact : whether it is the closed form
    steps, evaluations : integration steps so far, and evaluations of the right-hand side
    """

    is_exact = False
    steps = evaluations = 0

    def __init__(self, top: Top, start: State) -> None:
        self.top, self.start = top, start

    @abstractmethod
    def states(self, t: Column | Times, per_second: int = 1) -> States:
        """Return the states at ascending times (n,) in s, or in s/per_second."""

    def forget(self, before_ns: int) -> None:  # noqa: B027 - not all remember
        """Forget what only states before this time [ns] need."""

    def describe(self) -> Description | None:
        """Return the motion in numbers, None if they are not known."""
        return None

    def precise_posture(self, t_ns: int, vertical: Vertical | None) -> Posture | None:
        """
        Return the posture in the world in multiprecision, None if that is not known.

        vertical : that of the motion, None if it is the world's
        """
        return None
