# SPDX-License-Identifier: Apache-2.0
"""A figure of an exam: the errors that are judged over time, with their limit."""

import math
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.report import Report

LEAST_DEG = 1e-4        # lower limit of the logarithmic axes: below it, there is no error
# Marks whose limit holds for the errors of the outcomes.
LIMITS = 'noisy_deg', 'error_rms_deg', 'field_rms_deg', 'data_rms_deg'


def draw_page(report: Report, path: Path) -> None:
    """Draw what `examine` has returned into a new file, whose suffix decides the format."""
    limit = next((report.marks[name].limit for name in LIMITS if name in report.marks), math.nan)
    with rc_context({'text.parse_math': False}):        # names of a filter may contain '$'
        figure = Figure(figsize=(11.0, 4.0), layout='constrained')
        figure.suptitle(str(report).splitlines()[0])
        for axes, name in zip(figure.subplots(1, 2), ('tilt', 'heading'), strict=True):
            for outcome in report.outcomes:
                errors = errors_of(outcome.estimates, outcome.run.truth)
                error = getattr(errors if report.absolute else errors.about_mean(), name)
                error = np.maximum(np.degrees(np.abs(error)), LEAST_DEG)
                axes.semilogy(np.cumsum(outcome.run.dt), error, linewidth=0.8,
                              label=outcome.run.name)
            axes.axhline(limit, color='0.5', linestyle=':', label='limit of the rms')
            axes.set(ylabel=f'{name} error [deg]', xlabel='time that is judged [s]')
            axes.yaxis.set_major_formatter('{x:g}')         # the default is TeX
            axes.tick_params(which='minor', labelleft=False)
            axes.legend(fontsize=7)
        figure.savefig(path, format=path.suffix[1:] or 'png', dpi=110)
