# SPDX-License-Identifier: Apache-2.0
"""
Grade the trajectory of a simulator: its motion beside the exact one, its IMU
beside its motion.

  spinning-top grade run.mcap                       # a log of this package
  spinning-top grade poses.csv --scene looping      # top and start as given
  spinning-top grade poses.csv --fit                # top and start are fitted

exit codes:
  0    no fault was found
  1    the simulator has faults, or the file cannot be read
  2    wrong arguments, or a file without what is needed
  130  interrupted
What a file may contain is in docs/grade_files.md.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from spinning_top_sim.grade import fit as fitting
from spinning_top_sim.grade.grader import grade_trajectory
from spinning_top_sim.grade.motion import LEAST_SAMPLES, Trajectory
from spinning_top_sim.grade.scenes import Body, Reals, rotation_of
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, motion_files, scene_file
from spinning_top_sim.tools.motion_files import Recorded

SAME_S = 1e-6               # between two stamps of one time
EVEN = 1e-4                 # share of the interval by which evenly spaced samples may be off
GAP = 2.5                   # intervals that are a gap
DEGREE = 5                  # of the splines between samples
COARSE = 0.5                # turned from one sample to the next [rad]: splines fail


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('file', type=Path, help='.mcap, .csv, .parquet or .npz')
    scene_file.add_parameters(parser)
    add('--fit', action='store_true', help='fit top and start to the attitudes, or only the start '
        'of a top that is given; the default where neither arguments nor file tell them')
    add('--fit-imu', action='store_true', help='the same, and mounting, place and stamps of the '
        'IMU to its readings')
    add('--lever-arm', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
        help='position of the IMU in the body [m]; default: 0 0 0, or as the parameters tell')
    add('--topic', help='topic of the attitudes in a log; default: the first that has some')
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    recorded = motion_files.read(arguments.file, arguments.topic)
    body, state, found = _motion(arguments, recorded)
    trajectory = trajectory_of(recorded, ExactSolution(body, state),
                               recorded.parts['attitudes'][0][0] if found else 0.0)
    report = grade_trajectory(trajectory, body, state, subject=arguments.file.name)
    if arguments.json:
        print(json.dumps({**report.as_dict(), 'notes': recorded.notes,
                          'fit': found and found.as_dict()}, indent=2))
    else:
        for line in (*recorded.notes, *(found.lines() if found else ()),
                     *str(report).splitlines()):
            cli.print_line(line)
    return cli.OK if report.passed else cli.FAILED


def _motion(arguments: argparse.Namespace,
            recorded: Recorded) -> tuple[Body, State, fitting.Fit | None]:
    """Return top with IMU and start, as given or as fitted, and the fit."""
    given, fits = scene_file.given(arguments), arguments.fit or arguments.fit_imu
    if fits and (starts := [name for name in given if name.startswith(('initial.', 'spin.'))]):
        raise ValueError(f'--fit finds the start: {", ".join(starts)} must not be given')
    # A scene is another top and start; anything else changes what the file tells.
    known = None if arguments.scene or arguments.params else recorded.parameters
    values = parameters.checked({**(known or {}), **given})
    x, y, z, w = Rotation.from_euler('xyz', values['imu.rpy']).as_quat().tolist()
    top, start = parameters.top_of(values), parameters.start_state(values)
    body = Body.of(
        top, lever_arm=tuple(arguments.lever_arm or values['imu.lever_arm']),
        mounting=(w, x, y, z), field=tuple(values['mag.field']),
        **{name: given.get(f'imu.{name}') for name in (
            'gyroscope_noise_density', 'accelerometer_noise_density')})
    about_motion = known or any(name.startswith(('top.', 'initial.', 'spin.')) for name in given)
    if fits or not about_motion:
        return _motion_by_fit(arguments, recorded, given, body)
    if off := fitting.far_start(recorded.parts, top, start):
        raise ValueError(f'{arguments.file}: the parameters do not fit the trajectory: {off}; '
                         '--fit finds top and start')
    return body, start, None


def _motion_by_fit(arguments: argparse.Namespace, recorded: Recorded, given: Mapping[str, Any],
                   body: Body) -> tuple[Body, State, fitting.Fit]:
    """Return the same as fitted, but for the parts of `body` that are given."""
    try:
        found = fitting.fit(recorded.parts, lambda1=body.lambda1, gravity=body.gravity,
                            imu=arguments.fit_imu)
    except ValueError as error:
        raise ValueError(f'{arguments.file}: {error}') from error
    if arguments.fit_imu:
        body = replace(body, mounting=found.mounting, lever_arm=body.lever_arm if (
            arguments.lever_arm or 'imu.lever_arm' in given) else found.lever_arm)
    if any(name.startswith('top.') for name in given):
        return body, fitting.state_of_known_top(found, recorded.parts, body), found
    return replace(body, **vars(found.top)), found.start, found


def trajectory_of(recorded: Recorded, motion: ExactSolution, begin: float = 0.0) -> Trajectory:
    """
    Return all parts at the times of the IMU, else of the attitudes, made evenly spaced.

    motion : about which attitudes are interpolated; white noise about it is taken away
    begin : time of its start; times are counted from there [s]
    """
    def turns(times: Reals) -> Rotation:
        return Rotation.from_quat(motion.states_at_seconds(times).quaternion)

    notes = recorded.notes
    parts = {name: _longest(name, at - begin, values, notes)
             for name, (at, values) in recorded.parts.items()}
    times, attitudes = parts.pop('attitudes')
    sensors = [name for name in ('gyroscope', 'accelerations') if name in parts]
    begin, end = times[0] - SAME_S, times[-1] + SAME_S
    for name in dict.fromkeys([*sensors, *parts]):
        at = parts[name][0]
        both = max(at[0] - SAME_S, begin), min(at[-1] + SAME_S, end)
        if both[1] - both[0] < 0.5 * np.ptp(times):
            notes.append(f'{name}: not at the times of the others, left out')
            del parts[name]
        else:
            begin, end = both
    every = next((parts[name][0] for name in sensors if name in parts), times)
    even = _evenly(every[(every >= begin) & (every <= end)], notes)
    error = turns(times).inv() * rotation_of(attitudes)
    level, white = fitting.whiteness(error.as_rotvec().T)
    found = turns(even)
    if white and fitting.EXACT < level < fitting.LARGEST:
        notes.append(f'the attitudes are exact but for noise of {level:.3g} rad: graded without '
                     'it')
    else:
        found = found * RotationSpline(times, error)(even)
    angle = float(abs(motion.start.l3 / motion.top.lambda3)) * (even[1] - even[0])
    readings = {'attitudes': np.roll(found.as_quat(), 1, axis=1)}
    for name, (at, values) in parts.items():
        if angle < COARSE or (len(at) == len(even) and np.max(np.abs(at - even)) < SAME_S):
            readings[name] = make_interp_spline(at, values, DEGREE)(even)
        else:
            notes.append(f'{name}: not at the times of the attitudes, and the spin is '
                         f'{angle:.2g} rad from one sample to the next: not compared')
    return Trajectory.of({**readings, 'covariance': recorded.covariance}, even)


def _evenly(grid: Reals, notes: list[str]) -> Reals:
    """Return times, made evenly spaced.  Raises ValueError if they are too few."""
    if len(grid) < LEAST_SAMPLES:
        raise ValueError(f'{len(grid)} times at which there are attitudes and readings: must be '
                         f'{LEAST_SAMPLES} at least')
    even: Reals = np.linspace(grid[0], grid[-1], len(grid))
    if np.max(np.abs(even - grid)) < EVEN * (even[1] - even[0]):
        return grid
    notes.append('stamps are not evenly spaced: interpolated')
    return even


def _longest(name: str, at: Reals, values: Reals, notes: list[str]) -> tuple[Reals, Reals]:
    """Return the longest part without a gap."""
    gaps = np.flatnonzero(np.diff(at) > GAP * np.median(np.diff(at))) + 1
    if len(gaps):
        notes.append(f'{name}: the longest part without a gap is used')
    chosen = max(np.split(np.arange(len(at)), gaps), key=len)
    return at[chosen], values[chosen]


main = partial(cli.run, 'grade', __doc__, add_arguments, _run)
