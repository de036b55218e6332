# SPDX-License-Identifier: Apache-2.0
"""Pictures of a log: a page of figures, and an animation of the top."""

from pathlib import Path

import numpy as np
from cycler import cycler
from matplotlib import rc_context
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from spinning_top_sim.physics import pictures
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.pictures import (
    COLOURS,
    DISC,
    DISC_HEIGHT,
    FAINT,
    INK,
    draw_sphere,
    draw_tip,
    on_sphere,
    project,
)
from spinning_top_sim.tools.analysis import Attitudes
from spinning_top_sim.tools.survey import MotionReport

STYLE = {**pictures.STYLE, 'axes.prop_cycle': cycler(color=COLOURS), 'legend.fontsize': 8,
         'legend.frameon': False}
FINER = 10                  # points of a curve for each sample
MOST_DRAWN = 20_000         # points of a curve
PAGE_NUTATIONS, PAGE_S = 8, 5.0      # duration of the page; in seconds without nutation
FRAMES_PER_S, LONGEST_S = 20, 10.0


def smooth_tip(data: Attitudes) -> tuple[Column, NDArray[np.complex128], Column]:
    """Return time [s], tip (x + iy) and height of the axis, with points between the samples."""
    last = len(data.stamps_ns) - 1
    at = np.linspace(0.0, last, min(last * FINER, MOST_DRAWN) + 1)
    return at * data.period, *tip_at(data, at)


def tip_at(data: Attitudes, at: Column) -> tuple[NDArray[np.complex128], Column]:
    """Return tip and height at fractional indices of the samples."""
    count = len(data.stamps_ns)
    tip, height = (make_interp_spline(np.arange(count), values, k=min(5, count - 1))(at)
                   for values in (data.tip, data.height))
    return tip, height


def draw_page(name: str, motion: MotionReport, data: Attitudes, path: Path) -> None:
    """Draw a page about the first samples of a motion in the log of this name."""
    assert motion.measured is not None
    period, mean = motion.measured.nutation_period, motion.measured.mean_precession_rate
    data = data.first(PAGE_NUTATIONS * period if period else PAGE_S)
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 5.4), layout='constrained')
        grid = figure.add_gridspec(2, 2)
        figure.suptitle(f'{name}: {motion.exact.name if motion.exact else ""}', fontsize=14)
        _tip_panel(figure.add_subplot(grid[:, 0]), data, period or 0.0)
        tilt = figure.add_subplot(grid[0, 1])
        time, _, height = smooth_tip(data)
        tilt.plot(time, np.degrees(np.arccos(np.clip(height, -1.0, 1.0))))
        tilt.set(title=f'nutation, period {period:.9g} s' if period else '',
                 xlabel='time [s]', ylabel='tilt θ [deg]')
        _precession_panel(figure.add_subplot(grid[1, 1], sharex=tilt), data, mean)
        figure.savefig(path, dpi=120)


def _tip_panel(axes: Axes, data: Attitudes, period: float) -> None:
    turned = np.flatnonzero(np.abs(data.phi - data.phi[0]) > 2.0 * np.pi)
    if len(turned):         # show one turn, but at least two nutations
        data = data.first(max(float(data.time[turned[0]]), 2.0 * period))
    time, tip, height = smooth_tip(data)
    low, high = np.arccos(np.clip([np.max(height), np.min(height)], -1.0, 1.0))
    draw_sphere(axes, (low, high, np.pi / 2), -0.9 if high < np.radians(100.0) else -1.25)
    draw_tip(axes, tip, height)
    axes.set_title(f'path of the tip, t = 0 to {time[-1]:.3g} s')


def _precession_panel(axes: Axes, data: Attitudes, mean: float | None) -> None:
    axes.set(xlabel='time [s]', ylabel="φ' [rad/s]")
    if data.phi_dot is not None:
        axes.plot(data.time, data.phi_dot, color=COLOURS[1])
    axes.axhline(0.0, color=FAINT, linewidth=0.8, zorder=0)
    if mean is not None:
        axes.axhline(mean, color=INK, linewidth=0.9, linestyle='--')
        axes.set_title(f'precession, mean {mean:.9g} rad/s (dashed)')


def animate(data: Attitudes, path: Path) -> None:
    """Draw the turning top as a GIF: a disc with a mark, and the trace of the tip."""
    data = data.first(LONGEST_S)
    frames = max(2, int(float(data.time[-1]) * FRAMES_PER_S))
    # Indices of the samples; with few samples the last frame may be later than the last of them.
    at = np.minimum(np.arange(frames) / (FRAMES_PER_S * data.period), len(data.stamps_ns) - 1)
    spin = np.interp(at, np.arange(len(data.psi)), data.psi)
    trace = np.interp(np.arange((frames - 1) * FINER + 1) / FINER, np.arange(frames), at)
    tip, height = tip_at(data, trace)
    lowest = -0.9 if np.min(height) > -0.2 else -1.25
    figure = Figure(figsize=(3.6, 3.6), dpi=90)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    # The disc is perpendicular to the axis; the mark shows the spin.
    rim, mark = (on_sphere(DISC * np.exp(1j * np.linspace(begin, end, count)), DISC_HEIGHT)
                 for begin, end, count in ((0.0, 2.0 * np.pi, 60), (-0.25, 0.25, 9)))
    mark = np.vstack(((0.0, 0.0, DISC_HEIGHT), mark))

    def frame(number: int) -> list[Artist]:
        axes.clear()
        draw_sphere(axes, (np.pi / 2,), lowest)
        now = number * FINER
        body = Rotation.from_euler('ZYZ', (
            np.angle(tip[now]), np.arctan2(abs(tip[now]), height[now]), spin[number]))
        axes.fill(*project(body.apply(rim))[:2], facecolor='#f2e3c9', edgecolor=INK,
                  linewidth=1.0, alpha=0.9)
        axes.fill(*project(body.apply(mark))[:2], color=COLOURS[1])
        draw_tip(axes, tip[:now + 1], height[:now + 1])
        axes.text(-1.05, 1.15, f't = {number / FRAMES_PER_S:.2f} s', color=INK, fontsize=9)
        return []

    FuncAnimation(figure, frame, frames=frames, blit=False).save(
        path, writer=PillowWriter(fps=FRAMES_PER_S))
