# SPDX-License-Identifier: Apache-2.0
"""
Examine an attitude filter: a class of yours, a program in any language, a ROS
node, a published filter by name, or the attitudes in a log beside the truth.

  spinning-top examine --filter mine.py:MyFilter
  spinning-top examine --command "./my_filter"
  spinning-top examine --node "python examples/attitude_node.py" --topic imu/data
  spinning-top examine --filter vqf --level field --page vqf.png
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
import runpy
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.exam.adapters import FILTERS
from spinning_top_sim.exam.examiner import SEEDS, examine
from spinning_top_sim.exam.feeding import Filter, feed, feed_apart
from spinning_top_sim.exam.programs import Program
from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed
from spinning_top_sim.tools import cli, scene_file
from spinning_top_sim.tools.report import Report, printed

# What is examined, and the options that it takes.
OF_FILTER = 'level', 'imu', 'seeds', 'data'
KINDS = {'log': ('topic', 'truth'), 'node': ('topic', 'level', 'imu', 'seeds'),
         'filter': OF_FILTER, 'command': OF_FILTER}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_mutually_exclusive_group(required=True).add_argument
    add('log', type=Path, nargs='?', help='an MCAP file with the attitudes and the truth')
    add('--filter', metavar='NAME', help='examine the class with a method `update` in a file '
        f'(FILE.py:CLASS), or a published filter: {", ".join(FILTERS)}')
    add('--command', metavar='COMMAND', help='examine a program in any language: it reads a line '
        'of readings for each update and answers with a line; each run starts it anew')
    add('--node', metavar='COMMAND', help='command that starts a ROS node that reads imu/data_raw '
        'and imu/mag; each run starts it anew, and waits for its answer to each sample: minutes')
    add = parser.add_argument
    add('--topic', help='topic of the attitudes in a log, or of the node')
    add('--truth', help='topic of the true attitudes of the same axes; default: ground_truth/imu')
    add('--data', type=Path, metavar='FOLDER', help='examine with the trials of BROAD in this '
        'folder: readings of a real IMU beside an optical truth (.mat)')
    add('--level', choices=SEEDS, help='level of the exam; default: quick; field: scenes of a '
        'sensor in a hand')
    scene_file.add_arguments(parser, 'imu')
    add('--seeds', type=int, metavar='N', help='number of noisy runs')
    add('--json', action='store_true', help='print everything as JSON')
    add('--page', type=Path, metavar='FILE', help='draw a page of figures (.png, .pdf, .svg); '
        'needs matplotlib; an existing file is never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    kind = next(kind for kind in KINDS if getattr(arguments, kind) is not None)
    options = _options(arguments, kind)
    cli.check_output(arguments.page)
    if arguments.page is not None:
        with needed('a page', 'plot'):
            from spinning_top_sim.exam.page import draw_page  # noqa: PLC0415
    judge = _judge(kind, getattr(arguments, kind))
    with cli.progress('examined', 100.0, '%') as bar:
        if kind != 'log':
            options['show'] = lambda done, total: bar(100.0 * done / total)
        report = judge(**options)
    code = printed(report, arguments.json)
    if arguments.page is not None:
        with new_file(arguments.page):
            draw_page(report, arguments.page)
    return code


def _options(arguments: argparse.Namespace, kind: str) -> dict[str, Any]:
    """Return the options of what is examined.  Raises ValueError for those that it has not."""
    options = {name: value for name in dict.fromkeys(sum(KINDS.values(), ()))
               if (value := getattr(arguments, name)) is not None}
    shown, taken = kind if kind == 'log' else f'--{kind}', KINDS[kind]
    if 'topic' in taken and 'topic' not in options:
        raise ValueError(f'{shown} needs --topic')
    for name in options:
        if name not in taken:
            raise ValueError(f'--{name} cannot be given with {shown}: must be '
                             f'{", ".join(f"--{one}" for one in taken)}')
    if 'imu' in options:
        options['imu'] = scene_file.file_of('imu', options['imu'])
    return options


def _judge(kind: str, subject: Any) -> Callable[..., Report]:
    """Return what examines the subject with its options; it has imported what it needs."""
    if kind == 'log':
        from spinning_top_sim.exam.log import examine_log  # noqa: PLC0415 - not always needed
        return partial(examine_log, subject)
    words = shlex.split(subject) if kind in ('node', 'command') else [subject]
    if not words:
        raise ValueError(f'--{kind} {subject!r}: must be a program and its arguments')
    if kind == 'node':
        with needed('the exam of a node', 'ros'):
            from spinning_top_sim.exam.live import examine_node  # noqa: PLC0415
        return partial(examine_node, subject)
    make_filter: Callable[[], Filter] = partial(Program, words)
    how, name = feed, subject
    if kind == 'filter' and subject in FILTERS:
        make_filter = FILTERS[subject]
        with needed(f'the filter {subject}'):
            make_filter()
    elif kind == 'filter':
        make_filter, how, name = _own_filter(subject), feed_apart, None
    return partial(examine, make_filter, subject=name, feed=how)


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
