# SPDX-License-Identifier: Apache-2.0
"""How a state moves in time, a file per method.  numpy at most; no ROS, no I/O."""

import numpy as np
from numpy.typing import ArrayLike

from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.propagator import propagate


def solve(top: Top, start: State, t: ArrayLike, *, method: str = 'exact', rtol: float = 1e-11,
          atol: float | None = None, equations: str = 'transport') -> States:
    """
    Return the motion of a top that is in the state `start` at t = 0, at the times t.

    Parameters
    ----------
    t : (n,) times [s]: in any order and of any sign for 'exact', from 0 on and never decreasing
        for 'rk45'
    method : 'exact', the closed form, or 'rk45', Dormand-Prince steps
    rtol, atol : tolerated error of a step; atol is rtol/10 by default
    equations : of the steps: 'transport', regular everywhere, or 'euler', to the letter of the
        paper, for study

    Returns
    -------
    States, whose columns are computed when they are first asked for

    Raises
    ------
    ValueError : naming the argument, its value and what is allowed
    IntegrationError : where the 'euler' equations cannot go on
    """
    try:
        given = np.asarray(t)
        if given.dtype.kind in 'cmM':           # complex, timedelta64, datetime64
            raise TypeError(f'{given.dtype} is no number of seconds')
        times = given.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f't = {t!r}: must be (n,) numbers, in s') from error
    if times.ndim != 1:
        raise ValueError(f't has shape {times.shape}: must be (n,)')
    for at in np.flatnonzero(~np.isfinite(times))[:1]:
        raise ValueError(f't[{at}] = {times[at]} s: must be finite')
    motion = propagate(top, start, method=method, equations=equations, rtol=rtol,
                       atol=0.1 * rtol if atol is None else atol)
    if method == 'rk45':
        before = np.concatenate(([0.0], times[:-1]))
        for at in np.flatnonzero(times < before)[:1]:
            raise ValueError(f't[{at}] = {times[at]} s after {before[at]} s: must not decrease '
                             "with method = 'rk45'")
    return motion.states_at_seconds(times)
