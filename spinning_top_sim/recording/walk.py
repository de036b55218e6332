# SPDX-License-Identifier: Apache-2.0
"""
Through an MCAP file from its first byte to its last usable one, around what is damaged.

How damage is met (MCAP specification, "Records", "Data section", "Summary section"):

- A record whose content is wrong but whose length leads to another record is left out alone.
- Where no record begins, the next one is looked for: at the places that the summary tells, if
  the file has one whose checksum is right; else by search, for a chunk that proves itself by the
  lengths inside of it and its checksum.  On the way, schemas, channels and metadata are taken
  whose every length fits; single messages are not, since nothing in them tells them from chance.
- Schemas and channels of a summary with a right checksum go before those in the data section.
- The checksum of the data section is taken over the records as they should be, where something
  else tells that (magic, schemas, channels, message indexes, times of chunks).  If it is right
  then, nothing was lost.
"""

from __future__ import annotations

import contextlib
import operator
import os
import re
import stat
import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap.exceptions import McapError
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
)
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.damage import Damage, Loss
from spinning_top_sim.recording.errors import LogAccessError
from spinning_top_sim.recording.mcap_file import message_indexes, record_bytes, time_span
from spinning_top_sim.recording.parsing import (
    CHUNK_HEAD,
    HEAD,
    ChunkContents,
    Damaged,
    StoredMessage,
    StrictStream,
    name_of,
    open_chunk,
    parse,
    parse_attachment_head,
    parse_message,
)

BAG_METADATA = 'rosbag2'             # the name of a record that is made anew
OUR_LIBRARY = 'spinning_top_sim '  # what the header of our files begins with

MAGIC_SIZE = len(MCAP0_MAGIC)
FOOTER_SIZE = HEAD.size + 8 + 8 + 4
DATA_END_SIZE = HEAD.size + 4
BLOCK = 1 << 20  # bytes read at a time where a record is not needed whole

_ATTACHMENT_HEAD = 1 << 16  # more than anyone's name and media type
_CHUNK_START = 64           # all of a chunk before its data
_FEW_BYTES = 8              # wrong in a message index that is known for what it is
_LONGEST_NAME = 1 << 12
_LARGEST_DECLARATION = 1 << 24

# What may begin a chunk, a schema, a channel or metadata: opcode and a length below 2^40.
_CANDIDATE = re.compile(rb'[\x03\x04\x06\x0c](?=.{5}\x00\x00\x00)', re.DOTALL)
_CANDIDATE_SIZE = HEAD.size
# Where the length of the name is, in their contents.
_TEXT_OFFSETS: dict[int, int] = {Opcode.SCHEMA: 2, Opcode.CHANNEL: 4, Opcode.METADATA: 0}
_SUMMARY_KINDS = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                  Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER)


# Yields what is found on the way, returns the offset at which to go on.
_Resuming = Generator['Piece', None, int]


@dataclass
class Summary:
    """
    The summary section of a file, if its checksum is right and it fits the file.

    data_end: where the data section ends;  missing: why there is no summary, '' if there is
    ended: whether the file ends with a footer and the closing magic
    """

    data_end: int
    ended: bool = False
    missing: str = ''
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)

    @property
    def all_in_chunks(self) -> bool:
        """Whether the chunk indexes lead to as many messages as the statistics count."""
        # Each index record is 15 bytes and 16 for every message.
        indexed = sum((index.message_index_length - 15 * len(index.message_index_offsets)) // 16
                      for index in self.chunks)
        return self.statistics is not None and indexed == self.statistics.message_count


@dataclass(frozen=True)
class Piece:
    """
    A usable record of the data section.

    offset, length: where it stands in the file, and its size [bytes]
    record: an attachment is told by its index; None for a message outside of chunks
    contents: of a chunk with the messages of known channels; of a single message
    foreign: how many messages were left out because nothing tells what they are
    """

    offset: int
    length: int
    record: McapRecord | None
    contents: ChunkContents | None = None
    foreign: int = 0


class Reading:
    """
    A file being read, of the size that it has now; beyond its end there is nothing.

    Raises LogAccessError, at any call, for a file that cannot be opened or read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._access():
            # A pipe would be waited for.
            if not stat.S_ISREG(os.stat(path).st_mode):
                raise LogAccessError(f'cannot read {path}: it is no regular file')
            self._file = open(path, 'rb')  # noqa: SIM115
            self.size = os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextlib.contextmanager
    def _access(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogAccessError(
                f'cannot read {self._path}: {error.strerror or error}') from error

    def at(self, offset: int, length: int) -> bytes:
        """Return the bytes there, fewer where the file ends."""
        length = min(length, self.size - offset)
        if length <= 0:
            return b''
        with self._access():
            self._file.seek(offset)
            return self._file.read(length)

    def blocks(self, offset: int, length: int) -> Iterator[bytes]:
        """Yield a stretch of the file in blocks."""
        end = min(offset + length, self.size)
        while offset < end:
            block = self.at(offset, min(BLOCK, end - offset))
            if not block:
                return
            offset += len(block)
            yield block

    def head(self, offset: int, limit: int) -> tuple[int, int] | None:
        """Return opcode and length of the record there; None if none can begin there."""
        head = self.at(offset, HEAD.size)
        if len(head) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(head)
        if not _is_opcode(opcode) or offset + HEAD.size + length > limit:
            return None
        return opcode, length

    def record(self, offset: int, limit: int) -> McapRecord:
        """Return the record there, which is no message and no attachment; raises Damaged."""
        head = self.head(offset, limit)
        if head is None:
            raise Damaged('no record begins there')
        opcode, length = head
        return parse(opcode, self.at(offset + HEAD.size, length))


def _is_opcode(opcode: int) -> bool:
    # 0x10 to 0x7f are reserved for later versions, the rest is private.
    return Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 0x80


def read_summary(reading: Reading) -> Summary:
    """Return the summary, or an empty one that says why there is none."""
    footer_offset = reading.size - MAGIC_SIZE - FOOTER_SIZE
    none = Summary(reading.size)
    if (footer_offset < MAGIC_SIZE or reading.at(reading.size - MAGIC_SIZE, MAGIC_SIZE)
            != MCAP0_MAGIC):
        return replace(none, missing='the file does not end as an MCAP file ends')
    try:
        footer = reading.record(footer_offset, reading.size - MAGIC_SIZE)
    except Damaged:
        return replace(none, missing='the footer is damaged')
    if not isinstance(footer, Footer):
        return replace(none, missing='the footer is damaged')
    none.ended = True
    start = footer.summary_start
    if start == 0:
        return replace(none, data_end=footer_offset - DATA_END_SIZE,
                       missing='the file was written without summary')
    if not MAGIC_SIZE + DATA_END_SIZE <= start <= footer_offset:
        return replace(none, missing='the footer leads to no summary')
    if footer.summary_crc:
        crc = 0
        for block in reading.blocks(start, reading.size - MAGIC_SIZE - 4 - start):
            crc = zlib.crc32(block, crc)
        if crc != footer.summary_crc:
            return replace(none, missing='the checksum of the summary is wrong')
    summary = Summary(start - DATA_END_SIZE, ended=True)
    try:
        _fill(summary, reading, start, footer_offset)
    except Damaged as damage:
        return replace(none, missing=f'the summary is damaged: {damage}')
    return summary


def _fill(summary: Summary, reading: Reading, start: int, end: int) -> None:
    """Read the records of a summary; raises Damaged where they do not fit the file."""
    offset = start
    while offset < end:
        head = reading.head(offset, end)
        if head is None:
            raise Damaged(f'no record begins at byte {offset}')
        opcode, length = head
        # Offsets into the summary are not needed: all of it is read.
        if opcode < 0x80 and opcode != Opcode.SUMMARY_OFFSET:
            record = reading.record(offset, end)
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, Statistics):
                summary.statistics = record
            elif isinstance(record, ChunkIndex):
                summary.chunks.append(record)
            elif isinstance(record, MetadataIndex):
                summary.metadata.append(record)
            elif isinstance(record, AttachmentIndex):
                summary.attachments.append(record)
            else:
                raise Damaged(f'it holds a {name_of(opcode)}')
        offset += HEAD.size + length
    for index in summary.chunks:
        if index.chunk_start_offset + index.chunk_length > summary.data_end:
            raise Damaged('it places a chunk outside of the data section')
    statistics = summary.statistics
    if statistics is not None and summary.chunks and (
            statistics.chunk_count != len(summary.chunks)):
        raise Damaged('its statistics and its indexes count different numbers of chunks')


class Walk:
    """
    One walk through the data section.  Iterate once; `damage` is complete afterwards.

    header, schemas, channels: as far as they are known at the time
    """

    def __init__(self, reading: Reading, summary: Summary) -> None:
        self._reading = reading
        self._summary = summary
        self._limit = summary.data_end  # no record of the data section leads beyond
        self.header: Header | None = None
        self.schemas = dict(summary.schemas)
        self.channels = dict(summary.channels)

        self._torn = not summary.ended
        self._all_in_chunks = summary.all_in_chunks
        self._losses: list[Loss] = []
        self._defects: list[str] = []
        self._counts: dict[int, int] = {}       # whole messages by channel
        self._indexed_lost: dict[int, int] = {}  # messages in lost chunks by channel, by indexes
        self._foreign: dict[int, Loss] = {}     # by channel that nothing tells about
        self._next_sequence: dict[int, int] = {}
        self._gaps: dict[int, int] = {}         # missing by sequence numbers, by channel
        self._times: list[int] = []             # earliest and latest
        self._chunks_seen = False
        # Over the records as they should be; None once bytes are lost.
        self._crc: int | None = 0
        # What should follow a chunk: its message indexes by channel, and what a lost one held.
        self._indexes: dict[int, bytes] = {}
        self._lost_chunk: Loss | None = None

    def __iter__(self) -> Iterator[Piece]:
        if self._reading.at(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        self._crc = zlib.crc32(MCAP0_MAGIC)
        offset = MAGIC_SIZE
        suspect: int | None = None  # where a damaged record was that only its length led beyond
        while offset < self._limit:
            reason = ''
            head = self._reading.head(offset, self._limit)
            if head is not None:
                opcode, length = head
                following = offset + HEAD.size + length
                if opcode == Opcode.DATA_END and length == DATA_END_SIZE - HEAD.size:
                    break
                try:
                    piece = self._piece(offset, opcode, length)
                except _DataIsOverError:
                    break
                except Damaged as damage:
                    reason = str(damage)
                else:
                    if piece is not None:
                        yield piece
                    offset, suspect = following, None
                    continue
            index_size = self._correct_index(offset)
            if index_size:
                offset += index_size
                continue
            if head is not None and suspect is None and self._may_begin(following):
                self._lose(offset, following - offset, opcode, reason)
                offset, suspect = following, offset
                continue
            # The length of the one before led to what is no record: it was wrong too.
            start = offset if suspect is None else suspect
            self._losses = [loss for loss in self._losses if loss.offset < start]
            offset = yield from self._resume(start, reason)
            suspect = None
        self._end(offset)

    def damage(self) -> Damage:
        """Return what was found; for after the walk."""
        losses = sorted([*self._losses, *self._foreign.values()], key=lambda loss: loss.offset)
        statistics = self._summary.statistics
        missing: dict[str, int] = {}
        if statistics is not None:
            known = {number: total - self._counts.get(number, 0)
                     for number, total in statistics.channel_message_counts.items()}
        else:
            known = {number: max(self._gaps.get(number, 0), self._indexed_lost.get(number, 0))
                     for number in {*self._gaps, *self._indexed_lost}}
            for number, loss in self._foreign.items():
                known[number] = known.get(number, 0) + (loss.messages or 0)
        for number, lost in sorted(known.items()):
            if lost > 0:
                topic = self.channels[number].topic if self._knows(number) else ''
                missing[topic] = missing.get(topic, 0) + lost
        if statistics is not None and not losses:
            # A whole file that was made of a torn one still tells what that had lost.
            for number, lost in sorted(self._gaps.items()):
                topic = self.channels[number].topic
                missing[topic] = missing.get(topic, 0) + lost
        messages: dict[str, int] = {}
        for number, channel in self.channels.items():
            messages[channel.topic] = (
                messages.get(channel.topic, 0) + self._counts.get(number, 0))
        return Damage(
            torn=self._torn, losses=tuple(losses), defects=tuple(self._defects),
            messages=messages, missing=missing, missing_exactly=statistics is not None,
            start_ns=min(self._times, default=0), end_ns=max(self._times, default=0))

    def _piece(self, offset: int, opcode: int, length: int) -> Piece | None:
        """Return the record there, or None if it is none for others; raises Damaged."""
        whole = HEAD.size + length
        if opcode == Opcode.ATTACHMENT:
            return self._attachment(offset, length)
        if opcode >= 0x80:
            raise Damaged('it is private to the program that wrote it')
        content = self._reading.at(offset + HEAD.size, length)
        if opcode == Opcode.MESSAGE:
            return self._message(offset, content)
        record = parse(opcode, content)
        if opcode in _SUMMARY_KINDS:
            if not self._summary.missing:
                raise Damaged('it has no place before the summary')
            raise _DataIsOverError
        if isinstance(record, Chunk):
            return self._chunk(offset, whole, record)
        if isinstance(record, MessageIndex):
            self._message_index(offset, record, HEAD.pack(opcode, length) + content)
            return None
        self._no_more_indexes()
        if isinstance(record, Schema | Channel):
            record = self._declare(offset, record)
        elif isinstance(record, Header):
            if offset != MAGIC_SIZE:
                raise Damaged('it has no place but at the beginning')
            self.header = record
        elif not isinstance(record, Metadata):
            raise Damaged('it has no place there')
        self._add_to_crc(record_bytes(record))
        return Piece(offset, whole, record)

    def _chunk(self, offset: int, length: int, chunk: Chunk) -> Piece:
        contents = open_chunk(chunk)
        self._no_more_indexes()
        self._chunks_seen = True
        self._indexes = message_indexes(contents.entries)
        for record in contents.declared:
            self._declare(offset, record)
        if contents.messages:
            start, end = time_span(contents.entries)
            if (start, end) != (chunk.message_start_time, chunk.message_end_time):
                self._defects.append(f'the chunk at byte {offset} has wrong times in its head')
                chunk = replace(chunk, message_start_time=start, message_end_time=end)
        self._add_to_crc(record_bytes(chunk))
        return self._taken(Piece(offset, length, chunk, contents))

    def _message(self, offset: int, content: bytes) -> Piece:
        message = parse_message(content)
        if self._all_in_chunks or self._ours:
            raise Damaged('all messages of the file are in chunks')
        following = offset + HEAD.size + len(content)
        after = self._reading.at(following, 1)
        # Nothing in a message proves its length but the record that follows.
        if following < self._limit and not (after and _is_opcode(after[0])):
            raise Damaged('no record follows it')
        self._no_more_indexes()
        self._add_to_crc(HEAD.pack(Opcode.MESSAGE, len(content)) + content)
        return self._taken(Piece(
            offset, HEAD.size + len(content), None, ChunkContents(content, [], [message])))

    def _attachment(self, offset: int, length: int) -> Piece:
        head = self._reading.at(offset + HEAD.size, min(length, _ATTACHMENT_HEAD))
        index = parse_attachment_head(head, offset, HEAD.size + length)
        own_crc = 0
        for block in self._reading.blocks(offset + HEAD.size, length - 4):
            own_crc = zlib.crc32(block, own_crc)
        stored = int.from_bytes(self._reading.at(offset + HEAD.size + length - 4, 4), 'little')
        if stored not in (0, own_crc):
            raise Damaged('its checksum is wrong')
        self._no_more_indexes()
        for block in self._reading.blocks(offset, HEAD.size + length):
            self._add_to_crc(block)
        return Piece(offset, HEAD.size + length, index)

    def _message_index(self, offset: int, index: MessageIndex, found: bytes) -> None:
        """Compare an index with its chunk; after a lost chunk, learn what that held."""
        number = len(index.records)
        if self._lost_chunk is not None:
            self._lost_chunk.messages = (self._lost_chunk.messages or 0) + number
            self._indexed_lost[index.channel_id] = (
                self._indexed_lost.get(index.channel_id, 0) + number)
            return
        expected = self._indexes.get(index.channel_id, b'')
        # The entries may be in any order, and a channel without messages may have an index.
        if number and found != expected and sorted(index.records) != sorted(
                struct.iter_unpack('<QQ', expected[-16 * number:])):
            if self._correct_index(offset):
                return
            self._defects.append(f'the message index at byte {offset} is wrong')
        self._indexes.pop(index.channel_id, None)
        self._add_to_crc(found)

    def _correct_index(self, offset: int) -> int:
        """Return the size of the index that should be there, if what is there resembles one."""
        best, channel_id = _FEW_BYTES + 1, None
        for number, expected in self._indexes.items():
            found = self._reading.at(offset, len(expected))
            wrong = sum(map(operator.ne, found, expected))
            if found[:HEAD.size] == expected[:HEAD.size]:
                wrong = min(wrong, _FEW_BYTES)
            if len(found) == len(expected) and wrong < best:
                best, channel_id = wrong, number
        if channel_id is None:
            return 0
        self._defects.append(f'the message index at byte {offset} is wrong')
        expected = self._indexes.pop(channel_id)
        self._add_to_crc(expected)
        return len(expected)

    def _no_more_indexes(self) -> None:
        """Note that a record is not about the chunk before it."""
        self._indexes = {}
        self._lost_chunk = None

    def _declare(self, offset: int, record: Schema | Channel) -> Schema | Channel:
        """Make a schema or channel known, and return what is right about it."""
        known: Schema | Channel
        if isinstance(record, Schema):
            known = self.schemas.setdefault(record.id, record)
        else:
            known = self.channels.setdefault(record.id, record)
        if known != record:
            self._defects.append(
                f'the {type(record).__name__.lower()} {record.id} at byte {offset} is not what '
                'the file says elsewhere')
        return known

    def _knows(self, channel_id: int) -> bool:
        """Return whether messages of the channel can be understood."""
        channel = self.channels.get(channel_id)
        return channel is not None and (
            channel.schema_id == 0 or channel.schema_id in self.schemas)

    def _taken(self, piece: Piece) -> Piece:
        """Count the messages of a piece, and return it with those of known channels."""
        contents = piece.contents
        assert contents is not None
        foreign = [number for number in contents.entries if not self._knows(number)]
        if foreign:
            known = []
            for message in contents.messages:
                if message.channel_id in foreign:
                    self._leave_out_foreign(piece.offset, message)
                else:
                    known.append(message)
            piece = replace(
                piece, contents=ChunkContents(contents.plain, contents.declared, known),
                foreign=len(contents.messages) - len(known))
            return self._taken(piece)
        for number, entries in contents.entries.items():
            self._counts[number] = self._counts.get(number, 0) + len(entries) // 2
        if contents.messages:
            self._times += time_span(contents.entries)
            self._times = [min(self._times), max(self._times)]
        if self._ours:
            self._count_gaps(contents.messages)
        return piece

    def _leave_out_foreign(self, offset: int, message: StoredMessage) -> None:
        """Note a message that nothing tells how to understand."""
        number = message.channel_id
        loss = self._foreign.setdefault(number, Loss(
            offset, 0, f'messages of channel {number}',
            'the record of their channel or schema is lost', messages=0))
        loss.bytes += message.end - message.start
        loss.messages = (loss.messages or 0) + 1

    def _count_gaps(self, messages: list[StoredMessage]) -> None:
        """Count what is missing between messages that were numbered without gaps."""
        following = self._next_sequence
        for _, number, sequence, _, _, _ in messages:
            gap = (sequence - following.get(number, 0)) & 0xFFFFFFFF
            if gap < 1 << 31:  # else it is out of order
                if gap:
                    self._gaps[number] = self._gaps.get(number, 0) + gap
                following[number] = sequence + 1

    @property
    def _ours(self) -> bool:
        """Whether this package wrote the file, and so numbered the messages without gaps."""
        return self.header is not None and self.header.library.startswith(OUR_LIBRARY)

    def _add_to_crc(self, data: bytes) -> None:
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)

    def _may_begin(self, offset: int) -> bool:
        """Return whether a record of the known kinds can begin there, or the end is reached."""
        if offset == self._limit:
            return True
        head = self._reading.head(offset, self._limit)
        return head is not None and head[0] <= Opcode.DATA_END

    def _lose(self, offset: int, size: int, opcode: int, reason: str) -> None:
        """Note that bytes are lost that begin where a record of this kind should."""
        self._no_more_indexes()
        self._crc = None
        loss = Loss(offset, size, name_of(opcode), reason)
        self._losses.append(loss)
        index = next((index for index in self._summary.chunks
                      if index.chunk_start_offset == offset), None)
        if index is not None:
            loss.what = name_of(Opcode.CHUNK)
            loss.start_ns, loss.end_ns = index.message_start_time, index.message_end_time
        elif opcode == Opcode.CHUNK:
            head = self._reading.at(offset + HEAD.size, CHUNK_HEAD.size)
            if len(head) == CHUNK_HEAD.size:
                start, end, _, _ = CHUNK_HEAD.unpack(head)
                if 0 < start <= end:
                    loss.start_ns, loss.end_ns = start, end
        if loss.what == name_of(Opcode.CHUNK):
            self._chunks_seen = True
            self._lost_chunk = loss

    def _resume(self, offset: int, reason: str = '') -> _Resuming:
        """Go on behind what cannot be read at all: yield what is found, return where to go on."""
        first = int.from_bytes(self._reading.at(offset, 1), 'little')
        following = self._limit
        found = False
        for place, proven in self._proven_after(offset):
            found = True
            if proven is None or isinstance(proven, Chunk):
                following = place
                break
            record = proven
            if isinstance(proven, Schema | Channel):
                record = self._declare(place, proven)
            yield Piece(place, len(record_bytes(proven)), record)
        if not found and self._torn and self._rebuilt(offset, first):
            return self._limit
        if not reason:
            torn = self._torn and following == self._limit and _is_opcode(first)
            reason = 'the file ends within it' if torn else 'no record can be read there'
        self._lose(offset, following - offset, first, reason)
        if following < self._limit:
            self._no_more_indexes()  # they may be those of another chunk
        return following

    def _rebuilt(self, offset: int, opcode: int) -> bool:
        """Return whether the last record, which is cut, is one that tells nothing of its own."""
        if opcode == Opcode.MESSAGE_INDEX:
            return bool(self._indexes)
        if opcode == Opcode.METADATA:
            name = record_bytes(Metadata(BAG_METADATA, {}))[HEAD.size:-4]
            start = self._reading.at(offset + HEAD.size, len(name))
            # Ours have no other metadata behind their chunks.
            return start == name or (self._ours and self._chunks_seen)
        return opcode == Opcode.DATA_END or opcode in _SUMMARY_KINDS

    def _proven_after(self, offset: int) -> Iterator[tuple[int, McapRecord | None]]:
        """Yield places of records behind an offset; the walk goes on at a chunk or None."""
        if not self._summary.missing:
            places = [*(index.chunk_start_offset for index in self._summary.chunks),
                      *(index.offset for index in self._summary.metadata),
                      *(index.offset for index in self._summary.attachments)]
            following = min((place for place in places if place > offset), default=None)
            if following is not None:
                yield following, None
            return
        start = offset + 1
        proven = start
        while start < self._limit:
            block = self._reading.at(start, BLOCK + _CANDIDATE_SIZE)
            for match in _CANDIDATE.finditer(block):
                place = start + match.start()
                if proven <= place < start + BLOCK:
                    record = self._proven(place)
                    if record is not None:
                        yield place, record
                        proven = place + 1
            start += BLOCK

    def _proven(self, offset: int) -> McapRecord | None:
        """Return the record there if its own lengths and checksum leave nothing to chance."""
        head = self._reading.head(offset, self._limit)
        if head is None:
            return None
        opcode, length = head
        # First what needs no more than a look: most candidates are none.
        start = self._reading.at(offset + HEAD.size, _CHUNK_START)
        try:
            if opcode == Opcode.CHUNK:
                stream = StrictStream(start[CHUNK_HEAD.size:])
                stream.read_prefixed_string()
                if CHUNK_HEAD.size + stream.count + 8 + stream.read8() != length:
                    return None
            else:
                text = _TEXT_OFFSETS[opcode]
                size = int.from_bytes(start[text:text + 4], 'little')
                if not 0 < size < _LONGEST_NAME or length > _LARGEST_DECLARATION:
                    return None
            record = self._reading.record(offset, self._limit)
            if isinstance(record, Chunk):
                open_chunk(record)
        except (Damaged, McapError, UnicodeDecodeError):
            return None
        return record

    def _end(self, offset: int) -> None:
        """Look at what ends the data section, at an offset."""
        if self._summary.missing:
            self._defects.append(self._summary.missing)
        try:
            end = self._reading.record(offset, self._reading.size)
        except Damaged:
            end = None
        if isinstance(end, DataEnd):
            if self._crc is not None and end.data_section_crc not in (0, self._crc):
                self._losses.append(Loss(
                    0, 0, 'something besides the messages',
                    'the checksum of the data section is wrong'))
        elif not self._torn:
            self._defects.append('the end of the data section is damaged')
        statistics = self._summary.statistics
        if statistics is not None and not self._losses and not self._foreign and (
                statistics.message_count > sum(self._counts.values())):
            self._losses.append(Loss(
                0, 0, 'messages', 'the statistics count more than there are'))


class _DataIsOverError(Exception):
    """A record of the summary came before the end of the data section."""
