# SPDX-License-Identifier: Apache-2.0
"""Extreme tops, parameters and commands: they run, or are refused in one clear line."""

import math
import random
import re
import time
import warnings

import numpy as np
import pytest
from helpers.examples import TIMES, examples
from helpers.extremes import DOUBLES, actions, commands, number, parameter_set
from helpers.simulations import SECOND, doubles, play, simulate, stream
from hypothesis import given
from hypothesis import strategies as st
from stress.tops import COLUMNS, UNIT, time_limit
from test_tick_loop import POSE_NS, TICK_NS, Run

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import LAST_STAMP_NS
from spinning_top_sim.streams.intervals import LONGEST_NS
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.stream import Samples
from spinning_top_sim.tools.simulate import main

# ------------------------------------------------------------------------------- one top

TOP = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': 9.8}
START = {'theta': 0.6, 'theta_dot': 0.4, 'phi': 0.3, 'psi': -1.2, 'l3': 1.6, 'lz': 1.1}
METHODS = ({'method': 'exact'}, {'method': 'rk45', 'rtol': 1e-6},
           {'method': 'rk45', 'rtol': 1e-6, 'equations': 'euler'})
# What may be said instead of an answer; a ValueError names the field or says "too far apart".
REASONS = (r'(theta|theta_dot|l3|lz|lambda1|lambda3|mass|com_distance|gravity|t) = '
           r'|too far apart|closer to the separatrix|at most|at least')
SIZES = st.sampled_from((*DOUBLES[:-1], 1e-160, 1e-150, 1e-30, 1e150)) | st.floats(0.0, 1e300)
FIELDS = st.sampled_from([*TOP, *START])


def answer(values, method, t, columns=(*COLUMNS, 'theta_folded', 'l3', 'lz')):
    """Return the motion, after looking at the columns; None if it was refused in words."""
    try:
        with time_limit(5.0), warnings.catch_warnings():
            warnings.simplefilter('error')
            motion = solve(Top(**{name: values[name] for name in TOP}),
                           State(**{name: values[name] for name in START}), t, **method)
            for name in columns:
                assert np.all(np.isfinite(getattr(motion, name))), name
    except (ValueError, IntegrationError) as error:
        assert '\n' not in str(error)
        assert isinstance(error, IntegrationError) or re.search(REASONS, str(error)), error
        return None
    assert np.abs(np.linalg.norm(motion.quaternion, axis=1) - 1.0).max(initial=0.0) <= UNIT
    return motion


# Between them a motion is so fast that it takes millions of steps, and not so many as are refused.
FEW_STEPS = SIZES.filter(lambda size: not 1e3 < size < 1e30)


@pytest.mark.parametrize('method', METHODS, ids=('exact', 'transport', 'euler'))
@examples(60)
@given(FIELDS, FEW_STEPS, st.sampled_from((1.0, -1.0)))
def test_any_size_of_any_number_gives_an_answer_or_a_reason(method, name, size, side):
    answer({**TOP, **START, name: side * size}, method, [0.0, 0.5, 1.0])


@examples(200)
@given(st.dictionaries(FIELDS, st.tuples(SIZES, st.sampled_from((1.0, -1.0))), min_size=2),
       st.sampled_from((None, 1.0, -1.0)))
def test_any_sizes_of_all_numbers_give_the_start_exactly_or_a_reason(changed, lz_of_l3):
    values = {**TOP, **START, **{
        name: size * (side if name not in ('theta', 'lambda1', 'lambda3', 'mass') else 1.0)
        for name, (size, side) in changed.items()}}
    if lz_of_l3 is not None:
        values['lz'] = lz_of_l3 * values['l3']
    # The squares of rates and their products with momenta may be too large for a double.
    motion = answer(values, {'method': 'exact'}, [0.0], (*START, 'quaternion', 'angular_velocity'))
    if motion is not None:
        for name in ('theta', 'theta_dot', 'phi', 'psi'):
            assert abs(getattr(motion, name)[0] - values[name]) <= 1e-14 * max(
                1.0, abs(values[name])), name


# ------------------------------------------------------------------------------- parameters

HUGE, TINY = 1e300, 1e-300
OUT_OF_RANGE = [
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


@pytest.mark.parametrize(('name', 'value'), OUT_OF_RANGE)
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
    for refuse in (lambda: LiveSimulation(values), lambda: running.restart(values)):
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

def test_a_run_offline_whose_stamps_would_end_is_refused_before(tmp_path, capsys):
    simulation = simulate()
    simulation.epoch_ns = LAST_STAMP_NS - SECOND + 1
    with pytest.raises(IntegrationError, match='2038'):
        play(simulation, 2 * SECOND)
    assert simulation.now_ns == SECOND - 1
    for epoch_ns in (LAST_STAMP_NS - 5, -1, 2 ** 70):
        with pytest.raises(ValueError, match='must be >= 0 and < 2147483648 s'):
            LiveSimulation(parameters.checked({'duration': 1.0}), epoch_ns)
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
        simulation = LiveSimulation(checked, rng.choice((0, 1_700_000_000_000_000_000)))
    except ValueError:
        return 'refused'
    def streams():
        """Return all streams but those of intervals longer than intervals may be."""
        return [one for one in simulation.streams if one.parameter != 'increments'
                or simulation.imu.intervals.length_ns <= LONGEST_NS]

    for _ in range(3):
        simulation.log_to(lambda entries, size: None, streams())
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
        for one in streams():
            _, rows = one.encode(Samples(simulation.path, now), simulation.epoch_ns)
            for field in one.template.decode(rows.tobytes()):
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


def test_the_drift_of_a_tiny_constant_is_finite():
    simulation = LiveSimulation(parameters.checked({}), 0)
    simulation.advance(SECOND)
    simulation.command(5e-324, 50.0)
    simulation.advance(3 * SECOND)
    assert abs(simulation.state().l3[0]) > 1e-15    # more than 1.8e308 times the command
    invariants = stream(simulation, '~/invariants')
    now = range(3 * SECOND, 3 * SECOND + 1)
    _, rows = invariants.encode(Samples(simulation.path, now), 0)
    ((values,),) = invariants.template.decode(rows.tobytes())
    assert np.isfinite(values).all()


def test_every_combination_that_the_ranges_allow_runs_or_is_refused():
    found = [short_life(random.Random(seed)) for seed in range(30 * TIMES)]
    assert found.count('ran') >= 15 * TIMES and 'refused' in found


def test_numbers_of_any_size_are_among_them():
    sizes = [abs(value) for seed in range(600)
             for name, value in parameter_set(random.Random(seed), allowed=True).items()
             if name == 'spin.l3' and value]
    assert min(sizes) < 1e-100 and max(sizes) > 1e100
    assert all(map(math.isfinite, sizes))


# ------------------------------------------------------------------------- what is done to a node

CLOCK_STEP_NS = 5_000_000   # by which time goes on whenever it is read, so that budgets end
REFUSED = ValueError, RuntimeError, IntegrationError


class Recorded:
    """Takes what is recorded: stamps ascend, and attitudes are unit quaternions."""

    def __init__(self, simulation):
        self._last = {}
        self._topics = [stream.topic for stream in simulation.streams]
        simulation.log_to(self._write, simulation.streams)

    def _write(self, entries, size):
        for k, stamp_ns, message in entries:
            assert stamp_ns > self._last.get(k, -1), (self._topics[k], stamp_ns)
            self._last[k] = stamp_ns
            if self._topics[k] == 'pose':
                quaternion = doubles(message, 4)
                assert all(map(math.isfinite, quaternion)), quaternion
                assert abs(math.hypot(*quaternion) - 1.0) < 1e-15, quaternion


def run_of(given_values):
    """Return a run that records, or None where one is refused."""
    try:
        run = Run(**given_values)
    except REFUSED as error:
        check_reason(error)
        return None
    run.clock.step_ns = CLOCK_STEP_NS
    Recorded(run.simulation)
    run.loop.start()
    return run


def check_reason(error):
    """Whether a refusal is one line that people can read."""
    assert str(error).strip() and '\n' not in str(error), error


def angles(simulation):
    state = simulation.state()
    return [getattr(state, name)[0] for name in ('theta', 'theta_dot', 'phi', 'psi')]


def act(run, kind, value):
    """Do as the node does."""
    simulation, loop = run.simulation, run.loop
    if kind == 'set':
        changed = parameters.checked({**run.values, **without_end(value)})
        simulation.apply(changed)
        loop.set_pace(changed)
        run.values = changed
    elif kind == 'command' and len(value) == 2:
        loop.command(*value)
    elif kind == 'pause':
        (loop.pause if value else loop.resume)()
    elif kind == 'step':
        loop.step(run.values['step.count'], run.values['step.dt'])
    elif kind == 'reset':
        loop.reset(run.values, 0)


def without_end(values):
    return {name: value for name, value in values.items()
            if name not in ('duration', 'start_paused')}


@examples(2)
@given(st.randoms(), st.booleans())
def test_whatever_is_set_and_commanded_a_reset_to_the_default_revives(rng, allowed):
    run = run_of(without_end(parameter_set(rng, allowed))) or run_of({})
    for kind, value in [*actions(rng), *(('command', data) for data in commands(rng))]:
        before, now_ns = angles(run.simulation), run.loop.now_ns
        try:
            act(run, kind, value)
        except REFUSED as error:
            check_reason(error)
            if kind == 'set' and run.loop.now_ns == now_ns:
                assert angles(run.simulation) == before, 'a refusal changes nothing'
        run.tick(rng.choice((1_000_000, TICK_NS, 300_000_000)))
        run.ticks(5)
    run.clock.step_ns = 0
    values = parameters.checked({})
    run.simulation.apply(values)
    run.loop.set_pace(values)
    run.loop.reset(values, run.simulation.epoch_ns)
    run.loop.resume()
    assert run.loop.failure is None
    run.stamps.clear()
    run.record().ticks(4)
    assert [stamp - run.simulation.epoch_ns for stamp in run.stamps] == [0, POSE_NS, 2 * POSE_NS]


# ------------------------------------------------------------------------------------- real nodes

@pytest.fixture(scope='module')
def peer():
    pytest.importorskip('rclpy')
    from helpers.node_harness import Peer

    with Peer() as peer:
        yield peer


def test_a_node_survives_extreme_parameters_commands_and_resets(peer, tmp_path):
    from geometry_msgs.msg import PoseStamped
    from helpers.node_harness import Diagnostics, SimNode
    from rclpy.parameter import Parameter

    defaults = {name: list(value) if isinstance(value, tuple) else value
                for name, value in parameters.checked({}).items()
                if parameters.BY_NAME[name].effect is not parameters.Effect.START
                and not name.startswith('spin.')}
    with SimNode(tmp_path, {'status_period': 0.5}) as node:
        peer.introduce(node, Diagnostics(peer))
        for seed in range(8):
            for kind, data in actions(random.Random(seed)):
                if kind == 'set':
                    for name, value in without_end(data).items():
                        peer.set_each(node, **{name: Parameter(name, value=value)
                                               .to_parameter_msg()})
                elif kind == 'command':
                    peer.send_command(node, *data)
                elif kind == 'pause':
                    peer.switch(node, 'set_pause', data)
                elif kind == 'wait':
                    time.sleep(data)
                else:
                    peer.trigger(node, kind)
            assert node.alive, (seed, node.err)
        assert all(result.successful for result in peer.set_each(node, **defaults))
        assert peer.trigger(node, 'reset').success
        assert peer.switch(node, 'set_pause', False).success
        pose = peer.listen(node.topic('pose'), PoseStamped)
        pose.wait_more(50)
        assert node.end() == 0, node.err
        peer.stop_listening(pose)
