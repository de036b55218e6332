# SPDX-License-Identifier: Apache-2.0
"""The IMU: kinematics against differences of the exact pose, noise against its own numbers."""

import gc
import math
import random
import tracemalloc

import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import doubles, record, simulate, stream
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from spinning_top_sim import solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Imu, Sensor

# Central differences of order 8 (Fornberg, Math. Comp. 51 (1988) 699-706).
FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])
SECOND_NS = 1_000_000_000
PERIOD_NS = 5_000_000
NOISY = {'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 2e-4,
         'imu.accelerometer_noise_density': 2e-2, 'imu.accelerometer_random_walk': 3e-3,
         'imu.gyroscope_turn_on_bias': 0.01, 'imu.accelerometer_turn_on_bias': 0.05}


@pytest.mark.parametrize('scene', SCENES)
@pytest.mark.parametrize('lever_arm', [(0.0, 0.0, 0.0), (0.1, -0.05, 0.08)])
def test_readings_are_the_derivatives_of_the_exact_pose(scene, lever_arm):
    """Rates and specific force at a mounted sensor, where the differences are most exact."""
    values = parameters.checked({**scene_parameters(scene), 'imu.lever_arm': lever_arm,
                                 'imu.rpy': (0.3, -0.7, 1.9)})
    top, start = parameters.top_of(values), parameters.start_state(values)
    imu, motion = Imu(values), ExactSolution(top, start)
    mounting = Rotation.from_euler('xyz', values['imu.rpy'])
    for t in (0.31, 1.77, 4.05):
        states = motion.states(np.array([round(t * 1e9)]))
        rates, force = (np.ravel(part) for part in imu.true(states))
        step = 2e-2 / (np.abs(states.angular_velocity).max() + 20.0)
        times = round(t * 1e9) * 1e-9 + step * np.arange(-4, 5)
        turned = Rotation.from_quat(solve(top, start, times).quaternion)
        middle = turned[4] * mounting
        vectors = (turned[4].inv() * turned).as_rotvec()
        expected_rates = mounting.inv().apply(FIRST @ vectors / step)
        scale = 1.0 + np.linalg.norm(expected_rates)
        assert rates == pytest.approx(expected_rates, abs=1e-7 * scale)
        positions = turned.apply(lever_arm)
        acceleration = SECOND @ positions / step ** 2
        expected_force = middle.inv().apply(
            acceleration + np.array((0.0, 0.0, top.gravity)))
        scale = 1.0 + np.linalg.norm(expected_force)
        assert force == pytest.approx(expected_force, abs=1e-7 * scale)
        sensor = Rotation.from_quat(np.ravel(imu.orientation(states)))
        assert (sensor.inv() * middle).magnitude() < 1e-12


# ------------------------------------------------------------------------------------ by hand

def force_at(arm, theta, theta_dot=0.0, l3=0.0, lz=0.0):
    """Return the specific force at a place of the body, and the parameters."""
    values = parameters.checked({
        'initial.theta': theta, 'initial.theta_dot': theta_dot, 'spin.l3': l3, 'spin.lz': lz,
        'imu.lever_arm': arm})
    motion = ExactSolution(parameters.top_of(values), parameters.start_state(values))
    return np.ravel(Imu(values).true(motion.states(range(1)))[1]), values


@pytest.mark.parametrize('arm', [(0.0, 0.0, 0.0), (0.1, -0.05, 0.08)])
@pytest.mark.parametrize(('theta', 'expected'), [(0.0, 9.80665), (math.pi, -9.80665)])
def test_at_rest_it_reads_g_upwards(arm, theta, expected):
    """REP-145: standing and hanging, wherever it sits."""
    force, _ = force_at(arm, theta)
    assert force == pytest.approx((0.0, 0.0, expected), abs=1e-14)


def test_a_sleeping_top_adds_the_centripetal_acceleration():
    """omega^2 r towards the axis, with omega = L3/lambda3."""
    force, values = force_at((0.1, 0.0, 0.3), 0.0, l3=1.6, lz=1.6)
    omega = 1.6 / values['top.lambda3']
    assert force == pytest.approx((-0.1 * omega ** 2, 0.0, 9.80665), rel=1e-13, abs=1e-13)


def test_a_pendulum_reads_what_the_textbook_says():
    """
    Along the axis g cos(theta) - z theta'^2, across it z theta'' - g sin(theta).

    With theta'' = M g R sin(theta)/lambda1.  At the centre of percussion z = lambda1/(M R) nothing
    is read across the axis: there the body moves as a point mass would (Goldstein, Poole, Safko,
    "Classical Mechanics", 3rd ed., 2002, chapter 5).
    """
    theta, theta_dot, g = 0.7, 1.3, 9.80665
    values = parameters.checked({})
    torque = values['top.mass'] * g * values['top.com_distance'] * math.sin(theta)
    percussion = values['top.lambda1'] / (values['top.mass'] * values['top.com_distance'])
    for z in (0.1, percussion):
        force, _ = force_at((0.0, 0.0, z), theta, theta_dot)
        across = z * torque / values['top.lambda1'] - g * math.sin(theta)
        along = g * math.cos(theta) - z * theta_dot ** 2
        assert force == pytest.approx((across, 0.0, along), rel=1e-12, abs=1e-12)
    assert across == pytest.approx(0.0, abs=1e-14)


# -------------------------------------------------------------------------------------- noise

STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def read(sensor, times, exact=STILL):
    """Return readings and bias at these times, (n, 6) each."""
    return tuple(np.column_stack([np.broadcast_to(axis, len(times)) for kind in found
                                  for axis in kind])
                 for found in (sensor.read(exact, times), sensor.bias(times)))


def readings(values, count, period_ns=PERIOD_NS):
    """Return what an IMU at rest reads, (count, 6), its bias, and the sensor."""
    sensor = Sensor(parameters.checked(values), period_ns)
    return *read(sensor, range(0, count * period_ns, period_ns)), sensor


def test_noise_has_the_covariance_that_is_published():
    rows, biases, sensor = readings(NOISY, 40_000)
    white = rows - biases
    published = np.repeat([sensor.rate_variance, sensor.force_variance], 3)
    # A sample variance of n normal numbers has a relative deviation of sqrt(2/n): 5 of them.
    assert np.var(white, axis=0) == pytest.approx(published, rel=5.0 * math.sqrt(2.0 / 40_000))
    assert np.abs(np.mean(white, axis=0) / np.sqrt(published)).max() < 5.0 / math.sqrt(40_000)
    correlation = np.corrcoef(white.T) - np.eye(6)
    assert np.abs(correlation).max() < 5.0 / math.sqrt(40_000)
    density = np.repeat([1e-3, 2e-2], 3)
    assert published == pytest.approx(density ** 2 / 0.005)


def messages(values, duration_ns, *topics):
    """Return the messages of these topics, as (covariances, rows of rates and force)."""
    simulation = simulate(values)
    taken = record(simulation, *topics)
    simulation.advance(duration_ns)
    # The end of a sensor_msgs/Imu: rates, 9 covariances, force, 9 covariances.
    columns = {topic: np.array([doubles(data, 24) for name, _, data in taken if name == topic])
               for topic in topics}
    return {topic: (rows[0, [3, 7, 11, 15, 19, 23]], rows[:, [0, 1, 2, 12, 13, 14]])
            for topic, rows in columns.items()}


@pytest.mark.parametrize('resolution', [0.0, 1.0])
def test_what_is_added_is_distributed_as_the_message_says(resolution):
    """The errors over their published deviations: chi-square of as many degrees of freedom."""
    steps = {'imu.gyroscope_resolution': 1e-3 * resolution / math.sqrt(0.005),
             'imu.accelerometer_resolution': 2e-2 * resolution / math.sqrt(0.005)}
    found = messages({**NOISY, **steps, 'solver.method': 'exact', 'imu.lever_arm': (0.1, 0, 0)},
                     30_000_000_000, 'imu/data_raw', 'ground_truth/imu', 'ground_truth/imu_bias')
    covariances, raw = found['imu/data_raw']
    added = raw - found['ground_truth/imu'][1] - found['ground_truth/imu_bias'][1]
    squares = np.sum((added / np.sqrt(covariances)) ** 2, axis=0)
    assert len(added) == 6001
    low, high = chi2.ppf((1e-5, 1.0 - 1e-5), len(added))
    assert (low < squares).all() and (squares < high).all()
    whitened = added / np.sqrt(covariances)
    lagged = np.mean(whitened[1:] * whitened[:-1], axis=0)
    assert np.abs(lagged).max() < 5.0 / math.sqrt(len(added))


def errors(**noise):
    """Return white noise and bias of one second of samples, (n, 6) each."""
    values = {'imu.' + name: value for name, value in noise.items()}
    found = messages({**values, 'solver.method': 'exact'}, SECOND_NS, 'imu/data_raw',
                     'ground_truth/imu', 'ground_truth/imu_bias')
    bias = found['ground_truth/imu_bias'][1]
    return found['imu/data_raw'][1] - found['ground_truth/imu'][1] - bias, bias


def test_without_a_turn_on_bias_the_walk_begins_at_zero():
    _, bias = errors(gyroscope_random_walk=2e-4, accelerometer_random_walk=3e-3)
    assert np.all(bias[0] == 0.0)
    assert np.all(bias[1:] != 0.0)


def test_the_first_bias_is_the_turn_on_bias():
    turn_on = {'gyroscope_turn_on_bias': 0.01, 'accelerometer_turn_on_bias': 0.05}
    _, constant = errors(**turn_on)
    _, walking = errors(**turn_on, gyroscope_random_walk=2e-4, accelerometer_random_walk=3e-3)
    assert np.all(constant == constant[0]) and np.all(constant[0] != 0.0)
    assert np.array_equal(walking[0], constant[0])


def test_the_turn_on_bias_is_a_draw_of_its_own():
    """Over its deviation it is none of the numbers that noise and walk are made of."""
    _, bias = errors(gyroscope_turn_on_bias=1.0, accelerometer_turn_on_bias=1.0)
    # Deviations of 1 at the rate that the IMU has.
    density = math.sqrt(1.0 / parameters.checked({})['imu.rate'])
    white, _ = errors(gyroscope_noise_density=density, accelerometer_noise_density=density)
    _, walk = errors(gyroscope_random_walk=1.0 / density, accelerometer_random_walk=1.0 / density)
    numbers = np.concatenate((white.ravel(), walk.ravel(), np.diff(walk, axis=0).ravel()))
    assert np.abs(numbers[:, None] - bias[0]).min() > 1e-9
    assert 0.0 < np.abs(bias[0]).max() < 5.0 and np.ptp(bias[0]) > 0.1


def test_bias_walks_with_its_own_variance():
    _, biases, sensor = readings(NOISY, 40_000)
    steps = np.diff(biases, axis=0)
    walk = np.repeat([2e-4, 3e-3], 3) * math.sqrt(0.005)
    assert np.std(steps, axis=0) == pytest.approx(walk, rel=5.0 / math.sqrt(2.0 * 40_000))
    assert np.abs(np.mean(steps[:, :1] * steps[:, 1:2])) < 5.0 * walk[0] ** 2 / math.sqrt(40_000)
    # A random walk at every scale, and no seam between the blocks in which it is drawn.
    for apart in (1, 10, 100, 1000):
        far = (biases[apart:] - biases[:-apart])[::apart]
        assert np.std(far, axis=0) == pytest.approx(walk * math.sqrt(apart), rel=5.0 / math.sqrt(
            2.0 * len(far)))
    seams = np.flatnonzero(np.diff(np.arange(40_000) * 5 // 512))
    assert np.abs(steps[seams] / walk).max() < 5.0


def test_sample_k_depends_on_seed_and_k_alone():
    """Read forwards, backwards, at random, one by one and many together, across blocks of 512."""
    readings_at_once, biases, _ = readings(NOISY, 20_000)
    sensor = Sensor(parameters.checked(NOISY), PERIOD_NS)
    begins = [0, 102, 103, 511, 512, 1024, 19_999, *range(0, 19_000, 973)]
    for order in (begins, begins[::-1], random.Random(1).sample(begins, len(begins))):
        for begin in order:
            for count in (1, 2, 600):
                end = min(begin + count, 20_000)
                found, bias = read(sensor, range(begin * PERIOD_NS, end * PERIOD_NS, PERIOD_NS))
                assert np.array_equal(found, readings_at_once[begin:end])
                assert np.array_equal(bias, biases[begin:end])


def by_time(simulation, taken, topic):
    """Return the readings that were recorded of a stream: {t [ns]: rates and force, (6,)}."""
    decode = stream(simulation, topic).template.decode
    return {t_ns: np.ravel(decode(data)[1:]).tolist()
            for name, t_ns, data in taken if name == topic}


@pytest.mark.parametrize(('rate', 'other'), [(200.0, 100.0), (100.0, 250.0), (400.0, 400.0),
                                             (1000.0, 40.0), (125.0, 1000.0)])
def test_one_imu_has_one_noise_and_one_bias_at_all_rates(rate, other):
    simulation = simulate(NOISY, imu__rate=rate, imu_data__rate=other)
    taken = record(simulation)
    simulation.advance(3 * SECOND_NS)
    raw, data, bias = (by_time(simulation, taken, topic) for topic in (
        'imu/data_raw', 'imu/data', 'ground_truth/imu_bias'))
    common = raw.keys() & data.keys()
    assert len(common) >= 4 and len(data) == 1 + 3 * other
    assert all(raw[t_ns] == data[t_ns] for t_ns in common)
    # White noise about the one bias, in every sample of the other rate too.
    exact = simulate(imu_data__rate=other)
    taken = record(exact, 'imu/data')
    exact.advance(3 * SECOND_NS)
    truth = by_time(exact, taken, 'imu/data')
    path = Sensor(parameters.checked(NOISY), PERIOD_NS)
    white = np.repeat([1e-3, 2e-2], 3) * math.sqrt(rate)
    for t_ns, reading in data.items():
        (offset,) = read(path, range(t_ns, t_ns + 1))[1].tolist()
        assert bias.get(t_ns, offset) == offset
        assert np.abs((np.array(reading) - truth[t_ns] - offset) / white).max() < 5.5


def test_a_change_of_the_rate_leaves_the_bias_on_its_path():
    def biases(*rates):
        simulation = simulate(NOISY, imu__rate=200.0)
        taken = record(simulation, 'ground_truth/imu_bias')
        for number, rate in enumerate(rates, 1):
            simulation.advance(number * SECOND_NS // 2 + 7)
            simulation.apply({'imu.rate': rate})
        simulation.advance(2 * SECOND_NS)
        return by_time(simulation, taken, 'ground_truth/imu_bias')

    steady, changed = biases(), biases(100.0, 1000.0, 40.0)
    common = steady.keys() & changed.keys()
    assert len(common) > 250
    assert all(steady[t_ns] == changed[t_ns] for t_ns in common)


def test_a_change_of_the_rate_changes_the_noise_of_every_topic():
    simulation = simulate(NOISY)
    simulation.apply({'imu.rate': 50.0})
    for topic in ('imu/data_raw', 'imu/data'):
        message = stream(simulation, topic).template.encode_one(
            0, np.zeros(4), np.zeros(3), np.zeros(3))
        variances = doubles(message, 24)[3:12:4]
        assert variances == pytest.approx(3 * [1e-3 ** 2 * 50.0]), topic


@pytest.mark.parametrize('t_ns', [86_400 * SECOND_NS, 10 ** 18])
def test_a_jump_draws_few_numbers(t_ns, monkeypatch):
    sensor = Sensor(parameters.checked({**NOISY, 'seed': t_ns}), PERIOD_NS)
    draws, philox = [], np.random.Philox
    monkeypatch.setattr(np.random, 'Philox',
                        lambda **keys: (draws.append(keys), philox(**keys))[1])
    there, _ = read(sensor, range(t_ns, t_ns + SECOND_NS, PERIOD_NS))
    assert 3 < len(draws) < 100
    later, _ = read(sensor, range(t_ns + SECOND_NS, t_ns + 2 * SECOND_NS, PERIOD_NS))
    assert len(draws) < 120
    assert np.std(there - later, axis=0).min() > 0.0


def test_different_seeds_are_uncorrelated():
    """White noise and steps of the bias, of all axes and any two seeds, near or far apart."""
    count = 4000
    columns = []
    for seed in (0, 1, 2, 3, 1000, 2 ** 32, 2 ** 63 - 1):
        rows, biases, _ = readings({**NOISY, 'seed': seed}, count)
        columns += [*(rows - biases)[1:].T, *np.diff(biases, axis=0).T]
    correlation = np.corrcoef(columns) - np.eye(len(columns))
    # 3486 pairs: the largest of so many normal numbers is below 5.5 but once in 13 000 tries.
    assert np.abs(correlation).max() < 5.5 / math.sqrt(count - 1)


def test_white_noise_and_bias_are_separate_draws():
    whole, _, _ = readings(NOISY, 600)
    only_white, _, _ = readings({k: v for k, v in NOISY.items() if 'density' in k}, 600)
    _, biases, _ = readings(NOISY, 600)
    assert np.allclose(whole, only_white + biases, rtol=0.0, atol=1e-15)


def test_readings_saturate_and_are_rounded():
    values = parameters.checked({'imu.gyroscope_range': 4.0, 'imu.gyroscope_resolution': 0.25,
                                 'imu.accelerometer_range': 20.0})
    sensor = Sensor(values, 5_000_000)
    exact = (((1.1, -0.1), (-9.0, 0.2), (3.99, 9.0)), ((1.1, 2.0), (-30.0, 2.0), (25.0, -2.0)))
    found, _ = read(sensor, range(0, 2 * PERIOD_NS, PERIOD_NS),
                    tuple(tuple(map(np.array, kind)) for kind in exact))
    assert found.tolist() == [[1.0, -4.0, 4.0, 1.1, -20.0, 20.0],
                              [0.0, 0.25, 4.0, 2.0, 2.0, -2.0]]
    assert not np.signbit(found[1, 0]), 'no reading is -0'
    assert not np.signbit(read(sensor, range(1), tuple((np.array([-1e-9]),) * 3
                                                       for _ in range(2)))[0][0, 0])
    assert sensor.rate_variance == pytest.approx(0.25 ** 2 / 12.0)


@pytest.mark.parametrize(('limit', 'step'), [
    (4.0, 0.3), (34.9066, 1.06423e-3), (0.3, 0.1), (156.906, 4.78840e-3), (1.0, 3.0), (7.0, 7.0),
    (1e12, 1e-12), (1e-12, 1e12)])
def test_no_reading_is_beyond_the_range_or_off_the_grid_of_the_resolution(limit, step):
    sensor = Sensor(parameters.checked({
        'imu.gyroscope_range': limit, 'imu.gyroscope_resolution': step,
        'imu.accelerometer_range': limit}), PERIOD_NS)
    values = limit * np.array([-3.0, -1.0, -0.999, 0.999, 1.0, 1.001, 1e6])
    times = range(0, len(values) * PERIOD_NS, PERIOD_NS)
    found, _ = read(sensor, times, 2 * ((values, values, values),))
    assert np.abs(found).max() <= limit
    codes = found[:, :3] / step
    assert np.abs(codes - np.rint(codes)).max() <= 1e-9 * max(1.0, np.abs(codes).max())
    # No more than a step is lost, and both ends are alike.
    assert found[-1, 0] >= limit - step - 1e-15 * limit and found[0, 0] == -found[-1, 0]
    assert found[-1, 3] == limit and np.array_equal(found[2:4, 3], values[2:4])


@pytest.mark.parametrize('kind', ['gyroscope', 'accelerometer'])
@pytest.mark.parametrize('step', [1e-310, 5e-324, 1e-13, -0.1, math.nan])
def test_a_resolution_that_doubles_cannot_divide_by_is_refused(kind, step):
    with pytest.raises(ValueError, match=rf'imu\.{kind}_resolution = {step!r}: must be'):
        parameters.checked({f'imu.{kind}_resolution': step})


def test_equal_seeds_give_equal_bytes_in_any_company():
    def run(others=(), **values):
        simulation = simulate(NOISY, **values)
        raw = []
        stream(simulation, 'imu/data_raw').publish = raw.append
        record(simulation, *(others or ('pose',)))
        simulation.advance(2 * SECOND_NS)
        return raw

    alone = run()
    assert len(alone) == 401
    assert run(seed=5) != alone
    assert run(('pose', 'imu/data', 'ground_truth/imu', 'ground_truth/imu_bias'),
               imu_data__enabled=True, imu_data__rate=77.0) == alone


def test_noise_that_was_read_is_not_kept():
    sensor = Sensor(parameters.checked(NOISY), PERIOD_NS)

    def in_use_after(*blocks):
        for block in blocks:
            read(sensor, range(512 * block * PERIOD_NS, 512 * block * PERIOD_NS + 1))
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = in_use_after(*range(90, 101))      # which fill what the caches keep
        after = in_use_after(499, 500)
    finally:
        tracemalloc.stop()
    # Six numbers of each block in between would be this; Python and numpy keep some at hand.
    assert after - before < 400 * 6 * 8
