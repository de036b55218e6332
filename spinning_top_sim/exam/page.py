# SPDX-License-Identifier: Apache-2.0
"""A page of figures about an exam: the faults, and the errors that are judged over time."""

import math
import textwrap
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.report import Report

LEAST_DEG = 1e-4                # lower limit of the logarithmic axes
WIDTH, LINE = 130, 0.15         # of the text: characters, and the height of a line [inch]
# Marks whose limit holds for the errors of the outcomes.
LIMITS = 'noisy_deg', 'error_rms_deg'


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
    lines = [line for finding in report.found
             for line in textwrap.wrap(f'{finding.name}: {finding.evidence}', WIDTH)]
    lines += [*report.notes, '', *report.mark_lines()]
    height = LINE * len(lines)          # of the text [inch]
    # A heading is judged about its mean where nothing says that north is.
    absolute = 'rest_heading_deg' in report.marks or any(
        name.startswith(('field_', 'data_')) for name in report.marks)
    limit = next((report.marks[name].limit for name in LIMITS if name in report.marks), math.nan)
    with rc_context({'axes.spines.right': False, 'axes.spines.top': False, 'font.size': 9,
                     'text.parse_math': False}):        # texts of a filter may contain '$'
        figure = Figure(figsize=(11.0, 4.0 + height), layout='constrained')
        grid = figure.add_gridspec(2, 2, height_ratios=(4.0, height))
        tilt, heading = (figure.add_subplot(grid[0, column]) for column in (0, 1))
        for outcome in report.outcomes:
            errors = errors_of(outcome.estimates, outcome.run.truth)
            errors = errors if absolute else errors.about_mean()
            for axes, error in ((tilt, errors.tilt), (heading, errors.heading)):
                axes.semilogy(outcome.run.t, np.maximum(np.degrees(np.abs(error)), LEAST_DEG),
                              linewidth=0.8, label=outcome.run.name)
        for axes, name in ((tilt, 'tilt'), (heading, 'heading')):
            axes.axhline(limit, color='0.5', linestyle=':', label='limit of the rms')
            axes.set(ylabel=f'{name} error [deg]', xlabel='t [s]')
            axes.yaxis.set_major_formatter('{x:g}')         # the default is TeX
            axes.tick_params(which='minor', labelleft=False)
        if report.outcomes:
            tilt.legend(frameon=False, fontsize=7)
        figure.suptitle(f'{report.subject}: {"passed" if report.passed else "faults"}',
                        fontsize=14)
        text = figure.add_subplot(grid[1, :])
        text.axis('off')
        text.text(0.0, 1.0, '\n'.join(lines), va='top', family='monospace', fontsize=8)
        figure.savefig(path, dpi=110)
