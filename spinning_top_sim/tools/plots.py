# SPDX-License-Identifier: Apache-2.0
"""Pictures of a log: a page of figures, and an animation of the top."""

from collections.abc import Sequence
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
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools.analysis import Attitudes
from spinning_top_sim.tools.survey import MotionReport, Survey

STYLE = {**pictures.STYLE, 'axes.prop_cycle': cycler(color=COLOURS), 'legend.fontsize': 8,
         'legend.frameon': False}
FINER = 10                  # points of a curve for each sample
MOST_DRAWN = 20_000         # points of a curve
PAGE_NUTATIONS, PAGE_S = 8, 5.0      # duration of the page; in seconds without nutation
MOST_MARKS = 30             # motions whose beginnings are marked
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


def draw_page(found: Survey, motion: MotionReport, data: Attitudes, path: Path) -> str:
    """Draw a page about a log and the samples of a motion; return in words what it shows."""
    assert motion.measured is not None
    period, mean = motion.measured.nutation_period, motion.measured.mean_precession_rate
    data = data.first(PAGE_NUTATIONS * period if period else PAGE_S)
    rows = 4 if found.readings else 3
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 2.4 * rows + 0.6), layout='constrained')
        grid = figure.add_gridspec(rows, 2, height_ratios=[1.1, 1.1, 1.0, 1.0][:rows])
        regime = motion.regime or (motion.exact.name if motion.exact else '')
        figure.suptitle(f'{found.path.name}: {regime}', fontsize=14)
        _tip_panel(figure.add_subplot(grid[0:2, 0]), data, period or 0.0)
        tilt = figure.add_subplot(grid[0, 1])
        time, _, height = smooth_tip(data)
        tilt.plot(time, np.degrees(np.arccos(np.clip(height, -1.0, 1.0))))
        tilt.set(title=f'nutation, period {period:.9g} s' if period else '',
                 xlabel='time [s]', ylabel='tilt θ [deg]')
        _precession_panel(figure.add_subplot(grid[1, 1], sharex=tilt), data, mean)
        _accuracy_panels(found, *(figure.add_subplot(grid[2, column]) for column in (0, 1)))
        if found.readings:
            _reading_panels(found, data, [figure.add_subplot(grid[3, column])
                                          for column in (0, 1)])
        figure.savefig(path, dpi=120)
    return f'motion {_part(found, data, float(data.time[-1]))}; drifts and errors of all of it'


def _part(found: Survey, data: Attitudes, duration: float) -> str:
    """Return in words which part of the log is shown."""
    begin = float(data.stamps_ns[0] - found.damage.start_ns) / NANOSECONDS
    whole = (found.damage.end_ns - found.damage.start_ns) / NANOSECONDS
    return f'from {begin:.4g} to {begin + duration:.4g} s of {whole:.4g} s in the log'


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
    rate = data.phi_dot
    if rate is None or np.isnan(rate).all():
        axes.text(0.5, 0.5, "φ': no topic with rates", ha='center', transform=axes.transAxes)
    else:
        axes.plot(data.time, rate, color=COLOURS[1])
        usual = float(np.max(np.abs(np.nanpercentile(rate, (1.0, 99.0)))))
        if np.nanmax(np.abs(rate)) > 20.0 * max(usual, 1e-3):
            axes.set_yscale('symlog', linthresh=usual)
        axes.axhline(0.0, color=FAINT, linewidth=0.8, zorder=0)
    if mean is not None:
        axes.axhline(mean, color=INK, linewidth=0.9, linestyle='--')
        axes.set_title(f'precession, mean {mean:.9g} rad/s (dashed)')


def _accuracy_panels(found: Survey, drifts: Axes, errors: Axes) -> None:
    """Draw the drifts and the orientation error of the most accurate topics."""
    start_ns = found.damage.start_ns
    if found.drifts:
        topic = min(found.drifts, key=lambda name: found.drifts[name]['energy'].largest)
        for series, style, label in zip(found.drifts[topic].values(), ('-', '--', ':'),
                                        ('E', '$L_3$', '$L_z$'), strict=True):
            stamps_ns, values = series.points
            drifts.plot((stamps_ns - start_ns) * 1e-9, values, linestyle=style, label=label)
        drifts.legend(loc='upper left', ncols=3)
        drifts.margins(y=0.25)
        drifts.set_title(f'drift of the constants, from {topic}')
    if found.errors:
        topic = min(found.errors, key=lambda name: found.errors[name].largest)
        stamps_ns, values = found.errors[topic].points
        errors.plot((stamps_ns - start_ns) * 1e-9, values, color=COLOURS[2])
        errors.set_title(f'error against the exact solution, from {topic}')
        errors.set_ylim(bottom=0.0)
    for axes, quantity in ((drifts, 'relative drift'), (errors, 'orientation error [rad]')):
        axes.set(xlabel='time in the log [s]', ylabel=quantity)
        for later in found.motions[1:] if len(found.motions) <= MOST_MARKS else ():
            axes.axvline((later.begin_ns - start_ns) * 1e-9, color=FAINT, linewidth=0.8, zorder=0)


def _reading_panels(found: Survey, data: Attitudes, panels: Sequence[Axes]) -> None:
    """Draw the readings of the IMU during the samples that are shown."""
    # The noisy readings, else the noise-free ones, else the bias.
    topic = min(found.readings, key=lambda name: (not name.endswith('data_raw'),
                                                  not name.endswith('ground_truth/imu')))
    time, *vectors = np.concatenate(found.readings[topic]).T
    shown = time <= time[0] + float(data.time[-1])
    for column, label in enumerate(('angular velocity [rad/s]', 'specific force [m/s²]')):
        axes = panels[column]
        for axis, values in zip('xyz', vectors[3 * column:], strict=False):
            axes.plot((time - time[0])[shown], values[shown], label=axis)
        axes.legend(loc='upper right', ncols=3)
        axes.margins(y=0.2)
        axes.set(title=f'{label.partition(" [")[0]}, {topic}', xlabel='time [s]', ylabel=label)


def animate(found: Survey, _motion: MotionReport, data: Attitudes, path: Path) -> str:
    """Draw the turning top as a GIF: a disc with a mark, and the trace of the tip."""
    frames = max(2, int(min(LONGEST_S, float(data.time[-1])) * FRAMES_PER_S))
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
    return f'motion {_part(found, data, frames / FRAMES_PER_S)}'
