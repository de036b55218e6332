#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/motions.png, the picture of the README: `python docs/figures.py` (extra `plot`)."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from spinning_top_sim import solve
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import describe
from spinning_top_sim.streams import parameters

HERE = Path(__file__).parent
# Caption, file in config/, nutations shown.
PANELS = (('cusps: let go from rest', 'cusp', 5), ('loops: pushed backwards', 'looping', 5),
          ('waves: pushed forwards', 'wavy', 5))
ELEVATION, AZIMUTH = np.radians(45.0), np.radians(-60.0)
INK, FAINT, PATH = '#1b1b1b', '#c9c9c9', '#0b6fa4'


def scene(name):
    """Return top and start state of a scene; its file is flat, a name and a value a line."""
    values = {}
    for line in (HERE.parent / 'config' / f'{name}.yaml').read_text().splitlines():
        key, _, value = line.partition('#')[0].strip().partition(': ')
        if key in parameters.BY_NAME:
            values[key] = float(value)
    values = parameters.checked(values)
    return parameters.top_of(values), parameters.start_state(values)


def seen(x, y, z):
    """Return the picture coordinates of points on the unit sphere, and their nearness."""
    across = -np.sin(AZIMUTH) * x + np.cos(AZIMUTH) * y
    towards = np.cos(AZIMUTH) * x + np.sin(AZIMUTH) * y
    return (across, np.cos(ELEVATION) * z - np.sin(ELEVATION) * towards,
            np.cos(ELEVATION) * towards + np.sin(ELEVATION) * z)


def draw(axes, points, **style):
    """Draw a curve on the sphere: what lies behind it faintly."""
    across, up, near = seen(*points)
    for visible, alpha in ((near >= 0.0, 1.0), (near < 0.0, 0.25)):
        axes.plot(np.where(visible, across, np.nan), np.where(visible, up, np.nan),
                  alpha=alpha, **style)


def circle(theta):
    """Return the circle of one tilt."""
    phi = np.linspace(0.0, 2.0 * np.pi, 400)
    return np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.full(400, np.cos(theta))


def main():
    """Draw the three motions of the axis' tip."""
    figure, panels = plt.subplots(1, 3, figsize=(10.5, 3.5))
    for axes, (caption, name, nutations) in zip(panels, PANELS, strict=True):
        top, start = scene(name)
        period = solve(top, start, [0.0]).solution.nutation_period
        motion = solve(top, start, np.linspace(0.0, nutations * period, 4000))
        facts = describe(top, start, motion.solution)
        outline = np.linspace(0.0, 2.0 * np.pi, 400)
        above = np.sin(outline) > -0.7
        axes.plot(np.where(above, np.cos(outline), np.nan), np.sin(outline), color=FAINT,
                  linewidth=1.0)
        for theta in (facts.theta_min, facts.theta_max, np.pi / 2):
            draw(axes, circle(theta), color=FAINT, linewidth=0.8)
        tip, height = attitude.axis_in_world(motion.alpha, motion.beta)
        draw(axes, (tip.real, tip.imag, height), color=PATH, linewidth=1.8)
        across, up, _ = seen(tip.real[-1], tip.imag[-1], height[-1])
        axes.plot([0.0, across], [0.0, up], color=INK, linewidth=2.2, solid_capstyle='round')
        axes.plot([across], [up], 'o', color=INK, markersize=5)
        axes.text(0.0, 1.1, caption, ha='center', color=INK, fontsize=12)
        axes.text(0.0, -0.82, f'θ from {np.degrees(facts.theta_min):.1f}° to '
                  f'{np.degrees(facts.theta_max):.1f}° every {facts.nutation_period:.2f} s',
                  ha='center', color=INK, fontsize=9)
        axes.set_aspect('equal')
        axes.set_xlim(-1.1, 1.1)
        axes.set_ylim(-0.9, 1.25)
        axes.axis('off')
    figure.tight_layout()
    figure.savefig(HERE / 'motions.png', dpi=110)


if __name__ == '__main__':
    main()
