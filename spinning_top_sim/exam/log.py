# SPDX-License-Identifier: Apache-2.0
"""
The exam of a log: attitudes that a node has published, compared with the truth.

The filter cannot get the readings again, so only the attitudes are judged: their convention,
wrong stamps, the covariance and gross errors.  The heading must be steady.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam.checks import EXPLAINED
from spinning_top_sim.exam.feeding import Outcome, invalid
from spinning_top_sim.exam.measures import NEES_OFF, USELESS_DEG, degrees, nees_of, turns
from spinning_top_sim.exam.motions import Reals, Run
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.times import stamp_text
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.report import Finding, Mark, Report

TRUTH = 'ground_truth/imu'
LONGEST_GAP_S = 0.1             # of the truth, across which it is interpolated
# Steps by which stamps may be late, or early, because a node may predict the next attitude.
LATE, EARLY = 0.75, -1.5
FEWEST = 100                    # attitudes that can be judged, and that show a convention


class Stamped(NamedTuple):
    """Stamps (n,) [ns], quaternions (n, 4) and covariances (n, 3, 3), NaN where unknown."""

    stamps_ns: NDArray[np.int64]
    quaternions: Reals
    covariances: Reals


def examine_log(path: str | Path, topic: str, truth: str = TRUTH) -> Report:
    """
    Examine the attitudes q(world <- sensor) of a topic of an MCAP file.

    Parameters
    ----------
    path : path
        The file.
    topic : str
        Of the attitudes; its type must be one of LAYOUTS.
    truth : str, optional
        Topic of the true attitudes of the same axes.

    Raises
    ------
    LogError, ValueError
        If the file is no log, or lacks what the exam needs.
    """
    with LogReader(path) as reader:
        said, true = (_read(reader, name) for name in (topic, truth))
        notes = ['the log is damaged: what is whole is read'] * (not reader.whole)
    subject = one_line(f'{topic} of {Path(path).name}')
    if (wrong := invalid(true.quaternions, np.empty((0, 3, 3)))) is not None:
        raise ValueError(f'{truth} at {stamp_text(int(true.stamps_ns[wrong[0]]))} s: {wrong[1]}')
    if (wrong := invalid(said.quaternions, said.covariances)) is not None:
        return Report(subject, [Finding('invalid_output', 'the message of '
                                        f'{stamp_text(int(said.stamps_ns[wrong[0]]))} s: '
                                        f'{wrong[1]}')], notes=notes)
    return replace(_judge(subject, *_beside(one_line(topic), said, true)), notes=notes)


def _read(reader: LogReader, name: str) -> Stamped:
    """Return the attitudes of a topic by ascending stamps, the first of each stamp."""
    topics = {topic.name.lstrip('/'): topic for topic in reader.topics}
    topic = topics.get(name.lstrip('/'))
    if topic is None:
        raise ValueError(f'{reader.path} has no topic {name}; it has '
                         f'{", ".join(topic.name for topic in reader.topics) or "none"}')
    if topic.type_name not in LAYOUTS:
        raise ValueError(f'{topic.name} has the type {topic.type_name or "unknown"}: must be one '
                         f'of {", ".join(LAYOUTS)}')
    try:
        rows = [decode(message.data, topic.type_name)
                for message in reader.messages([topic.name])]
    except ValueError as error:
        raise ValueError(f'a message of {topic.name} cannot be read: {error}') from error
    if len(rows) < FEWEST:
        raise ValueError(f'{topic.name} has {len(rows)} messages: must have {FEWEST} at least')
    stamps_ns, quaternions, covariances = map(np.array, zip(*rows, strict=True))
    stamps_ns, first = np.unique(stamps_ns, return_index=True)
    return Stamped(stamps_ns, quaternions[first], covariances[first])


def _beside(name: str, said: Stamped, true: Stamped) -> tuple[Outcome, Reals]:
    """Return the estimates with the truth at their stamps, and the truth a step before each."""
    # The period of the filter, which may be shorter than that of the truth.
    step_ns = float(np.median(np.diff(said.stamps_ns)))
    after = np.clip(np.searchsorted(true.stamps_ns, said.stamps_ns), 1, len(true.stamps_ns) - 1)
    chosen = ((said.stamps_ns - step_ns >= true.stamps_ns[0])
              & (said.stamps_ns <= true.stamps_ns[-1])
              & (true.stamps_ns[after] - true.stamps_ns[after - 1] <= LONGEST_GAP_S * 1e9))
    count = int(np.count_nonzero(chosen))
    if count < FEWEST:
        raise ValueError(f'{name} has {count} attitudes at times of the truth: must have {FEWEST} '
                         'at least')
    times, t = (stamps - true.stamps_ns[0] for stamps in (true.stamps_ns, said.stamps_ns[chosen]))
    attitude = Slerp(times, Rotation.from_quat(true.quaternions))
    unknown = np.full((count, 3), np.nan)
    run = Run(name, np.full(count, 1e-9 * step_ns), attitude(t).as_quat(), *(3 * [unknown]))
    return (Outcome(run, said.quaternions[chosen], said.covariances[chosen], unknown),
            attitude(t - step_ns).as_quat())


def _delay(outcome: Outcome, before: Reals) -> tuple[float, float, float]:
    """Fit errors as a delay; return its number of steps, and the rms without and with it [rad]."""
    truth = outcome.run.truth
    errors, of_a_step = turns(truth, outcome.estimates), turns(truth, before)
    for one in (errors, of_a_step):
        one[:, 2] -= np.mean(one[:, 2])
    late = float(np.vdot(of_a_step, errors)) / max(float(np.vdot(of_a_step, of_a_step)), 1e-300)
    return late, rms(errors), rms(errors - late * of_a_step)


def _judge(subject: str, outcome: Outcome, before: Reals) -> Report:
    """Find the convention, the delay, and what is left, in the second half."""
    half = slice(len(outcome.run.dt) // 2, None)
    truth = outcome.run.truth[half]
    rows = np.linspace(0, len(truth) - 1, FEWEST // 2, dtype=int)
    best = conventions.best(outcome.estimates[half][rows], truth[rows], steady=True)
    findings, name, estimates = [], best.convention.name, outcome.estimates
    if name and best.after < EXPLAINED * best.before:
        findings.append(Finding('convention', f'read as {name}, the error falls from '
                                f'{degrees(best.before)} to {degrees(best.after)}; all measures '
                                'are those after this correction'))
        estimates = best.convention.undo(estimates)
    mean = float(np.angle(np.mean(np.exp(1j * errors_of(estimates[half], truth).heading))))
    turn = Rotation.from_euler('z', -mean)
    outcome = replace(outcome, estimates=(turn * Rotation.from_quat(estimates)).as_quat())
    settled = outcome.part(half)
    late, error, left = _delay(settled, before[half])
    seconds = late * float(outcome.run.dt[0])
    if not EARLY <= late <= LATE and left < EXPLAINED * error:
        findings.append(Finding(
            'timing', f'the attitude is {abs(1e3 * seconds):.3g} ms '
            f'{"behind" if late > 0.0 else "ahead of"} its stamp: shifted by that, the error '
            f'falls from {degrees(error)} to {degrees(left)}', seconds))
    errors = errors_of(settled.estimates, settled.run.truth)
    value, ratio = rms(errors.whole), nees_of([settled])
    marks = {'tilt_rms_deg': Mark(math.degrees(rms(errors.tilt)), meaning='in the second half'),
             'heading_rms_deg': Mark(math.degrees(rms(errors.heading)), meaning='about its mean'),
             'heading_mean_deg': Mark(math.degrees(mean), meaning='from true north'),
             'error_rms_deg': Mark(math.degrees(value), USELESS_DEG),
             'stamp_offset_s': Mark(seconds, meaning='> 0: late')}
    if not findings and math.degrees(value) > USELESS_DEG:
        findings.append(Finding('accuracy', f'the error is {degrees(value)} rms'))
    if ratio is not None:
        marks['nees'] = Mark(ratio, NEES_OFF[0])
        if not findings and not 1.0 / NEES_OFF[1] <= ratio <= NEES_OFF[0]:
            findings.append(Finding('covariance', f'the squared error of the tilt is {ratio:.3g} '
                                    'times what the covariance says'))
    return Report(subject, findings, marks, (), [outcome])
