# SPDX-License-Identifier: Apache-2.0
"""A page of figures about an exam: the faults, and the errors over time."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from spinning_top_sim.exam.report import Report

LEAST_DEG = 1e-4                # lower limit of the logarithmic axis


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
    with rc_context({'axes.spines.right': False, 'axes.spines.top': False, 'font.size': 9,
                     'text.parse_math': False}):        # texts of a filter may contain '$'
        figure = Figure(figsize=(11.0, 7.0), layout='constrained')
        grid = figure.add_gridspec(2, 2, width_ratios=(3.0, 2.0))
        tilt, heading = (figure.add_subplot(grid[row, 0]) for row in (0, 1))
        for outcome in report.outcomes:
            errors = outcome.errors
            tilt.semilogy(outcome.run.t, np.maximum(np.degrees(errors.tilt), LEAST_DEG),
                          linewidth=0.8, label=outcome.run.name)
            heading.plot(outcome.run.t, np.degrees(errors.turned(True)), linewidth=0.8)
        tilt.set(ylabel='tilt error [deg]')
        heading.set(ylabel='heading error [deg]', xlabel='t [s]')
        if report.outcomes:
            tilt.legend(frameon=False, fontsize=7)
        figure.suptitle(f'{report.subject}: {"passed" if report.passed else "faults"}',
                        fontsize=14)
        text = figure.add_subplot(grid[:, 1])
        text.axis('off')
        lines = [line for fault in report.found
                 for line in (*textwrap.wrap(f'{fault.name}: {fault.evidence}', 58), '')]
        text.text(0.0, 1.0, '\n'.join((*lines, *report.measure_lines())), va='top',
                  family='monospace', fontsize=8)
        figure.savefig(path, dpi=110)
