# SPDX-License-Identifier: Apache-2.0
"""How a state moves in time: one protocol, a file per method.  numpy at most; no ROS, no I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.propagator import METHODS
from spinning_top_sim.solvers.rk45 import check_settings, rk45

if TYPE_CHECKING:
    from spinning_top_sim.solvers.motion import Motion


def solve(top: Top, start: State, t: Any, *, method: str = 'exact', rtol: float = 1e-11,
          atol: float | None = None, equations: str = 'transport') -> Motion:
    """
    Return the motion of a top that is in the state `start` at t = 0, at the times t.

    t: (n,) float64 [s]; any order and sign for 'exact', from 0 on and never decreasing for 'rk45'
    method: 'exact' (closed form), or 'rk45' (Dormand-Prince steps with tolerance rtol and atol,
        by default rtol/10, in the form `equations`: 'transport' or 'euler')
    Raises ValueError naming the argument, its value and what is allowed; IntegrationError where
    the 'euler' equations cannot go on.
    """
    # numpy is imported by who wants arrays: a node steps without it.
    import numpy as np  # noqa: PLC0415

    from spinning_top_sim.solvers.motion import ExactMotion, SteppedMotion  # noqa: PLC0415

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
    check_settings(equations, rtol, atol)
    if method not in METHODS:
        raise ValueError(f'method = {method!r}: must be one of {", ".join(METHODS)}')
    if method == 'exact':
        return ExactMotion(top, start, times)
    if len(times) and times[0] < 0.0:
        raise ValueError(f"t[0] = {times[0]} s: must be >= 0 with method = 'rk45'")
    falls = np.flatnonzero(np.diff(times) < 0.0)
    if len(falls):
        at = int(falls[0])
        raise ValueError(f't[{at + 1}] = {times[at + 1]} s after {times[at]} s: must not '
                         "decrease with method = 'rk45'")
    stepped = rk45(top, start, equations=equations, rtol=rtol, atol=atol)
    return SteppedMotion(top, start, times, stepped)
