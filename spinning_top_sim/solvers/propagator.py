# SPDX-License-Identifier: Apache-2.0
"""One protocol for every method that moves a state in time, and the choice among them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from spinning_top_sim.physics.kinematics import Columns, OneState, lazy
from spinning_top_sim.physics.top import ContinuedState, State, Top
from spinning_top_sim.solvers.rk45 import ENDLESS_NS, rk45

if TYPE_CHECKING:
    from spinning_top_sim.solvers.motion import ExactGrid

METHODS = ('rk45', 'exact')


class Propagator(Protocol):
    """
    A motion from its start at t = 0 on, one state at a time, at integer nanoseconds.

    One that takes steps goes forward only; a few of the steps behind it can still be read.
    """

    @property
    def steps(self) -> int:
        """Integration steps taken."""

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side."""

    @property
    def earliest_ns(self) -> int:
        """The first nanosecond that can still be read after the steps taken."""

    @property
    def latest_ns(self) -> int:
        """The last nanosecond that can be read without more of them."""

    def reach_ns(self, ns: int, max_steps: int | None = None) -> bool:
        """Compute what the state at `ns` nanoseconds needs; False if max_steps did not do."""

    def step_ahead(self, until_ns: int, now_ns: int, period_ns: int) -> bool:
        """
        Take one more step towards until_ns; return whether that was done.

        Not if it is reached, nor if the state at now_ns could not be read any more.  period_ns: of
        the samples that will be asked for
        """

    def at_ns(self, ns: int) -> OneState:
        """Return the state at `ns` nanoseconds."""

    @property
    def in_columns(self) -> bool:
        """Whether `columns_ns` is to be had."""

    def columns_ns(self, instants: range) -> Columns:
        """
        Return the states at ascending nanoseconds that are reached, as numpy columns.

        To the last bit those of `at_ns`.
        """


def propagate(top: Top, start: State, *, method: str, equations: str = 'transport',
              rtol: float = 1e-11, atol: float = 1e-12) -> Propagator:
    """
    Return the motion that begins at `start`; see `rk45` for the settings of its steps.

    Raises ValueError for a bad setting or a motion that doubles cannot hold, IntegrationError
    where the Euler form cannot start.
    """
    if method not in METHODS:
        raise ValueError(f'method = {method!r}: must be one of {", ".join(METHODS)}')
    if method == 'exact':
        return ExactPropagator(top, start)
    return rk45(top, start, equations=equations, rtol=rtol, atol=atol)


class ExactPropagator:
    """
    The closed form, state by state.

    A motion that begins anew behind a pole (`ContinuedState`) is solved from the same attitude
    with theta in [0, pi], and its angles are put back on the branch where they were.
    """

    steps = 0
    evaluations = 0
    earliest_ns = 0
    latest_ns = ENDLESS_NS
    in_columns = False

    def __init__(self, top: Top, start: State) -> None:
        # 1.5 ms of long decimals, and their import, for those who ask for it only.
        from spinning_top_sim.solvers.exact import ExactSolution  # noqa: PLC0415

        self.top = top
        turns = round(start.theta / math.tau)
        theta = start.theta - turns * math.tau
        self._mirrored = theta < 0.0
        half_turn = math.pi if self._mirrored else 0.0
        side = -1.0 if self._mirrored else 1.0
        self.solution = ExactSolution(top, State(
            theta=min(abs(theta), math.pi), theta_dot=side * start.theta_dot,
            phi=start.phi + half_turn, psi=start.psi - half_turn, l3=start.l3, lz=start.lz))
        self.branch = Branch(side, turns * math.tau, half_turn, 1.0 - 2.0 * (turns % 2))

    def reach_ns(self, ns: int, max_steps: int | None = None) -> bool:
        """Nothing needs computing."""
        return True

    def step_ahead(self, until_ns: int, now_ns: int, period_ns: int) -> bool:
        """There are no steps."""
        return False

    def columns_ns(self, instants: range) -> Columns:
        """Those of `grid` differ in their last bits."""
        raise NotImplementedError('these states are told one by one')

    def at_ns(self, ns: int) -> OneState:
        """Return the state at `ns` nanoseconds, before or after the start."""
        return ExactState(self, ns)

    def grid(self, start_ns: int, step_ns: int, count: int) -> ExactGrid:
        """Return the states at start_ns + k step_ns, k < count, as numpy columns."""
        from spinning_top_sim.solvers.motion import ExactGrid  # noqa: PLC0415

        return ExactGrid(self.solution, self.branch, start_ns, step_ns, count)


class Branch:
    """
    How continued angles follow from those of a motion begun with theta in [0, pi].

    theta = side theta' + offset, phi = phi' - half_turn, psi = psi' + half_turn, and the
    quaternion with its sign: all of them the same attitude.
    """

    def __init__(self, side: float, offset: float, half_turn: float, sign: float) -> None:
        self.side, self.offset, self.half_turn, self.sign = side, offset, half_turn, sign


class ExactState(OneState):
    """One state of the closed form; the attitude costs 1 to 2 us, the rest 4 more if asked for."""

    def __init__(self, propagator: ExactPropagator, ns: int) -> None:
        solution = propagator.solution
        self._solution, self._branch, self._ns = solution, propagator.branch, ns
        self.top = propagator.top
        self.l3 = self.l3_start = solution.start.l3
        self.lz = self.lz_start = solution.start.lz

    @lazy
    def quaternion(self) -> tuple[float, float, float, float]:
        """Attitude q(world <- body)."""
        quaternion = self._solution.quaternion_at(self._ns)
        if self._branch.sign < 0.0:
            x, y, z, w = quaternion
            return -x, -y, -z, -w
        return quaternion

    @lazy
    def alpha(self) -> complex:
        """cos(theta/2) exp(i (phi + psi)/2)."""
        _, _, z, w = self.quaternion
        return complex(w, z)

    @lazy
    def beta(self) -> complex:
        """sin(theta/2) exp(i (phi - psi)/2)."""
        x, y, _, _ = self.quaternion
        return complex(y, -x)

    @lazy
    def _all(self) -> tuple[float, ...]:
        return self._solution.full_state_at(self._ns)

    @lazy
    def theta(self) -> float:
        """Tilt, continued through the poles [rad]."""
        return self._branch.side * self._all[0] + self._branch.offset

    @lazy
    def theta_dot(self) -> float:
        """Nutation rate [rad/s]."""
        return self._branch.side * self._all[1]

    @lazy
    def phi(self) -> float:
        """Precession angle, unwrapped [rad]."""
        return self._all[2] - self._branch.half_turn

    @lazy
    def psi(self) -> float:
        """Spin angle, unwrapped [rad]."""
        return self._all[3] + self._branch.half_turn

    @lazy
    def transverse_rate(self) -> complex:
        """omega_1 + i omega_2 [rad/s]."""
        return complex(*self._all[8:10])


def anchored(state: OneState, l3: float, lz: float) -> ContinuedState:
    """Return the start of the motion that goes on from `state` with these momenta."""
    return ContinuedState(theta=state.theta, theta_dot=state.theta_dot, phi=state.phi,
                          psi=state.psi, l3=l3, lz=lz)
