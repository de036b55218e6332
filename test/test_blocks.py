# SPDX-License-Identifier: Apache-2.0
"""
A value does not depend on which other values are computed with it.

Samples are computed in blocks, whose sizes follow from ticks, commands, rates and listeners.  The
same parameters and commands must give the same bytes for every division into blocks.
"""

import random

import pytest
from helpers.readings import command, rate
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, play, record, simulate

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.messages import FIELDS
from spinning_top_sim.streams.topics import all_streams

COMMON = {
    'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 2e-4,
    'imu.gyroscope_turn_on_bias': 0.01, 'imu.accelerometer_noise_density': 2e-2,
    'imu.accelerometer_random_walk': 3e-3, 'imu.accelerometer_turn_on_bias': 0.05,
    'markers.trace_length': 0.3, 'markers.trace_points': 12,
    'pose.rate': 333.0, 'imu.rate': 500.0, 'imu_data.rate': 77.7, 'ground_truth_imu.rate': 500.0}
MOUNTED = {'imu.lever_arm': (0.1, -0.2, 0.3), 'imu.rpy': (0.1, 0.2, 0.3),
           'imu.accelerometer_range': 40.0, 'imu.gyroscope_resolution': 1e-3,
           'imu.gyroscope_M': (1.1, 0.01, 0.0, 0.02, 0.9, 0.03, 0.0, 0.04, 1.0),
           'imu.accelerometer_M': (0.9, 0.0, 0.01, 0.0, 1.1, 0.0, 0.02, 0.0, 1.0),
           'imu.gyroscope_A': (1e-3, 0.0, 2e-3, 0.0, 3e-3, 0.0, 0.0, 0.0, 1e-3),
           'imu.gyroscope_bias_stddev': 0.1, 'imu.gyroscope_bias_correlation_time': 0.3,
           'imu.accelerometer_bias_instability': 0.02, 'imu.orientation_stddev': (0.1, 0.2, 0.05),
           'imu.stamp_offset': 0.01, 'imu.stamp_jitter': 1e-3, 'imu.clock_drift': -80.0,
           'imu.drop_rate': 0.1, 'imu.duplicate_rate': 0.1, 'mag.noise_density': 1e-7,
           'mag.random_walk': 1e-7, 'mag.hard_iron': (1e-5, 0.0, -2e-5), 'mag.resolution': 1.5e-7,
           'mag.soft_iron': (1.1, 0.0, 0.1, 0.0, 0.9, 0.0, 0.1, 0.0, 1.0), 'mag.rate': 125.0,
           'imu.sampling': 'mean', 'gnss.latency': 0.03, 'gnss.outages': (0.1, 0.2),
           'gnss.position_noise': (1.0, 2.0), 'gnss.velocity_noise': (0.1, 0.2),
           'gnss.rate': 300.0}
FILTERED = {'imu.sampling': 'instant', 'imu.bandwidth': 40.0, 'imu.bandwidth_order': 2,
            'imu.vibration.force': (1.0, 2.0, 3.0),
            'imu.vibration.rate_psd': (10.0, 1e-3, 100.0, 1e-4),
            'mag.disturbance.world': (0.1, 0.3, 1e-5, 0.0, 0.0)}
SCENES = {
    'cusps': {},
    'a sensor elsewhere': {**scene_parameters('looping'), **MOUNTED},
    # The acceleration changes at samples and between them.
    'a filtered sensor': {
        'pivot.path': (0.1, 2.0, 0.0, 0.0, 0.0123, 0.0, 0.0, -9.80665, 0.1, -2.0, 0.0, 0.0),
        **MOUNTED, **FILTERED},
    'many changes': {
        'pivot.path': (0.012, 2.0, 0.0, 0.0, 0.017, 0.0, 3.0, -9.80665, 0.011, -2.0, 0.0, -25.0,
                       0.023, 9.0, 0.0, -20.0, 0.02, 0.0, 0.0, 0.0, 0.015, -9.0, 0.0, 55.0),
        **MOUNTED},
    'through a pole': {'initial.theta': 0.5, 'spin.l3': 0.2, 'spin.lz': 0.2},
    'planar rotation': scene_parameters('planar_pendulum'),
}
CASES = (('planar rotation', 'exact'), ('a filtered sensor', 'rk45'), ('many changes', 'exact'),
         ('cusps', 'euler'), ('a sensor elsewhere', 'rk45'), ('through a pole', 'rk45'))
DURATION_NS = 500_000_000
# Commands, changes of rates, a velocity of the pivot and a state, and when they come [ns].
EVENTS = ((125_000_000, command(1.1, 1.1)),
          (225_000_001, lambda simulation: simulation.apply({'pose.rate': 250.0})),
          (225_000_001, rate(320.0)),
          (300_000_000, lambda simulation: simulation.drive((0.5, 0.0, 0.0))),
          (350_000_003, command(0.9, 0.85)), (350_000_003, command(1.2, 1.2)),
          (450_000_000, lambda simulation: simulation.set_state(
              parameters.start_state(parameters.checked({'initial.theta': 1.0})))))


def start(scene, method):
    solver = {'solver.equations': 'euler'} if method == 'euler' else {'solver.method': method}
    return simulate({**COMMON, **SCENES[scene], **solver})


def go(simulation, advance, splits):
    """Run to the end with `advance`, divided at the events and at `splits` [ns]."""
    stops = [*EVENTS, *((t_ns, lambda simulation: None) for t_ns in (*splits, DURATION_NS))]
    for t_ns, act in sorted(stops, key=lambda stop: stop[0]):
        if t_ns > simulation.now_ns:
            advance(t_ns)
        act(simulation)
    assert len(simulation.history) == 6


def offline(scene, method, splits=()):
    """Return the messages of each topic, {topic: [(t [ns], data)]}, of a run offline."""
    simulation, taken = start(scene, method), []
    go(simulation, lambda t_ns: taken.extend(play(simulation, t_ns)), splits)
    return by_topic(taken)


def restless(scene, method, splits, seed):
    """
    Return the same of a run as of a busy node, and what it publishes, [(topic, data)].

    Ticks give way, blocks of any size are computed ahead, listeners come and go.
    """
    simulation, dice, published = start(scene, method), random.Random(seed), []
    taken = record(simulation)

    def advance(t_ns):
        while not simulation.advance(t_ns, give_way=lambda: dice.random() < 0.3):
            pass
        for _ in range(dice.randrange(3)):
            simulation.prepare(t_ns + dice.choice((1, 16, 200)) * MILLISECOND,
                               dice.choice((None, 0, 100_000)))
        for output in simulation.outputs:
            if dice.random() < 0.05:
                output.publish = None if output.publish else (
                    lambda data, topic=output.stream.topic: published.append((topic, data)))
    go(simulation, advance, splits)
    return by_topic(taken), published


def by_topic(taken):
    messages = {}
    for topic, t_ns, data in taken:
        messages.setdefault(topic, []).append((t_ns, data))
    return messages


def random_splits(seed, count):
    """Return so many times, anywhere, on samples, and one nanosecond beside them."""
    dice = random.Random(seed)
    splits = []
    for _ in range(count):
        sample = dice.randrange(DURATION_NS // 2_000_000) * 2_000_000
        splits.append(dice.choice((dice.randrange(DURATION_NS), sample, sample + 1, sample - 1)))
    return sorted({split for split in splits if split > 0})


def first_difference(found, expected):
    """Return topic and time [ns] of the first message that differs; None if none does."""
    assert {topic: len(messages) for topic, messages in found.items()} == {
        topic: len(messages) for topic, messages in expected.items()}
    return next(((topic, two[0]) for topic in expected for one, two in zip(
        found[topic], expected[topic], strict=True) if one != two), None)


def test_each_field_of_each_stream_has_a_name():
    """For the columns of ensembles, and for what `inspect --verify` says."""
    for stream in all_streams(parameters.checked({})):
        assert len(FIELDS[stream.type_name]) == len(stream.template.counts), stream.topic


@pytest.mark.parametrize(('scene', 'method'), CASES)
def test_any_division_of_a_run_gives_the_same_bytes(scene, method):
    """Offline in large blocks and divided anywhere, and live; what is published is recorded."""
    whole = offline(scene, method)
    assert len(whole['pose']) > 125 and len(whole['imu/data_raw']) > 175
    assert len(whole) == len(all_streams(parameters.checked({})))
    assert min(map(len, whole.values())) > 5
    assert first_difference(offline(scene, method, random_splits(3, 5)), whole) is None
    recorded, published = restless(scene, method, random_splits(2, 20), seed=2)
    assert first_difference(recorded, whole) is None
    assert len(published) > 12
    assert set(published) <= {(topic, data) for topic in recorded for _, data in recorded[topic]}
