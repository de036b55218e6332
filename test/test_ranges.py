# SPDX-License-Identifier: Apache-2.0
"""Values that no arithmetic holds are refused where they are given; all others run."""

import math
import random

import numpy as np
import pytest
from helpers.examples import examples
from helpers.extremes import number, parameter_set
from helpers.simulations import MILLISECOND, SECOND, record, simulate, stream
from hypothesis import event, given
from hypothesis import strategies as st

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import LAST_STAMP_NS
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.tools.simulate import main

HUGE, TINY = 1e300, 1e-300
REFUSED = [
    ('status_period', 1e10), ('status_period', TINY), ('duration', HUGE), ('duration', TINY),
    *((f'{name}.rate', TINY) for name, rate, *_ in parameters.STREAM_DEFAULTS
      if rate),
    ('tick_rate', TINY), ('time_scale', TINY), ('max_error', HUGE),
    *((f'imu.{kind}_{name}', value) for kind in ('gyroscope', 'accelerometer')
      for name in ('noise_density', 'random_walk', 'turn_on_bias', 'bias_stddev',
                   'bias_instability', 'range', 'resolution')
      for value in (HUGE, 1e200, TINY)),
    *((f'imu.{name}', (*8 * (0.0,), HUGE)) for name in (
        'gyroscope_M', 'gyroscope_A', 'accelerometer_M')),
    *((f'imu.{name}', value) for name in ('stamp_offset', 'clock_drift') for value in (
        HUGE, -HUGE)),
    *((f'imu.{name}', value) for name in ('drop_rate', 'duplicate_rate') for value in (-0.1, 1.0)),
    ('imu.stamp_jitter', -1e-9), ('imu.orientation_stddev', (0.0, 0.0, 1.1)),
    ('imu.gyroscope_bias_correlation_time', 0.0), ('imu.bias_instability_band', (0.0, 1.0)),
    ('mag.field', (HUGE, 0.0, 0.0)), ('mag.resolution', TINY), ('mag.soft_iron', 9 * (HUGE,)),
    ('imu.lever_arm', (0.0, HUGE, 0.0)), ('imu.rpy', (0.0, 0.0, -HUGE)),
    ('top.mass', HUGE), ('top.com_distance', -HUGE), ('top.lambda1', HUGE),
    ('top.lambda3', 1e200), ('top.gravity', HUGE), ('initial.theta_dot', 1e18),
    ('initial.phi', HUGE), ('initial.psi', -1e18), ('record.min_free_bytes', 2 ** 63),
    ('seed', 10 ** 400), ('step.count', -10 ** 400)]


@pytest.mark.parametrize(('name', 'value'), REFUSED)
def test_what_no_arithmetic_holds_is_refused_by_the_table(name, value):
    """With name, value, and what is allowed."""
    with pytest.raises(ValueError, match='must be') as refusal:
        parameters.checked({name: value})
    assert str(refusal.value).startswith(f'{name} = {value!r}: must be ')


@pytest.mark.parametrize(('given', 'named'), [
    ({'spin.l3': 1e20}, '1e+20'), ({'spin.l3': 1e17, 'spin.lz': 1e16}, '1e+17'),
    ({'spin.lz': -1e18}, '-1e+18'), ({'spin.l3': HUGE}, '1e+300'),
    ({'initial.theta_dot': 1e12}, '1000000000000.0'),
    ({'top.lambda1': TINY}, 'lambda1=1e-300'), ({'top.lambda3': 5e-324}, 'lambda3=5e-324')])
@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_what_turns_too_fast_is_refused_at_the_start_at_a_reset_and_by_simulate(
        given, named, method, tmp_path, capsys):
    values = parameters.checked({**given, 'solver.method': method})
    running = simulate(solver__method=method)
    for refuse in (lambda: Simulation(values), lambda: running.restart(values)):
        with pytest.raises(ValueError, match='no motion from') as refusal:
            refuse()
        assert named in str(refusal.value)
    assert running.advance(SECOND)
    log = tmp_path / 'run.mcap'
    arguments = [part for name, value in values.items() if name in (*given, 'solver.method')
                 for part in ('-p', f'{name}:={value}')]
    assert main(['-o', str(log), '--duration', '1', '--quiet', *arguments]) == 2
    assert 'no motion from' in capsys.readouterr().err
    assert not log.exists()


def test_a_closed_form_that_ends_stops_the_motion_there():
    simulation = simulate(solver__method='exact', spin__l3=3e6, spin__lz=1e6)
    limit_ns = simulation.segment.solver.ns_limit
    assert 10 ** 17 < limit_ns < LAST_STAMP_NS - simulation.epoch_ns
    assert simulation.advance(limit_ns)
    with pytest.raises(IntegrationError, match=r'2\^52 turns'):
        simulation.advance(limit_ns + SECOND)
    simulation.command(1.0, 0.5)
    assert simulation.advance(limit_ns + SECOND)


def test_where_the_exact_solution_ends_the_steps_go_on_and_their_error_is_unknown():
    """A nutation so slow that steps take weeks, about an axis that spins very fast."""
    simulation = simulate(top__lambda3=1e-87, top__mass=1e-20, spin__l3=2e-79, spin__lz=1e-12,
                          initial__theta_dot=1e-9)
    segment = simulation.segment
    end_ns = segment.exact.ns_limit
    later_ns = LAST_STAMP_NS - simulation.epoch_ns
    assert end_ns + 10 ** 17 < later_ns
    while segment.reached_ns <= later_ns:
        segment.reach(later_ns, 1000)
    times = range(end_ns - 2 * SECOND, end_ns + 3 * SECOND + 1, SECOND)
    for block in (times, times[:3], times[3:], range(later_ns, later_ns + 1)):
        errors = segment.orientation_error(segment.states(block), block)
        assert np.isnan(errors).tolist() == [t_ns > end_ns for t_ns in block]
    axis = np.array(segment.exact_axis(np.array(times)))
    assert (axis[:, 3:] == axis[:, 2:3]).all()
    assert axis[:, :3] == pytest.approx(np.array(segment.states(times[:3]).rows_axis), abs=1e-6)


# -------------------------------------------------------------------------------------- stamps

def near_the_end(**values):
    """Return a simulation that begins a second before the last stamp."""
    simulation = simulate(**values)
    simulation.epoch_ns = LAST_STAMP_NS - SECOND + 1
    return simulation


@pytest.mark.parametrize('ahead', [False, True])
@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_stamps_end_with_their_seconds_and_not_before(method, ahead):
    simulation = near_the_end(solver__method=method)
    taken, published = record(simulation, 'pose'), []
    stream(simulation, 'pose').publish = published.append
    with pytest.raises(IntegrationError, match='< 2147483648 s, in January 2038'):
        for tick in range(300):
            if not simulation.send_ready(5 * tick * MILLISECOND):
                simulation.advance(5 * tick * MILLISECOND)
            if ahead:
                simulation.prepare(5 * (tick + 1) * MILLISECOND)
    assert [t_ns for _, t_ns, _ in taken] == [10 * k * MILLISECOND for k in range(100)]
    seconds = [int.from_bytes(data[4:8], 'little', signed=True) for data in published]
    assert set(seconds) == {2 ** 31 - 1} and len(published) == 100


def test_a_run_offline_whose_stamps_would_end_is_refused_before(tmp_path, capsys):
    simulation = near_the_end()
    simulation.log_to(None, simulation.streams)
    with pytest.raises(IntegrationError, match='2038'):
        simulation.advance_in_blocks(2 * SECOND, lambda *block: None)
    for epoch_ns in (LAST_STAMP_NS - 5, -1, 2 ** 70):
        with pytest.raises(ValueError, match='must be >= 0 and < 2147483648 s'):
            Simulation(parameters.checked({'duration': 1.0}), epoch_ns)
    for epoch in ('2147483647.5', '-3', '1e300', 'nan'):
        log = tmp_path / 'run.mcap'
        assert main(['-o', str(log), '--duration', '1', '--quiet', '--epoch', epoch]) == 2
        assert 'must be >= 0 and < 2147483648 s' in capsys.readouterr().err
        assert not log.exists()


# ----------------------------------------------------------------------------- anything allowed

# The last of the invariants is NaN where there is no exact solution to compare with.
COMPARABLE = {'~/invariants': 7}


def short_life(rng):
    """
    Simulate for a few steps of any length, with commands, changes of rates and resets in between.

    Return what came of it: 'refused', 'stopped', or 'ran'.  What may not be are other errors than
    ValueError, where something is refused, and IntegrationError, where a motion ends; and numbers
    that are not finite.
    """
    spin, rate = parameters.BY_NAME['spin.l3'], parameters.BY_NAME['imu.rate']
    try:
        checked = parameters.checked(parameter_set(rng, allowed=True))
        simulation = Simulation(checked, rng.choice((0, 1_700_000_000_000_000_000)))
    except ValueError:
        return 'refused'
    simulation.log_to(lambda *call: None, simulation.streams)
    for _ in range(3):
        asked = iter(range(30))
        target_ns = max(simulation.now_ns, 0) + rng.choice(
            (0, 1, *(10 ** n for n in range(3, 18))))
        try:
            if rng.random() < 0.5:
                simulation.prepare(target_ns, 5_000_000)
            simulation.advance(target_ns, give_way=lambda asked=asked: next(asked, None) is None)
        except IntegrationError:
            return 'stopped'
        now = range(max(simulation.now_ns, 0), max(simulation.now_ns, 0) + 1)
        for one in simulation.streams:
            data = one.encode(simulation.segment.states(now), simulation.epoch_ns, now)
            for field in one.template.decode(data.tobytes()):
                shown = field[:, :COMPARABLE.get(one.topic)]
                assert np.isfinite(shown).all(), (one.topic, shown)
        assert math.isfinite(simulation.energy_drift) and str(simulation.describe())
        act = rng.choice((
            lambda: simulation.command(number(rng, spin), number(rng, spin)),
            lambda: simulation.apply({'imu.rate': number(rng, rate)}),
            lambda: simulation.restart(parameters.checked(parameter_set(rng, allowed=True)))))
        try:
            act()
        except ValueError as error:
            assert str(error)
    return 'ran'


@examples(25)
@given(st.randoms())
def test_every_combination_that_the_ranges_allow_runs_or_is_refused(rng):
    event(short_life(rng))


def test_the_drift_of_a_tiny_constant_is_finite():
    simulation = Simulation(parameters.checked({}), 0)
    simulation.advance(SECOND)
    simulation.command(5e-324, 50.0)
    simulation.advance(3 * SECOND)
    assert abs(simulation.state().l3[0]) > 1e-15    # more than 1.8e308 times the command
    invariants = stream(simulation, '~/invariants')
    now = range(3 * SECOND, 3 * SECOND + 1)
    ((values,),) = invariants.template.decode(
        invariants.encode(simulation.segment.states(now), 0, now).tobytes())
    assert np.isfinite(values).all()


def test_most_combinations_run():
    found = [short_life(random.Random(seed)) for seed in range(30)]
    assert found.count('ran') >= 15 and 'refused' in found


def test_numbers_of_any_size_are_among_them():
    sizes = [abs(value) for seed in range(600)
             for name, value in parameter_set(random.Random(seed), allowed=True).items()
             if name == 'spin.l3' and value]
    assert min(sizes) < 1e-100 and max(sizes) > 1e100
    assert all(map(math.isfinite, sizes))
