# SPDX-License-Identifier: Apache-2.0
"""Pictures of a top: the tip's path on the sphere, a page about a log, an animation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools.analysis import Attitudes, Complexes, Reals, interpolate
from spinning_top_sim.tools.survey import Survey

# From the world to the viewer: towards, right, up.
VIEW = Rotation.from_euler('zy', (60.0, 45.0), degrees=True)
INK, FAINT, PATH = '#1b1b1b', '#c9c9c9', '#0b6fa4'
# Okabe and Ito's colours: distinct also for the colour-blind, and as greys.
COLOURS = ('#0072b2', '#d55e00', '#009e73')
FINER = 10                  # points drawn for each sample
PAGE_NUTATIONS, PAGE_S = 8, 5.0      # on the page; seconds where theta rests
MOST_MARKS = 30             # motions whose begin is marked
FRAMES_PER_S, LONGEST_S = 20, 10.0
FRAME_SIZE, FRAME_DPI = 3.6, 90
DISC, DISC_HEIGHT = 0.42, 0.45      # radius of the body's disc and its place on the axis


def project(points: Reals) -> tuple[Reals, Reals, Reals]:
    """Return picture coordinates across and up of points (n, 3), and how near they are (n,)."""
    near, across, up = VIEW.apply(points).T
    return across, up, near


def draw(axes: Axes, points: Reals, color: str, width: float) -> None:
    """Draw a curve (n, 3) on the sphere: the part behind it faintly."""
    across, up, near = project(points)
    for visible, alpha in ((near >= 0.0, 1.0), (near < 0.0, 0.25)):
        axes.plot(np.where(visible, across, np.nan), np.where(visible, up, np.nan),
                  alpha=alpha, color=color, linewidth=width)


def on_sphere(tip: Complexes, height: Reals | float) -> Reals:
    """Return points (n, 3) from x + iy and z."""
    return np.stack(np.broadcast_arrays(tip.real, tip.imag, height), axis=1)


def draw_sphere(axes: Axes, tilts: tuple[float, ...], lowest: float = -0.9) -> None:
    """Draw the unit sphere with circles of these tilts; below `lowest` it is open."""
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 400))
    axes.plot(np.where(circle.imag > lowest + 0.2, circle.real, np.nan), circle.imag,
              color=FAINT, linewidth=1.0)
    for theta in tilts:
        draw(axes, on_sphere(np.sin(theta) * circle, np.cos(theta)), FAINT, 0.8)
    axes.set_aspect('equal')
    axes.set_xlim(-1.1, 1.1)
    axes.set_ylim(lowest, 1.25)
    axes.axis('off')


def draw_tip(axes: Axes, tip: Complexes, height: Reals) -> None:
    """Draw the tip's path, x + iy and z, and the axis at its end."""
    path = on_sphere(tip, height)
    draw(axes, path, PATH, 1.8)
    across, up, _ = project(path[-1:])
    axes.plot([0.0, *across], [0.0, *up], color=INK, linewidth=2.2, solid_capstyle='round')
    axes.plot(across, up, 'o', color=INK, markersize=5)


def smooth_tip(data: Attitudes) -> tuple[Reals, Complexes, Reals]:
    """Return time [s], tip (x + iy) and height of the axis, with points between the samples."""
    last = len(data.stamps_ns) - 1
    at = np.linspace(0.0, last, last * FINER + 1)
    return at * data.period, interpolate(data.tip, at), interpolate(data.height, at)


def draw_page(found: Survey, path: Path, name: str) -> None:
    """
    Draw a page of figures about a log with samples of attitudes (`found.shown`).

    path : picture to write; its extension is the format
    name : of the log, for the title

    Raises OSError or ValueError where the picture cannot be written or the format is unknown.
    """
    assert found.shown is not None
    motion, data = found.shown
    measured = motion.measured
    period = None if measured is None else measured.nutation_period
    shown_s = PAGE_S if period is None else PAGE_NUTATIONS * period
    data = data.first(shown_s)
    rows = 4 if found.readings else 3
    figure = Figure(figsize=(11.0, 2.4 * rows + 0.6), layout='constrained')
    grid = figure.add_gridspec(rows, 2, height_ratios=[1.1, 1.1, 1.0, 1.0][:rows])
    regime = motion.regime or (motion.exact.name if motion.exact else '')
    figure.suptitle(f'{name}: {regime}', fontsize=14, color=INK)
    _tip_panel(figure.add_subplot(grid[0:2, 0]), data, period or 0.0)

    time, _, height = smooth_tip(data)
    tilt = _panel(figure, grid[0, 1], '' if period is None else f'nutation, period {period:.9g} s',
                  'tilt θ [deg]')
    tilt.plot(time, np.degrees(np.arccos(np.clip(height, -1.0, 1.0))), color=COLOURS[0])
    mean = None if measured is None else measured.mean_precession_rate
    _precession_panel(
        _panel(figure, grid[1, 1], '' if mean is None else
               f'precession, mean {mean:.9g} rad/s (dashed)', "φ' [rad/s]", tilt), data, mean)
    _accuracy_panels(figure, grid, found)
    if found.readings:
        _imu_panels(figure, grid, found, shown_s)
    figure.savefig(path, dpi=120)


def _panel(figure: Figure, place: SubplotSpec, title: str, quantity: str,
           share: Axes | None = None, time: str = 'time [s]') -> Axes:
    axes = figure.add_subplot(place, sharex=share)
    axes.set_title(title, fontsize=11)
    axes.set_ylabel(quantity, fontsize=9)
    axes.set_xlabel(time, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.margins(x=0.0)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
    return axes


def _tip_panel(axes: Axes, data: Attitudes, period: float) -> None:
    turned = np.flatnonzero(np.abs(data.phi - data.phi[0]) > 2.0 * np.pi)
    if len(turned):         # one turn is enough, if two nutations are in it
        data = data.first(max(float(data.time[turned[0]]), 2.0 * period))
    time, tip, height = smooth_tip(data)
    tilts = np.arccos(np.clip([np.max(height), np.min(height)], -1.0, 1.0))
    draw_sphere(axes, (*tilts, np.pi / 2), -0.9 if tilts[1] < np.radians(100.0) else -1.25)
    draw_tip(axes, tip, height)
    axes.set_title(f'path of the tip, t = 0 to {time[-1]:.3g} s', fontsize=11, color=INK)


def _precession_panel(axes: Axes, data: Attitudes, mean: float | None) -> None:
    rate = data.phi_dot
    if rate is None:
        axes.text(0.5, 0.5, "φ': no topic with rates", ha='center', transform=axes.transAxes)
    else:
        axes.plot(data.time, rate, color=COLOURS[1])
        usual = float(np.max(np.abs(np.nanpercentile(rate, (1.0, 99.0)))))
        if np.nanmax(np.abs(rate)) > 20.0 * max(usual, 1e-3):
            axes.set_yscale('symlog', linthresh=usual)
        axes.axhline(0.0, color=FAINT, linewidth=0.8, zorder=0)
    if mean is not None:
        axes.axhline(mean, color=INK, linewidth=0.9, linestyle='--')


def _accuracy_panels(figure: Figure, grid: GridSpec, found: Survey) -> None:
    """Draw drifts and errors from the topics where they are least, and where motions begin."""
    begin_ns = found.damage.start_ns
    drift_topic = min(found.drifts, default='', key=lambda name:
                      found.drifts[name]['energy'].largest)
    error_topic = min(found.errors, default='', key=lambda name: found.errors[name].largest)
    drift, error = (
        _panel(figure, grid[2, column], f'{title}, from {topic}' if topic else '', quantity,
               time='time in the log [s]')
        for column, title, topic, quantity in (
            (0, 'drift of the constants', drift_topic, 'relative drift'),
            (1, 'error against the exact solution', error_topic, 'orientation error [rad]')))
    for series, style, colour, label in zip(
            found.drifts.get(drift_topic, {}).values(), ('-', '--', ':'), COLOURS,
            ('E', '$L_3$', '$L_z$'), strict=False):
        stamps_ns, values = series.points
        drift.plot((stamps_ns - begin_ns) * 1e-9, values, style, color=colour, linewidth=1.0,
                   label=label)
    if drift_topic:
        _legend(drift)
    if error_topic:
        stamps_ns, values = found.errors[error_topic].points
        error.plot((stamps_ns - begin_ns) * 1e-9, values, color=COLOURS[2], linewidth=1.0)
        error.set_ylim(bottom=0.0)
    if len(found.motions) <= MOST_MARKS:
        for motion in found.motions[1:]:
            for axes in (drift, error):
                axes.axvline((motion.begin_ns - begin_ns) * 1e-9, color=FAINT, linewidth=0.8,
                             zorder=0)


def _imu_panels(figure: Figure, grid: GridSpec, found: Survey, shown_s: float) -> None:
    # The noisy readings, else the noise-free ones, else the bias.
    topic = min(found.readings, key=lambda name: (not name.endswith('data_raw'),
                                                  not name.endswith('ground_truth/imu')))
    time, *vectors = np.concatenate(found.readings[topic]).T
    shown = time <= time[0] + shown_s
    for column, quantity, unit in ((0, 'angular velocity', 'rad/s'),
                                   (1, 'specific force', 'm/s²')):
        axes = _panel(figure, grid[3, column], f'{quantity}, {topic}', f'{quantity} [{unit}]')
        for number, axis in enumerate('xyz'):
            axes.plot((time - time[0])[shown], vectors[3 * column + number][shown],
                      color=COLOURS[number], linewidth=0.9, label=axis)
        _legend(axes)


def _legend(axes: Axes) -> None:
    axes.legend(loc='upper right', ncols=3, fontsize=8, frameon=False)
    axes.margins(y=0.22)


def animate(found: Survey, path: Path) -> None:
    """
    Draw the turning top as a GIF, at most LONGEST_S of it: axis, disc with a mark, trace.

    Raises OSError or ValueError where the picture cannot be written.
    """
    assert found.shown is not None
    _, data = found.shown
    frames = max(2, int(min(LONGEST_S, float(data.time[-1])) * FRAMES_PER_S))
    at = np.arange(frames) / (FRAMES_PER_S * data.period)
    spin = np.interp(at, np.arange(len(data.psi)), data.psi)
    trace = np.linspace(0.0, at[-1], frames * FINER)
    tip, height = interpolate(data.tip, trace), interpolate(data.height, trace)
    lowest = -0.9 if np.min(height) > -0.2 else -1.25
    figure = Figure(figsize=(FRAME_SIZE, FRAME_SIZE), dpi=FRAME_DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def frame(number: int) -> list[Artist]:
        axes.clear()
        draw_sphere(axes, (np.pi / 2,), lowest)
        now = number * FINER
        _draw_body(axes, tip[now], float(height[now]), float(spin[number]))
        draw_tip(axes, tip[:now + 1], height[:now + 1])
        axes.text(-1.05, 1.15, f't = {number / FRAMES_PER_S:.2f} s', color=INK, fontsize=9)
        return []

    FuncAnimation(figure, frame, frames=frames, blit=False).save(
        path, writer=PillowWriter(fps=FRAMES_PER_S))


def _draw_body(axes: Axes, tip: complex, height: float, psi: float) -> None:
    """Draw the disc across the axis, with a mark that turns with the body."""
    theta = np.arctan2(abs(tip), height)
    attitude = Rotation.from_euler('ZYZ', (float(np.angle(tip)), theta, psi))
    rim, mark = (on_sphere(DISC * np.exp(1j * np.linspace(begin, end, count)), DISC_HEIGHT)
                 for begin, end, count in ((0.0, 2.0 * np.pi, 60), (-0.25, 0.25, 9)))
    across, up, _ = project(attitude.apply(rim))
    axes.fill(across, up, facecolor='#f2e3c9', edgecolor=INK, linewidth=1.0, alpha=0.9)
    across, up, _ = project(attitude.apply(np.vstack(((0.0, 0.0, DISC_HEIGHT), mark))))
    axes.fill(across, up, color=COLOURS[1])
