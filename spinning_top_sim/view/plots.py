# SPDX-License-Identifier: Apache-2.0
"""The plots beside the scene, as SVG: so a page of viser has them, and a file without it."""

import html
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.source import Reals, Track, effective_potential

BLUE, RED, GREEN = '#1c6dd0', '#d9482b', '#1e8a4c'
FLAT, ZERO = 1e-3, 1e-12        # least range of an axis / the greatest value; this and less is 0
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 340, 172, 46, 332, 38, 140        # [px]


class Line(NamedTuple):
    """A line through points; its name is in the legend."""

    name: str
    colour: str
    x: Reals
    y: Reals


class Plot(NamedTuple):
    """
    A plot with a mark at x = now.

    point : where the mark has a point; NaN: nowhere
    over : what x is, the time [s] or the tilt [deg]
    """

    title: str
    x_label: str
    y_label: str
    lines: list[Line]
    now: float
    point: float = math.nan
    over: Literal['time', 'tilt'] = 'time'


def potential_plot(track: Track, t_ns: int) -> Plot:
    """Return V around the bounds of theta, and the energy of the axis; no lines if not known."""
    body, newest, motion = track.top, track.newest(t_ns), track.motion_at(t_ns)
    plot = Plot('Effective potential V(θ)', 'tilt θ [deg]', 'V [J]', [], math.nan, over='tilt')
    if newest is None or motion is None or motion.description is None:
        return plot
    l3, lz = motion.l3, motion.lz
    theta = np.linspace(1e-3, math.pi - 1e-3, 2000)
    values = effective_potential(body, l3, lz, theta)
    depth = max(motion.energy - float(values.min()), 0.05 * abs(body.gravity_torque),
                1e-6 * abs(motion.energy))
    shown = np.flatnonzero(values <= motion.energy + depth)
    theta = np.linspace(theta[shown[0]], theta[shown[-1]], 200)
    bounds = np.array([motion.description.theta_min, motion.description.theta_max])
    return plot._replace(lines=[
        Line('V', BLUE, np.degrees(theta), effective_potential(body, l3, lz, theta)),
        Line('E − L₃²/2λ₃', GREEN, np.degrees(bounds), np.full(2, motion.energy))],
        now=math.degrees(track.state(newest).theta_folded[0]), point=motion.energy)


def time_plots(track: Track, t_ns: int, begin_ns: int, end_ns: int) -> list[Plot]:
    """
    Return the plots of energies, tilt and precession, as far as there are data.

    t_ns : the time that is marked
    begin_ns, end_ns : span of the plots over the time; of a fast motion they show a part
    """
    states, label = track.states(t_ns, begin_ns, end_ns), 'time t [s]'
    seconds, (w1, w2, w3), top = states.t, states.rows_angular_velocity, track.top
    # Without the motion of the pivot.
    kinetic = 0.5 * (top.lambda1 * (w1 * w1 + w2 * w2) + top.lambda3 * w3 * w3) + 0.0 * seconds
    height = top.gravity_torque * states.rows_axis[2]
    now = t_ns / NANOSECONDS
    return [
        Plot('Energy', label, 'E [J]', [
            Line('kinetic', RED, seconds, kinetic), Line('potential', BLUE, seconds, height),
            Line('sum', GREEN, seconds, kinetic + height)], now),
        Plot('Tilt', label, 'θ [deg]', [
            Line('θ', RED, seconds, np.degrees(states.theta_folded))], now),
        Plot('Precession rate', label, 'φ′ [rad/s]', [
            Line('φ′', BLUE, seconds, states.phi_dot)], now)]


class _Axis:
    """An axis from `low` to `high`, which are at two pixels."""

    def __init__(self, parts: Sequence[Reals], margin: float, first: int, last: int) -> None:
        values = np.concatenate(parts)
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        size = max(abs(low), abs(high))
        least = FLAT * size if size > ZERO else 1.0
        add = margin * (high - low) + (least if high - low < least else 0.0)
        self.low, self.high, self._first, self._last = low - add, high + add, first, last

    def place(self, value: Reals | float) -> Reals:
        """Return the pixels of values."""
        share = (np.asarray(value) - self.low) / (self.high - self.low)
        return (self._first + share * (self._last - self._first)).round(1)

    def ticks(self) -> list[tuple[float, str]]:
        """Return the pixels of round numbers, and how these are written."""
        span = (self.high - self.low) / 5.0
        step = 10.0 ** math.floor(math.log10(span))
        step *= next((factor for factor in (1, 2, 5) if span <= factor * step), 10)
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        numbers = step * np.arange(math.ceil(self.low / step - 1e-9),
                                   math.floor(self.high / step + 1e-9) + 1)
        return [(float(self.place(number)), f'{number:.{digits}f}'.replace('-', '−')
                 if digits < 7 else f'{number:.7g}') for number in numbers.tolist()]


def draw(plot: Plot) -> str:
    """
    Return a plot as an SVG element, or '' without data.

    `data-x` has the ends of its x axis, and `data-px` their pixels.  The classes are plot, title,
    grid and now; others style them.
    """
    lines = [line for line in plot.lines if np.isfinite(line.y).any()]
    if not lines:
        return ''
    across = _Axis([line.x for line in lines], 0.0, LEFT, RIGHT)
    up = _Axis([line.y for line in lines], 0.08, BOTTOM, TOP)
    names = {line.name: line.colour for line in lines}
    drawn = [
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{plot.title}" '
        f'data-over="{plot.over}" data-x="{across.low:.9g} {across.high:.9g}" '
        f'data-px="{LEFT} {RIGHT}"><text class="title" x="8" y="14">{plot.title}</text>'
        f'<text x="8" y="28">{plot.y_label}</text><text x="{(LEFT + RIGHT) / 2}" '
        f'y="{HEIGHT - 5}" text-anchor="middle">{plot.x_label}</text>'
        f'<text x="{RIGHT}" y="28" text-anchor="end">', '\u2003'.join(
            f'<tspan fill="{colour}">●</tspan> {html.escape(name)}'
            for name, colour in names.items() if len(names) > 1), '</text>']
    for x, number in across.ticks():
        drawn.append(f'<path class="grid" d="M{x} {TOP}V{BOTTOM}"/>'
                     f'<text x="{x}" y="{BOTTOM + 13}" text-anchor="middle">{number}</text>')
    for y, number in up.ticks():
        drawn.append(f'<path class="grid" d="M{LEFT} {y}H{RIGHT}"/>'
                     f'<text x="{LEFT - 5}" y="{y + 3}" text-anchor="end">{number}</text>')
    for line in lines:
        places = np.column_stack((across.place(line.x), up.place(line.y)))[np.isfinite(line.y)]
        points = ' '.join(f'{x},{y}' for x, y in places.tolist())
        drawn.append(f'<polyline stroke="{line.colour}" points="{points}"/>')
    if math.isfinite(plot.now):
        dot = '' if math.isnan(plot.point) else f'<circle cy="{up.place(plot.point)}" r="5"/>'
        drawn.append(f'<g class="now" transform="translate({across.place(plot.now)} 0)">'
                     f'<path d="M0 {TOP}V{BOTTOM}"/>{dot}</g>')
    return ''.join([*drawn, '</svg>'])
