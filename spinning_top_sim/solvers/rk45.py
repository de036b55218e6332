# SPDX-License-Identifier: Apache-2.0
"""A motion by Dormand-Prince steps, read between its steps at any number of times."""

import math
from abc import ABC, abstractmethod
from bisect import bisect_left
from functools import cached_property
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers import dormand_prince
from spinning_top_sim.solvers.dormand_prince import Equations, IntegrationError, Rows
from spinning_top_sim.solvers.equations import (
    POLE_SHARE,
    EulerEquations,
    Parts,
    TransportEquations,
    half_axis,
)
from spinning_top_sim.solvers.times import NANOSECONDS, Times
from spinning_top_sim.solvers.unwrap import PhaseUnwrapper, turns_to_follow

# A time that so many steps of the present size do not reach is refused: minutes of work.
MOST_STEPS = 1e7
# Steps that `states_at_seconds` takes and reads together; more would only take memory.
STEPS_TOGETHER = 256
# Steps that `release` leaves whatever it is asked: some 50 MB.
MOST_KEPT = 50_000


class SteppedMotion(ABC):
    """
    A motion by the steps of some equations, from its start at t = 0; every time counts from there.

    top, start : what moves, and from where
    ns_limit : the last time that it can give at all [ns]
    """

    ns_limit = 2 ** 63 - 1              # steps go on for ever

    def __init__(self, top: Top, start: State, equations: Equations) -> None:
        self.top, self.start, self._equations = top, start, equations
        self._integrator = dormand_prince.Integrator(equations)
        # The steps that can still be read, in order.
        self._kept = [self._integrator.newest]

    @property
    def steps(self) -> int:
        return self._integrator.steps

    @property
    def evaluations(self) -> int:
        return self._integrator.evaluations

    @property
    def reached_ns(self) -> int:
        """The last time that `states` can give without further steps [ns]."""
        end = self._kept[-1].t1
        ns = math.floor(end * NANOSECONDS)
        return ns if ns / NANOSECONDS <= end else ns - 1

    def reach(self, ns: int, max_steps: int | None = None) -> bool:
        """
        Take steps up to a time [ns]; return False if `max_steps` were too few.

        Raises IntegrationError if the equations cannot go on.
        """
        taken = 0
        while self.reached_ns < ns:
            if taken == max_steps:
                return False
            self._kept.append(self._integrator.step())
            taken += 1
        return True

    def release(self, before_ns: int) -> None:
        """Forget the steps that only states before this time [ns] need, or more to save memory."""
        count = bisect_left(self._kept, before_ns / NANOSECONDS, hi=len(self._kept) - 1,
                            key=attrgetter('t1'))
        self._forget(max(count, len(self._kept) - MOST_KEPT))

    def _forget(self, count: int) -> None:
        del self._kept[:count]

    def states(self, times_ns: NDArray[np.int64] | range) -> States:
        """Return the states at ascending times (n,) [ns]; see `states_at_seconds`."""
        return self.states_at_seconds(Times.from_ns(times_ns).seconds)

    def states_at_seconds(self, t: Column) -> States:
        """
        Return the states at ascending times t (n,) [s].

        Missing steps are taken here, STEPS_TOGETHER at a time, and forgotten once the times in
        them are computed: `solve` reads a motion of any length in bounded memory.
        Raises IntegrationError if a time lies before the steps that are kept, if the steps cannot
        go on to the last time, or if it is too many of them away.
        """
        if len(t) and t[0] < self._kept[0].t0:
            raise IntegrationError(f't = {float(t[0])!r} s: steps go forward, and the oldest one '
                                   f'that is kept begins at {self._kept[0].t0!r} s')
        parts, begin = [], 0
        while begin < len(t):
            while self._kept[-1].t1 < t[-1] and len(self._kept) < STEPS_TOGETHER:
                self._kept.append(self._integrator.step())
            oldest, newest = self._kept[0], self._kept[-1]
            length = (newest.t1 - oldest.t0) / len(self._kept)
            if t[-1] - newest.t1 > MOST_STEPS * length:
                raise IntegrationError(f't = {t[-1]:.9g} s is more than {MOST_STEPS:.0e} steps of '
                                       f"{length:.3g} s away: use method = 'exact'")
            end = int(np.searchsorted(t, newest.t1, 'right'))
            if end > begin:
                parts.append(self._unknowns(t[begin:end]))
                begin = end
            if begin < len(t):
                self._forget(len(self._kept) - 1)
        unknowns = np.concatenate(parts, axis=1) if parts else self._unknowns(t[:0])
        return self._states_of(t.copy(), unknowns)

    def _unknowns(self, t: Column) -> Rows:
        """Return the rows that `_states_of` needs at times [s] within the steps that are kept."""
        steps = np.array([step.t1 for step in self._kept]).searchsorted(t)
        first, last = (int(steps[0]), int(steps[-1])) if len(t) else (0, 0)
        interpolants = dormand_prince.Interpolants(self._kept[first:last + 1], self._equations)
        return np.concatenate((interpolants.at(steps - first, t), self._phases_at(steps)))

    def _phases_at(self, steps: NDArray[np.int64]) -> Rows:
        """Return further rows per time, of the step that it lies in: none here."""
        return np.empty((0, len(steps)))

    @abstractmethod
    def _states_of(self, t: Column, unknowns: Rows) -> States:
        """Return the states at times [s]."""


class EulerMotion(SteppedMotion):
    """A motion by `EulerEquations`, for study."""

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        super().__init__(top, start, EulerEquations(top, start, rtol, atol))

    def _states_of(self, t: Column, unknowns: Rows) -> States:
        return _EulerStates(self.top, self.start, t, unknowns)


class _EulerStates(States):
    def __init__(self, top: Top, start: State, t: Column, unknowns: Rows) -> None:
        super().__init__(top, start, len(t))
        theta, theta_dot, phi, psi = unknowns
        self.t, self.theta_dot, self.angles = t, theta_dot, (phi, theta, psi)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        return attitude.quaternion_of_angles(*self.angles)

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        """omega_1 + i omega_2 = (-phi' sin(theta) + i theta') exp(-i psi), eq. (4)."""
        across = self.phi_dot * np.sin(self.theta)
        cosine, sine = np.cos(self.psi), np.sin(self.psi)
        return self.theta_dot * sine - across * cosine, self.theta_dot * cosine + across * sine


class TransportMotion(SteppedMotion):
    """A motion by the regular equations, its angles unwrapped from step to step."""

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        self._transport = TransportEquations(top, start, rtol, atol)
        super().__init__(top, start, self._transport)
        self._phases = PhaseUnwrapper(start, self._transport.uniform_rates[0])

    def _forget(self, count: int) -> None:
        self._unwrap()
        super()._forget(count)
        self._phases.forget(count)

    def _unwrap(self) -> None:
        """Follow the phases to the begins of all steps that are kept."""
        new = self._kept[self._phases.begins.shape[1]:]
        if new:
            begins = np.array([step.y0 for step in new])
            self._phases.extend(np.array([step.t0 for step in new]), begins[:, 0], begins[:, 1])

    def _phases_at(self, steps: NDArray[np.int64]) -> Rows:
        self._unwrap()
        return self._phases.begins.take(steps, axis=1)

    def _states_of(self, t: Column, unknowns: Rows) -> States:
        return _TransportStates(self._transport, self._phases, self.start, t, unknowns)


class _TransportStates(States):
    """
    States known by alpha, beta and the momentum.

    rows : the six unknowns in the frame that is stepped, and `PhaseUnwrapper.begins` of the step
        that a sample lies in
    """

    def __init__(self, equations: TransportEquations, phases: PhaseUnwrapper, start: State,
                 t: Column, rows: Rows) -> None:
        super().__init__(equations.top, start, len(t))
        self.t, self._equations = t, equations
        self._polar, self._momenta = phases.polar, phases.momenta
        self._stepped: Parts = tuple(rows[:6])
        self._begins = rows[6:]

    @cached_property
    def _projected(self) -> Parts:
        """The unknowns on the invariants, in the body's own frame."""
        equations, y, pole_share = self._equations, self._stepped, POLE_SHARE
        if not all(self._momenta[:2]):  # the meridian of the axis is known
            y, pole_share = self._on_lines(y, equations.uniform_rates[0] * self.t), 0.0
        a, b, c, d, m_real, m_imag = equations.project_columns(y, pole_share)
        spin = 0.5 * equations.spin_rate * self.t
        cosine, sine = np.cos(spin), np.sin(spin)
        return (a * cosine - b * sine, b * cosine + a * sine,
                c * cosine + d * sine, d * cosine - c * sine, m_real, m_imag)

    def _on_lines(self, y: Parts, uniform: Column) -> Parts:
        """Return y with alpha or beta moved onto the line through zero, and m turned with them."""
        moved = list(y[:4])
        moduli, phases = self._polar(y, uniform)
        for k, part in enumerate((uniform, -uniform)):
            if not self._momenta[k]:
                moved[2 * k] = moduli[k] * np.cos(phases[k] + part)
                moved[2 * k + 1] = moduli[k] * np.sin(phases[k] + part)
        x, z = half_axis(*y[:4])
        u, v = half_axis(*moved)
        # Next to the pole m is known better than the axis.
        away = x * x + z * z > POLE_SHARE
        scale = np.where(away, np.hypot(x, z) * np.hypot(u, v), 1.0)
        cosine = np.where(away, (x * u + z * v) / scale, 1.0)
        sine = np.where(away, (x * v - z * u) / scale, 0.0)
        return *moved, y[4] * cosine - y[5] * sine, y[4] * sine + y[5] * cosine

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        alpha_real, alpha_imag, beta_real, beta_imag, *_ = self._projected
        return -beta_imag, beta_real, alpha_imag, alpha_real

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        uniform = self._equations.uniform_rates[1] * self.t
        _, phases = self._polar(self._projected, uniform)
        # theta/2 turns by less than half a turn within a step.
        half_sum, half_difference, half = (
            phase + math.tau * turns_to_follow(phase, begin, momentum)
            for phase, begin, momentum in zip(phases, self._begins, self._momenta, strict=True))
        half_sum, half_difference = half_sum + uniform, half_difference - uniform
        return half_sum + half_difference, 2.0 * half, half_sum - half_difference

    @cached_property
    def _momentum(self) -> tuple[Column, Column]:
        """L_x and L_y in the world frame [kg m^2/s]."""
        unit, (*_, m_real, m_imag) = 2.0 * self.top.lambda1, self._projected
        return unit * m_imag, -unit * m_real

    @cached_property
    def theta_dot(self) -> Column:
        """The momentum across the meridian plane, over lambda1."""
        lx, ly = self._momentum
        return (ly * np.cos(self.phi) - lx * np.sin(self.phi)) / self.top.lambda1

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        first, second, _ = attitude.in_body(self.rows_quaternion, (*self._momentum, self._lz))
        return first / self.top.lambda1, second / self.top.lambda1

    @cached_property
    def l3(self) -> Column:
        x, y, z = self.rows_axis
        lx, ly = self._momentum
        return lx * x + ly * y + self._lz * z
