# SPDX-License-Identifier: Apache-2.0
"""The page: scene, words and plots, made with viser; the same whatever its source is."""

import html
import json
import math
import threading
import time
from pathlib import Path
from typing import Any

import viser

from spinning_top_sim.recording.errors import reason_of
from spinning_top_sim.view import plots, text
from spinning_top_sim.view.drawn import ARROWS, BOUNDS, FOOT, TRACE, DrawnTop, axis_length
from spinning_top_sim.view.server import Server
from spinning_top_sim.view.source import WINDOW_NS, Source, Track

RATE = 30.0                     # pictures per second
LONGEST_STEP_S = 0.2            # of real time between two pictures; a longer one is not made up
LAST_WORDS_S = 0.2              # time to send the last texts
AFTER_ERROR_S = 1.0             # till a source that has raised an error is asked again
PLOT_EVERY, SETTLED = 6, 20     # pictures
PANEL_WIDTH = 330               # [px]
STYLE = Path(__file__).with_name('page.css').read_text('utf-8')


def set_value(handle: Any, value: object) -> None:
    """Show a value in an input; viser declares `value` without its setter."""
    handle.value = value


def set_content(handle: viser.GuiHtmlHandle | viser.GuiMarkdownHandle, content: str) -> None:
    """Show a text; it is sent only if it is another one."""
    if handle.content != content:
        handle.content = content


class Page:
    """
    The page, with its own server.

    One thread calls `draw`.  Threads of viser call what inputs call back: it may set `message`
    and inputs.

    server, gui : of viser
    address : of the page, http://...
    title : such as the name of the log
    controls : the folder for the controls of a source
    message : what was done, or the reason why not
    arrows : the switches of ARROWS, by name
    """

    def __init__(self, title: str, host: str, port: int | None) -> None:
        self.server = Server(host, port)
        shown_host = f'[{host}]' if ':' in host else host
        self.address = f'http://{shown_host}:{self.server.get_port()}'
        gui = self.gui = self.server.gui
        self.title = title
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='medium')
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        # viser has no option for the title of the tab.
        named = html.escape(f'document.title = {json.dumps(title)}')
        gui.add_html(f'<style onload="{named}">{STYLE}</style>')
        self._words = gui.add_html(f'<p>{text.NO_SAMPLES}</p>')
        self.message = gui.add_markdown('')
        self.controls = gui.add_folder('Control')
        with gui.add_folder('Show'):
            self._legend = gui.add_html('')
            self._trace = gui.add_checkbox('trace of the axis', True)
            self._bounds = gui.add_checkbox('bounds of θ', True)
            self.arrows = {name: gui.add_checkbox(name, False) for name in ARROWS}
        panel = gui.add_panel()
        with panel.add_tab('Plots'):
            self._plots = gui.add_html('')
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        panel.expand()              # also on a phone, where it is below
        self._top: DrawnTop | None = None
        self._number = 0            # of the picture

    def close(self) -> None:
        """Stop the server; browsers go on to show the last texts."""
        self.server.flush()
        time.sleep(LAST_WORDS_S)
        self.server.stop()

    def show(self, source: Source, stopped: threading.Event) -> None:
        """
        Draw pictures of a source until the event; time passes while somebody looks at it.

        An exception of the source is shown, and does not end the page.
        """
        before = time.monotonic()
        while not stopped.is_set():
            now = time.monotonic()
            seconds = min(now - before, LONGEST_STEP_S) if self.server.get_clients() else 0.0
            try:
                t_ns = source.update(seconds)
                if source.track is not None:
                    self.draw(t_ns, source.track)
            except Exception as error:
                set_content(self.message, f'**{reason_of(error)}**')
                stopped.wait(AFTER_ERROR_S)
            stopped.wait(max(now + 1.0 / RATE - time.monotonic(), 0.0))
            before = now

    def draw(self, t_ns: int, track: Track) -> None:
        """Draw a top at a time, now and then with its plots and words."""
        self.draw_scene(t_ns, track)
        if self._number % PLOT_EVERY == 0:
            set_content(self._plots, ''.join(map(plots.draw, (
                plots.potential_plot(track, t_ns),
                *plots.time_plots(track, t_ns, t_ns - WINDOW_NS, t_ns)))))
            set_content(self._words, text.words(track, t_ns))
            set_content(self._legend, self.legend())
        self._number += 1

    def draw_scene(self, t_ns: int, track: Track) -> None:
        """Draw a top at a time in the scene alone."""
        # Meshes take longer than a picture: they wait till a slider rests.
        if self._top is None or (self._number == SETTLED and self._top.top != track.top):
            self._top = self._new_top(track)
        if self._top.track is not track:
            self._top.track, self._number = track, 0
        newest_ns = track.newest(t_ns)
        with self.server.atomic():
            if newest_ns is not None:       # the picture follows the pivot: the ground moves
                size = abs(axis_length(track))
                x, y, z = track.state(newest_ns).pivot.position[:, 0].tolist()
                self._ground.position = -(x % size), -(y % size), -FOOT * size - z
            self._top.draw(t_ns, trace=self._trace.value, bounds=self._bounds.value, arrows={
                name for name, switch in self.arrows.items() if switch.value})

    def _new_top(self, track: Track) -> DrawnTop:
        """Return another top in the scene, with its ground and for its size."""
        if self._top is not None:
            self._top.root.remove()
        scene, camera, size = self.server.scene, self.server.initial_camera, abs(
            axis_length(track))
        self._ground = scene.add_grid(
            '/ground', infinite_grid=True, cell_size=0.5 * size, section_size=size,
            cell_color=(238, 240, 244), section_color=(228, 231, 236), fade_distance=9 * size,
            fade_from='origin', shadow_opacity=0.1, position=(0.0, 0.0, -FOOT * size))
        camera.fov = math.radians(35.0)
        camera.position = (0.0, -4.8 * size, 2.0 * size)
        camera.look_at = (0.0, 0.0, 0.1 * size)
        camera.near, camera.far = 0.01 * size, 100.0 * size
        return DrawnTop(scene, track)

    def legend(self) -> str:
        """Return HTML about the colours of what is switched on."""
        switches = ((TRACE, self._trace), (BOUNDS, self._bounds),
                    *((ARROWS[name], switch) for name, switch in self.arrows.items()))
        return '<div class="top-legend">' + ''.join(
            f'<div><i style="background:rgb{colour}"></i>{switch.label}</div>'
            for colour, switch in switches if switch.value) + '</div>'
