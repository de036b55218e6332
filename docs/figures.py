#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Draw the pictures of the README: `python docs/figures.py` (extra `plot`).

docs/motions.png shows three motions; docs/inspect_cusp.png is a page of `inspect --plot`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from spinning_top_sim.physics.pictures import INK, draw_sphere, draw_tip
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import inspect, simulate

HERE = Path(__file__).parent
# Caption, file in config/, nutations shown.
PANELS = (('cusps: released from rest', 'cusp', 5), ('loops: pushed backwards', 'looping', 5),
          ('waves: pushed forwards', 'wavy', 5))


def scene(name):
    """Return top and start state of a scene; each line of its file has a name and a value."""
    values = {}
    for line in (HERE.parent / 'config' / f'{name}.yaml').read_text().splitlines():
        key, _, value = line.partition('#')[0].strip().partition(': ')
        if key in parameters.BY_NAME:
            values[key] = float(value)
    values = parameters.checked(values)
    return parameters.top_of(values), parameters.start_state(values)


def motions(path):
    """Draw the three motions of the axis' tip."""
    figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.5))
    for axes, (caption, name, nutations) in zip(panels, PANELS, strict=True):
        top, start = scene(name)
        solution = ExactSolution(top, start)
        facts = solution.describe()
        t = np.linspace(0.0, nutations * facts.nutation_period, 4000)
        draw_sphere(axes, (facts.theta_min, facts.theta_max, np.pi / 2))
        x, y, z = solution.states_at_seconds(t).rows_axis
        draw_tip(axes, x + 1j * y, z)
        axes.text(0.0, 1.1, caption, ha='center', color=INK, fontsize=12)
        axes.text(0.0, -0.82, f'θ from {np.degrees(facts.theta_min):.1f}° to '
                  f'{np.degrees(facts.theta_max):.1f}° every {facts.nutation_period:.2f} s',
                  ha='center', color=INK, fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def page_about_a_log(path):
    """Draw the page of `inspect --plot` for half a minute of cusps."""
    with tempfile.TemporaryDirectory() as folder:
        log = f'{folder}/cusp.mcap'
        simulate.main(['-o', log, '--duration', '30', '--quiet',
                       '-p', 'imu.gyroscope_noise_density:=0.01',
                       '-p', 'imu.accelerometer_noise_density:=0.05'])
        inspect.main([log, '--plot', str(path)])


def main():
    """Draw both pictures."""
    motions(HERE / 'motions.png')
    page_about_a_log(HERE / 'inspect_cusp.png')


if __name__ == '__main__':
    main()
