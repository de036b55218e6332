# SPDX-License-Identifier: Apache-2.0
"""The schedule: what is computed ahead, how far, and when it no longer holds."""

import gc
import weakref

import pytest
from helpers.simulations import (
    MILLISECOND,
    SECOND,
    Counting,
    messages_of,
    publish,
    record,
    simulate,
    states_of,
    stream,
)
from spinning_top_sim.streams.schedule import (
    LARGEST_BLOCK,
    LONGEST_BLOCK_NS,
    NEVER_NS,
    SMALLEST_BLOCK,
    Schedule,
)

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters


def schedule_of(*topics, **values):
    """Return a schedule whose streams of these topics have subscribers."""
    simulation = simulate(**values)
    publish(simulation, *topics)
    schedule = Schedule(simulation.streams, 0)
    schedule.follow(simulation.segment)
    return schedule, simulation


def times_of(schedule):
    return [t_ns for t_ns, _, _ in schedule.ready]


# ---------------------------------------------------------------------------------- the blocks

def test_blocks_begin_small_and_double():
    schedule, _ = schedule_of('pose', pose__rate=10_000.0)

    def sizes(number):
        found = []
        for _ in range(number):
            before = len(schedule.ready)
            assert schedule.prepare(-1, max(schedule.ready_ns, 0))
            found.append(len(schedule.ready) - before)
        return found

    growing = [SMALLEST_BLOCK * 2 ** k for k in range(5)]
    assert growing[-1] == LARGEST_BLOCK
    assert sizes(7) == [*growing, LARGEST_BLOCK, LARGEST_BLOCK]
    assert times_of(schedule) == list(range(0, len(schedule.ready) * 100_000, 100_000))
    schedule.invalidate()
    assert sizes(2) == growing[:2], 'the next command may come soon'


def test_a_block_does_not_reach_too_far_ahead():
    schedule, _ = schedule_of('~/invariants', invariants__rate=5.0)
    assert schedule.prepare(-1, 0)
    assert times_of(schedule) == [0, 200 * MILLISECOND]
    assert schedule.ready[-1][0] <= LONGEST_BLOCK_NS < schedule.ready_ns == 400 * MILLISECOND


def test_a_block_at_once_has_what_is_asked_for_and_is_bounded():
    schedule, _ = schedule_of('pose', pose__rate=1000.0)
    schedule.compute(-1, 10 * MILLISECOND)
    assert times_of(schedule) == [k * MILLISECOND for k in range(11)]
    schedule.ready.clear()
    schedule.compute(10 * MILLISECOND, 60 * SECOND)
    assert times_of(schedule) == [k * MILLISECOND for k in range(11, 11 + LARGEST_BLOCK)]


def test_samples_of_one_instant_are_together_with_their_sinks():
    schedule, simulation = schedule_of('pose', 'joint_states', 'imu/data_raw')
    pose, joints, raw = (stream(simulation, topic)
                         for topic in ('pose', 'joint_states', 'imu/data_raw'))
    raw.log_index = 7
    schedule.compute(-1, 20 * MILLISECOND)
    assert times_of(schedule) == [0, 5_000_000, 10_000_000, 15_000_000, 20_000_000]
    for k, (_, delivery, messages) in enumerate(schedule.ready):
        due = [raw] if k % 2 else [pose, joints, raw]
        assert [one for _, _, one in delivery.published] == due
        assert [len(message) for message in messages] == [len(one.template) for one in due]
        assert delivery.log_indices == (7,)
        assert delivery.logged == (None if k % 2 else [2])
        assert delivery.size == len(raw.template)


def test_without_sinks_nothing_is_ever_due():
    schedule, simulation = schedule_of()
    schedule.next_due(-1)
    assert schedule.ready_ns == NEVER_NS
    states = states_of(simulation)
    assert schedule.prepare(-1, 60 * SECOND)
    assert not schedule.ready and states.count == 0


# --------------------------------------------------------------------------------- the budget

@pytest.mark.parametrize('values', [
    {}, {'solver__method': 'exact'},
    {'initial__theta': 0.5, 'spin__l3': 0.2, 'spin__lz': 0.2}])        # through a pole
def test_a_block_without_time_goes_on_with_the_next_call(values):
    simulation = simulate(**values)
    taken = record(simulation, 'pose', 'joint_states')
    simulation.advance(0)
    calls = 1
    while not simulation.prepare(SECOND // 10, budget_ns=0):
        assert not simulation.send_ready(SECOND // 20), 'nothing is ready before all is'
        calls += 1
    assert 4 < calls < 100
    assert simulation.prepare(SECOND // 10, budget_ns=0), 'there is nothing left to do'
    states = states_of(simulation)
    assert simulation.send_ready(SECOND // 10)
    assert (states.count, len(taken)) == (0, 22)


def test_a_tick_that_finds_a_block_under_way_finishes_it():
    simulation = simulate(pose__rate=1000.0)
    taken = record(simulation, 'pose')
    simulation.advance(0)
    states = states_of(simulation)
    while states.count == 0:
        assert not simulation.prepare(MILLISECOND, budget_ns=0)
    simulation.advance(MILLISECOND)
    assert len(taken) == 2
    assert states.count == SMALLEST_BLOCK
    assert simulation.send_ready(SMALLEST_BLOCK * MILLISECOND)
    assert len(taken) == 1 + SMALLEST_BLOCK


# ------------------------------------------------------------------------------------ the cost

@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_ticks_that_find_all_computed_compute_nothing(method):
    simulation = simulate(pose__rate=1000.0, solver__method=method)
    taken = record(simulation, 'pose')
    simulation.advance(0)
    simulation.prepare(MILLISECOND)
    states, steps = states_of(simulation), Counting(simulation.segment.solver, 'reach')
    for tick in range(1, SMALLEST_BLOCK + 1):
        assert simulation.send_ready(tick * MILLISECOND)
        assert simulation.now_ns == tick * MILLISECOND
    assert (states.count, steps.calls) == (0, 0)
    assert len(taken) == 1 + SMALLEST_BLOCK
    assert not simulation.send_ready((SMALLEST_BLOCK + 1) * MILLISECOND)
    assert simulation.now_ns == SMALLEST_BLOCK * MILLISECOND
    simulation.prepare(SMALLEST_BLOCK * MILLISECOND)
    assert states.count == 0, 'there was nothing to do'
    simulation.prepare((SMALLEST_BLOCK + 1) * MILLISECOND)
    assert states.count == 2 * SMALLEST_BLOCK


def test_each_sample_is_computed_once_and_few_in_vain():
    simulation = simulate(pose__rate=1000.0, joint_states__rate=500.0)
    taken = record(simulation, 'pose', 'joint_states')
    encoded, states = messages_of(simulation), states_of(simulation)
    for tick in range(1, 1001):
        simulation.advance(tick * MILLISECOND)
        simulation.prepare((tick + 1) * MILLISECOND)
    assert len(taken) == 1001 + 501
    ahead = simulation.ready_ns // MILLISECOND - 1001
    assert 0 <= ahead <= LARGEST_BLOCK
    assert 1001 <= encoded['pose'].count <= 1001 + ahead + 1
    assert 501 <= encoded['joint_states'].count <= 501 + ahead // 2 + 1
    # All streams but those whose samples are the same instants ask for states of their own.
    assert states.count <= encoded['pose'].count + encoded['joint_states'].count
    assert states.calls <= 20


# ------------------------------------------------------------------------ what no longer holds

@pytest.mark.parametrize('change', [
    'command', 'rate', 'subscriber', 'no subscriber', 'recorder', 'restart', 'epoch', 'late'])
def test_what_was_computed_ahead_is_dropped_when_it_no_longer_holds(change):
    def run(ahead):
        simulation = simulate(pose__rate=1000.0)
        taken = []
        pose, raw = stream(simulation, 'pose'), stream(simulation, 'imu/data_raw')
        pose.publish = taken.append
        simulation.advance(5 * MILLISECOND)
        if ahead:
            assert simulation.prepare(6 * MILLISECOND)
            assert simulation.ready_ns == 22 * MILLISECOND
        if change == 'command':
            simulation.command(2.0, 1.5)
        elif change == 'rate':
            simulation.apply({'pose.rate': 300.0})
        elif change == 'subscriber':
            raw.publish = taken.append
        elif change == 'no subscriber':
            pose.publish = None
        elif change == 'recorder':
            simulation.log_to(lambda *call: taken.append(call), [raw, pose])
        elif change == 'restart':
            simulation.restart(parameters.checked({'initial.theta': 1.0}))
        elif change == 'epoch':
            simulation.epoch_ns += 1
        else:
            simulation.advance(15 * MILLISECOND, publish_from_ns=10 * MILLISECOND)
        if ahead:
            assert (simulation.ready_ns == -1) == (change != 'late')
            simulation.prepare(30 * MILLISECOND)
        simulation.advance(60 * MILLISECOND)
        return taken, pose.sent, pose.skipped

    assert run(True) == run(False)


def test_a_sink_that_is_set_again_invalidates_nothing():
    simulation = simulate()
    publish(simulation, 'pose')
    simulation.advance(0)
    assert simulation.prepare(10 * MILLISECOND)
    ready_ns = simulation.ready_ns
    stream(simulation, 'pose').publish = stream(simulation, 'pose').publish
    assert simulation.ready_ns == ready_ns > 0


@pytest.mark.parametrize('l3', [1.6, 1e3, 1e4])
def test_however_far_is_computed_ahead_the_present_state_can_be_read(l3):
    """Also where a tick takes many steps, and where the clock stands still meanwhile."""
    simulation, beside = simulate(spin__l3=l3), simulate(spin__l3=l3)
    record(simulation)
    for tick in range(1, 25):
        now = tick // 4 * MILLISECOND
        simulation.advance(now)
        simulation.prepare(now + 8 * MILLISECOND)
        beside.advance(now)
        assert simulation.now_ns == beside.now_ns == now
        assert simulation.state().quaternion.tolist() == beside.state().quaternion.tolist()
    assert simulation.steps > beside.steps


# ------------------------------------------------------------------------------------ failure

def test_a_block_that_fails_leaves_nothing_half_done():
    def fail(stamps_ns, *fields):
        raise MemoryError

    simulation = simulate(pose__rate=1000.0, solver__method='exact')
    taken = record(simulation, 'pose', 'joint_states')
    simulation.advance(0)
    pose = stream(simulation, 'pose')
    original, pose.template.encode = pose.template.encode, fail
    with pytest.raises(MemoryError):
        simulation.prepare(10 * MILLISECOND)
    pose.template.encode = original
    simulation.advance(20 * MILLISECOND)
    assert [t for topic, t, _ in taken if topic == 'pose'] == [
        k * MILLISECOND for k in range(21)]
    assert [t for topic, t, _ in taken if topic == 'joint_states'] == [
        0, 10 * MILLISECOND, 20 * MILLISECOND]


def test_what_cannot_go_on_fails_at_the_same_time_when_computed_ahead():
    def run(ahead):
        simulation = simulate(solver__equations='euler', initial__theta=0.5,
                              initial__theta_dot=-3.0, spin__l3=0.2, spin__lz=-0.2)
        taken = record(simulation, 'joint_states')
        with pytest.raises(IntegrationError) as failure:
            for tick in range(20_000):
                simulation.advance(tick * MILLISECOND)
                if ahead:
                    simulation.prepare((tick + 1) * MILLISECOND)
        return taken, str(failure.value), simulation.now_ns

    assert run(True) == run(False)


def test_a_run_that_ends_is_freed_without_a_search_for_cycles():
    simulation = simulate()
    publish(simulation, 'pose')
    simulation.advance(SECOND)
    segment, on_change = weakref.ref(simulation.segment), simulation.streams[0].on_change
    gc.disable()
    try:
        del simulation
        assert segment() is None
        on_change()             # of a schedule that is no more
    finally:
        gc.enable()


def test_lost_samples_move_no_target():
    """The first sample of a block that is unfinished may be lost."""
    simulation = simulate({'imu.drop_rate': 0.9})
    published = publish(simulation, 'imu/data_raw')
    simulation.advance(0)
    for tick in range(1, 200):
        simulation.prepare(5 * tick * MILLISECOND, budget_ns=0)
        simulation.advance(5 * tick * MILLISECOND)
        assert simulation.now_ns == 5 * tick * MILLISECOND
    assert published
