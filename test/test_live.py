# SPDX-License-Identifier: Apache-2.0
"""The live simulation without ROS: who gets which messages, what is counted, what it costs."""

import itertools
from collections import Counter

import numpy as np
import pytest
from helpers import simulations
from helpers.simulations import EPOCH_NS, MILLISECOND, SECOND, output, play, record, simulate

from spinning_top_sim import solve
from spinning_top_sim.solvers import dormand_prince
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.trajectory import Trajectory
from spinning_top_sim.times import LAST_STAMP_NS

PERIOD_NS = 10 * MILLISECOND        # of most topics


def test_the_log_gets_an_instant_before_subscribers_and_those_that_fail_get_a_rest():
    expected, clock = play(simulate(), SECOND, 'pose', 'joint_states'), [1000.0]
    simulation = LiveSimulation(parameters.checked({}), EPOCH_NS, lambda: clock[0])
    tried, logged = [], []
    taken = record(simulation, 'pose', 'joint_states')

    def fail(data):
        tried.append(data)
        logged.append(data in [entry[2] for entry in taken[-2:]])
        raise RuntimeError('the context is gone')

    output(simulation, 'joint_states').publish = fail
    output(simulation, 'pose').publish = len
    simulation.refresh()
    for tick in range(1, 101):
        clock[0] = 1000.0 + 0.02 * tick
        simulation.send(tick * PERIOD_NS)
    assert sorted(taken) == sorted(expected) and all(logged)
    # Every second of the clock on the wall it is tried again.
    joints, pose = output(simulation, 'joint_states'), output(simulation, 'pose')
    assert (joints.sent, joints.failed, len(tried)) == (0, 101, 2)
    assert (pose.sent, pose.failed) == (101, 0)
    simulation.log_to(None)
    count = len(taken)
    simulation.send(2 * SECOND, 3 * SECOND // 2)
    assert (len(taken), pose.sent, pose.skipped) == (count, 152, 49)


def test_a_long_integration_is_divided_and_leaves_a_state_to_read(monkeypatch):
    """A wheel so fast that a sample takes thousands of steps; and a clock far ahead of it."""
    fast = {'spin.l3': 1e4, 'joint_states.rate': 500.0}
    expected = play(simulate(fast), 6_000_000, 'joint_states')
    broken, found = simulate(fast), []
    taken = record(broken, 'joint_states')
    while not broken.send(6_000_000, give_way=lambda: True):
        state = broken.state()
        found.append((broken.sent_ns * 1e-9, state.theta[0], state.phi[0], state.psi[0]))
        broken.look_ahead(broken.sent_ns + MILLISECOND, 1e-3)
    assert broken.trajectory.steps > 5000 and len(found) > 3
    t, *angles = zip(*found, strict=True)
    start = parameters.start_state(broken.values_at_start)
    there = solve(broken.trajectory.top, start, np.array(t))
    assert np.transpose(angles) == pytest.approx(
        np.column_stack((there.theta, there.phi, there.psi)), abs=1e-8)
    assert taken == expected
    # The solver goes no further than samples do, and keeps the steps that they need.
    monkeypatch.setattr(dormand_prince, 'MOST_STEPS', 2000)
    behind = simulate(pose__rate=5000.0)
    record(behind, 'pose')
    while behind.trajectory.steps < 4000:
        behind.send(10 ** 6 * SECOND, give_way=lambda: True)
        assert behind.state().theta[0] > 0.5


def test_what_has_a_stamp_of_ros_is_sent_and_nothing_behind_it():
    run = LiveSimulation(parameters.checked({}), LAST_STAMP_NS - 25 * MILLISECOND)
    taken = record(run, 'pose')
    with pytest.raises(dormand_prince.IntegrationError, match='January 2038'):
        run.send(SECOND)
    assert [LAST_STAMP_NS - stamp_ns for _, stamp_ns, _ in taken] == [
        25 * MILLISECOND, 15 * MILLISECOND, 5 * MILLISECOND]


def test_where_every_call_takes_long_time_goes_on():
    slow = LiveSimulation(parameters.checked({}), EPOCH_NS, itertools.count(0.0, 0.02).__next__)
    record(slow, 'pose')
    for _ in range(300):
        slow.send(SECOND, give_way=lambda: True)
    assert slow.sent_ns > 20 * MILLISECOND


def test_each_sample_is_computed_once_for_all_and_what_nobody_takes_is_not(monkeypatch):
    simulation = simulate(pose__rate=1000.0, joint_states__rate=500.0, clock__rate=1000.0)
    taken = record(simulation, 'pose', 'joint_states', '/clock')
    encode, encoded = Channel.encode, Counter()

    def counted(channel, samples):
        encoded[channel.topic] += len(samples.times)
        return encode(channel, samples)

    monkeypatch.setattr(Channel, 'encode', counted)
    for tick in range(1, 1001):
        simulation.send(tick * MILLISECOND)
        simulation.look_ahead((tick + 1) * MILLISECOND, 1e-2)
    assert len(taken) == 1001 + 501 + 1001
    # No more than what a tick looks ahead.
    assert encoded.keys() == {'pose', 'joint_states', '/clock'}
    assert encoded['pose'] == encoded['/clock'] <= 1001 + 301
    assert encoded['joint_states'] <= 501 + 151
    # Where nobody takes messages, the motion alone goes on, in few and long pieces.
    simulation.log_to(None)
    evaluate, evaluated = Trajectory.evaluate, []
    monkeypatch.setattr(Trajectory, 'evaluate', lambda motion, t_ns: (
        evaluated.append(t_ns) or evaluate(motion, t_ns)))
    for tick in range(1001, 2001):
        simulation.send(tick * MILLISECOND)
        simulation.look_ahead((tick + 1) * MILLISECOND, 1e-2)
    assert simulation.now_ns == 2 * SECOND and len(evaluated) < 50 and len(taken) == 2503


def test_after_a_change_of_the_rates_every_topic_goes_on_on_the_new_grid():
    changed_at, until_ns, rates = 123_456_789, SECOND // 4, [
        name for name in parameters.BY_NAME if name.endswith('.rate') and 'vibration' not in name]
    simulation = simulate(dict.fromkeys(rates, 1000.0))
    taken = record(simulation)
    simulation.send(changed_at)
    simulation.apply('parameters', **dict.fromkeys(rates, 33.0), world_frame='later')
    simulation.send(until_ns)
    assert b'later' not in b''.join(data for *_, data in taken), 'at the next reset'
    for one in simulation.channels:
        assert simulations.times(taken, one.topic) == [*range(0, changed_at + 1, MILLISECOND), *(
            t for t in range(0, until_ns + 1, round(SECOND / 33)) if t > changed_at)], one.topic


def test_motions_are_forgotten_when_nothing_reaches_back_to_them():
    """The trace of the markers has 4 s by default."""
    simulation, steps = simulate(), []
    for tick in range(1, 61):
        simulation.send(tick * SECOND // 10)
        steps.append(simulation.trajectory.steps)
        simulation.apply('command', l3=1.6 + 0.001 * tick, lz=1.4)
    kept = simulation.trajectory.starts(0, 7 * SECOND)
    assert 3 * SECOND // 2 <= kept[0] <= 2 * SECOND and kept[-1] == 6 * SECOND
    held = [one for one in vars(simulation.trajectory).values() if isinstance(one, list | tuple)]
    assert max(map(len, held)) <= 1 + len(kept), 'nothing grows'
    assert simulation.trajectory.evaluations > 6 * steps[-1] and steps == sorted({*steps}), 'all'
    with pytest.raises(LookupError, match=r't = 0 ns: the motion before .* is forgotten'):
        simulation.trajectory.evaluate(np.array([0]))
    play(simulation, 20 * SECOND, 'pose')           # nor are steps kept offline
    with pytest.raises(dormand_prince.IntegrationError, match='the oldest one that is kept'):
        simulation.trajectory.evaluate(np.array([10 * SECOND]))
