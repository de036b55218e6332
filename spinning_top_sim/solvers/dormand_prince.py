# SPDX-License-Identifier: Apache-2.0
"""
Motions by adaptive Dormand-Prince 5(4) steps: the method of MATLAB's ODE45.

Tableau: Dormand & Prince, "A family of embedded Runge-Kutta formulae", J. Comp. Appl. Math. 6
(1980) 19-26, table 2 (RK5(4)7M).  Step control: Hairer, Norsett & Wanner, *Solving Ordinary
Differential Equations I*, 2nd ed., sect. II.4.  Between steps the solution is the quintic
Hermite polynomial through the value and two derivatives at both ends: its error is O(h^6) like
that of a step, where the usual 4th-order continuous extension would spoil the step's accuracy.
"""

import functools
import math
from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.motion import Motion
from spinning_top_sim.times import NANOSECONDS, Times

# The unknowns of one state: complex numbers, of which floats are some.
Unknowns = tuple[complex, ...]
# Their components (k, n), a complex one as two rows; a column of each state.
UnknownRows = NDArray[np.float64]


# ERROR has the weights of fifth order, those of the last stage, less those of fourth.
*STAGES, ERROR = (tuple(map(Fraction, row.split())) for row in (
    '1/5',
    '3/40 9/40',
    '44/45 -56/15 32/9',
    '19372/6561 -25360/2187 64448/6561 -212/729',
    '9017/3168 -355/33 46732/5247 49/176 -5103/18656',
    '35/384 0 500/1113 125/192 -2187/6784 11/84',
    '71/57600 0 -71/16695 71/1920 -17253/339200 22/525 -1/40'))

# Hairer et al. eq. (4.13): aim a little below the tolerance and change the step within limits.
SAFETY = 0.9
SHRINK, GROW = 0.2, 5.0
# A step of fewer units in the last place of t is a collapse, not progress.
SMALLEST_STEP_ULPS = 16
# A time that so many steps of the present size do not reach is refused: half a minute, 1.2 GB.
MOST_STEPS = 2e6
STEPS_TOGETHER = 256            # steps that are taken and read together


class IntegrationError(RuntimeError):
    """
    The integration cannot go on; the message says where, why and what to do instead.

    Parameters
    ----------
    text : str
        The message.
    reached_ns : int
        Last time of which there are states [ns].
    """

    def __init__(self, text: str, *, reached_ns: int = 0) -> None:
        super().__init__(text)
        self.reached_ns = reached_ns


StepFunction = Callable[..., tuple[Unknowns, Unknowns, Unknowns]]


@functools.cache
def unrolled_step(size: int, is_complex: bool) -> StepFunction:
    """
    Return step(f, h, y, k1) -> (y_new, k7, error estimate) for vectors of `size` numbers.

    As source text without loops: with loops over lists a motion takes 1.4 times the time.
    """
    literal = (lambda x: f'({x!r}+0j)') if is_complex else repr

    def combination(coefficients: tuple[Fraction, ...], component: int) -> str:
        return ' + '.join(f'{literal(float(c))}*k{stage}_{component}'
                          for stage, c in enumerate(coefficients, start=1) if c)

    def names(stem: str) -> str:
        return ''.join(f'{stem}_{i}, ' for i in range(size))

    lines = ['def step(f, h, y, k1):', f'    {names("y")}= y', f'    {names("k1")}= k1',
             f'    h = {"complex(h)" if is_complex else "h"}']
    for stage, coefficients in enumerate(STAGES[:-1], start=2):
        arguments = ', '.join(f'y_{i} + h*({combination(coefficients, i)})' for i in range(size))
        lines.append(f'    {names(f"k{stage}")}= f({arguments})')
    lines.extend(f'    z_{i} = y_{i} + h*({combination(STAGES[-1], i)})' for i in range(size))
    lines.append(f'    {names("k7")}= k7 = f({names("z")})')
    estimate = ', '.join(f'h*({combination(ERROR, i)})' for i in range(size))
    lines.append(f'    return ({names("z")}), k7, ({estimate},)')
    scope: dict[str, StepFunction] = {}
    exec('\n'.join(lines), scope)
    return scope['step']


def components(vectors: Sequence[float] | Sequence[Unknowns]) -> UnknownRows:
    """Return rows (k, n) of n vectors, or (n,) of floats; a complex component makes two rows."""
    columns: NDArray[np.generic] = np.array(vectors)
    return np.ascontiguousarray(columns.view(np.float64).T)


class SteppedMotion(Motion):
    """
    A motion from its start at t = 0, by steps of equations y' = f(y).

    A subclass sets what its `derivative`, f, needs before it calls `__init__`.

    y : the unknowns at t = 0, all complex or all real
    tolerance, fastest_rate : relative error of a step, and a bound on |y'|/|y| [1/s], from which
        the first step's length comes
    """

    derivative: Callable[..., Unknowns]     # f of the unknowns, which it takes one by one
    columns: Callable[..., States]          # of this, times [s], and what `_unknowns` returns

    def __init__(self, top: Top, start: State, y: Unknowns, tolerance: float,
                 fastest_rate: float) -> None:
        super().__init__(top, start)
        # Where a step ends and the next begins [s], and there the unknowns and their derivatives.
        # Between these the motion can still be read; the first step has no length.
        self._ends, self._y, self._derivatives = 2 * [0.0], 2 * [y], 2 * [self.derivative(*y)]
        # A careful first step: the control finds the right one within a few.
        self._next_step = 0.1 * math.pow(tolerance, 0.2) / max(fastest_rate, 1e-100)
        self.steps, self.evaluations = 0, 1

    @abstractmethod
    def second_derivative(self, y: UnknownRows, derivative: UnknownRows) -> UnknownRows:
        """Return y'' from y and y': rows of components (k, n), real and imaginary parts apart."""

    @abstractmethod
    def errors(self, y: Unknowns, y_new: Unknowns, difference: Unknowns) -> tuple[float, ...]:
        """Return each error estimate over what is tolerated: a step passes if all are <= 1."""

    @abstractmethod
    def corrected(self, y: Unknowns, y_new: Unknowns) -> Unknowns:
        """Return the end of a step, perhaps moved; IntegrationError if it cannot be trusted."""

    def _take_step(self) -> None:
        """Take one accepted step.  Raises IntegrationError where none can be taken."""
        t, y, derivative = self._ends[-1], self._y[-1], self._derivatives[-1]
        grow, step = GROW, unrolled_step(len(y), isinstance(y[0], complex))
        while True:
            end = t + self._next_step
            h = end - t                         # what the sum really made of it
            if not h > SMALLEST_STEP_ULPS * math.ulp(t):
                raise IntegrationError(
                    f'the step size collapsed to {self._next_step:.3g} s at t = {t:.9g} s')
            y_new, derivative_new, difference = step(self.derivative, h, y, derivative)
            self.evaluations += 6
            errors = self.errors(y, y_new, difference)
            # `max` may pass over a NaN.  An infinite error shrinks the step until that collapses.
            error = max(errors) if sum(errors) < math.inf else math.inf
            factor = max(SHRINK, SAFETY * error ** -0.2) if error else GROW
            if error <= 1.0:
                break
            grow = 1.0
            self._next_step = h * factor
        y_new = self.corrected(y, y_new)
        self._next_step = h * min(grow, factor)
        self.steps += 1
        # First same as last: the projection moves y by less than the step's own error, so the
        # derivative at the unprojected end serves the next step too.
        self._ends.append(end)
        self._y.append(y_new)
        self._derivatives.append(derivative_new)

    @property
    def reached_ns(self) -> int:
        end = self._ends[-1]
        ns = math.floor(end * NANOSECONDS)
        return ns if ns / NANOSECONDS <= end else ns - 1

    def forget(self, before_ns: int) -> None:
        self._forget(self._number(before_ns / NANOSECONDS))

    def _forget(self, count: int) -> None:
        del self._ends[:count], self._y[:count], self._derivatives[:count]

    def _number(self, t: float) -> int:
        """Return the number of the step in which a time [s] lies, or of the last one before it."""
        return bisect_left(self._ends, t, 1, len(self._ends) - 1) - 1

    def states(self, t: Column | Times, per_second: int = 1) -> States:
        """
        Return the states at ascending times (n,); missing steps are taken, and kept.

        Raises IntegrationError for a time before the steps that are kept, or out of reach; up to
        its `reached_ns`, the states can be had then.
        """
        t = t / per_second
        if len(t) and t[0] < self._ends[0]:
            raise IntegrationError(f't = {float(t[0])!r} s: steps go forward, and the oldest one '
                                   f'that is kept begins at {self._ends[0]!r} s')
        parts, begin = [], 0
        while begin < len(t):
            if self._ends[-1] < t[-1]:
                self._take_steps(float(t[-1]))
            end = int(np.searchsorted(t, self._ends[-1], 'right'))
            if end > begin:
                parts.append(self._unknowns(t[begin:end]))
                begin = end
        unknowns = np.concatenate(parts, axis=1) if parts else self._unknowns(t[:0])
        return self.columns(self, t, unknowns)

    def _take_steps(self, until: float) -> None:
        """Take STEPS_TOGETHER steps towards a time [s], or those that are missing."""
        try:
            begin, taken = self._ends[-1], 0
            while taken < STEPS_TOGETHER and self._ends[-1] < until:
                self._take_step()
                taken += 1
            mean = (self._ends[-1] - begin) / taken
            if until - self._ends[-1] > MOST_STEPS * mean:
                raise IntegrationError(f't = {until:.9g} s is more than {MOST_STEPS:.0e} steps of '
                                       f"{mean:.3g} s away: use method = 'exact'")
        except IntegrationError as error:
            error.reached_ns = self.reached_ns
            raise

    def _unknowns(self, t: Column) -> UnknownRows:
        """Return the unknowns (k, n) at times [s] within the steps that are kept."""
        return self._interpolated(t)[2]

    def _interpolated(self, t: Column) -> tuple[int, NDArray[np.int64], UnknownRows]:
        """Return the step of the first time [s], in which step from there times lie, and y."""
        first, last = (self._number(t[0]), self._number(t[-1])) if len(t) else (0, 0)
        ends, y, first_derivative = (components(one[first:last + 2]) for one in (
            self._ends, self._y, self._derivatives))
        h = np.diff(ends)
        start, rise = y[:, :-1], np.diff(y)
        p, q = h * first_derivative[:, :-1], h * first_derivative[:, 1:]
        second = self.second_derivative(y, first_derivative)
        u, v = 0.5 * h * h * second[:, :-1], 0.5 * h * h * second[:, 1:]
        # (6, k, steps), by powers of (t - begin)/length.
        coefficients = np.array((
            start, p, u,
            10.0 * rise - 6.0 * p - 4.0 * q - 3.0 * u + v,
            -15.0 * rise + 8.0 * p + 7.0 * q + 3.0 * u - 2.0 * v,
            6.0 * rise - 3.0 * p - 3.0 * q - u + v))
        numbers = ends[1:].searchsorted(t)
        s = (t - ends[numbers]) / np.where(h > 0.0, h, 1.0)[numbers]
        c0, c1, c2, c3, c4, c5 = coefficients.take(numbers, axis=2)
        return first, numbers, ((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
