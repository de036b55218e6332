# SPDX-License-Identifier: Apache-2.0
"""
Reading and recovering logs that are torn, flipped, foreign or no logs at all.

What was recovered is read by rosbags, mcap-ros2-support and mcap, none of them written here; so
are the places of records in a file.  Children are killed for good after a timeout.
"""

import contextlib
import functools
import io
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml  # type: ignore[import-untyped]
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from test_recording import METADATA

from spinning_top_sim.recording import log_file
from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.mcap_writer import McapWriter, record_bytes
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS, RecordedTopic
from spinning_top_sim.recording.salvage import recover
from spinning_top_sim.recording.writer import create_file
from spinning_top_sim.tools.recover import main

ROOT = Path(__file__).parents[1]
JAZZY = get_typestore(Stores.ROS2_JAZZY)
POINT = 'geometry_msgs/msg/Point'
NUMBER = 'std_msgs/msg/Float64'
TOPICS = (
    RecordedTopic('/top/point', POINT),
    RecordedTopic('/top/number', NUMBER, {'depth': 3, 'reliability': 2}),
)
EPOCH_NS = 1_700_000_000_000_000_000
CHUNKS = 3
MESSAGES_PER_CHUNK = 12
ALL_KEPT, FAILED, SOME_LOST = 0, 1, 3


def cdr(number: int) -> tuple[int, bytes]:
    """Return a topic and a message for it."""
    if number % 3:
        return 0, bytes(JAZZY.serialize_cdr(
            JAZZY.types[POINT](float(number), -2.0, 1 / 3), POINT))
    return 1, bytes(JAZZY.serialize_cdr(JAZZY.types[NUMBER](float(number)), NUMBER))


def write_log(path, chunks=CHUNKS, compression='zstd', messages_per_chunk=MESSAGES_PER_CHUNK):
    """Write a log by our writer, chunk borders where they are wanted; return its messages."""
    file = create_file(path, TOPICS, METADATA, compression=compression)
    messages = []
    for number in range(chunks * messages_per_chunk):
        index, data = cdr(number)
        stamp = EPOCH_NS + number * 1_234_567
        file.append(index, stamp, data)
        messages.append((TOPICS[index].name, stamp, data))
        if (number + 1) % messages_per_chunk == 0:
            file.write_chunk()
    file.finish()
    return messages


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    """A small log of ours: bytes, messages, and (opcode, start, end) of each record."""
    path = tmp_path_factory.mktemp('log') / 'run.mcap'
    messages = write_log(path)
    content = path.read_bytes()
    records = records_of(content)
    chunks = [record for record in records if record[0] == Opcode.CHUNK]
    assert len(chunks) == CHUNKS
    return SimpleNamespace(content=content, messages=messages, records=records, chunks=chunks)


@pytest.fixture
def no_sync(monkeypatch):
    """For thousands of recoveries that nobody pulls the plug on; of one YAML, parsed once."""
    dumped, dump = {}, yaml.dump

    def dump_once(value, **options):
        key = repr((value, sorted(options)))
        if key not in dumped:
            dumped[key] = dump(value, **options)
        return dumped[key]

    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)
    monkeypatch.setattr(yaml, 'dump', dump_once)
    monkeypatch.setattr(yaml, 'safe_load', functools.cache(yaml.safe_load))


def write_anew(path, content):
    """Write a file, not over the one before: that would wait for the disk."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def records_of(content: bytes) -> list[tuple[int, int, int]]:
    """Return opcode, start and end of every record, of a whole file."""
    found = []
    offset = len(MCAP0_MAGIC)
    while offset < len(content) - len(MCAP0_MAGIC):
        opcode, length = struct.unpack_from('<BQ', content, offset)
        found.append((opcode, offset, offset + 9 + length))
        offset += 9 + length
    return found


def place_of(content: bytes, wanted: int) -> tuple[int, int]:
    """Return start and end of the only record of a kind."""
    (place,) = [(start, end) for opcode, start, end in records_of(content) if opcode == wanted]
    return place


def run(*argv) -> tuple[int, str, str]:
    """Run the command in this process; return exit code, output and errors."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in argv])
    return code, out.getvalue(), err.getvalue()


def run_process(*argv, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, '-m', 'spinning_top_sim.tools.recover', *map(str, argv)],
        env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, text=True, timeout=60,
        check=False, **options)


def seen_by_us(path) -> list[tuple[str, int, bytes]]:
    with LogReader(path) as reader:
        return [(message.topic, message.log_time, message.data) for message in reader.messages()]


def seen_by_mcap(path) -> list[tuple[str, int, bytes]]:
    """Return what mcap reads by the index; the file must hold in itself by its checksums, too."""
    with open(path, 'rb') as file:
        list(StreamReader(file, validate_crcs=True).records)
        file.seek(0)
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        read = [(channel.topic, message.log_time, message.data)
                for _, channel, message in reader.iter_messages()]
    assert summary.statistics.message_count == len(read)
    return read


def seen_by_rosbags(path) -> list[tuple[str, int, bytes]]:
    with AnyReader([Path(path)]) as reader:
        read = [(connection.topic, stamp, bytes(data))
                for connection, stamp, data in reader.messages()]
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    return read


def metadata_of(path) -> dict[str, dict[str, str]]:
    with open(path, 'rb') as file:
        return {record.name: record.metadata for record in make_reader(file).iter_metadata()}


def check_with_all_readers(path, messages) -> None:
    """A recovered log of ours: the messages, for everyone, and what it says of the run."""
    assert seen_by_us(path) == seen_by_mcap(path) == seen_by_rosbags(path) == messages
    with open(path, 'rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        values = [message.x if schema.name == POINT else message.data
                  for schema, _, _, message in reader.iter_decoded_messages()]
    assert values == [float(number) for number in range(len(messages))]
    metadata = metadata_of(path)
    assert metadata['spinning_top_sim'] == METADATA
    assert f'message_count: {len(messages)}\n' in metadata['rosbag2']['serialized_metadata']
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.metadata == metadata
        assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]


# Truncated

def test_every_cut_keeps_every_whole_chunk(tmp_path, log, no_sync):
    """The exit code says whether a message was in what is gone."""
    ends = [end for _, _, end in log.chunks]
    index_ends = [start for _, start, _ in log.chunks[1:]]
    # Around the ends of chunks and indexes after each byte; elsewhere not.
    edges = [0, *ends, *index_ends, len(log.content)]
    cuts = {cut for edge in edges for cut in range(edge - 10, edge + 11)
            if 0 <= cut <= len(log.content)}.union(range(0, len(log.content), 97))
    torn, output = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap'
    seen = {}
    torn.write_bytes(log.content)
    for size in sorted(cuts, reverse=True):
        os.truncate(torn, size)
        whole_chunks = sum(end <= size for end in ends)
        if whole_chunks == 0:
            expected = FAILED
        elif whole_chunks == CHUNKS or size <= index_ends[whole_chunks - 1]:
            expected = ALL_KEPT
        else:
            expected = SOME_LOST
        code, out, err = run(torn, '-o', output)
        assert code == expected, (size, out, err)
        assert err.count('\n') == (code == FAILED), (size, err)
        assert output.exists() == (code != FAILED), size
        assert ('lost: ' in out) == (code == SOME_LOST), (size, out)
        if size >= log.chunks[0][1]:
            with LogReader(torn) as reader:
                assert reader.damage.truncated == (size < len(log.content))
                assert reader.metadata['spinning_top_sim'] == METADATA
                assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]
        if output.exists():
            seen.setdefault(whole_chunks, set()).add(output.read_bytes())
            output.unlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['torn.mcap']
    assert sorted(seen) == [1, 2, 3]
    for whole_chunks, contents in seen.items():
        (content,) = contents
        output.write_bytes(content)
        check_with_all_readers(output, log.messages[:whole_chunks * MESSAGES_PER_CHUNK])


# Wrong bytes

def places(log, each=8):
    """Some bytes of every record: most of its head, and seeded ones of the rest; and the magic."""
    choice = random.Random(5)
    yield from range(len(MCAP0_MAGIC))
    for _, start, end in log.records:
        head = range(start, min(start + each, end))
        yield from head
        yield from choice.sample(range(head.stop, end), min(each, end - head.stop))
    yield from range(len(log.content) - len(MCAP0_MAGIC), len(log.content))


def flipped(content: bytes, position: int, bit: int) -> bytes:
    changed = bytearray(content)
    changed[position] ^= 1 << bit
    return bytes(changed)


def longer(record: bytes, number: int) -> bytes:
    """Return a record whose length is a number of bytes more than it has."""
    (length,) = struct.unpack_from('<Q', record, 1)
    return record[:1] + struct.pack('<Q', length + number) + record[9:]


def test_a_flipped_bit_is_never_passed_over(tmp_path, log, no_sync):
    """
    Anywhere in a whole file: it is said, and what is kept is what was there.

    Every byte is under some checksum or has one value only, so nothing may go unnoticed.
    """
    random_bits = random.Random(1)
    broken, output = tmp_path / 'broken.mcap', tmp_path / 'out' / 'broken.mcap'
    output.parent.mkdir()
    broken.write_bytes(log.content)
    assert run(broken, '-o', output)[0] == ALL_KEPT
    original = output.read_bytes()
    output.unlink()
    codes = {}
    for position in places(log):
        write_anew(broken, flipped(log.content, position, random_bits.randrange(8)))
        code, out, err = run(broken, '-o', output)
        assert code in (ALL_KEPT, SOME_LOST), (position, err)
        assert 'found: ' in out or 'lost: ' in out, (position, out)
        kind = next((Opcode(opcode) for opcode, start, end in log.records
                     if start <= position < end), None)
        codes.setdefault(kind, set()).add(code)
        content = output.read_bytes()
        output.unlink()
        output.write_bytes(content)
        if code == ALL_KEPT:
            assert content == original or seen_by_us(output) == log.messages, position
            output.unlink()
            continue
        touched = [start <= position < end for _, start, end in log.chunks]
        kept = [message for number, message in enumerate(log.messages)
                if not touched[number // MESSAGES_PER_CHUNK]]
        # A compressed chunk may be another one and yet give the same bytes, by its checksum.
        assert seen_by_us(output) in (kept, log.messages), position
        output.unlink()
    # What stands twice in a file, or follows from the rest, is made right again.
    for kind in (None, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                 Opcode.SUMMARY_OFFSET, Opcode.FOOTER):
        assert codes[kind] == {ALL_KEPT}, kind
    assert codes[Opcode.CHUNK] == {ALL_KEPT, SOME_LOST}  # kept with wrong times in the head
    assert SOME_LOST in codes[Opcode.METADATA]


def test_flipped_bits_in_a_torn_file_spare_the_other_chunks(tmp_path, log, no_sync):
    """Without a summary the next chunk is found by search, where a length is wrong."""
    broken, output = tmp_path / 'broken.mcap', tmp_path / 'whole.mcap'
    torn = log.content[:log.chunks[-1][2]]
    random_bits = random.Random(2)
    for position in places(log):
        if not log.chunks[0][1] <= position < len(torn):
            continue
        write_anew(broken, flipped(torn, position, random_bits.randrange(8)))
        code, out, _ = run(broken, '-o', output)
        touched = [start <= position < end for _, start, end in log.chunks]
        must = [message for number, message in enumerate(log.messages)
                if not touched[number // MESSAGES_PER_CHUNK]]
        read = seen_by_us(output)
        assert read == (log.messages if len(read) > len(must) else must), position
        assert (code == ALL_KEPT) == (len(read) == len(log.messages)) or 'lost: ' in out, position
        output.unlink()


def start_of(log, opcode, number=0):
    return [start for kind, start, _ in log.records if kind == opcode][number]


def torn(log, content=None):
    """Return a log up to the end of its last chunk; nothing in it repeats what stands before."""
    return (content or log.content)[:log.chunks[-1][2]]


# What is done to the bytes; the chunks that are kept, or the topic that is; the exit code; what
# is said.
DAMAGE = {
    'zeros behind the tear, as file systems leave them after a power loss': (
        lambda log: log.content[:log.chunks[2][1]] + bytes(3_000_000),
        (0, 1), SOME_LOST, 'lost: 3000000 bytes'),
    'a message index that lacks a byte': (
        lambda log: log.content[:log.chunks[0][2] + 20] + log.content[log.chunks[0][2] + 21:],
        (0, 1, 2), SOME_LOST, 'found: message index at byte'),
    'a chunk that became a record of an application, before its index': (
        lambda log: flipped(torn(log), log.chunks[1][1], 7),
        (0, 2), SOME_LOST, 'lost: 290 bytes, at least 12 messages'),
    'the same in a file with statistics': (
        lambda log: flipped(log.content, log.chunks[1][1], 7),
        (0, 2), SOME_LOST, ' 12 messages\nlost: chunk at byte'),
    'a header with a wild length, before all schemas and channels': (
        lambda log: flipped(torn(log), start_of(log, Opcode.HEADER) + 1 + 5, 0),
        (0, 1, 2), SOME_LOST, 'lost: header at byte 8'),
    'a schema that is lost': (
        lambda log: flipped(torn(log), start_of(log, Opcode.SCHEMA) + 9 + 3, 6),
        '/top/number', SOME_LOST, 'lost: 24 messages at byte 0'),
    'a channel that became a message of a channel that exists': (
        lambda log: flipped(log.content, start_of(log, Opcode.CHANNEL, 1), 0),
        (0, 1, 2), SOME_LOST, 'lost: message at byte'),
    'the same without a summary': (
        lambda log: flipped(torn(log), start_of(log, Opcode.CHANNEL, 1), 0),
        '/top/point', SOME_LOST, 'lost: 12 messages at byte 0'),
    'a chunk with a wrong checksum in the place of another': (
        lambda log: torn(log, log.content[:log.chunks[0][1]] + bytes(50) + flipped(
            log.content, log.chunks[1][2] - 6, 0)[log.chunks[1][1]:log.chunks[1][2]]
            + log.content[log.chunks[2][1]:]),
        (2,), SOME_LOST, 'bytes, an unknown number of messages'),
    'another log behind the end': (
        lambda log: log.content + log.content,
        (0, 1, 2), SOME_LOST, 'it stands behind the end of this one'),
}


@pytest.mark.parametrize('case', DAMAGE)
def test_what_can_be_decoded_is_kept_and_the_rest_is_told(tmp_path, log, case):
    damage, kept, code, says = DAMAGE[case]
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    path.write_bytes(damage(log))
    wanted = [message for number, message in enumerate(log.messages)
              if (message[0] == kept if isinstance(kept, str)
                  else number // MESSAGES_PER_CHUNK in kept)]
    assert seen_by_us(path) == wanted
    found, out, err = run(path, '-o', output)
    assert (found, err) == (code, ''), out
    assert says.replace('290', str(log.chunks[1][2] - log.chunks[1][1])) in out or (
        'at least' in says and says[says.index('at least'):] in out), out
    assert seen_by_us(output) == seen_by_mcap(output) == seen_by_rosbags(output) == wanted
    if kept == (0, 1, 2):
        check_with_all_readers(output, wanted)


def test_a_wild_length_that_seems_to_lead_to_a_record_takes_no_other_chunk(tmp_path):
    """It leads to data in the next chunk that look like the head of metadata."""
    path = tmp_path / 'run.mcap'
    decoy = struct.pack('<BQ', Opcode.METADATA, 5) + bytes(40)
    file = create_file(path, TOPICS[1:2], {}, compression='none')
    for number, data in enumerate((b'first', decoy, b'third')):
        file.append(0, number, data)
        file.write_chunk()
    content = path.read_bytes()
    file.finish()
    lost = next(start for opcode, start, _ in records_of(path.read_bytes())
                if opcode == Opcode.CHUNK)
    length = content.index(decoy) - lost - 9
    path.write_bytes(content[:lost + 1] + struct.pack('<Q', length) + content[lost + 9:])
    assert [data for _, _, data in seen_by_us(path)] == [decoy, b'third']


# Whole

@pytest.mark.parametrize('compression', ['zstd', 'none'])
def test_recovering_a_whole_file_changes_nothing(tmp_path, compression):
    path = tmp_path / 'run.mcap'
    messages = write_log(path, compression=compression)
    (tmp_path / 'out').mkdir()
    code, out, _ = run(path, '-o', tmp_path / 'out' / 'run.mcap')
    assert code == ALL_KEPT
    assert out.startswith(f'kept all: {len(messages)} messages in {CHUNKS} chunks')
    assert (tmp_path / 'out' / 'run.mcap').read_bytes() == path.read_bytes()
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.damage.lossless
        assert not reader.damage.lines()


def test_a_topic_tells_all_that_its_channel_says(log, tmp_path):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    with LogReader(tmp_path / 'run.mcap') as reader:
        topic = reader.topics[1]
        assert reader.profile == 'ros2'
        assert reader.library.startswith('spinning_top_sim ')
        assert reader.size == len(log.content)
    assert (topic.name, topic.type_name, topic.encoding) == ('/top/number', NUMBER, 'cdr')
    assert (topic.schema_encoding, topic.schema) == ('ros2msg', find_definition(NUMBER)[0])
    assert topic.qos == (dict(DEFAULT_QOS) | TOPICS[1].qos,)
    assert topic.metadata['topic_type_hash'] == JAZZY.hash_rihs01(NUMBER)


def test_messages_can_be_chosen(log, tmp_path):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    (tmp_path / 'torn.mcap').write_bytes(log.content[:log.chunks[-1][2]])
    start, end = log.messages[9][1], log.messages[30][1]    # both of the topic that is chosen
    for name in ('run.mcap', 'torn.mcap'):
        with LogReader(tmp_path / name) as reader:
            chosen = list(reader.messages(topics=['/top/number'], start=start, end=end))
            assert [(message.topic, message.log_time, message.data) for message in chosen] == [
                message for message in log.messages[9:30] if message[0] == '/top/number']
            assert [message.sequence for message in chosen] == list(range(3, 10))
            assert not list(reader.messages(topics=[]))
            assert not list(reader.messages(start=end, end=start))


@pytest.mark.parametrize('torn', [False, True])
def test_messages_come_in_the_order_of_their_log_times(tmp_path, torn):
    """Within chunks and across them; equal times in file order."""
    path = tmp_path / 'run.mcap'
    order = random.Random(4)
    stamps = [order.randrange(200) for _ in range(600)]
    file = create_file(path, TOPICS[1:2], {}, compression='none')
    for number, stamp in enumerate(stamps):
        file.append(0, stamp, struct.pack('<I', number))
        if number % 50 == 49:
            file.write_chunk()
    file.finish()
    if torn:
        path.write_bytes(path.read_bytes()[:-100])
    with LogReader(path) as reader:
        assert reader.whole == (not torn)
        read = [(message.log_time, struct.unpack('<I', message.data)[0])
                for message in reader.messages()]
    assert read == sorted((stamp, number) for number, stamp in enumerate(stamps))


# Of strangers

STRANGERS = {
    'plain': {},
    'unchunked': {'use_chunking': False},
    'lz4': {'compression': CompressionType.LZ4},
    'no index': {'index_types': IndexType.NONE},
    'no index of metadata': {'index_types': IndexType.CHUNK | IndexType.MESSAGE},
    'no statistics': {'use_statistics': False},
    'nothing repeated': {'repeat_channels': False, 'repeat_schemas': False},
    'nothing but messages': {
        'use_chunking': False, 'use_statistics': False, 'use_summary_offsets': False,
        'repeat_channels': False, 'repeat_schemas': False, 'index_types': IndexType.NONE,
        'enable_crcs': False},
}


def write_stranger(path, options, profile='', count=300):
    """Write JSON and schemaless messages by mcap's own writer, with an attachment."""
    messages = []
    with open(path, 'wb') as file:
        writer = Writer(file, chunk_size=1000, **options)
        writer.start(profile=profile, library='a stranger')
        writer.add_metadata('note', {'a': 'ä', 'b': ''})
        schema = writer.register_schema('thing', 'jsonschema', b'{"type": "object"}')
        channels = {
            '/json': writer.register_channel('/json', 'json', schema, {'unit': 'm'}),
            '/raw': writer.register_channel('/raw', 'octets', 0)}
        for number in range(count):
            topic = ('/json', '/raw')[number % 2]
            data = b'{"n": %d}' % number if topic == '/json' else (
                random.Random(number).randbytes(number % 70))
            writer.add_message(channels[topic], 1000 + number, data, 2000 + number)
            messages.append((topic, 1000 + number, data))
            if number == count // 2:
                writer.add_attachment(3, 4, 'calibration.bin', 'x/y', b'\x06' * 3000)
        writer.finish()
    return messages


@pytest.mark.parametrize('kind', STRANGERS)
def test_a_strangers_file_is_read_and_recovered(tmp_path, kind):
    path, output = tmp_path / 'stranger.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS[kind])
    assert seen_by_us(path) == messages
    with LogReader(path) as reader:
        assert reader.damage.lossless
        assert not reader.damage.truncated
        assert not reader.damage.missing_messages
        assert reader.metadata == {'note': {'a': 'ä', 'b': ''}}
        assert [(topic.name, topic.type_name, topic.encoding) for topic in reader.topics] == [
            ('/json', 'thing', 'json'), ('/raw', '', 'octets')]
        assert reader.topics[0].metadata == {'unit': 'm'}
    code, out, err = run(path, '-o', output)
    assert code == ALL_KEPT, (out, err)
    assert seen_by_us(output) == seen_by_mcap(output) == messages
    with open(output, 'rb') as file:
        reader = make_reader(file)
        assert reader.get_header() == Header(profile='', library='a stranger')
        assert [(record.name, record.metadata) for record in reader.iter_metadata()] == [
            ('note', {'a': 'ä', 'b': ''})]
        (attachment,) = reader.iter_attachments()
        assert [message.publish_time for _, _, message in reader.iter_messages()] == [
            stamp + 1000 for _, stamp, _ in messages]
    assert (attachment.name, attachment.media_type, attachment.data) == (
        'calibration.bin', 'x/y', b'\x06' * 3000)
    with LogReader(output) as reader:
        assert reader.whole


@pytest.mark.parametrize('kind', ['plain', 'unchunked'])
def test_a_torn_file_of_a_stranger_keeps_what_stands_before_the_tear(tmp_path, kind, no_sync):
    path, torn, output = (tmp_path / name for name in ('a.mcap', 'torn.mcap', 'whole.mcap'))
    messages = write_stranger(path, STRANGERS[kind], count=60)
    content = path.read_bytes()
    records = records_of(content)
    ends = [end for opcode, _, end in records if opcode in (Opcode.CHUNK, Opcode.MESSAGE)]
    firsts = [first_message(content[start:end], messages)
              for opcode, start, end in records if opcode == Opcode.CHUNK]
    firsts = [*firsts[1:], len(messages)] if firsts else range(1, len(messages) + 1)
    for size in range(8, len(content), 101):
        write_anew(torn, content[:size])
        whole = sum(end <= size for end in ends)
        kept = firsts[whole - 1] if whole else 0
        code, _, err = run(torn, '-o', output)
        assert (code == FAILED) == (kept == 0), (size, err)
        if kept:
            assert seen_by_us(output) == seen_by_mcap(output) == messages[:kept], size
            output.unlink()


def first_message(chunk: bytes, messages) -> int:
    """Return the number of the message that a chunk of `write_stranger` begins with."""
    start_time, = struct.unpack_from('<Q', chunk, 9)
    return start_time - messages[0][1]


def test_a_bag_of_rosbags_is_recovered(tmp_path):
    with BagWriter(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/number', NUMBER, typestore=JAZZY)
        for number in range(200):
            writer.write(connection, number, bytes(JAZZY.serialize_cdr(
                JAZZY.types[NUMBER](float(number)), NUMBER)))
    (path,) = (tmp_path / 'bag').glob('*.mcap')
    expected = seen_by_rosbags(path)
    assert len(expected) == 200
    code, out, err = run(path, '-o', tmp_path / 'whole.mcap')
    assert code == ALL_KEPT, (out, err)
    output = tmp_path / 'whole.mcap'
    assert seen_by_rosbags(output) == seen_by_mcap(output) == seen_by_us(output) == expected
    assert 'name: /number\n' in metadata_of(output)['rosbag2']['serialized_metadata']


def test_messages_in_and_out_of_chunks_keep_their_order(tmp_path):
    """All have one stamp, so that only their places in the file order them."""
    def message(data: bytes) -> bytes:
        return record_bytes(Message(channel_id=1, log_time=5, publish_time=5, sequence=0,
                                    data=data))

    plain = message(b'b') + message(b'c')
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    path.write_bytes(b''.join([
        MCAP0_MAGIC, record_bytes(Header(profile='', library='a stranger')),
        record_bytes(Channel(id=1, topic='/raw', message_encoding='x', metadata={}, schema_id=0)),
        message(b'a'),
        record_bytes(Chunk(compression='', data=plain, uncompressed_size=len(plain),
                           uncompressed_crc=zlib.crc32(plain), message_start_time=5,
                           message_end_time=5)),
        message(b'd'), record_bytes(DataEnd(0)),
        record_bytes(Footer(summary_start=0, summary_offset_start=0, summary_crc=0)),
        MCAP0_MAGIC]))
    assert run(path, '-o', output)[0] == ALL_KEPT
    for file in (path, output):
        assert [data for _, _, data in seen_by_us(file)] == [b'a', b'b', b'c', b'd']
    with open(output, 'rb') as file:
        assert [message.data for _, _, message in make_reader(file).iter_messages(
            log_time_order=False)] == [b'a', b'b', b'c', b'd']


@pytest.mark.parametrize('number', [-2, 8])
def test_a_message_of_another_length_is_not_believed(tmp_path, number):
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS['unchunked'], count=20)
    content = path.read_bytes()
    places = [(start, end) for opcode, start, end in records_of(content)
              if opcode == Opcode.MESSAGE]
    data_end, _ = place_of(content, Opcode.DATA_END)
    start, end = places[6]
    path.write_bytes(content[:start] + longer(content[start:end], number) + content[end:data_end])
    code, out, _ = run(path, '-o', output)
    assert code == SOME_LOST
    assert f'message at byte {start} ' in out
    # Without chunks and summary nothing proves where another message begins.
    assert seen_by_us(output) == seen_by_mcap(output) == messages[:6]


# The command and its errors

def test_exit_codes(tmp_path, log):
    whole, torn, head = (tmp_path / f'{name}.mcap' for name in ('whole', 'torn', 'head'))
    whole.write_bytes(log.content)
    torn.write_bytes(log.content[:log.chunks[2][2] - 1])
    head.write_bytes(log.content[:log.chunks[0][1]])
    done = run_process(whole)
    assert (done.returncode, done.stderr) == (ALL_KEPT, '')
    assert 'kept all: 36 messages in 3 chunks' in done.stdout
    code, out, err = run(torn, '--output', tmp_path / 'out.mcap')
    assert (code, err) == (SOME_LOST, '')
    _, start, end = log.chunks[2]
    assert f'lost: {end - 1 - start} bytes, an unknown number of messages\n' in out
    assert f'lost: chunk at byte {start} (' in out and 'kept: 24 messages in 2 chunks' in out
    assert run(head) == (
        FAILED, '', 'spinning-top recover: '
                    f'nothing to save in {head}: there is no whole message in it\n')
    with pytest.raises(SystemExit, match='2'):
        run()


def test_a_recovery_tells_what_it_has_written(tmp_path, log):
    path, output, told = tmp_path / 'run.mcap', tmp_path / 'whole.mcap', []
    path.write_bytes(log.content)
    with LogReader(path) as reader:
        done = recover(reader, output, told.append)
    assert (done.size, done.messages, done.chunk_count) == (
        output.stat().st_size, len(log.messages), len(log.chunks))
    assert told == sorted(told) and told[-1] == len(log.content) and len(told) > len(log.chunks)


def test_memory_does_not_grow_with_the_file(tmp_path):
    """Twenty times as many chunks: no more than their index, less than a fifth of the file."""
    peaks = []
    for chunks in (10, 200):
        path = tmp_path / f'{chunks}.mcap'
        file = create_file(path, TOPICS[1:2], {}, compression='none')
        for number in range(chunks):
            file.append(0, number, random.Random(number).randbytes(50_000))
            file.write_chunk()
        file.finish()
        path.write_bytes(path.read_bytes()[:-100])
        tracemalloc.start()
        try:
            assert run(path)[0] == ALL_KEPT
            with LogReader(path) as reader:
                assert sum(1 for _ in reader.messages()) == chunks
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] - peaks[0] < 1_000_000


def test_nothing_is_overwritten(tmp_path, log):
    path, other = tmp_path / 'run.mcap', tmp_path / 'other.mcap'
    path.write_bytes(log.content)
    other.write_text('precious')
    (tmp_path / 'link.mcap').symlink_to(tmp_path / 'nowhere')
    for output in (path, other, tmp_path / 'link.mcap'):
        code, out, err = run(path, '-o', output)
        assert (code, out) == (FAILED, '')
        assert err == (
            'spinning-top recover: '
            f'cannot write {output}: it exists, and nothing is overwritten\n')
    assert path.read_bytes() == log.content
    assert other.read_text() == 'precious'
    assert len(list(tmp_path.iterdir())) == 3


def test_a_full_disk_leaves_nothing_behind(monkeypatch, tmp_path, log):
    # What is measured for `make coverage` could not be written either.
    monkeypatch.delenv('COVERAGE_PROCESS_CONFIG', raising=False)
    path = tmp_path / 'run.mcap'
    path.write_bytes(log.content)
    limit = len(log.content) - 1000
    done = run_process(path, preexec_fn=lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (limit, limit)))
    assert done.returncode == FAILED
    assert done.stderr == (
        f'spinning-top recover: cannot write {tmp_path / "run_recovered.mcap"}: File too large\n')
    assert [item.name for item in tmp_path.iterdir()] == ['run.mcap']


def test_an_output_that_cannot_be_made_is_named(tmp_path, log):
    path = tmp_path / 'run.mcap'
    path.write_bytes(log.content)
    code, _, err = run(path, '-o', tmp_path / 'none' / 'whole.mcap')
    assert code == FAILED
    assert err == ('spinning-top recover: '
                   f'cannot write {tmp_path}/none/whole.mcap: there is no directory '
                   f'{tmp_path}/none\n')
    code, _, err = run(path, '-o', path / 'whole.mcap')
    assert code == FAILED
    assert 'Not a directory' in err
    assert run(path, '-o', '/proc/whole.mcap')[2] == (
        'spinning-top recover: cannot write /proc/whole.mcap: no files can be made in /proc\n')


@pytest.mark.parametrize(('content', 'reason'), [
    (b'', 'it is empty'),
    (MCAP0_MAGIC[:5], 'it is no MCAP file'),
    (b'SQLite format 3\x00' + bytes(100), 'it is no MCAP file'),
    (b'\n', 'it is no MCAP file'),
])
def test_what_is_no_log_is_refused(tmp_path, content, reason):
    path = tmp_path / 'file.mcap'
    path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        LogReader(path)
    assert str(caught.value) == f'cannot read {path}: {reason}'
    assert run(path) == (FAILED, '', f'spinning-top recover: cannot read {path}: {reason}\n')


def test_what_cannot_be_opened_is_named(tmp_path):
    os.mkfifo(tmp_path / 'pipe')
    for name, reason in (('missing', 'No such file or directory'),
                         ('', 'a folder must have one .mcap file, and this has pipe'),
                         ('pipe', 'it is no regular file')):
        path = tmp_path / name
        with pytest.raises(LogError) as caught:
            LogReader(path)
        assert str(caught.value) == f'cannot read {path}: {reason}'
        assert run(path, '-o', tmp_path / 'x') == (FAILED, '', 'spinning-top recover: '
                                                               f'{caught.value}\n')


def test_a_disk_that_fails_while_it_is_read_is_an_error(tmp_path, log, monkeypatch):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    real = open

    def open_bad(path, *arguments, **options):
        file = real(path, *arguments, **options)

        class Bad:
            def __getattr__(self, name):
                return getattr(file, name)

            def read(self, size):
                if file.tell() >= log.chunks[1][1]:
                    raise OSError(5, os.strerror(5))
                return file.read(size)

        return Bad()

    torn = log.content[:log.chunks[-1][2]]
    (tmp_path / 'run.mcap').write_bytes(torn + bytes(40))
    monkeypatch.setattr(log_file, 'open', open_bad, raising=False)
    code, _, err = run(tmp_path / 'run.mcap')
    assert code == FAILED
    assert err == ('spinning-top recover: '
                   f'cannot read {tmp_path / "run.mcap"}: Input/output error\n')
    assert [path.name for path in tmp_path.iterdir()] == ['run.mcap']


@pytest.mark.parametrize(('number', 'code'), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_leaves_nothing_behind(tmp_path, log, monkeypatch, number, code):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    monkeypatch.setattr(McapWriter, 'finish', lambda *_, **__: signal.raise_signal(number))
    found = None
    try:
        found, _, _ = run(tmp_path / 'run.mcap')
    except SystemExit as end:
        found = end.code
    assert found == code
    assert [path.name for path in tmp_path.iterdir()] == ['run.mcap']
