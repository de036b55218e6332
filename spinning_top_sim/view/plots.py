# SPDX-License-Identifier: Apache-2.0
"""The plots beside the scene."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.topics import INVARIANTS
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view import shapes
from spinning_top_sim.view.svg import Line, Plot
from spinning_top_sim.view.track import (
    PRECESSION,
    Series,
    Track,
    effective_potential,
    energies,
)

Reals = NDArray[np.float64]
POINTS = 400                    # in a line at most
LEAST = 1e-17                   # is drawn for 0 on a logarithmic axis
BLUE, RED, GREEN, VIOLET = '#1c6dd0', '#d9482b', '#1e8a4c', '#7a52b3'


class Plotted(NamedTuple):
    """A track, the stamp that is drawn, the span that is plotted, and the stamp of t = 0 [ns]."""

    track: Track
    stamp_ns: int
    begin_ns: int
    end_ns: int
    epoch_ns: int

    def seconds(self, stamps_ns: NDArray[np.int64]) -> Reals:
        """Return the times of stamps (n,) [ns] since t = 0 [s]."""
        return (stamps_ns - self.epoch_ns) / NANOSECONDS

    def part(self, samples: Series) -> tuple[Reals, Reals]:
        """Return times (n,) [s] and rows (n, width) of some samples in the span."""
        stamps_ns, rows = samples.part(self.begin_ns, self.end_ns).thinned(POINTS)
        return self.seconds(stamps_ns), rows


def motion_plots(tops: Sequence[Plotted]) -> list[Plot]:
    """Return the plots of potential, energies, tilt and precession, as far as there are data."""
    potential, energy, tilt, rate = (list[Line]() for _ in range(4))
    for top, dash in zip(tops, ('', '5 3'), strict=False):
        potential += _potential(top, dash)
        stamps_ns, axis, _ = shapes.trace_points(top.track, top.begin_ns, top.end_ns)
        stamps_ns, axis = Series(stamps_ns, axis).thinned(POINTS)
        tilt.append(Line('θ', RED, top.seconds(stamps_ns), shapes.tilt(axis), dash))
        times, rows = top.part(top.track.rates)
        if len(rows):
            rate.append(Line('φ′', BLUE, times, rows[:, PRECESSION], dash))
            kinetic, height = energies(top.track.top, rows)
            energy += [Line('kinetic', RED, times, kinetic, dash),
                       Line('potential', BLUE, times, height, dash),
                       Line('sum', GREEN, times, kinetic + height, dash)]
    now = float(tops[0].seconds(np.array(tops[0].stamp_ns)))
    present = tops[0].track.attitudes.at(tops[0].stamp_ns)
    motion = tops[0].track.motion_at(tops[0].stamp_ns)
    theta = float(shapes.tilt(shapes.axis_of(present[1]))[0]) if present else math.nan
    return [plot for plot in (
        Plot('Effective potential V(θ)', 'tilt θ [deg]', 'V [J]', potential, theta,
             motion.energy if motion and motion.description else math.nan, 'tilt'),
        Plot('Energy', 'time t [s]', 'E [J]', energy, now),
        Plot('Tilt', 'time t [s]', 'θ [deg]', tilt, now),
        Plot('Precession rate', 'time t [s]', 'φ′ [rad/s]', rate, now)) if plot.lines]


def accuracy_plots(tops: Sequence[Plotted]) -> list[Plot]:
    """Return the plots of the drift of the energy and of the error of the orientation."""
    now = float(tops[0].seconds(np.array(tops[0].stamp_ns)))
    parts = [top.part(top.track.samples['~/invariants']) for top in tops]
    return [Plot(title, 'time t [s]', y_label, [
        Line('', RED, times, np.log10(np.maximum(np.abs(rows[:, column]), LEAST)), dash)
        for (times, rows), dash in zip(parts, ('', '5 3'), strict=False)], now)
        for title, y_label, column in (
            ('Energy drift, relative', 'log₁₀', INVARIANTS.index('energy_drift')),
            ('Orientation error', 'log₁₀ [rad]', INVARIANTS.index('orientation_error')))]


def _potential(top: Plotted, dash: str) -> list[Line]:
    """Return V around the bounds of theta, the energy of the axis, and the turning points."""
    motion = top.track.motion_at(top.stamp_ns)
    if motion is None or motion.description is None:
        return []
    body, (l3, lz) = top.track.top, (motion.l3, motion.lz)
    theta = np.linspace(1e-3, math.pi - 1e-3, 2000)
    values = effective_potential(body, l3, lz, theta)
    depth = max(motion.energy - float(values.min()), 0.05 * abs(body.gravity_torque),
                1e-6 * abs(motion.energy))
    shown = np.flatnonzero(values <= motion.energy + depth)
    theta = np.linspace(theta[shown[0]], theta[shown[-1]], POINTS // 2)
    bounds = np.array([motion.description.theta_min, motion.description.theta_max])
    with np.errstate(all='ignore'):         # at the poles V may be infinite
        heights = effective_potential(body, l3, lz, bounds)
    turning = bounds[np.abs(heights - motion.energy) < 1e-3 * depth]
    inside = np.degrees(np.clip(bounds, theta[0], theta[-1]))
    return [Line('V', BLUE, np.degrees(theta), effective_potential(body, l3, lz, theta), dash),
            Line('E − L₃²/2λ₃', GREEN, inside, np.full(2, motion.energy), dash),
            Line('turning points', VIOLET, np.degrees(turning),
                 np.full(len(turning), motion.energy), dots=True)]
