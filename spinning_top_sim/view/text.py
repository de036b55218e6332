# SPDX-License-Identifier: Apache-2.0
"""The words of the page as HTML: what one sees, in numbers, the legend, and the whole file."""

import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

import numpy as np

from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.physics.top import Top
from spinning_top_sim.times import NANOSECONDS, stamp_text
from spinning_top_sim.view.track import DescribedMotion, Track

HERE = Path(__file__).parent
STYLE, LIVE_STYLE = ((HERE / name).read_text('utf-8') for name in ('page.css', 'live.css'))
BEYOND = 'No closed form is in reach of its numbers; the samples are shown as they are.'
PIVOT_MOVES = 'The pivot moves: where it accelerates, the top moves about another vertical.'
NEUTRAL = ('The body is not in this log, only its attitude: a grey disc shows it, with its axes '
           'x (red), y (green) and z (blue).')
VERTICAL = 1e-6                 # tilt from a vertical up to which there is no precession [rad]
# What one sees of each motion, by its name.
SENTENCES = {
    'at rest': 'Nothing turns: the axis stays where it is.',
    'cusps': 'Released without a push: the axis falls, is turned aside, and rises to stand still '
             'for an instant.',
    'free top': 'No torque acts: the axis goes round a fixed direction, that of the angular '
                'momentum.',
    'hanging': 'The axis hangs straight down, and the body only spins.',
    'loops': 'Pushed backwards at the start: where the axis is highest it moves backwards, and '
             'draws loops.',
    'planar pendulum, rotating': 'Without spin: the axis goes over the top in one vertical plane.',
    'planar pendulum, swinging': 'Without spin: the axis swings in one vertical plane.',
    'sleeping': 'The axis stands upright and the spin is fast enough to hold it there.',
    'sleeping, unstable': 'The axis stands upright, but the spin is too slow: a touch makes it '
                          'fall.',
    'spherical pendulum': 'Without spin: the axis swings round the vertical like a weight on a '
                          'string.',
    'steady precession': 'The axis goes round the vertical at one tilt and one speed.',
    'through the bottom': 'The axis passes through the straight-down position in each nutation.',
    'through the top': 'The axis passes through the upright position in each nutation.',
    'waves': 'The axis nods up and down while it always goes round the same way.',
}


def number(value: float) -> str:
    """Return a number with four digits at most."""
    shown = 0.0 if abs(value) < 1e-9 else float(f'{value:.3g}' if abs(value) < 1e3
                                                else f'{value:.4g}')
    return f'{shown:g}'.replace('-', '−')


def words(track: Track, motion: DescribedMotion | None, stamp_ns: int, since_ns: int) -> str:
    """Return headline, sentence and numbers of a top, and stamp and time of what is drawn."""
    description = motion.description if motion else None
    title, sentence = ((description.name, SENTENCES[description.name]) if description else
                       ('motion', PIVOT_MOVES if motion.pivot_moves else BEYOND) if motion else
                       ('attitude', '' if track.has_body else NEUTRAL))
    rows = [*_rows(track.top, motion)] if motion else []
    place = track.places(np.array([stamp_ns]))[0]
    if place.any():
        rows.append(('Pivot', ', '.join(map(number, place)), 'x, y, z [m]'))
    return ''.join((
        '<div class="top-words">', f'<p>{html.escape(track.name)}</p>' if track.name else '',
        f'<h1>{title}</h1>', f'<p>{sentence}</p>' if sentence else '', '<table>',
        *(f'<tr><td>{label}</td><td>{value}{f"<small>{note}</small>" if note else ""}</td></tr>'
          for label, value, note in rows),
        f'</table><p class="stamp">t = {since_ns / NANOSECONDS:.3f} s, stamp '
        f'{stamp_text(stamp_ns)}</p></div>'))


def _rows(top: Top, motion: DescribedMotion) -> Iterable[tuple[str, str, str]]:
    description = motion.description
    if description is not None:
        low = number(math.degrees(description.theta_min))
        high = number(math.degrees(description.theta_max))
        period = number(description.nutation_period) if description.nutation_period else ''
        yield 'Tilt θ', f'{low}° to {high}°' if period else f'{low}°', (
            f'nutation period {period} s' if period else '')
        if description.theta_max > VERTICAL and description.theta_min < math.pi - VERTICAL:
            slow, fast = number(description.precession_min), number(description.precession_max)
            yield 'Precession φ′', f'{number(description.mean_precession_rate)} rad/s', (
                f'mean; from {slow} to {fast}' if period else '')
            spin = number(description.mean_spin_rate)
            yield 'Spin ψ′', f'{spin} rad/s', 'mean' if period else ''
    yield 'Angular mo&shy;mentum', f'L₃ = {number(motion.l3)}' + (
        '' if motion.pivot_moves else f', L<sub>z</sub> = {number(motion.lz)}'), (
        'kg m²/s; axis' + ('' if motion.pivot_moves else ', vertical'))
    if least := 2.0 * natural_momentum(top):
        yield 'Stable upright', f'if |L₃| &gt; {number(least)} kg m²/s', ''


def legend(entries: Sequence[tuple[tuple[int, int, int], str]]) -> str:
    """Return what the colours in the scene mean."""
    return '<div class="top-legend">' + ''.join(
        f'<div><i style="background:rgb{colour}"></i>{text}</div>'
        for colour, text in entries) + '</div>'


def document(title: str, scene: str, legend_html: str, words_html: str,
             plots_html: Sequence[str]) -> str:
    """Return a page that works without a server; `scene` is a page for its own frame."""
    template = Template((HERE / 'file.html').read_text('utf-8'))
    return template.substitute(
        title=html.escape(title), style=STYLE, legend=legend_html, words=words_html,
        plots=''.join(plots_html), scene=scene.replace('&', '&amp;').replace('"', '&quot;'))
