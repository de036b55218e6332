# SPDX-License-Identifier: Apache-2.0
"""
Grade a recording: is this IMU that of this motion?  Of a top, is this motion right?

  spinning-top grade run.mcap                       # poses and readings of any body
  spinning-top grade run.csv --columns 't=stamp:ns, gx=gyro_x:deg/s, ...'
  spinning-top grade run.csv --scene looping        # also the motion of a top that is known

exit codes:
  0    no fault was found in what was judged
  1    there are faults, nothing was judged, or the file cannot be read
  2    wrong arguments, or a file that is not understood
  130  interrupted
docs/grade.md says what a file may contain.
"""

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim import solve
from spinning_top_sim.grade.bodies import grade_readings
from spinning_top_sim.grade.columns import DENSITIES, READINGS, Imu
from spinning_top_sim.grade.files import Recorded, read
from spinning_top_sim.grade.scenes import Body, Start
from spinning_top_sim.grade.simulators import EARLY, TOLERANCE, Judgement
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.tools import cli, conventions, scene_file
from spinning_top_sim.tools.kinematics import MOST, Smoothed, stretches
from spinning_top_sim.tools.report import Finding, Mark, Report, printed

START = 0.02            # angle to the start that is given, beyond which there is another [rad]
NOISES = 5.0            # standard deviations of noise by which an attitude may be off besides


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('file', type=Path, help='.mcap, .csv, .tum, .parquet or .npz; a folder of a bag or EuRoC')
    add('--columns', help='columns and units of a table, such as "t=stamp:ns, gx=gyro_x:deg/s", '
        'or a file with such a text')
    add('--topic', action='append', default=[], help='a topic of a log to read, of transforms '
        'TOPIC:CHILD; may be repeated; default: the only one of each kind')
    add('--lever-arm', dest='arm', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
        help='position of the IMU in the body [m]; default: found')
    scene_file.add_parameters(parser)
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    recorded = read(arguments.file, arguments.columns, arguments.topic)
    given: Mapping[str, Any] = scene_file.given(arguments)
    run = None if arguments.scene or arguments.params else recorded.run
    values = parameters.checked({**(run.values_in_effect if run else {}), **given})
    of_top = bool(run) or any(name.startswith(('top.', 'initial.', 'spin.'))
                              for name in given.keys() - {'top.gravity'})
    parts, at = recorded.parts, recorded.parts['attitudes'][0]
    if not of_top and READINGS.keys().isdisjoint(parts):
        raise ValueError(f'{arguments.file}: nothing to grade: no top (--scene) and no readings '
                         f"(--columns 'gx=COLUMN:UNIT, ...'); {'; '.join(recorded.notes)}")
    if of_top and not run:              # the pivot is at rest
        parts = {'positions': (at, np.zeros((len(at), 3))), **parts}
    known = values if run else given
    imu = Imu(lever_arm=arguments.arm or known.get('imu.lever_arm'), field=known.get('mag.field'),
              mounting=tuple(Rotation.from_euler('xyz', values['imu.rpy']).as_quat().tolist()),
              **{name: given.get(f'imu.{name}') for name in DENSITIES.values()})
    report = Report(arguments.file.name, notes=recorded.notes).plus(grade_readings(
        parts, imu, gravity=values['top.gravity']))
    if of_top:
        report = report.plus(_of_motion(recorded, values, run))
    return printed(report, arguments.json)


def _of_motion(recorded: Recorded, values: Mapping[str, Any], run: Any) -> Report:
    """Return a report on the motion of a top beside the exact one."""
    bodies, _ = stretches({'attitudes': recorded.parts['attitudes']})
    body = max(bodies, key=lambda one: len(one.t), default=None)
    untold = [f'the motion: {len(bodies) - 1} shorter parts between gaps'] * (len(bodies) > 1)
    tolerance, notes = TOLERANCE + NOISES * (body.sigma['attitudes'] if body else math.inf), []
    if not body or body.coarse or tolerance > MOST:
        return Report('', unjudged=['the motion: too few poses, or too much noise'])
    if run:                             # its own exact motion, its moving pivot included
        motion = Simulation({**values, 'solver.method': 'exact'}).trajectory
        stamps = np.rint(1e9 * body.t).astype(np.int64) + (recorded.origin - run.epoch_ns)
        truth = Rotation.from_quat(motion.evaluate(stamps).quaternion)
        worst = math.degrees(np.max((truth.inv() * body.rotation).magnitude()))
        limit = math.degrees(tolerance)
        found = [Finding('inaccurate', f'the attitude is up to {worst:.3g} deg off', worst)]
        return Report('', found * (worst > limit), {'total_error_deg': Mark(worst, limit)},
                      unjudged=untold)
    top = Body(**vars(parameters.top_of(values)))
    start, told = Start.of(top, parameters.start_state(values)), body.rotation.as_quat()
    body = replace(body, t=body.t - body.t[0])
    if conventions.best(told[:EARLY], solve(top, start, body.t[:EARLY]).quaternion).after > START:
        smoothed = Smoothed(body, 1)
        at = smoothed.inner.start
        start = Start.of(top, state_of(top, told[at], body.rotation[at].apply(smoothed.rates[0])))
        notes.append('another start than the one that is given: it is read off the first samples')
        body = replace(body, t=body.t - body.t[at])
    judgement = Judgement(top, body.step, tolerance)
    judgement.add('the motion', start, body)
    return Report('', judgement.faults, {}, notes, unjudged=untold).plus(*judgement.reports())


main = partial(cli.run, 'grade', __doc__, add_arguments, _run)
