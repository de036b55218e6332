#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Draw the pictures of README and docs/: `python docs/figures.py` (extra `plot`).

motions.png shows three motions, cubic.png their cubics, poles.png the angles of SciPy's steps
where the axis passes the vertical, inspect.png a page of `inspect --plot`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

from spinning_top_sim import scene
from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State
from spinning_top_sim.pictures import INK, draw_sphere, draw_tip
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import inspect, simulate

HERE = Path(__file__).parent
# Caption, file in config/, nutations shown.
PANELS = (('cusps: released from rest', 'cusp', 5), ('loops: pushed backwards', 'looping', 5),
          ('waves: pushed forwards', 'wavy', 5))


def motions(path):
    """Draw the three motions of the axis' tip."""
    figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.5))
    for axes, (caption, name, nutations) in zip(panels, PANELS, strict=True):
        top, start = scene(name)
        solution = ExactSolution(top, start)
        facts = solution.describe()
        t = np.linspace(0.0, nutations * facts.nutation_period, 4000)
        draw_sphere(axes, (facts.theta_min, facts.theta_max, np.pi / 2))
        draw_tip(axes, np.column_stack(solution.states(t).rows_axis))
        axes.text(0.0, 1.1, caption, ha='center', color=INK, fontsize=12)
        axes.text(0.0, -0.82, f'θ from {np.degrees(facts.theta_min):.1f}° to '
                  f'{np.degrees(facts.theta_max):.1f}° every {facts.nutation_period:.2f} s',
                  ha='center', color=INK, fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def page_about_a_log(path):
    """Draw the page of `inspect --plot` for a quarter of a minute of cusps."""
    with tempfile.TemporaryDirectory() as folder:
        log = f'{folder}/cusp.mcap'
        simulate.main(['-o', log, '--duration', '15', '--quiet',
                       '-p', 'imu.gyroscope_noise_density:=0.01',
                       '-p', 'imu.accelerometer_noise_density:=0.05'])
        path.unlink(missing_ok=True)
        assert inspect.main([log, '--plot', str(path)]) == 0


def cubic(path):
    """Draw the cubic u'^2 = f(u) of the three motions, and where the precession changes sign."""
    figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.0), sharey=True)
    u = np.linspace(-0.2, 1.1, 400)
    for axes, (caption, name, _) in zip(panels, PANELS, strict=True):
        top, start = scene(name)
        half = 0.5 * start.theta
        f0, f1, f2, f3 = nutation_cubic(top.lambda1, top.gravity_torque, start.l3, start.lz,
                                        start.theta_dot, np.sin(half), np.cos(half))
        y = u - np.cos(start.theta)
        f = f0 + y * (f1 + y * (f2 + y * f3))
        axes.plot(u, f, color=INK)
        axes.fill_between(u, 0.0, f, where=(f > 0.0) & (u < 1.0), alpha=0.3)
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.axvline(1.0, color='0.6', linewidth=0.8)
        axes.axvline(start.lz / start.l3, color='C1', linestyle='--', linewidth=1.0)
        axes.set(title=caption, xlabel='u = cos θ', ylim=(-8.0, 8.0))
    panels[0].set_ylabel("f(u) = u'² [1/s²]")
    panels[0].text(0.84, -6.8, 'Lz/L3', color='C1', ha='right', fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def poles(path):
    """Draw φ and φ + ψ where the axis passes the vertical closely, exact and by SciPy's RK45."""
    top, l3 = scene('cusp')[0], 1.0
    lz, t = l3 + 5e-7, np.linspace(0.0, 2.0, 2001)
    start = State(theta=1.0, theta_dot=-4.0, l3=l3, lz=lz)
    exact = ExactSolution(top, start).states(t)

    def equations(_, y):
        theta, theta_dot, _, _ = y
        phi_dot = (lz - l3 * np.cos(theta)) / (top.lambda1 * np.sin(theta) ** 2)
        return (theta_dot, phi_dot ** 2 * np.sin(theta) * np.cos(theta)
                - l3 / top.lambda1 * phi_dot * np.sin(theta)
                + top.gravity_torque / top.lambda1 * np.sin(theta),
                phi_dot, l3 / top.lambda3 - phi_dot * np.cos(theta))

    stepped = solve_ivp(equations, (0.0, 2.0), (1.0, -4.0, 0.0, 0.0), t_eval=t, rtol=1e-6,
                        atol=1e-6).y
    figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.0))
    for axes, title, right, wrong in zip(
            panels, ('θ', 'φ', 'φ + ψ'), (exact.theta, exact.phi, exact.phi + exact.psi),
            (stepped[0], stepped[2], stepped[2] + stepped[3]), strict=True):
        axes.plot(t, right, color=INK, label='exact')
        axes.plot(t, wrong, color='C1', linestyle='--', label='SciPy RK45, rtol 1e-6')
        axes.set(title=f'{title} [rad]', xlabel='t [s]')
    panels[0].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    """Draw all pictures."""
    motions(HERE / 'motions.png')
    page_about_a_log(HERE / 'inspect.png')
    cubic(HERE / 'cubic.png')
    poles(HERE / 'poles.png')


if __name__ == '__main__':
    main()
