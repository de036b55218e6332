# SPDX-License-Identifier: Apache-2.0
"""The source of a page for one log or two: reads their tops, and plays them."""

import contextlib
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spinning_top_sim.recording.errors import MALFORMED, LogError, reason_of
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Block
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.view.page import Page
from spinning_top_sim.view.player import Player
from spinning_top_sim.view.samples import QUATERNION, TOPICS, WIDTH, SampledTrack
from spinning_top_sim.view.source import Motion

# The tops of a log: another one from each reset on that makes another top.
Tops = list[SampledTrack]


def read_log(path: Path, name: str = '') -> Tops:
    """Return the tops of a log, which may be truncated.  Raises LogError."""
    with LogReader(path) as reader:
        notes = [] if reader.whole else ['it is truncated: shown as far as it goes']
        try:
            run = recorded_run.read_run_description(reader)
        except recorded_run.ForeignLogError as error:
            tops = [_read_foreign(reader, name)]
            notes.append(str(error))
        else:
            tops = _new_tops(run, name)
            _read_samples(reader, tops, run)
            try:
                _follow_run(tops, run, reader.span[1])
            except MALFORMED as error:
                notes.append(f'the run cannot be followed: {reason_of(error)}')
    tops = [top for top in tops if len(top.rows)]
    if not tops:
        raise LogError(f'{path}: no attitude in it ({", ".join(LAYOUTS)})')
    if notes:
        tops[0].note = f'{path.name}: {"; ".join(notes)}'
    return tops


def _new_tops(run: recorded_run.RunDescription, name: str) -> Tops:
    """Return tracks without samples, one for each top or mounting of the IMU in a run."""
    tops = [SampledTrack(name, run.values_in_effect, epoch_ns=run.epoch_ns)]
    for _, event in run.events:
        if event.kind == 'reset':
            before, values = tops[-1].values, event.details['parameters']
            if any(values[key] != before[key] for key in values
                   if key.startswith('top.') or key == 'imu.rpy'):
                tops.append(SampledTrack(name, values, epoch_ns=run.epoch_ns))
                tops[-1].begin_ns = event.details['epoch_ns'] - run.epoch_ns
    return tops


def _top_at(tops: Tops, t_ns: int) -> SampledTrack:
    """Return the top of a log at a time, the first one before that begins."""
    return tops[max(bisect_right(tops, t_ns, key=lambda top: top.begin_ns) - 1, 0)]


def _read_samples(reader: LogReader, tops: Tops, run: recorded_run.RunDescription) -> None:
    """Read the first of TOPICS that a log has; messages of another size are none."""
    name = next((name for name in TOPICS if name in run.topics), None)
    if name is None:
        return
    found = defaultdict(list)
    for _, group in reader.groups([run.topics[name]]):
        for message in group:
            top = _top_at(tops, message.log_time - run.epoch_ns)
            if len(message.data) == len(top.templates[name]):
                found[top].append(message)
    for top, messages in found.items():
        top.add_messages(name, [one.data for one in messages],
                         [one.log_time for one in messages])


def _read_foreign(reader: LogReader, name: str) -> SampledTrack:
    """Read the attitudes in a log of another program, from its first topic that has some."""
    track = SampledTrack(name, parameters.checked({}), has_body=False)
    for topic in reader.topics:
        if topic.type_name not in LAYOUTS:
            continue
        stamps_ns, quaternions = [], []
        for message in reader.messages([topic.name]):
            with contextlib.suppress(ValueError):       # undecodable, or without
                stamp_ns, quaternion, _ = decode(message.data, topic.type_name)
                norm = float(np.linalg.norm(quaternion))
                if 0.5 < norm < 2.0:
                    stamps_ns.append(stamp_ns)
                    quaternions.append(quaternion / norm)
        if stamps_ns:
            rows = np.full((len(stamps_ns), WIDTH), np.nan)
            rows[:, QUATERNION] = quaternions
            track.add(np.array(stamps_ns, np.int64), rows)
            track.epoch_ns = int(track.stamps_ns[0])
            break
    return track


def _follow_run(tops: Tops, run: recorded_run.RunDescription, end_ns: int) -> None:
    """Add the motions of a run to its tops."""
    for simulation, done in recorded_run.rerun(run, end_ns):
        if not isinstance(done, Block) and done.event.begins_report:
            now_ns = max(simulation.now_ns, 0)
            t_ns = simulation.epoch_ns + now_ns - run.epoch_ns
            _top_at(tops, t_ns).motions.append(
                (t_ns, Motion.of_piece(simulation.trajectory.after(now_ns))))


class LogSource:
    """The source of a page that plays the tops of each of one log or two."""

    def __init__(self, page: Page, logs: Sequence[Tops]) -> None:
        self._logs = logs
        tops = [top for log in logs for top in log]
        page.message.content = '\n'.join(f'*{top.note}*' for top in tops if top.note)
        begin_ns = min(top.span[0] for top in tops)
        self.player = Player(
            page, begin_ns, max(top.span[1] for top in tops),
            sorted({t_ns for log in logs for t_ns, _ in log[0].motions[1:]}))
        # A file shows one top of each log.
        self.player.file_end_ns = min(
            [self.player.file_end_ns, *(log[0].span[1] for log in logs if len(log) > 1)])

    def update(self, seconds: float) -> int:
        return self.player.advance(seconds)

    def tracks_at(self, t_ns: int) -> list[SampledTrack]:
        return [_top_at(tops, t_ns) for tops in self._logs]
