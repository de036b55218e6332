# SPDX-License-Identifier: Apache-2.0
"""The markers: a body with the top's inertia where the pose is, and a trace that is its path."""

import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import SECOND, run

from spinning_top_sim import solve
from spinning_top_sim.shape import Shape
from spinning_top_sim.streams import parameters


def axis_of(q):
    x, y, z, w = np.asarray(q).T
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]).T


@pytest.mark.parametrize(('values', 'count'), [
    *(({**scene_parameters(scene), 'solver.method': ('rk45', 'exact')[number % 2]}, 40)
      for number, scene in enumerate(SCENES)),
    ({'top.com_distance': -0.2}, 40), ({'markers.trace_length': 0.0}, 0),
    *(({'markers.trace_length': length, 'markers.trace_points': points}, count)
      for length, points, count in ((1e-9, 1, 1), (3e-9, 200, 3), (0.06, 7, 7)))])
def test_the_body_is_where_the_pose_is_and_the_trace_is_the_path_of_the_tip(values, count):
    """Evenly spaced, the newest point before the sample; before t = 0 it stands at the start."""
    simulation, found = run({'markers.trace_length': 1.0, 'markers.trace_points': 40, **values},
                            3 * SECOND // 2, 'markers', 'pose')
    times_ns, _, position, body, pivot, axis, *trace = found['markers']
    attitudes = found['pose'][3][::5]
    assert np.array_equal(body, attitudes) and np.array_equal(body, axis) and not pivot.any()
    top, start = simulation.trajectory.top, parameters.start_state(simulation.values_at_start)
    shape, length = Shape(top), simulation.values_at_start['markers.trace_length']
    assert position == pytest.approx(shape.centre * axis_of(body), abs=1e-15)
    assert bool(trace) == (count > 0)
    for points, q, t_ns in zip(*trace, body, times_ns, strict=True) if trace else ():
        spacing_ns = round(length * SECOND) // count
        newest = (t_ns - 1) // spacing_ns
        grid_ns = np.maximum(spacing_ns * np.arange(newest - count + 1, newest + 1), 0)
        exact = solve(top, start, grid_ns * 1e-9, method='exact')
        trace = points.reshape(count + 1, 3)
        assert trace[-1] == pytest.approx(shape.tip * axis_of(q), abs=1e-15)
        assert np.abs(trace[:-1] - shape.tip * axis_of(exact.quaternion)).max() < (
            1e-12 * abs(shape.tip))
