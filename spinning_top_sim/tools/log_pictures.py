# SPDX-License-Identifier: Apache-2.0
"""Pictures of the samples in a log, as a solution is drawn."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from matplotlib.animation import PillowWriter

from spinning_top_sim import pictures
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.tools.analysis import Attitudes
from spinning_top_sim.tools.survey import MotionReport, Survey

FRAMES_PER_S, LONGEST_S, GIF_PIXELS = 20, 10.0, 640
MOST_NAMES = 3              # of motions in a title


def draw_page(found: Survey, path: Path) -> None:
    """Draw a page about all motions that are measured in a log."""
    columns, drift = _columns(found.shown)
    first_ns = found.shown[0][1].stamps_ns[0]
    begins = [(data.stamps_ns[0] - first_ns) / NANOSECONDS for _, data in found.shown[1:]]
    figure = pictures.plot(columns, drift, begins)
    names = [motion.exact.name if motion.exact else 'motion' for motion, _ in found.shown]
    others = ', ...' if len(names) > MOST_NAMES else ''
    figure.suptitle(f'{found.path.name}: {", ".join(names[:MOST_NAMES])}{others} '
                    f'({len(names)} of {len(found.motions)} motions, {columns.t[-1]:.4g} s)',
                    fontsize=14)
    figure.savefig(path, format=path.suffix[1:] or 'png', dpi=120)


def animate(found: Survey, path: Path) -> None:
    """Draw the turning top in the begin of the first motion as a GIF."""
    motion, data = found.shown[0]
    begin = data.first(max(2, int(np.searchsorted(data.time, LONGEST_S, 'right'))))
    pictures.animate(_columns([(motion, begin)])[0], FRAMES_PER_S).save(
        path, writer=PillowWriter(fps=FRAMES_PER_S), dpi=GIF_PIXELS / 4.0)     # of 4 inches


def _columns(shown: Sequence[tuple[MotionReport, Attitudes]],
             ) -> tuple[SimpleNamespace, pictures.Reals]:
    """Return the columns of `States` that are drawn, and the drift of the energy in a motion."""
    every = [data for _, data in shown]
    first_ns = every[0].stamps_ns[0]
    drifts = []
    for motion, data in shown:
        constants = data.constants(motion.piece.top)    # None in a log of poses alone
        drifts.append(np.full(len(data.time), np.nan) if constants is None
                      else relative_drift(constants[0], constants[0][:1]))
    return SimpleNamespace(
        t=np.concatenate([(data.stamps_ns - first_ns) / NANOSECONDS for data in every]),
        quaternion=np.concatenate([np.stack(data.quaternion, axis=-1) for data in every]),
        rows_axis=tuple(np.concatenate(rows) for rows in zip(*(
            (data.tip.real, data.tip.imag, data.height) for data in every), strict=True)),
        theta_folded=np.concatenate(
            [np.arctan2(np.abs(data.tip), data.height) for data in every]),
        phi_dot=np.concatenate([np.full(len(data.time), np.nan) if data.phi_dot is None
                                else data.phi_dot for data in every])), np.concatenate(drifts)
