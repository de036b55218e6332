# SPDX-License-Identifier: Apache-2.0
"""Pictures of a motion by matplotlib: the tip's path on the sphere, its curves, an animation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude

Reals = NDArray[np.float64]
# From the world to the viewer: towards, right, up.  60 deg about z, then 45 deg about y.
_TURN, _TILT = np.radians(60.0), np.radians(45.0)
VIEW = np.array([[np.cos(_TILT), 0.0, np.sin(_TILT)], [0.0, 1.0, 0.0],
                 [-np.sin(_TILT), 0.0, np.cos(_TILT)]]) @ np.array(
    [[np.cos(_TURN), -np.sin(_TURN), 0.0], [np.sin(_TURN), np.cos(_TURN), 0.0], [0.0, 0.0, 1.0]])
FULL_TURN = 2.0 * np.pi
INK, FAINT, PATH = '#1b1b1b', '#c9c9c9', '#0b6fa4'
# Okabe and Ito's colours: distinct also for the colour-blind, and as greys.
COLOURS = ('#0072b2', '#d55e00', '#009e73')
LEAST_CHANGE = 1e-12         # that an axis shows
DISC, DISC_HEIGHT = 0.42, 0.45      # radius of the body's disc and its place on the axis


def project(points: Reals) -> tuple[Reals, Reals, Reals]:
    """Return picture coordinates across and up of points (n, 3), and how near they are (n,)."""
    near, across, up = VIEW @ points.T
    return across, up, near


def draw(axes: Axes, points: Reals, color: str, width: float) -> None:
    """Draw a curve (n, 3) on the sphere: the part behind it faintly."""
    across, up, near = project(points)
    for visible, alpha in ((near >= 0.0, 1.0), (near < 0.0, 0.25)):
        axes.plot(np.where(visible, across, np.nan), np.where(visible, up, np.nan),
                  alpha=alpha, color=color, linewidth=width)


def arc(begin: float, end: float, radius: float, height: float) -> Reals:
    """Return points (n, 3) of a horizontal arc between two angles [rad]."""
    angle = np.linspace(begin, end, 201)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full(201, height)), axis=1)


def draw_sphere(axes: Axes, tilts: Sequence[float]) -> None:
    """Draw the unit sphere with circles of these tilts."""
    axes.plot(*arc(0.0, FULL_TURN, 1.0, 0.0).T[:2], color=FAINT, linewidth=1.0)
    for theta in tilts:
        draw(axes, arc(0.0, FULL_TURN, np.sin(theta), np.cos(theta)), FAINT, 0.8)
    axes.set_aspect('equal')
    axes.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.25))
    axes.axis('off')


def draw_tip(axes: Axes, path: Reals) -> None:
    """Draw the tip's path (n, 3), and the axis at its end."""
    draw(axes, path, PATH, 1.8)
    across, up, _ = project(path[-1:])
    axes.plot([0.0, *across], [0.0, *up], color=INK, linewidth=2.2, solid_capstyle='round')
    axes.plot(across, up, 'o', color=INK, markersize=5)


def _outline(motion: Any) -> tuple[Reals, list[float]]:
    """Return the path of the axis (n, 3) and the bounds of theta.  Raises ValueError."""
    if len(motion.t) < 2:
        raise ValueError(f't has {len(motion.t)} times: a picture must have 2 at least')
    for k in np.flatnonzero(~(np.diff(motion.t) > 0.0)).tolist():
        raise ValueError(f't[{k + 1}] = {float(motion.t[k + 1])!r} s: must be later than t[{k}] = '
                         f'{float(motion.t[k])!r} s')
    path = np.stack(motion.rows_axis, axis=1)
    tilts = np.arctan2(np.hypot(path[:, 0], path[:, 1]), path[:, 2])
    return path, [float(tilts.min()), float(tilts.max())]


def plot(motion: Any, change: Reals, begins: Sequence[float] = (), end: float = np.inf) -> Figure:
    """
    Return a figure of `States`, or of what has its columns; see `States.plot`.

    motion : has t, rows_axis, theta_folded and phi_dot
    change : relative one of the energy, (n,)
    begins : times at which other motions begin [s]
    end : time up to which it is drawn [s]
    """
    path, bounds = _outline(motion)
    shown = slice(max(int(np.searchsorted(motion.t, end, 'right')), 2))
    figure = Figure(figsize=(10.0, 7.0), layout='constrained')
    panels = figure.subplot_mosaic([['sphere', 'theta'], ['sphere', 'rate'], ['sphere', 'change']])
    draw_sphere(panels['sphere'], (*bounds, np.pi / 2))
    draw_tip(panels['sphere'], path[shown])
    panels['sphere'].set_title('path of the axis on the unit sphere')
    for name, title, label, values, color in (
            ('theta', 'nutation', 'tilt θ [deg]', np.degrees(motion.theta_folded), COLOURS[0]),
            ('rate', 'precession', "rate φ' [rad/s]", motion.phi_dot, COLOURS[1]),
            ('change', 'energy', 'relative change [1]', change, COLOURS[2])):
        panels[name].plot(motion.t[shown], values[shown], color=color)
        panels[name].set(title=title, ylabel=label, xlabel='t [s]')
        for begin in (begin for begin in begins if begin <= end):
            panels[name].axvline(begin, color=FAINT, linewidth=0.8, zorder=0)
    # Of an exact motion it is rounding noise.
    reach = max(LEAST_CHANGE, 1.1 * float(np.max(np.abs(change[shown]), initial=0.0,
                                                 where=np.isfinite(change[shown]))))
    panels['change'].set_ylim(-reach, reach)
    panels['rate'].axhline(0.0, color=FAINT, linewidth=0.8, zorder=0)
    return figure


def animate(motion: Any, fps: float = 20.0, seconds: float = np.inf) -> FuncAnimation:
    """
    Return an animation of the body, its axis and the path of the tip; raises as `States.plot`.

    Parameters
    ----------
    motion : States
        Or what has its t, rows_axis and quaternion.
    fps : float
        Frames per second, > 0; each shows the newest sample: no others are computed.
    seconds : float
        Length of the animation at most.
    """
    path, bounds = _outline(motion)
    if not 0.0 < fps < np.inf:
        raise ValueError(f'fps = {fps!r}: must be a number > 0')
    times = motion.t - motion.t[0]
    # Each frame shows a sample: the newest one, but for rounding.
    count = int(min(times[-1], seconds) * fps + 1e-6) + 1
    shown = np.searchsorted(times, (np.arange(count) + 1e-6) / fps, 'right') - 1
    rim = arc(0.0, FULL_TURN, DISC, DISC_HEIGHT)
    mark = np.vstack(((0.0, 0.0, DISC_HEIGHT), arc(-0.25, 0.25, DISC, DISC_HEIGHT)))
    figure = Figure(figsize=(4.0, 4.0), dpi=80)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def frame(number: int) -> list[Artist]:
        axes.clear()
        draw_sphere(axes, bounds)
        now = shown[number]
        for points, style in ((rim, {'facecolor': '#f2e3c9', 'edgecolor': INK, 'alpha': 0.9}),
                              (mark, {'color': COLOURS[1]})):
            turned = attitude.rotated(tuple(motion.quaternion[now]), tuple(points.T))
            axes.fill(*project(np.stack(turned, axis=1))[:2], **style)
        draw_tip(axes, path[:now + 1])
        axes.text(-1.05, 1.15, f't = {motion.t[now]:.2f} s', color=INK, fontsize=9)
        return []

    return FuncAnimation(figure, frame, frames=count, interval=1000.0 / fps, blit=False)
