# SPDX-License-Identifier: Apache-2.0
"""The page of one log, or of two: reads their tracks, and plays them."""

import contextlib
import dataclasses
import html
import itertools
import math
import time
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.attitudes import LAYOUTS, decode
from spinning_top_sim.view.page import CATCH_UP_S, RATE, Page, set_value
from spinning_top_sim.view.track import WIDTHS, Motion, Track

BLOCK = 16384               # messages decoded together
SPEEDS = ('0.1', '0.25', '0.5', '1', '2', '4', '8')
MOST_MARKS = 40             # commands marked on the slider
LONGEST_HTML_S = 60.0


@dataclasses.dataclass(frozen=True)
class Log:
    """What a log shows: a track, the stamp of its t = 0 [ns], and those of its commands [ns]."""

    track: Track
    origin_ns: int
    commands_ns: Sequence[int]
    note: str                       # what is missing, '' if nothing is

    @property
    def span(self) -> tuple[int, int]:
        assert self.track.span is not None      # `read_log` refuses a log without samples
        return self.track.span


def read_log(path: Path, name: str, others: Mapping[str, Any]) -> Log:
    """
    Return a log, also a truncated one, or raise LogError.

    others : parameters of the top that is drawn for a log that this package did not record
    """
    origin_ns: int | None = None
    commands_ns: list[int] = []
    with LogReader(path) as reader:
        note = '' if reader.whole else 'it is truncated: shown as far as it goes'
        try:
            run = recorded_run.read_run_description(reader)
        except recorded_run.ForeignLogError as error:
            track = _read_foreign(reader, name, others, str(error))
        else:
            track = Track(name, run.values_in_effect)
            _read_samples(reader, track, run.topics)
            origin_ns = run.epoch_ns
            try:
                for simulation, event in recorded_run.rerun(run, reader.span[1]):
                    if event is None or event.name == 'parameters':
                        continue
                    segment, at_ns = simulation.segment, max(simulation.now_ns, 0)
                    track.motions.append(Motion.of(
                        simulation.epoch_ns + at_ns, segment.start, simulation.describe()))
                    if event.name == 'command':
                        commands_ns.append(simulation.epoch_ns + at_ns)
            except (recorded_run.DepartureError, *recorded_run.ODD) as error:
                note = '; '.join(filter(None, (
                    note, f'the run cannot be followed: {recorded_run.reason_of(error)}')))
    if track.span is None:
        raise LogError(f'{path}: no attitude of a top in it')
    return Log(track, track.span[0] if origin_ns is None else origin_ns, commands_ns,
               f'{path.name}: {note}' if note else '')


def _read_samples(reader: LogReader, track: Track, topics: Mapping[str, str]) -> None:
    """Read the samples of a log of this package; `topics` as in RunDescription."""
    names = {topics[name]: name for name in WIDTHS if name in topics}
    messages = reader.messages(topics=names)
    while block := list(itertools.islice(messages, BLOCK)):
        for topic, group in itertools.groupby(
                sorted(block, key=attrgetter('topic')), attrgetter('topic')):
            samples = list(group)
            track.add(names[topic], [sample.log_time for sample in samples],
                      [sample.data for sample in samples])


def _read_foreign(reader: LogReader, name: str, values: Mapping[str, Any],
                  reason: str) -> Track:
    """Read the first topic of a log that has an attitude."""
    topics = [topic for topic in reader.topics if topic.type_name in LAYOUTS]
    if not topics:
        raise LogError(f'{reader.path}: no topic with an attitude ({", ".join(LAYOUTS)}); '
                       f'{reason}')
    track = Track(name, values)
    for topic in topics:
        stamps_ns, rows = [], []
        for message in reader.messages(topics=[topic.name]):
            with contextlib.suppress(ValueError):
                attitude = decode(message.data, topic.type_name)
                norm = math.hypot(*attitude.quaternion)
                if 0.5 < norm < 2.0:
                    stamps_ns.append(attitude.stamp_ns)
                    rows.append(attitude.quaternion / norm)
        if rows:
            track.columns['pose'].append(np.array(stamps_ns), np.array(rows))
            break
    return track


def read_logs(paths: Sequence[Path]) -> list[Log]:
    """Return one log or two; each shows its own top, or that of the other.  Raises LogError."""
    names = [path.stem for path in paths] if len(paths) > 1 else ['']
    others: Mapping[str, Any] = parameters.checked({})
    for path in paths:
        with LogReader(path) as reader, contextlib.suppress(recorded_run.ForeignLogError):
            others = recorded_run.read_run_description(reader).values_in_effect
    return [read_log(path, name, others) for path, name in zip(paths, names, strict=True)]


class Player:
    """Plays logs on a page; the clock is the time since the begin of the first [s]."""

    def __init__(self, page: Page, logs: Sequence[Log]) -> None:
        self._page, self._logs = page, logs
        (first_ns, _), origin_ns = logs[0].span, logs[0].origin_ns
        # Logs of one time lie on each other; else each begins with its t = 0.
        self._shifts_ns = [0 if log.span[0] < logs[0].span[1] and first_ns < log.span[1]
                           else log.origin_ns - origin_ns for log in logs]
        self._begin_ns = min(log.span[0] - shift for log, shift in zip(
            logs, self._shifts_ns, strict=True))
        self.length = max(log.span[1] - shift - self._begin_ns for log, shift in zip(
            logs, self._shifts_ns, strict=True)) / NANOSECONDS
        self._commands = sorted({(stamp_ns - shift - self._begin_ns) / NANOSECONDS
                                 for log, shift in zip(logs, self._shifts_ns, strict=True)
                                 for stamp_ns in log.commands_ns})
        page.set_tracks([log.track for log in logs])
        page.message.content = '\n'.join(f'*{log.note}*' for log in logs if log.note)
        gui = page.gui
        with page.controls:
            self._button = gui.add_button('Pause')
            self._speed = gui.add_dropdown('speed', SPEEDS, initial_value='1')
            self._slider = gui.add_slider(
                'time [s]', 0.0, max(self.length, 1e-3), max(self.length, 1e-3) / 10_000, 0.0,
                marks=tuple(self._commands[:MOST_MARKS]) or None)
            self._next = gui.add_button('Next command', disabled=not self._commands)
        self._now, self._plays, self._seen = 0.0, True, time.monotonic()
        self._button.on_click(lambda _: self._switch())
        self._next.on_click(lambda _: self._go_to_next())
        self._drawn_at = self._slider.value

    def _switch(self) -> None:
        if not self._plays and self._now >= self.length:
            self._now = 0.0
        self._plays = not self._plays
        self._button.label = 'Pause' if self._plays else 'Play'

    def _follow_slider(self) -> None:
        """
        Go where a user has moved the slider.

        A callback may come so late that the next picture has put the slider back.
        """
        if self._slider.value != self._drawn_at:
            self._now = float(self._slider.value)

    def _go_to_next(self) -> None:
        """Go to the next command, behind the last one to the first."""
        behind = bisect_right(self._commands, self._now + 1e-9)
        self._now = self._commands[behind % len(self._commands)]

    def play(self) -> None:
        """Show pictures until KeyboardInterrupt."""
        due = time.monotonic()
        while True:
            due = max(due + 1.0 / RATE, time.monotonic() - CATCH_UP_S)
            self.draw_next(float(self._speed.value) / RATE if self._plays else 0.0)
            time.sleep(max(due - time.monotonic(), 0.0))

    def draw_next(self, step: float) -> None:
        """Draw the picture of now, which is so many seconds after the one before."""
        self._follow_slider()
        self._now = min(self._now + step, self.length)
        if self._plays and self._now >= self.length:
            self._switch()
        if self._now != self._drawn_at:
            set_value(self._slider, self._now)
            self._drawn_at = self._slider.value
        self.draw(self._now)

    def draw(self, now: float) -> None:
        """Draw the picture of a time [s]."""
        at_ns = self._begin_ns + round(now * NANOSECONDS)
        self._page.draw([at_ns + shift for shift in self._shifts_ns], self._logs[0].origin_ns)

    def write_html(self, path: Path) -> str:
        """Write a file that plays the first minute by itself; return what is in it."""
        self.draw(0.0)
        serializer = self._page.server.get_scene_serializer()
        seconds = min(self.length, LONGEST_HTML_S)
        for picture in range(1, int(seconds * RATE) + 1):
            serializer.insert_sleep(1.0 / RATE)
            self.draw(picture / RATE)
        motions = [motion for log in self._logs for motion in log.track.motions[:1]]
        caption = ''.join(f'<b>{html.escape(motion.words[0])}</b><br>' + ''.join(
            f'{html.escape(words)}<br>' for words in motion.words[1:]) for motion in motions)
        text = serializer.as_html().replace('</body>', (
            '<div style="position:fixed;top:1em;right:1em;text-align:right;color:#333;'
            f'font:14px sans-serif;pointer-events:none">{caption}</div></body>'))
        path.write_text(text, encoding='utf-8')
        return f'{seconds:g} of {self.length:g} s, {len(text.encode()) / 1e6:.1f} MB'
