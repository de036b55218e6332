# SPDX-License-Identifier: Apache-2.0
"""
The exam of a log: attitudes that some node has published, beside the truth.

The readings cannot be given to the filter again.  What is judged is what the attitudes show:
misreadings of them, a wrong stamp, the covariance, and whether they diverge.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam import diagnosis
from spinning_top_sim.exam.diagnosis import Fault
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import OF_PLACE, Reals, Truth
from spinning_top_sim.exam.trial import (
    UNKNOWN,
    Known,
    Outcome,
    is_indefinite,
    no_attitudes,
    one_line,
)
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.writer import METADATA_NAME
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.attitudes import LAYOUTS, decode
from spinning_top_sim.tools.recorded_run import ODD, reason_of

# The first that the log has is the truth: of the sensor as each Imu is, and of the body.
TRUTHS = ('ground_truth/imu', 'ground_truth/odom', 'pose')
ODOMETRY_OF_SENSOR = 'ground_truth/imu_odom'
NORTHS = TRUE, MAGNETIC = 'true', 'magnetic'
LONGEST_GAP_S = 0.1             # of the truth, for attitudes between two of its samples
FEWEST = 100                    # attitudes that say something


class Attitudes(NamedTuple):
    """Stamps (n,) [ns], quaternions (n, 4), covariances (n, 3, 3), NaN where unknown."""

    stamps_ns: NDArray[np.int64]
    quaternions: Reals
    covariances: Reals


def examine_log(path: Path, topic: str, truth: str | None = None,
                north: str | None = None) -> Report:
    """
    Examine the attitudes of a topic.

    Parameters
    ----------
    path : Path
        An MCAP file.
    topic : str
        Of the attitudes q(world <- sensor), of a type of LAYOUTS.
    truth : str, optional
        Topic of the truth; default: the first of TRUTHS.
    north : {'true', 'magnetic'}, optional
        From which the heading counts; by default it needs only be steady.

    Returns
    -------
    Report
        The faults that show in a log, and measures.

    Raises
    ------
    LogError
        For what is no log.
    ValueError
        For a log without these topics, with too few attitudes, with odd parameters, or whose
        truth has another norm than 1.
    """
    heading = north is not None
    with LogReader(path) as reader:
        examined = _topic(reader, topic)
        said = _read(reader, examined)
        true_topic = _topic(reader, truth) if truth else _first_truth(reader, examined)
        if true_topic.name == examined.name:
            raise ValueError(f'the truth of {topic} cannot be {truth}: must be another topic')
        true = _read(reader, true_topic)
        values = _parameters(reader)
    wrong = no_attitudes(true.quaternions)
    if len(wrong):
        raise ValueError(f'{true_topic.name} has the quaternion '
                         f'{true.quaternions[wrong[0]].tolist()} at '
                         f'{true.stamps_ns[wrong[0]] * 1e-9:.9f} s: its norm must be 1')
    turns = Rotation.from_quat(true.quaternions)
    if not (true_topic.type_name == 'sensor_msgs/msg/Imu'
            or true_topic.name.endswith(ODOMETRY_OF_SENSOR)):
        turns = turns * Rotation.from_euler('xyz', values.get('imu.rpy', (0.0, 0.0, 0.0)))
    if north == MAGNETIC:
        if 'mag.field' not in values:
            raise ValueError(f'{path} does not say where magnetic north is')
        east_part, north_part, _ = values['mag.field']
        turns = Rotation.from_euler('z', math.atan2(east_part, north_part)) * turns
    true = true._replace(quaternions=turns.as_quat())
    subject = one_line(f'{topic} of {path.name}')
    for what, rows, wrong in (
            ('no unit quaternion', said.quaternions, no_attitudes(said.quaternions)),
            ('a covariance that is not finite, or has a negative eigenvalue', said.covariances,
             _no_covariances(said.covariances))):
        if len(wrong):
            k = int(wrong[0])
            return Report(subject, [Fault(
                'invalid_output', f'{len(wrong)} of {len(rows)} messages have {what}; the '
                f'first, at {said.stamps_ns[k] * 1e-9:.9f} s, has {rows[k].tolist()}')], {})
    outcome = _beside(one_line(topic), said, true)
    settled = outcome.last()
    faults = []
    found = diagnosis.explain(settled, heading, None)
    if found is not None:
        faults = [Fault(name, found.text) for name in found.faults]
        corrected = replace(outcome, estimates=found.read(outcome.estimates))
    else:
        corrected = outcome
    offset, fault = diagnosis.stamp_fault(corrected.last(), heading)
    measured = {**diagnosis.marks([outcome], heading), 'stamp_offset_s': offset.seconds}
    faults += [fault] if fault is not None else []
    if not faults and (fault := diagnosis.divergence(outcome, heading)) is not None:
        faults.append(fault)
    consistency = diagnosis.consistency([corrected], heading)
    measured |= diagnosis.nees_marks(consistency)
    if not faults and (fault := diagnosis.covariance_fault(consistency)) is not None:
        faults.append(fault)
    return Report(subject, list(diagnosis.one_of_each(faults)), measured, [outcome])


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
    for name in TRUTHS:
        for topic in reader.topics:
            if (f'/{topic.name}'.endswith(f'/{name}') and topic.type_name in LAYOUTS
                    and topic.name != examined.name):
                return topic
    raise ValueError(f'{reader.path} has no other topic {", ".join(TRUTHS)} with attitudes: name '
                     'one by --truth')


def _parameters(reader: LogReader) -> dict[str, Any]:
    """Return those of the parameters OF_PLACE that the log has.  Raises ValueError."""
    text = reader.metadata.get(METADATA_NAME, {}).get('parameters', '{}')
    try:
        return {name: parameters.BY_NAME[name].check(value)
                for name, value in json.loads(text).items() if name in OF_PLACE}
    except ODD as error:
        raise ValueError(f'the parameters in the metadata of {reader.path} cannot be used: '
                         f'{reason_of(error)}') from error


def _no_covariances(covariances: Reals) -> NDArray[np.intp]:
    """Return the numbers of those (n, 3, 3), NaN where unknown, that no errors can have."""
    finite = np.all(np.isfinite(covariances), axis=(1, 2))
    wrong = ~finite & ~np.any(np.isnan(covariances), axis=(1, 2))
    wrong[finite] = is_indefinite(covariances[finite])
    return np.flatnonzero(wrong)


def _read(reader: LogReader, topic: LogTopic) -> Attitudes:
    """Return the attitudes of a topic by ascending stamps, the first of each."""
    rows = []
    for message in reader.messages([topic.name]):
        try:
            rows.append(decode(message.data, topic.type_name))
        except ValueError as error:
            raise ValueError(f'a message of {topic.name} cannot be read: {error}') from error
    if len(rows) < FEWEST:
        raise ValueError(f'{topic.name} has {len(rows)} messages: must have {FEWEST} at least')
    stamps, first = np.unique([row.stamp_ns for row in rows], return_index=True)
    return Attitudes(stamps, np.array([rows[k].quaternion for k in first]),
                     np.array([rows[k].covariance for k in first]))


def _beside(name: str, said: Attitudes, true: Attitudes) -> Outcome:
    """
    Return attitudes beside the truth of their stamps.

    If there are enough, those with a sample of the truth; else it is interpolated.
    """
    after = np.clip(np.searchsorted(true.stamps_ns, said.stamps_ns), 1, len(true.stamps_ns) - 1)
    chosen = np.isin(said.stamps_ns, true.stamps_ns)
    if np.count_nonzero(chosen) < FEWEST:
        chosen = ((said.stamps_ns >= true.stamps_ns[0]) & (said.stamps_ns <= true.stamps_ns[-1])
                  & (true.stamps_ns[after] - true.stamps_ns[after - 1] <= LONGEST_GAP_S * 1e9))
    stamps = said.stamps_ns[chosen]
    if len(stamps) < FEWEST:
        raise ValueError(f'{name} has {len(stamps)} attitudes at times of the truth: must have '
                         f'{FEWEST} at least')
    times = (true.stamps_ns - true.stamps_ns[0]) * 1e-9
    turns = Rotation.from_quat(true.quaternions)
    t = (stamps - true.stamps_ns[0]) * 1e-9
    truth = Slerp(times, turns)(t)
    # By the difference of the samples on either side.
    step = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(times)[:, np.newaxis]
    middle = 0.5 * (times[1:] + times[:-1])
    rates = np.stack([np.interp(t, middle, column) for column in step.T], axis=1)
    covariances = said.covariances[chosen]
    known = np.flatnonzero(np.all(np.isfinite(covariances), axis=(1, 2)))
    # Of the filter: it may be faster than the truth.
    dt = np.full(len(t), float(np.median(np.diff(said.stamps_ns))) * 1e-9)
    return Outcome(Truth(name, t - t[0], dt, truth.as_quat(), rates), said.quaternions[chosen],
                   Known(known, covariances[known]), UNKNOWN)
