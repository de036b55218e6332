# SPDX-License-Identifier: Apache-2.0
"""The pipeline without ROS: what is sent depends on the parameters and the commands alone."""

import gc
import itertools
import math
import random
import struct
import sys
import tracemalloc

import numpy as np
import pytest

from spinning_top_sim import solve
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.phases import MomentumState
from spinning_top_sim.solvers.step_columns import StepColumns
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Simulation

SECOND = 1_000_000_000
EPOCH_NS = 1_700_000_000 * SECOND
POSE_RATE_NS = 10_000_000
MILLISECOND = 1_000_000
VARIANTS = {
    'rk45': {},
    'exact': {'solver.method': 'exact'},
    'euler': {'solver.equations': 'euler'},
    'wild': {'initial.theta': 2.5, 'initial.theta_dot': 3.0, 'spin.l3': 0.3, 'spin.lz': -0.1},
    'near a pole': {'initial.theta': 1e-7, 'spin.l3': 0.5, 'spin.lz': 0.5},
    'sleeping': {'initial.theta': 0.0, 'spin.l3': 3.0},
    'no gravity': {'top.gravity': 0.0, 'spin.lz': 0.2},
    'through a pole': {'initial.theta': 0.5, 'spin.l3': 0.2, 'spin.lz': 0.2},
    'a noisy sensor elsewhere': {
        'initial.theta': 2.0, 'initial.phi': 0.3, 'imu.lever_arm': (0.1, -0.2, 0.3),
        'imu.rpy': (0.1, 0.2, 0.3), 'imu.gyroscope_noise_density': 1e-3,
        'imu.accelerometer_noise_density': 1e-2, 'imu.gyroscope_random_walk': 1e-4,
        'imu.accelerometer_range': 12.0, 'imu.accelerometer_resolution': 0.01,
        'imu.gyroscope_resolution': 0.5},
    'uneven rates': {'pose.rate': 333.0, 'imu.rate': 77.7, 'joint_states.rate': 7.0},
}


def simulate(**values):
    dotted = {name.replace('__', '.'): value for name, value in values.items()}
    return Simulation(parameters.checked(dotted), EPOCH_NS)


def stream(simulation, topic):
    return next(stream for stream in simulation.streams if stream.topic == topic)


def listen(simulation, *topics, sink='record'):
    """Take what these streams (all where none is named) send: [(topic, stamp, bytes)]."""
    taken = []

    def attach(one):
        if sink == 'record':
            one.record = lambda stamp, data: taken.append((one.topic, stamp, data))
        else:
            one.publish = lambda data: taken.append((one.topic, None, data))

    for one in simulation.streams:
        if not topics or one.topic in topics:
            attach(one)
    return taken


def stamps(taken, topic):
    return [stamp - EPOCH_NS for name, stamp, _ in taken if name == topic]


def doubles(data, count):
    """Return the last doubles of a message."""
    return struct.unpack(f'<{count}d', data[-8 * count:])


# ------------------------------------------------------------------------- independent of ticks

@pytest.mark.parametrize('name', VARIANTS)
def test_what_is_sent_does_not_depend_on_how_ticks_fall(name):
    """One call, random ticks, and ticks that give way at random: the same bytes in order."""
    duration, commands = 3 * SECOND, ((SECOND, 0.7), (2 * SECOND + 1, 1.1))

    def run(ticks, give_way=lambda: False):
        simulation = Simulation(parameters.checked(VARIANTS[name]), EPOCH_NS)
        taken = listen(simulation)
        for at_ns, factor in (*commands, (duration, 0.0)):
            for tick in sorted({*(t for t in ticks if t < at_ns), at_ns}):
                if tick > simulation.now_ns:
                    while not simulation.advance(tick, give_way=give_way):
                        pass
            if factor:
                simulation.command(factor * simulation.l3, factor * simulation.lz)
        return taken

    whole = run([])
    assert len(whole) > 900 or name == 'uneven rates'
    for seed in range(3):
        dice = random.Random(seed)
        ticks = [dice.randrange(duration) for _ in range(dice.choice((5, 100, 2000)))]
        parts = run(ticks, lambda: dice.random() < 0.3)     # noqa: B023 - called in this turn
        assert parts == whole


def test_a_stream_sends_the_same_whoever_else_listens():
    alone = simulate()
    taken_alone = listen(alone, 'pose')
    alone.advance(2 * SECOND)
    crowd = simulate()
    taken = listen(crowd)
    crowd.advance(2 * SECOND)
    assert [entry for entry in taken if entry[0] == 'pose'] == taken_alone


def test_where_publishing_fails_the_log_has_the_instant_whole():
    """So it is when a signal takes the context away in the midst of it."""
    undisturbed = simulate()
    expected = listen(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = listen(simulation)

    def fail(data):
        if simulation.now_ns >= SECOND // 3:
            raise RuntimeError('the context is gone')

    stream(simulation, 'joint_states').publish = fail
    with pytest.raises(RuntimeError, match='gone'):
        simulation.advance(SECOND)
    last = taken[-1][1]
    assert EPOCH_NS + SECOND // 3 < last < EPOCH_NS + SECOND // 2
    assert taken == [entry for entry in expected if entry[1] <= last]


def test_samples_are_on_the_grid_and_in_order_of_time():
    simulation = simulate()
    taken = listen(simulation)
    simulation.advance(2 * SECOND)
    times = [stamp for _, stamp, _ in taken]
    assert times == sorted(times)
    for one in simulation.streams:
        period = round(SECOND / parameters.defaults()[f'{one.parameter}.rate'])
        assert stamps(taken, one.topic) == list(range(0, 2 * SECOND + 1, period))


def test_giving_way_in_a_long_integration_loses_nothing_and_leaves_a_state_to_read():
    """A wheel so fast that a sample takes thousands of steps; ticks end in their midst."""
    fast = {'spin__l3': 1e4, 'joint_states__rate': 500.0}
    whole = simulate(**fast)
    expected = listen(whole, 'joint_states')
    whole.advance(6_000_000)
    assert whole.steps > 5000
    broken = simulate(**fast)
    taken = listen(broken, 'joint_states')
    start, found = parameters.start_state(broken.values), []
    while not broken.advance(6_000_000, give_way=lambda: True):
        state = broken.state()
        assert abs(broken.energy_drift(state)) <= 1e-14
        assert abs(state.l3 / 1e4 - 1.0) <= 1e-14
        found.append((broken.now_ns * 1e-9, state.theta, state.phi, state.psi))
    assert len(found) > 6
    assert found[-1][0] <= 6e-3 and all(a[0] < b[0] for a, b in itertools.pairwise(found))
    t, *angles = zip(*found, strict=True)
    exact = solve(broken.top, start, t)
    assert np.transpose(angles) == pytest.approx(
        np.column_stack((exact.theta, exact.phi, exact.psi)), abs=1e-8)
    assert taken == expected


def test_the_energy_of_a_hanging_top_drifts_upwards_where_it_grows():
    """The drift is over the magnitude of an energy that is below 0."""
    simulation = simulate(initial__theta=2.8, spin__l3=0.1, spin__lz=-0.05,
                          solver__equations='euler', solver__rtol=1e-4, solver__atol=1e-4)
    taken = listen(simulation, '~/invariants')
    simulation.advance(20 * SECOND)
    energies, drifts = np.array([doubles(data, 8) for _, _, data in taken])[:, [0, 3]].T
    assert energies[0] < -2.0 and simulation.start_energy == energies[0]
    assert abs(drifts[-1]) > 1e-5
    assert drifts == pytest.approx((energies - energies[0]) / -energies[0], rel=1e-9, abs=1e-15)
    assert simulation.energy_drift(simulation.state()) == drifts[-1]


def test_giving_way_goes_on_without_listeners_too():
    simulation = simulate(spin__l3=1e4)
    calls = 0
    while not simulation.advance(2_000_000, give_way=lambda: True):
        calls += 1
        before = simulation.now_ns
        simulation.state()
    assert calls > 2
    assert before > 0
    assert simulation.now_ns == 2_000_000


def test_a_command_in_the_midst_of_a_long_integration_is_taken():
    simulation = simulate(spin__l3=1e4)
    taken = listen(simulation, 'joint_states')
    assert not simulation.advance(SECOND, give_way=lambda: simulation.steps > 800)
    simulation.command(1.0, 0.5)
    at_ns = simulation.history[-1][0]
    assert simulation.now_ns >= at_ns > 0
    simulation.advance(SECOND)
    assert stamps(taken, 'joint_states') == list(range(0, SECOND + 1, POSE_RATE_NS))


# ------------------------------------------------------------------------- computed ahead

@pytest.mark.parametrize('name', VARIANTS)
def test_what_is_sent_does_not_depend_on_how_far_is_computed_ahead(name):
    """With commands, changes of rate, and listeners who come and go in between."""
    def run(instants, budget_ns=None):
        values = {**VARIANTS[name], 'imu.gyroscope_noise_density': 1e-3}
        simulation = Simulation(parameters.checked(values), EPOCH_NS)
        taken = listen(simulation)
        l3, lz = simulation.l3, simulation.lz
        ready = 0
        for tick in range(1, 61):
            if instants and simulation.send_ready(tick * 7_654_321):
                ready += 1
            else:
                simulation.advance(tick * 7_654_321)
            assert simulation.now_ns == tick * 7_654_321
            if instants:
                for _ in range(tick % 5):
                    simulation.prepare((tick + 9) * 7_654_321, instants, budget_ns)
            if tick == 20:
                simulation.command(1.01 * l3, 1.01 * lz)
            if tick == 30:
                one = stream(simulation, 'joint_states')
                one.set_rate(250.0)
                one.resume(simulation.now_ns)
            if tick == 40:
                stream(simulation, 'imu/data_raw').record = None
            if tick == 50:
                one = stream(simulation, 'imu/data_raw')
                one.record = lambda stamp, data: taken.append(('back', stamp, data))
                simulation.command(l3, lz)
        assert not instants or ready > 10
        return taken

    once = run(0)
    assert len(once) > 300
    assert run(1) == once
    assert run(16) == once
    assert run(64) == once
    assert run(16, budget_ns=0) == once
    assert run(64, budget_ns=100_000) == once


@pytest.mark.parametrize('name', ['rk45', 'exact', 'through a pole'])
def test_a_computation_without_time_goes_on_with_the_next_call(name):
    simulation = Simulation(parameters.checked(VARIANTS[name]))
    taken = listen(simulation, 'pose', 'joint_states')
    simulation.advance(0)
    calls = 1
    while not simulation.prepare(SECOND // 10, 8, budget_ns=0):
        assert not simulation.send_ready(SECOND // 20), 'nothing is ready before all is'
        calls += 1
    assert 4 < calls < 100
    assert simulation.prepare(SECOND // 10, 8, budget_ns=0), 'there is nothing left to do'
    samples = samples_of(simulation.solver)
    assert simulation.send_ready(SECOND // 10)
    assert (samples.count, len(taken)) == (0, 22)


def test_a_tick_that_finds_a_computation_under_way_finishes_it():
    simulation = simulate(pose__rate=1000.0)
    taken = listen(simulation, 'pose')
    simulation.advance(0)
    samples = samples_of(simulation.solver)
    while samples.count == 0:
        assert not simulation.prepare(10 * MILLISECOND, 16, budget_ns=0)
    simulation.advance(MILLISECOND)
    assert len(taken) == 2
    assert samples.count == 16
    assert simulation.send_ready(16 * MILLISECOND)
    assert len(taken) == 17


def test_less_is_computed_ahead_at_first_and_after_a_command():
    simulation = simulate(pose__rate=1000.0)
    listen(simulation, 'pose')
    samples = samples_of(simulation.solver)

    def batches():
        sizes = []
        for _ in range(6):
            before = samples.count
            while samples.count == before:
                simulation.advance(simulation.now_ns + MILLISECOND)
                simulation.prepare(simulation.now_ns + MILLISECOND, 128)
            sizes.append(samples.count - before)
        return sizes

    simulation.advance(0)
    assert batches() == [1 + 16, 32, 64, 128, 128, 128], 'the tick has to compute its own'
    simulation.command(1.7, simulation.lz)
    samples = samples_of(simulation.solver)
    assert batches() == [1 + 16, 32, 64, 128, 128, 128]


def test_what_fails_in_a_computation_leaves_nothing_half_done():
    def fail(stamp_ns, *runs):
        raise MemoryError

    simulation = simulate(pose__rate=1000.0, solver__method='exact')
    taken = listen(simulation, 'pose', 'joint_states')
    simulation.advance(0)
    pose = stream(simulation, 'pose')
    original, pose.template.encode = pose.template.encode, fail
    with pytest.raises(MemoryError):
        simulation.prepare(10 * MILLISECOND, 16)
    pose.template.encode = original
    simulation.advance(20 * MILLISECOND)
    assert stamps(taken, 'pose') == list(range(0, 21 * MILLISECOND, MILLISECOND))
    assert stamps(taken, 'joint_states') == [0, 10 * MILLISECOND, 20 * MILLISECOND]


@pytest.mark.parametrize('name', VARIANTS)
def test_messages_in_columns_are_those_of_single_states(name):
    simulation = Simulation(parameters.checked({**VARIANTS[name], 'imu_data.enabled': True}))
    beside = Simulation(parameters.checked({**VARIANTS[name], 'imu_data.enabled': True}))
    topics = ('pose', 'joint_states', 'imu/data_raw', 'imu/data', 'ground_truth/imu_bias',
              'ground_truth/imu', 'ground_truth/odom', '/clock')
    for topic in topics:
        taken = listen(simulation, topic)
        simulation.advance(simulation.now_ns + SECOND)
        assert len(taken) > 5
        one = stream(beside, topic)
        for _, stamp_ns, data in taken:
            assert data == one.encode(beside.solver.at_ns(stamp_ns), stamp_ns, stamp_ns), topic
        stream(simulation, topic).record = None
    assert simulation.in_columns == (name in ('rk45', 'wild', 'uneven rates',
                                              'a noisy sensor elsewhere'))


def test_computing_ahead_computes_each_sample_once_and_little_in_vain():
    simulation = simulate(pose__rate=1000.0, joint_states__rate=500.0)
    taken = listen(simulation, 'pose', 'joint_states')
    encodes = messages_of(simulation)
    samples = samples_of(simulation.solver)
    for tick in range(1, 1001):
        simulation.advance(tick * MILLISECOND)
        simulation.prepare((tick + 1) * MILLISECOND, 16)
    assert [len(stamps(taken, topic)) for topic in ('pose', 'joint_states')] == [1001, 501]
    assert 1001 <= encodes['pose'].count <= 1017
    assert 501 <= encodes['joint_states'].count <= 509
    # Both share the first one, single; later `pose` reads columns, and `joint_states` too few.
    assert samples.count == encodes['pose'].count + encodes['joint_states'].count - 1


@pytest.mark.parametrize('name', ['rk45', 'exact'])
def test_streams_of_one_rate_share_the_states(name):
    simulation = Simulation(parameters.checked(VARIANTS[name]))
    taken = listen(simulation, 'pose', 'joint_states', 'ground_truth/odom')
    samples = samples_of(simulation.solver)
    simulation.advance(SECOND)
    assert len(taken) == 3 * 101
    assert samples.count == 101


def test_a_log_gets_the_rows_of_an_instant_at_once_and_the_same_bytes():
    simulation, beside = simulate(pose__rate=1000.0), simulate(pose__rate=1000.0)
    calls = []
    chosen = [stream(simulation, topic) for topic in ('imu/data_raw', 'pose', '~/invariants')]
    simulation.log_to(lambda *call: calls.append(call), chosen)
    expected = listen(beside, *(one.topic for one in chosen))
    beside.advance(SECOND)
    simulation.advance(SECOND // 2)
    assert [one.recorded for one in simulation.streams].count(True) == 3
    for tick in range(501, 1001):
        simulation.prepare(tick * MILLISECOND, 16)
        assert simulation.send_ready(tick * MILLISECOND)
    assert len(calls) == 1001, 'an instant is one call'
    assert all(size == sum(map(len, messages)) for _, _, messages, size in calls)
    assert [(chosen[index].topic, stamp, data) for indices, stamp, messages, _ in calls
            for index, data in zip(indices, messages, strict=True)] == expected
    simulation.log_to(calls.append, ())
    simulation.advance(2 * SECOND)
    assert len(calls) == 1001
    assert not any(one.wanted for one in simulation.streams)


def test_late_samples_go_to_the_log_all_the_same():
    simulation = simulate()
    calls = []
    pose = stream(simulation, 'pose')
    simulation.log_to(lambda *call: calls.append(call), [pose])
    published = listen(simulation, 'pose', 'joint_states', sink='publish')
    simulation.advance(0)
    simulation.prepare(SECOND, 1)
    simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND + 1)
    assert len(calls) == 1001
    assert len(published) == 2 * 101
    for topic in ('pose', 'joint_states'):
        assert (stream(simulation, topic).sent, stream(simulation, topic).skipped) == (101, 900)


def test_ticks_that_find_all_prepared_compute_nothing():
    simulation = simulate(pose__rate=1000.0)
    taken = listen(simulation, 'pose')
    simulation.advance(0)
    simulation.prepare(10 * MILLISECOND, 1)
    samples = samples_of(simulation.solver)
    steps = Counting(simulation.solver, 'reach_ns')
    for tick in range(1, 11):
        assert simulation.send_ready(tick * MILLISECOND)
        assert simulation.now_ns == tick * MILLISECOND
    assert (samples.count, steps.count) == (0, 0)
    assert len(taken) == 11
    assert not simulation.send_ready(11 * MILLISECOND)
    assert simulation.now_ns == 10 * MILLISECOND
    simulation.prepare(10 * MILLISECOND, 16)
    assert samples.count == 0, 'there was nothing to do'
    simulation.prepare(11 * MILLISECOND, 16)
    assert samples.count == 16


@pytest.mark.parametrize('change', ['command', 'rate', 'listener', 'recorder', 'restart'])
def test_what_was_computed_ahead_is_forgotten_when_it_no_longer_holds(change):
    def run(ahead):
        simulation = simulate(pose__rate=1000.0)
        taken = listen(simulation, 'pose')
        simulation.advance(5 * MILLISECOND)
        if ahead:
            simulation.prepare(6 * MILLISECOND, 16)
        pose, imu = stream(simulation, 'pose'), stream(simulation, 'imu/data_raw')
        if change == 'command':
            simulation.command(2.0, 1.5)
        elif change == 'rate':
            pose.set_rate(300.0)
            pose.resume(simulation.now_ns)
        elif change == 'listener':
            imu.publish = lambda data: taken.append(('imu', None, data))
        elif change == 'recorder':
            pose.record = lambda stamp, data: taken.append(('other', stamp, data))
        else:
            simulation.restart(parameters.checked({'initial.theta': 1.0}))
        if ahead:
            simulation.prepare(30 * MILLISECOND, 1)
        simulation.advance(60 * MILLISECOND)
        return taken

    assert run(True) == run(False)


@pytest.mark.parametrize('l3', [1.6, 1e3, 1e5])
def test_however_far_is_computed_ahead_the_present_state_can_be_read(l3):
    """Also where a tick takes many steps, and where the clock stands still meanwhile."""
    simulation, beside = simulate(spin__l3=l3), simulate(spin__l3=l3)
    listen(simulation)
    for tick in range(1, 41):
        now = tick // 4 * 5 * MILLISECOND
        simulation.advance(now)
        simulation.prepare(now + 8 * MILLISECOND, 16)
        beside.advance(now)
        assert simulation.now_ns == beside.now_ns == now
        assert simulation.state().quaternion == beside.state().quaternion
    assert simulation.steps > beside.steps


def test_an_exact_solution_made_beside_is_taken_for_its_own_motion_only():
    simulation = simulate()
    late = simulation.exact_in_advance()
    simulation.command(2.0, 1.5)
    late()
    assert simulation.exact().solution.start.l3 == 2.0
    simulation.command(1.8, 1.4)
    simulation.exact_in_advance()()
    there = simulation.exact()
    assert there.solution.start.l3 == 1.8
    assert simulation.exact() is there


# --------------------------------------------------------------------- nothing for nobody

class Counting:
    """Counts what methods of one object are called for."""

    def __init__(self, owner, name):
        self.count = 0
        self.also(owner, name, lambda *args: 1)

    def also(self, owner, name, number):
        """Count calls of another method too, as many as `number` says of its arguments."""
        original = getattr(owner, name)

        def counted(*args):
            self.count += number(*args)
            return original(*args)
        setattr(owner, name, counted)
        return self


def samples_of(solver):
    """Count the states that are asked of a solver, one by one or as columns."""
    return Counting(solver, 'at_ns').also(solver, 'columns_ns', len)


def messages_of(simulation):
    """Count the messages that are encoded of each topic."""
    return {one.topic: Counting(one, 'encode').also(
        one, 'encode_columns', lambda states, epoch_ns, times: len(times))
        for one in simulation.streams}


def test_without_a_listener_nothing_is_encoded_and_the_solver_is_not_sampled():
    simulation = simulate()
    encodes = messages_of(simulation)
    samples = samples_of(simulation.solver)
    for tick in range(1, 101):
        simulation.advance(tick * POSE_RATE_NS)
    assert simulation.now_ns == SECOND
    assert samples.count == 0
    assert {topic: counted.count for topic, counted in encodes.items()} == dict.fromkeys(
        encodes, 0)
    assert all(one.sent == one.skipped == 0 for one in simulation.streams)


@pytest.mark.parametrize('topic', ['pose', 'imu/data_raw', '~/invariants', '/clock'])
def test_only_the_stream_that_is_listened_to_is_encoded(topic):
    simulation = simulate()
    encodes = messages_of(simulation)
    samples = samples_of(simulation.solver)
    simulation.advance(SECOND)
    taken = listen(simulation, topic, sink='publish')
    simulation.advance(2 * SECOND)
    rate = parameters.defaults()[f'{stream(simulation, topic).parameter}.rate']
    assert len(taken) == rate
    assert encodes.pop(topic).count == samples.count == rate
    assert all(counted.count == 0 for counted in encodes.values())


def test_a_sample_is_encoded_once_for_all_who_take_it():
    simulation = simulate()
    encodes = messages_of(simulation)
    published, recorded = [], []
    pose = stream(simulation, 'pose')
    pose.publish = published.append
    pose.record = lambda stamp, data: recorded.append(data)
    simulation.advance(SECOND)
    assert encodes['pose'].count == len(published) == len(recorded) == 101
    assert all(a is b for a, b in zip(published, recorded, strict=True))


@pytest.mark.parametrize('ahead', [0, 16])
def test_ticks_leave_nothing_behind(ahead):
    """Blocks of memory in use do not become more, whoever listens, however long it runs."""
    simulation = simulate(imu__rate=1000.0, pose__rate=1000.0, joint_states__rate=1000.0)
    for one in simulation.streams:
        one.publish = len
        one.record = lambda stamp, data: None

    def run(ticks):
        for _ in range(ticks):
            simulation.advance(simulation.now_ns + MILLISECOND)
            if ahead:
                simulation.prepare(simulation.now_ns + MILLISECOND, ahead)
        gc.collect()
        return sys.getallocatedblocks()

    run(2000)
    before = run(1000)
    assert run(3000) - before < 100


def test_a_tick_allocates_little():
    """The most that is in use at a time during a tick, over that between two: a few states."""
    simulation = simulate(imu__rate=1000.0, pose__rate=1000.0, joint_states__rate=1000.0)
    for topic in ('pose', 'joint_states', 'imu/data_raw'):
        stream(simulation, topic).publish = len
    for tick in range(1, 101):
        simulation.advance(tick * 1_000_000)
    tracemalloc.start()
    try:
        most = 0
        for tick in range(101, 201):
            before, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            simulation.advance(tick * 1_000_000)
            most = max(most, tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    assert 500 < most < 16_000


def test_a_tick_without_listeners_costs_the_same_however_many_streams_there_are():
    """Calls of Python functions, not seconds."""
    def calls(**values):
        simulation = simulate(**values)
        simulation.advance(1_000_000)
        count = [0]

        def count_call(frame, event, argument):
            count[0] += event == 'call'
        before = sys.getprofile()
        sys.setprofile(count_call)
        try:
            for tick in range(2, 1002):
                simulation.advance(tick * 1_000_000)
        finally:
            sys.setprofile(before)
        return count[0]

    few = calls()
    assert calls(imu_data__enabled=True, clock__enabled=True, pose__rate=5000.0,
                 imu__rate=5000.0) == few


@pytest.mark.parametrize('how', ['columns', 'one by one'])
def test_a_column_that_nobody_needs_is_not_computed(how, monkeypatch):
    """A pose needs no angle and no rate, joints no body rate, odometry no angle."""
    computed = set()

    def watch(kind, name):
        original = getattr(kind, name)
        monkeypatch.setattr(kind, name, property(
            lambda self: (computed.add(name), original._compute(self))[1]))

    kind, angles, values = {
        'columns': (StepColumns, 'half_sum', {}),
        'one by one': (MomentumState, '_polar',        # it passes the top
                       {'initial__theta': 0.5, 'spin__l3': 0.2, 'spin__lz': 0.2})}[how]
    watch(kind, angles)
    watch(kind, 'transverse_rate')
    for topic, needed in (('pose', set()), ('joint_states', {angles}),
                          ('ground_truth/odom', {'transverse_rate'})):
        simulation = simulate(**values)
        taken = listen(simulation, topic)
        computed.clear()
        simulation.advance(SECOND)
        assert len(taken) == 101
        assert computed == needed, topic


def test_equilibria_and_free_motion_take_no_steps():
    for name in ('sleeping', 'no gravity'):
        simulation = Simulation(parameters.checked(VARIANTS[name]))
        listen(simulation)
        simulation.advance(SECOND)
        assert simulation.steps == simulation.evaluations == 0, name


def test_a_listener_who_comes_late_gets_the_next_sample_of_the_grid_not_the_past():
    simulation = simulate()
    simulation.advance(SECOND + 3)
    taken = listen(simulation, 'pose')
    simulation.advance(SECOND + 2 * POSE_RATE_NS)
    assert stamps(taken, 'pose') == [SECOND + POSE_RATE_NS, SECOND + 2 * POSE_RATE_NS]


def test_a_listener_who_goes_and_comes_back_gets_no_backlog():
    simulation = simulate()
    taken = listen(simulation, 'pose')
    simulation.advance(SECOND)
    stream(simulation, 'pose').record = None
    simulation.advance(5 * SECOND)
    listen(simulation, 'pose')
    again = listen(simulation, 'pose')
    simulation.advance(5 * SECOND + POSE_RATE_NS)
    assert len(taken) == 101
    assert stamps(again, 'pose') == [5 * SECOND + POSE_RATE_NS]


# ------------------------------------------------------------------------------- coming late

def test_late_samples_are_not_published_but_counted():
    simulation = simulate()
    published = listen(simulation, 'pose', sink='publish')
    simulation.advance(0)
    assert simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND)
    pose = stream(simulation, 'pose')
    assert pose.sent == len(published) == 102       # t = 0 and [9 s, 10 s]
    assert pose.skipped == 899
    assert pose.sent + pose.skipped == 1001


def test_late_samples_are_recorded_all_the_same():
    simulation = simulate()
    published = listen(simulation, 'pose', 'joint_states', sink='publish')
    recorded = listen(simulation, 'pose')
    simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND + 1)
    assert stamps(recorded, 'pose') == list(range(0, 10 * SECOND + 1, POSE_RATE_NS))
    for topic in ('pose', 'joint_states'):
        assert len([entry for entry in published if entry[0] == topic]) == 100
        one = stream(simulation, topic)
        assert (one.sent, one.skipped) == (100, 901)


def test_skipping_keeps_the_grid_of_any_rate():
    simulation = simulate(pose__rate=333.0)
    taken = listen(simulation, 'pose')
    stream(simulation, 'pose').publish = lambda data: None
    stream(simulation, 'pose').record = None
    simulation.advance(SECOND, publish_from_ns=SECOND // 2)
    del taken[:]
    listen(simulation, 'pose')
    more = listen(simulation, 'pose')
    simulation.advance(2 * SECOND)
    period = round(SECOND / 333.0)
    assert {stamp % period for stamp in stamps(more, 'pose')} == {0}


# ------------------------------------------------------------------------ rates and commands

@pytest.mark.parametrize(('before', 'after'), [(100.0, 200.0), (200.0, 100.0), (100.0, 33.0),
                                               (1.0, 1000.0), (10000.0, 10.0)])
def test_a_change_of_rate_goes_on_on_the_new_grid(before, after):
    simulation = simulate(pose__rate=before)
    taken = listen(simulation, 'pose')
    changed_at = 123_456_789
    simulation.advance(changed_at)
    pose = stream(simulation, 'pose')
    pose.set_rate(after)
    pose.resume(simulation.now_ns)
    simulation.advance(SECOND)
    old, new = round(SECOND / before), round(SECOND / after)
    expected = [*range(0, changed_at + 1, old),
                *(t for t in range(0, SECOND + 1, new) if t > changed_at)]
    assert stamps(taken, 'pose') == expected


def test_a_command_keeps_the_angles_and_the_nutation_rate_and_sets_the_momenta():
    simulation = simulate()
    simulation.advance(777_777_777)
    before = simulation.state()
    angles = before.theta, before.phi, before.psi, before.theta_dot
    simulation.command(2.0, -0.5)
    after = simulation.state()
    assert (after.theta, after.phi, after.psi) == pytest.approx(angles[:3], abs=1e-14)
    assert after.theta_dot == pytest.approx(angles[3], abs=1e-12)   # rtol is 1e-11
    assert (after.l3_start, after.lz_start) == (simulation.l3, simulation.lz) == (2.0, -0.5)
    assert simulation.history == [(777_777_777, 2.0, -0.5)]


def test_commands_are_applied_at_their_time_again_with_the_same_bytes():
    dice = random.Random(3)
    first = simulate()
    taken = listen(first)
    for _ in range(10):
        first.advance(first.now_ns + dice.randrange(1, SECOND // 3))
        first.command(dice.uniform(-3.0, 3.0), dice.uniform(-2.0, 2.0))
    end_ns = first.now_ns + SECOND
    first.advance(end_ns)
    again = simulate()
    taken_again = listen(again)
    for at_ns, l3, lz in first.history:
        again.advance(at_ns)
        again.command(l3, lz)
    again.advance(end_ns)
    assert taken_again == taken


@pytest.mark.parametrize(('l3', 'lz', 'named'), [
    (math.nan, 0.0, 'l3 = nan'), (0.0, math.inf, 'lz = inf'), (-math.inf, 0.0, 'l3 = -inf'),
    (1e300, 1e300, '1e+300'), (1e100, 0.5, '1e+100'), (1e20, 1e20, '1e+20'),
    (1e16, -1e16, '1e+16')])
def test_a_refused_command_names_the_value_and_changes_nothing(l3, lz, named):
    undisturbed = simulate()
    expected = listen(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = listen(simulation)
    simulation.advance(SECOND // 3)
    momenta = simulation.l3, simulation.lz
    with pytest.raises(ValueError, match=r'must be finite|no motion from') as refusal:
        simulation.command(l3, lz)
    assert named in str(refusal.value)
    simulation.advance(SECOND)
    assert taken == expected
    assert (simulation.l3, simulation.lz) == momenta
    assert simulation.history == []


@pytest.mark.parametrize(('theta', 'sign'), [(0.0, 1.0), (math.pi, -1.0)])
def test_at_a_pole_only_lz_of_the_pole_is_taken(theta, sign):
    simulation = simulate(initial__theta=theta, spin__l3=3.0, spin__lz=sign * 3.0)
    simulation.advance(SECOND)
    for lz in (-sign * 2.0, 0.0, sign * 2.0000001):
        with pytest.raises(ValueError, match=r'lz = .*pole'):
            simulation.command(2.0, lz)
    simulation.command(2.0, sign * 2.0)
    assert simulation.lz == sign * 2.0


# --------------------------------------------------------------------------- restart, failure

def test_a_restart_gives_the_same_bytes_again_but_for_stamps():
    simulation = simulate()
    taken = listen(simulation)
    simulation.advance(SECOND)
    first = list(taken)
    simulation.command(0.5, 0.1)
    simulation.advance(2 * SECOND)
    simulation.restart(parameters.checked({}))
    del taken[:]
    simulation.advance(SECOND)
    assert taken == first
    assert simulation.history == []


def test_a_restart_keeps_sinks_counts_and_steps():
    simulation = simulate()
    listen(simulation, 'pose', sink='publish')
    simulation.advance(SECOND)
    steps = simulation.steps
    assert steps > 0
    simulation.restart(parameters.checked({'pose.rate': 50.0}))
    simulation.advance(SECOND)
    assert stream(simulation, 'pose').sent == 101 + 51
    assert simulation.steps == 2 * steps


def test_a_restart_that_is_refused_leaves_the_motion_as_it_was():
    undisturbed = simulate()
    expected = listen(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = listen(simulation)
    simulation.advance(SECOND // 2)
    bad = {**parameters.checked({}), 'initial.theta': 0.0, 'spin.lz': 0.5}
    with pytest.raises(ValueError, match='pole'):
        simulation.restart(bad)
    with pytest.raises(ValueError, match=r'1e\+20'):
        simulation.restart({**parameters.checked({}), 'spin.l3': 1e20, 'spin.lz': 1e20})
    simulation.advance(SECOND)
    assert taken == expected


def test_the_euler_form_fails_at_a_pole_with_a_reason_and_can_be_restarted():
    through = {'solver__equations': 'euler', 'initial__theta': 0.5, 'initial__theta_dot': -3.0,
               'spin__l3': 0.2, 'spin__lz': -0.2}
    simulation = simulate(**through)
    taken = listen(simulation, 'joint_states')
    with pytest.raises(IntegrationError, match='leapt over a pole'):
        simulation.advance(60 * SECOND)
    assert 0 <= simulation.now_ns < 60 * SECOND
    assert stamps(taken, 'joint_states') == list(
        range(0, len(taken) * POSE_RATE_NS, POSE_RATE_NS))
    assert math.isfinite(simulation.state().energy)
    with pytest.raises(IntegrationError):           # it does not go on by itself
        simulation.advance(60 * SECOND)
    simulation.restart(parameters.checked({'initial.theta': 0.5, 'initial.theta_dot': -3.0,
                                           'spin.l3': 0.2, 'spin.lz': -0.2}))
    assert simulation.advance(5 * SECOND)


@pytest.mark.parametrize('name', VARIANTS)
def test_angles_and_rates_are_the_same_together_and_one_by_one(name):
    solver = Simulation(parameters.checked(VARIANTS[name])).solver
    for ns in range(0, SECOND, 7_654_321):
        together, each = solver.at_ns(ns), solver.at_ns(ns)
        assert together.euler_angles == (each.phi, each.theta, each.psi)
        assert together.euler_rates == (each.phi_dot, each.theta_dot, each.psi_dot)


def test_what_cannot_go_on_fails_at_the_same_time_when_computed_ahead():
    def run(ahead):
        simulation = simulate(solver__equations='euler', initial__theta=0.5,
                              initial__theta_dot=-3.0, spin__l3=0.2, spin__lz=-0.2)
        taken = listen(simulation, 'joint_states')
        with pytest.raises(IntegrationError) as failure:
            for tick in range(20_000):
                simulation.advance(tick * MILLISECOND)
                if ahead:
                    simulation.prepare((tick + 1) * MILLISECOND, 16)
        return taken, str(failure.value), simulation.now_ns

    assert run(True) == run(False)


def test_the_euler_form_cannot_start_at_a_pole():
    with pytest.raises((ValueError, IntegrationError), match='theta'):
        simulate(solver__equations='euler', initial__theta=0.0, spin__l3=1.0, spin__lz=1.0)
