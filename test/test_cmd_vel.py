# SPDX-License-Identifier: Apache-2.0
"""A pivot that moves: paths as parameters, commanded velocities, and what is sent about it."""

import json
import math
from importlib.util import find_spec

import numpy as np
import pytest
from helpers.reference import RIDES, scene_parameters
from helpers.simulations import play, stream
from helpers.simulations import simulate as simulated

from spinning_top_sim.physics import attitude
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import inspect, simulate

S = 10 ** 9
SHUTTLE = {'pivot.waypoints': (0.0, 0.0, 0.0, 2.0, 1.0, 0.5), 'pivot.speed': 1.5,
           'pivot.acceleration': 2.0, 'pivot.repeat': True}
METHODS = ('exact', 'rk45')


def test_the_specific_force_is_that_of_the_place_in_the_world():
    values = {'solver.method': 'exact', 'imu.lever_arm': (0.1, -0.2, 0.3),
              'ground_truth_imu.rate': 1000.0, 'ground_truth_imu_odom.enabled': True,
              'ground_truth_imu_odom.rate': 1000.0, **SHUTTLE}
    simulation = simulated(values)
    force, place = (np.vstack([stream(simulation, topic).template.decode(data)[number]
                               for _, _, data in taken]) for topic, number, taken in (
        ('ground_truth/imu', 2, play(simulated(values), S // 2, 'ground_truth/imu')),
        ('ground_truth/imu_odom', 0,
         play(simulated(values), S // 2, 'ground_truth/imu_odom'))))
    q = simulation.segment.states(range(0, S // 2 + 1, 10 ** 6)).rows_quaternion
    acceleration = (place[2:] - 2 * place[1:-1] + place[:-2]) * 1e6
    expected = attitude.rotated_back(tuple(part[1:-1] for part in q),
                                     tuple((acceleration + np.array((0.0, 0.0, 9.80665))).T))
    assert np.stack(expected, axis=-1) == pytest.approx(force[1:-1], abs=2e-2)


@pytest.mark.parametrize('method', METHODS)
def test_a_driven_pivot_goes_to_the_velocity_and_stops(method):
    simulation = simulated({'solver.method': method, 'pivot.cmd_timeout': 1.0})
    list(simulation.play((), S))
    assert simulation.drive((0.0, 0.0, 0.0)) is None and simulation.segment.ride is None
    assert simulation.drive((0.0, 0.8, 0.0)) == 2 * S
    list(simulation.play((), 3 * S // 2))
    segment = simulation.segment
    assert simulation.drive((0.0, 0.8, 0.0)) == 5 * S // 2      # to repeat it only lasts longer
    assert simulation.segment is segment and len(simulation.history) == 1
    list(simulation.play((), 10 * S))
    found = simulation.segment.pivot(np.array([simulation.now_ns]))
    assert not found.velocity.any() and not found.acceleration.any()
    # Half a ramp of 0.4 s at each end, and 1.1 s of cruise.
    assert np.ravel(found.position) == pytest.approx((0.0, 0.8 * 1.5, 0.0), abs=1e-12)
    assert simulation.history == [(S, 0.0, 0.8, 0.0, 5 * S // 2)]
    # Repeated while it brakes, it is another command: the pivot goes on from there.
    simulation.drive((0.0, 0.8, 0.0))
    list(simulation.play((), 11 * S + S // 5))
    before = simulation.segment.pivot(np.array([simulation.now_ns]))
    assert simulation.drive((0.0, 0.8, 0.0)) == 12 * S + S // 5
    after = simulation.segment.pivot(np.array([simulation.now_ns]))
    assert 0.0 < before.velocity[1] < 0.8 and len(simulation.history) == 3
    assert after.velocity[1] == before.velocity[1] and after.position[1] == before.position[1]


def test_a_velocity_of_zero_brakes_a_pivot_that_moves():
    simulation = simulated({'pivot.cmd_timeout': 0.0})
    for t_ns, velocity, found in ((S, 0.8, 0.0), (2 * S, 0.0, 0.8), (3 * S, 0.0, 0.0)):
        list(simulation.play((), t_ns))
        assert simulation.segment.pivot(np.array([t_ns])).velocity[1] == pytest.approx(found)
        assert simulation.drive((0.0, velocity, 0.0))


def test_a_storm_of_velocities_costs_the_same_from_first_to_last(monkeypatch):
    """Also with a filter that remembers all of them."""
    states, counts = ExactSolution.states, [0]

    def counted(motion, times):
        counts[-1] += len(times)
        return states(motion, times)
    monkeypatch.setattr(ExactSolution, 'states', counted)
    simulation = simulated({'solver.method': 'exact', 'imu.bandwidth': 1.0})
    imu = [stream(simulation, 'imu/data_raw')]
    simulation.drive((0.0, 0.0, 0.1))
    for k in range(1, 61):
        list(simulation.play(imu, k * S // 50))
        simulation.drive((0.1 * (k % 7), 0.2, 0.0))
        counts.append(0)
    assert max(counts[40:-1]) <= 1.2 * max(counts[1:10])
    assert simulation.imu.keep_ns > 60 * S // 50


@pytest.mark.parametrize('velocity', [(math.nan, 0, 0), (0, math.inf, 0), (0, 0, 1e5)])
def test_a_bad_velocity_is_refused_with_its_value(velocity):
    simulation = simulated()
    with pytest.raises(ValueError, match=r'linear = \[.*(nan|inf|100000).*within 10000 m/s'):
        simulation.drive(velocity)
    assert not simulation.history


def test_commands_of_the_spin_count_about_the_vertical_of_the_world():
    simulation = simulated({'solver.method': 'exact', **SHUTTLE})
    list(simulation.play((), S // 2))
    before = simulation.state()
    simulation.command(1.2, 0.9)
    after, top = simulation.state(), simulation.top
    assert abs(before.quaternion - after.quaternion).max() < 4e-15
    w1, w2, w3 = after.angular_velocity[0]
    z1, z2, z3 = (float(part[0]) for part in after.rows_vertical)
    lz = top.lambda1 * (w1 * z1 + w2 * z2) + top.lambda3 * w3 * z3
    assert lz == pytest.approx(0.9, rel=1e-14)
    assert top.lambda3 * w3 == pytest.approx(1.2, rel=1e-15)
    assert (simulation.l3, simulation.lz) == (1.2, 0.9)


@pytest.mark.parametrize('frame', ['world', 'map/θ', ''])
def test_a_transform_is_the_pose(frame):
    typesys = pytest.importorskip('rosbags.typesys')
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    values = {'solver.method': 'exact', 'tf.enabled': True, 'world_frame': frame, **SHUTTLE}
    sent = {topic: play(simulated(values), S, topic)[-1][2] for topic in ('/tf', 'pose')}
    (found,) = store.deserialize_cdr(sent['/tf'], 'tf2_msgs/msg/TFMessage').transforms
    pose = store.deserialize_cdr(sent['pose'], 'geometry_msgs/msg/PoseStamped')
    assert found.header == pose.header and found.header.frame_id == frame
    assert found.child_frame_id == 'base_link'
    for one, other in ((found.transform.translation, pose.pose.position),
                       (found.transform.rotation, pose.pose.orientation)):
        assert [getattr(one, axis) for axis in 'xyz'] == [getattr(other, axis) for axis in 'xyz']
    assert found.transform.translation.x > 0.1


def test_odometry_has_the_twist_in_the_frame_of_the_body():
    values = {'solver.method': 'exact', **SHUTTLE}
    simulation = simulated(values)
    (position, q, velocity, rates) = stream(simulation, 'ground_truth/odom').template.decode(
        play(simulation, S, 'ground_truth/odom')[-1][2])
    pivot, state = simulation.segment.pivot(np.array([S])), simulation.state()
    assert (position[0] == pivot.position[:, 0]).all() and (q == state.quaternion).all()
    assert (rates == state.angular_velocity).all()
    assert np.ravel(attitude.rotated(tuple(q.T), tuple(velocity.T))) == pytest.approx(
        pivot.velocity[:, 0], abs=1e-15)


@pytest.mark.parametrize('method', METHODS)
def test_rates_of_the_angles_are_their_derivatives_in_the_world(method):
    simulation = simulated({'solver.method': method, **SHUTTLE})
    simulation.segment.reach(S // 2, 10 ** 6)
    states = simulation.segment.states(range(S // 2 - 20_000_000, S // 2 + 1, 20_000))
    for angle, rate in ((states.phi, states.phi_dot), (states.theta, states.theta_dot),
                        (states.psi, states.psi_dot)):
        found = (np.unwrap(angle)[2:] - np.unwrap(angle)[:-2]) / 4e-5
        assert found == pytest.approx(rate[1:-1], rel=1e-6, abs=1e-6)
        assert np.ptp(rate) > 1e-3


def test_a_table_has_the_pivot(tmp_path):
    path = tmp_path / 'truth.csv'
    assert simulate.main(['--scene', 'shuttle', '--duration', '3', '--quiet', '-o',
                          str(path)]) == 0
    table = np.genfromtxt(path, delimiter=',', names=True)
    t = table['t_s']
    late = np.maximum(t - 2.0, 0.0)         # 2 m/s^2 for 2 s, 4 m/s for 0.5 s, then braking
    assert table['vx_ms'] == pytest.approx(
        2.0 * np.minimum(t, 2.0) - 2.0 * np.maximum(late - 0.5, 0.0), abs=1e-12)
    assert table['x_m'] == pytest.approx(
        np.minimum(t, 2.0) ** 2 + 4.0 * late - np.maximum(late - 0.5, 0.0) ** 2, abs=1e-12)
    assert not any(table[name].any() for name in ('y_m', 'z_m', 'vy_ms', 'vz_ms'))


@pytest.mark.parametrize('scene', RIDES)
def test_a_scene_with_a_moving_pivot_goes_on(scene):
    simulation = simulated(scene_parameters(scene))
    assert len(list(play(simulation, 20 * S, 'ground_truth/odom'))) == 2001
    assert simulation.top.is_realizable
    assert len(simulation.path._segments) < 10           # the others are forgotten
    force = simulated(scene_parameters(scene))
    readings = np.vstack([stream(force, 'ground_truth/imu').template.decode(data)[2]
                          for _, _, data in play(force, 9 * S, 'ground_truth/imu')])
    expected = {'shuttle': (9.80665, math.hypot(9.80665, 2.0)), 'elevator': (7.80665, 11.80665),
                'free_fall': (0.0, 2 * 9.80665),
                'braking': (9.80665, math.hypot(9.80665, 8.0))}[scene]
    sizes = np.linalg.norm(readings, axis=1)
    assert (sizes.min(), sizes.max()) == pytest.approx(expected, rel=1e-15, abs=1e-30)


@pytest.mark.parametrize('method', METHODS)
def test_a_driven_node_is_recorded_and_verified(tmp_path, method, capsys):
    msg = pytest.importorskip('geometry_msgs.msg')
    own_node = pytest.importorskip('helpers.own_node')

    def twist(linear, angular=0.0):
        return msg.Twist(linear=msg.Vector3(x=linear), angular=msg.Vector3(z=angular))

    receiver = {'gnss__enabled': True, 'gnss__latency': 0.05} if find_spec('pymap3d') else {}
    with own_node.OwnNode(tmp_path, solver__method=method, record__enabled=True,
                          pivot__cmd_timeout=0.2, **receiver) as top:
        node, told = top.node, []
        node.get_logger().warning = told.append
        for linear in (0.1, 0.7, 0.7, -0.3):
            for _ in range(50):             # a storm: the last one of a tick counts
                node._on_velocity(twist(linear))
            top.wait_until(top.simulation.now_ns + S // 10)
        assert top.simulation.segment.ride is not None
        refused = (twist(math.nan), twist(math.inf), twist(1e9), twist(0.0, 2.0))
        for message in refused:
            node._on_velocity(message)
        assert top.loop.rejected_commands == len(refused)
        top.wait_until(top.simulation.now_ns + S)
        rests = top.simulation.segment.pivot(np.array([top.simulation.now_ns]))
        assert not rests.velocity.any() and 4 <= top.loop.commands <= 10
    capsys.readouterr()
    assert inspect.main([str(tmp_path / 'run.mcap'), '--verify', '--json']) == 0
    said = json.loads(capsys.readouterr().out)
    assert said['verify']['identical']
    assert not receiver or (said['topics']['/gnss/fix']['missing'] == 0
                            and said['verify']['compared']['/gnss/fix'] > 10)
