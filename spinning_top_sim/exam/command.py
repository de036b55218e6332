# SPDX-License-Identifier: Apache-2.0
"""
Examine an attitude filter: its attitudes in a log beside the truth, a running
node, or a published filter by name.

  examine run.mcap --topic /imu/data
  examine --node "python examples/attitude_node.py" --topic imu/data
  examine --filter vqf --level full --page vqf.png

exit codes:
  0    no fault was found
  1    the filter has faults, or a file cannot be read or written
  2    wrong arguments
  130  interrupted
The faults and the measures are defined in docs/exam.md.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spinning_top_sim.exam.adapters import FILTERS
from spinning_top_sim.exam.examiner import SEEDS, examine
from spinning_top_sim.exam.log import NORTHS, examine_log
from spinning_top_sim.exam.report import Report
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.tools import cli


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return cli.run('examine', __doc__, argv, _add_arguments, _run,
                   (ValueError, LogError, OSError, ImportError))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('log', type=Path, nargs='?', help='an MCAP file with the attitudes and the truth')
    add('--topic', help='of the attitudes')
    add('--truth', help='topic of the truth; default: ground_truth/imu, ground_truth/odom or pose')
    add('--heading', choices=NORTHS, help='the heading in the log must be right, from true or '
        'magnetic north; default: it must be steady')
    add('--node', metavar='COMMAND', help='examine a ROS node that reads imu/data_raw and '
        'imu/mag; it is started for every run, and gets a sample when it has answered the one '
        'before')
    add('--filter', choices=FILTERS, metavar='NAME',
        help=f'examine a published filter: {", ".join(FILTERS)}')
    add('--level', choices=SEEDS, default='quick', help='of the exam of a filter')
    add('--imu', metavar='FILE', help='parameter file of the IMU, as in config/imu')
    add('--seeds', type=int, metavar='N', help='number of noisy runs')
    add('--json', action='store_true', help='print everything as JSON')
    add('--junit', type=Path, metavar='FILE', help='write JUnit XML')
    add('--page', type=_picture, metavar='FILE',
        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib')


def _picture(name: str) -> Path:
    if Path(name).suffix.lower() not in ('.png', '.pdf', '.svg'):
        raise argparse.ArgumentTypeError(f'{name}: must end in .png or .pdf or .svg')
    return Path(name)


def _run(arguments: argparse.Namespace) -> int:
    report = _report(arguments)
    if arguments.json:
        print(report.as_json())
    else:
        for line in str(report).splitlines():
            cli.print_line(line)
    if arguments.junit is not None:
        arguments.junit.write_text(report.as_junit(), encoding='utf-8')
    if arguments.page is not None:
        from spinning_top_sim.exam.page import draw_page  # noqa: PLC0415 - needs matplotlib

        draw_page(report, arguments.page)
    return cli.OK if report.passed else cli.FAILED


def _report(arguments: argparse.Namespace) -> Report:
    if [arguments.log, arguments.node, arguments.filter].count(None) != 2:
        raise ValueError('give either a log and --topic, --node and --topic, or --filter')
    if arguments.filter is None and arguments.topic is None:
        raise ValueError('--topic: which topic has the attitudes?')
    if arguments.log is not None:
        return examine_log(arguments.log, arguments.topic, arguments.truth, arguments.heading)
    if arguments.node is not None:
        from spinning_top_sim.exam.live import NodeExam  # noqa: PLC0415 - needs ROS

        with NodeExam(arguments.node, arguments.topic) as node:
            return examine(node.make_filter, arguments.level, arguments.imu, arguments.seeds,
                           arguments.node)
    return examine(FILTERS[arguments.filter], arguments.level, arguments.imu, arguments.seeds,
                   arguments.filter)


if __name__ == '__main__':
    sys.exit(main())
