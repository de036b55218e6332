# SPDX-License-Identifier: Apache-2.0
"""The motion by Dormand-Prince steps, and by closed formulas where no step is needed."""

from __future__ import annotations

import cmath
import math
from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import AxisState, Columns, OneState
from spinning_top_sim.physics.pairs import Pairs
from spinning_top_sim.physics.regimes import cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import (
    DenseStep,
    Form,
    IntegrationError,
    Integrator,
    Vector,
)
from spinning_top_sim.solvers.phases import (
    MomentumState,
    Polar,
    StepPhases,
    Winding,
    spin_excess,
    windings,
)
from spinning_top_sim.solvers.transport import TransportForm

if TYPE_CHECKING:
    from spinning_top_sim.solvers.step_columns import Samples, StepColumns

NANOSECONDS = 1_000_000_000
# Later than any time: 292 years.
ENDLESS_NS = 2 ** 63 - 1
EQUATIONS = ('transport', 'euler')
# Larger energies and rates leave no room for their products in doubles.
MOST = 1e290
# A time that so many steps of the present size do not reach is refused at once: 3 hours of work.
MOST_STEPS = 1e9
# The careful first steps say nothing about that.
TRIAL_STEPS = 100
# How many units in the last place count as rounding.
REST_ULPS = 2.0
# And how far the axis may swing all the same, in cos(theta) over sin^2(theta).
REST_SWING = 1e-12
# So many of the newest steps can still be read, for who computes ahead of the time that it is.
STEPS_KEPT = 128


def rk45(top: Top, start: State, *, equations: str = 'transport', rtol: float = 1e-11,
         atol: float = 1e-12) -> SteppedOrClosed:
    """
    Return the motion that begins at `start`.

    rtol, atol: tolerated error a step.  The transport form scales its unknowns to 1, so there
    the two add up; the Euler form tolerates atol + rtol |angle|.
    Raises ValueError for a bad setting or constants that doubles cannot hold, IntegrationError
    where the Euler form cannot start.
    """
    check_settings(equations, rtol, atol)
    try:
        motion = _motion(top, start, equations, rtol, atol)
        first = motion.at(0.0)
        held = all(abs(x) <= MOST for x in (first.energy, first.phi_dot, first.psi_dot))
    except ArithmeticError:
        held = False
    if not held:
        raise ValueError(f'{top} from {start}: the constants are too far apart in size for '
                         'doubles to hold the motion')
    return motion


def _motion(top: Top, start: State, equations: str, rtol: float, atol: float) -> SteppedOrClosed:
    if equations == 'euler':
        return EulerMotion(top, start, rtol, atol)
    if top.gravity_torque == 0.0:
        return FreeMotion(top, start)
    if nutation_rests(top, start):
        return RestingMotion(top, start)
    return TransportMotion(top, start, rtol, atol)


def check_settings(equations: str, rtol: float, atol: float) -> None:
    """Raise ValueError naming the setting that is off, its value and what is allowed."""
    if equations not in EQUATIONS:
        raise ValueError(f'equations = {equations!r}: must be one of {", ".join(EQUATIONS)}')
    if not 1e-14 <= rtol <= 1e-2:
        raise ValueError(f'rtol = {rtol!r}: must be in [1e-14, 1e-2]')
    if not 0.0 <= atol <= 1e-2:
        raise ValueError(f'atol = {atol!r}: must be in [0, 1e-2]')


def nutation_rests(top: Top, start: State) -> bool:
    """
    Whether theta stays as it is: sleeping, hanging at a pole, or steady precession.

    Steady means theta'' = 0, eq. (30), as nearly as its terms and the given L3 and Lz, doubles
    all, can say.  Next to a pole they say so little that the axis may swing far; then it is not.
    """
    if start.theta_dot != 0.0:
        return False
    sine, cosine = math.sin(start.theta), math.cos(start.theta)
    half_cosine, half_sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
    phi_dot = attitude.precession_rate(top, start.l3, start.lz, half_cosine ** 2, half_sine ** 2)
    gyroscopic = start.l3 / top.lambda1
    terms = (phi_dot * phi_dot * sine * cosine, -gyroscopic * phi_dot * sine,
             top.gravity_torque / top.lambda1 * sine)
    doubt = sum(map(abs, terms))
    if start.lz - start.l3 * cosine:
        rounded_rate = (abs(start.lz) + abs(start.l3)) / (top.lambda1 * sine * sine)
        doubt += abs((2.0 * phi_dot * cosine - gyroscopic) * sine) * rounded_rate
    if abs(math.fsum(terms)) > REST_ULPS * math.ulp(1.0) * doubt:
        return False
    # From theta' = 0 cos(theta) swings by f1/f2, where that is small.
    s0, c0 = half_sine ** 2, half_cosine ** 2
    _, f1, f2, _ = cubic(top, start, s0, c0)
    return abs(f1) <= REST_SWING * 4.0 * s0 * c0 * abs(f2)


class SteppedOrClosed(ABC):
    """A motion read at seconds, or at the integer nanoseconds of a `Propagator`."""

    steps = 0
    evaluations = 0
    earliest_ns = 0
    latest_ns = ENDLESS_NS
    in_columns = False

    @abstractmethod
    def at(self, t: float) -> OneState:
        """Return the state at t [s]."""

    def reach(self, t: float, max_steps: int | None = None) -> bool:
        """Compute what the state at t [s] needs; False if max_steps did not do."""
        return True

    def at_ns(self, ns: int) -> OneState:
        """See `Propagator`."""
        return self.at(ns / NANOSECONDS)

    def reach_ns(self, ns: int, max_steps: int | None = None) -> bool:
        """See `Propagator`."""
        return self.reach(ns / NANOSECONDS, max_steps)

    def step_ahead(self, until_ns: int, now_ns: int, period_ns: int) -> bool:
        """See `Propagator`."""
        return False

    def columns_ns(self, instants: range) -> Columns:
        """See `Propagator`."""
        raise NotImplementedError('these states are told one by one')


# A step, and the phases at its begin where the motion follows them.
Kept = tuple[DenseStep, StepPhases | None]


def _end(kept: tuple[DenseStep, Any]) -> float:
    return kept[0].t1


class _Stepped(SteppedOrClosed):
    """A motion by steps: what both forms share."""

    def __init__(self, form: Form, start: Vector, first_step: float,
                 phases: StepPhases | None = None) -> None:
        self._integrator = Integrator(form, start, first_step)
        self._newest: Kept = (self._integrator.newest, phases)
        self._kept = deque([self._newest], STEPS_KEPT)

    @property
    def steps(self) -> int:  # type: ignore[override]
        return self._integrator.steps

    @property
    def evaluations(self) -> int:  # type: ignore[override]
        return self._integrator.evaluations

    @property
    def earliest_ns(self) -> int:  # type: ignore[override]
        """See `Propagator`."""
        start = self._kept[0][0].t0
        ns = math.ceil(start * NANOSECONDS)
        return ns if ns / NANOSECONDS >= start else ns + 1

    @property
    def latest_ns(self) -> int:  # type: ignore[override]
        """See `Propagator`."""
        end = self._newest[0].t1
        ns = math.floor(end * NANOSECONDS)
        return ns if ns / NANOSECONDS <= end else ns - 1

    def reach(self, t: float, max_steps: int | None = None) -> bool:
        taken = 0
        while self._newest[0].t1 < t:
            if taken == max_steps:
                return False
            self._step()
            taken += 1
            newest = self._newest[0]
            step = newest.t1 - newest.t0
            if max_steps is None and taken == TRIAL_STEPS and t - newest.t1 > MOST_STEPS * step:
                raise IntegrationError(
                    f't = {t:.9g} s is more than {MOST_STEPS:.0e} steps of {step:.3g} s away: '
                    "use method = 'exact'")
        return True

    def step_ahead(self, until_ns: int, now_ns: int, period_ns: int) -> bool:
        """See `Propagator`."""
        # The oldest one would go, and the second has to hold that time then.
        if self._newest[0].t1 >= until_ns / NANOSECONDS or (
                len(self._kept) == STEPS_KEPT and self._kept[1][0].t0 >= now_ns / NANOSECONDS):
            return False
        self._step()
        newest = self._newest[0]
        if newest.t1 - newest.t0 >= period_ns / NANOSECONDS:
            _ = newest.coefficients             # a part of the work that can be done now
        return True

    def _step(self) -> None:
        self._newest = self._integrator.step(), self._phases_onward()
        self._kept.append(self._newest)

    def _phases_onward(self) -> StepPhases | None:
        """Return the phases at the begin of the step that follows the newest one."""
        return None

    def _step_at(self, t: float) -> Kept:
        """Return the step that holds t [s], of two that meet there the earlier one."""
        newest = self._newest[0]
        if newest.t0 < t <= newest.t1:
            return self._newest
        if t > newest.t1:
            self.reach(t)
            return self._newest
        for kept in reversed(self._kept):
            if kept[0].t0 < t:
                return kept
        oldest = self._kept[0]
        if t < oldest[0].t0:
            raise ValueError(f't = {t!r} s: steps go forward, and the oldest one that is kept '
                             f'began at {oldest[0].t0!r} s; times must not decrease by much')
        return oldest


class EulerMotion(_Stepped):
    """Equations (29)-(32) to the letter."""

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        from spinning_top_sim.solvers.euler_form import EulerForm  # noqa: PLC0415 - for study

        self._top, self._start = top, start
        form = EulerForm(top, start, rtol, atol)
        super().__init__(form, form.start, form.first_step)

    def at(self, t: float) -> OneState:
        """Return the state at t [s]."""
        step, _ = self._step_at(t)
        return AxisState(self._top, self._start.l3, self._start.lz, *step.interpolate(t))


class TransportMotion(_Stepped):
    """The regular form, with phases followed from step to step."""

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        self._top, self._start = top, start
        self._form = TransportForm(top, start, rtol, atol)
        alpha, beta = windings(start)
        super().__init__(self._form, self._form.start, self._form.first_step,
                         StepPhases(0.5 * spin_excess(top, start.l3), alpha, beta,
                                    0.5 * start.theta))
        # A top that passes a pole has phases that are known otherwise.
        self.in_columns = not (alpha.crosses or beta.crosses)
        self._carried_rate = 0.5 * self._form.spin_carried / top.lambda1
        self._half_spin_rate = 0.5 * self._form.spin_rate
        self._momentum_unit = -2j * top.lambda1

    def at(self, t: float) -> MomentumState:
        """Return the state at t [s], on the invariants."""
        step, phases = self._newest
        if not step.t0 < t <= step.t1:
            step, phases = self._step_at(t)
        assert phases is not None
        alpha, beta, m = step.interpolate(t)
        if phases.crosses:
            lines = phases.on_lines(alpha, beta, -self._carried_rate * t)
            alpha, beta, m = self._form.project_on_lines((alpha, beta, m), *lines)
        elif t < step.t1:
            alpha, beta, m = self._form.project((alpha, beta, m))
        spin = cmath.rect(1.0, self._half_spin_rate * t)
        return MomentumState(self._top, self._start, alpha * spin, beta * spin.conjugate(),
                             self._momentum_unit * m, t, phases)

    def columns_ns(self, instants: range) -> StepColumns:
        """See `Propagator`."""
        return self._columns([ns / NANOSECONDS for ns in instants])

    def blocks(self, t: Sequence[float]) -> Iterator[StepColumns]:
        """Yield the states at ascending times [s], those of many steps each, if `in_columns`."""
        begin = 0
        while begin < len(t):
            self.reach(t[begin])
            # The step that holds that time has to stay.
            for _ in range(STEPS_KEPT - 2):
                if self._newest[0].t1 >= t[-1]:
                    break
                self._step()
            end = bisect_right(t, self._newest[0].t1, begin)
            yield self._columns(t[begin:end])
            begin = end

    def _columns(self, t: Sequence[float]) -> StepColumns:
        """Return the states at ascending times [s] within the steps that are kept."""
        from spinning_top_sim.solvers import step_columns  # noqa: PLC0415 - for its numpy

        self._step_at(t[0])
        assert t[-1] <= self._newest[0].t1
        kept = [(step, phases) for step, phases in self._kept if phases is not None]
        first, last = (bisect_left(kept, time, key=_end) for time in (t[0], t[-1]))
        samples = step_columns.read(kept[first:last + 1], t)
        # What is known there is not read from the polynomial.
        ended = [(k, self.at(t[k])) for k in samples.ended]
        return step_columns.StepColumns(self._top, self._start, samples,
                                        partial(self._on_invariants, ended))

    def _on_invariants(self, ended: Sequence[tuple[int, MomentumState]], samples: Samples,
                       ) -> tuple[Pairs, Pairs, Pairs]:
        """Return alpha, beta and the momentum as `at` has them; it has said some already."""
        from spinning_top_sim.solvers.step_columns import rotations  # noqa: PLC0415

        alpha, beta, m = self._form.project_columns(*samples.unknowns)
        spin, turn = rotations(self._half_spin_rate * samples.t), self._momentum_unit.imag
        columns = alpha * spin, beta * spin.conjugate(), Pairs(-turn * m.imag, turn * m.real)
        for k, state in ended:
            for column, z in zip(columns, (state.alpha, state.beta, state.momentum), strict=True):
                column.real[k], column.imag[k] = z.real, z.imag
        return columns

    def _phases_onward(self) -> StepPhases:
        step, phases = self._newest
        assert phases is not None
        alpha, beta, _ = step.y1
        # The stepped frame lacks the spin of `TransportForm.spin_rate`: so does its line.
        return phases.moved_to(alpha, beta, -self._carried_rate * step.t1)


class FreeMotion(SteppedOrClosed):
    """
    No torque (P = 0): the momentum stands still and the axis turns about it uniformly.

    alpha and beta less the spin Omega move on ellipses, at half the rate |L|/lambda1.
    """

    def __init__(self, top: Top, start: State) -> None:
        self._top, self._start = top, start
        form = TransportForm(top, start, 0.0, 0.0, spin_carried_share=0.0)
        self._alpha0, self._beta0, m = form.start
        self._momentum = -2j * top.lambda1 * m
        total = math.hypot(start.lz, abs(self._momentum))
        self._rate = 0.5 * total / top.lambda1
        # At x = pi/2: i/|L| times the momentum acting on (alpha, beta).
        unit = 1j / total if total else 0j
        self._alpha1 = unit * (start.lz * self._alpha0
                               + self._momentum * self._beta0.conjugate())
        self._beta1 = unit * (start.lz * self._beta0
                              - self._momentum * self._alpha0.conjugate())
        self._line_rate = 0.5 * spin_excess(top, start.l3)
        self._alpha, self._beta = windings(start)

    def at(self, t: float) -> OneState:
        """Return the state at any t [s]."""
        cosine, sine = math.cos(self._rate * t), math.sin(self._rate * t)
        spin = cmath.rect(1.0, self._line_rate * t)
        return MomentumState(
            self._top, self._start, (cosine * self._alpha0 + sine * self._alpha1) * spin,
            (cosine * self._beta0 + sine * self._beta1) * spin.conjugate(), self._momentum, t,
            self)

    def polar(self, alpha: complex, beta: complex, t: float) -> Polar:
        """See `phases.Phases`: on an ellipse the angle is within pi of its parameter."""
        return (self._continue(self._alpha, alpha, t, self._line_rate * t),
                self._continue(self._beta, beta, t, -self._line_rate * t))

    def _continue(self, winding: Winding, z: complex, t: float, line: float,
                  ) -> tuple[float, float]:
        if winding.crosses:
            return winding.on_line(z, winding.phase + line)
        turned = math.copysign(self._rate * t, winding.momentum)
        return winding.nearest(z, winding.phase + line + turned)

    def theta(self, half_theta: float, t: float) -> float:
        """See `phases.Phases`: only a planar rotation takes theta out of [-pi, pi]."""
        expected = 0.5 * self._start.theta
        if self._alpha.crosses and self._beta.crosses:
            expected += math.copysign(self._rate * t, self._start.theta_dot)
        return 2.0 * (half_theta + math.tau * round((expected - half_theta) / math.tau))


class RestingMotion(SteppedOrClosed):
    """The nutation rests: theta stays, phi and psi turn uniformly."""

    def __init__(self, top: Top, start: State) -> None:
        self._top, self._start = top, start
        now = self._state(start.phi, start.psi)
        self._phi_dot, self._psi_dot = now.phi_dot, now.psi_dot

    def _state(self, phi: float, psi: float) -> AxisState:
        start = self._start
        return AxisState(self._top, start.l3, start.lz, start.theta, 0.0, phi, psi)

    def at(self, t: float) -> OneState:
        """Return the state at any t [s]."""
        return self._state(self._start.phi + self._phi_dot * t,
                           self._start.psi + self._psi_dot * t)
