# SPDX-License-Identifier: Apache-2.0
"""The page of one log or two: reads their tracks, and plays them."""

import contextlib
import itertools
import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import MALFORMED, LogError, reason_of
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.play import Block
from spinning_top_sim.tools import cli, recorded_run
from spinning_top_sim.tools.foreign_messages import LAYOUTS, decode
from spinning_top_sim.view import plots, svg, text
from spinning_top_sim.view.page import CATCH_UP_S, RATE, Page, set_value
from spinning_top_sim.view.track import (
    WIDTHS,
    DescribedMotion,
    Series,
    Track,
    attitude_rows,
    joined,
)

SPEEDS = ('0.1', '0.25', '0.5', '1', '2', '4', '8')
LONGEST_HTML_S = 60.0


def read_logs(paths: Sequence[Path]) -> list[list[Track]]:
    """
    Return the tracks of each of one log or two, which may be truncated.  Raises LogError.

    A log has one track, and another one from each reset on that makes another top of it.
    """
    return [_read_log(path, path.stem if len(paths) > 1 else '') for path in paths]


def _read_log(path: Path, name: str) -> list[Track]:
    with LogReader(path) as reader:
        notes = [] if reader.whole else ['it is truncated: shown as far as it goes']
        try:
            run = recorded_run.read_run_description(reader)
        except recorded_run.ForeignLogError as error:
            tracks = [_read_foreign(reader, name)]
            notes.append(str(error))
        else:
            tracks = _new_tracks(run, name)
            _read_samples(reader, tracks, run)
            try:
                _follow_run(tracks, run, reader.span[1])
            except MALFORMED as error:
                notes.append(f'the run cannot be followed: {reason_of(error)}')
    tracks = [track for track in tracks if len(track.attitudes.rows)]
    if not tracks:
        raise LogError(f'{path}: no attitude in it ({", ".join(LAYOUTS)})')
    if notes:
        tracks[0].note = f'{path.name}: {"; ".join(notes)}'
    return tracks


def _new_tracks(run: recorded_run.RunDescription, name: str) -> list[Track]:
    """Return tracks without samples, one for each top or mounting of the IMU in a run."""
    tracks = [Track(name, run.values_in_effect)]
    for _, event in run.events:
        if event.kind == 'reset':
            before, values = tracks[-1].values, event.details['parameters']
            if any(values[key] != before[key] for key in values
                   if key.startswith('top.') or key == 'imu.rpy'):
                tracks.append(Track(name, values))
                tracks[-1].begin_ns = event.details['epoch_ns']
    for track in tracks:
        track.epoch_ns = run.epoch_ns
    return tracks


def _track_at(tracks: Sequence[Track], stamp_ns: int) -> Track:
    """Return the track of a log that a stamp belongs to, the first one before that begins."""
    return tracks[max(bisect_right(tracks, stamp_ns, key=lambda track: track.begin_ns) - 1, 0)]


def _read_samples(reader: LogReader, tracks: Sequence[Track],
                  run: recorded_run.RunDescription) -> None:
    """Read the samples of a log of this package; messages of another size are none."""
    names = {run.topics[name]: name for name in WIDTHS if name in run.topics}
    parts = defaultdict(list)
    for topic, group in reader.groups(names):
        name = names[topic]
        for track, part in itertools.groupby(group, lambda one: _track_at(tracks, one.log_time)):
            fitting = [one for one in part if len(one.data) == len(track.templates[name])]
            parts[track, name].append(track.decode(
                name, [one.data for one in fitting], [one.log_time for one in fitting]))
    for (track, name), samples in parts.items():
        track.samples[name] = joined(samples)


def _read_foreign(reader: LogReader, name: str) -> Track:
    """Read the attitudes in a log of another program, from its first topic that has some."""
    track = Track(name, parameters.checked({}), has_body=False)
    for topic in reader.topics:
        found: dict[int, NDArray[np.float64]] = {}
        if topic.type_name not in LAYOUTS:
            continue
        for message in reader.messages([topic.name]):
            with contextlib.suppress(ValueError):       # undecodable, or without
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


def _follow_run(tracks: Sequence[Track], run: recorded_run.RunDescription, end_ns: int) -> None:
    for simulation, done in recorded_run.rerun(run, end_ns):
        if isinstance(done, Block) or not done.event.begins_report:
            continue
        begin_ns = simulation.epoch_ns + max(simulation.now_ns, 0)
        track = _track_at(tracks, begin_ns)
        piece = simulation.trajectory.after(max(simulation.now_ns, 0))
        track.motions.append(DescribedMotion.of(
            begin_ns, track.top, piece.start, piece.describe(), pivot_moves=not piece.rests))
        if done.event.kind == 'command':
            track.commands_ns.append(begin_ns)


class Player:
    """
    Plays logs on a page; its time [s] begins with the first sample, and ends at `length`.

    logs : the tracks of each, as from `read_logs`
    """

    def __init__(self, page: Page, logs: Sequence[Sequence[Track]]) -> None:
        self._page = page
        self._epoch_ns = logs[0][0].epoch_ns      # t = 0 of all logs coincides
        self._logs = [(tracks, tracks[0].epoch_ns - self._epoch_ns) for tracks in logs]
        self._shown: list[Track] = []
        shifted = [(track, shift_ns) for tracks, shift_ns in self._logs for track in tracks]
        self._begin_ns = min(track.span[0] - shift_ns for track, shift_ns in shifted)
        self.length = self._seconds(max(track.span[1] - shift_ns for track, shift_ns in shifted))
        self._commands = sorted({self._seconds(stamp_ns - shift_ns)
                                 for track, shift_ns in shifted for stamp_ns in track.commands_ns})
        page.message.content = '\n'.join(f'*{track.note}*' for track, _ in shifted if track.note)
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
        """Draw the picture at a time [s], of the tops that are there then."""
        page_ns = self._begin_ns + round(now * NANOSECONDS)
        present = [_track_at(tracks, page_ns + shift_ns) for tracks, shift_ns in self._logs]
        if present != self._shown:
            self._shown = present
            self._page.set_tracks(present, [shift_ns for _, shift_ns in self._logs])
        self._page.draw(page_ns, self._epoch_ns)

    def write_html(self, path: Path) -> str:
        """
        Write a file that plays the first minute by itself; return its length and size.

        It ends before the first reset to another top, as its plots are of one.
        """
        page, begin_ns = self._page, self._begin_ns
        clock = page.server.scene.add_frame('/clock', show_axes=False)
        start = (begin_ns - self._epoch_ns) / NANOSECONDS
        clock.position = (start, 0.0, 0.0)          # read by the script of the file
        self.draw(0.0)
        seconds = min(self.length, LONGEST_HTML_S, *(
            self._seconds(tracks[0].span[1] - shift_ns)
            for tracks, shift_ns in self._logs if len(tracks) > 1))
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
        with cli.new_file(path) as file:
            file.write(document)
        return f'{seconds:g} of {self.length:g} s, {len(document.encode()) / 1e6:.1f} MB'
