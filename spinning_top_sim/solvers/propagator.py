# SPDX-License-Identifier: Apache-2.0
"""The choice among the solvers, and `solve`, which reads a motion at times."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spinning_top_sim.physics.pivot import Fractions
from spinning_top_sim.physics.regimes import axis_rests
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top, shown
from spinning_top_sim.solvers.dormand_prince import SteppedMotion
from spinning_top_sim.solvers.euler import EulerMotion
from spinning_top_sim.solvers.exact import ClosedForm, ExactSolution
from spinning_top_sim.solvers.theta_values import LARGEST_NUMBER
from spinning_top_sim.solvers.transport import TransportMotion
from spinning_top_sim.solvers.vertical import (
    AcceleratedMotion,
    Posture,
    Vertical,
    about_vertical,
    posture_of,
    rounded,
)

METHODS = ('rk45', 'exact')
EQUATIONS = ('transport', 'euler')
# A motion from its start at t = 0; `SteppedMotion` says what the members do.
Motion = ClosedForm | SteppedMotion


def propagate(top: Top, start: State, *, method: str, equations: str = 'transport',
              rtol: float = 1e-11, atol: float = 1e-12) -> Motion:
    """
    Return the motion that begins at `start`; `solve` explains the settings.

    Motions without torque or nutation take no steps: 'rk45' hands them to the closed form too.
    The transport equations scale their unknowns to 1 and tolerate atol + rtol; the Euler equations
    tolerate atol + rtol |angle|.

    Raises ValueError for a bad setting, or a motion that doubles cannot hold, and IntegrationError
    if the Euler equations cannot start.
    """
    if method not in METHODS:
        raise ValueError(f'method = {method!r}: must be one of {", ".join(METHODS)}')
    if equations not in EQUATIONS:
        raise ValueError(f'equations = {equations!r}: must be one of {", ".join(EQUATIONS)}')
    if not 1e-14 <= rtol <= 1e-2:
        raise ValueError(f'rtol = {rtol!r}: must be in [1e-14, 1e-2]')
    if not 0.0 <= atol <= 1e-2:
        raise ValueError(f'atol = {atol!r}: must be in [0, 1e-2]')
    if method == 'exact':
        return ExactSolution(top, start)
    try:
        with np.errstate(over='raise', divide='raise', invalid='raise'):
            motion = _stepped(top, start, equations, rtol, atol)
            first = motion.states(range(1))
            held = all(abs(float(column[0])) <= LARGEST_NUMBER for column in (
                first.energy, first.phi_dot, first.psi_dot, *first.angular_acceleration.T))
    except ArithmeticError:
        held = False
    if not held:
        raise ValueError(f'{top} from {start}: the constants are too far apart in size for '
                         'doubles to hold the motion')
    return motion


def propagate_accelerated(top: Top, start: State | Posture, acceleration: Fractions, *,
                          method: str, **settings: Any) -> tuple[Motion, Vertical]:
    """
    Return the motion while the pivot accelerates uniformly, and the vertical that it is about.

    acceleration : of the pivot in the world [m/s^2]
    method, settings : as of `propagate`
    """
    posture = posture_of(top, start) if isinstance(start, State) else start
    if method == 'exact':
        motion = AcceleratedMotion(top, posture, acceleration)
        return motion, motion.vertical
    vertical, precise_start = about_vertical(top, posture, acceleration)
    return propagate(vertical.top, rounded(precise_start), method=method, **settings), vertical


def _stepped(top: Top, start: State, equations: str, rtol: float, atol: float) -> Motion:
    if equations == 'euler':
        return EulerMotion(top, start, rtol, atol)
    if top.gravity_torque == 0.0 or axis_rests(top, start):
        with suppress(ValueError):      # beyond its range, steps go on
            return ExactSolution(top, start)
    return TransportMotion(top, start, rtol, atol)


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
    ValueError
        Naming the argument, its value and what is allowed.
    IntegrationError
        Where the 'euler' equations cannot go on, a step collapses, or the last time is more than
        1e7 steps of the present size away.

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
        times = np.asarray(t).astype(np.float64, casting='same_kind')
    except (TypeError, ValueError) as error:
        raise ValueError(f't = {shown(t)}: must be (n,) numbers, in s') from error
    if times.ndim != 1:
        raise ValueError(f't has shape {times.shape}: must be (n,)')
    for at in np.flatnonzero(~np.isfinite(times)):
        raise ValueError(f't[{at}] = {times[at]} s: must be finite')
    motion = propagate(top, start, method=method, equations=equations, rtol=rtol,
                       atol=0.1 * rtol if atol is None else atol)
    before = np.concatenate(([0.0], times[:-1]))
    for at in np.flatnonzero(times < before) if method != 'exact' else ():
        raise ValueError(f't[{at}] = {times[at]} s after {before[at]} s: must not decrease with '
                         f'method = {method!r}')
    return motion.states_at_seconds(times)
