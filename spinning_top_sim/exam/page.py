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

LEAST_DEG = 1e-4        # lower limit of the logarithmic axes
LINE = 0.15             # height of a line of text [inch]
# Marks whose limit holds for the errors of the outcomes.
LIMITS = 'noisy_deg', 'error_rms_deg', 'field_rms_deg', 'data_rms_deg'


def draw_page(report: Report, path: Path) -> None:
    """
    Draw what `examine` has returned.

    Parameters
    ----------
    report : Report
        What `examine` has returned.
    path : path
        A new file; its suffix decides the format.
    """
    lines = [part for line in str(report).splitlines() for part in textwrap.wrap(line, 130)]
    limit = next((report.marks[name].limit for name in LIMITS if name in report.marks), math.nan)
    with rc_context({'axes.spines.right': False, 'axes.spines.top': False, 'font.size': 9,
                     'text.parse_math': False}):        # texts of a filter may contain '$'
        figure = Figure(figsize=(11.0, 4.0 + LINE * len(lines)), layout='constrained')
        grid = figure.add_gridspec(2, 2, height_ratios=(4.0, LINE * len(lines)))
        tilt, heading = (figure.add_subplot(grid[0, column]) for column in (0, 1))
        for outcome in report.outcomes:
            errors = errors_of(outcome.estimates, outcome.run.truth)
            errors = errors if report.absolute else errors.about_mean()
            for axes, error in ((tilt, errors.tilt), (heading, errors.heading)):
                axes.semilogy(outcome.run.t, np.maximum(np.degrees(np.abs(error)), LEAST_DEG),
                              linewidth=0.8, label=outcome.run.name)
        for axes, name in ((tilt, 'tilt'), (heading, 'heading')):
            axes.axhline(limit, color='0.5', linestyle=':', label='limit of the rms')
            axes.set(ylabel=f'{name} error [deg]', xlabel='time that is judged [s]')
            axes.yaxis.set_major_formatter('{x:g}')         # the default is TeX
            axes.tick_params(which='minor', labelleft=False)
        if report.outcomes:
            tilt.legend(frameon=False, fontsize=7)
        text = figure.add_subplot(grid[1, :])
        text.axis('off')
        text.text(0.0, 1.0, '\n'.join(lines), va='top', family='monospace', fontsize=8)
        figure.savefig(path, format=path.suffix[1:] or 'png', dpi=110)
