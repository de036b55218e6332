# SPDX-License-Identifier: Apache-2.0
"""The findings about a log: as JSON, and as human-readable lines and tables."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from spinning_top_sim.recording.damage import count, seconds
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools.cli import Table
from spinning_top_sim.tools.survey import MotionReport, Survey
from spinning_top_sim.tools.verify import Verdict

MOST_MOTIONS = 12           # shown one by one in the text
DEGREES = math.degrees(1.0)
# Rows of the table of a motion: what it is, field of Description and Measured, factor, unit.
ROWS = (('nutation period', 'nutation_period', 1.0, 's'),
        ('mean precession', 'mean_precession_rate', 1.0, 'rad/s'),
        ('mean spin', 'mean_spin_rate', 1.0, 'rad/s'),
        ('least tilt', 'theta_min', DEGREES, 'deg'),
        ('greatest tilt', 'theta_max', DEGREES, 'deg'),
        ('slowest precession seen', 'precession_min', 1.0, 'rad/s'),
        ('fastest precession seen', 'precession_max', 1.0, 'rad/s'))


def as_json(path: Path, found: Survey, verdict: Verdict | None) -> dict[str, object]:
    """
    Return all findings as what JSON can hold.

    Parameters
    ----------
    path : Path
        Name of the log.
    found : Survey
        What is in it.
    verdict : Verdict or None
        Result of `verify`, if it was called.

    Returns
    -------
    dict
        See docs/inspect.md for its keys.
    """
    damage = found.damage
    content: dict[str, object] = {
        'file': str(path),
        'whole': found.whole,
        'damage': {'torn': damage.truncated, 'lost_bytes': damage.lost_bytes,
                   'lost_chunks': damage.lost_chunks,
                   'missing_messages': damage.missing_messages,
                   'missing_exactly': damage.missing_exactly, 'report': damage.lines()},
        'begin_ns': found.begin_ns,
        'end_ns': found.end_ns,
        'duration': (found.end_ns - found.begin_ns) / NANOSECONDS,
        'topics': {name: {'type': topic.type_name, 'stream': topic.stream, 'count': topic.count,
                          'rate': topic.rate, 'grid_rate': topic.grid_rate,
                          'missing': topic.missing, 'off_grid': topic.off_grid,
                          'gaps_ns': topic.gaps, 'odd_size': topic.odd_size,
                          'longest_step_ns': topic.longest_step_ns}
                   for name, topic in found.topics.items()},
        'ours': found.run is not None,
        'why_not_ours': found.foreign_reason or None,
        'notes': found.notes,
        'run': None, 'events': [], 'motions': [_motion_as_json(m) for m in found.motions],
        'drifts': {topic: {name: series.largest for name, series in drifts.items()}
                   for topic, drifts in found.drifts.items()},
        'orientation_error': {topic: {'max': series.largest, 'rms': series.rms}
                              for topic, series in found.errors.items()},
        'verify': None,
    }
    run = found.run
    if run is not None:
        content['run'] = {
            'parameters': dict(run.values), 'seed': run.values['seed'],
            'epoch_ns': run.epoch_ns, 'begun_ns': run.begun_ns,
            **run.surroundings}
        content['events'] = [{'event': event.name, 'stamp_ns': event.stamp_ns,
                              't_ns': event.t_ns, **event.details} for event in run.events]
    if verdict is not None:
        content['verify'] = {'identical': verdict.identical, **asdict(verdict)}
    return {key: _json_value(value) for key, value in content.items()}


def _motion_as_json(motion: MotionReport) -> dict[str, object]:
    return {'cause': motion.cause, 'begin_ns': motion.begin_ns, 'end_ns': motion.end_ns,
            'l3': motion.l3, 'lz': motion.lz, 'energy': motion.energy,
            'source': motion.source, 'regime': motion.regime,
            'exact': None if motion.described is None else asdict(motion.described),
            'measured': None if motion.measured is None else asdict(motion.measured)}


def _json_value(value: object) -> object:
    """Return a value with null for the numbers that JSON does not have."""
    if isinstance(value, dict):
        return {str(key): _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def as_text(path: Path, found: Survey, verdict: Verdict | None) -> Iterator[str | Table]:
    """
    Yield the findings as lines and tables.

    Parameters
    ----------
    path : Path
        Name of the log.
    found : Survey
        What is in it.
    verdict : Verdict or None
        Result of `verify`, if it was called.
    """
    damage = found.damage
    state = ('whole' if found.whole and not damage.defects else
             'torn' if damage.truncated else 'damaged')
    yield f'{path}: {state}, {(found.end_ns - found.begin_ns) / NANOSECONDS:.6g} s'
    yield from damage.lines()
    run = found.run
    if run is None:
        yield f'not recorded by spinning_top_sim: {found.foreign_reason}'
    else:
        values = run.values
        solver = values['solver.method'] + (
            '' if values['solver.method'] == 'exact' else
            f" ({values['solver.equations']}, rtol {values['solver.rtol']:g})")
        yield (f'spinning_top_sim {run.surroundings["version"]}, {solver}, seed '
               f'{values["seed"]}')
    yield from _topics(found)
    if run is None:
        return
    yield from _journal(found)
    yield from found.notes
    for number, motion in enumerate(found.motions[:MOST_MOTIONS], start=1):
        yield from _motion(number, motion, found.begin_ns)
    if len(found.motions) > MOST_MOTIONS:
        yield f'and {len(found.motions) - MOST_MOTIONS} more motions (all are in --json)'
    yield from _accuracy(found)
    if verdict is not None:
        yield from _verdict(verdict)


def _topics(found: Survey) -> Iterator[str | Table]:
    yield Table('topics', ('topic', 'type', 'messages', 'rate [Hz]', 'grid [Hz]', 'missing'), [
        (name, topic.type_name, str(topic.count), _number(topic.rate),
         _number(topic.grid_rate), '' if topic.missing is None else str(topic.missing))
        for name, topic in found.topics.items()])
    for name, topic in found.topics.items():
        for begin, end in topic.gaps:
            yield f'gap: {name} from {seconds(begin)} to {seconds(end)}'
        if topic.off_grid:
            yield f'{name}: {topic.off_grid} stamps are not on the grid'
        if topic.odd_size:
            yield f'{name}: {topic.odd_size} messages do not have the size of this stream'


def _journal(found: Survey) -> Iterator[str]:
    run = found.run
    assert run is not None
    if run.events_topic is None:
        yield 'no journal: commands and resets are unknown'
        return
    nouns = {'command': 'commands', 'reset': 'resets', 'parameters': 'changes of parameters'}
    yield 'journal: ' + ', '.join(
        f'{sum(event.name == name for event in run.events)} {noun}'
        for name, noun in nouns.items())
    for stamp_ns, reason in run.broken:
        yield f'journal, entry at {seconds(stamp_ns)}: {reason}'


def _motion(number: int, motion: MotionReport, begin_ns: int) -> Iterator[str | Table]:
    exact, measured = motion.described, motion.measured
    begin, end = (max(at_ns - begin_ns, 0) / NANOSECONDS
                  for at_ns in (motion.begin_ns, motion.end_ns))
    name = exact.name if exact is not None else 'beyond the closed form'
    title = f'motion {number} ({motion.cause}), {begin:.6g} to {end:.6g} s: {name}'
    if motion.regime is not None and motion.regime != name:
        title += f' (the data look like: {motion.regime})'
    rows = []
    for text, key, factor, unit in ROWS:
        expected, seen = getattr(exact, key, None), getattr(measured, key, None)
        rows.append((f'{text} [{unit}]', _number(expected, factor, 12),
                     _number(seen, factor, 12), _difference(expected, seen)))
    if exact is not None:
        rows += [('1 - m', _number(exact.separatrix_distance), '', ''),
                 ('L3^2/(4 lambda1 |P|)', _number(exact.gyroscopic_ratio), '', '')]
    source = f'from {motion.source}' if motion.source else 'measured'
    yield Table(title, ('', 'exact', source, 'relative difference'), rows)
    if measured is None:
        yield ('not measured: too few samples' if motion.source else
               'not measured: no topic with an attitude (joint_states, pose, ground_truth/...)')
        return
    if measured.nutations:
        yield count(measured.nutations, 'whole nutation')
    for reason in measured.missing:
        yield f'not measured: {reason}'


def _accuracy(found: Survey) -> Iterator[str | Table]:
    if found.drifts:
        yield Table('largest drifts since the start of each motion, relative',
                    ('from', 'E', 'L3', 'Lz'),
                    [(topic, *(f'{series.largest:.2g}' for series in drifts.values()))
                     for topic, drifts in found.drifts.items()])
    else:
        yield ('drifts of E, L3, Lz: no topic with rates (joint_states, ground_truth/odom, '
               'ground_truth/imu)')
    if found.errors:
        yield Table('orientation error against the exact solution [rad]',
                    ('from', 'max', 'rms'),
                    [(topic, f'{series.largest:.3g}', f'{series.rms:.3g}')
                     for topic, series in found.errors.items()])
    else:
        yield 'orientation error: no topic with an attitude'


def _verdict(verdict: Verdict) -> Iterator[str]:
    for warning in verdict.warnings:
        yield f'verify: {warning}: the last bits may differ for that'
    compared = sum(verdict.compared.values())
    if verdict.stopped:
        yield f'verify: the run cannot be computed again: {verdict.stopped}'
    if verdict.identical:
        missing = f' ({verdict.missing} more are not in the file)' if verdict.missing else ''
        yield f'verify: identical, all {compared} messages byte for byte{missing}'
        return
    yield (f'verify: DIFFERENT: {verdict.different} of {compared} messages differ, '
           f'{verdict.missing} are missing, {verdict.unexpected} should not be there')
    first = verdict.first
    if first is not None:
        place = '' if first.byte is None else f', byte {first.byte}'
        yield (f'verify: first: {first.topic} at {seconds(first.stamp_ns)}{place}, '
               f'{first.field}: in the log {first.logged}, computed {first.computed}')


def _number(value: float | None, factor: float = 1.0, digits: int = 6) -> str:
    return '' if value is None else f'{value * factor:.{digits}g}'


def _difference(expected: float | None, seen: float | None) -> str:
    if expected is None or seen is None:
        return ''
    if expected == 0.0 or abs(seen - expected) > abs(expected):
        return f'{seen - expected:.1e} absolute' if seen != expected else '0'
    return f'{(seen - expected) / abs(expected):.1e}'
