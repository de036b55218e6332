# SPDX-License-Identifier: Apache-2.0
"""A page of figures about an exam: the faults, and the errors over time."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from spinning_top_sim.exam.report import Report

LEAST_DEG = 1e-4                # lower limit of the logarithmic axis
WIDTH, LINE = 130, 0.15         # of the text: characters, and the height of a line [inch]


def draw_page(report: Report, path: Path) -> None:
    """
    Draw a page about a report.

    Parameters
    ----------
    report : Report
        What `examine` has returned.
    path : pathlib.Path
        Of the file; its suffix decides the format.
    """
    lines = [line for fault in report.found
             for line in textwrap.wrap(f'{fault.name}: {fault.evidence}', WIDTH)]
    lines += ['', *report.measure_lines()]
    height = LINE * len(lines)          # of the text [inch]
    with rc_context({'axes.spines.right': False, 'axes.spines.top': False, 'font.size': 9,
                     'text.parse_math': False}):        # texts of a filter may contain '$'
        figure = Figure(figsize=(11.0, 4.0 + height), layout='constrained')
        grid = figure.add_gridspec(2, 2, height_ratios=(4.0, height))
        tilt, heading = (figure.add_subplot(grid[0, column]) for column in (0, 1))
        for outcome in report.outcomes:
            errors = outcome.errors
            tilt.semilogy(outcome.run.t, np.maximum(np.degrees(errors.tilt), LEAST_DEG),
                          linewidth=0.8, label=outcome.run.name)
            heading.plot(outcome.run.t, np.degrees(errors.heading), linewidth=0.8)
        tilt.set(ylabel='tilt error [deg]', xlabel='t [s]')
        tilt.yaxis.set_major_formatter('{x:g}')         # the default is TeX
        tilt.tick_params(which='minor', labelleft=False)
        heading.set(ylabel='heading error [deg]', xlabel='t [s]')
        if report.outcomes:
            tilt.legend(frameon=False, fontsize=7)
        figure.suptitle(f'{report.subject}: {"passed" if report.passed else "faults"}',
                        fontsize=14)
        text = figure.add_subplot(grid[1, :])
        text.axis('off')
        text.text(0.0, 1.0, '\n'.join(lines), va='top', family='monospace', fontsize=8)
        figure.savefig(path, dpi=110)
