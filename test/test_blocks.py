# SPDX-License-Identifier: Apache-2.0
"""
A message depends on parameters, events and its own time, never on what is computed with it.

The whole run as few large blocks is compared with the same run offline in pieces, and live.
"""

import dataclasses
import random

import pytest
from helpers.examples import examples
from helpers.reference import scene_parameters
from helpers.simulations import EPOCH_NS, MILLISECOND, drive, entries, play, record, simulate
from hypothesis import example, given
from hypothesis import strategies as st

from spinning_top_sim.physics.top import State

COMMON = {
    'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 2e-4,
    'imu.accelerometer_turn_on_bias': 0.05, 'markers.trace_length': 0.1, 'pose.rate': 333.0,
    'markers.trace_points': 12, 'imu.rate': 500.0, 'imu_data.rate': 77.7, 'gnss.rate': 300.0,
    'ground_truth_imu.rate': 500.0, 'invariants.rate': 60.0}
MOUNTED = {
    **COMMON, 'imu.lever_arm': (0.1, -0.2, 0.3), 'imu.rpy': (0.1, 0.2, 0.3),
    'imu.accelerometer_range': 40.0, 'imu.gyroscope_resolution': 1e-3,
    'imu.gyroscope_M': (1.1, 0.01, 0.0, 0.02, 0.9, 0.03, 0.0, 0.04, 1.0),
    'imu.gyroscope_A': (1e-3, 0.0, 2e-3, 0.0, 3e-3, 0.0, 0.0, 0.0, 1e-3),
    'imu.gyroscope_bias_stddev': 0.1, 'imu.gyroscope_bias_correlation_time': 0.3,
    'imu.accelerometer_bias_instability': 0.02, 'imu.orientation_stddev': (0.1, 0.2, 0.05),
    'imu.stamp_offset': 0.01, 'imu.stamp_jitter': 1e-3, 'imu.clock_drift': -80.0,
    'imu.drop_rate': 0.1, 'imu.duplicate_rate': 0.1, 'mag.noise_density': 1e-7,
    'mag.random_walk': 1e-7, 'mag.resolution': 1.5e-7, 'mag.rate': 125.0, 'gnss.latency': 0.03,
    'mag.disturbance.world': (0.1, 0.2, 1e-5, 0.0, 0.0), 'gnss.outages': (0.05, 0.1),
    'gnss.position_noise': (1.0, 2.0), 'gnss.velocity_noise': (0.1, 0.2), 'imu.sampling': 'mean',
    'markers.trace_length': 0.02}         # a late fix reaches back further
FILTERED = {
    **MOUNTED, 'imu.sampling': 'instant', 'imu.bandwidth': 150.0, 'imu.bandwidth_order': 2,
    'imu.vibration.force': (1.0, 2.0, 3.0), 'imu.vibration.rate_psd': (10.0, 1e-3, 90.0, 1e-4)}
# Accelerations change at samples and between them; two of them are free fall.
PATH = (0.012, 2.0, 0.0, 0.0, 0.017, 0.0, 3.0, -9.80665, 0.011, -2.0, 0.0, -25.0,
        0.0231, 9.0, 0.0, -20.0, 0.02, 0.0, 0.0, 0.0, 0.015, -9.0, 0.0, 55.0)
RUNS = {
    'cusps, the equations of the paper': {**COMMON, 'solver.equations': 'euler'},
    'a sensor elsewhere, rk45': {**scene_parameters('looping'), **MOUNTED,
                                 'solver.method': 'rk45'},
    'a filtered sensor, rk45': {**FILTERED, 'pivot.path': PATH},
    'many changes, exact': {**MOUNTED, 'pivot.path': PATH, 'solver.method': 'exact'},
    'through a pole': {**COMMON, 'initial.theta': 0.5, 'spin.l3': 0.2, 'spin.lz': 0.2}}
STATE = dataclasses.asdict(State(theta=1.0, theta_dot=0.3, l3=1.5, lz=1.1))
# What may happen in a run; refused ones change nothing.
ACTS = {
    'command': lambda one: one.apply('command', l3=1.2 * float(one.state().l3[0]) + 0.1, lz=1.1),
    'state': lambda one: one.apply('state', **STATE),
    'drive': lambda one: drive(one, 0.5, 0.0, 0.1),
    'repeat': lambda one: drive(one, 0.5, 0.0, 0.1),
    'rates': lambda one: one.apply('parameters', **{'imu.rate': 320.0, 'pose.rate': 250.0}),
    'slow': lambda one: one.apply('parameters', **{'imu.rate': 40.0}),
    'epoch': lambda one: one.apply('epoch', epoch_ns=one.epoch_ns + 12_345),
    'reset': lambda one: one.apply('reset', epoch_ns=EPOCH_NS + 10 ** 10,
                                   parameters={**one.values_at_start, 'initial.theta': 0.7})}
# Times between them: none, on samples, next to samples, anywhere.
PAUSES = st.sampled_from((0, 1, 2 * MILLISECOND, 12 * MILLISECOND)) | st.integers(
    0, 40).map(lambda k: 2 * MILLISECOND * k - 1).filter(lambda t: t > 0) | st.integers(
        0, 60 * MILLISECOND)
EVENTS = st.lists(st.tuples(PAUSES, st.sampled_from([*ACTS])), max_size=6)


def go(simulation, events, advance):
    """Run through the events; `advance` goes on to a time [ns] and returns what it yields."""
    taken = []
    for pause_ns, name in (*events, (30 * MILLISECOND, '')):
        until_ns = simulation.now_ns + pause_ns
        if until_ns > simulation.sent_ns:
            taken += advance(simulation, until_ns) or ()
        if name:
            try:
                ACTS[name](simulation)
            except ValueError:      # of a top at a pole
                assert name == 'command'
    return by_topic(taken)


def by_topic(taken):
    messages = {}
    for topic, stamp_ns, data in taken:
        messages.setdefault(topic, []).append((stamp_ns, data))
    return messages


def at_once(simulation, until_ns):
    """Nothing is forgotten, either."""
    assert simulation.reach(simulation.sent_ns, until_ns) == until_ns
    messages = simulation.messages(simulation.channels, simulation.sent_ns, until_ns)
    simulation.sent_ns = until_ns
    return entries(simulation, messages)


def in_pieces(dice):
    def advance(simulation, until_ns):
        taken = []
        while simulation.sent_ns < until_ns:
            taken += play(simulation, min(until_ns, simulation.sent_ns + dice.choice(
                (1, MILLISECOND, dice.randrange(1, 10 * MILLISECOND)))
                if dice.random() < 0.1 else until_ns))
        return taken
    return advance


def live(dice, published):
    """Calls give way, look ahead for any time; subscribers come and go."""
    def advance(simulation, until_ns):
        while not simulation.send(dice.choice((until_ns, (until_ns + simulation.sent_ns) // 2)),
                                  give_way=lambda: dice.random() < 0.3
                                  ) or simulation.sent_ns < until_ns:
            simulation.look_ahead(until_ns + dice.choice((0, 1, 16, 200)) * MILLISECOND,
                                  dice.choice((0.0, 1e-4, 1e-2)))
            if dice.random() < 0.5:
                for output in simulation.outputs:
                    if dice.random() < 0.1:
                        output.publish = None if output.publish else (
                            lambda data, name=output.channel.topic: published.append((name, data)))
                simulation.refresh()
    return advance


def assert_same(found, expected):
    topics = found.keys() | expected.keys()
    assert [topic for topic in topics if found.get(topic) != expected.get(topic)] == []


@pytest.mark.parametrize('name', RUNS)
@examples(4)
@given(EVENTS, st.integers(0, 999))
@example([(25 * MILLISECOND, act) for act in ACTS], 2)
@example([(0, 'slow'), (49 * MILLISECOND, 'rates'), (1, 'epoch')], 2)
def test_any_division_of_a_run_gives_the_same_bytes(name, events, seed):
    dice = random.Random(seed)      # how often it is thrown depends on the clock
    whole = go(simulate(RUNS[name]), events, at_once)
    assert len(events) < 8 or len(whole) == len(simulate().channels)
    assert_same(go(simulate(RUNS[name]), events, in_pieces(dice)), whole)
    simulation, published = simulate(RUNS[name]), []
    taken = record(simulation)
    go(simulation, events, live(dice, published))
    assert_same(by_topic(taken), whole)
    assert {*published} <= {(topic, data) for topic in whole for _, data in whole[topic]}
