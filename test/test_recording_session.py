# SPDX-License-Identifier: Apache-2.0
"""The recording of a running simulation: opening beside the ticks, names, failures."""

import json
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import PATIENCE_S
from helpers.node_logs import events_in, log_of
from spinning_top_sim.nodes.pacing import FairLock
from spinning_top_sim.nodes.recording_session import RecordingSession
from spinning_top_sim.nodes.simulator import Simulator
from std_srvs.srv import SetBool

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording import recorder as recorder_module
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.live import LiveSimulation

EPOCH_NS = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


class Recorded:
    """A simulation, its lock and its recording session."""

    def __init__(self, folder, **values):
        given = {name.replace('__', '.'): value for name, value in values.items()}
        self.values = parameters.checked({'record.uri': str(folder), 'record.min_free_bytes': 0,
                                          **given})
        self.simulation = LiveSimulation(self.values, EPOCH_NS)
        self.lock = FairLock()
        self.session = RecordingSession(self.simulation, self.lock, self.topics)

    def topics(self, streams):
        types = {stream.topic: stream.type_name for stream in streams} | journal.TOPICS
        return [(f'/ns/{name.lstrip("~/")}', type_name, {'depth': 10})
                for name, type_name in types.items()]

    def start(self):
        self.session.start(self.values)
        return self.session.open()

    def is_held(self):
        return self.lock._lock.locked()

    def stop(self):
        """Close the log; return what is in it, and its metadata."""
        return log_of(self.session.stop().split(': ')[0])


def test_a_name_with_a_slash_is_a_folder_and_a_second_start_or_stop_does_nothing(tmp_path):
    recorded = Recorded(f'{tmp_path}/new/er.mcap/')
    recorded.start()
    log, = (tmp_path / 'new/er.mcap').iterdir()
    assert log.suffix == '.mcap'
    assert recorded.start() == f'recording already to {log}'
    assert recorded.session.stop().startswith(str(log))
    assert recorded.session.stop() is None


@pytest.fixture
def slow_disk(monkeypatch):
    """Have a log opened no sooner than `go_on` is set; `opening` says that it is at it."""
    disk = SimpleNamespace(opening=threading.Event(), go_on=threading.Event())
    ordinary = recorder_module.Recorder

    def opened(*arguments, **options):
        disk.opening.set()
        assert disk.go_on.wait(PATIENCE_S)
        return ordinary(*arguments, **options)

    monkeypatch.setattr(recorder_module, 'Recorder', opened)
    return disk


def test_ticks_and_commands_go_on_while_a_log_is_being_opened_and_are_in_it(
        tmp_path, slow_disk, monkeypatch):
    recorded, held, ordinary = Recorded(tmp_path), [], provenance.environment
    monkeypatch.setattr(provenance, 'environment',
                        lambda: held.append(recorded.is_held()) or ordinary())
    simulation, session = recorded.simulation, recorded.session
    simulation.advance(SECOND)
    answers = []
    opening = threading.Thread(target=lambda: answers.append(recorded.start()), daemon=True)
    opening.start()
    assert slow_disk.opening.wait(PATIENCE_S)
    assert not recorded.is_held()                   # the other thread waits for the disk
    assert held == [False]                          # it has read files
    with recorded.lock:
        simulation.advance(2 * SECOND)
        simulation.command(2.0, 1.0)
        session.write_command(2.0, 1.0)
        simulation.advance(3 * SECOND)
    assert session.has_room() and session.numbers() == {'recorder': 'off'}
    slow_disk.go_on.set()
    opening.join(PATIENCE_S)
    assert answers[0].startswith('recording to ')
    simulation.advance(4 * SECOND)
    log, metadata = recorded.stop()
    times = [at - EPOCH_NS for at, _ in log['/ns/pose']]
    assert times == list(range(SECOND + 10_000_000, 4 * SECOND + 1, 10_000_000))
    assert metadata['spinning_top_sim']['begun_ns'] == str(SECOND)
    assert json.loads(metadata['spinning_top_sim']['history']) == []
    assert [event['event'] for event in events_in(log)] == ['start', 'command']
    assert [at - EPOCH_NS for at, _ in log['/ns/commands']] == [2 * SECOND]


def test_two_nodes_that_start_in_the_same_second_take_different_names(tmp_path, monkeypatch):
    monkeypatch.setattr(time, 'strftime', lambda _: 'spinning_top_2000-01-01_00-00-00')
    nodes = [Recorded(tmp_path) for _ in range(2)]
    together = threading.Barrier(len(nodes))

    def start(node):
        together.wait(PATIENCE_S)
        node.start()

    threads = [threading.Thread(target=start, args=(node,), daemon=True) for node in nodes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
    for number, node in enumerate(nodes):
        node.simulation.advance(number * SECOND)
    stem = 'spinning_top_2000-01-01_00-00-00'
    assert {path.name for path in tmp_path.iterdir()} == {f'{stem}.mcap', f'{stem}_2.mcap'}
    assert [len(node.stop()[0]['/ns/pose']) for node in nodes] == [1, 101]


def test_a_file_that_is_named_is_never_overwritten_and_nothing_is_kept(tmp_path):
    path = tmp_path / 'there.mcap'
    path.write_bytes(b'precious')
    recorded = Recorded(path)
    with pytest.raises(RecordingError, match='exists'):
        recorded.start()
    assert path.read_bytes() == b'precious'
    assert not any(output.is_used for output in recorded.simulation.outputs)
    recorded.simulation.advance(SECOND)
    assert recorded.session.stop() is None
    assert recorded.session.numbers() == {'recorder': 'off'}


def test_a_recording_that_has_failed_gives_way_to_the_next(tmp_path):
    recorded, told = Recorded(tmp_path), []
    recorded.start()
    assert recorded.session.check() is None
    recorded.session._recorder.error = 'the disk is gone'
    node = SimpleNamespace(
        _session=recorded.session, check_started=lambda: None, start_values=recorded.values,
        _log=SimpleNamespace(error=told.append))
    node._check_recording = lambda: Simulator._check_recording(node)
    assert Simulator._record(node, SetBool.Request(data=True)).startswith('recording to ')
    assert told == ['recording stopped: the disk is gone; the simulation goes on']
    assert ' messages, ' in Simulator._record(node, SetBool.Request())
    assert Simulator._record(node, SetBool.Request()) == 'not recording'
