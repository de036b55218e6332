# SPDX-License-Identifier: Apache-2.0
"""
Show what is in a log: topics, gaps, drifts, errors, and the motions as measured
from the data beside the exact ones. Reads damaged logs, too.

exit codes:
  0    no fault was found
  1    the file cannot be read or is damaged, --verify found a difference,
       could not compute the run or is for another version (logs of 1.x), or a
       picture could not be drawn
  2    wrong arguments
  130  interrupted
The keys of --json are in docs/logs.md.
"""

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed
from spinning_top_sim.physics.states import joined, relative_drift
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.times import NANOSECONDS, stamp_text
from spinning_top_sim.tools import cli, log_exports
from spinning_top_sim.tools.recorded_run import (
    ForeignLogError,
    RunDescription,
    read_run_description,
)
from spinning_top_sim.tools.survey import Survey
from spinning_top_sim.tools.verify import compare, objection

DEGREES = math.degrees(1.0)
FRAMES_PER_S, LONGEST_S, GIF_PIXELS = 20, 10.0, 640
# Rows of the table of a motion: text, field of Description and Measured, factor.
ROWS = (('nutation period [s]', 'nutation_period', 1.0),
        ('mean precession [rad/s]', 'mean_precession_rate', 1.0),
        ('mean spin [rad/s]', 'mean_spin_rate', 1.0),
        ('least tilt [deg]', 'theta_min', DEGREES),
        ('greatest tilt [deg]', 'theta_max', DEGREES),
        ('least precession [rad/s]', 'precession_min', 1.0),
        ('greatest precession [rad/s]', 'precession_max', 1.0),
        ('1 - m (separatrix: 0)', 'separatrix_distance', 1.0),
        ('L3^2/(4 lambda1 |P|) (sleeps: > 1)', 'gyroscopic_ratio', 1.0))
Content = Mapping[str, Any]     # as of --json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('log', type=Path, help='an MCAP file, of this package or any other, or a folder with one')
    add('--plot', type=Path, metavar='FILE',
        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib; an existing file is '
        'never overwritten')
    add('--animate', type=Path, metavar='GIF',
        help='draw the turning top; likewise')
    add('--verify', action='store_true',
        help='compute the run again and compare every message byte for byte')
    log_exports.add_argument(parser)
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    cli.check_output(arguments.plot, arguments.animate, *(path for _, path in arguments.export))
    with LogReader(arguments.log) as reader:
        run, foreign, verdict = None, '', None
        exported: list[str] = []
        try:
            run = read_run_description(reader)
        except ForeignLogError as error:
            foreign = str(error)
        found = Survey(reader, run)
        refused = foreign if run is None else objection(run)
        if run is not None:
            if arguments.verify and not refused:
                with cli.progress('verified', (found.end_ns - found.begin_ns) / NANOSECONDS, 's',
                                  quiet=arguments.json) as show:
                    verdict = compare(run, reader, found.end_ns, lambda stamp_ns: show(
                        (stamp_ns - found.begin_ns) / NANOSECONDS)).as_json()
            exported += log_exports.write(reader, run, arguments.export)
        content = {**_content(reader, found, run), 'ours': run is not None,
                   'why_not_ours': foreign or None, 'verify': verdict}
    if arguments.json:
        with cli.reader_may_end():
            # Numbers that JSON does not have become null.
            print(json.dumps(json.loads(json.dumps(content), parse_constant=lambda name: None),
                             indent=2))
    else:
        for line in _as_text(content):
            cli.print_line(line)
    for line in exported:
        cli.print_line(line, sys.stderr if arguments.json else None)
    for option, reason in (('verify', refused), ('export', foreign)):
        if reason and getattr(arguments, option):
            raise LogError(f'--{option}: {reason}')
    _draw(arguments, found)
    passed = reader.whole and (verdict is None or verdict['identical'])
    return cli.OK if passed else cli.FAILED


def _content(reader: LogReader, found: Survey, run: RunDescription | None) -> dict[str, Any]:
    """Return the findings for JSON; docs/logs.md has the keys."""
    begin_ns, end_ns = reader.span
    return {
        'file': str(reader.path), 'whole': reader.whole,
        'damage': {'torn': reader.torn, 'lost_bytes': reader.lost_bytes,
                   'report': reader.damage},
        'begin_ns': begin_ns, 'end_ns': end_ns, 'duration': (end_ns - begin_ns) / NANOSECONDS,
        'topics': {name: asdict(topic) for name, topic in found.topics.items()},
        'notes': found.notes,
        'run': run and {'parameters': run.values_at_start, 'seed': run.values_at_start['seed'],
                        'epoch_ns': run.epoch_ns, 'begun_ns': run.begun_ns, **run.environment},
        'events': [{'event': event.kind, 'stamp_ns': stamp_ns, 't_ns': event.t_ns,
                    **event.details} for stamp_ns, event in (run.events if run else ())],
        'motions': [{
            'cause': motion.cause, 'begin_ns': motion.begin_ns, 'end_ns': motion.end_ns,
            'source': motion.source, 'regime': motion.exact and motion.exact.name,
            **{name: getattr(motion.piece, name) for name in ('l3', 'lz', 'energy')},
            'exact': motion.exact and asdict(motion.exact),
            'measured': motion.measured and asdict(motion.measured)} for motion in found.motions],
        'drifts': found.drifts,
        'orientation_error': {topic: {'max': error} for topic, error in found.errors.items()}}


def _draw(arguments: argparse.Namespace, found: Survey) -> None:
    """Draw the pictures.  Raises LogError, or OSError or ValueError for the name of a file."""
    if arguments.plot is None and arguments.animate is None:
        return
    if not found.shown:
        raise LogError('nothing to draw: no attitude of a top in this log')
    with needed('a picture', 'plot'):
        from matplotlib.animation import PillowWriter  # noqa: PLC0415

        from spinning_top_sim import pictures  # noqa: PLC0415 - matplotlib is slow
    if arguments.plot is not None:
        # A motion is of one energy.
        drift = np.concatenate([relative_drift(one.energy, one.energy[:1]) for one in found.shown])
        figure = pictures.plot(joined(found.shown), drift, [one.t[0] for one in found.shown[1:]])
        figure.suptitle(f'{arguments.log.name}: {len(found.shown)} of {len(found.motions)} '
                        'motions')
        with new_file(arguments.plot) as file:
            figure.savefig(file.name, format=arguments.plot.suffix[1:] or 'png', dpi=120)
    if arguments.animate is not None:
        with new_file(arguments.animate) as file:
            pictures.animate(found.shown[0].until(LONGEST_S), FRAMES_PER_S).save(
                file.name, writer=PillowWriter(fps=FRAMES_PER_S), dpi=GIF_PIXELS / 4.0)  # 4 inches


def _as_text(content: Content) -> Iterator[str]:
    """Yield the findings as lines of text."""
    damage, run = content['damage'], content['run']
    state = ('truncated' if damage['torn'] else 'whole' if content['whole'] else 'damaged')
    yield f'{content["file"]}: {state}, {content["duration"]:.6g} s'
    yield from damage['report']
    if run is None:
        yield content['why_not_ours']
        yield from _topics(content['topics'])
        return
    values = run['parameters']
    solver = values['solver.method']
    if solver != 'exact':
        solver += f" ({values['solver.equations']}, rtol {values['solver.rtol']:g})"
    yield f'spinning_top_sim {run["version"]}, {solver}, seed {run["seed"]}'
    yield from _topics(content['topics'])
    counts = Counter(event['event'] for event in content['events'])
    yield (f'journal: {counts["command"]} commands, {counts["reset"]} resets, '
           f'{counts["parameters"]} changes of parameters')
    yield from content['notes']
    for number, motion in enumerate(content['motions'], start=1):
        yield from _motion(number, motion, content['begin_ns'])
    drifts, errors = content['drifts'], content['orientation_error']
    if drifts or errors:
        yield from cli.table_lines(
            'largest relative drifts in a motion, orientation error against the exact solution '
            '[rad]', ('from', 'E', 'L3', 'Lz', 'error'),
            [(topic, *(_number(drifts.get(topic, {}).get(name), 2)
                       for name in ('energy', 'l3', 'lz')),
              _number(errors.get(topic, {}).get('max'), 3))
             for topic in content['topics'] if topic in {**drifts, **errors}])
    if content['verify'] is not None:
        yield from _verdict(content['verify'])


def _topics(topics: Content) -> Iterator[str]:
    head = 'topic', 'type', 'messages', 'rate [Hz]', 'grid [Hz]', 'missing'
    yield from cli.table_lines('topics', head, [
        (name, topic['type'], str(topic['count']), _number(topic['rate']),
         _number(topic['grid_rate']), _number(topic['missing'], 15))
        for name, topic in topics.items()])
    for name, topic in topics.items():
        for begin, end in topic['gaps_ns']:
            yield f'gap: {name} from {stamp_text(begin)} s to {stamp_text(end)} s'


def _motion(number: int, motion: Content, begin_ns: int) -> Iterator[str]:
    exact, measured = motion['exact'] or {}, motion['measured'] or {}
    begin, end = (max(motion[at] - begin_ns, 0) / NANOSECONDS for at in ('begin_ns', 'end_ns'))
    name = motion['regime'] or 'no closed form'
    rows = []
    for text, key, factor in ROWS:
        expected, seen = (None if one.get(key) is None else one[key] * factor
                          for one in (exact, measured))
        rows.append((text, _number(expected, 12), _number(seen, 12), _number(
            None if expected is None or seen is None else seen - expected, 2)))
    yield from cli.table_lines(
        f'motion {number} ({motion["cause"]}), {begin:.6g} to {end:.6g} s: {name}',
        ('', 'exact', 'measured', 'difference'), rows)
    if measured:
        yield f'measured from {motion["source"]}: {measured["nutations"]} whole nutations'
        yield from (f'not measured: {reason}' for reason in measured['missing'])
    else:
        yield 'not measured: no topic with enough attitudes (joint_states, pose, ground_truth/...)'


def _verdict(verdict: Content) -> Iterator[str]:
    for warning in verdict['warnings']:
        yield f'verify: {warning}: the last bits may differ for that'
    compared = sum(verdict['compared'].values())
    if verdict['stopped']:
        yield f'verify: the run cannot be computed again: {verdict["stopped"]}'
    if verdict['identical']:
        yield f'verify: identical, all {compared} messages byte for byte'
    else:
        yield (f'verify: DIFFERENT: {verdict["different"]} of {compared} messages differ, '
               f'{verdict["missing"]} are missing, {verdict["unexpected"]} should not be there')
    if first := verdict['first']:
        place = '' if first['byte'] is None else f', byte {first["byte"]}'
        yield (f'verify: first: {first["topic"]} at {stamp_text(first["stamp_ns"])} s{place}, '
               f'{first["field"]}: in the log {first["logged"]}, computed {first["computed"]}')


def _number(value: float | None, digits: int = 6) -> str:
    return '' if value is None else f'{value:.{digits}g}'


main = partial(cli.run, 'inspect', __doc__, add_arguments, _run)
