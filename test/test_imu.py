# SPDX-License-Identifier: Apache-2.0
"""The IMU: kinematics against differences of the exact pose, and how its errors are drawn."""


import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import SECOND, run
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


def test_one_imu_has_one_noise_and_one_bias_at_all_rates():
    values = {'imu.rate': 100.0, 'imu_data.rate': 250.0}
    _, found = run({**NOISY, **values}, SECOND, 'imu/data_raw', 'imu/data')
    raw, data = (dict(zip(times_ns.tolist(), np.hstack((rates, force)), strict=True))
                       for times_ns, *_, rates, force in found.values())
    common = raw.keys() & data.keys()
    assert len(common) >= 4 and len(data) == 251
    assert all(np.array_equal(raw[t_ns], data[t_ns]) for t_ns in common)
