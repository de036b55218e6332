# SPDX-License-Identifier: Apache-2.0
"""
Grade a recording: is this IMU that of this motion?  Of a top, is this motion right?

  spinning-top grade run.mcap                       # poses and readings of any body
  spinning-top grade run.csv --lever-arm 0.1 0 0.2
  spinning-top grade run.csv --columns 't=stamp:ns, gx=gyro_x:deg/s, ...'
  spinning-top grade run.csv --scene looping        # also the motion of a top that is known

exit codes:
  0    no fault was found
  1    there are faults, or the file cannot be read
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
from spinning_top_sim.grade import files, grade_readings
from spinning_top_sim.grade.columns import DENSITIES, READINGS, STANDARD_GRAVITY, Imu
from spinning_top_sim.grade.logs import read_log
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
# Errors of a device in our parameters, and faults that they are in the readings of its logs.
DECLARED = {**{name: {'bias', 'reading_scale', 'matrix', 'inaccurate'} for name in (
                'turn_on_bias', 'hard_iron', 'soft_iron', 'disturbance')},
            'bias': {'bias'}, 'random_walk': {'bias'}, 'drop': {'held'}, 'duplicate': {'held'},
            **{name: {'matrix', 'mounting', 'reading_scale', 'sign'} for name in ('_M', '_A')},
            **{name: {'late', 'early', 'inaccurate', 'noise_scale', 'acceleration_scale',
                      'reading_scale', 'matrix', 'finite_differences'} for name in (
                'stamp', 'clock', 'bandwidth', 'sampling', 'vibration', 'range', 'resolution')}}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('file', type=Path, help='.mcap, .csv, .tum, .parquet or .npz; a folder of a bag or EuRoC')
    add('--columns', help='columns and units of a table, such as "t=stamp:ns, gx=gyro_x:deg/s", '
        'or a file with such a text')
    add('--topic', action='append', default=[], help='a topic of a log to read, of transforms '
        'TOPIC:CHILD; may be repeated; default: the only one of each kind')
    add('--lever-arm', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
        help='position of the IMU in the body [m]; default: found')
    scene_file.add_parameters(parser)
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    path, log = arguments.file, arguments.file.suffix == '.mcap'
    if path.is_dir():
        path = path / 'mav0' if (path / 'mav0').is_dir() else path
        log = not (path / 'imu0').is_dir()
    if (arguments.columns if log else arguments.topic):
        raise ValueError('--columns is for tables' if log else '--topic is for logs')
    recorded = read_log(path, arguments.topic) if log else files.read_table(
        path, arguments.columns)
    given = scene_file.given(arguments)
    known = None if arguments.scene or arguments.params else recorded.run
    values = parameters.checked({**(known.values_in_effect if known else {}), **given})
    of_top = bool(known) or any(name.startswith(('top.', 'initial.', 'spin.')) for name in given)
    parts, at = recorded.parts, recorded.parts['attitudes'][0]
    if not of_top and READINGS.keys().isdisjoint(parts):
        raise ValueError(f'{path}: there are no readings, and no top is known (--scene): nothing '
                         f'to grade; {"; ".join(recorded.notes)}; readings are named by --columns '
                         "'gx=COLUMN:UNIT, ...'")
    if of_top and not known:            # the pivot is at rest
        parts = {'positions': (at, np.zeros((len(at), 3))), **parts}
    report = Report(path.name, [], {}, recorded.notes).plus(grade_readings(
        parts, _imu(arguments, given, values, bool(known), recorded.densities),
        gravity=values['top.gravity'] if of_top else STANDARD_GRAVITY))
    if known:
        report = _without_declared(report, known.values_in_effect)
    if of_top:
        report = report.plus(_of_motion(recorded, values, known))
    return printed(report, arguments.json)


def _imu(arguments: argparse.Namespace, given: Mapping[str, Any], values: Mapping[str, Any],
         known: bool, densities: Mapping[str, float]) -> Imu:
    """Return what is known of the IMU."""
    arm, field = (tuple(values[name]) if known or name in given else None
                  for name in ('imu.lever_arm', 'mag.field'))
    return Imu(
        lever_arm=tuple(arguments.lever_arm) if arguments.lever_arm else arm, field=field,
        mounting=tuple(Rotation.from_euler('xyz', values['imu.rpy']).as_quat().tolist()),
        **{name: given.get(f'imu.{name}', densities.get(kind))
           for kind, name in DENSITIES.items()})


def _without_declared(report: Report, values: Mapping[str, Any]) -> Report:
    """Return a report without the errors that the parameters of a log give its device."""
    defaults = parameters.checked({})
    ours = [name for name, value in values.items()
            if name.startswith(('imu.', 'mag.')) and value != defaults[name]]
    known = set().union(*(faults for part, faults in DECLARED.items()
                          if any(part in name for name in ours)))
    return replace(report, found=[one for one in report.found if one.name not in known], notes=[
        *report.notes, *(f'{one.name}, as the parameters of the log say: {one.evidence}'
                         for one in report.found if one.name in known)])


def _of_motion(recorded: files.Recorded, values: Mapping[str, Any], run: Any) -> Report:
    """Return a report on the motion of a top beside the exact one."""
    bodies, _ = stretches({'attitudes': recorded.parts['attitudes']})
    body = max(bodies, key=lambda one: len(one.t), default=None)
    tolerance, notes = TOLERANCE + NOISES * (body.sigma['attitudes'] if body else math.inf), []
    if not body or body.coarse or tolerance > MOST:
        return Report('', unjudged=['the motion: too few poses, or too much noise'])
    if run is not None:                 # its own exact motion, its moving pivot included
        first_ns = float(recorded.origin * 10 ** 9 - run.epoch_ns)
        motion = Simulation({**run.values_in_effect, 'solver.method': 'exact'}).trajectory
        truth = motion.evaluate(np.rint(1e9 * body.t + first_ns).astype(np.int64)).quaternion
        worst = float(np.max((Rotation.from_quat(truth).inv() * body.rotation).magnitude()))
        found = [Finding('inaccurate', f'the attitude is up to {math.degrees(worst):.3g} deg off',
                         math.degrees(worst))] if worst > tolerance else []
        return Report('', found, {'total_error_deg': Mark(math.degrees(worst),
                                                          math.degrees(tolerance))})
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
    judgement.motions.append(judgement.beside_truth('the motion', start, body))
    return Report('', judgement.faults, {}, notes).plus(*judgement.reports())


main = partial(cli.run, 'grade', __doc__, add_arguments, _run)
