# SPDX-License-Identifier: Apache-2.0
"""Pictures of the samples in a log, as `States.plot` and `States.animate` draw a solution."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from matplotlib.animation import PillowWriter

from spinning_top_sim import pictures
from spinning_top_sim.tools.analysis import Attitudes
from spinning_top_sim.tools.survey import MotionReport

PAGE_NUTATIONS, PAGE_S = 8, 5.0     # duration of the page; in seconds without nutation
FRAMES_PER_S, LONGEST_S, GIF_PIXELS = 20, 10.0, 640


def draw_page(name: str, motion: MotionReport, data: Attitudes, path: Path) -> None:
    """Draw a page about the first samples of a motion in the log of this name."""
    assert motion.measured is not None
    period = motion.measured.nutation_period
    figure = pictures.plot(_columns(motion, data, PAGE_NUTATIONS * period if period else PAGE_S))
    figure.suptitle(f'{name}: {motion.exact.name if motion.exact else ""}', fontsize=14)
    figure.savefig(path, dpi=120)


def animate(_: str, motion: MotionReport, data: Attitudes, path: Path) -> None:
    """Draw the turning top as a GIF."""
    pictures.animate(_columns(motion, data, LONGEST_S), FRAMES_PER_S, 1.0).save(
        path, writer=PillowWriter(fps=FRAMES_PER_S), dpi=GIF_PIXELS / 4.0)     # of 4 inches


def _columns(motion: MotionReport, data: Attitudes, seconds: float) -> SimpleNamespace:
    """Return the first samples, at least two, with the columns of `States` that are drawn."""
    data = data.first(max(2, int(np.searchsorted(data.time, seconds, 'right'))))
    top = motion.piece.top
    unknown = np.full(len(data.time), np.nan)       # such as the rates in a log of poses alone
    constants = data.constants(top)
    return SimpleNamespace(
        t=data.time,
        quaternion=np.stack(data.quaternion, axis=-1),
        rows_axis=(data.tip.real, data.tip.imag, data.height),
        theta_folded=np.arccos(np.clip(data.height, -1.0, 1.0)),
        phi_dot=unknown if data.phi_dot is None else data.phi_dot,
        energy=unknown if constants is None else constants[0])
