# SPDX-License-Identifier: Apache-2.0
"""The executable `inspect`: what is in a log, how right it is, and pictures of it."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spinning_top_sim.recording.damage import count

if TYPE_CHECKING:
    from spinning_top_sim.tools.survey import Motion, Survey
    from spinning_top_sim.tools.verify import Verdict

FINE = 0
FAULTY = 1
INTERRUPTED = 130
MOST_MOTIONS = 12           # shown to people one by one
SECOND = 1e9
TEXT_WIDTH = 118            # where there is no terminal to ask


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    arguments = _parser().parse_args(argv)
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        print('inspect: interrupted', file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:         # of a pager that was left
        sys.stderr.close()
        return FINE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='inspect', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Tell what is in a log: topics, gaps, the motions measured from the data\n'
                    'beside the exact ones, drifts, errors.  Reads torn and damaged logs too.',
        epilog='exit codes:\n'
               '  0  fine\n'
               '  1  the file cannot be read or is damaged, --verify found a difference or could\n'
               '     not compute the run, or a picture could not be drawn\n'
               '  2  wrong arguments\n'
               'The keys of --json are in docs/inspect.md.\n')
    parser.add_argument('log', type=Path, help='an MCAP file, of this package or any other')
    parser.add_argument('--plot', type=Path, metavar='FILE',
                        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib')
    parser.add_argument('--animate', type=Path, metavar='GIF',
                        help='draw the turning top; needs matplotlib')
    parser.add_argument('--verify', action='store_true',
                        help='compute the run again and compare every message byte for byte')
    parser.add_argument('--json', action='store_true', help='all of it for programs')
    return parser


def _run(arguments: argparse.Namespace) -> int:
    # Not before: --help needs none of it.
    from spinning_top_sim.recording.errors import LogError  # noqa: PLC0415
    from spinning_top_sim.recording.reader import LogReader  # noqa: PLC0415
    from spinning_top_sim.tools.survey import survey  # noqa: PLC0415

    verdict = None
    try:
        with LogReader(arguments.log) as reader:
            found = survey(reader)
            if arguments.verify and found.account is not None:
                verdict = _verify(reader, found, arguments.json)
    except LogError as error:
        print(f'inspect: {error}', file=sys.stderr)
        return FAULTY
    if arguments.json:
        print(json.dumps(as_json(arguments.log, found, verdict), indent=2, allow_nan=False))
    else:
        _show(report(arguments.log, found, verdict))
    faulty = not found.whole or bool(found.damage.defects)
    if arguments.verify:
        if verdict is None:
            print(f'inspect: --verify: {found.why_not}', file=sys.stderr)
        faulty = faulty or verdict is None or not verdict.identical
    drawn = _draw(arguments, found)
    return FAULTY if faulty or not drawn else FINE


def _verify(reader: Any, found: Survey, quiet: bool) -> Verdict:
    from spinning_top_sim.tools.simulate import progress  # noqa: PLC0415
    from spinning_top_sim.tools.verify import verify  # noqa: PLC0415

    assert found.account is not None
    begin_ns = found.begin_ns
    with progress((found.end_ns - begin_ns) / SECOND, quiet) as show:
        return verify(reader, found.account, found.end_ns,
                      lambda stamp_ns: show(stamp_ns - begin_ns))


def _draw(arguments: argparse.Namespace, found: Survey) -> bool:
    """Draw what is asked for; return whether that worked."""
    if arguments.plot is None and arguments.animate is None:
        return True
    if found.tilts is None:
        print('inspect: nothing to draw: no attitude of a top in this log', file=sys.stderr)
        return False
    try:
        from spinning_top_sim.tools import plots  # noqa: PLC0415
    except ImportError as error:
        print(f"inspect: pictures need matplotlib: pip install 'spinning_top_sim[plot]', or "
              f'apt install python3-matplotlib ({error})', file=sys.stderr)
        return False
    try:
        if arguments.plot is not None:
            plots.page(found, arguments.plot, arguments.log.name)
        if arguments.animate is not None:
            plots.animate(found, arguments.animate)
    except (OSError, ValueError) as error:
        print(f'inspect: {error}', file=sys.stderr)
        return False
    return True


# ------------------------------------------------------------------------------- for programs


def as_json(path: Path, found: Survey, verdict: Verdict | None) -> dict[str, Any]:
    """Return everything as what JSON can hold; see docs/inspect.md."""
    damage = found.damage
    content: dict[str, Any] = {
        'file': str(path),
        'whole': found.whole,
        'damage': {'torn': damage.truncated, 'lost_bytes': damage.lost_bytes,
                   'lost_chunks': damage.lost_chunks,
                   'missing_messages': damage.missing_messages,
                   'missing_exactly': damage.missing_exactly, 'report': damage.lines()},
        'begin_ns': found.begin_ns,
        'end_ns': found.end_ns,
        'duration': (found.end_ns - found.begin_ns) / SECOND,
        'topics': {name: {'type': topic.type_name, 'stream': topic.stream, 'count': topic.count,
                          'rate': topic.rate, 'grid_rate': topic.grid_rate,
                          'missing': topic.missing, 'off_grid': topic.off_grid,
                          'gaps_ns': topic.gaps, 'odd_size': topic.odd,
                          'longest_step_ns': topic.longest_step_ns}
                   for name, topic in found.topics.items()},
        'ours': found.account is not None,
        'why_not_ours': found.why_not or None,
        'notes': found.notes,
        'run': None, 'events': [], 'motions': [_motion_as_json(m) for m in found.motions],
        'drifts': {topic: {name: curve.largest for name, curve in curves.items()}
                   for topic, curves in found.drifts.items()},
        'orientation_error': {topic: {'max': curve.largest, 'rms': curve.rms}
                              for topic, curve in found.errors.items()},
        'verify': None,
    }
    account = found.account
    if account is not None:
        content['run'] = {
            'parameters': dict(account.values), 'seed': account.values['seed'],
            'epoch_ns': account.epoch_ns, 'begun_ns': account.begun_ns,
            'evaluation': account.evaluation, **account.surroundings}
        content['events'] = [{'event': event.name, 'stamp_ns': event.stamp_ns,
                              't_ns': event.t_ns, **event.details} for event in account.events]
    if verdict is not None:
        content['verify'] = {'identical': verdict.identical, **asdict(verdict)}
    return {key: _plain(value) for key, value in content.items()}


def _motion_as_json(motion: Motion) -> dict[str, Any]:
    return {'cause': motion.cause, 'begin_ns': motion.begin_ns, 'end_ns': motion.end_ns,
            'l3': motion.l3, 'lz': motion.lz, 'energy': motion.energy,
            'source': motion.source, 'regime': motion.regime,
            'exact': None if motion.described is None else asdict(motion.described),
            'measured': None if motion.measured is None else asdict(motion.measured)}


def _plain(value: Any) -> Any:
    """Return a value with null for numbers that JSON does not know."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# --------------------------------------------------------------------------------- for people


@dataclass(frozen=True)
class Table:
    """Lines of equal columns; the first column to the left, the others to the right."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def report(path: Path, found: Survey, verdict: Verdict | None) -> Iterator[str | Table]:
    """Yield what to tell people, lines and tables."""
    damage = found.damage
    state = ('whole' if found.whole and not damage.defects else
             'torn' if damage.truncated else 'damaged')
    yield f'{path}: {state}, {(found.end_ns - found.begin_ns) / SECOND:.6g} s'
    yield from damage.lines()
    account = found.account
    if account is None:
        yield f'not one of ours: {found.why_not}'
    else:
        values = account.values
        how = values['solver.method'] + (
            '' if values['solver.method'] == 'exact' else
            f" ({values['solver.equations']}, rtol {values['solver.rtol']:g})")
        yield (f'spinning_top_sim {account.surroundings["version"]}, {how}, seed '
               f'{values["seed"]}, evaluated {account.evaluation}')
    yield Table('topics', ('topic', 'type', 'messages', 'rate [Hz]', 'grid [Hz]', 'missing'), [
        (name, topic.type_name, str(topic.count), _number(topic.rate),
         _number(topic.grid_rate), '' if topic.missing is None else str(topic.missing))
        for name, topic in found.topics.items()])
    for name, topic in found.topics.items():
        yield from (f'gap: {name} from {_seconds(begin)} to {_seconds(end)}'
                    for begin, end in topic.gaps)
        if topic.off_grid:
            yield f'{name}: {topic.off_grid} stamps beside the grid'
        if topic.odd:
            yield f'{name}: {topic.odd} messages of another layout than ours'
    if account is None:
        return
    yield from _journal_lines(found)
    yield from found.notes
    for number, motion in enumerate(found.motions[:MOST_MOTIONS], start=1):
        yield from _motion_report(number, motion, found.begin_ns)
    if len(found.motions) > MOST_MOTIONS:
        yield f'and {len(found.motions) - MOST_MOTIONS} more motions (--json tells them all)'
    yield from _errors(found)
    if verdict is not None:
        yield from _verdict_lines(verdict)


def _journal_lines(found: Survey) -> Iterator[str]:
    account = found.account
    assert account is not None
    if account.events_topic is None:
        yield 'no journal: commands and resets cannot be told from the data'
        return
    counts = [(name, sum(event.name == name for event in account.events))
              for name in ('command', 'reset', 'parameters')]
    words = {'command': 'commands', 'reset': 'resets', 'parameters': 'changes of parameters'}
    yield 'journal: ' + ', '.join(f'{number} {words[name]}' for name, number in counts)
    yield from (f'journal, entry at {_seconds(stamp_ns)}: {reason}'
                for stamp_ns, reason in account.broken)


# Rows of the table of a motion: name, field of Description and Measured, factor, unit.
DEGREES = math.degrees(1.0)
ROWS = (('nutation period', 'nutation_period', 1.0, 's'),
        ('mean precession', 'mean_precession_rate', 1.0, 'rad/s'),
        ('mean spin', 'mean_spin_rate', 1.0, 'rad/s'),
        ('least tilt', 'theta_min', DEGREES, 'deg'),
        ('greatest tilt', 'theta_max', DEGREES, 'deg'),
        ('slowest precession seen', 'precession_min', 1.0, 'rad/s'),
        ('fastest precession seen', 'precession_max', 1.0, 'rad/s'))


def _motion_report(number: int, motion: Motion, begin_ns: int) -> Iterator[str | Table]:
    exact, measured = motion.described, motion.measured
    since = max(motion.begin_ns - begin_ns, 0) / SECOND
    until = max(motion.end_ns - begin_ns, 0) / SECOND
    name = exact.name if exact is not None else 'beyond the closed form'
    head = (f'motion {number} ({motion.cause}), {since:.6g} to {until:.6g} s: {name}')
    if motion.regime is not None and motion.regime != name:
        head += f' (the data look like: {motion.regime})'
    rows = []
    for text, key, factor, unit in ROWS:
        told = None if exact is None else getattr(exact, key)
        seen = None if measured is None else getattr(measured, key)
        rows.append((f'{text} [{unit}]', _number(told, factor, 12), _number(seen, factor, 12),
                     _off(told, seen)))
    if exact is not None:
        rows += [('1 - m', _number(exact.separatrix_distance), '', ''),
                 ('L3^2/(4 lambda1 |P|)', _number(exact.gyroscopic_ratio), '', '')]
    source = f'from {motion.source}' if motion.source else 'measured'
    yield Table(head, ('', 'exact', source, 'relative difference'), rows)
    if measured is None:
        yield ('not measured: too few samples' if motion.source else
               'not measured: no topic with an attitude (joint_states, pose, ground_truth/...)')
    else:
        if measured.nutations:
            yield count(measured.nutations, 'whole nutation')
        yield from (f'not measured: {reason}' for reason in measured.missing)


def _errors(found: Survey) -> Iterator[str | Table]:
    if found.drifts:
        yield Table('largest drifts since the start of each motion, relative',
                    ('from', 'E', 'L3', 'Lz'),
                    [(topic, *(f'{curve.largest:.2g}' for curve in curves.values()))
                     for topic, curves in found.drifts.items()])
    else:
        yield ('drifts of E, L3, Lz: no topic with rates (joint_states, ground_truth/odom, '
               'ground_truth/imu)')
    if found.errors:
        yield Table('orientation error against the exact solution [rad]',
                    ('from', 'max', 'rms'),
                    [(topic, f'{curve.largest:.3g}', f'{curve.rms:.3g}')
                     for topic, curve in found.errors.items()])
    else:
        yield 'orientation error: no topic with an attitude'


def _verdict_lines(verdict: Verdict) -> Iterator[str]:
    yield from (f'verify: {warning}: the last bits may differ for that'
                for warning in verdict.warnings)
    count = sum(verdict.compared.values())
    if verdict.stopped:
        yield f'verify: the run cannot be computed again: {verdict.stopped}'
    if verdict.identical:
        missing = f' ({verdict.missing} more are not in the file)' if verdict.missing else ''
        yield f'verify: identical, all {count} messages byte for byte{missing}'
        return
    yield (f'verify: DIFFERENT: {verdict.different} of {count} messages differ, '
           f'{verdict.missing} are missing, {verdict.unexpected} should not be there')
    first = verdict.first
    if first is not None:
        place = '' if first.byte is None else f', byte {first.byte}'
        yield (f'verify: first: {first.topic} at {_seconds(first.stamp_ns)}{place}, '
               f'{first.field}: in the log {first.logged}, computed {first.computed}')


def _number(value: float | None, factor: float = 1.0, digits: int = 6) -> str:
    return '' if value is None else f'{value * factor:.{digits}g}'


def _off(told: float | None, seen: float | None) -> str:
    if told is None or seen is None:
        return ''
    if told == 0.0 or abs(seen - told) > abs(told):
        return f'{seen - told:.1e} absolute' if seen != told else '0'
    return f'{(seen - told) / abs(told):.1e}'


def _seconds(stamp_ns: int) -> str:
    return f'{stamp_ns // 10 ** 9}.{stamp_ns % 10 ** 9:09d} s'


def _show(content: Iterator[str | Table]) -> None:
    """Print it, with rich where that is installed."""
    try:
        from rich import box  # noqa: PLC0415
        from rich.console import Console  # noqa: PLC0415
        from rich.table import Table as RichTable  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415
    except ImportError:
        for item in content:
            print(item if isinstance(item, str) else _plain_table(item))
        return
    console = Console(width=None if sys.stdout.isatty() else TEXT_WIDTH, highlight=False)
    for item in content:
        if isinstance(item, str):
            console.print(item, markup=False, soft_wrap=True)
            continue
        table = RichTable(title=Text(item.title), title_justify='left', box=box.SIMPLE_HEAD,
                          title_style='bold')
        for number, name in enumerate(item.head):
            table.add_column(Text(name), justify='left' if number == 0 else 'right',
                             overflow='fold')
        for row in item.rows:
            table.add_row(*map(Text, row))
        console.print(table)


def _plain_table(table: Table) -> str:
    lines = [table.head, *table.rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.head))]
    texts = [('  ' + '  '.join(cell.ljust(width) if i == 0 else cell.rjust(width)
                               for i, (cell, width) in enumerate(zip(line, widths, strict=True)))
              ).rstrip() for line in lines]
    return '\n'.join(['', table.title, *texts])


if __name__ == '__main__':
    sys.exit(main())
