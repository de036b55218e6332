# SPDX-License-Identifier: Apache-2.0
"""Makes a trajectory of what a file has: all parts at the same, evenly spaced times."""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from spinning_top_sim.grade.fit import EXACT, LARGEST, whiteness
from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.grade.trajectory import Trajectory
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.motion_files import Recorded

SAME_S = 1e-6               # between two stamps of one time
EVEN = 1e-4                 # share of the interval by which evenly spaced samples may be off
GAP = 2.5                   # intervals that are a gap
DEGREE = 5                  # of the splines between samples
COARSE = 0.5                # turned from one sample to the next [rad]: splines fail


def trajectory_of(recorded: Recorded, motion: ExactSolution, begin: float = 0.0) -> Trajectory:
    """
    Return all parts at the times of the one with most samples, made evenly spaced.

    motion : about which attitudes are interpolated; white noise about it is taken away
    begin : time of its start; times are counted from there [s]
    """
    def turns(times: Reals) -> Rotation:
        return Rotation.from_quat(motion.states_at_seconds(times).quaternion)

    notes = recorded.notes
    parts = {name: _longest(name, at - begin, values, notes)
             for name, (at, values) in recorded.parts.items()}
    times, attitudes = parts.pop('attitudes')
    for name, (at, _) in [*parts.items()]:
        if min(at[-1], times[-1]) - max(at[0], times[0]) < 0.5 * np.ptp(times):
            notes.append(f'{name}: not at the times of the attitudes, left out')
            del parts[name]
    even = _even([times, *(at for at, _ in parts.values())], notes)
    error = turns(times).inv() * Rotation.from_quat(np.roll(attitudes, -1, axis=1))
    level, white = whiteness(error.as_rotvec().T)
    found = turns(even)
    if white and EXACT < level < LARGEST:
        notes.append(f'the attitudes are exact but for noise of {level:.3g} rad: graded without '
                     'it')
    else:
        found = found * (error if np.array_equal(even, times) else
                         RotationSpline(times, error)(even))
    angle = float(abs(motion.start.l3 / motion.top.lambda3)) * (even[1] - even[0])
    readings = {}
    for name, (at, values) in parts.items():
        if len(at) == len(even) and np.max(np.abs(at - even)) < SAME_S:
            readings[name] = values
        elif angle < COARSE:
            readings[name] = make_interp_spline(at, values, DEGREE)(even)
        else:
            notes.append(f'{name}: not at the times of the attitudes, and the spin is '
                         f'{angle:.2g} rad from one sample to the next: not compared')
    return Trajectory.of({'attitudes': np.roll(found.as_quat(), 1, axis=1), **readings,
                          'covariance': recorded.covariance or None}, even)


def _longest(name: str, at: Reals, values: Reals, notes: list[str]) -> tuple[Reals, Reals]:
    """Return the longest part without a gap."""
    steps = np.diff(at)
    ends = np.array([0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1), len(at)])
    if len(ends) > 2:
        notes.append(f'{name}: the longest part without a gap is used')
    chosen = slice(*ends[np.argmax(np.diff(ends)):][:2].tolist())
    return at[chosen], values[chosen]


def _even(times: Sequence[Reals], notes: list[str]) -> Reals:
    """Return evenly spaced times within all of these, as many as most of them have."""
    begin, end = max(at[0] for at in times) - SAME_S, min(at[-1] for at in times) + SAME_S
    grid = max((at[(at >= begin) & (at <= end)] for at in times), key=len)
    even: Reals = np.linspace(grid[0], grid[-1], len(grid))
    if np.max(np.abs(even - grid)) < EVEN * (even[1] - even[0]):
        return grid
    notes.append('stamps are not evenly spaced: interpolated')
    return even
