# SPDX-License-Identifier: Apache-2.0
"""The page: the scene, what it says, and its plots, made with viser; the same for all sources."""

import math
import time
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import viser
from viser import uplot

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.view import model
from spinning_top_sim.view.server import Server
from spinning_top_sim.view.track import Rows, Track

RATE = 30.0                     # pictures a second
CATCH_UP_S = 0.2                # by so much late pictures follow each other at once
LAST_WORDS_S = 0.2              # until they are sent
PLOT_EVERY = 6                  # pictures
WINDOW_NS = 10 * NANOSECONDS    # of the plots
BODY, MARK, ROD = (51, 102, 178), (242, 191, 51), (90, 90, 90)
TRACES = ((229, 77, 51), (40, 140, 70))
BOUNDS, SPHERE = (120, 90, 170), (205, 205, 210)
ARROW_COLOURS = ((20, 120, 60), (190, 60, 160), (230, 130, 20))
CAMERAS = ('side', 'above', 'with the body')
Value = TypeVar('Value')
NO_SAMPLES = 'no samples yet'


def set_value(handle: viser.GuiInputHandle[Value], value: Value) -> None:
    """Show a value in an input; viser declares `value` without its setter."""
    handle.value = value        # type: ignore[misc]


class DrawnTop:
    """One top in the scene."""

    def __init__(self, scene: viser.SceneApi, name: str, track: Track, number: int,
                 faint: bool = False) -> None:
        self.track, self.name = track, name
        shape = track.shape
        far = model.reach(track)
        radius = abs(far)
        opacity = 0.35 if faint else None
        self._root = scene.add_frame(name, show_axes=False)
        self._sphere = scene.add_line_segments(
            f'{name}/sphere', model.meridians(radius), SPHERE, thickness=0.002 * radius)
        self._body = scene.add_frame(f'{name}/body', show_axes=False)
        low, high = shape.centre - 0.5 * shape.height, shape.centre + 0.5 * shape.height
        for part, colour, sector in (
                ('mark', MARK, (shape.radius, low, high, -0.3, 0.3)),
                ('disc', BODY, (shape.radius, low, high, 0.3, math.tau - 0.3)),
                ('rod', ROD, (0.015 * radius, min(0.0, far), max(0.0, far), 0.0, math.tau))):
            scene.add_mesh_simple(f'{name}/body/{part}', *model.sector(*sector), color=colour,
                                  opacity=opacity, flat_shading=part != 'rod', side='double')
        self._trace = scene.add_line_segments(
            f'{name}/trace', np.zeros((1, 2, 3), np.float32), TRACES[number % len(TRACES)],
            thickness=0.012 * radius)
        self._bounds = [scene.add_line_segments(
            f'{name}/bound{k}', np.zeros((1, 2, 3), np.float32), BOUNDS,
            thickness=0.005 * radius, visible=False) for k in range(2)]
        self._arrows = [scene.add_arrows(
            f'{name}/{arrow.replace(" ", "_")}', np.zeros((1, 2, 3), np.float32), colour,
            shaft_radius=0.012 * radius, head_radius=0.035 * radius, head_length=0.1 * radius,
            visible=False) for arrow, colour in zip(model.ARROWS, ARROW_COLOURS, strict=True)]
        self._theta_range: tuple[float, float] | None = None
        self.drawn: tuple[int, Rows] | None = None      # stamp [ns] and row of the attitude
        self._shown: object = None                      # with which stamp and parts

    def remove(self) -> None:
        self._root.remove()

    def place(self, x: float) -> None:
        """Put the pivot at (x, 0, 0)."""
        self._root.position = (x, 0.0, 0.0)

    def show(self, *, trace: bool, bounds: bool, arrows: Sequence[bool]) -> None:
        """Show or hide parts."""
        self._trace.visible = self._sphere.visible = trace
        for bound in self._bounds:
            bound.visible = bounds and self._theta_range is not None
        for arrow, on in zip(self._arrows, arrows, strict=True):
            arrow.visible = on

    def draw(self, stamp_ns: int) -> None:
        """Draw the newest samples up to a stamp."""
        self.drawn = sample = self.track.attitudes.at(stamp_ns)
        self._root.visible = sample is not None
        if sample is None:
            self._shown = None
            return
        # While the motion is paused, too, a part may be switched on.
        shown = sample[0], self._trace.visible, [arrow.visible for arrow in self._arrows]
        if shown == self._shown:
            return
        self._shown = shown
        x, y, z, w = sample[1][:4].tolist()
        self._body.wxyz = (w, x, y, z)
        if self._trace.visible:
            lines = model.trace(self.track, stamp_ns)
            self._trace.points = lines if len(lines) else np.zeros((1, 2, 3), np.float32)
        for name, arrow in zip(model.ARROWS, self._arrows, strict=True):
            if arrow.visible:
                vector = model.arrow(self.track, name, stamp_ns)
                arrow.points = np.array([[(0.0, 0.0, 0.0), (
                    (0.0, 0.0, 0.0) if vector is None else vector)]], np.float32)
        motion = self.track.motion_at(stamp_ns)
        limits = motion.theta_range if motion else None
        if limits != self._theta_range:
            self._theta_range = limits
            for node, theta in zip(self._bounds, limits or (0.0, 0.0), strict=True):
                node.points = model.circle(model.reach(self.track), theta)


class Page:
    """
    The page, on a server of its own.  One thread calls `set_tracks` and `draw`.

    controls : the folder for what the source of the samples can be told
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
            self._camera = gui.add_dropdown('camera', CAMERAS)
        self._camera.on_update(lambda _: self._place_cameras())
        self._plots_folder = gui.add_folder(f'Last {WINDOW_NS // NANOSECONDS} s')
        self._plots: list[viser.GuiUplotHandle] = []
        self._tops: list[DrawnTop] = []
        self._number = 0            # of the picture

    def close(self) -> None:
        """End; the browsers keep what was said last."""
        self.server.flush()
        time.sleep(LAST_WORDS_S)
        self.server.stop()

    def set_tracks(self, tracks: Sequence[Track]) -> None:
        """Show these tops instead of those before."""
        for top in self._tops:
            top.remove()
        for plot in self._plots:
            plot.remove()
        self._tops = [DrawnTop(self.server.scene, f'/top{k}', track, k, faint=k > 0)
                      for k, track in enumerate(tracks)]
        self._reach = max(abs(model.reach(track)) for track in tracks)
        self._over.visible = len(tracks) > 1
        scene = self.server.scene
        scene.add_line_segments('/vertical', self._reach * np.array(
            [[(0, 0, -1.2), (0, 0, 1.2)]]), (150, 150, 150), thickness=0.004 * self._reach)
        scene.add_icosphere('/pivot', 0.04 * self._reach, (60, 60, 60))
        scene.add_grid('/ground', 4 * self._reach, 4 * self._reach, cell_size=0.5 * self._reach,
                       section_size=self._reach, section_color=(200, 200, 200),
                       position=(0.0, 0.0, -1.2 * self._reach))
        camera = self.server.initial_camera
        camera.position, camera.look_at = self._camera_position(), (0.0, 0.0, 0.0)
        camera.near, camera.far = 0.01 * self._reach, 100.0 * self._reach
        self._place_cameras()
        empty = np.zeros(1)
        with self._plots_folder:
            self._plots = [self.gui.add_uplot(
                (empty, *(empty for _ in tracks)),
                (uplot.Series(label='s'), *(
                    uplot.Series(label=f'{name} {track.name}'.rstrip(), width=1.5,
                                 stroke=f'rgb{TRACES[k % len(TRACES)]}')
                    for k, track in enumerate(tracks))),
                scales={'x': uplot.Scale(time=False), 'y': uplot.Scale(auto=True)},
                height=150) for name in model.CURVES]

    def _camera_position(self) -> tuple[float, float, float]:
        """Return where the chosen camera is; with the body it turns with the precession."""
        far = 2.9 * self._reach
        if self._camera.value == CAMERAS[1]:
            return 0.0, -0.01 * far, far
        turn = 0.0
        if self._camera.value == CAMERAS[2] and self._tops and self._tops[0].drawn:
            x, y, z, w = self._tops[0].drawn[1][:4].tolist()
            turn = math.atan2(y * z - w * x, x * z + w * y) + 0.5 * math.pi
        return 0.87 * far * math.sin(turn), -0.87 * far * math.cos(turn), 0.5 * far

    def _place_cameras(self) -> None:
        position = self._camera_position()
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = position, (0.0, 0.0, 0.0)

    def draw(self, stamps_ns: Sequence[int], origin_ns: int) -> None:
        """
        Draw each track at its stamp [ns].

        origin_ns : the stamp at which the axes of the plots begin to count
        """
        arrows = [switch.value for switch in self.arrows]
        with self.server.atomic():
            for k, (top, stamp_ns) in enumerate(zip(self._tops, stamps_ns, strict=True)):
                side = 0.0 if self._over.value else 1.3 * self._reach
                top.place(side * (2 * k - len(self._tops) + 1))
                top.show(trace=self._trace.value, bounds=self._bounds.value, arrows=arrows)
                top.draw(stamp_ns)
        if self._camera.value == CAMERAS[2]:
            self._place_cameras()
        if self._number % PLOT_EVERY == 0:
            self._plot(stamps_ns, origin_ns)
            self._tell(stamps_ns, origin_ns)
        self._number += 1

    def _plot(self, stamps_ns: Sequence[int], origin_ns: int) -> None:
        """Draw the curves; each has the times of its own samples, and gaps at those of others."""
        for name, plot in zip(model.CURVES, self._plots, strict=True):
            curves = [model.curve(top.track, name, stamp_ns - WINDOW_NS, stamp_ns)
                      for top, stamp_ns in zip(self._tops, stamps_ns, strict=True)]
            shifted = [(stamps - (stamp_ns - stamps_ns[0]), values) for (stamps, values), stamp_ns
                       in zip(curves, stamps_ns, strict=True)]
            times_ns = np.unique(np.concatenate([times for times, _ in shifted]))
            if not len(times_ns):
                continue
            columns = []
            for times, values in shifted:
                column = np.full(len(times_ns), np.nan)
                column[np.searchsorted(times_ns, times)] = values
                columns.append(column)
            plot.data = ((times_ns - origin_ns) / NANOSECONDS, *columns)

    def _tell(self, stamps_ns: Sequence[int], origin_ns: int) -> None:
        """Say which motion this is, and the numbers of the sample that is drawn."""
        lines = []
        for top, stamp_ns in zip(self._tops, stamps_ns, strict=True):
            shift_ns = stamp_ns - stamps_ns[0]          # of its t = 0 from that of the first
            if top.drawn is None:
                lines.append(f'{top.track.name} *{NO_SAMPLES}*')
                continue
            motion = top.track.motion_at(stamp_ns)
            seconds, nanoseconds = divmod(top.drawn[0], NANOSECONDS)
            regime, *numbers = motion.words if motion else ('',)
            if motion:
                numbers.append(f'L3 = {motion.l3:.6g}, Lz = {motion.lz:.6g} kg m²/s')
            x, y, z, w = top.drawn[1][:4].tolist()
            title = ' '.join(filter(None, (top.track.name, regime)))
            lines += [
                f'**{title}**' if title else '', *(f'- {number}' for number in numbers),
                f'- t = {(top.drawn[0] - shift_ns - origin_ns) / NANOSECONDS:.3f} s, stamp '
                f'{seconds}.{nanoseconds:09d}',
                f'- q = {x:.6f}, {y:.6f}, {z:.6f}, {w:.6f}', '']
        if len(self._tops) == 2 and all(top.drawn for top in self._tops):
            one, other = (top.drawn[1] for top in self._tops if top.drawn)
            lines.append(f'**angle between the two: '
                         f'{math.degrees(model.angle_apart(one, other)):.3g}°**')
        text = '\n'.join(lines)
        if text != self._words.content:
            self._words.content = text
