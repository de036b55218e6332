# SPDX-License-Identifier: Apache-2.0
"""
The exam of a log: attitudes that a node has published, compared with the truth.

The filter cannot get the readings again, so only the attitudes are judged: their convention,
wrong stamps, the covariance and gross errors.
"""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam.feeding import Outcome, invalid
from spinning_top_sim.exam.measures import consistency, degrees, errors_of, time_offset
from spinning_top_sim.exam.motions import Reals, Run
from spinning_top_sim.recording.provenance import METADATA_NAME
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.recorded_run import ForeignLogError, read_run_description
from spinning_top_sim.tools.report import Finding, Mark, Report

# The first of these topics in the log is the truth.  An Imu is about the sensor, the others are
# about the body.
TRUTHS = ('ground_truth/imu', 'ground_truth/odom', 'pose')
ODOMETRY_OF_SENSOR = 'ground_truth/imu_odom'
LONGEST_GAP_S = 0.1             # of the truth, across which it is interpolated
GROSS, USELESS = np.radians((3.0, 10.0))    # errors that are a convention; that are a fault
LATE, EARLY = 0.75, -1.5        # steps; a node may predict by one
THINNED = 10                    # every so many attitudes are compared in all conventions
FEWEST = 100                    # attitudes in a log that can be judged


class Stamped(NamedTuple):
    """Stamps (n,) [ns], quaternions (n, 4) and covariances (n, 3, 3), NaN where unknown."""

    stamps_ns: NDArray[np.int64]
    quaternions: Reals
    covariances: Reals


def examine_log(path: str | Path, topic: str, truth: str | None = None,
                north: str | None = None) -> Report:
    """
    Examine the attitudes of a topic.

    Parameters
    ----------
    path : path
        An MCAP file.
    topic : str
        Topic of the attitudes q(world <- sensor); its type must be one of LAYOUTS.
    truth : str, optional
        Topic of the truth; default: the first of TRUTHS.
    north : {'true', 'magnetic'}, optional
        From which the heading counts; by default it needs only be steady.

    Raises
    ------
    LogError, ValueError
        If the file is no log, or lacks what the exam needs.
    """
    with LogReader(path) as reader:
        examined = _topic(reader, topic)
        estimates = _read(reader, examined)
        true_topic = _topic(reader, truth) if truth else _first_truth(reader, examined)
        true = _read(reader, true_topic)
        turns = _of_sensor(true_topic, true, _places(reader), north)
    subject = one_line(f'{topic} of {Path(path).name}')
    for k, why in invalid(estimates.quaternions, estimates.covariances):
        return Report(subject, [Finding('invalid_output', f'the message of '
                                        f'{estimates.stamps_ns[k] * 1e-9:.9f} s: {why}')])
    outcome = _beside(one_line(topic), estimates, true.stamps_ns, turns)
    return _judge(subject, outcome, north is not None)


def _topic(reader: LogReader, name: str) -> LogTopic:
    for topic in reader.topics:
        if topic.name.lstrip('/') == name.lstrip('/'):
            if topic.type_name not in LAYOUTS:
                raise ValueError(f'{topic.name} has the type {topic.type_name or "unknown"}: must '
                                 f'be one of {", ".join(LAYOUTS)}')
            return topic
    raise ValueError(f'{reader.path} has no topic {name}; it has '
                     f'{", ".join(topic.name for topic in reader.topics) or "none"}')


def _first_truth(reader: LogReader, examined: LogTopic) -> LogTopic:
    for name, topic in itertools.product(TRUTHS, reader.topics):
        if (f'/{topic.name}'.endswith(f'/{name}') and topic.type_name in LAYOUTS
                and topic.name != examined.name):
            return topic
    raise ValueError(f'{reader.path} has no other topic {", ".join(TRUTHS)} with attitudes: name '
                     'one by --truth')


def _read(reader: LogReader, topic: LogTopic) -> Stamped:
    """Return the attitudes of a topic by ascending stamps, the first of each stamp."""
    try:
        rows = [decode(message.data, topic.type_name)
                for message in reader.messages([topic.name])]
    except ValueError as error:
        raise ValueError(f'a message of {topic.name} cannot be read: {error}') from error
    if len(rows) < FEWEST:
        raise ValueError(f'{topic.name} has {len(rows)} messages: must have {FEWEST} at least')
    stamps, first = np.unique([row.stamp_ns for row in rows], return_index=True)
    return Stamped(stamps, np.array([rows[k].quaternion for k in first]),
                   np.array([rows[k].covariance for k in first]))


def _places(reader: LogReader) -> dict[int, Mapping[str, Any]]:
    """Return the parameters by the log time from which they hold [ns].  Raises ValueError."""
    try:
        run = read_run_description(reader)
    except ForeignLogError as error:
        if reader.metadata.get(METADATA_NAME):
            raise ValueError(f'{reader.path}: {error}') from error
        return {0: {}}
    return {0: run.values_at_start, **{
        event.stamp_ns: event.details['parameters'] for event in run.events
        if event.name == 'reset'}}


def _of_sensor(topic: LogTopic, true: Stamped, places: Mapping[int, Mapping[str, Any]],
               north: str | None) -> Rotation:
    """Return the true attitudes of the sensor, in a world with this north.  Raises ValueError."""
    for k, why in invalid(true.quaternions, np.empty((0, 3, 3))):
        raise ValueError(f'{topic.name} at {true.stamps_ns[k] * 1e-9:.9f} s: {why}')
    turns = Rotation.from_quat(true.quaternions)
    place = np.searchsorted([*places], true.stamps_ns, 'right') - 1
    if not (topic.type_name == 'sensor_msgs/msg/Imu' or topic.name.endswith(ODOMETRY_OF_SENSOR)):
        turns = turns * Rotation.from_euler('xyz', np.array([
            values.get('imu.rpy', (0.0, 0.0, 0.0)) for values in places.values()])[place])
    if north == 'magnetic':
        if not all('mag.field' in values for values in places.values()):
            raise ValueError('the log does not say where magnetic north is')
        east_part, north_part, _ = np.array([
            values['mag.field'] for values in places.values()])[place].T
        turns = Rotation.from_euler(
            'z', np.arctan2(east_part, north_part)[:, np.newaxis]) * turns
    return turns


def _beside(name: str, said: Stamped, true_ns: NDArray[np.int64], turns: Rotation) -> Outcome:
    """Return the estimates with the truth at their stamps, interpolated if few are the same."""
    chosen = np.isin(said.stamps_ns, true_ns)
    if np.count_nonzero(chosen) < FEWEST:
        after = np.clip(np.searchsorted(true_ns, said.stamps_ns), 1, len(true_ns) - 1)
        chosen = ((said.stamps_ns >= true_ns[0]) & (said.stamps_ns <= true_ns[-1])
                  & (true_ns[after] - true_ns[after - 1] <= LONGEST_GAP_S * 1e9))
    stamps = said.stamps_ns[chosen]
    if len(stamps) < FEWEST:
        raise ValueError(f'{name} has {len(stamps)} attitudes at times of the truth: must have '
                         f'{FEWEST} at least')
    times, t = (true_ns - true_ns[0]) * 1e-9, (stamps - true_ns[0]) * 1e-9
    # Central differences.
    step = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(times)[:, np.newaxis]
    middle = 0.5 * (times[1:] + times[:-1])
    rates = np.stack([np.interp(t, middle, column) for column in step.T], axis=1)
    # The period of the filter, which may be shorter than that of the truth.
    dt = np.full(len(t), float(np.median(np.diff(said.stamps_ns))) * 1e-9)
    readings = np.full((2, len(t), 3), np.nan)          # nothing asks for them
    return Outcome(Run(name, dt, Slerp(times, turns)(t).as_quat(), rates, *readings),
                   said.quaternions[chosen], said.covariances[chosen],
                   np.full((len(t), 3), np.nan))


def _judge(subject: str, outcome: Outcome, absolute: bool) -> Report:
    """Find the convention, the delay, and what is left."""
    heading = 'absolute' if absolute else 'steady'
    half = slice(len(outcome.run.dt) // 2, None)
    settled = outcome.part(half)
    best = conventions.best(settled.estimates[::THINNED], settled.run.truth[::THINNED], heading)
    findings, name = [], best.convention.name
    if name and best.before > GROSS and best.after < 0.25 * best.before:
        findings.append(Finding(
            'convention', f'read as {name}, the error falls from {degrees(best.before)} to '
            f'{degrees(best.after)}; all measures are those after this correction'))
        outcome = replace(outcome, estimates=best.convention.undo(outcome.estimates))
        settled = outcome.part(half)
    offset = time_offset(settled.estimates, settled.run.truth, settled.run.gyroscope, absolute)
    late = offset.seconds / float(outcome.run.dt[0])
    if (late > LATE or late < EARLY) and offset.after < 0.25 * offset.before:
        findings.append(Finding(
            'timing', f'the attitude is {abs(1e3 * offset.seconds):.3g} ms '
            f'{"behind" if late > 0.0 else "ahead of"} its stamp: shifted by that, the error '
            f'falls from {degrees(offset.before)} to {degrees(offset.after)}', offset.seconds))
    errors = errors_of(settled.estimates, settled.run.truth)
    heading_error = errors.varying_heading(absolute)
    value = rms(np.hypot(errors.tilt, heading_error))
    if not findings and value > USELESS:
        findings.append(Finding('accuracy', f'the error is {degrees(value)} rms in the second '
                                'half', math.degrees(value)))
    marks = {'tilt_rms_deg': Mark(math.degrees(rms(errors.tilt)), meaning='in the second half'),
             'heading_rms_deg': Mark(math.degrees(rms(heading_error))),
             'error_rms_deg': Mark(math.degrees(value), math.degrees(USELESS)),
             'stamp_offset_s': Mark(offset.seconds, meaning='> 0: late')}
    for what, whole in (('tilt', False), ('attitude', True))[:1 + absolute]:
        if nees := consistency([outcome], whole):
            low, high = nees.band
            text = f'right from {low:.3g} to {high:.3g}'
            marks[f'nees_{what}'] = Mark(nees.ratio, meaning=text)
            if not findings and not low <= nees.ratio <= high:
                findings.append(Finding('covariance', f'the squared error of the {what} is '
                                        f'{nees.ratio:.3g} times what the covariance says; {text}',
                                        nees.ratio))
    return Report(subject, findings, marks, (), [outcome])
