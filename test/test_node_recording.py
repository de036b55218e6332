# SPDX-License-Identifier: Apache-2.0
"""What a node records: beside its ticks, whole, and the same as `simulate` computes."""

import errno

import pytest

pytest.importorskip('rclpy')

from helpers.node_logs import log_of, verified
from helpers.own_node import OwnNode
from std_srvs.srv import SetBool

from spinning_top_sim.recording import recorder
from spinning_top_sim.recording.writer import McapWriter


def test_who_asks_twice_for_a_recording_hears_twice_where_it_goes(tmp_path):
    with OwnNode(tmp_path, start_paused=True) as node:
        (service,) = (one for one in node.node.services if one.srv_name.endswith('/record'))
        asked = [service.callback(SetBool.Request(data=True), SetBool.Response())
                 for _ in range(2)]
        node.spin_until('the answers', lambda: all(one.done() for one in asked))
    assert [one.result().message for one in asked] == [
        f'recording {text} {tmp_path}/run.mcap' for text in ('to', 'already to')]


def test_a_step_waits_for_a_recorder_that_has_no_room(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, 'QUEUE_BYTES', 20_000)
    with OwnNode(tmp_path, start_paused=True) as node:
        assert node.switch('record', True).success
        node.step(500)
    assert len(log_of(tmp_path / 'run.mcap')[0]['/pose']) == 501


def test_a_recording_that_fails_is_told_once_and_gives_way_to_the_next(
        tmp_path, monkeypatch, capfd):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, 'No space left on device')

    precious = tmp_path / 'run.mcap'
    precious.write_bytes(b'precious')
    with OwnNode(tmp_path, record__enabled=True) as node:
        node.spin_until('an error', lambda: node.diagnostics()[0] == 2)
        assert 'exists' in node.diagnostics()[1]
        answer = node.switch('record', True)
        assert not answer.success and 'exists' in answer.message
        assert not any(one.is_used for one in node.simulation.outputs)
        assert node.set(record__uri=f'{tmp_path}/new/er.mcap/').successful
        assert node.switch('record', True).success
        (path,) = (tmp_path / 'new/er.mcap').iterdir()
        with monkeypatch.context() as patch:
            patch.setattr(McapWriter, 'flush', full)
            node.spin_until('an error', lambda: node.diagnostics()[0] == 2)
        level, message, said = node.diagnostics()
        assert (level, said['recorder'], said['state']) == (2, 'failed', 'running')
        assert f'{path}' in message and 'No space left' in message
        assert node.set(record__uri=f'{tmp_path}/third.mcap').successful
        assert node.switch('record', True).success
        assert node.diagnostics()[:2] == (0, 'running')
    errors = [line for line in capfd.readouterr().err.splitlines() if 'ERROR' in line]
    assert ['not recording' in errors[0], 'recording stopped' in errors[1]] == [True, True]
    assert len(errors) == 2 and precious.read_bytes() == b'precious'
    assert verified(tmp_path / 'third.mcap')['identical']
