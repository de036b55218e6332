# SPDX-License-Identifier: Apache-2.0
"""
Examine an attitude filter: its attitudes in a log beside the truth, a ROS node,
a class of yours, or a published filter by name.

  spinning-top examine run.mcap --topic /imu/data
  spinning-top examine --node "python examples/attitude_node.py" --topic imu/data
  spinning-top examine --topic imu/data                      # of a node that runs already
  spinning-top examine --filter vqf --level full --page vqf.png
  spinning-top examine --filter mine.py:MyFilter
  spinning-top examine --filter vqf --data broad/data_mat    # with real readings

exit codes:
  0    no fault was found
  1    the filter has faults, a file cannot be read or written, or the node is
       not there
  2    wrong arguments
  130  interrupted
The faults and the measures are defined in docs/exam.md.
"""

import argparse
import runpy
import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.exam.adapters import FILTERS
from spinning_top_sim.exam.broad import examine_data, trials_in
from spinning_top_sim.exam.examiner import SEEDS, examine
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.trial import INTERRUPTED, Filter
from spinning_top_sim.installation import needed
from spinning_top_sim.tools import cli, scene_file

NORTHS = 'true', 'magnetic'
# What is examined, by the arguments that say so.
KINDS = {('log', 'topic'): 'a log', ('node', 'topic'): 'a node', ('topic',): 'a node',
         ('filter',): '--filter', ('filter', 'data'): '--data'}
# Options for each kind of subject.
OPTIONS = {'a log': ('topic', 'truth', 'heading'), 'a node': ('topic', 'level', 'imu', 'seeds'),
           '--filter': ('level', 'imu', 'seeds'), '--data': ('data',)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('log', type=Path, nargs='?', help='an MCAP file with the attitudes and the truth')
    add('--topic', help='topic of the attitudes; without a log and --node, of a running node that '
        'reads imu/data_raw and imu/mag')
    add('--truth', help='topic of the truth; default: ground_truth/imu, ground_truth/odom or pose')
    add('--heading', choices=NORTHS, help='the heading in the log must be right, from true or '
        'magnetic north; default: it must be steady')
    add('--node', metavar='COMMAND', help='command that starts a ROS node that reads imu/data_raw '
        'and imu/mag; each run starts it anew, and waits for its answer to each sample')
    add('--filter', metavar='NAME', help='examine the class with a method `update` in a file '
        f'(FILE.py:CLASS), or a published filter: {", ".join(FILTERS)}')
    add('--data', type=Path, metavar='FOLDER', help='examine --filter with the trials of BROAD in '
        'this folder: readings of a real IMU beside an optical truth (.mat; .hdf5 needs h5py)')
    add('--level', choices=SEEDS, help='level of the exam of a filter or node; default: quick; '
        'field: scenes of a sensor in a hand')
    scene_file.add_arguments(parser, 'imu')
    add('--seeds', type=int, metavar='N', help='number of noisy runs')
    add('--json', action='store_true', help='print everything as JSON')
    add('--junit', type=Path, metavar='FILE', help='write JUnit XML; an existing file is replaced')
    add('--page', type=Path, metavar='FILE',
        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib; an existing file is '
        'never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    cli.check_output(arguments.page)
    report = _report(arguments)
    if arguments.json:
        print(report.as_json())
    else:
        for line in str(report).splitlines():
            cli.print_line(line)
    if arguments.junit is not None:
        arguments.junit.write_text(report.as_junit(), encoding='utf-8')
    if arguments.page is not None:
        with needed('a page', 'plot'):
            from spinning_top_sim.exam.page import draw_page  # noqa: PLC0415
        draw_page(report, arguments.page)
    return cli.OK if report.passed else cli.FAILED


def _kind(arguments: argparse.Namespace) -> str:
    """Return what is examined, a key of OPTIONS.  Raises ValueError where that is not clear."""
    given = tuple(name for name in ('log', 'node', 'filter', 'topic', 'data')
                  if getattr(arguments, name) is not None)
    if given not in KINDS:
        log = f'{arguments.log}: ' if arguments.log else ''
        raise ValueError(f'{log}give either a log and --topic, --node and --topic, --topic '
                         f'alone, --filter, or --filter and --data, not {", ".join(given)}')
    return KINDS[given]


def _report(arguments: argparse.Namespace) -> Report:
    kind = _kind(arguments)
    options = {name: value for names in OPTIONS.values() for name in names
               if (value := getattr(arguments, name)) is not None}
    for name in options.keys() - OPTIONS[kind]:
        others = ', '.join(f'--{one}' for one in OPTIONS[kind] if f'--{one}' != kind)
        refusal = f'--{name} cannot be given with {kind}'
        raise ValueError(f'{refusal}: must be {others}' if others else refusal)
    if arguments.imu is not None:
        options['imu'] = scene_file.file_of('imu', arguments.imu)
    if kind == 'a log':
        return _of_log(arguments.log, options)
    if kind == 'a node':
        return _of_node(arguments.node, options)
    return _of_filter(arguments.filter, options)


def _of_log(path: Path, options: dict[str, Any]) -> Report:
    with needed('it'):
        from spinning_top_sim.exam.log import examine_log  # noqa: PLC0415 - not always needed

    options['north'] = options.pop('heading', None)
    return examine_log(path, **options)


def _of_node(command: str | None, options: Mapping[str, Any]) -> Report:
    before = signal.signal(signal.SIGINT, lambda *_: INTERRUPTED.set())
    try:
        with needed('the exam of a node', 'ros'):
            from spinning_top_sim.exam.live import examine_node  # noqa: PLC0415

        return examine_node(command=command, **options)
    finally:
        signal.signal(signal.SIGINT, before)


def _of_filter(name: str, options: Mapping[str, Any]) -> Report:
    if name in FILTERS:
        with needed(f'the filter {name}'):
            FILTERS[name]()         # imports its package once, before the runs fork
    make_filter, shown = FILTERS.get(name) or _own_filter(name), name if name in FILTERS else None
    if 'data' not in options:
        # Published filters neither crash nor hang: without processes, the exam is faster.
        return examine(make_filter, subject=shown, isolated=shown is None, **options)
    folder = options['data']
    with cli.progress('examined', len(trials_in(folder)), 'trials') as show:
        return examine_data(make_filter, folder, subject=shown, show=show)


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


main = partial(cli.run, 'examine', __doc__, add_arguments, _run)
