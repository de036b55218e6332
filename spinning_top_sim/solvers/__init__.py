# SPDX-License-Identifier: Apache-2.0
"""How a state moves in time: one protocol, a file per method.  numpy at most; no ROS, no I/O."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.propagator import check_settings, propagate


def solve(top: Top, start: State, t: ArrayLike, *, method: str = 'exact', rtol: float = 1e-11,
          atol: float | None = None, equations: str = 'transport') -> States:
    """
    Return the motion of a top that is in the state `start` at t = 0, at the times t.

    Parameters
    ----------
    top : Top
    start : State
    t : (n,) array_like of float64
        Times [s]: in any order and of any sign for 'exact', from 0 on and never decreasing for
        'rk45'.
    method : {'exact', 'rk45'}
        The closed form, or Dormand-Prince steps of tolerance rtol and atol.
    rtol, atol : float
        Tolerated error of a step; atol is rtol/10 by default.
    equations : {'transport', 'euler'}
        Of the steps: regular everywhere, or to the letter of the paper, for study.

    Returns
    -------
    States
        Its columns are computed when they are first asked for.

    Raises
    ------
    ValueError
        Naming the argument, its value and what is allowed.
    IntegrationError
        Where the 'euler' equations cannot go on.
    """
    try:
        times = np.asarray(t, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f't = {t!r}: must be (n,) numbers, in s') from error
    if times.ndim != 1:
        raise ValueError(f't has shape {times.shape}: must be (n,)')
    if not np.all(np.isfinite(times)):
        at = int(np.argmin(np.isfinite(times)))
        raise ValueError(f't[{at}] = {times[at]} s: must be finite')
    atol = 0.1 * rtol if atol is None else atol
    check_settings(method, equations, rtol, atol)
    if method == 'rk45':
        if len(times) and times[0] < 0.0:
            raise ValueError(f"t[0] = {times[0]} s: must be >= 0 with method = 'rk45'")
        falls = np.flatnonzero(np.diff(times) < 0.0)
        if len(falls):
            at = int(falls[0])
            raise ValueError(f't[{at + 1}] = {times[at + 1]} s after {times[at]} s: must not '
                             "decrease with method = 'rk45'")
    motion = propagate(top, start, method=method, equations=equations, rtol=rtol, atol=atol)
    return motion.states_at_seconds(times)
