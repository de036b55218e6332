# SPDX-License-Identifier: Apache-2.0
"""The page of one log or two: reads their tracks, and plays them."""

import contextlib
import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import MALFORMED, LogError, reason_of
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.blocks import Block
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.view import plots, svg, text
from spinning_top_sim.view.page import CATCH_UP_S, RATE, Page, set_value
from spinning_top_sim.view.track import DescribedMotion, Series, Track, attitude_rows, joined

SPEEDS = ('0.1', '0.25', '0.5', '1', '2', '4', '8')
LONGEST_HTML_S = 60.0


def read_logs(paths: Sequence[Path]) -> list[Track]:
    """Return the tracks of one log or two, which may be truncated.  Raises LogError."""
    return [_read_log(path, path.stem if len(paths) > 1 else '') for path in paths]


def _read_log(path: Path, name: str) -> Track:
    with LogReader(path) as reader:
        notes = [] if reader.whole else ['it is truncated: shown as far as it goes']
        try:
            run = recorded_run.read_run_description(reader)
        except recorded_run.ForeignLogError as error:
            track = _read_foreign(reader, name)
            notes.append(str(error))
        else:
            track = Track(name, run.values_in_effect)
            track.epoch_ns = run.epoch_ns
            _read_samples(reader, track, run.topics)
            try:
                _follow_run(track, run, reader.span[1])
            except MALFORMED as error:
                notes.append(f'the run cannot be followed: {reason_of(error)}')
    if not len(track.attitudes.rows):
        raise LogError(f'{path}: no attitude in it ({", ".join(LAYOUTS)})')
    if notes:
        track.note = f'{path.name}: {"; ".join(notes)}'
    return track


def _read_samples(reader: LogReader, track: Track, topics: Mapping[str, str]) -> None:
    """Read the samples of a log of this package; `topics` as in RunDescription."""
    names = {topics[name]: name for name in track.samples if name in topics}
    parts = defaultdict(list)
    for topic, group in reader.groups(names):
        stamps_ns, data = zip(*((one.log_time, one.data) for one in group), strict=True)
        parts[names[topic]].append(track.decode(names[topic], data, stamps_ns))
    for name, samples in parts.items():
        track.samples[name] = joined(samples)


def _read_foreign(reader: LogReader, name: str) -> Track:
    """Read the attitudes in a log of another program, from its first topic that has some."""
    track = Track(name, parameters.checked({}), has_body=False)
    for topic in reader.topics:
        found: dict[int, NDArray[np.float64]] = {}
        if topic.type_name not in LAYOUTS:
            continue
        for message in reader.messages([topic.name]):
            with contextlib.suppress(ValueError):       # without an orientation
                stamp_ns, quaternion, _ = decode(message.data, topic.type_name)
                norm = float(np.linalg.norm(quaternion))
                if 0.5 < norm < 2.0:
                    found[stamp_ns] = quaternion / norm
        if found:
            track.add('pose', Series(np.array(list(found), np.int64), attitude_rows(
                np.array(list(found.values())), place=0.0)))
            track.epoch_ns = track.span[0]
            break
    return track


def _follow_run(track: Track, run: recorded_run.RunDescription, end_ns: int) -> None:
    for simulation, event in recorded_run.rerun(run, end_ns):
        if isinstance(event, Block) or event.name == 'parameters':
            continue
        begin_ns = simulation.epoch_ns + max(simulation.now_ns, 0)
        track.motions.append(DescribedMotion.of(
            begin_ns, track.top, simulation.segment.start, simulation.describe(),
            pivot_moves=simulation.segment.ride is not None))
        if event.name == 'command':
            track.commands_ns.append(begin_ns)


class Player:
    """Plays logs on a page; its time [s] begins with the first sample, and ends at `length`."""

    def __init__(self, page: Page, tracks: Sequence[Track]) -> None:
        self._page = page
        self._epoch_ns = tracks[0].epoch_ns       # t = 0 of all logs coincides
        shifts_ns = [track.epoch_ns - self._epoch_ns for track in tracks]
        shifted = list(zip(tracks, shifts_ns, strict=True))
        self._begin_ns = min(track.span[0] - shift_ns for track, shift_ns in shifted)
        self.length = self._seconds(max(track.span[1] - shift_ns for track, shift_ns in shifted))
        self._commands = sorted({self._seconds(stamp_ns - shift_ns)
                                 for track, shift_ns in shifted for stamp_ns in track.commands_ns})
        page.set_tracks(tracks, shifts_ns)
        page.message.content = '\n'.join(f'*{track.note}*' for track in tracks if track.note)
        gui = page.gui
        with page.controls:
            self._button = gui.add_button('Pause')
            self._speed = gui.add_dropdown('speed', SPEEDS, initial_value='1')
            self._slider = gui.add_slider(
                'time [s]', 0.0, max(self.length, 1e-3), max(self.length, 1e-3) / 10_000, 0.0,
                marks=tuple(self._commands) or None)
            self._next = gui.add_button('Next command', disabled=not self._commands)
        self._now, self._plays = 0.0, True
        self._button.on_click(lambda _: self._switch())
        self._next.on_click(lambda _: self._go_to_next())
        self._drawn_at = self._slider.value

    def _seconds(self, page_ns: int) -> float:
        return (page_ns - self._begin_ns) / NANOSECONDS

    def _switch(self) -> None:
        if not self._plays and self._now >= self.length:
            self._now = 0.0
        self._plays = not self._plays
        self._button.label = 'Pause' if self._plays else 'Play'

    def _go_to_next(self) -> None:
        behind = bisect_right(self._commands, self._now + 1e-9)
        self._now = self._commands[behind % len(self._commands)]

    def play(self) -> None:
        """Show pictures until KeyboardInterrupt; the log waits for somebody who looks at it."""
        due = time.monotonic()
        while True:
            due = max(due + 1.0 / RATE, time.monotonic() - CATCH_UP_S)
            plays = self._plays and self._page.server.get_clients()
            self.draw_next(float(self._speed.value) / RATE if plays else 0.0)
            time.sleep(max(due - time.monotonic(), 0.0))

    def draw_next(self, step: float) -> None:
        """Draw the picture that is so many seconds after the one before."""
        # Where a user has moved the slider.  A callback could come after the next picture, which
        # puts the slider back.
        if self._slider.value != self._drawn_at:
            self._now = float(self._slider.value)
        self._now = min(self._now + step, self.length)
        if self._plays and self._now >= self.length:
            self._switch()
        if self._now != self._drawn_at:
            set_value(self._slider, self._now)
            self._drawn_at = self._slider.value
        self.draw(self._now)

    def draw(self, now: float) -> None:
        self._page.draw(self._begin_ns + round(now * NANOSECONDS), self._epoch_ns)

    def write_html(self, path: Path) -> str:
        """Write a file that plays the first minute by itself; return its length and size."""
        page, begin_ns = self._page, self._begin_ns
        clock = page.server.scene.add_frame('/clock', show_axes=False)
        start = (begin_ns - self._epoch_ns) / NANOSECONDS
        clock.position = (start, 0.0, 0.0)          # read by the script of the file
        self.draw(0.0)
        seconds = min(self.length, LONGEST_HTML_S)
        words = ''.join(page.words(begin_ns + round(second * NANOSECONDS), self._epoch_ns)
                        for second in [0.0, *self._commands] if second <= seconds)
        tops = page.plotted(begin_ns, self._epoch_ns, begin_ns,
                            begin_ns + round(seconds * NANOSECONDS))
        serializer = page.server.get_scene_serializer()
        for picture in range(1, int(seconds * RATE) + 1):
            serializer.insert_sleep(1.0 / RATE)
            clock.position = (start + picture / RATE, 0.0, 0.0)
            self.draw(picture / RATE)
        document = text.document(page.title, serializer.as_html(), page.legend(), words, [
            svg.draw(plot) for plot in (*plots.motion_plots(tops), *plots.accuracy_plots(tops))])
        with open(path, 'x', encoding='utf-8') as file:
            file.write(document)
        return f'{seconds:g} of {self.length:g} s, {len(document.encode()) / 1e6:.1f} MB'
