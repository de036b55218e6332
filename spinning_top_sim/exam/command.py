# SPDX-License-Identifier: Apache-2.0
"""
Examine an attitude filter: a class of yours, a program in any language, a ROS
node, a published filter by name, or the attitudes in a log beside the truth.

  spinning-top examine --filter mine.py:MyFilter
  spinning-top examine --command "./my_filter"
  spinning-top examine --node "python examples/attitude_node.py" --topic imu/data
  spinning-top examine --filter vqf --level full --page vqf.png
  spinning-top examine --filter vqf --data broad/data_mat    # with real readings
  spinning-top examine run.mcap --topic /imu/data

exit codes:
  0    no fault was found
  1    the filter has faults, a file cannot be read or written, or the node is
       not there
  2    wrong arguments
  130  interrupted
The faults and the measures are defined in docs/exam.md.
"""

import argparse
import contextlib
import runpy
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.exam.adapters import FILTERS
from spinning_top_sim.exam.broad import examine_data, trials_in
from spinning_top_sim.exam.examiner import SEEDS, checked_imu, examine
from spinning_top_sim.exam.feeding import INTERRUPTED, Filter, feed, feed_apart
from spinning_top_sim.exam.programs import Program
from spinning_top_sim.installation import needed
from spinning_top_sim.tools import cli, scene_file
from spinning_top_sim.tools.report import Report

# What is examined, with the options that it needs and those that it may have.
KINDS = {'log': (('topic',), ('truth', 'heading')),
         'node': (('topic',), ('level', 'imu', 'seeds')),
         'filter': ((), ('level', 'imu', 'seeds', 'data')),
         'command': ((), ('level', 'imu', 'seeds', 'data'))}
# With --data there is nothing to choose.
CHOSEN = 'level', 'imu', 'seeds'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('log', type=Path, nargs='?', help='an MCAP file with the attitudes and the truth')
    add('--filter', metavar='NAME', help='examine the class with a method `update` in a file '
        f'(FILE.py:CLASS), or a published filter: {", ".join(FILTERS)}')
    add('--command', metavar='COMMAND', help='examine a program in any language: it reads a line '
        'of readings for each update and answers with a line; each run starts it anew')
    add('--node', metavar='COMMAND', help='command that starts a ROS node that reads imu/data_raw '
        'and imu/mag; each run starts it anew, and waits for its answer to each sample')
    add('--topic', help='topic of the attitudes in a log, or of the node')
    add('--truth', help='topic of the truth; default: ground_truth/imu, ground_truth/odom or pose')
    add('--heading', choices=('true', 'magnetic'), help='the heading in the log must be right, '
        'from true or magnetic north; default: it must be steady')
    add('--data', type=Path, metavar='FOLDER', help='examine with the trials of BROAD in this '
        'folder: readings of a real IMU beside an optical truth (.mat; .hdf5 needs h5py)')
    add('--level', choices=SEEDS, help='level of the exam; default: quick; field: scenes of a '
        'sensor in a hand')
    scene_file.add_arguments(parser, 'imu')
    add('--seeds', type=int, metavar='N', help='number of noisy runs')
    add('--json', action='store_true', help='print everything as JSON')
    add('--page', type=Path, metavar='FILE', help='draw a page of figures (.png, .pdf, .svg); '
        'needs matplotlib; an existing file is never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    kind, options = _options(arguments)
    cli.check_output(arguments.page)
    if arguments.page is not None:
        with needed('a page', 'plot'):
            from spinning_top_sim.exam.page import draw_page  # noqa: PLC0415
    subject = getattr(arguments, kind)
    with _interruptible(), _progress() as show:
        report = EXAMS[kind](subject, options, show)
    if arguments.json:
        print(report.as_json())
    else:
        for line in str(report).splitlines():
            cli.print_line(line)
    if arguments.page is not None:
        draw_page(report, arguments.page)
    return cli.OK if report.passed else cli.FAILED


def _options(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Return what is examined, a key of KINDS, and its options.  Raises ValueError."""
    given = [kind for kind in KINDS if getattr(arguments, kind) is not None]
    if len(given) != 1:
        raise ValueError('give one of a log, --filter, --command and --node, not '
                         f'{" and ".join(given) or "none"}')
    (kind,), names = given, dict.fromkeys(name for pair in KINDS.values() for part in pair
                                          for name in part)
    needed_names, others = KINDS[kind]
    options = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    shown = kind if kind == 'log' else f'--{kind}'
    for name in needed_names:
        if name not in options:
            raise ValueError(f'{shown} needs --{name}')
    taken = [*needed_names, *(name for name in others if name not in CHOSEN
                              or 'data' not in options)]
    for name in options:
        if name not in taken:
            raise ValueError(f'--{name} cannot be given with '
                             f'{"--data" if name in others else shown}'
                             + f': must be {", ".join(f"--{one}" for one in taken)}' * bool(taken))
    if 'imu' in options:
        options['imu'] = scene_file.file_of('imu', options['imu'])
        checked_imu(options['imu'], options.get('level', 'quick'))
    if 'data' in options:
        trials_in(options['data'])
    return kind, options


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """End the exam, and what it has started, at SIGTERM as at SIGINT."""
    def interrupt(*_: object) -> None:
        INTERRUPTED.set()
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt)
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        INTERRUPTED.clear()


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[float, float], None]]:
    """Yield what shows how much is done, and the time that is left."""
    with contextlib.ExitStack() as stack:
        bars: list[Callable[[float], None]] = []

        def show(done: float, total: float) -> None:
            if not bars:
                bars.append(stack.enter_context(cli.progress('examined', total, 'checks')))
            bars[0](done)
        yield show


def _of_log(path: Path, options: dict[str, Any], show: Any) -> Report:
    with needed('it'):
        from spinning_top_sim.exam.log import examine_log  # noqa: PLC0415 - not always needed

    options['north'] = options.pop('heading', None)
    return examine_log(path, **options)


def _of_node(command: str, options: dict[str, Any], show: Any) -> Report:
    with needed('the exam of a node', 'ros'):
        from spinning_top_sim.exam.live import examine_node  # noqa: PLC0415
    return examine_node(command, show=show, **options)


def _of_filter(name: str, options: dict[str, Any], show: Any) -> Report:
    if name in FILTERS:
        with needed(f'the filter {name}'):
            FILTERS[name]()         # imports its package once, before the runs fork
        # Published filters neither crash nor hang: without processes, the exam is faster.
        return _of(FILTERS[name], name, feed, options, show)
    return _of(_own_filter(name), None, feed_apart, options, show)


def _of_program(command: str, options: dict[str, Any], show: Any) -> Report:
    return _of(partial(Program, command), command, feed, options, show)


def _of(make_filter: Callable[[], Filter], subject: str | None, how: Any,
        options: dict[str, Any], show: Any) -> Report:
    if 'data' in options:
        return examine_data(make_filter, options['data'], subject=subject, feed=how, show=show)
    return examine(make_filter, subject=subject, feed=how, show=show, **options)


def _own_filter(given: str) -> Callable[[], Filter]:
    """Return the class FILE.py:CLASS.  Raises ValueError, or OSError if there is no file."""
    path, _, name = given.rpartition(':')
    if not path.endswith('.py'):
        raise ValueError(f'--filter {given}: must be FILE.py:CLASS, or one of '
                         f'{", ".join(FILTERS)}')
    folder = Path(path).resolve(strict=True).parent
    sys.path.insert(0, str(folder))         # for what the file imports
    try:
        made: Callable[[], Filter] | None = runpy.run_path(path).get(name)
    except (Exception, SystemExit) as error:
        raise ValueError(f'--filter {given}: {path} raises {type(error).__name__}: '
                         f'{cli.one_line(error)}') from error
    if not callable(made):
        raise ValueError(f'--filter {given}: there is no {name} in {path} that can be called')
    return made


EXAMS: Mapping[str, Callable[..., Report]] = {
    'log': _of_log, 'node': _of_node, 'filter': _of_filter, 'command': _of_program}
main = partial(cli.run, 'examine', __doc__, add_arguments, _run)
