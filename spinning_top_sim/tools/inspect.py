# SPDX-License-Identifier: Apache-2.0
"""
Show what is in a log: topics, gaps, drifts, errors, and the motions as measured
from the data beside the exact ones. Reads damaged logs, too.

exit codes:
  0    no fault was found
  1    the file is damaged or cannot be read, --verify found a difference or
       cannot compute the run (logs of 1.x), or a picture cannot be drawn
  2    wrong arguments
  130  interrupted
The keys of --json are in docs/logs.md.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import joined, relative_drift
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.times import NANOSECONDS, Times, stamp_text
from spinning_top_sim.tools import cli, recorded_run
from spinning_top_sim.tools.recorded_run import RunDescription, channels_of
from spinning_top_sim.tools.survey import Motion, Survey

Reals = NDArray[np.float64]
PLOTTED_S, ANIMATED_S = 20.0, 10.0      # that a picture shows at most
# Topics whose numbers are exported.  TUM (vision.in.tum.de, RGB-D dataset, file formats)
# has "timestamp tx ty tz qx qy qz qw", in s and m; EuRoC (M. Burri et al., IJRR 35, 2016)
# state_groundtruth_estimate0/data.csv and imu0/data.csv.
IMU, BIAS, BODY = 'ground_truth/imu_odom', 'ground_truth/imu_bias', 'ground_truth/odom'
KINDS = {'tum': (IMU,), 'euroc': (IMU, BIAS), 'euroc_imu': ('imu/data_raw',)}
HEADS = {'tum': '', **{kind: f'#timestamp [ns],{columns}\n' for kind, columns in (
    ('euroc', 'p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],'
     'v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],'
     'b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],'
     'b_a_RS_S_z [m s^-2]'),
    ('euroc_imu', 'w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],'
     'a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]'))}}


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
    add('--export', type=_kind_and_file, metavar='KIND:FILE', action='append', default=[],
        help='write a file for other tools: tum or euroc, the true trajectory of the IMU (tum: of '
        f'the body where the log has no {IMU}); euroc_imu, its readings (CSV); may be repeated; '
        'an existing file is never overwritten')
    add('--json', action='store_true', help='print everything as JSON')


def _kind_and_file(text: str) -> tuple[str, Path]:
    kind, colon, name = text.partition(':')
    if kind not in KINDS or not name:
        raise argparse.ArgumentTypeError(
            f'{text}: must be KIND:FILE with one of {", ".join(KINDS)}, such as tum:truth.tum')
    return kind, Path(name)


def _run(arguments: argparse.Namespace) -> int:
    cli.check_output(arguments.plot, arguments.animate, *(path for _, path in arguments.export))
    with LogReader(arguments.log) as reader:
        run, notes = None, list[str]()
        try:
            run = recorded_run.read_run_description(reader)
            for kind, _ in arguments.export:
                _topics(run, kind)
        except recorded_run.ForeignLogError as error:
            if arguments.verify or arguments.export:
                raise
            notes.append(str(error))
        found = Survey(reader, run, notes)
        if run is not None:
            found.verify = recorded_run.compare(run, reader) if arguments.verify else None
            _export(reader, run, arguments.export)
    if arguments.json:
        with cli.reader_may_end():
            # Numbers that JSON does not have become null.
            print(json.dumps(json.loads(json.dumps(found, default=_public),
                                        parse_constant=lambda name: None), indent=2))
    else:
        for line in _as_text(found):
            cli.print_line(line)
    if arguments.plot or arguments.animate:
        _draw(arguments, found)
    passed = found.whole and (found.verify is None or found.verify.identical)
    return cli.OK if passed else cli.FAILED


def _public(one: object) -> dict[str, Any]:
    return {name: value for name, value in vars(one).items()
            if name != 'states' and not name.startswith('_')}


def _topics(run: RunDescription, kind: str) -> Sequence[str]:
    """Return the topics of an export.  Raises ValueError if the log lacks one."""
    if kind == 'tum' and IMU not in run.topics and BODY in run.topics:
        return (BODY,)
    for topic in KINDS[kind]:
        if topic not in run.topics:
            raise ValueError(f'--export {kind}: the log has no {topic}')
    return KINDS[kind]


def _rows(reader: LogReader, run: RunDescription, topic: str) -> tuple[Times, list[Reals]]:
    """Return stamps (n,) [ns] and fields of the messages of a stream."""
    template = next(channel.template for channel in channels_of(run.values_in_effect)
                    if channel.topic == topic)
    data = b''.join(one.data for one in reader.messages([run.topics[topic]])
                    if len(one.data) == len(template))
    return template.stamps_ns(data), list(template.decode(data))


def _export(reader: LogReader, run: RunDescription, exports: Sequence[tuple[str, Path]]) -> None:
    """Write the files, and say of what they are.  Raises OSError or ValueError."""
    for kind, path in exports:
        topic, *others = _topics(run, kind)
        stamps_ns, columns = _rows(reader, run, topic)
        if others:              # with the bias of the last reading before a sample
            bias_ns, biases = _rows(reader, run, BIAS)
            if not len(bias_ns):
                raise ValueError(f'--export {kind}: the log has no sample of {BIAS}')
            newest = np.maximum(np.searchsorted(bias_ns, stamps_ns, 'right') - 1, 0)
            place, (x, y, z, w), velocity = columns[0], columns[1].T, columns[2].T
            world = attitude.rotated((x, y, z, w), tuple(velocity))
            columns = [place, np.stack([w, x, y, z], axis=1), np.stack(world, axis=1),
                       *(bias[newest] for bias in biases)]
        separator, text = (' ', stamp_text) if kind == 'tum' else (',', str)
        with new_file(path) as file:
            file.write(HEADS[kind])
            # Place and attitude, or rates and accelerations, are the first two fields.
            rows = np.hstack(columns if others else columns[:2]).tolist()
            for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True):
                file.write(separator.join([text(stamp_ns), *map(repr, row)]) + '\n')
        cli.print_line(f'{path}: {kind}, from {topic}', sys.stderr)


def _draw(arguments: argparse.Namespace, found: Survey) -> None:
    """Draw the pictures.  Raises LogError, or OSError or ValueError for the name of a file."""
    shown = [one.states for one in found.motions if one.states]
    if not shown:
        raise LogError('nothing to draw: no attitude of a top in this log')
    with needed('a picture', 'plot'):
        from spinning_top_sim import pictures  # noqa: PLC0415 - matplotlib is slow
    if arguments.plot is not None:
        states, begins = joined(shown), [one.t[0] for one in shown]
        # A motion is of one energy.
        change = [relative_drift(one.energy, one.energy[:1]) for one in shown]
        end = min(begins[0] + PLOTTED_S, states.t[-1])
        figure = pictures.plot(states, np.concatenate(change), begins[1:], end)
        figure.suptitle(f'{arguments.log.name}: {sum(one <= end for one in begins)} of '
                        f'{len(found.motions)} motions, up to {end:.4g} s of {states.t[-1]:.4g} s')
        with new_file(arguments.plot) as file:
            figure.savefig(file.name, format=arguments.plot.suffix[1:] or 'png', dpi=120)
    if arguments.animate is not None:
        with new_file(arguments.animate) as file:
            pictures.animate(shown[0], seconds=ANIMATED_S).save(
                file.name, writer='pillow', dpi=160)


def _as_text(found: Survey) -> Iterator[str]:
    """Yield the findings as lines of text."""
    yield (f'{found.file}: {"whole" if found.whole else "damaged"}, '
           f'{(found.end_ns - found.begin_ns) / NANOSECONDS:.6g} s')
    yield from found.damage['report']
    if found.run is not None:
        values = found.run.values_at_start
        yield (f'spinning_top_sim {found.run.environment["version"]}, '
               f'{values["solver.method"]}, seed {values["seed"]}')
    yield from found.notes
    rows = []
    for name, topic in found.topics.items():
        begin, end = topic['longest_gap_ns'] or (0, 0)
        gap = (_number((end - begin) / NANOSECONDS, 9), stamp_text(begin)) if end else ('', '')
        rows.append((name, topic['type'], str(topic['count']), _number(topic['rate']), *gap))
    yield from cli.table_lines('topics', (
        'topic', 'type', 'messages', 'rate [Hz]', 'longest gap [s]', 'from [s]'), rows)
    for number, motion in enumerate(found.motions, start=1):
        yield from _motion(number, motion, found.begin_ns)
    if found.verify is not None:
        yield from _verdict(found.verify)


def _motion(number: int, motion: Motion, log_ns: int) -> Iterator[str]:
    begin, end = (max(at_ns - log_ns, 0) / NANOSECONDS
                  for at_ns in (motion.begin_ns, motion.end_ns))
    exact, measured = vars(motion.exact) if motion.exact else {}, motion.measured or {}
    rows = []
    for name in dict.fromkeys((*exact, *measured)):
        truth, seen = exact.get(name), measured.get(name)
        apart = seen - truth if isinstance(truth, float) and isinstance(seen, float) else None
        rows.append((name, _number(truth, 12), _number(seen, 12), _number(apart, 2)))
    rows += [(f'drift of {name}', '', '', _number(drift, 2))
             for name, drift in motion.drifts.items()]
    rows.append(('orientation_error', '', '', _number(motion.orientation_error, 2)))
    yield from cli.table_lines(
        f'motion {number} ({motion.cause}), {begin:.6g} to {end:.6g} s: '
        f'{exact.get("name", "no closed form")}',
        ('[s, rad, rad/s]', 'exact', 'measured', 'difference'),
        [row for row in rows if any(row[1:])])
    yield (f'measured from {motion.source}: {measured["nutations"]} whole nutations' if measured
           else 'not measured: fewer than two attitudes, or gaps between them')
    if measured.get('missing'):
        yield f'not measured: {measured["missing"]}'


def _number(value: object, digits: int = 6) -> str:
    return f'{value:.{digits}g}' if isinstance(value, float) else ''


def _verdict(verdict: recorded_run.Comparison) -> Iterator[str]:
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


main = partial(cli.run, 'inspect', __doc__, add_arguments, _run)
