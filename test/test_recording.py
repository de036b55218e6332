# SPDX-License-Identifier: Apache-2.0
"""
The recorder: logs that others read.

The readers are rosbags and mcap, none of them written here; the messages are
serialized by rosbags.
"""

import io
import json
import random
import runpy
import zlib
from contextlib import closing

import pytest
import yaml  # type: ignore[import-untyped]
from helpers.recordings import (
    EPOCH_NS,
    JAZZY,
    METADATA,
    TOPICS,
    parsed_qos,
    some_messages,
    write,
)
from helpers.reference import ROOT
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, DataEnd, Message, MessageIndex
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from rosbags.highlevel import AnyReader

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import Recorder, single
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS
from spinning_top_sim.recording.writer import CHUNK_BYTES, McapWriter

COMPRESSIONS = ('zstd', 'lz4', 'none')


def record(path, messages, **options):
    with closing(Recorder(
            str(path), TOPICS, METADATA.copy, **{'min_free_bytes': 0} | options)) as recorder:
        for message in messages:
            write(recorder, *message)
        return recorder.close()


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
    content, found = path.read_bytes(), []
    records = list(StreamReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True).records)
    (end,) = (item for item in records if isinstance(item, DataEnd))
    assert end.data_section_crc != 0
    assert records[-1].summary_crc == zlib.crc32(content[records[-1].summary_start:-12])
    summary = make_reader(io.BytesIO(content), validate_crcs=True).get_summary()
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 1
    for chunk_index in summary.chunk_indexes:
        chunk = record_at(content, chunk_index.chunk_start_offset, Chunk)
        assert chunk.uncompressed_crc != 0 and chunk.uncompressed_size < 1.1 * CHUNK_BYTES
        plain = get_chunk_data_stream(chunk, validate_crc=True)[0].read(chunk.uncompressed_size)
        for channel_id, offset in chunk_index.message_index_offsets.items():
            for stamp, place in record_at(content, offset, MessageIndex).records:
                length = int.from_bytes(plain[place + 1:place + 9], 'little')
                message = Message.read(ReadDataStream(io.BytesIO(plain[place + 9:])), length)
                assert (message.channel_id, message.log_time) == (channel_id, stamp)
                found.append((channel_id - 1, stamp, message.data))
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


GIVEN = {'depth': 7, 'reliability': 2, 'deadline': {'sec': 1, 'nsec': 2}}
OFFERED = {     # any style of YAML; a policy that is not understood is the default
    '[{depth: 7, reliability: best_effort, deadline: {sec: 1, nsec: 2}}]': [GIVEN],
    '# offered\n- depth: 7  # last\n  reliability: 2\n  deadline: {sec: 1, nsec: 2}': [GIVEN],
    '- {"depth": 7, "reliability": 2, "histroy": 3, deadline: {"sec": 1, "nsec": 2}}': [GIVEN],
    **{f'- {{history: {x}, depth: {x}, reliability: {x}, deadline: {x}}}': [{}] for x in (
        '1.5', '[1]', '{}', 'true', '"7"', '~', '.nan', 'keep_some', 1 << 63, '-' + '9' * 20)},
    **dict.fromkeys(('', '7', '- depth: ' + '9' * 5000, '[' * 1000, '!!timestamp x', '\x00',
                     '? {} : 1'), ())}


@pytest.mark.parametrize('text', OFFERED)
def test_offered_qos_is_what_is_understood(text):
    assert parsed_qos(text) == tuple(dict(DEFAULT_QOS) | given for given in OFFERED[text])


@pytest.mark.parametrize('count', [0, 101])
def test_bag_metadata_agrees_with_the_messages(tmp_path, monkeypatch, count):
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    path = tmp_path / 'a "b": #ü.mcap'
    summary = record(path, some_messages(count))
    counts = [(count + 1) // 2, count // 2, 0]
    assert summary.messages == count
    with open(path, 'rb') as file:
        records = {item.name: item.metadata for item in make_reader(file).iter_metadata()}
    assert records['spinning_top_sim'].items() >= METADATA.items()
    bag = yaml.safe_load(records['rosbag2']['serialized_metadata'])
    expected = {'version': 9, 'storage_identifier': 'mcap', 'ros_distro': 'jazzy',
                'message_count': count, 'relative_file_paths': [path.name],
                'starting_time': {'nanoseconds_since_epoch': EPOCH_NS if count else 0},
                'duration': {'nanoseconds': max(0, count - 1) * 1_000_000}}
    assert {name: bag[name] for name in expected} == expected
    assert bag['files'][0]['message_count'] == count
    for entry, topic, number in zip(bag['topics_with_message_count'], TOPICS, counts, strict=True):
        told = entry['topic_metadata']
        assert (told['name'], told['type'], entry['message_count']) == (*topic[:2], number)
        assert told['type_description_hash'].startswith('RIHS01_')
        assert told['offered_qos_profiles'][0]['reliability'] == (
            'best_effort' if topic.qos else 'reliable')


def test_the_definitions_of_all_streams_are_those_that_rosbags_generates():
    written = runpy.run_path(str(ROOT / 'docs/definitions.py'))
    assert written['FILE'].read_text('utf-8') == written['definitions']()


def test_what_decides_the_last_bits_is_told(monkeypatch):
    versions = {'gmpy2': '2.2', 'pymap3d': 'unknown'}
    monkeypatch.setattr(provenance, 'version', lambda name='': versions.get(name, '1.0'))
    told = provenance.run_metadata({'seed': 7}, 5, -1, [{'event': 'start', 't_ns': 0}],
                                   {'seed': 7, 'record.streams': ('all',)})
    assert json.loads(provenance.environment()['libraries']) == {
        'numpy': '1.0', 'mcap': '1.0', 'gmpy2': '2.2'}
    assert (told['format'], told['seed'], told['epoch_ns']) == ('2', '7', '5')
    assert json.loads(told['history']) == [{'event': 'start', 't_ns': 0}]
    assert json.loads(told['parameters_now'])['record.streams'] == ['all']


def test_a_chunk_whose_writing_is_interrupted_is_there_once(tmp_path, monkeypatch):
    path, real = tmp_path / 'run.mcap', McapWriter._write
    file = McapWriter(path, TOPICS, METADATA, compression='none')
    file.add(*single(0, 5, bytes(99)))

    def interrupted(self, blocks):
        real(self, blocks)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(McapWriter, '_write', interrupted)
        file.flush()
    file.finish()
    with LogReader(path) as reader:
        assert [one.log_time for one in reader.messages()] == [5]
        assert not reader.damage.lines()


@pytest.mark.parametrize('compression', COMPRESSIONS)
def test_messages_of_any_length_are_all_kept_and_the_bytes_are_always_the_same(
        tmp_path, compression):
    """
    Chunks stay of a size, and in the file the messages of a topic are in the order in which they
    were handed over.  Noise becomes longer by being compressed.
    """
    rng = random.Random(5)
    messages, contents, found = [], [], [[], [], []]
    for time_ns in range(5000):
        topic = rng.randrange(3)
        size = (1000, rng.choice([12, 12, 12, 700]), time_ns % 7)[topic]
        messages.append((topic, time_ns, rng.randbytes(3_000_000 if time_ns == 999 else size)))
    for folder in (tmp_path / 'a', tmp_path / 'b'):
        folder.mkdir()
        path = folder / 'run.mcap'
        record(path, messages, max_loss=100.0, compression=compression)
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]
    with path.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            assert message.sequence == len(found[channel.id - 1])
            found[channel.id - 1].append((message.log_time, message.data))
        assert 3 <= len(reader.get_summary().chunk_indexes) <= 9
    assert found == [[message[1:] for message in messages if message[0] == topic]
                     for topic in range(3)]
