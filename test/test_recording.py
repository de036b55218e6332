# SPDX-License-Identifier: Apache-2.0
"""
The recorder: logs that others read, their names, and how they end.

The readers are rosbags and mcap, none of them written here.  What a slow, full or failing disk
does: test_world.py and test_failing_calls.py.
"""

import json
import os
import random
import re
import runpy
import struct
import time
from contextlib import closing
from types import SimpleNamespace

import pytest
import yaml  # type: ignore[import-untyped]
from helpers.logs import records_of, seen_by_mcap
from helpers.machine import Machine
from helpers.recordings import EPOCH_NS, JAZZY, METADATA, TOPICS, some_messages
from helpers.reference import ROOT
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, MessageIndex
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from rosbags.highlevel import AnyReader

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording import recorder as recorder_module
from spinning_top_sim.recording.errors import MAX_BYTES
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import Recorder, single
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS, qos_profiles


def record(path, messages, topics=TOPICS, metadata=METADATA.copy, **options):
    with closing(Recorder(
            str(path), topics, metadata, **{'min_free_bytes': 0} | options)) as recorder:
        for message in messages:
            recorder.write([single(*message)])
        recorder.close()
    return recorder


def check_indexes(path):
    """Each entry of an index is the place of its message in the chunk, as rosbag2 reads it."""
    plain, count = b'', 0
    with path.open('rb') as file:
        for one in StreamReader(file, emit_chunks=True).records:
            if isinstance(one, Chunk):
                stream, _ = get_chunk_data_stream(one)
                plain = stream.read(one.uncompressed_size)
            elif isinstance(one, MessageIndex):
                for log_time, offset in one.records:
                    opcode, _, channel, _, found, _ = struct.unpack_from('<BQHIQQ', plain, offset)
                    assert (opcode, channel, found) == (
                        Opcode.MESSAGE, one.channel_id, log_time)
                    count += 1
    return count


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
def test_mcap_and_rosbags_read_every_message(tmp_path, compression):
    messages, path = some_messages(12_000), tmp_path / 'run.mcap'
    record(path, messages, compression=compression)
    expected = [(TOPICS[index].name, stamp, data) for index, stamp, data in messages]
    assert seen_by_mcap(path) == expected       # with all checksums
    assert check_indexes(path) == len(messages)
    indexes = [record for record in records_of(path.read_bytes())
               if record[0] == Opcode.MESSAGE_INDEX]
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
    assert sum(end - start for _, start, end in indexes) == sum(
        one.message_index_length for one in summary.chunk_indexes)
    assert len(summary.chunk_indexes) > 1 and (
        summary.statistics.message_start_time, summary.statistics.message_end_time) == (
            messages[0][1], messages[-1][1])
    with AnyReader([path]) as reader:
        read = list(reader.messages())
        assert [(connection.topic, stamp, bytes(data)) for connection, stamp, data in read
                ] == expected
        for number, (connection, _, data) in enumerate(read):
            message = reader.deserialize(data, connection.msgtype)
            value = message.pose.position.z if number % 2 == 0 else message.data[0]
            assert value == number


@pytest.mark.parametrize('count', [0, 101])
def test_channels_and_the_metadata_of_the_bag_are_those_of_rosbag2(tmp_path, monkeypatch, count):
    monkeypatch.setenv('ROS_DISTRO', 'kilted')
    path = tmp_path / 'a "b": #ü\udcff.mcap'      # the last one is no text
    assert record(path, some_messages(count)).written[0] == count
    with open(path, 'rb') as file:
        reader = make_reader(file)
        summary, profile = reader.get_summary(), reader.get_header().profile
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
    assert profile == 'ros2' and metadata['spinning_top_sim'].items() >= METADATA.items()
    bag = yaml.safe_load(metadata['rosbag2']['serialized_metadata'])
    expected = {'version': 9, 'storage_identifier': 'mcap', 'ros_distro': 'kilted',
                'message_count': count, 'relative_file_paths': ['a "b": #ü?.mcap'],
                'starting_time': {'nanoseconds_since_epoch': EPOCH_NS if count else 0},
                'duration': {'nanoseconds': max(0, count - 1) * 1_000_000}}
    assert {name: bag[name] for name in expected} == expected
    channels, counts = summary.channels.values(), [(count + 1) // 2, count // 2, 0]
    for entry, channel, topic, number in zip(
            bag['topics_with_message_count'], channels, TOPICS, counts, strict=True):
        told, type_hash = entry['topic_metadata'], JAZZY.hash_rihs01(topic.type_name)
        assert (told['name'], told['type'], entry['message_count']) == (*topic[:2], number)
        assert told['type_description_hash'] == channel.metadata['topic_type_hash'] == type_hash
        assert told['offered_qos_profiles'][0]['reliability'] == (
            'best_effort' if topic.qos else 'reliable')
        assert (channel.topic, channel.message_encoding) == (topic.name, 'cdr')
        profiles = channel.metadata['offered_qos_profiles']
        assert yaml.safe_load(profiles) == [{**DEFAULT_QOS, **topic.qos}]
        # As yaml-cpp writes it: in blocks and without anchors.
        assert profiles.startswith('- history: 1\n  depth: ') and '&' not in profiles
        schema = summary.schemas[channel.schema_id]
        assert (schema.name, schema.encoding) == (topic.type_name, 'ros2msg')


# Reliability, durability, history and depth.
OFFERED = {     # any style of YAML; a policy that is not understood is the default
    '[{depth: 7, reliability: best_effort, deadline: {sec: 1, nsec: 2}}]': [(2, 2, 1, 7)],
    '# offered\n- depth: 7  # last\n  reliability: 2\n  durability: 1': [(2, 1, 1, 7)],
    **{f'- {{history: {x}, depth: {x}, reliability: {x}}}': [(1, 2, 1, 10)] for x in (
        '1.5', '[1]', '{}', 'true', '"7"', '~', 'unknown', 1 << 63)},
    **{text: [] for text in (
        '', '7', '[' * 1000, '!!timestamp x', '\x00', '? {} : 1', '- <<: {depth: 7}')}}


@pytest.mark.parametrize('text', OFFERED)
def test_offered_qos_is_what_is_understood(text):
    channel = Channel(1, '/a', 'cdr', {'offered_qos_profiles': text}, 1)
    assert [tuple(one.values()) for one in qos_profiles(channel)] == OFFERED[text]


def test_the_definitions_of_all_streams_are_those_that_rosbags_generates():
    written = runpy.run_path(str(ROOT / 'docs/definitions.py'))
    assert written['FILE'].read_text('utf-8') == written['definitions']()


def test_what_decides_the_last_bits_is_told(monkeypatch):
    versions = {'gmpy2': '2.2', 'pymap3d': 'unknown'}
    monkeypatch.setattr(provenance, 'version', lambda name='': versions.get(name, '1.0'))
    assert json.loads(provenance.environment()['libraries']) == {
        'numpy': '1.0', 'mcap': '1.0', 'gmpy2': '2.2'}


def test_messages_of_any_length_are_all_kept_and_the_bytes_are_always_the_same(tmp_path):
    """
    Chunks stay of a size, and in the file the messages of a topic are in the order in which they
    were handed over.
    """
    rng = random.Random(5)
    messages, contents, found = [], [], [[], [], []]
    for time_ns in range(5000):
        topic = rng.randrange(3)
        size = (1000, rng.choice([12, 12, 12, 700]), time_ns % 7)[topic]
        data = rng.randbytes(3_000_000 if time_ns == 999 else size)
        messages.append((topic, 5000 - time_ns, data))
    for folder in (tmp_path / 'a', tmp_path / 'b'):
        folder.mkdir()
        path = folder / 'run.mcap'
        record(path, messages, max_loss=100.0)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert 3 <= len(summary.chunk_indexes) <= 9
        for _, channel, message in reader.iter_messages(log_time_order=False):
            assert message.sequence == len(found[channel.id - 1])
            found[channel.id - 1].append((message.log_time, message.data))
        assert summary.statistics.message_start_time == 1
        assert summary.statistics.message_end_time == 5000
    assert found == [[message[1:] for message in messages if message[0] == topic]
                     for topic in range(3)]


def test_too_little_space_leaves_no_file_and_holds_nobody_up(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, 'QUEUE_BYTES', 1)
    recorder = record(tmp_path / 'run.mcap', [(0, 1, b'')], min_free_bytes=10 ** 30)
    assert re.fullmatch(rf'cannot write {tmp_path}/run\.mcap: \d+ bytes are free .* 10{{30}}',
                        recorder.error)
    assert (recorder.path, recorder.missing, recorder.written) == (None, 1, (0, 0))
    assert recorder.room and not list(tmp_path.iterdir())


def test_a_failure_ends_the_wait_for_room(tmp_path, monkeypatch):
    def live():
        recorder = Recorder(f'{tmp_path}/none/a.mcap', TOPICS, dict, threads=machine)
        recorder.write([single(0, 1, b'')])
        assert not recorder.room and recorder.wait_for_room(1000.0) and recorder.error
        assert machine.clock() - began < 1.0

    monkeypatch.setattr(recorder_module, 'QUEUE_BYTES', 1)
    machine = Machine(random.Random(1))
    began = machine.clock()
    machine.run(live)


@pytest.mark.parametrize(('harm', 'reason'), [
    (lambda path, patch: path.unlink(), 'the file was deleted'),
    (lambda path, patch: patch.setattr(os, 'fstatvfs', lambda descriptor: SimpleNamespace(
        f_bavail=3, f_frsize=1)), '3 bytes are free on the disk, fewer than min_free_bytes = 5')])
def test_a_file_that_is_deleted_and_a_disk_that_fills_end_a_recording(
        tmp_path, monkeypatch, harm, reason):
    path = tmp_path / 'run.mcap'
    recorder = Recorder(str(path), TOPICS, METADATA.copy, min_free_bytes=5)
    while recorder.state == 'opening':
        time.sleep(0.002)
    recorder.write([single(*some_messages(1)[0])])
    harm(path, monkeypatch)
    recorder.close()
    assert recorder.error == f'recording to {path} stopped: {reason}'
    assert not path.exists() or len(seen_by_mcap(path)) == 1


def test_a_file_has_its_name_or_a_date_and_none_is_overwritten(tmp_path, monkeypatch):
    """In a folder, which a name with a slash makes, it is a date."""
    forgotten = []
    monkeypatch.setattr(recorder_module.atexit, 'unregister', forgotten.append)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'old').mkdir()
    dated = r'spinning_top_\d{4}(-\d\d){2}_\d\d(-\d\d){2}_\d{6}\.mcap'
    for uri, path in (('run.mcap', r'run\.mcap'), *2 * (('new/er/', f'new/er/{dated}'),),
                      ('~/old', f'old/{dated}'), ('plain', 'plain'), ('', dated), ('', dated)):
        recorder = record(uri, [])
        assert re.fullmatch(f'{tmp_path}/{path}', str(recorder.path))
        with LogReader(recorder.path) as reader:
            assert reader.whole and reader.span == (0, 0)
    content = (tmp_path / 'run.mcap').read_bytes()
    for uri, reason in (('run.mcap', 'File exists'), ('none/a.mcap', 'No such file or directory')):
        assert record(uri, []).error == f'cannot write {tmp_path}/{uri}: {reason}'
    assert 'run.mcap' in record('run.mcap/', []).error
    twice = record('twice.mcap', [], [TOPICS[0], TOPICS[0]])
    assert twice.error == "topic '/top/pose' is listed twice: once is allowed"
    long = record('long.mcap', [], metadata=lambda: {'history': MAX_BYTES * ' '})
    assert 'too many events' in long.error and not (tmp_path / 'long.mcap').exists()
    assert (tmp_path / 'run.mcap').read_bytes() == content and len(forgotten) == 12
