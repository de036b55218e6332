# SPDX-License-Identifier: Apache-2.0
"""A motion sampled at many times: numpy columns, computed when they are asked for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import Columns, lazy
from spinning_top_sim.physics.pairs import Pairs
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.rk45 import SteppedOrClosed, TransportMotion

if TYPE_CHECKING:
    from spinning_top_sim.solvers.propagator import Branch

Column = NDArray[Any]


class Motion(Columns):
    """
    States of a top at the times t (n,) [s].

    theta, theta_dot, phi, psi  (n,) [rad], [rad/s]: ZYZ angles, unwrapped, continued through the
    poles;  phi_dot, psi_dot  (n,) [rad/s];  theta_folded  (n,) in [0, pi];
    quaternion  (n, 4): x, y, z, w of q(world <- body), sign continuous in time;
    angular_velocity, angular_acceleration  (n, 3): body frame [rad/s], [rad/s^2];
    energy [J], l3, lz [kg m^2/s]  (n,).
    """

    def __init__(self, top: Top, start: State, t: Column) -> None:
        self.top, self.l3_start, self.lz_start, self.t = top, start.l3, start.lz, t

    @lazy
    def alpha(self) -> Column:
        """cos(theta/2) exp(i (phi + psi)/2), complex."""
        x, y, z, w = self.quaternion.T
        return w + 1j * z

    @lazy
    def beta(self) -> Column:
        """sin(theta/2) exp(i (phi - psi)/2), complex."""
        x, y, z, w = self.quaternion.T
        return y - 1j * x

    @lazy
    def quaternion(self) -> Column:
        """Attitude q(world <- body), (n, 4): x, y, z, w."""
        return np.stack(attitude.quaternion(self.alpha, self.beta), axis=-1)

    @lazy
    def theta_folded(self) -> Column:
        """Tilt in [0, pi] [rad]."""
        return 2.0 * np.arctan2(np.abs(self.beta), np.abs(self.alpha))

    @lazy
    def l3(self) -> Column:
        """L . e3 [kg m^2/s]: a constant of this motion."""
        return np.full(len(self.t), self.l3_start)

    @lazy
    def lz(self) -> Column:
        """L . z [kg m^2/s]: a constant of this motion."""
        return np.full(len(self.t), self.lz_start)

    @lazy
    def transverse_rate(self) -> Column:
        """omega_1 + i omega_2 (n,), complex [rad/s], eq. (4)."""
        return (-self.phi_dot * np.sin(self.theta) + 1j * self.theta_dot) * np.exp(
            -1j * self.psi)

    @lazy
    def angular_velocity(self) -> Column:
        """Body rates (n, 3) [rad/s]."""
        return np.stack(np.broadcast_arrays(*self.body_rates), axis=-1)

    @lazy
    def angular_acceleration(self) -> Column:
        """Body angular acceleration (n, 3) [rad/s^2]."""
        across1, across2, along = self.body_acceleration
        return np.stack((across1, across2, np.full(len(self.t), along)), axis=-1)

    @lazy
    def norm_error(self) -> Column:
        """|q| - 1 (n,)."""
        return np.linalg.norm(self.quaternion, axis=1) - 1.0


def _joined(name: str) -> Any:
    return lazy(lambda motion: motion.join(name))


class SteppedMotion(Motion):
    """Samples of steps: of many at once where the motion has them so, else one by one."""

    PARTS = ('alpha', 'beta', 'theta', 'theta_dot', 'phi', 'psi', 'l3', 'transverse_rate')

    def __init__(self, top: Top, start: State, t: Column, stepped: SteppedOrClosed) -> None:
        super().__init__(top, start, t)
        times = t.tolist()
        self._blocks: list[Any]
        if isinstance(stepped, TransportMotion) and stepped.in_columns and times:
            self._blocks = list(stepped.blocks(times))
        else:
            states = [stepped.at(instant) for instant in times]
            self._blocks = [SimpleNamespace(**{
                name: np.array([getattr(state, name) for state in states])
                for name in self.PARTS})]
        self.steps, self.evaluations = stepped.steps, stepped.evaluations

    def join(self, name: str) -> Column:
        """Return a column of all blocks."""
        columns = [getattr(block, name) for block in self._blocks]
        if not isinstance(columns[0], Pairs):
            return np.concatenate(columns)
        joined = np.empty(len(self.t), complex)
        joined.real = np.concatenate([column.real for column in columns])
        joined.imag = np.concatenate([column.imag for column in columns])
        return joined

    alpha, beta, theta, theta_dot, phi, psi, l3, transverse_rate = map(_joined, PARTS)


class ExactMotion(Motion):
    """Samples of the closed form, each column evaluated for all times at once."""

    def __init__(self, top: Top, start: State, t: Column) -> None:
        super().__init__(top, start, t)
        self.solution = ExactSolution(top, start)
        self._states = self.solution.states(t)

    @lazy
    def quaternion(self) -> Column:
        return self._states.quaternion

    @lazy
    def theta(self) -> Column:
        return self._states.theta

    @lazy
    def theta_dot(self) -> Column:
        return self._states.theta_dot

    @lazy
    def phi(self) -> Column:
        return self._states.phi

    @lazy
    def psi(self) -> Column:
        return self._states.psi

    @lazy
    def angular_velocity(self) -> Column:
        return self._states.angular_velocity

    @lazy
    def transverse_rate(self) -> Column:
        rates = self.angular_velocity
        return rates[:, 0] + 1j * rates[:, 1]


class ExactGrid(ExactMotion):
    """
    Samples of the closed form at start_ns + k step_ns, k = 0 .. count - 1.

    branch: where its angles are put, see `propagator.Branch`.
    """

    def __init__(self, solution: ExactSolution, branch: Branch, start_ns: int, step_ns: int,
                 count: int) -> None:
        ns = start_ns + step_ns * np.arange(count, dtype=np.int64)
        Motion.__init__(self, solution.top, solution.start, ns * 1e-9)
        self.solution, self._branch = solution, branch
        self._states = solution.states_at_ns(ns)

    @lazy
    def quaternion(self) -> Column:
        return self._branch.sign * self._states.quaternion

    @lazy
    def theta(self) -> Column:
        return self._branch.side * self._states.theta + self._branch.offset

    @lazy
    def theta_dot(self) -> Column:
        return self._branch.side * self._states.theta_dot

    @lazy
    def phi(self) -> Column:
        return self._states.phi - self._branch.half_turn

    @lazy
    def psi(self) -> Column:
        return self._states.psi + self._branch.half_turn
