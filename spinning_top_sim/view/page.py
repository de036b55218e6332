# SPDX-License-Identifier: Apache-2.0
"""The page: scene, texts and plots, made with viser; the same for logs and for a running node."""

import time
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import trimesh.creation
import viser
from viser import uplot

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.view import model
from spinning_top_sim.view.server import Server
from spinning_top_sim.view.track import DescribedMotion, Track

RATE = 30.0                     # pictures per second
CATCH_UP_S = 0.2                # delay up to which late pictures follow each other at once
LAST_WORDS_S = 0.2              # time to send the last texts
PLOT_EVERY = 6                  # pictures
WINDOW_NS = 10 * NANOSECONDS    # of the plots
BODY, MARK, ROD = (51, 102, 178), (242, 191, 51), (90, 90, 90)
TRACES = ((229, 77, 51), (40, 140, 70))
BOUNDS, SPHERE = (120, 90, 170), (205, 205, 210)
ARROW_COLOURS = ((20, 120, 60), (190, 60, 160), (230, 130, 20))
NO_LINES = np.zeros((1, 2, 3), np.float32)
NO_SAMPLES = 'no samples yet'
Value = TypeVar('Value')


def set_value(handle: viser.GuiInputHandle[Value], value: Value) -> None:
    """Show a value in an input; viser declares `value` without its setter."""
    handle.value = value        # type: ignore[misc]


class DrawnTop:
    """
    One top in the scene.

    shift_ns : added to the stamp of the page
    drawn : stamp [ns] and row of the attitude that is drawn, None if there is none
    """

    def __init__(self, scene: viser.SceneApi, number: int, track: Track, shift_ns: int) -> None:
        self.track, self.shift_ns = track, shift_ns
        name, shape, far = f'/top{number}', track.shape, model.reach(track)
        radius = abs(far)
        self.root = scene.add_frame(name, show_axes=False)
        self._sphere = scene.add_icosphere(f'{name}/sphere', radius, SPHERE, wireframe=True,
                                           opacity=0.2, cast_shadow=False)
        self._body = scene.add_frame(f'{name}/body', show_axes=False)
        for part, colour, mesh, position in (
                ('mark', MARK, trimesh.creation.box((
                    0.3 * shape.radius, 0.5 * shape.radius, 1.02 * shape.height)),
                 (0.86 * shape.radius, 0.0, shape.centre)),
                ('disc', BODY, trimesh.creation.cylinder(shape.radius, shape.height, 48),
                 (0.0, 0.0, shape.centre)),
                ('rod', ROD, trimesh.creation.cylinder(0.015 * radius, radius),
                 (0.0, 0.0, 0.5 * far))):
            scene.add_mesh_simple(f'{name}/body/{part}', mesh.vertices, mesh.faces, color=colour,
                                  position=position, opacity=0.35 if number else None,
                                  flat_shading=part != 'rod')
        self._trace = scene.add_line_segments(
            f'{name}/trace', NO_LINES, TRACES[number], thickness=0.012 * radius)
        self._bounds = [scene.add_line_segments(
            f'{name}/bound{k}', NO_LINES, BOUNDS, thickness=0.005 * radius, visible=False)
            for k in range(2)]
        self._arrows = [scene.add_arrows(
            f'{name}/{arrow.replace(" ", "_")}', NO_LINES, colour,
            shaft_radius=0.012 * radius, head_radius=0.035 * radius, head_length=0.1 * radius,
            visible=False) for arrow, colour in zip(model.ARROWS, ARROW_COLOURS, strict=True)]
        self._theta_range: tuple[float, float] | None = None
        self.drawn: tuple[int, model.Vectors] | None = None
        self._shown: object = None                      # stamp and switches of the picture

    def motion(self, page_ns: int) -> DescribedMotion | None:
        """Return the motion at a stamp of the page."""
        return self.track.motion_at(page_ns + self.shift_ns)

    def draw(self, page_ns: int, *, trace: bool, bounds: bool, arrows: Sequence[bool]) -> None:
        """Draw the newest samples up to a stamp of the page, with some of the parts."""
        stamp_ns = page_ns + self.shift_ns
        self.drawn = sample = self.track.attitudes.at(stamp_ns)
        self.root.visible = sample is not None
        shown = sample and (sample[0], trace, bounds, arrows)
        if shown == self._shown:        # as while it is paused
            return
        self._shown = shown
        if sample is None:
            return
        x, y, z, w = sample[1][:4].tolist()
        self._body.wxyz = (w, x, y, z)
        self._trace.visible = self._sphere.visible = trace
        if trace:
            lines = model.trace(self.track, stamp_ns)
            self._trace.points = lines if len(lines) else NO_LINES
        for name, arrow, on in zip(model.ARROWS, self._arrows, arrows, strict=True):
            arrow.visible = on
            vector = model.arrow(self.track, name, stamp_ns) if on else None
            arrow.points = NO_LINES if vector is None else model.segments(
                np.vstack((np.zeros(3), vector)))
        self._draw_bounds(self.motion(page_ns), bounds)

    def _draw_bounds(self, motion: DescribedMotion | None, on: bool) -> None:
        limits = motion.theta_range if motion else None
        for bound in self._bounds:
            bound.visible = on and limits is not None
        if limits is not None and limits != self._theta_range:
            self._theta_range = limits
            for bound, theta in zip(self._bounds, limits, strict=True):
                bound.points = model.circle(model.reach(self.track), theta)


class Page:
    """
    The page, with its own server.  One thread calls `set_tracks` and `draw`.

    controls : the folder for the controls of the source of the samples
    message : what was done, or the reason why not
    arrows : the switches of model.ARROWS
    """

    def __init__(self, title: str, host: str, port: int | None) -> None:
        self.server = Server(host, port)
        shown_host = f'[{host}]' if ':' in host else host
        self.address = f'http://{shown_host}:{self.server.get_port()}'
        gui = self.gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.set_panel_label(title)
        self._words, self.message = gui.add_markdown(f'*{NO_SAMPLES}*'), gui.add_markdown('')
        self.controls = gui.add_folder('Control')
        with gui.add_folder('Show'):
            self._trace = gui.add_checkbox('trace on its sphere', True)
            self._bounds = gui.add_checkbox('bounds of θ', True)
            self.arrows = [gui.add_checkbox(name, False) for name in model.ARROWS]
            self._over = gui.add_checkbox('one over the other', False, visible=False)
        self._plots_folder = gui.add_folder(f'Last {WINDOW_NS // NANOSECONDS} s')
        self._plots: list[viser.GuiUplotHandle] = []
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
        for plot in self._plots:
            plot.remove()
        scene = self.server.scene
        self._tops = [DrawnTop(scene, number, track, shift_ns) for number, (track, shift_ns)
                      in enumerate(zip(tracks, shifts_ns, strict=True))]
        self._reach = max(abs(model.reach(track)) for track in tracks)
        self._over.visible = len(tracks) > 1
        scene.add_line_segments('/vertical', self._reach * np.array(
            [[(0, 0, -1.2), (0, 0, 1.2)]]), (150, 150, 150), thickness=0.004 * self._reach)
        scene.add_icosphere('/pivot', 0.04 * self._reach, (60, 60, 60))
        scene.add_grid('/ground', 4 * self._reach, 4 * self._reach, cell_size=0.5 * self._reach,
                       section_size=self._reach, section_color=(200, 200, 200),
                       position=(0.0, 0.0, -1.2 * self._reach))
        camera = self.server.initial_camera
        camera.position = (0.0, -2.5 * self._reach, 1.45 * self._reach)
        camera.look_at = (0.0, 0.0, 0.0)
        camera.near, camera.far = 0.01 * self._reach, 100.0 * self._reach
        empty = np.zeros(1)
        with self._plots_folder:
            self._plots = [self.gui.add_uplot(
                (empty, *(empty for _ in tracks)),
                (uplot.Series(label='s'), *(
                    uplot.Series(label=f'{name} {track.name}'.rstrip(), width=1.5,
                                 stroke=f'rgb{colour}')
                    for track, colour in zip(tracks, TRACES, strict=False))),
                scales={'x': uplot.Scale(time=False), 'y': uplot.Scale(auto=True)},
                height=150) for name in model.CURVES]

    def draw(self, page_ns: int, origin_ns: int) -> None:
        """
        Draw all tops at a stamp of the page [ns].

        origin_ns : stamp of t = 0
        """
        arrows = [switch.value for switch in self.arrows]
        side = 0.0 if self._over.value else 1.3 * self._reach
        with self.server.atomic():
            for k, top in enumerate(self._tops):
                top.root.position = (side * (2 * k - len(self._tops) + 1), 0.0, 0.0)
                top.draw(page_ns, trace=self._trace.value, bounds=self._bounds.value,
                         arrows=arrows)
        if self._number % PLOT_EVERY == 0:
            self._plot(page_ns, origin_ns)
            self._tell(page_ns, origin_ns)
        self._number += 1

    def _plot(self, page_ns: int, origin_ns: int) -> None:
        """Draw the curves over common times; NaN where a top has no sample."""
        for name, plot in zip(model.CURVES, self._plots, strict=True):
            curves = []
            for top in self._tops:
                end_ns = page_ns + top.shift_ns
                stamps_ns, values = model.curve(top.track, name, end_ns - WINDOW_NS, end_ns)
                curves.append((stamps_ns - top.shift_ns, values))
            times_ns = np.unique(np.concatenate([times for times, _ in curves]))
            if not len(times_ns):
                continue
            columns = np.full((len(curves), len(times_ns)), np.nan)
            for column, (times, values) in zip(columns, curves, strict=True):
                column[np.searchsorted(times_ns, times)] = values
            plot.data = ((times_ns - origin_ns) / NANOSECONDS, *columns)

    def _tell(self, page_ns: int, origin_ns: int) -> None:
        """Describe the motions and the samples that are drawn."""
        lines = [line for top in self._tops for line in _words_of(top, page_ns, origin_ns)]
        text = '\n'.join(lines)
        if text != self._words.content:
            self._words.content = text


def _words_of(top: DrawnTop, page_ns: int, origin_ns: int) -> list[str]:
    """Return lines of Markdown about a top."""
    if top.drawn is None:
        return [f'{top.track.name} *{NO_SAMPLES}*']
    stamp_ns, row = top.drawn
    motion = top.motion(page_ns)
    regime, *numbers = motion.words if motion else ('',)
    if motion:
        numbers.append(f'L3 = {motion.l3:.6g}, Lz = {motion.lz:.6g} kg m²/s')
    x, y, z, w = row[:4].tolist()
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    title = ' '.join(filter(None, (top.track.name, regime)))
    return [f'**{title}**' if title else '', *(f'- {number}' for number in numbers),
            f'- t = {(stamp_ns - top.shift_ns - origin_ns) / NANOSECONDS:.3f} s, stamp '
            f'{seconds}.{nanoseconds:09d}',
            f'- q = {x:.6f}, {y:.6f}, {z:.6f}, {w:.6f}', '']
