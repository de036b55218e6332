# SPDX-License-Identifier: Apache-2.0
"""Chooses poses and readings from a ROS 2 log, by the types of its topics; and the run of ours."""

import contextlib
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from spinning_top_sim.grade.files import Recorded
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.messages import EXACT_VARIANCE
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.foreign_messages import PLACES, Sample, samples

# Topics of this package that are graded where its log has them, the first of each kind.
OURS = 'pose', 'ground_truth/odom', 'imu/data_raw', 'imu/data', 'ground_truth/imu', 'imu/mag'


def read_log(path: Path, wanted: Sequence[str] = ()) -> Recorded:
    """
    Read a log.

    wanted : topics to read, of transforms as TOPIC:CHILD; none: the only ones of each kind

    Raises OSError, LogError or ValueError, which name the file and what to type.
    """
    recorded, end_ns = Recorded(), 1 << 63
    found: dict[str, dict[str, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    with LogReader(path) as reader:
        with contextlib.suppress(recorded_run.ForeignLogError):
            recorded.run = recorded_run.read_run_description(reader)
            end_ns = next((one.stamp_ns for one in recorded.run.events
                           if one.event.kind != 'start'), end_ns)
        if not reader.whole:
            recorded.notes.append('the log is truncated: read as far as it goes')
        types = {topic.name: topic.type_name for topic in reader.topics
                 if topic.type_name in PLACES}
        for one in samples(reader, types, end_ns):
            found[one.kind][one.source].append(one)
        if reader.left_out:
            recorded.notes.append('damaged chunks of the log are left out')
    try:
        _choose(recorded, found, wanted)
        recorded.check()
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    return recorded


def _choose(recorded: Recorded, found: Mapping[str, Mapping[str, list[Sample]]],
            wanted: Sequence[str]) -> None:
    """Add the parts of a log.  Raises ValueError."""
    sources = {source for every in found.values() for source in every}
    for name in wanted:
        if name not in sources:
            raise ValueError(f'--topic {name}: the log has {", ".join(sorted(sources)) or "none"}')
    moving = {source for source, rows in found.get('attitudes', {}).items()
              if any(row.values != rows[0].values for row in rows)}
    chosen = {}
    for kind, every in found.items():
        names = [one for one in every if kind not in ('positions', 'attitudes') or one in moving]
        ours = [one for name in OURS for one in names if one.endswith(f'/{name}')][:1]
        named = [one for one in names if one in wanted] or (ours if recorded.run else names)
        if len(named) > 1:
            raise ValueError(f'{kind} are in {", ".join(named)}: choose by --topic {named[0]}')
        if named:
            chosen[kind] = every[named[0]]
    origin = min((rows[0].stamp_ns or rows[0].log_ns for rows in chosen.values()), default=0)
    recorded.origin = Decimal(origin).scaleb(-9)
    recorded.notes.append(f'times of headers: the first is {recorded.origin} s')
    for kind, rows in chosen.items():
        if not rows[0].stamp_ns:
            recorded.notes.append(f'{kind}: headers without a time: that of the log is used')
        times = np.array([1e-9 * ((row.stamp_ns or row.log_ns) - origin) for row in rows])
        recorded.add(kind, rows[0].source, times, np.array([row.values for row in rows]),
                     [f'message {k}' for k in range(len(rows))])
        covariance = rows[0].covariance         # zeros: unknown; the smallest: exact
        if covariance is not None and np.max(covariance) > EXACT_VARIANCE:
            recorded.densities[kind] = math.sqrt(
                np.trace(covariance.reshape(3, 3)) / 3.0 * np.median(np.diff(times)))
    if unused := sorted(sources - {rows[0].source for rows in chosen.values()}):
        recorded.notes.append(f'not used: {", ".join(unused)}')
