# SPDX-License-Identifier: Apache-2.0
"""
Adaptive Dormand-Prince 5(4) steps in plain Python numbers: the method of MATLAB's ODE45.

Tableau: Dormand & Prince, "A family of embedded Runge-Kutta formulae", J. Comp. Appl. Math. 6
(1980) 19-26, table 2 (RK5(4)7M).  Step control: Hairer, Norsett & Wanner, *Solving Ordinary
Differential Equations I*, 2nd ed., sect. II.4.  Between steps the solution is the quintic
Hermite polynomial through value, slope and curvature at both ends: its error is O(h^6) like that
of a step, where the usual 4th-order continuous extension would spoil the step's accuracy; the
curvatures come from the equations themselves and only where a step is sampled at all.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, Protocol

# One state: a tuple of n floats or complex numbers.
Vector = tuple[Any, ...]

STAGES: tuple[tuple[Fraction, ...], ...] = (
    (Fraction(1, 5),),
    (Fraction(3, 40), Fraction(9, 40)),
    (Fraction(44, 45), Fraction(-56, 15), Fraction(32, 9)),
    (Fraction(19372, 6561), Fraction(-25360, 2187), Fraction(64448, 6561), Fraction(-212, 729)),
    (Fraction(9017, 3168), Fraction(-355, 33), Fraction(46732, 5247), Fraction(49, 176),
     Fraction(-5103, 18656)),
    (Fraction(35, 384), Fraction(0), Fraction(500, 1113), Fraction(125, 192),
     Fraction(-2187, 6784), Fraction(11, 84)),
)
NODES = (Fraction(0), Fraction(1, 5), Fraction(3, 10), Fraction(4, 5), Fraction(8, 9),
         Fraction(1), Fraction(1))
FOURTH_ORDER = (Fraction(5179, 57600), Fraction(0), Fraction(7571, 16695), Fraction(393, 640),
                Fraction(-92097, 339200), Fraction(187, 2100), Fraction(1, 40))
ERROR = tuple(fifth - fourth for fifth, fourth in zip((*STAGES[-1], Fraction(0)), FOURTH_ORDER,
                                                      strict=True))

# Hairer et al. eq. (4.13): aim a little below the tolerance and change the step within limits.
SAFETY = 0.9
SHRINK, GROW = 0.2, 5.0
# A step of fewer units in the last place of t is a collapse, not progress.
SMALLEST_STEP_ULPS = 16


class IntegrationError(RuntimeError):
    """The integration cannot go on; the message says where, why and what to do instead."""


class Form(Protocol):
    """Equations of motion y' = f(y) in some chart, with what the step control needs to know."""

    @property
    def name(self) -> str:
        """Of the equations."""

    @property
    def number(self) -> type:
        """Of the unknowns: float or complex."""

    def rates(self, *y: Any) -> Vector:
        """Return y'."""

    def curvatures(self, y: Vector, rates: Vector) -> Vector:
        """Return y'' from y and y'."""

    def project(self, y: Vector) -> Vector:
        """Return y moved back onto the motion's invariants, or as it is."""

    def error(self, y: Vector, y_new: Vector, difference: Vector) -> float:
        """Return the largest error estimate over what is tolerated: a step passes at <= 1."""

    def check_step(self, y: Vector, y_new: Vector) -> None:
        """Raise IntegrationError if a step that passed cannot be trusted all the same."""


StepFunction = Callable[..., tuple[Vector, Vector, Vector]]


@functools.cache
def unrolled_step(size: int, number: type) -> StepFunction:
    """
    Return step(f, h, y, k1) -> (y_new, k7, error estimate) for vectors of `size` numbers.

    The loops over stages and components are written out once from the tableau, as source text:
    plain expressions on local names take a third of the time of loops over lists.
    """
    literal = repr if number is float else (lambda x: f'({x!r}+0j)')

    def combination(coefficients: tuple[Fraction, ...], component: int) -> str:
        return ' + '.join(f'{literal(float(c))}*k{stage}_{component}'
                          for stage, c in enumerate(coefficients, start=1) if c)

    def names(stem: str) -> str:
        return ''.join(f'{stem}_{i}, ' for i in range(size))

    lines = ['def step(f, h, y, k1):', f'    {names("y")}= y', f'    {names("k1")}= k1',
             f'    h = {"h" if number is float else "complex(h)"}']
    for stage, coefficients in enumerate(STAGES[:-1], start=2):
        arguments = ', '.join(f'y_{i} + h*({combination(coefficients, i)})' for i in range(size))
        lines.append(f'    {names(f"k{stage}")}= f({arguments})')
    lines.extend(f'    z_{i} = y_{i} + h*({combination(STAGES[-1], i)})' for i in range(size))
    lines.append(f'    {names("k7")}= k7 = f({names("z")})')
    estimate = ', '.join(f'h*({combination(ERROR, i)})' for i in range(size))
    lines.append(f'    return ({names("z")}), k7, ({estimate},)')
    scope: dict[str, Any] = {}
    exec('\n'.join(lines), scope)
    return scope['step']


class DenseStep:
    """
    One accepted step, to be read anywhere between its ends.

    t0, t1: the ends [s];  y0, y1: the states there;  slope0, slope1: their derivatives
    """

    __slots__ = ('_form', '_polynomial', 'slope0', 'slope1', 't0', 't1', 'y0', 'y1')

    def __init__(self, form: Form, t0: float, y0: Vector, slope0: Vector,
                 t1: float, y1: Vector, slope1: Vector) -> None:
        self._form = form
        self.t0, self.y0, self.slope0 = t0, y0, slope0
        self.t1, self.y1, self.slope1 = t1, y1, slope1
        self._polynomial: list[tuple[Any, ...]] | None = None

    def interpolate(self, t: float) -> Vector:
        """Return y at t in [t0, t1] [s]; the ends exactly."""
        if t >= self.t1:
            return self.y1
        s = (t - self.t0) / (self.t1 - self.t0)
        return tuple([((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
                      for c0, c1, c2, c3, c4, c5 in self._polynomial or self.coefficients])

    @property
    def coefficients(self) -> list[tuple[Any, ...]]:
        """Of the quintic in s = (t - t0)/h, one tuple a component."""
        if self._polynomial is None:
            self._polynomial = self._hermite()
        return self._polynomial

    def _hermite(self) -> list[tuple[Any, ...]]:
        h = self.t1 - self.t0
        bend0 = self._form.curvatures(self.y0, self.slope0)
        bend1 = self._form.curvatures(self.y1, self.slope1)
        rows = []
        for a, b, k0, k1, c0, c1 in zip(self.y0, self.y1, self.slope0, self.slope1, bend0, bend1,
                                        strict=True):
            rise, p, q = b - a, h * k0, h * k1
            u, v = 0.5 * h * h * c0, 0.5 * h * h * c1
            rows.append((a, p, u,
                         10.0 * rise - 6.0 * p - 4.0 * q - 3.0 * u + v,
                         -15.0 * rise + 8.0 * p + 7.0 * q + 3.0 * u - 2.0 * v,
                         6.0 * rise - 3.0 * p - 3.0 * q - u + v))
        return rows


class Integrator:
    """
    Takes steps forward from t = 0.

    newest: the latest step (one of no length before the first);  steps, rejected, evaluations:
    counts
    """

    def __init__(self, form: Form, start: Vector, first_step: float) -> None:
        self.form = form
        self._step = unrolled_step(len(start), form.number)
        start = form.project(start)
        slope = form.rates(*start)
        self.newest = DenseStep(form, 0.0, start, slope, 0.0, start, slope)
        self._next_step = first_step
        self.steps = self.rejected = 0
        self.evaluations = 1

    def step(self) -> DenseStep:
        """Take one accepted step.  Raises IntegrationError where none can be taken."""
        form, newest = self.form, self.newest
        t, y, slope = newest.t1, newest.y1, newest.slope1
        grow = GROW
        while True:
            end = t + self._next_step
            h = end - t                         # what the sum really made of it
            if not h > SMALLEST_STEP_ULPS * math.ulp(t) or not math.isfinite(end):
                raise IntegrationError(
                    f'the step size collapsed to {self._next_step:.3g} s at t = {t:.9g} s '
                    f'({form.name} equations)')
            y_new, slope_new, difference = self._step(form.rates, h, y, slope)
            self.evaluations += 6
            error = form.error(y, y_new, difference)
            if error <= 1.0:
                break
            # A NaN compares false everywhere: it lands here and shrinks the step until collapse.
            self.rejected += 1
            grow = 1.0
            shrink = SAFETY * error ** -0.2 if error < math.inf else SHRINK
            self._next_step = h * max(SHRINK, shrink)
        form.check_step(y, y_new)
        factor = SAFETY * error ** -0.2 if error > 0.0 else grow
        self._next_step = h * min(grow, max(SHRINK, factor))
        self.steps += 1
        # First same as last: the projection moves y by less than the step's own error, so the
        # slope at the unprojected end serves the next step too.
        self.newest = DenseStep(form, t, y, slope, end, form.project(y_new), slope_new)
        return self.newest
