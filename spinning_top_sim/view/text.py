# SPDX-License-Identifier: Apache-2.0
"""The words of the page as HTML: what one sees, in numbers."""

import html
import math
from collections.abc import Iterable, Mapping

from spinning_top_sim.installation import read_table
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.physics.top import Top
from spinning_top_sim.times import NANOSECONDS, stamp_text
from spinning_top_sim.view.source import Motion, Track

NO_SAMPLES = 'no samples yet'
BEYOND = 'No closed form is in reach of its numbers; the samples are shown as they are.'
PIVOT_MOVES = 'The pivot moves: where it accelerates, the top moves about another vertical.'
VERTICAL = 1e-6                 # tilt from a vertical up to which there is no precession [rad]
SENTENCES: Mapping[str, str] = read_table('view/motions.toml')      # by name of the motion


def number(value: float) -> str:
    """Return a number with four digits at most."""
    shown = 0.0 if abs(value) < 1e-9 else float(f'{value:.3g}' if abs(value) < 1e3
                                                else f'{value:.4g}')
    return f'{shown:g}'.replace('-', '−')


def words(track: Track, t_ns: int) -> str:
    """Return headline, sentences and numbers of a top at a time; and those of its sample."""
    sample_ns = track.newest(t_ns)
    if sample_ns is None:
        return f'<p>{NO_SAMPLES}</p>'
    motion = track.motion_at(t_ns)
    description = motion.description if motion else None
    title, sentence = ((description.name, SENTENCES[description.name]) if description else
                       ('motion', PIVOT_MOVES if motion.pivot_moves else BEYOND) if motion else
                       ('attitude', ''))
    return ''.join((
        f'<div class="top-words" data-from="{t_ns / NANOSECONDS}">',
        f'<h1>{title}</h1>',
        *(f'<p>{html.escape(line)}</p>' for line in (sentence, track.about) if line),
        '<table>',
        *(f'<tr><td>{label}</td><td>{value}{f"<small>{note}</small>" if note else ""}</td></tr>'
          for label, value, note in (_rows(track.top, motion) if motion else ())),
        f'</table><p class="stamp" data-epoch="{track.epoch_ns}">t = '
        f'{sample_ns / NANOSECONDS:.3f} s, stamp {stamp_text(track.epoch_ns + sample_ns)}</p>',
        '</div>'))


def _rows(top: Top, motion: Motion) -> Iterable[tuple[str, str, str]]:
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
