# SPDX-License-Identifier: Apache-2.0
"""
The simulation without ROS: what is sent depends on the parameters and the commands alone.

What changes it: commands, rates, listeners, restarts, refusals.
"""

import gc
import itertools
import sys

import numpy as np
import pytest
from helpers.reference import ROOT
from helpers.simulations import (
    EPOCH_NS,
    MILLISECOND,
    SECOND,
    messages_of,
    output,
    play,
    publish,
    record,
    simulate,
    states_of,
    times,
)

from spinning_top_sim import solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LARGEST_BLOCK, LONGEST_AHEAD_NS, MOST_STEPS
from spinning_top_sim.streams.parameter import Effect

PERIOD_NS = 10 * MILLISECOND        # of most streams


def test_a_log_gets_an_instant_in_one_call_before_anybody_else():
    """Also where publishing fails, as when a signal takes the context away."""
    undisturbed = simulate()
    expected = record(undisturbed)
    undisturbed.advance(SECOND)
    simulation, calls = simulate(), []
    simulation.log_to(calls.append, simulation.streams)

    def fail(data):
        if simulation.now_ns >= SECOND // 3:
            raise RuntimeError('the context is gone')

    output(simulation, 'joint_states').publish = fail
    with pytest.raises(RuntimeError, match='gone'):
        simulation.advance(SECOND)
    assert all(len({stamp_ns for _, stamp_ns, _ in entries}) == 1 for entries in calls)
    taken = [(simulation.streams[number].topic, stamp_ns - EPOCH_NS, message)
             for number, stamp_ns, message in itertools.chain(*calls)]
    assert taken == [entry for entry in expected if entry[1] <= simulation.now_ns]
    assert SECOND // 3 < simulation.now_ns == taken[-1][1] < SECOND // 2
    simulation.log_to(None)
    output(simulation, 'joint_states').publish = None
    count = len(calls)
    simulation.advance(2 * SECOND)
    assert len(calls) == count and not any(one.is_used for one in simulation.outputs)


def test_giving_way_in_a_long_integration_loses_nothing_and_leaves_a_state_to_read():
    """A wheel so fast that a sample takes thousands of steps; ticks end in their midst."""
    fast = {'spin.l3': 1e4, 'joint_states.rate': 500.0}
    expected = play(simulate(fast), 6_000_000, 'joint_states')
    broken = simulate(fast)
    taken = record(broken, 'joint_states')
    start, found, steps = parameters.start_state(broken.values), [], [broken.steps]
    while not broken.advance(6_000_000, give_way=lambda: True):
        steps.append(broken.steps)
        state = broken.state()
        assert abs(broken.energy_drift) <= 1e-14
        assert abs(state.l3[0] / 1e4 - 1.0) <= 1e-14
        found.append((broken.now_ns * 1e-9, state.theta[0], state.phi[0], state.psi[0]))
    assert broken.steps > 5000 and max(np.diff(steps)) <= MOST_STEPS
    assert found[-1][0] <= 6e-3 and all(a[0] < b[0] for a, b in itertools.pairwise(found))
    t, *angles = zip(*found, strict=True)
    there = solve(broken.top, start, np.array(t))
    assert np.transpose(angles) == pytest.approx(
        np.column_stack((there.theta, there.phi, there.psi)), abs=1e-8)
    assert taken == expected


def test_ticks_leave_nothing_behind():
    """
    Blocks of memory in use do not become more, whoever listens, however long it runs.

    The interpreter's and numpy's own caches take blocks too, up to some 150 and then no more: how
    fast depends on what ran before in the process.  What a tick leaves behind, every round shows.
    """
    simulation = simulate(solver__method='exact')
    for one in simulation.outputs:
        one.publish = len
    simulation.log_to(lambda entries: None, simulation.streams)

    def run(ticks):
        for _ in range(ticks):
            simulation.advance(simulation.now_ns + 5 * MILLISECOND)
            simulation.prepare(simulation.now_ns + MILLISECOND)
        gc.collect()
        return sys.getallocatedblocks()

    run(200)
    in_use = [run(64) for _ in range(5)]
    assert min(np.diff(in_use)) < 8


def test_a_block_is_bounded_in_time_and_in_samples():
    simulation = simulate(pose__rate=1000.0)
    publish(simulation, '~/invariants')
    simulation.advance(0)
    simulation.prepare(1)
    assert simulation.computed_ns == LONGEST_AHEAD_NS
    publish(simulation, 'pose')
    simulation.prepare(60 * SECOND)
    assert simulation.computed_ns == (LARGEST_BLOCK - 1) * MILLISECOND
    assert not simulation.advance(60 * SECOND, give_way=lambda: True)
    assert simulation.now_ns == (LARGEST_BLOCK - 1) * MILLISECOND


def test_each_sample_is_computed_once_for_all_its_sinks_and_few_in_vain():
    simulation = simulate(pose__rate=1000.0, joint_states__rate=500.0)
    taken = record(simulation, 'pose', 'joint_states', '/clock')
    published = publish(simulation, 'pose')
    encoded, states = messages_of(simulation), states_of(simulation)
    for tick in range(1, 1001):
        simulation.advance(tick * MILLISECOND)
        simulation.prepare((tick + 1) * MILLISECOND)
    poses = [data for topic, _, data in taken if topic == 'pose']
    assert (len(poses), len(taken)) == (1001, 1001 + 501 + 101)
    assert all(a is b for (_, a), b in zip(published, poses, strict=True))
    ahead = simulation.computed_ns // MILLISECOND - 1000
    assert 0 < ahead <= LARGEST_BLOCK
    counts = {topic: counted.count for topic, counted in encoded.items() if counted.count}
    assert counts.keys() == {'pose', 'joint_states', '/clock'}
    assert counts['pose'] == 1001 + ahead and counts['joint_states'] <= 501 + ahead // 2
    # Streams whose samples are the same instants share states; the clock asks for none.
    assert states.count <= counts['pose'] + counts['joint_states']
    assert states.calls <= 22


CHANGES = {
    'command': lambda one, taken: one.command(2.0, 1.5),
    'subscriber': lambda one, taken: setattr(output(one, 'imu/data_raw'), 'publish', taken.append),
    'recorder': lambda one, taken: one.log_to(taken.extend, [output(one, 'imu/data_raw').stream]),
    'epoch': lambda one, taken: setattr(one, 'epoch_ns', one.epoch_ns + 1),
    'late': lambda one, taken: one.advance(15 * MILLISECOND, publish_from_ns=10 * MILLISECOND)}


@pytest.mark.parametrize('change', CHANGES)
def test_what_was_computed_ahead_is_dropped_when_it_no_longer_holds(change):
    def run(ahead):
        simulation, taken = simulate(pose__rate=1000.0), []
        pose = output(simulation, 'pose')
        pose.publish = taken.append
        simulation.advance(5 * MILLISECOND)
        assert not ahead or simulation.prepare(6 * MILLISECOND)
        CHANGES[change](simulation, taken)
        for until in (30, 60):
            simulation.advance(until * MILLISECOND)
        return taken, pose.sent, pose.skipped

    expected = run(False)
    assert run(True) == expected
    assert change not in ('subscriber', 'recorder') or len(expected[0]) > 70


@pytest.mark.parametrize('l3', [1.6, 1e3])
def test_however_far_is_computed_ahead_the_present_state_can_be_read(l3):
    """Also where a tick takes many steps, and where the clock stands still meanwhile."""
    simulation, beside = simulate(spin__l3=l3), simulate(spin__l3=l3)
    record(simulation, 'pose', '~/invariants')
    for tick in range(1, 25):
        now = tick // 4 * MILLISECOND
        simulation.advance(now)
        simulation.prepare(now + 8 * MILLISECOND)
        beside.advance(now)
        assert simulation.now_ns == beside.now_ns == now
        assert simulation.state().quaternion.tolist() == beside.state().quaternion.tolist()
    assert simulation.steps > beside.steps


def test_a_subscriber_gets_the_next_samples_of_the_grid_and_no_backlog():
    simulation = simulate()
    simulation.advance(SECOND + 3)
    taken = publish(simulation, 'pose')
    simulation.advance(2 * SECOND)
    assert len(taken) == 100
    output(simulation, 'pose').publish = None
    simulation.advance(5 * SECOND)
    again, recorded = publish(simulation, 'pose'), record(simulation, 'pose')
    simulation.advance(5 * SECOND + PERIOD_NS)
    assert again == [('pose', data) for _, _, data in recorded]
    assert times(recorded, 'pose') == [5 * SECOND + PERIOD_NS]
    assert len(taken) == 100


@pytest.mark.parametrize('ahead', [False, True])
def test_late_samples_are_recorded_and_counted_but_not_published(ahead):
    simulation = simulate()
    encoded = messages_of(simulation)
    published = publish(simulation, 'pose', 'joint_states')
    recorded = record(simulation, 'pose')
    simulation.advance(0)
    if ahead:
        simulation.prepare(SECOND)
    assert simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND)
    assert times(recorded, 'pose') == list(range(0, 10 * SECOND + 1, PERIOD_NS))
    for topic in ('pose', 'joint_states'):
        assert [name for name, _ in published].count(topic) == 102
        assert (output(simulation, topic).sent, output(simulation, topic).skipped) == (102, 899)
    assert encoded['pose'].count == 1001
    if not ahead:       # nobody takes the samples that are left out
        assert encoded['joint_states'].count == 102


@pytest.mark.parametrize(('before', 'after'), [(100.0, 33.0), (10000.0, 10.0)])
def test_a_change_of_rate_goes_on_on_the_new_grid(before, after):
    simulation = simulate(pose__rate=before)
    taken = record(simulation, 'pose')
    changed_at = 123_456_789
    simulation.advance(changed_at)
    simulation.apply({'pose.rate': after})
    simulation.advance(SECOND)
    old, new = round(SECOND / before), round(SECOND / after)
    expected = [*range(0, changed_at + 1, old),
                *(t for t in range(0, SECOND + 1, new) if t > changed_at)]
    assert times(taken, 'pose') == expected


def test_a_change_of_rates_reaches_every_stream():
    """A run is computed again by the rates of its streams."""
    simulation = simulate()
    at_once = {stream.rate_parameter for stream in simulation.streams}
    assert at_once == {name for name in parameters.BY_NAME if name.endswith('.rate')
                       and not name.startswith('imu.vibration')}
    assert all(parameters.BY_NAME[name].effect is Effect.NOW for name in at_once)
    simulation.apply({'imu.rate': 100.0})
    simulation.advance(SECOND)
    simulation.apply({**dict.fromkeys(at_once, 50.0), 'tick_rate': 100.0})
    taken = record(simulation)
    simulation.advance(2 * SECOND)
    for one in simulation.streams:
        assert times(taken, one.topic) == list(range(SECOND + 20 * MILLISECOND, 2 * SECOND + 1,
                                                     20 * MILLISECOND)), one.topic
    assert simulation.history == [(0, 100.0), (SECOND, 50.0)], 'the rates of the IMU'


def test_what_takes_effect_at_once_acts_on_the_samples_or_is_named_in_the_node():
    """The switches of streams have no name there: they come with the streams."""
    node = ''.join(path.read_text() for path in (ROOT / 'spinning_top_sim/nodes').glob('*.py'))
    before = play(simulate(), SECOND // 2)
    for parameter in parameters.TABLE:
        if (parameter.effect is Effect.NOW and f"'{parameter.name}'" not in node
                and not parameter.name.endswith('.enabled')):
            simulation = simulate()
            simulation.apply({parameter.name: parameter.check(0.5 * parameter.default)})
            assert play(simulation, SECOND // 2) != before, parameter.name


def test_segments_are_forgotten_when_nothing_reaches_back_to_them():
    """The trace of the markers has 3 s by default."""
    simulation = simulate(solver__method='exact')
    for tick in range(1, 101):
        simulation.advance(tick * SECOND // 10)
        simulation.command(1.6 + 0.001 * tick, 1.4)
    kept = [one.start_ns for one in simulation.path._segments]
    trace_ns = round(simulation.values['markers.trace_length'] * SECOND)
    assert kept == list(range(10 * SECOND - trace_ns - SECOND // 10, 10 * SECOND + 1,
                              SECOND // 10))


def test_a_restart_gives_the_same_bytes_again_and_keeps_sinks_and_counts():
    simulation = simulate()
    taken, published = record(simulation), publish(simulation, 'pose')
    simulation.advance(SECOND)
    first, steps = list(taken), simulation.steps
    simulation.command(0.5, 0.1)
    simulation.advance(2 * SECOND)
    simulation.prepare(3 * SECOND)
    between = simulation.steps
    simulation.restart(parameters.checked({}))
    del taken[:]
    simulation.advance(SECOND)
    assert taken == first
    assert simulation.history == []
    assert simulation.steps == between + steps > between > steps
    assert output(simulation, 'pose').sent == len(published) == 101 + 100 + 101


def test_a_restart_that_is_refused_leaves_the_motion_as_it_was():
    expected = play(simulate(), SECOND, 'pose')
    simulation = simulate()
    taken = record(simulation, 'pose')
    simulation.advance(SECOND // 2)
    with pytest.raises(ValueError, match='pole'):
        simulation.restart({**parameters.checked({}), 'initial.theta': 0.0, 'spin.lz': 0.5})
    with pytest.raises(ValueError, match=r'1e\+20'):
        simulation.restart({**parameters.checked({}), 'spin.l3': 1e20, 'spin.lz': 1e20})
    simulation.advance(SECOND)
    assert taken == expected
