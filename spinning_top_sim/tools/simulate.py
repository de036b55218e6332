# SPDX-License-Identifier: Apache-2.0
"""
The executable `simulate`: the node's pipeline offline, as fast as the machine goes.

The same parameters, seed and commands give the same messages as a live run, the offset of the
stamps aside.  rk45 has the bytes of a live run; the exact solution is evaluated and written in
whole columns of its own.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.rk45 import NANOSECONDS
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.pipeline import Messages, Simulation
from spinning_top_sim.tools.scene_file import parse_assignment, read_scene

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

# Simulated time between two looks at the progress, when states go one by one.
STRIDE_NS = NANOSECONDS
# Uncompressed size of a chunk of columns: large enough for numpy, small enough for a reader.
CHUNK_BYTES = 1 << 21
# In ROS a stamp of 0 means "no time".
DEFAULT_EPOCH = 1.0

Command = tuple[int, float, float]


def main(argv: Sequence[str] | None = None) -> int:
    """Run it; return 0, or 1 for what cannot be simulated or written."""
    arguments = _parser().parse_args(argv)
    try:
        values = _values(arguments)
        _run(arguments, values)
    except (ValueError, RecordingError, IntegrationError, OSError) as error:
        print(f'simulate: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('simulate: interrupted', file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='simulate', description='Simulate the heavy symmetric top offline, into a log (MCAP) '
        'or a table of the truth (CSV, Parquet).')
    parser.add_argument('--params', metavar='FILE', action='append', default=[],
                        help='parameter file as for the node; may be repeated')
    parser.add_argument('-p', '--param', metavar='NAME:=VALUE', action='append', default=[],
                        help='one parameter; may be repeated')
    parser.add_argument('--duration', type=float, metavar='S',
                        help='simulated time [s]; default: the parameter duration')
    parser.add_argument('-o', '--output', metavar='FILE', required=True,
                        help='file to write; an existing one is never overwritten')
    parser.add_argument('--seed', type=int, help='seed of the noise: the parameter seed')
    parser.add_argument('--command', metavar='T:L3:LZ', action='append', default=[],
                        help='at T [s] let L3 and Lz [kg m^2/s] jump; may be repeated')
    parser.add_argument('--epoch', type=float, default=DEFAULT_EPOCH, metavar='S',
                        help='stamp of t = 0 [s], default %(default)g')
    parser.add_argument('--namespace', default='/', help='of the topics in the log')
    parser.add_argument('--format', choices=('mcap', 'csv', 'parquet'),
                        help='default: by the name of the output, else mcap')
    parser.add_argument('--quiet', action='store_true', help='no progress, no summary')
    return parser


def _values(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the checked parameters of the command line.  Raises ValueError."""
    given: dict[str, Any] = {}
    for path in arguments.params:
        given.update(read_scene(path))
    given.update(parse_assignment(text) for text in arguments.param)
    if arguments.seed is not None:
        given['seed'] = arguments.seed
    if arguments.duration is not None:
        given['duration'] = arguments.duration
    values = parameters.checked(given)
    if not values['duration'] > 0.0:
        raise ValueError(f'duration = {values["duration"]!r} s: must be > 0 (--duration)')
    return values


def parse_commands(texts: Sequence[str]) -> list[Command]:
    """Return (t_ns, l3, lz) of each T:L3:LZ in order of time.  Raises ValueError."""
    commands = []
    for text in texts:
        try:
            t, l3, lz = map(float, text.split(':'))
            at_ns = round(t * NANOSECONDS)
        except (ValueError, OverflowError):
            raise ValueError(f'--command {text}: must be T:L3:LZ, three numbers') from None
        if at_ns < 0:
            raise ValueError(f'--command {text}: T must be >= 0')
        commands.append((at_ns, l3, lz))
    return sorted(commands, key=lambda command: command[0])


def _run(arguments: argparse.Namespace, values: dict[str, Any]) -> None:
    commands = parse_commands(arguments.command)
    output = Path(arguments.output)
    kind = arguments.format or {'.csv': 'csv', '.parquet': 'parquet'}.get(output.suffix, 'mcap')
    duration_ns = round(values['duration'] * NANOSECONDS)
    with progress(values['duration'], arguments.quiet) as show:
        if kind == 'mcap':
            summary = write_log(output, values, duration_ns, commands,
                                epoch_ns=round(arguments.epoch * NANOSECONDS),
                                namespace=arguments.namespace, show=show)
        else:
            from spinning_top_sim.tools.table import write_table  # noqa: PLC0415

            summary = write_table(output, kind, values, duration_ns, commands, show)
    if not arguments.quiet:
        print(f'{output}: {summary}')


class progress:  # noqa: N801 - a context manager, used like a function
    """Shows simulated seconds on a terminal: `show(t)`."""

    def __init__(self, total: float, quiet: bool) -> None:
        self._bar: Any = None
        if not quiet and sys.stderr.isatty():
            try:
                from tqdm import tqdm  # noqa: PLC0415
            except ImportError:
                return
            self._bar = tqdm(total=total, unit='s', desc='simulated', unit_scale=False,
                             bar_format='{desc} {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s '
                                        '[{elapsed}<{remaining}]')

    def __enter__(self) -> Callable[[int], None]:
        return self._show

    def _show(self, t_ns: int) -> None:
        if self._bar is not None:
            self._bar.update(t_ns / NANOSECONDS - self._bar.n)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()


def write_log(path: Path, values: Mapping[str, Any], duration_ns: int,
              commands: Sequence[Command] = (), *, epoch_ns: int, namespace: str = '/',
              show: Callable[[int], None] = lambda t_ns: None) -> str:
    """
    Simulate into a new log; return what to tell about it.

    Raises RecordingError where the file cannot be made, OSError where the disk gives up,
    ValueError for a command that is refused, IntegrationError where the Euler form stops.  What
    was written until then is closed and readable.
    """
    from spinning_top_sim.recording.provenance import provenance  # noqa: PLC0415
    from spinning_top_sim.recording.rosbag2 import RecordedTopic  # noqa: PLC0415
    from spinning_top_sim.recording.writer import create_file  # noqa: PLC0415

    simulation = Simulation(values, epoch_ns)
    columns = values['solver.method'] == 'exact'
    streams = journal.recorded_streams(simulation.streams, values)
    topics = [RecordedTopic(resolve(name, namespace), type_name) for name, type_name in
              (*((stream.topic, stream.type_name) for stream in streams), *journal.TOPICS)]
    commands_topic, events_topic = len(streams), len(streams) + 1
    metadata = provenance(values, epoch_ns, -1, (), values,
                          'columns' if columns else 'one state at a time')
    file = create_file(path, topics, metadata, compression=values['record.compression'])

    behind = _Behind(file.put_plain_chunk if columns else file.append_all)
    taken: list[Messages] = []

    def write(topic_index: int, stamp_ns: int, data: bytes) -> None:
        behind.wait()
        if file.append(topic_index, stamp_ns, data):
            file.write_chunk()

    def flush() -> None:
        nonlocal taken
        if taken:
            behind.wait()
            batch, taken = taken, []        # before: interrupted, a log is shorter, not doubled
            behind.start(batch)

    def advance(target_ns: int) -> None:
        if not columns:
            simulation.advance(target_ns)
            if sum(size for *_, size in taken) >= CHUNK_BYTES:
                flush()
            return
        parts: list[tuple[int, Any, Any]] = []
        simulation.advance_in_columns(target_ns, lambda stream, stamps, rows: parts.append(
            (streams.index(stream), stamps, rows)))
        if parts:
            chunk = file.chunk_of_rows(parts)
            behind.wait()
            file.write_chunk()
            behind.start(chunk)

    simulation.log_to(lambda *messages: taken.append(messages), streams)
    write(events_topic, epoch_ns, journal.event('start', 0, -1))
    try:
        for target_ns, command in stretches(duration_ns, commands,
                                            stride(streams) if columns else STRIDE_NS):
            advance(target_ns)
            if command is not None:
                _, l3, lz = command
                simulation.command(l3, lz)
                at_ns = simulation.history[-1][0]
                write(events_topic, epoch_ns + at_ns,
                      journal.event('command', at_ns, simulation.now_ns, l3=l3, lz=lz))
                write(commands_topic, epoch_ns + at_ns, journal.command(l3, lz))
            show(target_ns)
        flush()
        behind.wait()
    finally:
        behind.close()
        file.append_all(taken)          # of a motion that could not go on
        file.write_chunk()
        file.finish()
    return f'{sum(file.counts)} messages, {file.size / 1e6:.1f} MB'


class _Behind:
    """
    Does something with one item in a thread, while the next item is made.

    Compressing and writing take as long as computing, and leave Python to others meanwhile.
    """

    def __init__(self, work: Callable[[Any], None]) -> None:
        self._work = work
        self._thread: Executor | None = None
        self._pending: Future[None] | None = None

    def start(self, item: Any) -> None:
        """Begin the work with an item; call `wait` before."""
        if self._thread is None:
            from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

            self._thread = ThreadPoolExecutor(1)
        self._pending = self._thread.submit(self._work, item)

    def wait(self) -> None:
        """Wait until the work is done.  Raises what it raised."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def close(self) -> None:
        """Wait until the work is done, whatever became of it, and end the thread."""
        if self._thread is not None:
            self._thread.shutdown()


def stretches(duration_ns: int, commands: Sequence[Command], stride_ns: int,
              ) -> Iterator[tuple[int, Command | None]]:
    """
    Yield how far to go next, and the command to apply there.

    The last bits of columns depend on it.
    """
    now = 0
    due = [command for command in commands if command[0] <= duration_ns]
    for until_ns, command in (*((command[0], command) for command in due), (duration_ns, None)):
        while until_ns - now > stride_ns:
            now += stride_ns
            yield now, None
        now = until_ns
        yield now, command


def stride(streams: Sequence[Any]) -> int:
    """Return the simulated time that fills a chunk of columns [ns]."""
    bytes_per_ns = sum(len(stream.template) / stream.period_ns for stream in streams)
    return max(int(CHUNK_BYTES / bytes_per_ns), 1) if bytes_per_ns else STRIDE_NS


def resolve(topic: str, namespace: str) -> str:
    """Return a topic's full name, as ROS resolves it for the node spinning_top."""
    if topic.startswith('/'):
        return topic
    space = '/' + namespace.strip('/')
    name = topic.replace('~', 'spinning_top', 1)
    return f'{space.rstrip("/")}/{name}'


if __name__ == '__main__':
    sys.exit(main())
