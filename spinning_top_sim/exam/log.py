# SPDX-License-Identifier: Apache-2.0
"""
The exam of a log: attitudes that a node has published, compared with the truth.

The filter cannot get the readings again, so only the attitudes are judged: their convention,
wrong stamps, the covariance and gross errors.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam.feeding import Outcome, invalid
from spinning_top_sim.exam.measures import degrees, nees_of
from spinning_top_sim.exam.motions import Reals, Run
from spinning_top_sim.exam.scored import USELESS_DEG
from spinning_top_sim.recording.provenance import METADATA_NAME
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.times import stamp_text
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.recorded_run import ForeignLogError, read_run_description
from spinning_top_sim.tools.report import Finding, Mark, Report

# The first of these topics in the log is the truth.  An Imu is about the sensor, the others are
# about the body.
TRUTHS = ('ground_truth/imu', 'ground_truth/odom', 'pose')
ODOMETRY_OF_SENSOR = 'ground_truth/imu_odom'
LONGEST_GAP_S = 0.1             # of the truth, across which it is interpolated
# Steps by which stamps may be late, or early, because a node may predict the next attitude.
LATE, EARLY = 0.75, -1.5
EXPLAINED = 0.25                # most of an error that its cause leaves
FEWEST = 100                    # attitudes that can be judged, and that show a convention


class Stamped(NamedTuple):
    """Stamps (n,) [ns], quaternions (n, 4) and covariances (n, 3, 3), NaN where unknown."""

    stamps_ns: NDArray[np.int64]
    quaternions: Reals
    covariances: Reals


def examine_log(path: str | Path, topic: str, truth: str | None = None,
                north: str | None = None) -> Report:
    """
    Examine the attitudes q(world <- sensor) of a topic of an MCAP file.

    Parameters
    ----------
    path : path
        The file.
    topic : str
        Of the attitudes; its type must be one of LAYOUTS.
    truth : str, optional
        Topic of the truth; default: the first of TRUTHS.
    north : {'true', 'magnetic'}, optional
        From which the heading counts; by default it must be steady.

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
        turns = _of_sensor(reader, true_topic, true, north)
        notes = ['the log is damaged: what is whole is read'] * (not reader.whole)
    subject = one_line(f'{topic} of {Path(path).name}')
    if (wrong := invalid(estimates.quaternions, estimates.covariances)) is not None:
        k, why = wrong
        return Report(subject, [Finding('invalid_output', f'the message of '
                                        f'{stamp_text(int(estimates.stamps_ns[k]))} s: {why}')])
    outcome = _beside(one_line(topic), estimates, true.stamps_ns, turns)
    return replace(_judge(subject, outcome, north is not None), notes=notes)


def _topic(reader: LogReader, name: str) -> LogTopic:
    for topic in reader.topics:
        if topic.name.lstrip('/') == name.lstrip('/'):
            if topic.type_name in LAYOUTS:
                return topic
            raise ValueError(f'{topic.name} has the type {topic.type_name or "unknown"}: must be '
                             f'one of {", ".join(LAYOUTS)}')
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


def _of_sensor(reader: LogReader, topic: LogTopic, true: Stamped, north: str | None) -> Rotation:
    """Return the true attitudes of the sensor, in a world with this north.  Raises ValueError."""
    if (wrong := invalid(true.quaternions, np.empty((0, 3, 3)))) is not None:
        raise ValueError(f'{topic.name} at {stamp_text(int(true.stamps_ns[wrong[0]]))} s: '
                         f'{wrong[1]}')
    turns = Rotation.from_quat(true.quaternions)
    values: Mapping[str, Any] = {}
    try:
        run = read_run_description(reader)
        values = run.values_at_start
        if any('imu.rpy' in event.details.get('parameters', {}) and event.details['parameters'][
                'imu.rpy'] != values['imu.rpy'] for stamp_ns, event in run.events):
            raise ValueError(f'{reader.path}: a reset turns the sensor on the body: name '
                             'the topic of an Imu by --truth')
    except ForeignLogError as error:
        if reader.metadata.get(METADATA_NAME):
            raise ValueError(f'{reader.path}: {error}') from error
    if not (topic.type_name == 'sensor_msgs/msg/Imu' or topic.name.endswith(ODOMETRY_OF_SENSOR)):
        turns = turns * Rotation.from_euler('xyz', values.get('imu.rpy', (0.0, 0.0, 0.0)))
    if north == 'magnetic':
        if 'mag.field' not in values:
            raise ValueError('the log does not say where magnetic north is')
        turns = Rotation.from_euler('z', math.atan2(*values['mag.field'][:2])) * turns
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
    rates = np.stack([np.interp(t, 0.5 * (times[1:] + times[:-1]), column) for column in step.T],
                     axis=1)
    # The period of the filter, which may be shorter than that of the truth.
    dt = np.full(len(t), float(np.median(np.diff(said.stamps_ns))) * 1e-9)
    unknown = np.full((len(t), 3), np.nan)
    return Outcome(Run(name, dt, Slerp(times, turns)(t).as_quat(), rates, unknown, unknown),
                   said.quaternions[chosen], said.covariances[chosen], unknown)


def _delay(outcome: Outcome, absolute: bool) -> tuple[float, float, float]:
    """Fit e = -s w + h z; return s [s], and the rms of e without and with it [rad]."""
    true, est = (Rotation.from_quat(rows) for rows in (outcome.run.truth, outcome.estimates))
    errors = errors_of(outcome.estimates, outcome.run.truth)
    mean = 0.0 if absolute else float(np.angle(np.mean(np.exp(1j * errors.heading))))
    vector = (true.inv() * Rotation.from_euler('z', -mean) * est).as_rotvec().ravel()
    columns = np.stack((-outcome.run.gyroscope.ravel(), true.inv().apply((0, 0, 1)).ravel()),
                       axis=1)[:, :2 - absolute]
    found = np.linalg.lstsq(columns, vector, rcond=None)[0]
    return (float(found[0]), rms(vector - columns[:, 1:] @ found[1:]),
            rms(vector - columns @ found))


def _judge(subject: str, outcome: Outcome, absolute: bool) -> Report:
    """Find the convention, the delay, and what is left, in the second half."""
    settled = outcome.part(slice(len(outcome.run.dt) // 2, None))
    rows = np.linspace(0, len(settled.run.dt) - 1, FEWEST // 2, dtype=int)
    best = conventions.best(settled.estimates[rows], settled.run.truth[rows],
                            'absolute' if absolute else 'steady')
    findings, name = [], best.convention.name
    if name and best.after < EXPLAINED * best.before:
        findings.append(Finding('convention', f'read as {name}, the error falls from '
                                f'{degrees(best.before)} to {degrees(best.after)}; all measures '
                                'are those after this correction'))
        outcome, settled = (replace(one, estimates=best.convention.undo(one.estimates))
                            for one in (outcome, settled))
    seconds, before, after = _delay(settled, absolute)
    late = seconds / float(outcome.run.dt[0])
    if not EARLY <= late <= LATE and after < EXPLAINED * before:
        findings.append(Finding(
            'timing', f'the attitude is {abs(1e3 * seconds):.3g} ms '
            f'{"behind" if late > 0.0 else "ahead of"} its stamp: shifted by that, the error '
            f'falls from {degrees(before)} to {degrees(after)}', seconds))
    errors = errors_of(settled.estimates, settled.run.truth)
    errors = errors if absolute else errors.about_mean()
    value, nees = rms(errors.whole), nees_of([outcome])
    marks = {'tilt_rms_deg': Mark(math.degrees(rms(errors.tilt)), meaning='in the second half'),
             'heading_rms_deg': Mark(math.degrees(rms(errors.heading))),
             'error_rms_deg': Mark(math.degrees(value), USELESS_DEG),
             'stamp_offset_s': Mark(seconds, meaning='> 0: late')}
    if not findings and math.degrees(value) > USELESS_DEG:
        findings.append(Finding('accuracy', f'the error is {degrees(value)} rms'))
    if nees is not None:
        marks['nees'] = Mark(nees.ratio, nees.high, nees.band)
        if not findings and not nees.low <= nees.ratio <= nees.high:
            findings.append(Finding('covariance', str(nees)))
    return Report(subject, findings, marks, (), [outcome], absolute)
