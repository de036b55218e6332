# SPDX-License-Identifier: Apache-2.0
"""The page: scene, words and plots, made with viser; the same for logs and for a running node."""

import math
import time
from typing import TypeVar

import numpy as np
import viser

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools import svg
from spinning_top_sim.view import body, model, plots, text
from spinning_top_sim.view.server import Server
from spinning_top_sim.view.track import DescribedMotion, Track

RATE = 30.0                     # pictures per second
CATCH_UP_S = 0.2                # delay up to which late pictures follow each other at once
LAST_WORDS_S = 0.2              # time to send the last texts
PLOT_EVERY = 6                  # pictures
WINDOW_NS = 10 * NANOSECONDS    # of the plots
PANEL_WIDTH = 330               # [px]
VIEW_ANGLE = math.radians(35.0)
STANDS_TO = math.radians(100.0)     # tilt up to which the pivot stands on a peg; else it hangs
TRACE, BOUNDS = (217, 72, 43), (122, 82, 179)
SPHERE, STAND, FOOT = (190, 200, 215), (120, 126, 136), 0.8
ARROW_COLOURS = ((20, 120, 70), (196, 50, 150), (20, 150, 180), (230, 130, 20))
NO_LINES = np.zeros((1, 2, 3), np.float32)
NO_SAMPLES = 'no samples yet'
Value = TypeVar('Value')


def set_value(handle: viser.GuiInputHandle[Value], value: Value) -> None:
    """Show a value in an input; viser declares `value` without its setter."""
    handle.value = value        # type: ignore[misc]


def set_content(handle: viser.GuiHtmlHandle | viser.GuiMarkdownHandle, content: str) -> None:
    """Show a text; it is sent only if it is another one."""
    if handle.content != content:
        handle.content = content


class Page:
    """
    The page, with its own server.  One thread calls `set_track`, and then `draw`.

    title : such as the name of the log
    controls : the folder for the controls of the source of the samples
    message : what was done, or the reason why not
    arrows : the switches of model.ARROWS
    drawn : stamp [ns] and row of the attitude that is drawn, None if there is none
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
        gui.add_html(f'<style>{text.STYLE}{text.LIVE_STYLE}</style>')
        self._words, self._legend = gui.add_html(f'<p>{NO_SAMPLES}</p>'), gui.add_html('')
        self.message = gui.add_markdown('')
        self.controls = gui.add_folder('Control')
        with gui.add_folder('Show'):
            self._trace = gui.add_checkbox('trace of the axis', True)
            self._bounds = gui.add_checkbox('bounds of θ', True)
            self.arrows = [gui.add_checkbox(name, False) for name in model.ARROWS]
        self._accuracy_folder = gui.add_folder('Accuracy', expand_by_default=False)
        with self._accuracy_folder:
            self._accuracy = gui.add_html('')
        panel = gui.add_panel()
        with panel.add_tab('Plots'):
            self._plots = gui.add_html('')
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        panel.expand()              # also on a phone, where it is below
        self._root: viser.FrameHandle | None = None
        self._number = 0            # of the picture

    def close(self) -> None:
        """Stop the server; browsers go on to show the last texts."""
        self.server.flush()
        time.sleep(LAST_WORDS_S)
        self.server.stop()

    def set_track(self, track: Track) -> None:
        """Show this top."""
        if self._root is not None:
            self._root.remove()
        self._track, far = track, model.reach(track)
        scene, size = self.server.scene, abs(far)
        self._reach = size
        self._accuracy_folder.visible = track.has_body
        for switch in (self._bounds, *self.arrows):
            switch.visible = track.has_body
        self._root = scene.add_frame('/top', show_axes=False)
        self._sphere = scene.add_icosphere('/top/sphere', size, SPHERE, subdivisions=5,
                                           opacity=0.12, side='back', cast_shadow=False,
                                           receive_shadow=False)
        self._body = scene.add_frame('/top/body', show_axes=not track.has_body,
                                     axes_length=0.7 * size, axes_radius=0.015 * size)
        for part in (body.wheel if track.has_body else body.disc)(track.shape, far):
            scene.add_mesh_simple(
                f'/top/body/{part.name}', part.mesh.vertices, part.mesh.faces, color=part.colour,
                flat_shading=part.name != 'axle', side='double')
        peg = body.stand(FOOT * size)
        self._stand = scene.add_mesh_simple('/top/stand', peg.vertices, peg.faces, color=STAND,
                                            side='double')
        self._trace_lines = scene.add_line_segments('/top/trace', NO_LINES, TRACE,
                                                    thickness=0.018 * size)
        self._bound_lines = [scene.add_line_segments(
            f'/top/bound{k}', NO_LINES, BOUNDS, thickness=0.007 * size, visible=False)
            for k in range(2)]
        self._arrow_lines = [scene.add_arrows(
            f'/top/{arrow.replace(" ", "_")}', NO_LINES, colour,
            shaft_radius=0.014 * size, head_radius=0.04 * size, head_length=0.12 * size,
            visible=False) for arrow, colour in zip(model.ARROWS, ARROW_COLOURS, strict=True)]
        self._limits: tuple[float, float] | None = None         # that are drawn [rad]
        self.drawn: tuple[int, model.Vectors] | None = None
        self._shown: object = None                      # stamp and switches of the picture
        self._ground = scene.add_grid(
            '/ground', infinite_grid=True, cell_size=0.5 * size, section_size=size,
            cell_color=(238, 240, 244), section_color=(228, 231, 236), fade_distance=9 * size,
            fade_from='origin', shadow_opacity=0.1, position=(0.0, 0.0, -FOOT * size))
        camera = self.server.initial_camera
        camera.fov = VIEW_ANGLE
        camera.position = (0.0, -4.8 * size, 2.0 * size)
        camera.look_at = (0.0, 0.0, 0.1 * size)
        camera.near, camera.far = 0.01 * size, 100.0 * size

    def draw(self, stamp_ns: int, origin_ns: int) -> None:
        """
        Draw the newest samples up to a stamp [ns].

        origin_ns : stamp of t = 0
        """
        with self.server.atomic():
            self._draw_top(stamp_ns)
        if self._number % PLOT_EVERY == 0:
            motion, accuracy = self.plots(stamp_ns, origin_ns, stamp_ns - WINDOW_NS, stamp_ns)
            set_content(self._plots, motion)
            set_content(self._accuracy, accuracy)
            set_content(self._words, self.words(stamp_ns, origin_ns))
            set_content(self._legend, self.legend())
        self._number += 1

    def _draw_top(self, stamp_ns: int) -> None:
        # The top stays in the picture: the ground moves.
        x, y, z = self._track.place(stamp_ns)
        self._ground.position = -(x % self._reach), -(y % self._reach), -FOOT * self._reach - z
        self.drawn = sample = self._track.attitudes.at(stamp_ns)
        assert self._root is not None
        self._root.visible = sample is not None
        trace, bounds = self._trace.value, self._bounds.value
        arrows = [switch.value for switch in self.arrows]
        shown = sample and (sample[0], trace, bounds, arrows)
        if shown == self._shown:        # as while it is paused
            return
        self._shown = shown
        if sample is None:
            return
        x, y, z, w = sample[1][:4].tolist()
        self._body.wxyz = (w, x, y, z)
        self._trace_lines.visible = self._sphere.visible = trace
        if trace:
            self._draw_trace(model.trace(self._track, stamp_ns))
        for name, arrow, on in zip(model.ARROWS, self._arrow_lines, arrows, strict=True):
            arrow.visible = on
            vector = model.arrow(self._track, name, stamp_ns) if on else None
            arrow.points = NO_LINES if vector is None else model.segments(
                np.vstack((np.zeros(3), vector)))
        self._draw_bounds(self._track.motion_at(stamp_ns), bounds)

    def _draw_trace(self, lines: model.Lines) -> None:
        """Draw a trace that fades with its age; the colours of a line's points are linear."""
        lines = lines if len(lines) else NO_LINES
        if len(lines) != len(self._trace_lines.points):
            share = np.linspace(0.35, 1.0, len(lines))[:, np.newaxis, np.newaxis]
            self._trace_lines.colors = np.broadcast_to(255 * (
                1.0 + share * (np.array(TRACE) / 255 - 1.0)) ** 2.2, lines.shape).astype(np.uint8)
        self._trace_lines.points = lines

    def _draw_bounds(self, motion: DescribedMotion | None, on: bool) -> None:
        moves = motion.description if motion else None
        for bound in self._bound_lines:
            bound.visible = on and moves is not None
        if moves is None or self._limits == (moves.theta_min, moves.theta_max):
            return
        self._limits = moves.theta_min, moves.theta_max
        for bound, theta in zip(self._bound_lines, self._limits, strict=True):
            bound.points = model.circle(model.reach(self._track), theta)
        # A top that comes low hangs from above.
        self._stand.wxyz = (1, 0, 0, 0) if moves.theta_max < STANDS_TO else (0, 1, 0, 0)

    def plots(self, stamp_ns: int, origin_ns: int, begin_ns: int, end_ns: int) -> tuple[str, str]:
        """Return the plots of a span of stamps, with a mark at one, and those of the accuracy."""
        shown = plots.Shown(self._track, stamp_ns, begin_ns, end_ns, origin_ns)
        motion, accuracy = (''.join(map(svg.draw, found)) for found in (
            plots.motion_plots(shown), plots.accuracy_plots(shown)))
        return motion, accuracy

    def words(self, stamp_ns: int, origin_ns: int) -> str:
        """Return HTML about the motion and the sample that is drawn at a stamp."""
        track = self._track
        sample = track.attitudes.at(stamp_ns)
        return f'<p>{NO_SAMPLES}</p>' if sample is None else text.words(
            track, track.motion_at(stamp_ns), sample[0], sample[0] - origin_ns)

    def legend(self) -> str:
        """Return HTML about the colours of what is switched on."""
        entries = [(TRACE, 'trace of the axis')] if self._trace.value else []
        if self._bounds.value and self._track.motions:
            entries.append((BOUNDS, 'bounds of θ'))
        entries += [(colour, name) for name, colour, switch in zip(
            model.ARROWS, ARROW_COLOURS, self.arrows, strict=True) if switch.value]
        return text.legend(entries)
