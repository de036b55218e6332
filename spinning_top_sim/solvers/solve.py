# SPDX-License-Identifier: Apache-2.0
"""The choice among the solvers, and `solve`, which reads a motion at times."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spinning_top_sim.installation import needed
from spinning_top_sim.physics.regimes import axis_rests
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top, shown
from spinning_top_sim.solvers.equations import EulerMotion, TransportMotion
from spinning_top_sim.solvers.motion import Motion
from spinning_top_sim.solvers.vertical import Posture

# Doubles do not hold the squares of larger rates [rad/s]; those of the spin are smaller anyway.
FASTEST_AXIS = 1e100
# Called with the top, the start, its posture, rtol and atol.
EQUATIONS: Mapping[str, Callable[..., Motion]] = {
    'transport': TransportMotion, 'euler': EulerMotion}


def _closed_form(top: Top, start: State, *_: Any) -> Motion:
    with needed("method = 'exact'"):
        from spinning_top_sim.solvers.exact import ExactSolution  # noqa: PLC0415 - gmpy2
    return ExactSolution(top, start)


# Called with the top, the start, the name of equations, and what EQUATIONS take besides these.
METHODS: Mapping[str, Callable[..., Motion]] = {
    'rk45': lambda top, start, equations, *others: EQUATIONS[equations](top, start, *others),
    'exact': _closed_form}


def motion_of(top: Top, start: State | Posture, *, method: str, equations: str = 'transport',
              rtol: Any = 1e-11, atol: Any = None) -> Motion:
    """
    Return the motion that begins at `start`; `solve` explains the settings.

    Motions without torque or nutation take no steps: 'rk45' leaves them to the closed form, where
    that can hold them and gmpy2 is installed.

    start : a posture is in doubles

    Raises ValueError for a bad setting, or a motion that doubles cannot hold.
    """
    atol = 0.1 * rtol if atol is None and isinstance(rtol, float) else atol
    for name, value, allowed in (('method', method, METHODS), ('equations', equations, EQUATIONS)):
        if value not in allowed:
            raise ValueError(f'{name} = {value!r}: must be one of {", ".join(allowed)}')
    for name, value, least in (('rtol', rtol, 1e-14), ('atol', atol, 0.0)):
        if not (isinstance(value, int | float) and least <= value <= 1e-2):
            raise ValueError(f'{name} = {shown(value)}: must be in [{least:g}, 1e-2]')
    try:
        now = Posture.of(top, start)
        if not abs(now.transverse) <= FASTEST_AXIS:
            raise OverflowError
    except ArithmeticError:
        raise ValueError(f'{top} from {start}: the rate of the axis must be at most '
                         f'{FASTEST_AXIS:g} rad/s') from None
    if isinstance(start, Posture):
        start = now.state(top)
    # Rounded to a state beside a pole, a posture that moves a little would rest.
    elif method == 'rk45' and equations == 'transport' and (
            top.gravity_torque == 0.0 or axis_rests(top, start)):
        with suppress(ImportError, ValueError):
            return _closed_form(top, start)
    return METHODS[method](top, start, equations, now, rtol, atol)


def solve(top: Top, start: State, t: ArrayLike, *, method: str = 'exact', rtol: float = 1e-11,
          atol: float | None = None, equations: str = 'transport') -> States:
    """
    Return the motion of a top that is in the state `start` at t = 0, at the times t.

    Parameters
    ----------
    top : Top
        The top to simulate.
    start : State
        The state at t = 0.
    t : (n,) array_like
        Times [s]: in any order and of any sign for 'exact', from 0 on and never decreasing for
        'rk45'.
    method : {'exact', 'rk45'}
        The closed form, or Dormand-Prince steps, which the 'transport' equations take only where
        the axis moves and has a torque.
    rtol, atol : float
        Tolerated error of a step; atol is rtol/10 by default.
    equations : {'transport', 'euler'}
        Equations of motion used by 'rk45': regular everywhere, or those of the source in Euler
        angles, for study.

    Returns
    -------
    States
        Its columns are computed when they are first asked for.

    Raises
    ------
    TypeError
        If `top` is no Top or `start` no State.
    ImportError
        If 'exact' misses gmpy2.
    ValueError
        Naming the argument, its value and what is allowed.
    IntegrationError
        Where the 'euler' equations cannot go on, a step collapses, or the last time is more than
        2e6 steps of the present size away.

    Examples
    --------
    >>> top = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
    >>> motion = solve(top, State(theta=0.5, l3=1.6, lz=1.3), [0.0, 0.5, 1.0])
    >>> motion
    <States by 'exact': 3 times from 0 to 1 s>
    >>> motion.theta.round(6)
    array([0.5     , 0.630905, 0.86732 ])
    """
    if not (isinstance(top, Top) and isinstance(start, State)):
        raise TypeError(f'solve({type(top).__name__}, {type(start).__name__}, ...): must be '
                        'solve(top, start, t) with a Top and a State')
    try:
        times = np.asarray(np.ma.filled(t, math.nan)).astype(np.float64, casting='same_kind')
    except (TypeError, ValueError) as error:
        raise ValueError(f't = {shown(t)}: must be (n,) numbers, in s') from error
    if times.ndim != 1:
        raise ValueError(f't has shape {times.shape}: must be (n,)')
    for at in np.flatnonzero(~np.isfinite(times)):
        raise ValueError(f't[{at}] = {times[at]} s: must be finite')
    if method != 'exact':
        before = np.concatenate(([0.0], times[:-1]))
        for at in np.flatnonzero(times < before):
            raise ValueError(f't[{at}] = {times[at]} s after {before[at]} s: must not decrease '
                             f'with method = {method!r}')
    motion = motion_of(top, start, method=method, equations=equations, rtol=rtol, atol=atol)
    return motion.states(times)
