# SPDX-License-Identifier: Apache-2.0
"""Plots as SVG, for pages: a title, axes with round numbers, lines, points, and a mark."""

import html
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
FLAT = 1e-3                     # least range of an axis / the greatest value
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 340, 172, 46, 8, 38, 32       # [px]


class Line(NamedTuple):
    """A line through points, or with `dots` the points alone; its name is in the legend."""

    name: str
    colour: str
    x: Reals
    y: Reals
    dash: str = ''
    dots: bool = False


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


class _Frame(NamedTuple):
    low: float
    high: float
    bottom: float
    top: float

    def place(self, x: Reals, y: Reals) -> list[list[float]]:
        across = (x - self.low) * ((WIDTH - LEFT - RIGHT) / (self.high - self.low))
        down = (self.top - y) * ((HEIGHT - TOP - BOTTOM) / (self.top - self.bottom))
        return np.column_stack((LEFT + across, TOP + down)).round(1).tolist()

    def place_one(self, x: float, y: float) -> list[float]:
        return self.place(np.array([x]), np.array([y]))[0]


def draw(plot: Plot) -> str:
    """
    Return a plot as an SVG element, or '' without data; `data-x` has the ends of its x axis.

    `data-px` has their places.  The classes are plot, title, grid and now; others style them.
    """
    lines = [line for line in plot.lines if np.isfinite(line.y).any()]
    if not lines:
        return ''
    frame = _Frame(*_range([line.x for line in lines], 0.0),
                   *_range([line.y for line in lines], 0.08))
    return (
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{plot.title}" '
        f'data-over="{plot.over}" '
        f'data-x="{frame.low:.9g} {frame.high:.9g}" data-px="{LEFT} {WIDTH - RIGHT}">'
        f'<text class="title" x="8" y="14">{plot.title}</text>'
        f'<text x="{WIDTH - RIGHT}" y="28" text-anchor="end">{_legend(lines)}</text>'
        f'<text x="8" y="28">{plot.y_label}</text>'
        f'<text x="{(WIDTH + LEFT - RIGHT) / 2}" y="{HEIGHT - 5}" text-anchor="middle">'
        f'{plot.x_label}</text>{_grid(frame)}{"".join(_curve(frame, line) for line in lines)}'
        f'{_mark(frame, plot)}</svg>')


def _legend(lines: Sequence[Line]) -> str:
    names = {line.name: line.colour for line in lines}
    return ''.join(f'<tspan fill="{colour}" dx="9">●</tspan><tspan dx="3">{html.escape(name)}'
                   '</tspan>' for name, colour in names.items()) if len(names) > 1 else ''


def _grid(frame: _Frame) -> str:
    drawn = []
    for x, text in _ticks(frame.low, frame.high, 5):
        at, _ = frame.place_one(x, 0.0)
        drawn.append(f'<path class="grid" d="M{at} {TOP}V{HEIGHT - BOTTOM}"/>'
                     f'<text x="{at}" y="{HEIGHT - 19}" text-anchor="middle">{text}</text>')
    for y, text in _ticks(frame.bottom, frame.top, 5):
        _, at = frame.place_one(0.0, y)
        drawn.append(f'<path class="grid" d="M{LEFT} {at}H{WIDTH - RIGHT}"/>'
                     f'<text x="{LEFT - 5}" y="{at + 3}" text-anchor="end">{text}</text>')
    return ''.join(drawn)


def _curve(frame: _Frame, line: Line) -> str:
    places = frame.place(line.x, line.y)
    if line.dots:
        return ''.join(f'<circle cx="{x}" cy="{y}" r="4" fill="{line.colour}"/>'
                       for x, y in places)
    points = ' '.join(f'{x},{y}' for x, y in places)
    return f'<polyline stroke="{line.colour}" stroke-dasharray="{line.dash}" points="{points}"/>'


def _mark(frame: _Frame, plot: Plot) -> str:
    if not math.isfinite(plot.now):
        return ''
    now, point = frame.place_one(plot.now, plot.point)
    dot = '' if math.isnan(point) else f'<circle cy="{point}" r="5"/>'
    return (f'<g class="now" transform="translate({now} 0)">'
            f'<path d="M0 {TOP}V{HEIGHT - BOTTOM}"/>{dot}</g>')


def _range(parts: Sequence[Reals], margin: float) -> tuple[float, float]:
    values = np.concatenate(parts)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    least = max(FLAT * max(abs(low), abs(high)), 1e-12)
    add = margin * (high - low) + (least if high - low < least else 0.0)
    return low - add, high + add


def _ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return round numbers in a range, and how they are written."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step *= next((factor for factor in (1, 2, 5) if (high - low) / (factor * step) <= most), 10)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [(k * step, f'{k * step:.{digits}f}'.replace('-', '−') if digits < 7
             else f'{k * step:.7g}')
            for k in range(first, math.floor(high / step + 1e-9) + 1)]
