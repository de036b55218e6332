# SPDX-License-Identifier: Apache-2.0
"""The time of a page that has its own: buttons play it, and a file plays it by itself."""

import html
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue
from string import Template

from spinning_top_sim.files import new_file
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view import plots, text
from spinning_top_sim.view.page import RATE, STYLE, Page, set_value
from spinning_top_sim.view.source import Track

SPEEDS = ('0.01', '0.1', '0.25', '0.5', '1', '2', '4', '8')
STEP_NS = 20_000_000
LONGEST_FILE_NS = 60 * NANOSECONDS


class Player:
    """
    A time that passes, from `begin_ns` to `end_ns`; None: for ever.

    now_ns : the present time [ns]
    motions_ns : ascending times at which other motions begin [ns]
    file_end_ns : end of what a file shows, the first minute at most [ns]
    """

    def __init__(self, page: Page, begin_ns: int = 0, end_ns: int | None = None,
                 motions_ns: Sequence[int] = ()) -> None:
        self.begin_ns, self.end_ns, self.motions_ns = begin_ns, end_ns, motions_ns
        self.now_ns, self._plays = begin_ns, True
        self.file_end_ns = begin_ns + LONGEST_FILE_NS
        if end_ns is not None:
            self.file_end_ns = min(self.file_end_ns, end_ns)
        # What buttons ask for, by threads of viser; done by the thread that draws.
        self._asked: SimpleQueue[Callable[[], None]] = SimpleQueue()
        gui = page.gui
        with page.controls:
            self._pause = gui.add_button('Pause')
            buttons = {'Step': self._step, 'Reset': self._reset}
            group = gui.add_button_group('time', tuple(buttons))
            self._speed = gui.add_dropdown('speed', SPEEDS, initial_value='1')
            length = self._seconds(end_ns) if end_ns is not None else 0.0
            self._slider = gui.add_slider(
                'time [s]', 0.0, max(length, 1e-3), max(length, 1e-3) / 10_000, 0.0,
                marks=tuple(map(self._seconds, motions_ns)) or None, visible=end_ns is not None)
        self._pause.on_click(lambda _: self._asked.put(self._switch))
        group.on_click(lambda _: self._asked.put(buttons[group.value]))
        self._shown = self._slider.value

    def _seconds(self, t_ns: int) -> float:
        return (t_ns - self.begin_ns) / NANOSECONDS

    def advance(self, seconds: float) -> int:
        """Do what the controls ask for, and let real time pass [s]; return the present time."""
        while not self._asked.empty():
            self._asked.get()()
        # A callback of the slider could come after the next picture, which puts it back.
        if self._slider.value != self._shown:
            self.now_ns = self.begin_ns + round(self._slider.value * NANOSECONDS)
        if self._plays:
            self.now_ns += round(seconds * float(self._speed.value) * NANOSECONDS)
        if self.end_ns is not None:
            if self.now_ns >= self.end_ns:
                self.stop_at(self.end_ns)
            if self._seconds(self.now_ns) != self._shown:
                set_value(self._slider, self._seconds(self.now_ns))
        self._shown = self._slider.value
        return self.now_ns

    def stop_at(self, t_ns: int) -> None:
        """Stay at a time until somebody presses a button."""
        self.now_ns = t_ns
        self._play(False)

    def _play(self, on: bool) -> None:
        self._plays = on
        label = 'Pause' if on else 'Play'
        if self._pause.label != label:
            self._pause.label = label

    def _switch(self) -> None:
        if not self._plays and self.now_ns == self.end_ns:
            self.now_ns = self.begin_ns
        self._play(not self._plays)

    def _step(self) -> None:
        self.stop_at(self.now_ns + STEP_NS)

    def _reset(self) -> None:
        self.now_ns = self.begin_ns


def write_file(path: Path, page: Page, player: Player, track: Track) -> str:
    """Write a file that plays by itself what a player plays; return its length and size."""
    begin_ns, end_ns = player.begin_ns, player.file_end_ns
    clock = page.server.scene.add_frame('/clock', show_axes=False)

    def draw(t_ns: int) -> None:
        clock.position = (t_ns / NANOSECONDS, 0.0, 0.0)      # read by the script of the file
        page.draw_scene(t_ns, track)

    draw(begin_ns)
    motions_ns = [t_ns for t_ns in (begin_ns, *player.motions_ns) if t_ns <= end_ns]
    words = ''.join(text.words(track, t_ns) for t_ns in motions_ns)
    drawn = ''.join(
        f'<section class="potential" data-from="{t_ns / NANOSECONDS}">'
        f'{plots.draw(plots.potential_plot(track, t_ns))}</section>' for t_ns in motions_ns)
    drawn += ''.join(map(plots.draw, plots.time_plots(track, begin_ns, begin_ns, end_ns)))
    serializer = page.server.get_scene_serializer()
    for picture in range(1, int((end_ns - begin_ns) / NANOSECONDS * RATE) + 1):
        serializer.insert_sleep(1.0 / RATE)
        draw(begin_ns + round(picture / RATE * NANOSECONDS))
    document = Template(Path(__file__).with_name('file.html').read_text('utf-8')).substitute(
        title=html.escape(page.title), style=STYLE, legend=page.legend(), words=words,
        plots=drawn, scene=html.escape(serializer.as_html()))
    with new_file(path) as file:
        file.write(document)
    return f'{(end_ns - begin_ns) / NANOSECONDS:g} s, {len(document.encode()) / 1e6:.1f} MB'
