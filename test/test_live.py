# SPDX-License-Identifier: Apache-2.0
"""The simulation without ROS: what is sent depends on the parameters and the commands alone."""

import gc
import itertools
import sys

import numpy as np
import pytest
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
)

from spinning_top_sim import solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import (
    LARGEST_BLOCK,
    LONGEST_AHEAD_NS,
    MOST_STEPS,
)

PERIOD_NS = 10 * MILLISECOND        # of most streams


def test_a_log_gets_an_instant_in_one_call_before_anybody_else():
    """Also where publishing fails, as when a signal takes the context away."""
    undisturbed = simulate()
    expected = record(undisturbed)
    undisturbed.advance(SECOND)
    simulation, calls = simulate(), []
    simulation.log_to(lambda entries, size: calls.append(entries), simulation.streams)

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


@pytest.mark.parametrize('topic', ['pose', '/clock'])
def test_a_sample_of_a_stream_with_a_sink_is_encoded_once_for_all_its_sinks(topic):
    simulation = simulate()
    encoded, states = messages_of(simulation), states_of(simulation)
    simulation.advance(SECOND)
    published, recorded = publish(simulation, topic), record(simulation, topic)
    simulation.advance(2 * SECOND)
    assert encoded.pop(topic).count == len(published) == len(recorded) == 100
    assert all(a is b for (_, a), (_, _, b) in zip(published, recorded, strict=True))
    assert states.count == (0 if topic == '/clock' else 100)
    assert all(counted.count == 0 for counted in encoded.values())


def test_ticks_leave_nothing_behind():
    """
    Blocks of memory in use do not become more, whoever listens, however long it runs.

    The interpreter's and numpy's own caches take blocks too, up to some 150 and then no more: how
    fast depends on what ran before in the process.  What a tick leaves behind, every round shows.
    """
    simulation = simulate(solver__method='exact')
    for one in simulation.outputs:
        one.publish = len
    simulation.log_to(lambda entries, size: None, simulation.streams)

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


def test_each_sample_is_computed_once_and_few_in_vain():
    simulation = simulate(pose__rate=1000.0, joint_states__rate=500.0)
    taken = record(simulation, 'pose', 'joint_states')
    encoded, states = messages_of(simulation), states_of(simulation)
    for tick in range(1, 1001):
        simulation.advance(tick * MILLISECOND)
        simulation.prepare((tick + 1) * MILLISECOND)
    assert len(taken) == 1001 + 501
    ahead = simulation.computed_ns // MILLISECOND - 1000
    assert 0 < ahead <= LARGEST_BLOCK
    assert encoded['pose'].count == 1001 + ahead
    assert encoded['joint_states'].count <= 501 + ahead // 2
    # All streams but those whose samples are the same instants ask for states of their own.
    assert states.count <= encoded['pose'].count + encoded['joint_states'].count
    assert states.calls <= 22


CHANGES = {
    'command': lambda one, taken: one.command(2.0, 1.5),
    'subscriber': lambda one, taken: setattr(output(one, 'imu/data_raw'), 'publish', taken.append),
    'recorder': lambda one, taken: one.log_to(
        lambda entries, _: taken.extend(entries), [output(one, 'imu/data_raw').stream]),
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
