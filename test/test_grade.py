# SPDX-License-Identifier: Apache-2.0
"""The grade of simulators: measures, faults by name, right simulators, bad answers."""

from spinning_top_sim import solve
from spinning_top_sim.grade import grade


def exact(top, start, times, dt):
    motion = solve(top, start.state, times)
    return {'attitudes': motion.quaternion[:, [3, 0, 1, 2]], 'rates': motion.angular_velocity}


def test_the_exact_solution_passes():
    report = grade(exact)
    assert report.passed, report
    assert report.marks['total_error_deg: cusps'] < 1e-12
