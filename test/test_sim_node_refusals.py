# SPDX-License-Identifier: Apache-2.0
"""What the running node refuses: with the value named, and nothing changed."""

import math

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    QUIET,
    TRACEBACK,
    assert_clean_end,
    by_parameters,
    commands_in,
    log_of,
    simulated,
    the_log,
)
from sensor_msgs.msg import JointState

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.recorded_run import read_run_description

LAMBDA3 = parameters.checked({})['top.lambda3']
REFUSED_COMMANDS = [(), (1.0,), (1.0, 1.0, 1.0), (math.nan, 1.0), (1.0, math.nan),
                    (math.inf, 1.0), (1.0, -math.inf), (1e300, 1e300), (1e20, 1.0),
                    (1e100, 1e100), (-1e150, 1e15)]
REFUSED_PARAMETERS = [
    ({'spin__l3': math.nan}, 'nan'), ({'spin__lz': math.inf}, 'inf'),
    ({'spin__l3': 1e300}, '1e+300'), ({'spin__l3': 1e20, 'spin__lz': 1.0}, '1e+20'),
    ({'spin__l3': 'fast'}, 'fast'), ({'pose__rate': 'fast'}, 'fast'),
    ({'spin__l3': True}, 'True'), ({'pose__enabled': 1}, '1'),
    ({'top__lambda1': 0.0}, '0.0'), ({'top__lambda1': -1.5}, '-1.5'),
    ({'top__lambda3': -2}, '-2.0'), ({'top__mass': 1e300, 'top__gravity': 1e300}, '1e+300'),
    ({'pose__rate': -100.0}, '-100.0'), ({'pose__rate': 0.0}, '0.0'), ({'imu__rate': 1e5}, '1000'),
    ({'tick_rate': 0}, '0.0'), ({'time_scale': -1.0}, '-1.0'), ({'time_scale': math.inf}, 'inf'),
    ({'solver__method': 'magic'}, 'magic'), ({'solver__equations': ''}, "''"),
    ({'solver__rtol': 1.0}, '1.0'), ({'initial__theta': 4.0}, '4.0'),
    ({'imu__lever_arm': [1.0, 2.0]}, '2.0'), ({'duration': -1.0}, '-1.0'),
    ({'record__streams': ['pose', 'poise']}, 'poise'), ({'step__count': 0}, '0'),
    ({'step__count': 1.5}, '1.5'), ({'record__compression': 'zip'}, 'zip')]


def test_refused_commands_and_parameters_change_nothing(peer, diagnostics, tmp_path):
    """Each is refused with the value named; the motion is to the bit the undisturbed one."""
    with SimNode(tmp_path, {**QUIET, 'record.enabled': True}) as node:
        joints = peer.listen(node.topic('joint_states'), JointState)
        peer.introduce(node, diagnostics)
        before = diagnostics.next(node)
        for sent, data in enumerate(REFUSED_COMMANDS):
            if sent % 5 == 0:           # the node's queue holds ten
                wait_for('the ones before', lambda sent=sent: node.err.count('refused')
                         >= int(before['rejected commands']) + sent)
            peer.send_command(node, *data)
        wait_for('all refusals counted', lambda: diagnostics.number(node, 'rejected commands')
                 >= int(before['rejected commands']) + len(REFUSED_COMMANDS))
        values = peer.get(node, 'spin.l3', 'top.lambda1', 'pose.rate')
        for given, named in REFUSED_PARAMETERS:
            result = peer.set_together(node, **given)
            assert not result.successful, given
            name = next(iter(given)).replace('__', '.')
            assert named in result.reason, (given, result.reason)
            assert name.split('.')[-1] in result.reason, (given, result.reason)
        assert not peer.set_together(node, pacing='thread').successful
        assert peer.get(node, 'spin.l3', 'top.lambda1', 'pose.rate') == values
        after = diagnostics.next(node)
        spins = sum(1 for given, _ in REFUSED_PARAMETERS if any('spin__' in key for key in given))
        assert spins > 2
        assert int(after['rejected commands']) == (
            int(before['rejected commands']) + len(REFUSED_COMMANDS) + spins)
        assert int(after['commands']) == 0
        joints.wait_more(10)
        warnings = node.err
        assert_clean_end(node, node.end())
    for shown in ('nan', 'inf', '1e+300', '1e+20', '3 values', '0 values'):
        assert shown in warnings, shown
    log, metadata = log_of(the_log(node.folder))
    rows = log[node.topic('joint_states')]
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    assert commands_in(log) == []
    assert rows == simulated(log, metadata, rows[-1][0] - epoch)['joint_states']


def test_at_a_pole_only_the_possible_commands_are_taken(peer, diagnostics, tmp_path):
    with SimNode(tmp_path, {**QUIET, 'initial.theta': 0.0, 'spin.l3': 3.0}) as node:
        joints = peer.listen(node.topic('joint_states'), JointState).wait(10)
        peer.introduce(node, diagnostics)
        before = int(diagnostics.next(node)['rejected commands'])
        rates = {tuple(m.velocity) for m in joints.messages()}
        for data in ((3.0, 2.0), (-3.0, 3.0), (2.0, 3.0)):
            peer.send_command(node, *data)
            reason = peer.set_together(node, spin__l3=data[0], spin__lz=data[1])
            assert not reason.successful
            assert 'pole' in reason.reason
            assert repr(data[1]) in reason.reason
        (alone,) = peer.set_each(node, spin__l3=2.0)
        assert 'ros2 topic pub --once' in alone.reason and f'{node.name}/commands' in alone.reason
        assert f'{node.name}/set_parameters_atomically' in alone.reason
        wait_for('refusals', lambda: diagnostics.number(node, 'rejected commands') == before + 7)
        joints.wait_more(20)
        assert {tuple(m.velocity) for m in joints.messages()} == rates
        peer.send_command(node, 2.0, 2.0)
        wait_for('the new spin', lambda: tuple(joints.last().velocity) not in rates)
        phi_dot, theta_dot, psi_dot = joints.last().velocity
        assert phi_dot + psi_dot == pytest.approx(2.0 / LAMBDA3, abs=1e-12)
        assert theta_dot == 0.0
        assert joints.last().position[1] == 0.0
        assert_clean_end(node, node.end())


STARTS_REFUSED = {
    'negative inertia': (['-p', 'top.lambda1:=-1.0'], ('top.lambda1', '-1.0', '> 0')),
    'zero inertia': (['-p', 'top.lambda3:=0'], ('top.lambda3', '0', '> 0')),
    'string for a double': (['-p', 'spin.l3:=fast'], ('spin.l3', 'fast', 'a number')),
    'nan': (['-p', 'spin.l3:=.nan'], ('spin.l3', 'nan', 'a number')),
    'unknown solver': (['-p', 'solver.method:=magic'], ('solver.method', 'magic', 'rk45')),
    'pole': (['-p', 'initial.theta:=0.0', '-p', 'spin.lz:=1.0'], ('lz', '1.0', '1.6')),
    'too fast': (['-p', 'spin.l3:=1.0e20'], ('l3', '1e+20')),
    'beyond doubles': (['-p', 'spin.l3:=1.0e300'], ('l3', '1e+300')),
    'theta': (['-p', 'initial.theta:=7.0'], ('initial.theta', '7.0', '3.14159')),
    'missing file': (['--params-file', 'nowhere.yaml'], ('nowhere.yaml', 'Error opening YAML')),
    'no YAML': (['--params-file', 'bad.yaml'], ('bad.yaml', 'Error at line 1')),
    'no parameters': (['--params-file', 'list.yaml'], ('list.yaml',)),
    'use_sim_time': (['-p', 'use_sim_time:=perhaps'], ('use_sim_time', 'perhaps')),
    'no stream': (['-p', 'record.streams:=[poise]'], ('record.streams', 'poise')),
    'too many digits': (['-p', f'seed:={400 * "7"}'], ('seed', '7777', 'an integer')),
    'too many digits for a double': (['-p', f'spin.l3:={400 * "7"}'], ('spin.l3', 'a number')),
    'too many digits in a file': (['--params-file', 'digits.yaml'], ('top.mass', 'a number')),
    'bad remapping': (['-r', 'pose:='], ('pose:=',)),
    'bad qos': (['-p', 'qos_overrides./pose.publisher.reliability:=often'], ('often',)),
}


@pytest.mark.parametrize('case', STARTS_REFUSED)
def test_what_cannot_be_started_is_said_in_one_line_with_exit_code_2(tmp_path, case):
    arguments, named = STARTS_REFUSED[case]
    node = SimNode(tmp_path, namespace='/', arguments=arguments)
    (node.folder / 'bad.yaml').write_text('a: [1, 2\n  : {{{\n')
    (node.folder / 'list.yaml').write_text('- 1\n- 2\n')
    (node.folder / 'digits.yaml').write_text(
        f'/**:\n  ros__parameters:\n    top.mass: {400 * "7"}\n')
    with node:
        code = node.wait()
    assert code == 2, (code, node.err)
    assert TRACEBACK not in node.err + node.out
    assert 'is not expected here' not in node.err
    # rcl and rclpy have lines of their own for arguments that they do not understand.
    lines = [line for line in node.err.splitlines() if '[rcl]: Failed to parse global' not in line
             and "Invalid type for parameter 'use_sim_time'" not in line]
    ours = [line for line in lines if line.startswith('sim_node: cannot start:')]
    assert len(ours) == 1, node.err
    for text in named:
        assert text in ours[0], (text, ours[0])
    assert lines == ours, node.err


def test_an_unknown_parameter_is_said_with_its_likely_name(tmp_path):
    with SimNode(tmp_path, {'spin.l33': 1.0, 'duration': 0.01}) as node:
        assert_clean_end(node, node.wait())
    assert 'spin.l33' in node.err
    assert 'did you mean spin.l3?' in node.err


def test_a_body_that_cannot_be_is_warned_about_and_simulated(tmp_path):
    with SimNode(tmp_path, {'top.lambda3': 0.5, 'duration': 0.01}) as node:
        assert_clean_end(node, node.wait())
    assert 'top.lambda3 = 0.5' in node.err


def test_parameters_are_checked_where_the_top_is_now_not_where_it_began(peer, tmp_path):
    """Begun upright but falling: off the pole Lz is free, and other parameters go on changing."""
    fall = {**QUIET, 'initial.theta': 0.0, 'initial.theta_dot': 1.0, 'spin.l3': 0.5}
    with SimNode(tmp_path, fall) as node:
        joints = peer.listen(node.topic('joint_states'), JointState)
        wait_for('a tilt', lambda: joints.raw and abs(joints.last().position[1]) > 0.1)
        by_parameters(peer, node, 2.0, 0.3)
        assert peer.get(node, 'spin.l3', 'spin.lz') == [2.0, 0.3]
        assert peer.set_together(node, pose__rate=50.0).successful
        assert peer.trigger(node, 'reset').success
        assert peer.get(node, 'spin.l3', 'spin.lz') == [0.5, 0.5]
        assert_clean_end(node, node.end())


def test_an_unset_lz_is_the_cusp_of_the_tilt_at_the_reset(peer, tmp_path):
    with SimNode(tmp_path, {**QUIET, 'start_paused': True}) as node:
        for theta in (1.0, 0.0, 2.0):
            result = peer.set_together(node, initial__theta=theta)
            assert result.successful, result.reason
            assert peer.trigger(node, 'reset').success
            assert peer.get(node, 'spin.lz') == [1.6 * math.cos(theta)]
        assert_clean_end(node, node.end())


def test_a_spin_with_the_initial_state_is_that_of_the_next_start(peer, diagnostics, tmp_path):
    with SimNode(tmp_path, {**QUIET, 'start_paused': True, 'spin.lz': 1.42}) as node:
        # Upright, as 1.42 could not be; and away from the pole, where now only 2.0 could be.
        for theta, l3, lz in ((0.0, 2.0, 2.0), (0.5, 1.0, 0.4)):
            result = peer.set_together(node, initial__theta=theta, spin__l3=l3, spin__lz=lz)
            assert result.successful, result.reason
            assert peer.trigger(node, 'reset').success
            assert peer.get(node, 'initial.theta', 'spin.l3', 'spin.lz') == [theta, l3, lz]
        assert 'pole' in peer.set_together(node, initial__theta=0.0, spin__l3=1.0).reason
        by_parameters(peer, node, 2.0, 0.3)         # without it, a command
        numbers = diagnostics.next(node)
        assert (numbers['commands'], numbers['rejected commands']) == ('1', '0')
        assert peer.trigger(node, 'reset').success
        assert peer.get(node, 'spin.l3', 'spin.lz') == [1.0, 0.4]
        assert_clean_end(node, node.end())


def test_a_log_can_be_read_that_begins_between_a_new_start_and_its_reset(peer, tmp_path):
    path = tmp_path / 'run.mcap'
    with SimNode(tmp_path, {**QUIET, 'record.uri': str(path)}) as node:
        # Upright; what moves now has an Lz that is not possible there.
        assert peer.set_together(node, initial__theta=0.0).successful
        assert peer.switch(node, 'record', True).success
        assert peer.trigger(node, 'reset').success
        assert_clean_end(node, node.end())
    with LogReader(path) as reader:
        assert read_run_description(reader).values_at_recording['initial.theta'] == 0.0
