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
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.files import trajectory_of
from spinning_top_sim.grade.fit import Fit, far_start, fit, start_of
from spinning_top_sim.grade.grader import grade_trajectory
from spinning_top_sim.grade.scenes import Body
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, motion_files, scene_file

DENSITIES = 'gyroscope_noise_density', 'accelerometer_noise_density'


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return cli.run('grade', __doc__, argv, add_arguments, _run)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('file', type=Path, help='.mcap, .csv, .parquet or .npz')
    scene_file.add_parameters(parser)
    add('--fit', action='store_true', help='fit top and start to the attitudes, or only the start '
        'of a top that is given; the default where nothing is given and the file tells nothing')
    add('--fit-imu', action='store_true', help='the same, and mounting, place and stamps of the '
        'IMU to its readings')
    add('--lever-arm', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
        help='position of the IMU in the body [m]; default: 0 0 0, or as the parameters tell')
    add('--topic', help='topic of the attitudes in a log; default: the first that has some')
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    recorded = motion_files.read(arguments.file, arguments.topic)
    body, state, found = _motion(arguments, recorded)
    trajectory = trajectory_of(recorded, ExactSolution(body, state), found.begin if found else 0.0)
    report = grade_trajectory(trajectory, body, state, subject=arguments.file.name)
    if arguments.json:
        print(json.dumps({**report.as_dict(), 'notes': recorded.notes,
                          'fit': found and found.as_dict()}, indent=2))
    else:
        fitted = found.lines() if found else ()
        for line in (*recorded.notes, *fitted, *str(report).splitlines()):
            cli.print_line(line)
    return cli.OK if report.passed and (found is None or found.reached) else cli.FAILED


def _given(arguments: argparse.Namespace) -> dict[str, object]:
    """Return the parameters that are given.  Raises ValueError for a start beside --fit."""
    given = scene_file.given(arguments)
    starts = [name for name in given if name.startswith(('initial.', 'spin.'))]
    if starts and (arguments.fit or arguments.fit_imu):
        raise ValueError(f'--fit finds the start: {", ".join(starts)} must not be given')
    return given


def _motion(arguments: argparse.Namespace,
            recorded: motion_files.Recorded) -> tuple[Body, State, Fit | None]:
    """Return top with IMU and start, as given or as fitted, and the fit."""
    given, fits = _given(arguments), arguments.fit or arguments.fit_imu
    known = None if given else recorded.parameters
    values = known or parameters.checked(given)
    x, y, z, w = Rotation.from_euler('xyz', values['imu.rpy']).as_quat().tolist()
    top, start = parameters.top_of(values), parameters.start_state(values)
    body = Body.of(
        top, lever_arm=tuple(arguments.lever_arm or values['imu.lever_arm']),
        mounting=(w, x, y, z), field=tuple(values['mag.field']),
        **{name: given.get(f'imu.{name}') for name in DENSITIES})
    if fits or not (given or known):
        found = fit(recorded.parts, lambda1=top.lambda1, gravity=top.gravity,
                    imu=arguments.fit_imu)
        fitted, start = found.body(body), found.start
        if arguments.lever_arm or 'imu.lever_arm' in given:
            fitted = replace(fitted, lever_arm=body.lever_arm)
        if any(name.startswith('top.') for name in given):
            fitted = replace(fitted, **vars(top))
            start = start_of(found, recorded.parts, top)
        return fitted, start, found
    if off := far_start(recorded.parts, top, start):
        raise ValueError(f'{arguments.file}: the parameters do not fit the trajectory: {off}; '
                         '--fit finds top and start')
    return body, start, None


if __name__ == '__main__':
    sys.exit(main())
