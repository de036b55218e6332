# SPDX-License-Identifier: Apache-2.0
"""
The page: scene, words and plots, made with viser; the same for logs and for a running node.

On the page are tops whose motions began at different dates.  `page_ns` is a stamp of the first
one; a stamp of another is `page_ns + shift_ns`, so that the t = 0 of all coincide.
"""

import math
import time
from collections.abc import Sequence, Set
from typing import TypeVar

import numpy as np
import viser

from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view import body, plots, shapes, svg, text
from spinning_top_sim.view.server import Server
from spinning_top_sim.view.track import QUATERNION, DescribedMotion, Track

RATE = 30.0                     # pictures per second
CATCH_UP_S = 0.2                # delay up to which late pictures follow each other at once
LAST_WORDS_S = 0.2              # time to send the last texts
PLOT_EVERY = 6                  # pictures
WINDOW_NS = 10 * NANOSECONDS    # of the plots
PANEL_WIDTH = 330               # [px]
VIEW_ANGLE = math.radians(35.0)
STANDS_TO = math.radians(100.0)     # tilt up to which the pivot stands on a peg; else it hangs
TRACES = ((217, 72, 43), (30, 138, 76))
BOUNDS, SPHERE, STAND, FOOT = (122, 82, 179), (190, 200, 215), (120, 126, 136), 0.8
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


class DrawnTop:
    """One top in the scene; `shift_ns` is added to the stamp of the page."""

    def __init__(self, scene: viser.SceneApi, number: int, track: Track, shift_ns: int) -> None:
        self.track, self.shift_ns = track, shift_ns
        name, far = f'/top{number}', shapes.axis_length(track)
        radius = abs(far)
        self.root = scene.add_frame(name, show_axes=False)
        self._sphere = scene.add_icosphere(f'{name}/sphere', radius, SPHERE, subdivisions=5,
                                           opacity=0.12, side='back', cast_shadow=False,
                                           receive_shadow=False)
        self._body = scene.add_frame(f'{name}/body', show_axes=not track.has_body,
                                     axes_length=0.7 * radius, axes_radius=0.015 * radius)
        for part in (body.wheel if track.has_body else body.disc)(track.shape, far):
            scene.add_mesh_simple(
                f'{name}/body/{part.name}', part.mesh.vertices, part.mesh.faces,
                color=part.colour, opacity=0.4 if number else None,
                flat_shading=part.name != 'axle', side='double')
        peg = body.stand(FOOT * radius)
        self._stand = scene.add_mesh_simple(f'{name}/stand', peg.vertices, peg.faces, color=STAND,
                                            side='double')
        self._trace = scene.add_line_segments(
            f'{name}/trace', NO_LINES, TRACES[number], thickness=0.018 * radius)
        self._bounds = [scene.add_line_segments(
            f'{name}/bound{k}', NO_LINES, BOUNDS, thickness=0.007 * radius, visible=False)
            for k in range(2)]
        self._arrows = {arrow: scene.add_arrows(
            f'{name}/{arrow.replace(" ", "_")}', NO_LINES, colour,
            shaft_radius=0.014 * radius, head_radius=0.04 * radius, head_length=0.12 * radius,
            visible=False) for arrow, (colour, *_) in shapes.ARROWS.items()}
        self._colour = np.array(TRACES[number])
        self._limits: tuple[float, float] | None = None         # that are drawn [rad]
        self._picture: object = None                    # its stamp and switches

    def draw(self, page_ns: int, *, trace: bool, bounds: bool, arrows: Set[str]) -> None:
        """Draw the newest samples up to a stamp of the page, with some of the parts."""
        stamp_ns = page_ns + self.shift_ns
        sample = self.track.attitudes.at(stamp_ns)
        self.root.visible = sample is not None
        picture = sample and (sample[0], trace, bounds, arrows)
        if picture == self._picture:        # as while it is paused
            return
        self._picture = picture
        if sample is None:
            return
        x, y, z, w = sample[1][QUATERNION].tolist()
        self._body.wxyz = (w, x, y, z)
        self._trace.visible = self._sphere.visible = trace
        if trace:
            self._draw_trace(shapes.trace(self.track, stamp_ns))
        for name, arrow in self._arrows.items():
            arrow.visible = name in arrows
            vector = shapes.arrow(self.track, name, stamp_ns) if arrow.visible else None
            arrow.points = NO_LINES if vector is None else shapes.lines_through(
                np.vstack((np.zeros(3), vector)))
        self._draw_bounds(self.track.motion_at(stamp_ns), bounds)

    def _draw_trace(self, lines: shapes.Lines) -> None:
        """Draw a trace that fades with its age; the colours of a line's points are linear."""
        lines = lines if len(lines) else NO_LINES
        if len(lines) != len(self._trace.points):
            share = np.linspace(0.35, 1.0, len(lines))[:, np.newaxis, np.newaxis]
            self._trace.colors = np.broadcast_to(255 * (
                1.0 + share * (self._colour / 255 - 1.0)) ** 2.2, lines.shape).astype(np.uint8)
        self._trace.points = lines

    def _draw_bounds(self, motion: DescribedMotion | None, on: bool) -> None:
        description = motion.description if motion else None
        for bound in self._bounds:
            bound.visible = on and description is not None
        if description is None:
            return
        limits = description.theta_min, description.theta_max
        if limits == self._limits:
            return
        self._limits = limits
        for bound, theta in zip(self._bounds, self._limits, strict=True):
            bound.points = shapes.circle(shapes.axis_length(self.track), theta)
        # A top that comes low hangs from above.
        self._stand.wxyz = (1, 0, 0, 0) if description.theta_max < STANDS_TO else (0, 1, 0, 0)


class Page:
    """
    The page, with its own server.

    One thread calls `set_tracks` and `draw`.  Threads of viser call what inputs call back: it may
    set `message` and inputs.

    server, gui : of viser
    address : of the page, http://...
    title : such as the name of the log
    controls : the folder for the controls of the source of the samples
    message : what was done, or the reason why not
    arrows : the switches of shapes.ARROWS, by name
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
            self.arrows = {name: gui.add_checkbox(name, False) for name in shapes.ARROWS}
            self._over = gui.add_checkbox('one over the other', False, visible=False)
        self._accuracy_folder = gui.add_folder('Accuracy', expand_by_default=False)
        with self._accuracy_folder:
            self._accuracy = gui.add_html('')
        panel = gui.add_panel()
        with panel.add_tab('Plots'):
            self._plots = gui.add_html('')
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        panel.expand()              # also on a phone, where it is below
        self._tops: list[DrawnTop] = []
        self._number = 0            # of the picture

    def close(self) -> None:
        """Stop the server; browsers go on to show the last texts."""
        self.server.flush()
        time.sleep(LAST_WORDS_S)
        self.server.stop()

    def set_tracks(self, tracks: Sequence[Track], shifts_ns: Sequence[int] = (0,)) -> None:
        """Show these tops; a shift is added to a stamp of the page to get the track's."""
        for top in self._tops:
            top.root.remove()
        scene = self.server.scene
        self._tops = [DrawnTop(scene, number, track, shift_ns) for number, (track, shift_ns)
                      in enumerate(zip(tracks, shifts_ns, strict=True))]
        size = self._size = max(abs(shapes.axis_length(track)) for track in tracks)
        self._over.visible = len(tracks) > 1
        self._bounds.visible = self._accuracy_folder.visible = any(
            track.has_body for track in tracks)
        for switch in self.arrows.values():
            switch.visible = self._bounds.visible
        self._ground = scene.add_grid(
            '/ground', infinite_grid=True, cell_size=0.5 * size, section_size=size,
            cell_color=(238, 240, 244), section_color=(228, 231, 236), fade_distance=9 * size,
            fade_from='origin', shadow_opacity=0.1, position=(0.0, 0.0, -FOOT * size))
        camera = self.server.initial_camera
        away = size * (5.2 if len(tracks) == 1 else 10.5)
        camera.fov = VIEW_ANGLE
        camera.position = (0.0, -0.92 * away, 0.39 * away)
        camera.look_at = (0.0, 0.0, 0.1 * size)
        camera.near, camera.far = 0.01 * size, 100.0 * size

    def draw(self, page_ns: int, epoch_ns: int) -> None:
        """Draw all tops at a stamp of the page [ns]; `epoch_ns` is that of t = 0."""
        arrows = {name for name, switch in self.arrows.items() if switch.value}
        side = 0.0 if self._over.value else 1.3 * self._size
        places = [top.track.places(np.array([page_ns + top.shift_ns]))[0] for top in self._tops]
        with self.server.atomic():
            if places:          # the picture follows the first top: the ground moves
                x, y, z = places[0]
                self._ground.position = (-(x % self._size), -(y % self._size),
                                         -FOOT * self._size - z)
            for k, (top, place) in enumerate(zip(self._tops, places, strict=True)):
                top.root.position = place - places[0] + (
                    side * (2 * k - len(self._tops) + 1), 0.0, 0.0)
                top.draw(page_ns, trace=self._trace.value, bounds=self._bounds.value,
                         arrows=arrows)
        if self._number % PLOT_EVERY == 0:
            tops = self.plotted(page_ns, epoch_ns, page_ns - WINDOW_NS, page_ns)
            set_content(self._plots, ''.join(map(svg.draw, plots.motion_plots(tops))))
            set_content(self._accuracy, ''.join(map(svg.draw, plots.accuracy_plots(tops))))
            set_content(self._words, self.words(page_ns, epoch_ns))
            set_content(self._legend, self.legend())
        self._number += 1

    def plotted(self, page_ns: int, epoch_ns: int, begin_ns: int,
                end_ns: int) -> list[plots.Plotted]:
        """Return what is plotted of the tops at a stamp, for a span of stamps of the page."""
        return [plots.Plotted(
            top.track, stamp_ns=page_ns + top.shift_ns, begin_ns=begin_ns + top.shift_ns,
            end_ns=end_ns + top.shift_ns, epoch_ns=epoch_ns + top.shift_ns) for top in self._tops]

    def words(self, page_ns: int, epoch_ns: int) -> str:
        """Return HTML about the motions and the samples that are drawn."""
        parts = []
        for track, shift_ns in ((top.track, top.shift_ns) for top in self._tops):
            sample = track.attitudes.at(page_ns + shift_ns)
            parts.append(f'<p>{track.name} {NO_SAMPLES}</p>' if sample is None else text.words(
                track, track.motion_at(page_ns + shift_ns), sample[0],
                sample[0] - shift_ns - epoch_ns))
        return ''.join(parts)

    def legend(self) -> str:
        """Return HTML about the colours of what is switched on."""
        entries = []
        if self._trace.value:
            entries += [(TRACES[k], f'trace of the axis {top.track.name}'.rstrip()
                         + (' (plots: dashed)' if k else '')) for k, top in enumerate(self._tops)]
        if self._bounds.value and any(top.track.motions for top in self._tops):
            entries.append((BOUNDS, 'bounds of θ'))
        entries += [(shapes.ARROWS[name][0], name)
                    for name, switch in self.arrows.items() if switch.value]
        return text.legend(entries)
