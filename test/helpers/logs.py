# SPDX-License-Identifier: Apache-2.0
"""Logs for the tests of `recover` and of the readers, and what three readers see in them."""

import contextlib
import io
import random
from pathlib import Path
from types import SimpleNamespace

import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader

from helpers.mutations import records
from helpers.recordings import METADATA, TOPICS, some_messages, write_rows
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import single
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import McapWriter
from spinning_top_sim.tools import recover

CHUNKS, MESSAGES_PER_CHUNK = 3, 12


def small_log(path) -> SimpleNamespace:
    """Write a small log of ours; return bytes, messages, and (opcode, start, end) of chunks."""
    rows = some_messages(CHUNKS * MESSAGES_PER_CHUNK)
    file = McapWriter(path, TOPICS, METADATA, compression='zstd')
    for number, row in enumerate(rows, start=1):
        file.add(*single(*row))
        if number % MESSAGES_PER_CHUNK == 0:
            file.flush()
    file.finish()
    content = path.read_bytes()
    chunks = [record for record in records_of(content) if record[0] == Opcode.CHUNK]
    assert len(chunks) == CHUNKS
    return SimpleNamespace(content=content, chunks=chunks, messages=[
        (TOPICS[index].name, stamp, data) for index, stamp, data in rows])


def flipped(content: bytes, position: int, bit: int = 0) -> bytes:
    changed = bytearray(content)
    changed[position] ^= 1 << bit
    return bytes(changed)


def records_of(content: bytes) -> list[tuple[int, int, int]]:
    """Return opcode, begin and end of every record."""
    return [(content[begin], begin, end) for begin, end in records(content)]


def run(*argv, tool=recover) -> tuple[int, str, str]:
    """Run a command in this process; return exit code, output and errors."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = tool.main([str(argument) for argument in argv])
    return code, out.getvalue(), err.getvalue()


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


STRANGERS = {
    'unchunked': {'use_chunking': False},
    'lz4': {'compression': CompressionType.LZ4},
    'nothing but messages': {
        'use_chunking': False, 'use_statistics': False, 'use_summary_offsets': False,
        'repeat_channels': False, 'repeat_schemas': False, 'index_types': IndexType.NONE,
        'enable_crcs': False},
}


def write_stranger(path, options, count=300):
    """Write JSON and schemaless messages by mcap's own writer, with an attachment."""
    messages = []
    with open(path, 'wb') as file:
        writer = Writer(file, chunk_size=1000, **options)
        writer.start(library='a stranger')
        writer.add_metadata('note', {'a': 'ä', 'b': ''})
        schema = writer.register_schema('thing', 'jsonschema', b'{"type": "object"}')
        channels = {
            '/json': writer.register_channel('/json', 'json', schema, {'unit': 'm'}),
            '/raw': writer.register_channel('/raw', 'octets', 0)}
        for number in range(count):
            topic = ('/json', '/raw')[number % 2]
            data = b'{"n": %d}' % number if topic == '/json' else (
                random.Random(number).randbytes(number % 70))
            writer.add_message(channels[topic], 1000 + number, data, 2000 + number, number // 2)
            messages.append((topic, 1000 + number, data))
            if number == count // 2:
                writer.add_attachment(3, 4, 'calibration.bin', 'x/y', b'\x06' * 3000)
        writer.finish()
    return messages


def write_bag(folder, mode='', split=1, lost=0, *, record=True):
    """Write what matters of a bag as rosbag2 does, with ten strings, but for the lost files."""
    folder.mkdir()
    about = f"compression_format: zstd\ncompression_mode: '{mode}'\n"
    texts = [b'\0\1\0\0\x06\0\0\0text%d\0' % number for number in range(10)]
    rows = [(0, number, zstandard.compress(text) if mode == 'MESSAGE' else text)
            for number, text in enumerate(texts)]
    for part in range(split - lost):
        path = write_rows(
            folder / f'{folder.name}_{part}.mcap',
            [RecordedTopic('/said', 'std_msgs/msg/String')], rows,
            **({'rosbag2': {'serialized_metadata': about}} if record else {}))
        if mode == 'FILE':
            packed = zstandard.compress(path.read_bytes())
            path.rename(f'{path}.zstd').write_bytes(packed)
    (folder / 'metadata.yaml').write_text('rosbag2_bagfile_information:\n  ' + about.replace(
        '\n', '\n  ') + ''.join(f'- {folder.name}_{part}.mcap\n' for part in range(split)))
