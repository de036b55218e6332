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


class IntegrationError(RuntimeError):
    """The integration cannot go on; the message says where, why and what to do instead."""


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


def interpolate(steps: Sequence[Step], second_derivative: Callable[[Rows, Rows], Rows],
                numbers: NDArray[np.int64], t: Rows) -> Rows:
    """Return the unknowns (k, n) at n times [s] in the steps of these numbers."""
    begin, y0, first0, end, y1, first1 = map(components, zip(*steps, strict=True))
    h = end - begin
    rise, p, q = y1 - y0, h * first0, h * first1
    u = 0.5 * h * h * second_derivative(y0, first0)
    v = 0.5 * h * h * second_derivative(y1, first1)
    # (6, k, steps), by powers of (t - begin)/length.
    coefficients = np.array((
        y0, p, u,
        10.0 * rise - 6.0 * p - 4.0 * q - 3.0 * u + v,
        -15.0 * rise + 8.0 * p + 7.0 * q + 3.0 * u - 2.0 * v,
        6.0 * rise - 3.0 * p - 3.0 * q - u + v))
    s = (t - begin[numbers]) / np.where(h > 0.0, h, 1.0)[numbers]
    c0, c1, c2, c3, c4, c5 = coefficients.take(numbers, axis=2)
    unknowns: Rows = ((((c5 * s + c4) * s + c3) * s + c2) * s + c1) * s + c0
    return unknowns


def components(vectors: Sequence[float] | Sequence[Vector]) -> Rows:
    """Return rows (k, n) of n vectors, or (n,) of floats; a complex component makes two rows."""
    columns: NDArray[np.generic] = np.array(vectors)
    return np.ascontiguousarray(columns.view(np.float64).T)
