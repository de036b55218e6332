# SPDX-License-Identifier: Apache-2.0
"""Pictures of a motion for notebooks."""

import re

import numpy as np
import pytest

from spinning_top_sim import State, Top, solve

pictures = pytest.importorskip('spinning_top_sim.pictures')
TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
CUSP = State(theta=0.5, l3=1.6, lz=float(1.6 * np.cos(0.5)))


def test_plot_draws_the_columns():
    motion = solve(TOP, CUSP, np.linspace(0.0, 4.0, 401))
    panels = {axes.get_ylabel() or axes.get_title(): axes for axes in motion.plot().axes}
    for label, expected in (
            ('tilt θ [deg]', np.degrees(motion.theta_folded)),
            ("rate φ' [rad/s]", motion.phi_dot),
            ('relative change [1]', (motion.energy - motion.energy[0]) / abs(motion.energy[0]))):
        line = panels[label].lines[0]
        assert (line.get_xdata() == motion.t).all() and (line.get_ydata() == expected).all()
    path = panels['path of the axis on the unit sphere'].lines[-2]
    assert (path.get_xdata()[1], path.get_ydata()[1]) == pytest.approx(
        [part[0] for part in pictures.project(np.stack(motion.rows_axis, axis=1)[-1:])[:2]])
    # The rounding noise of an exact motion is no curve.
    assert panels['relative change [1]'].get_ylim() == (-1e-12, 1e-12)


def test_animate_shows_samples_in_time():
    motion = solve(TOP, CUSP, np.linspace(0.0, 1.0, 101))
    for seconds, count in ((9.0, 11), (0.5, 6)):
        html = pictures.animate(motion, fps=10.0, seconds=seconds).to_jshtml()
        assert len(re.findall(r'frames\[\d+\] = ', html)) == count


@pytest.mark.parametrize(('times', 'argument', 'says'), [
    ([0.0], {}, 't has 1 times: a picture must have 2'),
    ([1.0, 0.5], {}, 't[1] = 0.5 s: must be later than t[0] = 1.0 s'),
    ([0.0, 1.0], {'fps': 0.0}, 'fps = 0.0')])
def test_what_makes_no_picture_is_refused(times, argument, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        pictures.animate(solve(TOP, CUSP, times), **argument)
