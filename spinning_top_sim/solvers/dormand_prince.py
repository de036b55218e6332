# SPDX-License-Identifier: Apache-2.0
"""
Adaptive Dormand-Prince 5(4) steps in plain Python numbers: the method of MATLAB's ODE45.

Tableau: Dormand & Prince, "A family of embedded Runge-Kutta formulae", J. Comp. Appl. Math. 6
(1980) 19-26, table 2 (RK5(4)7M).  Step control: Hairer, Norsett & Wanner, *Solving Ordinary
Differential Equations I*, 2nd ed., sect. II.4.  Between steps the solution is the quintic
Hermite polynomial through the value and two derivatives at both ends: its error is O(h^6) like
that of a step, where the usual 4th-order continuous extension would spoil the step's accuracy.
"""

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The unknowns of one state: complex numbers, of which floats are some.
Vector = tuple[complex, ...]
# A row of each component (k, n), a complex one as two rows; a column of each state.
Rows = NDArray[np.float64]


def _fractions(text: str) -> tuple[Fraction, ...]:
    return tuple(map(Fraction, text.split()))


STAGES = tuple(map(_fractions, (
    '1/5',
    '3/40 9/40',
    '44/45 -56/15 32/9',
    '19372/6561 -25360/2187 64448/6561 -212/729',
    '9017/3168 -355/33 46732/5247 49/176 -5103/18656',
    '35/384 0 500/1113 125/192 -2187/6784 11/84')))
# The weights of fifth order, which are the last stage, less those of fourth order.
ERROR = _fractions('71/57600 0 -71/16695 71/1920 -17253/339200 22/525 -1/40')

# Hairer et al. eq. (4.13): aim a little below the tolerance and change the step within limits.
SAFETY = 0.9
SHRINK, GROW = 0.2, 5.0
# Doubles do not hold the powers of faster rates or longer steps.
FASTEST_RATE, LONGEST_STEP = 1e100, 1e100       # [rad/s], [s]
# A step of fewer units in the last place of t is a collapse, not progress.
SMALLEST_STEP_ULPS = 16


class IntegrationError(RuntimeError):
    """The integration cannot go on; the message says where, why and what to do instead."""


class Equations(ABC):
    """
    Equations of motion y' = f(y), with what the step control needs.

    start : the unknowns at t = 0, all complex or all real
    tolerance, fastest_rate : relative error of a step, and a bound on |y'|/|y| [1/s]: the first
        step's length comes from these two
    derivative : f; takes the unknowns one by one
    """

    start: Vector
    tolerance: float
    fastest_rate: float
    derivative: Callable[..., Vector]

    @abstractmethod
    def second_derivative(self, y: Rows, derivative: Rows) -> Rows:
        """Return y'' from y and y': rows of components (k, n), real and imaginary parts apart."""

    @abstractmethod
    def errors(self, y: Vector, y_new: Vector, difference: Vector) -> tuple[float, ...]:
        """Return each error estimate over what is tolerated: a step passes if all are <= 1."""

    @abstractmethod
    def accepted(self, y: Vector, y_new: Vector) -> Vector:
        """Return the end of a step, perhaps moved; IntegrationError if it cannot be trusted."""


StepFunction = Callable[..., tuple[Vector, Vector, Vector]]


@functools.cache
def unrolled_step(size: int, is_complex: bool) -> StepFunction:
    """
    Return step(f, h, y, k1) -> (y_new, k7, error estimate) for vectors of `size` numbers.

    The loops over stages and components are written out once from the tableau, as source text:
    plain expressions on local names take a third of the time of loops over lists.
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


class Step(NamedTuple):
    """One accepted step: times [s], unknowns and their derivatives at both ends."""

    t0: float
    y0: Vector
    derivative0: Vector
    t1: float
    y1: Vector
    derivative1: Vector


class Integrator:
    """
    Takes steps forward from t = 0.

    newest : the latest step, one of no length before the first
    steps, evaluations : counts
    """

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        start = equations.start
        self._step = unrolled_step(len(start), isinstance(start[0], complex))
        derivative = equations.derivative(*start)
        self.newest = Step(0.0, start, derivative, 0.0, start, derivative)
        if not equations.fastest_rate <= FASTEST_RATE:
            raise OverflowError(f'{equations.fastest_rate:.3g} rad/s')
        # A careful first step: the control finds the right one within a few.
        self._next_step = 0.1 * math.pow(equations.tolerance, 0.2) / (
            equations.fastest_rate or 1.0)
        self.steps = 0
        self.evaluations = 1

    def step(self) -> Step:
        """Take one accepted step.  Raises IntegrationError where none can be taken."""
        equations, newest = self.equations, self.newest
        t, y, derivative = newest.t1, newest.y1, newest.derivative1
        grow = GROW
        while True:
            end = t + min(self._next_step, LONGEST_STEP)
            h = end - t                         # what the sum really made of it
            if not h > SMALLEST_STEP_ULPS * math.ulp(t):
                raise IntegrationError(
                    f'the step size collapsed to {self._next_step:.3g} s at t = {t:.9g} s')
            y_new, derivative_new, difference = self._step(equations.derivative, h, y, derivative)
            self.evaluations += 6
            errors = equations.errors(y, y_new, difference)
            # `max` may pass over a NaN.  An infinite error shrinks the step until that collapses.
            error = max(errors) if sum(errors) < math.inf else math.inf
            factor = max(SHRINK, SAFETY * error ** -0.2) if error else GROW
            if error <= 1.0:
                break
            grow = 1.0
            self._next_step = h * factor
        y_new = equations.accepted(y, y_new)
        self._next_step = h * min(grow, factor)
        self.steps += 1
        # First same as last: the projection moves y by less than the step's own error, so the
        # derivative at the unprojected end serves the next step too.
        self.newest = Step(t, y, derivative, end, y_new, derivative_new)
        return self.newest


class Interpolants:
    """The quintic Hermite polynomials of n steps of some equations."""

    def __init__(self, steps: Sequence[Step], equations: Equations) -> None:
        self._begin, y0, first0, end, y1, first1 = map(_components, zip(*steps, strict=True))
        h = end - self._begin
        self._length = np.where(h > 0.0, h, 1.0)
        rise, p, q = y1 - y0, h * first0, h * first1
        u = 0.5 * h * h * equations.second_derivative(y0, first0)
        v = 0.5 * h * h * equations.second_derivative(y1, first1)
        # (6, k, n), by powers of (t - begin)/length.
        self._coefficients = np.array((
            y0, p, u,
            10.0 * rise - 6.0 * p - 4.0 * q - 3.0 * u + v,
            -15.0 * rise + 8.0 * p + 7.0 * q + 3.0 * u - 2.0 * v,
            6.0 * rise - 3.0 * p - 3.0 * q - u + v))

    def at(self, numbers: NDArray[np.int64], t: Rows) -> Rows:
        """Return the unknowns (k, m) at m times [s] in the steps of these numbers."""
        s = (t - self._begin[numbers]) / self._length[numbers]
        c0, c1, c2, c3, c4, c5 = self._coefficients.take(numbers, axis=2)
        unknowns: Rows = ((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
        return unknowns


def _components(vectors: Sequence[float] | Sequence[Vector]) -> Rows:
    """Return rows (k, n) of n vectors, or (n,) of floats; a complex component makes two rows."""
    columns: NDArray[np.generic] = np.array(vectors)
    return np.ascontiguousarray(columns.view(np.float64).T)
