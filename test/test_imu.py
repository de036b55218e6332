# SPDX-License-Identifier: Apache-2.0
"""The IMU: kinematics against differences of the exact pose, and how its errors are drawn."""


import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import SECOND, read, run
from scipy.spatial.transform import Rotation

from spinning_top_sim import solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Mounting

# Central differences of order 8 (Fornberg, Math. Comp. 51 (1988) 699-706).
FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
TWICE = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])
NOISY = {'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 2e-4,
         'imu.accelerometer_noise_density': 2e-2, 'imu.accelerometer_random_walk': 3e-3,
         'imu.gyroscope_turn_on_bias': 0.01, 'imu.accelerometer_turn_on_bias': 0.05}


@pytest.mark.parametrize('scene', SCENES)
def test_readings_are_the_derivatives_of_the_exact_pose(scene):
    """Rates and specific force at a mounted sensor, where the differences are most exact."""
    lever_arm = (0.1, -0.05, 0.08)
    values = parameters.checked({**scene_parameters(scene), 'imu.lever_arm': lever_arm,
                                 'imu.rpy': (0.3, -0.7, 1.9)})
    top, start = parameters.top_of(values), parameters.start_state(values)
    sensor, motion = Mounting(values), ExactSolution(top, start)
    mounting = Rotation.from_euler('xyz', values['imu.rpy'])
    for t in (0.31, 4.05):
        states = motion.states(np.array([round(t * 1e9)]))
        rates, force = (np.ravel(part) for part in sensor.felt(states))
        step = 2e-2 / (np.abs(states.angular_velocity).max() + 20.0)
        times = round(t * 1e9) * 1e-9 + step * np.arange(-4, 5)
        turned = Rotation.from_quat(solve(top, start, times).quaternion)
        middle = turned[4] * mounting
        vectors = (turned[4].inv() * turned).as_rotvec()
        expected_rates = mounting.inv().apply(FIRST @ vectors / step)
        scale = 1.0 + np.linalg.norm(expected_rates)
        assert rates == pytest.approx(expected_rates, abs=1e-7 * scale)
        positions = turned.apply(lever_arm)
        acceleration = TWICE @ positions / step ** 2
        expected_force = middle.inv().apply(acceleration + np.array((0.0, 0.0, top.gravity)))
        scale = 1.0 + np.linalg.norm(expected_force)
        assert force == pytest.approx(expected_force, abs=1e-7 * scale)
        turned = Rotation.from_quat(np.ravel(sensor.orientation(states)))
        assert (turned.inv() * middle).magnitude() < 1e-12


@pytest.mark.parametrize(('rate', 'other'), [(100.0, 250.0), (1000.0, 40.0)])
def test_one_imu_has_one_noise_and_one_bias_at_all_rates(rate, other):
    values = {'imu.rate': rate, 'imu_data.rate': other}
    _, found = run({**NOISY, **values}, SECOND, 'imu/data_raw', 'imu/data',
                   'ground_truth/imu_bias')
    raw, data, bias = (dict(zip(times_ns.tolist(), np.hstack((rates, force)), strict=True))
                       for times_ns, *_, rates, force in found.values())
    common = raw.keys() & data.keys()
    assert len(common) >= 4 and len(data) == 1 + other
    assert all(np.array_equal(raw[t_ns], data[t_ns]) for t_ns in common)


@pytest.mark.parametrize(('limit', 'step'), [
    (4.0, 0.3), (34.9066, 1.06423e-3), (0.3, 0.1), (1.0, 3.0), (7.0, 7.0), (1e12, 1e-12)])
def test_no_reading_is_beyond_the_range_or_off_the_grid_of_the_resolution(limit, step):
    values = limit * np.array([-3.0, -1.0, -0.999, 0.999, 1.0, 1.001, -1e-26, 1e6])
    found, _ = read({'imu.gyroscope_range': limit, 'imu.gyroscope_resolution': step,
                     'imu.accelerometer_range': limit}, range(8), 2 * ((values,) * 3,))
    assert np.abs(found).max() <= limit
    codes = found[:, :3] / step
    assert np.abs(codes - np.rint(codes)).max() <= 1e-9 * max(1.0, np.abs(codes).max())
    # Less than a step is lost, and both ends are alike.
    assert limit - found[-1, 0] < step and found[0, 0] == -found[-1, 0]
    assert not np.signbit(found[-2, :3]).any(), 'no reading is -0'
    assert found[-1, 3] == limit and np.array_equal(found[2:4, 3], values[2:4])
