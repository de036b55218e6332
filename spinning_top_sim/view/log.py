# SPDX-License-Identifier: Apache-2.0
"""The source of a page for a log: reads its top, and plays it."""

from collections.abc import Callable
from pathlib import Path

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.events import RESTARTS
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
        with LogReader(path) as reader:
            try:
                run = recorded_run.read_run_description(reader)
            except recorded_run.ForeignLogError as error:
                raise LogError(f'{path}: {error}') from error
            self.track = SampledTrack(run.values_in_effect, run.epoch_ns)
            last_ns = _end_of_top(run)
            for topic in [name for name in TOPICS if name in run.topics][:1]:
                messages = [one.data for one in reader.messages(
                    [run.topics[topic]], end=(last_ns or 1 << 62) + 1)]
                length = len(self.track.templates[topic])       # a message of another is not ours
                self.track.add_messages(topic, [one for one in messages if len(one) == length])
            notes = {'is damaged: what is whole is shown': not reader.whole,
                     'is shown up to the reset to another top': last_ns}
        if not len(self.track.rows):
            raise LogError(f'{path}: no attitude of the top in it ({", ".join(TOPICS)})')
        # A sample at the instant of an event belongs to the motion before it.
        changes_ns = [int(stamp_ns) - run.epoch_ns for begin_ns, event in run.events
                      if event.kind in RESTARTS
                      for stamp_ns in self.track.stamps_ns[self.track.stamps_ns > begin_ns][:1]]
        self.page = open_page()
        self.page.message.content = ' '.join(
            f'*{path.name} {note}*' for note, is_so in notes.items() if is_so)
        self.player = Player(self.page, *self.track.span, changes_ns)

    def update(self, seconds: float) -> int:
        return self.player.advance(seconds)


def _end_of_top(run: recorded_run.RunDescription) -> int | None:
    """Return the last log time before a reset to another top [ns], None if there is none."""
    for _, event in run.events:
        values = event.details['parameters'] if event.kind == 'reset' else {}
        if any(values[key] != run.values_in_effect[key] for key in values
               if key.startswith('top.') or key == 'imu.rpy'):
            return int(event.details['epoch_ns']) - 1
    return None
