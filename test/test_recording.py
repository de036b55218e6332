# SPDX-License-Identifier: Apache-2.0
"""
The recorder: logs that others read, a bounded loss, and disks that fail.

The readers are rosbags and mcap, none of them written here; the messages are
serialized by rosbags.
"""

import io
import json
import os
import random
import re
import shutil
import struct
import subprocess
import sys
import textwrap
import threading
import time
import zlib
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, DataEnd, Message, MessageIndex, SummaryOffset
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosHistory, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.recording import definitions, writer
from spinning_top_sim.recording.chunks import CHUNK_BYTES, PlainChunk, time_span
from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.recording.mcap_writer import McapWriter
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import (
    DEFAULT_QOS,
    RecordedTopic,
    qos_profiles,
)
from spinning_top_sim.recording.writer import McapRecorder, create_file
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.topics import all_streams

ROOT = Path(__file__).parents[1]
COMPRESSIONS = ('zstd', 'lz4', 'none')
JAZZY = get_typestore(Stores.ROS2_JAZZY)
POSE = 'geometry_msgs/msg/PoseStamped'
ARRAY = 'std_msgs/msg/Float64MultiArray'
TOPICS = (
    RecordedTopic('/top/pose', POSE),
    RecordedTopic('/top/spinning_top/invariants', ARRAY, {'depth': 3, 'reliability': 2}),
    RecordedTopic('/top/silent', POSE),
)
METADATA = {'seed': '7', 'top.mass': '0.5', 'note': 'θ: "quoted"\nline'}
EPOCH_NS = 1_700_000_000_000_000_000
SUMMARY_OPCODES = (
    Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET)  # what follows a group of the summary
PATIENCE_S = 20.0  # for what happens at once on an idle machine


def pose_cdr(number: int) -> bytes:
    types = JAZZY.types
    pose = types['geometry_msgs/msg/Pose'](
        types['geometry_msgs/msg/Point'](1.0, 2.0, float(number)),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.6, 0.0, 0.8))
    stamp = types['builtin_interfaces/msg/Time'](1_700_000_000, number)
    header = types['std_msgs/msg/Header'](stamp, 'world')
    return bytes(JAZZY.serialize_cdr(types[POSE](header, pose), POSE))


def array_cdr(number: int) -> bytes:
    """The CDR of a Float64MultiArray without labels, packed by hand."""
    return struct.pack('<4sIII4xd', b'\x00\x01\x00\x00', 0, 0, 1, float(number))


def some_messages(count: int) -> list[tuple[int, int, bytes]]:
    """Messages of the first two topics in turn, 1 ms apart."""
    makers = (pose_cdr, array_cdr)
    return [(n % 2, EPOCH_NS + n * 1_000_000, makers[n % 2](n)) for n in range(count)]


def record(path, messages, **options):
    with closing(McapRecorder(
            path, TOPICS, METADATA, **{'min_free_bytes': 0} | options)) as recorder:
        for message in messages:
            recorder.write(*message)
        return recorder.close()


def complete_messages(path):
    """Return (topic, channel, message) of every complete chunk, in file order; torn files too."""
    found = []
    with open(path, 'rb') as file:
        reader = NonSeekingReader(file)
        try:
            for _, channel, message in reader.iter_messages(log_time_order=False):
                found.append((channel.topic, channel, message))
        except McapError:
            pass
    return found


def numbers_in(path):
    """Return the stamps of a log whose messages are stamped 0, 1, 2, ..."""
    return [message.log_time for _, _, message in complete_messages(path)]


def is_indexed(path):
    """Return whether a file has its summary; ordinary readers refuse it without."""
    with LogReader(path) as reader:
        return reader.whole


def eventually(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, 'did not happen in time'
        time.sleep(0.005)


# What readers find

@pytest.mark.parametrize(('compression', 'default_typestore'), [
    ('zstd', None), ('lz4', JAZZY), ('none', None)])
def test_rosbags_reads_every_message(tmp_path, compression, default_typestore):
    messages = some_messages(500)
    record(tmp_path / 'run.mcap', messages, compression=compression)
    with AnyReader([tmp_path / 'run.mcap'], default_typestore=default_typestore) as reader:
        read = list(reader.messages())
        assert [(TOPICS[index].name, stamp, data) for index, stamp, data in messages] == [
            (connection.topic, stamp, bytes(data)) for connection, stamp, data in read]
        for number, (connection, _, data) in enumerate(read):
            message = reader.deserialize(data, connection.msgtype)
            value = message.pose.position.z if number % 2 == 0 else message.data[0]
            assert value == number


def test_checksums_are_there_and_indexes_lead_to_the_messages(tmp_path):
    """Chunk index -> message index -> message, by the offsets, as rosbag2 goes."""
    path = tmp_path / 'run.mcap'
    record(path, some_messages(20_000), max_loss=60.0)
    content = path.read_bytes()
    records = list(StreamReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True).records)
    summary = make_reader(io.BytesIO(content), validate_crcs=True).get_summary()
    (end,) = (item for item in records if isinstance(item, DataEnd))
    assert end.data_section_crc != 0
    assert records[-1].summary_crc == zlib.crc32(content[records[-1].summary_start:-12])
    assert summary.statistics.message_start_time == EPOCH_NS
    assert summary.statistics.message_end_time == EPOCH_NS + 19_999 * 1_000_000
    for group in (item for item in records if isinstance(item, SummaryOffset)):
        assert content[group.group_start] == group.group_opcode
        assert content[group.group_start + group.group_length] in SUMMARY_OPCODES
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 1
    found = []
    for chunk_index in summary.chunk_indexes:
        chunk = record_at(content, chunk_index.chunk_start_offset, Chunk)
        assert chunk.uncompressed_crc != 0 and chunk.uncompressed_size <= CHUNK_BYTES + 200
        plain = get_chunk_data_stream(chunk, validate_crc=True)[0].read(2 * CHUNK_BYTES)
        assert sorted(chunk_index.message_index_offsets) == [1, 2]
        for channel_id, offset in chunk_index.message_index_offsets.items():
            index = record_at(content, offset, MessageIndex)
            assert index.channel_id == channel_id
            for stamp, message_offset in index.records:
                length = int.from_bytes(plain[message_offset + 1:message_offset + 9], 'little')
                stream = ReadDataStream(io.BytesIO(plain[message_offset + 9:]))
                message = Message.read(stream, length)
                assert (message.channel_id, message.log_time) == (channel_id, stamp)
                found.append((message.channel_id - 1, stamp, message.data))
    assert sorted(found, key=lambda item: item[1]) == some_messages(20_000)


def record_at(content: bytes, offset: int, kind):
    """Return the record at a place in the file; its first nine bytes are opcode and length."""
    return kind.read(ReadDataStream(io.BytesIO(content[offset + 9:])))


def test_channels_carry_qos_and_type_hash(tmp_path):
    record(tmp_path / 'run.mcap', [])
    with open(tmp_path / 'run.mcap', 'rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == 'ros2'
        assert reader.get_header().library.startswith('spinning_top_sim ')
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert list(channels) == [topic.name for topic in TOPICS]
    for topic in TOPICS:
        channel = channels[topic.name]
        assert channel.message_encoding == 'cdr'
        profiles = channel.metadata['offered_qos_profiles']
        assert yaml.safe_load(profiles) == [dict(DEFAULT_QOS) | topic.qos]
        # As yaml-cpp writes it: in blocks and without anchors.
        assert profiles.startswith('- history: 1\n  depth: ') and '&' not in profiles
        assert channel.metadata['topic_type_hash'] == JAZZY.hash_rihs01(topic.type_name)
        schema = summary.schemas[channel.schema_id]
        assert (schema.name, schema.encoding) == (topic.type_name, 'ros2msg')
    assert len(summary.schemas) == 2
    with Reader(tmp_path / 'run.mcap') as reader:
        profile: Qos = reader.connections[1].ext.offered_qos_profiles[0]
        assert profile.reliability is QosReliability.BEST_EFFORT
        assert (profile.history, profile.depth) == (QosHistory.KEEP_LAST, 3)


def parsed_qos(text):
    return qos_profiles(ChannelRecord(1, '/a', 'cdr', {'offered_qos_profiles': text}, 1))


@pytest.mark.parametrize('text', [
    '[{depth: 7, reliability: best_effort, deadline: {sec: 1, nsec: 2}}]',
    '# what it offers\n- depth: 7   # last ones\n  reliability: 2\n  deadline: {sec: 1, nsec: 2}',
    '- {"depth": 7, "reliability": 2, "histroy": 3, deadline: {"sec": 1, "nsec": 2}}',
])
def test_offered_qos_is_read_in_any_style_of_yaml(text):
    assert parsed_qos(text) == (
        dict(DEFAULT_QOS) | {'depth': 7, 'reliability': 2, 'deadline': {'sec': 1, 'nsec': 2}},)


@pytest.mark.parametrize('value', [
    '1.5', '[1]', '{}', 'true', '"7"', '~', '.nan', 'keep_some', str(1 << 63), '-' + '9' * 20])
def test_a_policy_that_is_not_understood_is_the_default(value):
    keys = ('history', 'depth', 'reliability', 'deadline')
    text = '- ' + '\n  '.join(f'{key}: {value}' for key in keys)
    assert parsed_qos(text) == (DEFAULT_QOS,)


@pytest.mark.parametrize('text', [
    '', '7', '{}', '- 7', '[', '- depth: ' + '9' * 5000, '[' * 1000, '!!int ""', '!!timestamp x',
    '- {a: &a [1], <<: *a}', '\x00', 'x' * 100_000, '? {} : 1', '- ? []\n  : 1', '"\\ud800"',
    'a: &a {b: 1}\n' + ''.join(
        f'{name}: &{name} {{<<: [{", ".join([f"*{former}"] * 20)}]}}\n'
        for former, name in zip('abcdefgh', 'bcdefghi', strict=True)),
])
def test_what_is_no_list_of_profiles_offers_none(text):
    assert parsed_qos(text) == ()


@pytest.mark.parametrize('count', [0, 101])
def test_bag_metadata_agrees_with_the_messages(tmp_path, monkeypatch, count):
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    path = tmp_path / 'a "b": #ü.mcap'
    summary = record(path, some_messages(count))
    assert summary.counts == {
        TOPICS[0].name: (count + 1) // 2, TOPICS[1].name: count // 2, TOPICS[2].name: 0}
    with open(path, 'rb') as file:
        records = {item.name: item.metadata for item in make_reader(file).iter_metadata()}
    assert records['spinning_top_sim'] == METADATA
    bag = yaml.safe_load(records['rosbag2']['serialized_metadata'])
    assert bag['version'] == 9
    assert bag['storage_identifier'] == 'mcap'
    assert bag['ros_distro'] == 'jazzy'
    assert bag['message_count'] == bag['files'][0]['message_count'] == count
    assert bag['starting_time']['nanoseconds_since_epoch'] == (EPOCH_NS if count else 0)
    assert bag['duration']['nanoseconds'] == max(0, count - 1) * 1_000_000
    assert bag['relative_file_paths'] == [path.name]
    for entry, topic in zip(bag['topics_with_message_count'], TOPICS, strict=True):
        assert entry['message_count'] == summary.counts[topic.name]
        assert entry['topic_metadata']['name'] == topic.name
        assert entry['topic_metadata']['type'] == topic.type_name
        assert entry['topic_metadata']['type_description_hash'].startswith('RIHS01_')
        assert entry['topic_metadata']['offered_qos_profiles'][0]['history'] == 'keep_last'
    assert bag['topics_with_message_count'][1]['topic_metadata']['offered_qos_profiles'][0][
        'reliability'] == 'best_effort'


def test_a_bag_folder_made_of_the_embedded_metadata_is_read(tmp_path):
    """The record holds what rosbag2 would have put into metadata.yaml."""
    record(tmp_path / 'run.mcap', some_messages(100))
    with open(tmp_path / 'run.mcap', 'rb') as file:
        text = next(item.metadata['serialized_metadata']
                    for item in make_reader(file).iter_metadata() if item.name == 'rosbag2')
    (tmp_path / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n' + textwrap.indent(text, '  '))
    with Reader(tmp_path) as reader:
        assert reader.message_count == len(list(reader.messages())) == 100
        assert reader.ros_distro == os.environ.get('ROS_DISTRO', 'jazzy')


def test_chunks_with_falling_stamps_give_the_whole_span(tmp_path):
    """Statistics and bag metadata tell the earliest and the latest stamp of all chunks."""
    path = tmp_path / 'run.mcap'
    file = create_file(path, TOPICS, METADATA, compression='none')
    for chunk in ((50, 40), (20, 30)):
        for stamp in chunk:
            file.append(0, stamp, pose_cdr(stamp))
        file.write_chunk()
    file.finish()
    with path.open('rb') as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        bag = yaml.safe_load(next(
            item.metadata['serialized_metadata'] for item in reader.iter_metadata()
            if item.name == 'rosbag2'))
    assert [(index.message_start_time, index.message_end_time)
            for index in summary.chunk_indexes] == [(40, 50), (20, 30)]
    assert summary.statistics.message_start_time == 20
    assert summary.statistics.message_end_time == 50
    for times in (bag, bag['files'][0]):
        assert times['starting_time']['nanoseconds_since_epoch'] == 20
        assert times['duration']['nanoseconds'] == 30


# Definitions

def test_a_schema_holds_constants_then_fields_and_what_they_need(tmp_path, monkeypatch):
    """Depth first, each once, without comments and default values."""
    share = tmp_path / 'share' / 'nested_msgs' / 'msg'
    share.mkdir(parents=True)
    (share / 'Root.msg').write_bytes(
        b'# Zebra in a comment\r\nnested_msgs/Zebra[<=3] z\nApe  a\nstring<=5 s "x"\nuint8 N = 1')
    (share / 'Ape.msg').write_bytes(b'Zebra[2] z # no newline at the end')
    (share / 'Zebra.msg').write_bytes('float32 c 0.5  # [°]\n'.encode())
    (share / 'Root.json').write_text(json.dumps({'type_hashes': [
        {'type_name': 'nested_msgs/msg/Zebra', 'hash_string': 'RIHS01_0'},
        {'type_name': 'nested_msgs/msg/Root', 'hash_string': 'RIHS01_1'}]}))
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "nothing"}{os.pathsep}{tmp_path}')
    text, type_hash = find_definition('nested_msgs/msg/Root')
    line = '=' * 80
    assert text == (
        'uint8 N=1\nnested_msgs/Zebra[<=3] z\nnested_msgs/Ape a\nstring<=5 s\n'
        f'{line}\nMSG: nested_msgs/Zebra\nfloat32 c\n'
        f'{line}\nMSG: nested_msgs/Ape\nnested_msgs/Zebra[2] z\n')
    assert type_hash == 'RIHS01_1'


RECORDED = sorted({stream.type_name for stream in all_streams(parameters.checked({}))}
                  | {type_name for _, type_name in journal.TOPICS})


@pytest.mark.parametrize('type_name', RECORDED)
def test_definitions_are_the_same_with_and_without_ros(type_name):
    assert find_definition(type_name) == definitions._of_rosbags(type_name)


@pytest.mark.parametrize('type_name', [
    'geometry_msgs/msg/NoSuchType', 'no_such_msgs/msg/Type'])
def test_a_missing_definition_is_named(tmp_path, type_name):
    with pytest.raises(RecordingError) as caught:
        McapRecorder(
            tmp_path / 'run.mcap', [RecordedTopic('/a', type_name)], {}, min_free_bytes=0)
    assert type_name in str(caught.value)
    assert not list(tmp_path.iterdir())


# Starting

def test_an_existing_file_is_left_alone(tmp_path):
    path = tmp_path / 'run.mcap'
    path.write_text('precious')
    with pytest.raises(RecordingError, match=r'run\.mcap.*exists'):
        McapRecorder(path, TOPICS, METADATA, min_free_bytes=0)
    assert path.read_text() == 'precious'


def test_a_missing_directory_is_named(tmp_path):
    with pytest.raises(RecordingError, match=f'no directory {tmp_path}/logs'):
        McapRecorder(tmp_path / 'logs' / 'run.mcap', TOPICS, METADATA, min_free_bytes=0)


def test_too_little_space_at_the_start_leaves_no_file(tmp_path):
    with pytest.raises(RecordingError, match=r'run\.mcap: \d+ bytes are free .* 10{30}'):
        McapRecorder(tmp_path / 'run.mcap', TOPICS, METADATA, min_free_bytes=10 ** 30)
    assert not list(tmp_path.iterdir())


def test_a_head_that_cannot_be_written_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(os, 'fsync', refuse_to_sync)
    with pytest.raises(RecordingError, match=r'run\.mcap: Input/output error'):
        McapRecorder(tmp_path / 'run.mcap', TOPICS, METADATA, min_free_bytes=0)
    assert not list(tmp_path.iterdir())


def refuse_to_sync(descriptor):
    raise OSError(5, os.strerror(5))


def test_topics_twice_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'/top/pose' is listed twice"):
        McapRecorder(tmp_path / 'run.mcap', [TOPICS[0], TOPICS[0]], {})


# Running and ending

def test_a_file_and_its_name_are_on_the_disk_when_it_is_closed(tmp_path, monkeypatch):
    """First the content, then the directory: a name without content would be a broken log."""
    synced = []
    monkeypatch.setattr(os, 'fsync', lambda fd: synced.append(os.readlink(f'/proc/self/fd/{fd}')))
    path = tmp_path / 'run.mcap'
    file = create_file(path, TOPICS, METADATA, compression='zstd')
    assert synced == [str(path), str(tmp_path)]
    synced.clear()
    file.append(0, 1, pose_cdr(1))
    file.write_chunk()
    file.finish()
    assert synced == [str(path), str(tmp_path)]


def test_closing_twice_changes_nothing(tmp_path):
    recorder = McapRecorder(tmp_path / 'run.mcap', TOPICS, METADATA, min_free_bytes=0)
    recorder.write(0, 1, pose_cdr(1))
    first = recorder.close()
    content = first.path.read_bytes()
    recorder.write(0, 2, pose_cdr(2))
    second = recorder.close()
    assert recorder.state == 'closed'
    assert (first.counts, first.bytes, first.error, first.lost) == (
        second.counts, second.bytes, None, 0)
    assert is_indexed(first.path)
    assert second.lost == recorder.counters.lost == 1
    assert first.bytes == len(content) == len(second.path.read_bytes())


def test_messages_of_any_length_are_all_kept(tmp_path):
    """
    Chunks stay of a size, and in the file the messages are in the order in which they were
    handed over.
    """
    rng = random.Random(5)
    wanted = [[], [], []]
    with closing(McapRecorder(
            tmp_path / 'run.mcap', TOPICS, METADATA, max_loss=100.0,
            min_free_bytes=0)) as recorder:
        for time_ns in range(5000):
            topic = rng.randrange(3)
            size = (1000, rng.choice([12, 12, 12, 700]), time_ns % 7)[topic]
            data = rng.randbytes(size)
            wanted[topic].append((time_ns, data))
            recorder.write(topic, time_ns, data)
    found = [[], [], []]
    names = [topic.name for topic in TOPICS]
    with (tmp_path / 'run.mcap').open('rb') as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            of_topic = found[names.index(channel.topic)]
            assert message.sequence == len(of_topic)
            of_topic.append((message.log_time, message.data))
        chunks = reader.get_summary().chunk_indexes
    assert found == wanted
    assert 2 <= len(chunks) <= 4
    assert max(chunk.uncompressed_size for chunk in chunks) < 1.5 * CHUNK_BYTES


def test_rows_give_the_chunk_that_single_messages_give():
    """Also with falling stamps, sequence numbers that wrap, no data, and more than 2 MiB."""
    times = np.array([*range(30, 50), *range(30)])
    rows = np.frombuffer(b''.join(pose_cdr(number) for number in range(50)), 'u1').reshape(50, -1)
    many = np.arange(600), np.zeros((600, 6000), np.uint8)
    together, singly = PlainChunk(), PlainChunk()
    for _ in range(2):
        for chunk in (together, singly):
            chunk.clear()
            chunk.add(3, 9, 35, 36, b'another')
        for channel_id, sequence, stamps, block in (
                (3, 10, times, rows), (1, 2 ** 32 - 7, times, rows), (2, 0, times, rows[:, :0]),
                (2, 50, *many)):
            together.add_rows(channel_id, sequence, stamps, block)
            for number, row in enumerate(block):
                singly.add(channel_id, sequence + number, stamps[number], stamps[number],
                           row.tobytes())
        assert bytes(together.data) == bytes(singly.data)
        assert together.entries == singly.entries
        assert time_span(together.entries) == (0, 599)


def rows_of(begin: int, end: int):
    """Return a block of messages of the first topic, stamped by their numbers."""
    data = b''.join(map(pose_cdr, range(begin, end)))
    return 0, np.arange(begin, end), np.frombuffer(data, np.uint8).reshape(end - begin, -1)


@pytest.mark.parametrize('compression', COMPRESSIONS)
def test_rows_are_written_in_order_and_the_bytes_are_always_the_same(tmp_path, compression):
    """Chunks are compressed by two threads; single messages keep their place among them."""
    contents = []
    for name in 'ab':
        path = tmp_path / name / 'run.mcap'
        path.parent.mkdir()
        file = create_file(path, TOPICS, METADATA, compression=compression)
        block = rows_of(0, 1)[2].copy()
        for number in range(0, 8000, 400):
            file.append(1, number, array_cdr(number))
            index, times, rows = rows_of(number, number + 400 - number % 3)
            block = rows.copy()
            file.append_rows([(index, times, block)])
            block[:] = 0                # the rows were copied
        file.append(1, 8000, array_cdr(8000))
        file.write_chunk()
        assert file.chunk_count == 41
        file.finish()
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]
    in_file = complete_messages(path)
    assert [message.log_time for _, _, message in in_file] == [
        stamp for number in range(0, 8000, 400)
        for stamp in (number, *range(number, number + 400 - number % 3))] + [8000]
    for topic in (TOPICS[0].name, TOPICS[1].name):
        assert [message.sequence for name, _, message in in_file if name == topic] == list(
            range(sum(name == topic for name, _, _ in in_file)))
    assert all(message.data == (pose_cdr if name == TOPICS[0].name else array_cdr)(
        message.log_time) for name, _, message in in_file)


def test_a_disk_that_fails_under_rows_is_told_and_nothing_follows(tmp_path, monkeypatch):
    """The thread that writes has the error; the caller gets it, and can still finish the file."""
    file = create_file(tmp_path / 'run.mcap', TOPICS, METADATA, compression='zstd')
    file.append_rows([rows_of(0, 100)])
    file.write_chunk()
    pwrite = os.pwrite

    def refuse(*_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, 'pwrite', refuse)
    with pytest.raises(OSError, match='No space'):
        for number in range(100, 1000, 100):
            file.append_rows([rows_of(number, number + 100)])
        file.write_chunk()
    monkeypatch.setattr(os, 'pwrite', pwrite)
    file.write_chunk()          # what was told once is not told again
    file.finish()
    assert is_indexed(tmp_path / 'run.mcap')
    assert numbers_in(tmp_path / 'run.mcap') == list(range(100))


@pytest.mark.parametrize(('compression', 'size'), [
    ('zstd', CHUNK_BYTES), ('lz4', 2 * CHUNK_BYTES - 31), ('none', 2 * CHUNK_BYTES)])
def test_a_chunk_of_noise_survives_whatever_its_size(compression, size):
    """It becomes longer by being compressed; a message that is too long gets more memory."""
    message = random.Random(size).randbytes(size)
    chunk = PlainChunk(compression)
    for before in (b'', b'before'):
        chunk.clear()
        chunk.add(1, 0, 7, 7, before)
        chunk.add(1, 1, 5, 5, message)
        record = chunk.record()
        assert (record.message_start_time, record.message_end_time) == (5, 7)
        first, second = breakup_chunk(record, validate_crc=True)
        assert (first.data, second.data) == (before, message)


def test_a_full_queue_says_so_and_loses_nothing(tmp_path, monkeypatch):
    blocked, disk_is_back = threading.Event(), threading.Event()
    append = McapWriter.append

    def append_slowly(self, *message):
        blocked.set()
        disk_is_back.wait(PATIENCE_S)
        return append(self, *message)

    monkeypatch.setattr(McapWriter, 'append', append_slowly)
    monkeypatch.setattr(writer, 'QUEUE_BYTES', 10_000)
    recorder = McapRecorder(
        tmp_path / 'run.mcap', TOPICS, METADATA, max_loss=0.01, min_free_bytes=0)
    recorder.write(0, 0, pose_cdr(0))
    assert blocked.wait(PATIENCE_S)  # with the first message, out of the queue
    written = 1
    while recorder.room:
        recorder.write(0, written, pose_cdr(written))
        written += 1
    assert 10 < written < 100
    assert not recorder.wait_for_room(0.01)
    recorder.write(0, written, pose_cdr(written))  # a burst may go on
    disk_is_back.set()
    assert recorder.wait_for_room(PATIENCE_S)
    summary = recorder.close()
    assert (summary.lost, summary.error) == (0, None)
    assert numbers_in(summary.path) == list(range(written + 1))


@pytest.mark.parametrize('ending', ['pass', 'os.kill(os.getpid(), signal.SIGINT)'])
def test_an_interpreter_that_ends_without_closing_leaves_a_whole_file(tmp_path, ending):
    code = f"""
        import os, signal, sys
        from spinning_top_sim.recording.rosbag2 import RecordedTopic
        from spinning_top_sim.recording.writer import McapRecorder
        topics = [RecordedTopic('/a', {ARRAY!r})]
        recorder = McapRecorder(sys.argv[1], topics, {{}}, min_free_bytes=0, max_loss=60.0)
        for number in range(100):
            recorder.write(0, number, bytes(8))
        {ending}
        """
    subprocess.run([sys.executable, '-c', textwrap.dedent(code), tmp_path / 'run.mcap'],
                   env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=60,
                   check=False)
    with Reader(tmp_path / 'run.mcap') as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == list(range(100))


@pytest.mark.parametrize('fsync_s', [0.0, 0.45])
def test_what_is_handed_over_is_on_the_disk_within_max_loss(tmp_path, monkeypatch, fsync_s):
    """On a simulated clock, which waiting and a slow disk advance; messages come all the time."""
    max_loss, step_s = 1.0, 0.01
    now, on_disk, flushes, waits = 0.0, 0, 0, []
    handed_over = []    # times

    class Event(threading.Event):
        def wait(self, timeout=None):
            advance(timeout)

    class Thread:
        """The thread that records is this one, and what it starts is done at once."""

        join = is_alive = lambda *_: None

        def __init__(self, target, args=(), **_):
            self.start = (lambda: target(*args)) if args else (lambda: None)

    def advance(duration):
        nonlocal now
        if not recorder._accepting:
            return
        for _ in range(max(1, round(duration / step_s))):
            now += step_s
            recorder.write(0, len(handed_over), b'')
            handed_over.append(now)
            waits.append(now - handed_over[on_disk])
        if now > 20.0:
            recorder._accepting = False

    def fsync(_):
        nonlocal on_disk, flushes
        written = recorder.counters.messages
        advance(fsync_s)
        on_disk = written
        flushes += 1

    monkeypatch.setattr(writer, 'time', SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(writer, 'threading', SimpleNamespace(
        Event=Event, Thread=Thread, TIMEOUT_MAX=threading.TIMEOUT_MAX))
    recorder = McapRecorder(
        tmp_path / 'run.mcap', TOPICS, METADATA, max_loss=max_loss, min_free_bytes=0)
    monkeypatch.setattr(os, 'fsync', fsync)
    recorder._run()
    summary = recorder.close()
    assert (summary.error, summary.lost) == (None, 0)
    assert flushes > 30
    assert len(waits) > 1900 and 0.9 * max_loss / 2 < max(waits) <= max_loss


@pytest.fixture
def slow_disk(monkeypatch):
    """Have every fsync wait from now on until the event is set."""
    disk_is_back, fsync = threading.Event(), os.fsync
    monkeypatch.setattr(os, 'fsync', lambda fd: (disk_is_back.wait(PATIENCE_S), fsync(fd)))
    return disk_is_back


def test_recording_goes_on_while_the_disk_is_slow_and_says_what_may_be_lost(tmp_path, slow_disk):
    path = tmp_path / 'run.mcap'
    slow_disk.set()
    with closing(McapRecorder(
            path, TOPICS, METADATA, max_loss=0.05, min_free_bytes=0)) as recorder:
        assert (recorder.warning, recorder.possible_loss) == (None, 0.0)
        slow_disk.clear()
        for number in range(3):
            recorder.write(0, number, pose_cdr(number))
            eventually(lambda n=number: numbers_in(path) == list(range(n + 1)))
        eventually(lambda: recorder.warning)
        assert recorder.possible_loss > 0.05
        assert re.fullmatch(rf'the disk of {path} is slow: a power loss would take the last '
                            r'\d+\.\d s, more than max_loss = 0\.05 s', recorder.warning)
        assert recorder.state == 'recording'
        slow_disk.set()
        eventually(lambda: recorder.possible_loss == 0.0)
        assert recorder.warning is None
    assert numbers_in(path) == [0, 1, 2]


def test_a_sync_that_hangs_does_not_hang_the_end(tmp_path, slow_disk):
    slow_disk.set()
    recorder = McapRecorder(tmp_path / 'run.mcap', TOPICS, METADATA, max_loss=0.02,
                                 min_free_bytes=0)
    slow_disk.clear()
    recorder.write(0, 1, pose_cdr(1))
    eventually(lambda: recorder.warning)
    assert 'could not be closed within 0.05 s' in (recorder.close(timeout=0.05).error or '')
    slow_disk.set()
    assert is_indexed(recorder.close(timeout=PATIENCE_S).path)


# Disks that fail

@pytest.fixture
def disk(monkeypatch):
    """A disk on which a file has at most `disk.size` bytes."""
    disk, pwrite = SimpleNamespace(size=1 << 30), os.pwrite

    def write(descriptor, data, offset):
        if offset >= disk.size:
            raise OSError(28, os.strerror(28))
        return pwrite(descriptor, data[:disk.size - offset], offset)

    monkeypatch.setattr(os, 'pwrite', write)
    return disk


@pytest.mark.parametrize(('room', 'max_loss'), [(100_000, 100.0), (100, 0.02)])
def test_a_full_disk_stops_the_recording_and_costs_what_is_not_written(
        tmp_path, disk, monkeypatch, room, max_loss):
    """A torn chunk is cut off, and where it stood there is room for the summary; or only that."""
    monkeypatch.setattr(writer, 'QUEUE_BYTES', 4_000_000)
    path, rng = tmp_path / 'run.mcap', random.Random(3)
    at_end = max_loss < 1.0
    recorder = McapRecorder(path, TOPICS, METADATA, min_free_bytes=0, max_loss=max_loss)
    for number in range(2000):      # half full, so that chunks of 1 MB are made
        recorder.write(0, number, rng.randbytes(1000))
    eventually(lambda: recorder.counters.messages > (1999 if at_end else 1000))
    disk.size = recorder.counters.bytes + room
    for number in range(2000, 2000 if at_end else 5000):
        recorder.write(0, number, rng.randbytes(1000))
    summary = recorder.close()
    recorder.write(0, 0, b'after the end')
    kept = summary.messages
    assert recorder.error == f'recording to {path} stopped: No space left on device'
    assert recorder.state == 'failed' and summary.error == recorder.error and recorder.room
    assert kept == 2000 if at_end else kept > 1000
    assert recorder.counters.lost == (2001 if at_end else 5001) - kept
    assert is_indexed(path) != at_end
    assert numbers_in(path) == list(range(kept)) and summary.bytes == path.stat().st_size


FAULTS = {
    'the file was deleted': lambda path, patch: path.unlink(),
    'the file was deleted ': lambda path, patch: shutil.rmtree(path.parent),
    'Input/output error': lambda path, patch: patch.setattr(os, 'fsync', refuse_to_sync),
    '0 bytes are free on the disk, fewer than min_free_bytes = 1': lambda path, patch: (
        patch.setattr(os, 'fstatvfs', lambda _: SimpleNamespace(f_bavail=0, f_frsize=4096))),
}


@pytest.mark.parametrize('reason', FAULTS)
def test_a_fault_stops_the_recording_with_its_reason(tmp_path, monkeypatch, reason):
    path = tmp_path / 'logs' / 'run.mcap'
    path.parent.mkdir()
    recorder = McapRecorder(path, TOPICS, METADATA, max_loss=0.02, min_free_bytes=1)
    recorder.write(0, 0, pose_cdr(0))
    FAULTS[reason](path, monkeypatch)
    recorder.write(0, 1, pose_cdr(1))
    eventually(lambda: recorder.state == 'failed')
    recorder.write(0, 2, b'late')
    summary = recorder.close()
    assert recorder.error == summary.error == f'recording to {path} stopped: {reason.strip()}'
    assert recorder.room and summary.messages + summary.lost == 3 and summary.lost >= 1
    if path.exists():
        assert is_indexed(path) and numbers_in(path) == list(range(summary.messages))


def test_a_message_that_cannot_be_packed_is_no_exception_for_the_simulation(tmp_path):
    recorder = McapRecorder(tmp_path / 'run.mcap', TOPICS, METADATA, min_free_bytes=0)
    recorder.write(0, -1, b'')
    summary = recorder.close()
    assert recorder.state == 'failed' and 'stopped: error:' in (summary.error or '')
    assert (is_indexed(summary.path), summary.lost) == (True, 1)


def test_an_interrupted_write_shifts_nothing(tmp_path, monkeypatch):
    """An interrupt in the middle of a chunk; the chunk is written again, and all places hold."""
    path = tmp_path / 'run.mcap'
    file = create_file(path, TOPICS, METADATA, compression='none')
    size = file.size
    pwrite = os.pwrite

    def interrupted(descriptor, data, offset):
        pwrite(descriptor, data[:len(data) // 2], offset)
        if offset > size:
            raise KeyboardInterrupt
        return len(data) // 2

    for index, stamp, data in some_messages(100):
        file.append(index, stamp, data)
    monkeypatch.setattr(os, 'pwrite', interrupted)
    with pytest.raises(KeyboardInterrupt):
        file.write_chunk()
    monkeypatch.setattr(os, 'pwrite', pwrite)
    assert file.size == path.stat().st_size == size
    file.write_chunk()
    file.finish()
    with path.open('rb') as stream:
        list(StreamReader(stream, validate_crcs=True).records)
        stream.seek(0)
        assert len(list(make_reader(stream, validate_crcs=True).iter_messages())) == 100
    assert len(complete_messages(path)) == 100


