# SPDX-License-Identifier: Apache-2.0
"""The source of a page for a log: reads its tops, and plays them."""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.view.page import Page
from spinning_top_sim.view.player import Player
from spinning_top_sim.view.samples import TOPICS, SampledTrack


class LogSource:
    """
    The source of a page that plays a log of this package, which may be truncated.

    open_page : opens the page, when the log has been read

    Raises LogError.
    """

    def __init__(self, path: Path, open_page: Callable[[], Page]) -> None:
        self._tops: list[SampledTrack] = []     # another one from each reset to another top on
        with LogReader(path) as reader:
            try:
                changes_ns = self._read(reader, recorded_run.read_run_description(reader))
            except recorded_run.ForeignLogError as error:
                raise LogError(f'{path}: {error}') from error
            note = '' if reader.whole else f'*{path.name} is damaged: what is whole is shown*'
        self._tops = [top for top in self._tops if len(top.rows)]
        if not self._tops:
            raise LogError(f'{path}: no attitude of the top in it ({", ".join(TOPICS)})')
        self.page = open_page()
        self.page.message.content = note
        first = self._tops[0]
        self.player = Player(self.page, first.span[0], self._tops[-1].span[1], changes_ns)
        # A file shows one top.
        self.player.file_end_ns = min(self.player.file_end_ns, first.span[1])

    def _read(self, reader: LogReader, run: recorded_run.RunDescription) -> list[int]:
        """Read the tops and their samples; return where other motions have their first one."""
        self._tops = [SampledTrack(run.values_in_effect, run.epoch_ns)]
        for _, event in run.events:
            if event.kind == 'reset':
                before, values = self._tops[-1].values, event.details['parameters']
                if any(values[key] != before[key] for key in values
                       if key.startswith('top.') or key == 'imu.rpy'):
                    self._tops.append(SampledTrack(values, run.epoch_ns))
                    self._tops[-1].begin_ns = event.details['epoch_ns'] - run.epoch_ns
        found = defaultdict(list)
        name = next((name for name in TOPICS if name in run.topics), '')
        for message in reader.messages([run.topics[name]] if name else []):
            top = self.track_at(message.log_time - run.epoch_ns)
            if len(message.data) == len(top.templates[name]) and (      # else it is none
                    message.log_time <= recorded_run.LAST_LOG_TIME_NS):
                found[top].append(message)
        for top, messages in found.items():
            top.add_messages(name, [one.data for one in messages],
                             [one.log_time for one in messages])
        stamps_ns = np.concatenate([top.stamps_ns for top in self._tops])
        # A sample at the instant of an event belongs to the motion before it.
        return [int(stamp_ns) - run.epoch_ns for begin_ns, event in run.events
                if event.begins_report and event.kind != 'start'
                for stamp_ns in stamps_ns[stamps_ns > begin_ns][:1]]

    def update(self, seconds: float) -> int:
        return self.player.advance(seconds)

    def track_at(self, t_ns: int) -> SampledTrack:
        """Return the top at a time, the first one before that begins."""
        return self._tops[max(bisect_right(
            self._tops, t_ns, key=lambda top: top.begin_ns) - 1, 0)]
