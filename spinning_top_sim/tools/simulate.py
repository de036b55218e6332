# SPDX-License-Identifier: Apache-2.0
"""
Simulate the heavy symmetric top offline, as the node does, into a log (MCAP)
or a table of the true states (CSV, Parquet).

exit codes:
  0    done
  1    a file cannot be read or written, or the run ends early
  2    wrong arguments or parameters; no file is made
  130  interrupted; the log holds what was computed before
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path

from spinning_top_sim.recording.provenance import environment, run_metadata
from spinning_top_sim.recording.recorder import single
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import McapWriter
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.events import Event
from spinning_top_sim.streams.messages import Field, Template
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.streams.topics import recorded, resolve_topic
from spinning_top_sim.table import RIDE_UNITS, UNITS, columns, write_csv, write_parquet
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, period_ns
from spinning_top_sim.tools import cli, scene_file

TABLES = {'.csv': write_csv, '.parquet': write_parquet}
# Time [ns], text and momenta [kg m^2/s] of a command; the last one is the end of the run.
Stop = tuple[int, str, dict[str, float]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    scene_file.add_parameters(parser)
    add('--duration', metavar='S', type='duration:={}'.format, dest='param', action='append',
        help='simulated time [s]: the parameter duration')
    add('-o', '--output', metavar='FILE', required=True, type=Path,
        help='file to write, .mcap, .csv or .parquet; an existing one is never overwritten')
    add('--seed', metavar='N', type='seed:={}'.format, dest='param', action='append',
        help='of the noise: the parameter seed')
    add('--command', metavar='T:L3:LZ', action='append', default=[],
        help='at T [s] set L3 and Lz [kg m^2/s]; may be repeated; commands at the same time are '
        'applied in the order given')
    add('--epoch', type=float, default=1.0, metavar='S',        # in ROS a stamp of 0 is "no time"
        help='stamp of t = 0 [s], default %(default)g')
    add('--namespace', default='/', help='of the topics and frames in the log')
    add('--quiet', action='store_true', help='no progress, no summary')


def _run(arguments: argparse.Namespace) -> int:
    output: Path = arguments.output
    if output.suffix not in ('.mcap', *TABLES):
        raise ValueError(f'{output}: the name must end in .mcap, {", ".join(TABLES)}')
    epoch_ns = arguments.epoch * NANOSECONDS
    if not 0.0 <= epoch_ns <= LAST_STAMP_NS:
        raise ValueError(f'--epoch {arguments.epoch!r}: must be >= 0 and < {2 ** 31} s')
    values = parameters.checked(scene_file.given(
        arguments, resolve_topic('spinning_top', arguments.namespace)))
    if not values['duration'] > 0.0:
        raise ValueError('--duration S, or the parameter duration, must be given')
    simulation = Simulation(values, round(epoch_ns))
    cli.check_output(output)
    stops = _parse_stops(arguments.command, round(values['duration'] * NANOSECONDS))
    with cli.progress('simulated', values['duration'], 's', quiet=arguments.quiet) as show:
        write = _write_log if output.suffix == '.mcap' else _write_table
        summary = write(arguments, simulation, stops, show)
    if not arguments.quiet:
        cli.print_line(f'{output}: {summary}')
    return cli.OK


def _parse_stops(commands: Sequence[str], duration_ns: int) -> list[Stop]:
    """Return the commands (T:L3:LZ) in the order of their application, and the end of the run."""
    stops: list[Stop] = []
    for text in commands:
        try:
            t, l3, lz = map(float, text.split(':'))
            at_ns, *_ = map(round, (t * NANOSECONDS, l3, lz))       # round refuses inf and nan
        except (ValueError, OverflowError):
            raise ValueError(f'--command {text}: must be T:L3:LZ, three numbers') from None
        if not 0 <= at_ns <= duration_ns:
            raise ValueError(f'--command {text}: T must be from 0 to the end of the run, '
                             f'{duration_ns / NANOSECONDS:g} s')
        stops.append((at_ns, text, {'l3': l3, 'lz': lz}))
    return [*sorted(stops, key=itemgetter(0)), (duration_ns, '', {})]


def _play(simulation: Simulation, channels: Sequence[Channel], stops: Sequence[Stop],
          show: Callable[[float], object]) -> Iterator[Block | Event]:
    """Yield the blocks up to each stop, and its command; a RuntimeError refuses it."""
    for stop_ns, text, momenta in stops:
        for block in simulation.play(channels, stop_ns):
            yield block
            show(simulation.sent_ns / NANOSECONDS)
        if text:
            try:
                yield simulation.apply('command', **momenta)
            except ValueError as error:
                raise RuntimeError(f'--command {text}: {error}; the file holds the run up to '
                                   'there') from error


def _write_table(arguments: argparse.Namespace, simulation: Simulation, stops: Sequence[Stop],
                 show: Callable[[float], object]) -> str:
    """Write a table; return the names of its columns."""
    pivot_moves = simulation.trajectory.pivot is not None
    units = RIDE_UNITS if pivot_moves else UNITS
    row = Template(Field('row', len(units)))
    table = Channel('table', '', '', period_ns(simulation.values_at_start['pose.rate']), row,
                    lambda samples: [columns(samples.t_ns / NANOSECONDS, samples.states,
                                             pivot_moves=pivot_moves)])
    # A command changes the rows after its time.
    TABLES[arguments.output.suffix](arguments.output, (
        row.decode(rows)[0] for done in _play(simulation, [table], stops, show)
        if isinstance(done, Block) for _, _, rows in done.messages), units)
    return ', '.join(units)


def _write_log(arguments: argparse.Namespace, simulation: Simulation, stops: Sequence[Stop],
               show: Callable[[float], object]) -> str:
    """Write a log, which is whole after an error, too; return what is in it."""
    values, epoch_ns = simulation.values_at_start, simulation.epoch_ns
    channels = recorded(simulation.channels, values)
    types = {channel.topic: channel.type_name for channel in channels} | events.TOPICS
    topics = [*types]
    file = McapWriter(
        arguments.output, [RecordedTopic(resolve_topic(name, arguments.namespace), type_name)
                           for name, type_name in types.items()],
        {**run_metadata(values, epoch_ns, -1, (), values), **environment()},
        compression=values['record.compression'])
    try:
        for done in chain([Event('start', 0, -1)], _play(simulation, channels, stops, show)):
            if isinstance(done, Event):
                for topic, data in done.entries():
                    file.add(*single(topics.index(topic), epoch_ns + done.t_ns, data))
            else:
                for channel, t_ns, rows in done.messages:
                    file.add(topics.index(channel.topic), epoch_ns + t_ns, rows)
                file.flush()
    finally:
        file.finish()
    return f'{file.message_counts.total()} messages, {file.size / 1e6:.1f} MB'


main = partial(cli.run, 'simulate', __doc__, add_arguments, _run)
