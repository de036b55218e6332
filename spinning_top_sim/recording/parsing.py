# SPDX-License-Identifier: Apache-2.0
"""
MCAP records from bytes that may be wrong: a record is exactly what it says it is, or `Damaged`.

mcap's record classes take what is cut or inconsistent for shorter strings and smaller numbers.
Here a record must fill its length to the last byte and be what its content would be written as
(MCAP specification, "Records").  The lengths inside a record then prove the one outside.
"""

from __future__ import annotations

import functools
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from spinning_top_sim.recording.mcap_file import MESSAGE, MESSAGE_FIELDS, Entries, record_bytes

HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows
CHUNK_HEAD = struct.Struct('<QQQI')  # start and end time, uncompressed size and checksum

_PIECE = 1 << 20  # bytes decompressed at a time
_FIELDS = struct.Struct('<HIQQ')    # of a message: channel, sequence, log and publish time
_INDEX_FIELDS = struct.Struct('<HI')  # of a message index: channel, length of the entries

_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}


class Damaged(Exception):  # noqa: N818 - a finding, not an error of the program
    """A record is not what it says it is; the text says why."""


class StrictStream(ReadDataStream):
    """A stream of one record's content that gives what is asked for or raises EndOfFile."""

    def __init__(self, content: bytes) -> None:
        super().__init__(BytesIO(content))

    def read(self, length: int) -> bytes:
        """Return exactly `length` bytes."""
        if length > 1 << 62:  # more than BytesIO can be asked for
            raise EndOfFile()
        data: bytes = super().read(length)
        if len(data) != length:
            raise EndOfFile()
        return data


class StoredMessage(NamedTuple):
    """
    A message and where its data are in the bytes that hold it.

    log_time, publish_time: [ns];  start, end: of the data
    """

    log_time: int
    channel_id: int
    sequence: int
    publish_time: int
    start: int
    end: int


@dataclass
class ChunkContents:
    """
    What is in a chunk whose checksum is right.

    plain: its uncompressed bytes;  declared: its schemas and channels
    messages: in their order;  entries: what its message indexes should say
    """

    plain: bytes
    declared: list[Schema | Channel] = field(default_factory=list)
    messages: list[StoredMessage] = field(default_factory=list)

    @functools.cached_property
    def entries(self) -> Entries:
        found: dict[int, array[int]] = {}
        for log_time, channel_id, _, _, start, _ in self.messages:
            numbers = found.get(channel_id)
            if numbers is None:
                numbers = found[channel_id] = array('Q')
            numbers.append(log_time)
            numbers.append(max(start - MESSAGE.size, 0))    # of no use outside of chunks
        return found


def name_of(opcode: int) -> str:
    """Return what a kind of record is called in reports."""
    try:
        return Opcode(opcode).name.lower().replace('_', ' ')
    except ValueError:
        return f'record of unknown kind {opcode:#04x}'


def parse(opcode: int, content: bytes) -> McapRecord:
    """
    Return the record with this content; not for messages and attachments.

    Raises Damaged.
    """
    if opcode == Opcode.MESSAGE_INDEX:
        return _parse_message_index(content)
    kind = _KINDS.get(opcode)
    if kind is None:
        raise Damaged('there is no such kind of record')
    stream = StrictStream(content)
    try:
        record: McapRecord = kind.read(stream)
    except McapError:
        raise Damaged('a length inside of it leads beyond its end') from None
    except UnicodeDecodeError:
        raise Damaged('a text in it is no UTF-8') from None
    # A chunk has no maps, in which mcap could run over an end; writing it would copy its data.
    if stream.count != len(content) or (
            opcode != Opcode.CHUNK and record_bytes(record)[HEAD.size:] != content):
        raise Damaged('its length is not that of its content')
    return record


def _parse_message_index(content: bytes) -> MessageIndex:
    """As mcap does it, number by number, this would be most of the time that reading takes."""
    if len(content) < _INDEX_FIELDS.size:
        raise Damaged('it is shorter than an index can be')
    channel_id, size = _INDEX_FIELDS.unpack_from(content)
    if size != len(content) - _INDEX_FIELDS.size or size % 16:
        raise Damaged('its length is not that of its content')
    return MessageIndex(
        channel_id, list(struct.iter_unpack('<QQ', content[_INDEX_FIELDS.size:])))


def parse_message(content: bytes) -> StoredMessage:
    """Return the message with this content; raises Damaged."""
    if len(content) < MESSAGE_FIELDS:
        raise Damaged('it is shorter than a message can be')
    channel_id, sequence, log_time, publish_time = _FIELDS.unpack_from(content)
    return StoredMessage(
        log_time, channel_id, sequence, publish_time, MESSAGE_FIELDS, len(content))


def parse_attachment_head(head: bytes, offset: int, length: int) -> AttachmentIndex:
    """
    Return what the summary should say of an attachment.

    head: the beginning of its content, which holds all but its data
    offset, length: where the record stands in the file, and its size with its head [bytes]

    Raises Damaged.
    """
    stream = StrictStream(head)
    try:
        log_time = stream.read8()
        create_time = stream.read8()
        name = stream.read_prefixed_string()
        media_type = stream.read_prefixed_string()
        data_size = stream.read8()
    except (McapError, UnicodeDecodeError):
        raise Damaged('its name or its type cannot be read') from None
    if HEAD.size + stream.count + data_size + 4 != length:
        raise Damaged('its length is not that of its content')
    return AttachmentIndex(
        offset=offset, length=length, log_time=log_time, create_time=create_time,
        data_size=data_size, name=name, media_type=media_type)


def open_chunk(chunk: Chunk) -> ChunkContents:
    """
    Decompress and check a chunk; raises Damaged when anything about it is wrong.

    A chunk without checksum (0) is right when it decompresses and breaks up into records.
    """
    plain = _inflate(chunk)
    if len(plain) != chunk.uncompressed_size:
        raise Damaged('it has not the size that it says it has')
    if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
        raise Damaged('its checksum is wrong')
    contents = ChunkContents(plain)
    size = len(plain)
    offset = 0
    while offset < size:
        if size - offset < HEAD.size:
            raise Damaged('a record in it is cut')
        opcode, length = HEAD.unpack_from(plain, offset)
        start = offset + HEAD.size
        offset = start + length
        if offset > size:
            raise Damaged('a record in it leads beyond its end')
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_FIELDS:
                raise Damaged('a message in it is shorter than a message can be')
            channel_id, sequence, log_time, publish_time = _FIELDS.unpack_from(plain, start)
            contents.messages.append(StoredMessage(
                log_time, channel_id, sequence, publish_time, start + MESSAGE_FIELDS, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = parse(opcode, plain[start:offset])
            assert isinstance(record, Schema | Channel)
            contents.declared.append(record)
    return contents


def _inflate(chunk: Chunk) -> bytes:
    """Return the uncompressed bytes, but never many more than the chunk says it has."""
    if chunk.compression == '':
        return chunk.data
    pieces: Iterator[bytes]
    if chunk.compression == 'zstd':
        pieces = zstandard.ZstdDecompressor().read_to_iter(chunk.data, write_size=_PIECE)
    elif chunk.compression == 'lz4':
        pieces = _lz4_pieces(chunk.data)
    else:
        raise Damaged(f'its compression {chunk.compression[:20]!r} is unknown')
    found = []
    size = 0
    try:
        for piece in pieces:
            found.append(piece)
            size += len(piece)
            if size > chunk.uncompressed_size:
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError):
        raise Damaged('it cannot be decompressed') from None
    return b''.join(found)


def _lz4_pieces(data: bytes) -> Iterator[bytes]:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    piece = decompressor.decompress(data, _PIECE)
    while piece:
        yield piece
        if decompressor.eof:
            return
        piece = decompressor.decompress(b'', _PIECE)
