# SPDX-License-Identifier: Apache-2.0
"""The pipeline without ROS: what is sent depends on the parameters and the commands alone."""

import gc
import itertools
import math
import random
import sys
import tracemalloc

import numpy as np
import pytest
from helpers.simulations import (
    EPOCH_NS,
    MILLISECOND,
    SECOND,
    doubles,
    messages_of,
    publish,
    record,
    simulate,
    states_of,
    stream,
    times,
)
from spinning_top_sim.streams.schedule import MOST_PIECES, STEPS_IN_A_PIECE

from spinning_top_sim import solve
from spinning_top_sim.solvers import exact, rk45
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.propagator import Propagator
from spinning_top_sim.streams import parameters, pipeline

PERIOD_NS = 10 * MILLISECOND        # of most streams
SLEEPING = {'initial.theta': 0.0, 'spin.l3': 3.0}
NO_GRAVITY = {'top.gravity': 0.0, 'spin.lz': 0.2}


# ------------------------------------------------------------------------------ what is sent

def test_samples_are_on_the_grid_and_in_order_of_time():
    simulation = simulate()
    taken = record(simulation)
    simulation.advance(2 * SECOND)
    all_times = [t_ns for _, t_ns, _ in taken]
    assert all_times == sorted(all_times)
    for one in simulation.streams:
        period = round(SECOND / parameters.checked({})[one.rate_parameter])
        assert times(taken, one.topic) == list(range(0, 2 * SECOND + 1, period))


def test_a_log_gets_an_instant_in_one_call():
    simulation = simulate(pose__rate=1000.0)
    chosen = [stream(simulation, topic) for topic in ('imu/data_raw', 'pose', '~/invariants')]
    calls = []
    simulation.log_to(lambda *call: calls.append(call), chosen)
    simulation.advance(SECOND)
    assert [stamp_ns for _, stamp_ns, _, _ in calls] == [
        EPOCH_NS + k * MILLISECOND for k in range(1001)]
    for k, (numbers, _, messages, size) in enumerate(calls):
        assert set(numbers) == {1} | ({0} if k % 5 == 0 else set()) | (
            {2} if k % 100 == 0 else set())
        assert [len(message) for message in messages] == [
            len(chosen[number].template) for number in numbers]
        assert size == sum(map(len, messages))
    simulation.log_to(lambda *call: calls.append(call), ())
    simulation.advance(2 * SECOND)
    assert len(calls) == 1001
    assert not any(one.has_sinks for one in simulation.streams)


def test_where_publishing_fails_the_log_has_the_instant_whole():
    """So it is when a signal takes the context away in the midst of it."""
    undisturbed = simulate()
    expected = record(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = record(simulation)

    def fail(data):
        if simulation.now_ns >= SECOND // 3:
            raise RuntimeError('the context is gone')

    stream(simulation, 'joint_states').publish = fail
    with pytest.raises(RuntimeError, match='gone'):
        simulation.advance(SECOND)
    last = taken[-1][1]
    assert SECOND // 3 < last < SECOND // 2
    assert taken == [entry for entry in expected if entry[1] <= last]


def test_the_energy_of_a_hanging_top_drifts_upwards_where_it_grows():
    """The drift is over the magnitude of an energy that is below 0."""
    simulation = simulate(initial__theta=2.8, spin__l3=0.1, spin__lz=-0.05,
                          solver__equations='euler', solver__rtol=1e-4, solver__atol=1e-4)
    taken = record(simulation, '~/invariants')
    simulation.advance(20 * SECOND)
    energies, drifts = np.array([doubles(data, 8) for _, _, data in taken])[:, [0, 3]].T
    assert energies[0] < -2.0 and simulation.segment.energy == energies[0]
    assert abs(drifts[-1]) > 1e-5
    assert drifts == pytest.approx((energies - energies[0]) / -energies[0], rel=1e-9, abs=1e-15)
    assert simulation.energy_drift == drifts[-1]


# -------------------------------------------------------------------------------- giving way

def test_giving_way_in_a_long_integration_loses_nothing_and_leaves_a_state_to_read():
    """A wheel so fast that a sample takes thousands of steps; ticks end in their midst."""
    fast = {'spin.l3': 1e4, 'joint_states.rate': 500.0}
    whole = simulate(fast)
    expected = record(whole, 'joint_states')
    whole.advance(6_000_000)
    assert whole.steps > 5000
    broken = simulate(fast)
    taken = record(broken, 'joint_states')
    start, found, steps = parameters.start_state(broken.values), [], [broken.steps]
    while not broken.advance(6_000_000, give_way=lambda: True):
        steps.append(broken.steps)
        state = broken.state()
        assert abs(broken.energy_drift) <= 1e-14
        assert abs(state.l3[0] / 1e4 - 1.0) <= 1e-14
        found.append((broken.now_ns * 1e-9, state.theta[0], state.phi[0], state.psi[0]))
    assert max(np.diff(steps)) <= STEPS_IN_A_PIECE * MOST_PIECES
    assert found[-1][0] <= 6e-3 and all(a[0] < b[0] for a, b in itertools.pairwise(found))
    t, *angles = zip(*found, strict=True)
    there = solve(broken.top, start, np.array(t))
    assert np.transpose(angles) == pytest.approx(
        np.column_stack((there.theta, there.phi, there.psi)), abs=1e-8)
    assert taken == expected


def test_giving_way_goes_on_without_listeners_too():
    simulation = simulate(spin__l3=1e4)
    found = []
    while not simulation.advance(2_000_000, give_way=lambda: True):
        found.append(simulation.now_ns)
        simulation.state()
        # Steps are 2 us long: those of the time before are not kept.
        assert simulation.now_ns / SECOND - 1e-5 < simulation.segment.solver._kept[0].t0
    assert len(found) > 2
    assert found[-1] > 0
    assert simulation.now_ns == 2_000_000


def test_a_command_in_the_midst_of_a_long_integration_is_taken():
    simulation = simulate(spin__l3=1e4)
    taken = record(simulation, 'joint_states')
    assert not simulation.advance(SECOND, give_way=lambda: simulation.steps > 800)
    simulation.command(1.0, 0.5)
    at_ns = simulation.history[-1][0]
    assert simulation.now_ns >= at_ns > 0
    simulation.advance(SECOND)
    assert times(taken, 'joint_states') == list(range(0, SECOND + 1, PERIOD_NS))


# -------------------------------------------------------------------------- nothing for nobody

def test_without_a_sink_nothing_is_encoded_and_the_solver_is_not_sampled():
    simulation = simulate()
    encoded, states = messages_of(simulation), states_of(simulation)
    for tick in range(1, 101):
        simulation.advance(tick * PERIOD_NS)
    assert simulation.now_ns == SECOND
    assert states.count == 0
    assert {counted.count for counted in encoded.values()} == {0}
    assert all(one.sent == one.skipped == 0 for one in simulation.streams)


@pytest.mark.parametrize('topic', ['pose', 'imu/data_raw', '~/invariants', '/clock'])
def test_only_the_stream_with_a_subscriber_is_encoded(topic):
    simulation = simulate()
    encoded, states = messages_of(simulation), states_of(simulation)
    simulation.advance(SECOND)
    taken = publish(simulation, topic)
    simulation.advance(2 * SECOND)
    rate = parameters.checked({})[f'{stream(simulation, topic).parameter}.rate']
    assert len(taken) == rate
    assert encoded.pop(topic).count == states.count == rate
    assert all(counted.count == 0 for counted in encoded.values())


def test_a_sample_is_encoded_once_for_all_its_sinks():
    simulation = simulate()
    encoded = messages_of(simulation)
    published, recorded = [], []
    pose = stream(simulation, 'pose')
    pose.publish = published.append
    simulation.log_to(lambda numbers, stamp_ns, messages, size: recorded.extend(messages), [pose])
    simulation.advance(SECOND)
    assert encoded['pose'].count == len(published) == len(recorded) == 101
    assert all(a is b for a, b in zip(published, recorded, strict=True))


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_streams_of_one_rate_share_the_states(method):
    simulation = simulate(solver__method=method)
    taken = record(simulation, 'pose', 'joint_states', 'ground_truth/odom')
    states = states_of(simulation)
    simulation.advance(SECOND)
    assert len(taken) == 3 * 101
    assert states.count == 101


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_a_column_that_nobody_needs_is_not_computed(method, monkeypatch):
    """A pose needs no angle and no rate, joints no body rate, odometry no angle."""
    computed = set()
    samples = {'rk45': rk45._TransportStates, 'exact': exact._ExactStates}[method]

    def watch(name):
        original = getattr(samples, name)
        compute = original.fget if isinstance(original, property) else original.func
        monkeypatch.setattr(samples, name, property(
            lambda self: (computed.add(name), compute(self))[1]))

    watch('angles')
    watch('transverse_velocity')
    for topic, needed in (('pose', set()), ('joint_states', {'angles'}),
                          ('ground_truth/odom', {'transverse_velocity'})):
        simulation = simulate(solver__method=method)
        taken = record(simulation, topic)
        computed.clear()
        simulation.advance(SECOND)
        assert len(taken) == 101
        assert computed == needed, topic


def test_equilibria_and_free_motion_take_no_steps():
    for values in (SLEEPING, NO_GRAVITY):
        simulation = simulate(values)
        record(simulation)
        simulation.advance(SECOND)
        assert simulation.steps == simulation.evaluations == 0, values


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_a_solver_needs_the_members_of_the_protocol_and_no_others(method, monkeypatch):
    """Nobody asks what kind of solver it is: a foreign one with these members does as well."""
    members = {name for name in (*vars(Propagator), *Propagator.__annotations__)
               if not name.startswith('_')}

    class Foreign:
        def __init__(self, solver):
            self._solver = solver

        def __getattr__(self, name):
            assert name in members, name
            return 10 ** 16 if name == 'ns_limit' and limited else getattr(self._solver, name)

    expected_of = simulate(solver__method=method)
    topics = [one.topic for one in expected_of.streams if one.topic != '~/invariants']
    expected = record(expected_of, *topics)
    expected_of.advance(SECOND)
    propagate = pipeline.propagate
    monkeypatch.setattr(pipeline, 'propagate', lambda *args, **more: Foreign(
        propagate(*args, **more)))
    limited = False
    simulation = simulate(solver__method=method)
    taken = record(simulation, *topics)
    simulation.advance(SECOND)
    assert taken == expected
    assert simulation.orientation_error <= 1e-9 and simulation.describe().name == 'cusps'
    limited = True
    with pytest.raises(ValueError, match='turns too fast'):
        simulate(solver__method=method)


@pytest.mark.parametrize('ahead', [False, True])
def test_ticks_leave_nothing_behind(ahead):
    """
    Blocks of memory in use do not become more, whoever listens, however long it runs.

    The interpreter's and numpy's own caches take blocks too, up to some 150 and then no more: how
    fast depends on what ran before in the process.  What a tick leaves behind, every round shows.
    """
    simulation = simulate(imu__rate=1000.0, pose__rate=1000.0, joint_states__rate=1000.0)
    for one in simulation.streams:
        one.publish = len
    simulation.log_to(lambda *call: None, simulation.streams)

    def run(ticks):
        for _ in range(ticks):
            simulation.advance(simulation.now_ns + MILLISECOND)
            if ahead:
                simulation.prepare(simulation.now_ns + MILLISECOND)
        gc.collect()
        return sys.getallocatedblocks()

    run(500)
    in_use = [run(256) for _ in range(9)]
    assert min(np.diff(in_use)) < 8


def test_a_tick_allocates_little():
    """The most that is in use at a time during a tick, over that between two: a few states."""
    simulation = simulate(imu__rate=1000.0, pose__rate=1000.0, joint_states__rate=1000.0)
    publish_to = ('pose', 'joint_states', 'imu/data_raw')
    for topic in publish_to:
        stream(simulation, topic).publish = len
    for tick in range(1, 101):
        simulation.advance(tick * MILLISECOND)
    tracemalloc.start()
    try:
        most = 0
        for tick in range(101, 201):
            before, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            simulation.advance(tick * MILLISECOND)
            most = max(most, tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    assert 500 < most < 16_000


def test_a_tick_without_sinks_costs_the_same_however_many_streams_there_are():
    """Calls of Python functions, not seconds."""
    def calls(**values):
        simulation = simulate(**values)
        simulation.advance(MILLISECOND)
        count = [0]

        def count_call(frame, event, argument):
            count[0] += event == 'call'
        before = sys.getprofile()
        sys.setprofile(count_call)
        try:
            for tick in range(2, 1002):
                simulation.advance(tick * MILLISECOND)
        finally:
            sys.setprofile(before)
        return count[0]

    few = calls()
    assert calls(imu_data__enabled=True, clock__enabled=True, pose__rate=5000.0,
                 imu__rate=5000.0) == few


# ----------------------------------------------------------------------- coming and being late

def test_a_subscriber_who_comes_late_gets_the_next_sample_of_the_grid_not_the_past():
    simulation = simulate()
    simulation.advance(SECOND + 3)
    taken = record(simulation, 'pose')
    simulation.advance(SECOND + 2 * PERIOD_NS)
    assert times(taken, 'pose') == [SECOND + PERIOD_NS, SECOND + 2 * PERIOD_NS]


def test_a_subscriber_who_goes_and_comes_back_gets_no_backlog():
    simulation = simulate()
    taken = publish(simulation, 'pose')
    simulation.advance(SECOND)
    stream(simulation, 'pose').publish = None
    simulation.advance(5 * SECOND)
    again = publish(simulation, 'pose')
    recorded = record(simulation, 'pose')
    simulation.advance(5 * SECOND + PERIOD_NS)
    assert len(taken) == 101
    assert again == [('pose', data) for _, _, data in recorded]
    assert times(recorded, 'pose') == [5 * SECOND + PERIOD_NS]


def test_late_samples_are_not_published_but_counted():
    simulation = simulate()
    published = publish(simulation, 'pose')
    simulation.advance(0)
    assert simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND)
    pose = stream(simulation, 'pose')
    assert pose.sent == len(published) == 102       # t = 0 and [9 s, 10 s]
    assert pose.skipped == 899


def test_a_recording_that_begins_while_late_samples_are_left_out_has_them():
    simulation = simulate()
    published = publish(simulation, 'pose')
    simulation.advance(0)
    assert not simulation.advance(50 * SECOND, publish_from_ns=49 * SECOND, give_way=lambda: True)
    begun_ns, pose = simulation.now_ns, stream(simulation, 'pose')
    assert begun_ns < 45 * SECOND and pose.skipped == 4899
    recorded = record(simulation, 'pose')
    simulation.advance(50 * SECOND, publish_from_ns=49 * SECOND)
    assert times(recorded, 'pose') == [
        t_ns for t_ns in range(0, 50 * SECOND + 1, PERIOD_NS) if t_ns > begun_ns]
    assert (pose.sent, pose.skipped) == (len(published), 4899) == (102, 4899)


@pytest.mark.parametrize('ahead', [False, True])
def test_late_samples_are_recorded_all_the_same(ahead):
    simulation = simulate()
    published = publish(simulation, 'pose', 'joint_states')
    recorded = record(simulation, 'pose')
    simulation.advance(0)
    if ahead:
        simulation.prepare(SECOND)
    simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND + 1)
    assert times(recorded, 'pose') == list(range(0, 10 * SECOND + 1, PERIOD_NS))
    for topic in ('pose', 'joint_states'):
        assert [name for name, _ in published].count(topic) == 101
        one = stream(simulation, topic)
        assert (one.sent, one.skipped) == (101, 900)


def test_skipping_keeps_the_grid_of_any_rate():
    simulation = simulate(pose__rate=333.0)
    pose = stream(simulation, 'pose')
    pose.publish = len
    simulation.advance(SECOND, publish_from_ns=SECOND // 2)
    assert (pose.sent, pose.skipped) == (167, 167)
    taken = record(simulation, 'pose')
    simulation.advance(2 * SECOND)
    period = round(SECOND / 333.0)
    assert times(taken, 'pose') == [
        t for t in range(0, 2 * SECOND + 1, period) if t > SECOND]


# --------------------------------------------------------------------------- rates and commands

@pytest.mark.parametrize(('before', 'after'), [(100.0, 200.0), (200.0, 100.0), (100.0, 33.0),
                                               (1.0, 1000.0), (10000.0, 10.0)])
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


def test_a_command_keeps_the_angles_and_the_nutation_rate_and_sets_the_momenta():
    simulation = simulate()
    simulation.advance(777_777_777)
    before = simulation.state()
    simulation.command(2.0, -0.5)
    after = simulation.state()
    for name in ('theta', 'phi', 'psi'):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-14)
    assert after.theta_dot == pytest.approx(before.theta_dot, abs=1e-12)   # rtol is 1e-11
    assert (simulation.l3, simulation.lz) == (2.0, -0.5)
    assert (after.l3[0], after.lz[0]) == pytest.approx((2.0, -0.5), rel=1e-15)
    assert simulation.history == [(777_777_777, 2.0, -0.5)]


def test_commands_are_applied_at_their_time_again_with_the_same_bytes():
    dice = random.Random(3)
    first = simulate()
    taken = record(first)
    for _ in range(10):
        first.advance(first.now_ns + dice.randrange(1, SECOND // 3))
        first.command(dice.uniform(-3.0, 3.0), dice.uniform(-2.0, 2.0))
    end_ns = first.now_ns + SECOND
    first.advance(end_ns)
    again = simulate()
    taken_again = record(again)
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
    expected = record(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = record(simulation)
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


def test_a_reference_stays_that_of_its_own_motion():
    """It may be set up in another thread, while a command begins the next motion."""
    simulation = simulate()
    first = simulation.segment
    simulation.command(2.0, 1.5)
    assert first.exact.start.l3 == 1.6
    assert simulation.segment.exact.start.l3 == 2.0
    assert simulation.segment.exact is simulation.segment.exact
    assert simulate(solver__method='exact').segment.exact.start.l3 == 1.6


# ----------------------------------------------------------------------------- restart, failure

def test_a_restart_gives_the_same_bytes_again():
    simulation = simulate()
    taken = record(simulation)
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
    published = publish(simulation, 'pose')
    simulation.advance(SECOND)
    steps = simulation.steps
    assert steps > 0
    simulation.restart(parameters.checked({'pose.rate': 50.0}))
    simulation.advance(SECOND)
    assert stream(simulation, 'pose').sent == len(published) == 101 + 51
    assert simulation.steps == 2 * steps


def test_a_restart_that_is_refused_leaves_the_motion_as_it_was():
    undisturbed = simulate()
    expected = record(undisturbed)
    undisturbed.advance(SECOND)
    simulation = simulate()
    taken = record(simulation)
    simulation.advance(SECOND // 2)
    with pytest.raises(ValueError, match='pole'):
        simulation.restart({**parameters.checked({}), 'initial.theta': 0.0, 'spin.lz': 0.5})
    with pytest.raises(ValueError, match=r'1e\+20'):
        simulation.restart({**parameters.checked({}), 'spin.l3': 1e20, 'spin.lz': 1e20})
    simulation.advance(SECOND)
    assert taken == expected


THROUGH_A_POLE = {'initial.theta': 0.5, 'initial.theta_dot': -3.0, 'spin.l3': 0.2,
                  'spin.lz': -0.2}


@pytest.mark.parametrize('offline', [False, True])
def test_the_euler_equations_fail_at_a_pole_with_a_reason_and_can_be_restarted(offline):
    simulation = simulate({**THROUGH_A_POLE, 'solver.equations': 'euler'})
    taken = record(simulation, 'joint_states')

    def send(one, stamps_ns, rows):
        taken.extend((one.topic, int(stamp) - EPOCH_NS, row.tobytes())
                     for stamp, row in zip(stamps_ns, rows, strict=True))

    def advance():
        return (simulation.advance_in_blocks(60 * SECOND, send) if offline
                else simulation.advance(60 * SECOND))

    with pytest.raises(IntegrationError, match='leapt over a pole'):
        advance()
    assert 0 <= simulation.now_ns < 60 * SECOND
    assert len(taken) > 10
    assert times(taken, 'joint_states') == list(range(0, len(taken) * PERIOD_NS, PERIOD_NS))
    assert math.isfinite(simulation.state().energy[0])
    with pytest.raises(IntegrationError):           # it does not go on by itself
        advance()
    simulation.restart(parameters.checked(THROUGH_A_POLE))
    assert simulation.advance(5 * SECOND)


def test_the_euler_equations_cannot_start_at_a_pole():
    with pytest.raises((ValueError, IntegrationError), match='theta'):
        simulate(solver__equations='euler', initial__theta=0.0, spin__l3=1.0, spin__lz=1.0)


# --------------------------------------------------------------- what takes effect at once

def test_a_change_of_rates_reaches_every_stream():
    simulation = simulate()
    simulation.advance(SECOND)
    rates = {f'{one.parameter}.rate': 50.0 for one in simulation.streams}
    simulation.apply({**rates, 'tick_rate': 100.0})
    assert {one.period_ns for one in simulation.streams} == {20 * MILLISECOND}
    taken = record(simulation)
    simulation.advance(2 * SECOND)
    for one in simulation.streams:
        assert times(taken, one.topic) == list(range(SECOND + 20 * MILLISECOND, 2 * SECOND + 1,
                                                     20 * MILLISECOND)), one.topic


def test_samples_that_are_too_late_and_not_recorded_are_not_computed():
    simulation = simulate()
    encoded, taken = messages_of(simulation), publish(simulation, 'pose', 'joint_states')
    record(simulation, 'joint_states')
    simulation.advance(SECOND, publish_from_ns=SECOND // 2)
    assert len(taken) == 2 * 51
    # Recorded samples are all computed; of the others, those from the limit on.
    assert encoded['joint_states'].count == 101
    assert encoded['pose'].count == 51
    assert stream(simulation, 'pose').skipped == stream(simulation, 'joint_states').skipped == 50


def test_what_streams_take_over_at_once_is_described_so():
    """A run is computed again by the parameters that `Stream.at_once` names."""
    at_once = {name for stream in simulate().streams for name in stream.at_once}
    assert at_once == {name for name, parameter in parameters.BY_NAME.items()
                       if name.endswith('.rate')}
    assert all(parameters.BY_NAME[name].effect is parameters.Effect.NOW for name in at_once)
