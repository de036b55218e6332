# SPDX-License-Identifier: Apache-2.0
"""A pivot that moves: paths as parameters, commanded velocities, and what is sent about it."""

import json
import math

import numpy as np
import pytest
from helpers.reference import RIDES, scene_parameters
from helpers.simulations import drive, run, simulate

from spinning_top_sim.physics import attitude
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.events import Event

S = 10 ** 9
SHUTTLE = {'pivot.waypoints': (0.0, 0.0, 0.0, 2.0, 1.0, 0.5), 'pivot.speed': 1.5,
           'pivot.acceleration': 2.0, 'pivot.repeat': True, 'solver.method': 'exact'}
ODOMETRY, IMU = 'ground_truth/odom', 'ground_truth/imu'


def goes_to(simulation, t_ns):
    """Let the motion go on; return position and velocity of the pivot (3,) there."""
    list(simulation.play((), t_ns))
    place = simulation.trajectory.pivot_at(np.array([t_ns]))
    return place.position[:, 0], place.velocity[:, 0]


def test_a_driven_pivot_goes_to_the_velocity_and_stops():
    simulation = simulate({'solver.method': 'exact', 'pivot.cmd_timeout': 1.0})
    goes_to(simulation, S)
    assert simulation.drive_details((0.0, 0.0, 0.0)) is None, 'it rests'
    drive(simulation, 0.0, 0.8, 0.0)
    for t_ns in (3 * S // 2, 11 * S // 5):
        goes_to(simulation, t_ns)
        drive(simulation, 0.0, 0.8, 0.0)            # to repeat it only lasts longer
    event = Event.from_mapping(json.loads(*simulation.history))
    assert (event.t_ns, event.details['stop_ns']) == (S, 16 * S // 5)
    assert not Event('drive', 16 * S // 5, 0, event.details).repeats(event), 'it brakes then'
    assert simulation.trajectory.starts(S + S // 2, 3 * S) == []
    position, velocity = goes_to(simulation, 10 * S)
    # Half a ramp of 0.4 s at each end, and 1.8 s of cruise.
    assert position == pytest.approx((0.0, 0.8 * 2.2, 0.0), abs=1e-12) and not velocity.any()
    # Repeated while it brakes, it is another command: the pivot goes on from there.
    drive(simulation, 0.0, 0.8, 0.0)
    before = goes_to(simulation, 11 * S + S // 5)
    drive(simulation, 0.0, 0.8, 0.0)
    after = goes_to(simulation, simulation.sent_ns)
    assert 0.0 < before[1][1] < 0.8 and len(simulation.history) == 3
    assert np.array_equal(before, after)
    drive(simulation, 0.0, 0.8, 0.4)        # another velocity along one axis alone
    position, velocity = goes_to(simulation, 12 * S)
    assert velocity.tolist() == [0.0, 0.8, 0.4] and position[1] > after[0][1]


def test_a_command_that_ends_within_its_ramp_leaves_the_pivot_at_rest():
    simulation = simulate({'pivot.cmd_timeout': 0.1})
    drive(simulation, 0.0, 0.8, 0.0)                # a ramp of 0.4 s, of which 0.1 s up and down
    position, velocity = goes_to(simulation, S)
    assert position == pytest.approx((0.0, 0.02, 0.0), abs=1e-12) and not velocity.any()
    drive(simulation, 0.8, 0.0, 0.0)
    goes_to(simulation, S + S // 20)
    drive(simulation, 0.0, 0.8, 0.0)                # while it moves
    assert goes_to(simulation, 2 * S)[0][0] == pytest.approx(0.0152490769, rel=1e-8)


def momenta(states):
    """Return L3 and Lz about the vertical of the world, by attitude and angular velocity."""
    top, (w1, w2, w3) = states.top, states.angular_velocity[0]
    z1, z2, z3 = (float(part[0]) for part in states.rows_vertical)
    return top.lambda3 * w3, top.lambda1 * (w1 * z1 + w2 * z2) + top.lambda3 * w3 * z3


def test_spin_counts_about_the_vertical_of_the_world():
    simulation = simulate(SHUTTLE)
    goes_to(simulation, 2 * S)                      # it brakes
    present = momenta(before := simulation.state())
    assert simulation.trajectory.momenta(2 * S) == pytest.approx(present, rel=1e-13)
    assert abs(present[1] - parameters.start_state(simulation.values_at_start).lz) > 0.01
    simulation.apply('command', l3=1.2, lz=0.9)
    after = simulation.state()
    assert abs(before.quaternion - after.quaternion).max() < 4e-15
    assert (*momenta(after), after.theta_dot[0]) == pytest.approx(
        (1.2, 0.9, before.theta_dot[0]), rel=1e-14)


@pytest.mark.parametrize(('scene', 'expected'), [
    ('shuttle', (9.80665, math.hypot(9.80665, 2.0))), ('elevator', (7.80665, 11.80665)),
    ('free_fall', (0.0, 2 * 9.80665)), ('braking', (9.80665, math.hypot(9.80665, 8.0)))])
def test_a_scene_with_a_moving_pivot_feels_its_acceleration(scene, expected):
    assert scene in RIDES
    simulation, found = run(scene_parameters(scene), 9 * S, IMU, ODOMETRY, 'pose', '/tf')
    assert simulation.trajectory.top.is_realizable
    assert len(simulation.trajectory.starts(0, 9 * S)) < 10         # the others are forgotten
    # One place, which has the velocity in the body.
    _, _, position, q, velocity, _ = found[ODOMETRY]
    for topic in ('pose', '/tf'):
        assert [*map(np.array_equal, found[topic][2:], (position, q))] == [True, True]
    speed = simulation.trajectory.pivot_at(np.array([9 * S])).velocity[:, 0]
    assert np.ravel(attitude.rotated(q[-1], velocity[-1])) == pytest.approx(speed, abs=1e-14)
    sizes = np.linalg.norm(found[IMU][-1], axis=1)
    assert (sizes.min(), sizes.max()) == pytest.approx(expected, rel=1e-15, abs=1e-30)
