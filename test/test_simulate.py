# SPDX-License-Identifier: Apache-2.0
"""The offline simulation: files, refusals, and the same bytes as the node's own pipeline."""

import json

import numpy as np
import pytest
from helpers.inspected import log_of as simulate
from helpers.node_logs import SECOND, log_of

from spinning_top_sim import scene, solve
from spinning_top_sim.tools import inspect
from spinning_top_sim.tools.simulate import main


def read(path):
    """Return the messages of a log by topic and simulated time; the epoch is 1 s."""
    log, _ = log_of(path)
    return {topic: {t - SECOND: data for t, data in rows} for topic, rows in log.items()}


def test_a_table_of_the_truth(tmp_path):
    path = simulate(tmp_path / 'truth.csv', '--duration', 2, '--command', '1:2.0:1.5')
    motion, other = solve(*scene('cusp'), np.arange(101) * 0.01), tmp_path / 'solved.csv'
    motion.to_csv(other)
    head, of_solved = (one.read_text().partition('\n')[0].split(',') for one in (path, other))
    table, solved = (np.loadtxt(one, delimiter=',', skiprows=1) for one in (path, other))
    assert head == of_solved and len(table) == 201 and table[100, 0] == 1.0
    l3 = table[:, head.index('l3 [kg m^2/s]')]
    assert l3[:101] == pytest.approx(1.6) and l3[101:] == pytest.approx(2.0)
    assert table[:100] == pytest.approx(solved[:100], abs=1e-9)
    assert np.array_equal(solved[:, 7:11], motion.quaternion)        # to the last bit
    with pytest.raises(FileExistsError):
        motion.to_csv(other)


def test_commands_at_one_time_are_applied_in_the_order_given_also_at_the_end(tmp_path):
    """The last one given holds, whether its momenta are larger or smaller."""
    for number, (first, last) in enumerate((('2.0:1.5', '1.7:1.4'), ('1.7:1.4', '2.0:1.5'))):
        path = simulate(tmp_path / f'{number}.mcap', '--duration', 1.2, *(
            word for command in (f'1.2:{first}', f'1.2:{last}', f'1:{first}', f'1:{last}')
            for word in ('--command', command)))
        assert inspect.main([str(path), '--verify']) == 0
        log = read(path)
        l3 = {t: np.frombuffer(data[-64:])[1]
              for t, data in log['/spinning_top/invariants'].items()}
        assert l3[1_000_000_000] == pytest.approx(1.6)        # samples, then commands
        assert l3[1_100_000_000] == pytest.approx(float(last.split(':')[0]))
        event = json.loads(log['/spinning_top/events'][1_200_000_000][8:].rstrip(b'\0'))
        assert event == {'event': 'command', 't_ns': 1_200_000_000, 'sent_ns': 1_200_000_000,
                         **dict(zip(('l3', 'lz'), map(float, last.split(':')), strict=True))}
        assert [*log['/spinning_top/commands']] == [1_000_000_000, 1_200_000_000]


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--scene', 'cups'], 'scene cups: must be the path of a file, or one of braking, cusp'),
    (['--params', '/nowhere.yaml'], 'spinning-top simulate: /nowhere.yaml: No such file'),
    (['--duration', '1', '-o', '/nowhere/run.mcap'], 'spinning-top simulate: '
     'cannot write /nowhere/run.mcap: No such file or directory\n'),
    (['--duration', '0'], '--duration S, or the parameter duration'),
    (['--duration', '1', '-p', 'spin.l3=2'], "'spin.l3=2'"),
    (['-p', 'imu.frame_id:=base_link'], 'must be another frame than its parent'),
    (['--duration', '1', '--epoch', 'nan'], '--epoch nan'),
    (['--duration', '10', '--epoch', '2147483640'], '2038'),
    (['--duration', '1', '--command', '1.000000001:2:1.5'], 'end of the run, 1 s'),
    (['--duration', '1', '--command', '0.5:nan:2'], '--command 0.5:nan:2'),
    (['--duration', '1', '-p', 'initial.theta:=0.0', '-p', 'solver.equations:=euler'],
     'transport'),
    (['--duration', '1', '-p', 'spin.l3:=1e20'], 'no motion from'),
    (['--duration', '1', '-o', 'run.bag'], 'must end in .mcap, .csv, .parquet')])
def test_wrong_arguments_are_told_in_a_line_and_leave_no_file(
        tmp_path, capsys, arguments, message):
    code = 1 if 'nowhere' in message else 2
    assert main(['-o', str(tmp_path / 'run.csv'), '--quiet', *arguments]) == code
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1 and 'Traceback' not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('name', ['run.mcap', 'run.csv'])
def test_nothing_is_overwritten(tmp_path, capsys, name):
    path = tmp_path / name
    path.write_text('precious')
    assert main(['-o', str(path), '--duration', '1', '--quiet']) == 1
    assert path.read_text() == 'precious'
    assert f'{path}: File exists, and nothing is overwritten: choose' in capsys.readouterr().err


def test_a_command_that_the_state_refuses_ends_the_run_there(tmp_path, capsys):
    path = tmp_path / 'run.mcap'
    assert main(['-o', str(path), '--quiet', '--duration', '1', '-p', 'initial.theta:=0.0', '-p',
                 'solver.method:=exact', '--command', '0.5:2.0:1.0']) == 1
    error = capsys.readouterr().err
    assert error.startswith('spinning-top simulate: --command 0.5:2.0:1.0: lz = 1.0 '
                            'kg m^2/s with l3 = 2.0: the axis is at a pole')
    assert error.endswith('; the file holds the run up to there\n') and error.count('\n') == 1
    assert max(read(path)['/pose']) == 500_000_000
