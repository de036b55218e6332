# SPDX-License-Identifier: Apache-2.0
"""Pictures of a top: the tip's path on the sphere, a page about a log, an animation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools.analysis import Reals, Tilts, interpolate
from spinning_top_sim.tools.motions import MotionReport
from spinning_top_sim.tools.survey import Survey

# From the world to the viewer: towards, right, up.
VIEW = Rotation.from_euler('zy', (60.0, 45.0), degrees=True)
INK, FAINT, PATH = '#1b1b1b', '#c9c9c9', '#0b6fa4'
# Okabe and Ito's colours: distinct also for the colour-blind, and as greys.
COLOURS = ('#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9')
FINER = 10                  # points drawn for each sample
PAGE_NUTATIONS, PAGE_S = 8, 5.0      # on the page; seconds where theta rests
FRAMES_PER_S, LONGEST_S = 20, 10.0
FRAME_SIZE, FRAME_DPI = 3.6, 90
DISC, DISC_HEIGHT = 0.42, 0.45      # radius of the body's disc and its place on the axis


def project(points: Reals) -> tuple[Reals, Reals, Reals]:
    """
    Return the picture coordinates of points.

    Parameters
    ----------
    points : NDArray[np.float64], shape (n, 3)
        On the unit sphere, z upwards.

    Returns
    -------
    across, up, near : NDArray[np.float64], shape (n,)
        Picture coordinates, and the height above the picture's plane.
    """
    near, across, up = VIEW.apply(points).T
    return across, up, near


def draw(axes: Axes, points: Reals, **style: Any) -> None:
    """Draw a curve on the sphere, (n, 3): the part behind it faintly."""
    across, up, near = project(points)
    for visible, alpha in ((near >= 0.0, 1.0), (near < 0.0, 0.25)):
        axes.plot(np.where(visible, across, np.nan), np.where(visible, up, np.nan),
                  alpha=alpha, **style)


def on_sphere(tip: NDArray[np.complex128], height: Reals) -> Reals:
    """Return points (n, 3) from x + iy and z."""
    return np.stack((tip.real, tip.imag, height), axis=1)


def circle(theta: float) -> Reals:
    """Return the circle of one tilt, (n, 3)."""
    tip = np.sin(theta) * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 400))
    return on_sphere(tip, np.full(400, np.cos(theta)))


def draw_sphere(axes: Axes, tilts: tuple[float, ...], lowest: float = -0.9) -> None:
    """Draw the unit sphere with circles of these tilts; below `lowest` it is open."""
    outline = np.linspace(0.0, 2.0 * np.pi, 400)
    axes.plot(np.where(np.sin(outline) > lowest + 0.2, np.cos(outline), np.nan),
              np.sin(outline), color=FAINT, linewidth=1.0)
    for theta in tilts:
        draw(axes, circle(theta), color=FAINT, linewidth=0.8)
    axes.set_aspect('equal')
    axes.set_xlim(-1.1, 1.1)
    axes.set_ylim(lowest, 1.25)
    axes.axis('off')


def draw_tip(axes: Axes, tip: NDArray[np.complex128], height: Reals) -> None:
    """Draw the tip's path, x + iy and z, and the axis at its end."""
    path = on_sphere(tip, height)
    draw(axes, path, color=PATH, linewidth=1.8)
    across, up, _ = project(path[-1:])
    axes.plot([0.0, *across], [0.0, *up], color=INK, linewidth=2.2, solid_capstyle='round')
    axes.plot(across, up, 'o', color=INK, markersize=5)


def smooth_tip(tilts: Tilts, finer: int = FINER,
               ) -> tuple[Reals, NDArray[np.complex128], Reals]:
    """Return time [s], tip (x + iy) and height of the axis, with points between the samples."""
    at = np.linspace(0.0, len(tilts.time) - 1.0, (len(tilts.time) - 1) * finer + 1)
    return at * tilts.period, interpolate(tilts.tip, at), interpolate(tilts.height, at)


def draw_page(found: Survey, path: Path, name: str) -> None:
    """
    Draw a page of figures about a log.

    Parameters
    ----------
    found : Survey
        With samples of attitudes (`found.shown`).
    path : Path
        Picture to write; its extension is the format.
    name : str
        Name of the log, for the title.

    Raises
    ------
    OSError, ValueError
        The picture cannot be written, or the format is unknown.
    """
    assert found.shown is not None
    motion = _motion_of(found, found.shown)
    period = motion.measured.nutation_period if motion.measured is not None else None
    shown_s = PAGE_S if period is None else PAGE_NUTATIONS * period
    tilts = found.shown.first(shown_s)
    figure = Figure(figsize=(11.0, 10.2 if found.readings else 7.8), layout='constrained')
    rows = 4 if found.readings else 3
    grid = figure.add_gridspec(rows, 2, height_ratios=[1.1, 1.1, 1.0, 1.0][:rows])
    _title(figure, found, motion, name)
    _tip_panel(figure.add_subplot(grid[0:2, 0]), tilts, motion)
    tilt = figure.add_subplot(grid[0, 1])
    _tilt_panel(tilt, tilts, motion)
    _precession_panel(figure.add_subplot(grid[1, 1], sharex=tilt), tilts, motion)
    _drift_panel(figure.add_subplot(grid[2, 0]), found)
    _error_panel(figure.add_subplot(grid[2, 1]), found)
    if found.readings:
        for column, quantity, unit in ((0, 'angular velocity', 'rad/s'),
                                       (1, 'specific force', 'm/s²')):
            _imu_panel(figure.add_subplot(grid[3, column]), found, quantity, unit, shown_s)
    figure.savefig(path, dpi=120)


def _motion_of(found: Survey, tilts: Tilts) -> MotionReport:
    """Return the motion of the samples shown."""
    first = int(tilts.stamps_ns[0])
    return next(motion for motion in found.motions if motion.begin_ns < first <= motion.end_ns)


def _title(figure: Figure, found: Survey, motion: MotionReport, name: str) -> None:
    regime = motion.regime or (motion.described.name if motion.described else '')
    figure.suptitle(f'{name}: {regime}', fontsize=14, color=INK)


def _tip_panel(axes: Axes, tilts: Tilts, motion: MotionReport) -> None:
    turned = np.flatnonzero(np.abs(tilts.phi - tilts.phi[0]) > 2.0 * np.pi)
    measured = motion.measured
    if len(turned):         # one turn is enough, if two nutations are in it
        period = None if measured is None else measured.nutation_period
        tilts = tilts.first(max(float(tilts.time[turned[0]]), 2.0 * (period or 0.0)))
    time, tip, height = smooth_tip(tilts)
    low, high = ((float(np.min(tilts.theta)), float(np.max(tilts.theta))) if measured is None
                 else (measured.theta_min, measured.theta_max))
    draw_sphere(axes, (low, high, np.pi / 2),
                lowest=-0.9 if high < np.radians(100.0) else -1.25)
    draw_tip(axes, tip, height)
    axes.set_title(f'path of the tip, t = 0 to {time[-1]:.3g} s', fontsize=11, color=INK)


def _tilt_panel(axes: Axes, tilts: Tilts, motion: MotionReport) -> None:
    time, _, height = smooth_tip(tilts)
    axes.plot(time, np.degrees(np.arccos(np.clip(height, -1.0, 1.0))), color=COLOURS[0])
    if motion.measured is not None and motion.measured.nutation_period is not None:
        axes.set_title(f'nutation, period {motion.measured.nutation_period:.9g} s', fontsize=11)
    _dress(axes, 'tilt θ [deg]', 'time [s]')


def _precession_panel(axes: Axes, tilts: Tilts, motion: MotionReport) -> None:
    if tilts.phi_dot is None:
        axes.text(0.5, 0.5, "φ': no topic with rates", ha='center', transform=axes.transAxes)
    else:
        axes.plot(tilts.time, tilts.phi_dot, color=COLOURS[1])
        low, high = np.nanpercentile(tilts.phi_dot, (1.0, 99.0))
        if np.nanmax(np.abs(tilts.phi_dot)) > 20.0 * max(abs(low), abs(high), 1e-3):
            axes.set_yscale('symlog', linthresh=max(abs(low), abs(high)))
        axes.axhline(0.0, color=FAINT, linewidth=0.8, zorder=0)
    if motion.measured is not None and motion.measured.mean_precession_rate is not None:
        mean = motion.measured.mean_precession_rate
        axes.axhline(mean, color=INK, linewidth=0.9, linestyle='--')
        axes.set_title(f'precession, mean {mean:.9g} rad/s (dashed)', fontsize=11)
    _dress(axes, "φ' [rad/s]", 'time [s]')


def _drift_panel(axes: Axes, found: Survey) -> None:
    topic = min(found.drifts, default='', key=lambda name: found.drifts[name]['energy'].largest)
    if topic:
        for (name, curve), colour, style in zip(found.drifts[topic].items(), COLOURS,
                                                ('-', '--', ':'), strict=False):
            stamps, values = curve.points()
            label = {'energy': 'E', 'l3': '$L_3$', 'lz': '$L_z$'}[name]
            axes.plot((stamps - found.begin_ns) * 1e-9, values, style, color=colour,
                      linewidth=1.0, label=label)
        axes.legend(loc='upper left', ncols=3, fontsize=8, frameon=False)
        axes.margins(y=0.25)
        axes.set_title(f'drift of the constants, from {topic}', fontsize=11)
    _mark_motions(axes, found)
    _dress(axes, 'relative drift', 'time in the log [s]')


def _error_panel(axes: Axes, found: Survey) -> None:
    if found.errors:
        topic = min(found.errors, key=lambda name: found.errors[name].largest)
        stamps, values = found.errors[topic].points()
        axes.plot((stamps - found.begin_ns) * 1e-9, values, color=COLOURS[2], linewidth=1.0)
        axes.set_title(f'error against the exact solution, from {topic}', fontsize=11)
        axes.set_ylim(bottom=0.0)
    _mark_motions(axes, found)
    _dress(axes, 'orientation error [rad]', 'time in the log [s]')


def _mark_motions(axes: Axes, found: Survey) -> None:
    """Mark commands and resets, where there are not too many."""
    for motion in found.motions[1:] if len(found.motions) <= 30 else ():
        axes.axvline((motion.begin_ns - found.begin_ns) * 1e-9, color=FAINT, linewidth=0.8,
                     zorder=0)


def _imu_panel(axes: Axes, found: Survey, quantity: str, unit: str, shown_s: float) -> None:
    # The noisy readings, else the noise-free ones, else the bias.
    topic = min(found.readings, key=lambda name: (not name.endswith('data_raw'),
                                                  not name.endswith('ground_truth/imu')))
    readings = found.readings[topic]
    vectors = (readings.angular_velocity if quantity == 'angular velocity'
               else readings.specific_force)
    time = (readings.stamps_ns - readings.stamps_ns[0]) * 1e-9
    shown = time <= shown_s
    for axis, column, colour in zip('xyz', vectors.T, COLOURS, strict=False):
        axes.plot(time[shown], column[shown], color=colour, linewidth=0.9, label=axis)
    axes.legend(loc='upper right', ncols=3, fontsize=8, frameon=False)
    axes.margins(y=0.2)
    axes.set_title(f'{quantity}, {topic}', fontsize=11)
    _dress(axes, f'{quantity} [{unit}]', 'time [s]')


def _dress(axes: Axes, what: str, when: str) -> None:
    axes.set_ylabel(what, fontsize=9)
    axes.set_xlabel(when, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.margins(x=0.0)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)


def animate(found: Survey, path: Path) -> None:
    """
    Draw the turning top, at most LONGEST_S of it: axis, disc with a mark, trace.

    Parameters
    ----------
    found : Survey
        With samples of attitudes (`found.shown`).
    path : Path
        GIF to write.

    Raises
    ------
    OSError, ValueError
        The picture cannot be written.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter  # noqa: PLC0415

    tilts = found.shown
    assert tilts is not None
    duration = min(LONGEST_S, float(tilts.time[-1]))
    frames = max(2, int(duration * FRAMES_PER_S))
    at = np.arange(frames) / (FRAMES_PER_S * tilts.period)
    spin = np.interp(at, np.arange(len(tilts.psi)), tilts.psi)
    trace = np.linspace(0.0, at[-1], frames * FINER)
    tip, height = interpolate(tilts.tip, trace), interpolate(tilts.height, trace)
    lowest = -0.9 if float(np.min(height)) > -0.2 else -1.25

    figure = Figure(figsize=(FRAME_SIZE, FRAME_SIZE), dpi=FRAME_DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def frame(number: int) -> list[Artist]:
        axes.clear()
        draw_sphere(axes, (np.pi / 2,), lowest)
        shown = number * FINER + 1
        _draw_body(axes, tip[number * FINER], float(height[number * FINER]), float(spin[number]))
        draw_tip(axes, tip[:shown], height[:shown])
        axes.text(-1.05, 1.15, f't = {number / FRAMES_PER_S:.2f} s', color=INK, fontsize=9)
        return []

    FuncAnimation(figure, frame, frames=frames, blit=False).save(
        path, writer=PillowWriter(fps=FRAMES_PER_S))


def _draw_body(axes: Axes, tip: complex, height: float, psi: float) -> None:
    """Draw the disc across the axis, with a mark that turns with the body."""
    theta = np.arctan2(abs(tip), height)
    attitude = Rotation.from_euler('ZYZ', (float(np.angle(tip)), theta, psi))

    def rim(angles: Reals) -> Reals:
        edge = DISC * np.exp(1j * angles)
        return on_sphere(edge, np.full(len(angles), DISC_HEIGHT))

    across, up, _ = project(attitude.apply(rim(np.linspace(0.0, 2.0 * np.pi, 60))))
    axes.fill(across, up, facecolor='#f2e3c9', edgecolor=INK, linewidth=1.0, alpha=0.9)
    sector = np.vstack(((0.0, 0.0, DISC_HEIGHT), rim(np.linspace(-0.25, 0.25, 9))))
    across, up, _ = project(attitude.apply(sector))
    axes.fill(across, up, color=COLOURS[1])
