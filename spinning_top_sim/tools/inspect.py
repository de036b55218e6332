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
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path

import numpy as np

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import joined, relative_drift
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.times import NANOSECONDS, stamp_text
from spinning_top_sim.tools import cli, log_exports
from spinning_top_sim.tools.recorded_run import ForeignLogError, read_run_description
from spinning_top_sim.tools.survey import Motion, Survey, Topic
from spinning_top_sim.tools.verify import Comparison, compare, objection

FRAMES_PER_S, LONGEST_S, GIF_PIXELS = 20, 10.0, 640
MOST_NUTATIONS, RESTS = 40, 9       # that a plot tells apart; digits of a tilt that rests
NUMBERS = [one.name for one in fields(Description) if one.name != 'name']


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
        run, foreign, exported = None, '', list[str]()
        try:
            run = read_run_description(reader)
        except ForeignLogError as error:
            foreign = str(error)
        for option, reason in (('verify', foreign or objection(run)), ('export', foreign)):
            if reason and getattr(arguments, option):
                raise LogError(f'--{option}: {reason}')
        if run is not None:
            log_exports.check(run, arguments.export)
        found = Survey(reader, run)
        if run is None:
            found.notes.append(foreign)
        else:
            if arguments.verify:
                found.verify = compare(run, reader, found.last_ns)
            exported += log_exports.write(reader, run, arguments.export)
    if arguments.json:
        with cli.reader_may_end():
            text = json.dumps(found, default=lambda one: {
                name: value for name, value in vars(one).items() if not name.startswith('_')})
            # Numbers that JSON does not have become null.
            print(json.dumps(json.loads(text, parse_constant=lambda name: None), indent=2))
    else:
        for line in _as_text(found):
            cli.print_line(line)
    for line in exported:
        cli.print_line(line, sys.stderr if arguments.json else None)
    _draw(arguments, found)
    passed = found.whole and (found.verify is None or found.verify.identical)
    return cli.OK if passed else cli.FAILED


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
        change = [relative_drift(one.energy, one.energy[:1]) for one in found.shown]
        begins, states = [one.t[0] for one in found.shown], joined(found.shown)
        rises = np.diff(states.theta_folded.round(RESTS)) > 0.0
        tops = states.t[1:-1][rises[:-1] & ~rises[1:]]
        end = tops[MOST_NUTATIONS] if len(tops) > MOST_NUTATIONS else states.t[-1]
        figure = pictures.plot(states, np.concatenate(change), begins[1:], end)
        title = (f'{arguments.log.name}: {sum(one <= end for one in begins)} of '
                 f'{len(found.motions)} motions')
        if end < states.t[-1]:
            title += f', up to {end:.4g} s of {states.t[-1]:.4g} s'
        missing = [one.measured.missing for one in found.motions if one.measured]
        figure.suptitle('\n'.join((title, *list(filter(None, missing))[:1])))
        with new_file(arguments.plot) as file:
            figure.savefig(file.name, format=arguments.plot.suffix[1:] or 'png', dpi=120)
    if arguments.animate is not None:
        with new_file(arguments.animate) as file:
            pictures.animate(found.shown[0], FRAMES_PER_S, LONGEST_S).save(
                file.name, writer=PillowWriter(fps=FRAMES_PER_S), dpi=GIF_PIXELS / 4.0)  # 4 inches


def _as_text(found: Survey) -> Iterator[str]:
    """Yield the findings as lines of text."""
    state = 'whole' if found.whole else 'truncated' if found.damage['torn'] else 'damaged'
    yield f'{found.file}: {state}, {(found.end_ns - found.begin_ns) / NANOSECONDS:.6g} s'
    yield from found.damage['report']
    if found.run is not None:
        values, counts = found.run.values_at_start, Counter(
            event.kind for _, event in found.run.events)
        yield (f'spinning_top_sim {found.run.environment["version"]}, '
               f'{values["solver.method"]}, seed {values["seed"]}')
        yield (f'journal: {counts["command"]} commands, {counts["reset"]} resets, '
               f'{counts["parameters"]} changes of parameters')
    yield from found.notes
    yield from _topics(found.topics)
    for number, motion in enumerate(found.motions, start=1):
        yield from _motion(number, motion, found.begin_ns)
    if found.verify is not None:
        yield from _verdict(found.verify)


def _topics(topics: dict[str, Topic]) -> Iterator[str]:
    rows = []
    for name, topic in topics.items():
        begin, end = topic.longest_gap_ns or (0, 0)
        gap = (f'{(end - begin) / NANOSECONDS:.9g}', stamp_text(begin)) if end else ('', '')
        rows.append((name, topic.type, str(topic.count), _number(topic.rate), *gap))
    yield from cli.table_lines('topics', (
        'topic', 'type', 'messages', 'rate [Hz]', 'longest gap [s]', 'from [s]'), rows)


def _motion(number: int, motion: Motion, begin_ns: int) -> Iterator[str]:
    begin, end = (max(at_ns - begin_ns, 0) / NANOSECONDS
                  for at_ns in (motion.begin_ns, motion.end_ns))
    rows = [(name, _number(exact, 12), _number(seen, 12), _number(
        None if exact is None or seen is None else seen - exact, 2)) for name, exact, seen in (
            (name, getattr(motion.exact, name, None), getattr(motion.measured, name, None))
            for name in NUMBERS)]
    rows += [(f'drift of {name}', '', '', _number(drift, 2))
             for name, drift in motion.drifts.items()]
    rows.append(('orientation_error', '', '', _number(motion.orientation_error, 2)))
    yield from cli.table_lines(
        f'motion {number} ({motion.cause}), {begin:.6g} to {end:.6g} s: '
        f'{motion.exact.name if motion.exact else "no closed form"}',
        ('[s, rad, rad/s]', 'exact', 'measured', 'difference'),
        [row for row in rows if any(row[1:])])
    if motion.measured is None:
        yield 'not measured: no topic with enough attitudes (joint_states, pose, ground_truth/...)'
    else:
        yield f'measured from {motion.source}: {motion.measured.nutations} whole nutations'
        if motion.measured.missing:
            yield f'not measured: {motion.measured.missing}'


def _verdict(verdict: Comparison) -> Iterator[str]:
    for warning in verdict.warnings:
        yield f'verify: {warning}: the last bits may differ for that'
    compared = sum(verdict.compared.values())
    if verdict.stopped:
        yield f'verify: the run cannot be computed again: {verdict.stopped}'
    if verdict.identical:
        yield f'verify: identical, all {compared} messages byte for byte'
    else:
        yield (f'verify: DIFFERENT: {verdict.different} of {compared} messages differ, '
               f'{verdict.missing} are missing, {verdict.unexpected} should not be there')
    if verdict.first:
        yield f'verify: first: {verdict.first}'


def _number(value: float | None, digits: int = 6) -> str:
    return '' if value is None else f'{value:.{digits}g}'


main = partial(cli.run, 'inspect', __doc__, add_arguments, _run)
