# SPDX-License-Identifier: Apache-2.0
"""The executable `simulate`: the node's pipeline offline, as fast as the machine goes."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.recording.provenance import provenance
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.streams.schedule import offline_block_ns, offline_targets
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.tools.cli import OK, exit_code, print_line, progress
from spinning_top_sim.tools.scene_file import parse_assignment, read_scene
from spinning_top_sim.tools.table import Stop, write_table

if TYPE_CHECKING:
    from spinning_top_sim.recording.mcap_writer import McapWriter

# In ROS a stamp of 0 means "no time".
DEFAULT_EPOCH = 1.0
FORMATS = ('mcap', 'csv', 'parquet')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return exit_code(_parser(), argv, _run,
                     (ValueError, RecordingError, IntegrationError, OSError))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='simulate', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Simulate the heavy symmetric top offline, into a log (MCAP) or a table of '
        'the\ntrue states (CSV, Parquet).',
        epilog='exit codes:\n'
               '  0    done\n'
               '  1    the run cannot be simulated or written; the reason is printed\n'
               '  2    wrong arguments\n'
               '  130  interrupted; the log holds what was computed before\n')
    add = parser.add_argument
    add('--params', metavar='FILE', action='append', default=[],
        help='parameter file as for the node; may be repeated')
    add('-p', '--param', metavar='NAME:=VALUE', action='append', default=[],
        help='one parameter; may be repeated')
    add('--duration', type=float, metavar='S',
        help='simulated time [s]; default: the parameter duration')
    add('-o', '--output', metavar='FILE', required=True, type=Path,
        help='file to write; an existing one is never overwritten')
    add('--seed', type=int, help='seed of the noise; default: the parameter seed')
    add('--command', metavar='T:L3:LZ', action='append', default=[],
        help='at T [s] set L3 and Lz [kg m^2/s]; may be repeated; commands at the same time are '
        'applied in the order given')
    add('--epoch', type=float, default=DEFAULT_EPOCH, metavar='S',
        help='stamp of t = 0 [s], default %(default)g')
    add('--namespace', default='/', help='of the topics in the log')
    add('--format', choices=FORMATS,
        help='format of the output; default: by the extension of its name')
    add('--quiet', action='store_true', help='no progress, no summary')
    return parser


def _run(arguments: argparse.Namespace) -> int:
    values = _parameters(arguments)
    if not 0.0 <= arguments.epoch <= 2.0 ** 31:
        raise ValueError(f'--epoch {arguments.epoch!r}: must be from 0 to {2 ** 31} s')
    stops = parse_stops(arguments.command, round(values['duration'] * NANOSECONDS))
    output: Path = arguments.output
    file_format = arguments.format or output.suffix[1:]
    if file_format not in FORMATS:
        raise ValueError(f'{output}: the name must end in .{", .".join(FORMATS)}, or --format be '
                         'given')
    with progress('simulated', values['duration'], 's', quiet=arguments.quiet) as show:
        if file_format == 'mcap':
            summary = write_log(output, values, stops, show,
                                round(arguments.epoch * NANOSECONDS), arguments.namespace)
        else:
            summary = write_table(output, file_format, values, stops, show)
    if not arguments.quiet:
        print_line(f'{output}: {summary}')
    return OK


def _parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the checked parameters of the command line.  Raises ValueError."""
    given: dict[str, object] = {}
    for path in arguments.params:
        given.update(read_scene(path))
    given.update(parse_assignment(text) for text in arguments.param)
    given.update((name, value) for name, value in vars(arguments).items()
                 if name in ('seed', 'duration') and value is not None)
    values = parameters.checked(given)
    if not values['duration'] > 0.0:
        raise ValueError(f'duration = {values["duration"]!r} s: must be > 0 (--duration)')
    return values


def parse_stops(commands: Sequence[str], duration_ns: int) -> list[Stop]:
    """Return the commands (T:L3:LZ) in the order of their application, and the end of the run."""
    stops: list[Stop] = []
    for text in commands:
        try:
            t, l3, lz = map(float, text.split(':'))
            at_ns = round(t * NANOSECONDS)
        except (ValueError, OverflowError):
            raise ValueError(f'--command {text}: must be T:L3:LZ, three numbers') from None
        if not 0 <= at_ns <= duration_ns:
            raise ValueError(f'--command {text}: T must be from 0 to the end of the run, '
                             f'{duration_ns / NANOSECONDS:g} s')
        stops.append((at_ns, (l3, lz)))
    # The sort is stable: commands at the same time keep their order.
    return [*sorted(stops, key=lambda stop: stop[0]), (duration_ns, None)]


def write_log(path: Path, values: Mapping[str, Any], stops: Sequence[Stop],
              show: Callable[[float], object], epoch_ns: int, namespace: str) -> str:
    """
    Simulate a run into a new log; return the number of messages and the size of the file.

    After an error the log is closed and readable, and holds what was computed before.

    stops : in ascending order of time, the last one is the end of the run
    show : takes the simulated time reached [s]
    epoch_ns : stamp of t = 0 [ns]
    namespace : of the topics
    """
    from spinning_top_sim.recording.writer import create_file  # noqa: PLC0415 - needs mcap

    simulation = Simulation(values, epoch_ns)
    streams = journal.recorded_streams(simulation.streams, values)
    topics = [RecordedTopic(journal.resolve_topic(name, namespace), type_name)
              for name, type_name in (*((stream.topic, stream.type_name) for stream in streams),
                                      *journal.TOPICS)]
    commands_topic, events_topic = len(streams), len(streams) + 1
    metadata = provenance(values, epoch_ns, -1, (), values)
    file = create_file(path, topics, metadata, compression=values['record.compression'])
    simulation.log_to(None, streams)
    with contextlib.closing(_LogWriter(file, streams)) as writer:
        writer.write(events_topic, epoch_ns, journal.event('start', 0, -1))
        for target_ns, momenta in offline_targets(0, stops, offline_block_ns(streams)):
            try:
                simulation.advance_in_blocks(target_ns, writer.take)
            finally:                # also what was computed before the motion could not go on
                writer.write_blocks()
            if momenta is not None:
                simulation.command(*momenta)
                t_ns, l3, lz = simulation.history[-1]
                writer.write(events_topic, epoch_ns + t_ns, journal.event(
                    'command', t_ns, simulation.now_ns, l3=l3, lz=lz))
                writer.write(commands_topic, epoch_ns + t_ns, journal.command(l3, lz))
            show(target_ns / NANOSECONDS)
    return f'{sum(file.message_counts.values())} messages, {file.size / 1e6:.1f} MB'


class _LogWriter:
    """Writes a log in a thread: compression and the file system leave Python to others."""

    def __init__(self, file: McapWriter, streams: Sequence[Stream]) -> None:
        self._file, self._streams = file, streams
        self._blocks: list[tuple[int, NDArray[np.int64], NDArray[np.uint8]]] = []
        self._executor = ThreadPoolExecutor(1)
        self._chunk: Future[None] | None = None         # that is being written

    def _wait(self) -> None:
        chunk, self._chunk = self._chunk, None
        if chunk is not None:
            chunk.result()

    def write(self, topic_index: int, stamp_ns: int, data: bytes) -> None:
        """Write an entry of the journal with the next chunk."""
        self._wait()
        self._file.append(topic_index, stamp_ns, data)

    def take(self, stream: Stream, stamps_ns: NDArray[np.int64],
             rows: NDArray[np.uint8]) -> None:
        """Take a block of samples, which `write_blocks` writes."""
        self._blocks.append((self._streams.index(stream), stamps_ns, rows.copy()))

    def write_blocks(self) -> None:
        """Begin to write a chunk of the blocks.  Raises OSError of the chunk before."""
        blocks, self._blocks = self._blocks, []
        if blocks:
            chunk = self._file.chunk_of_rows(blocks)
            self._wait()
            self._file.write_chunk()
            self._chunk = self._executor.submit(self._file.write_chunk, chunk)

    def close(self) -> None:
        """Finish the file."""
        try:
            self._wait()
        finally:
            self._executor.shutdown()
            self._file.write_chunk()
            self._file.finish()


if __name__ == '__main__':
    sys.exit(main())
