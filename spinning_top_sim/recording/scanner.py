# SPDX-License-Identifier: Apache-2.0
"""
Scans an MCAP file sequentially and skips damaged records.

- A record with wrong content whose length leads to another record is skipped alone.
- Elsewhere the scan goes on at the next record that the summary indexes; if there is no summary,
  at the next chunk that proves itself by its inner lengths and its checksum.  Schemas, channels
  and metadata on the way are used if all their lengths fit.  Single messages are not: nothing in
  them tells them from chance.
- Schemas and channels of a summary with a right checksum go before those in the data section.
- The checksum of the data section is taken over the records as they should be, where something
  else tells that (magic, schemas, channels, message indexes, times of chunks).  If it is right
  then, nothing was lost.
- Records of unknown kinds are no damage: they belong to applications or to later versions of the
  format (MCAP specification, "Records").
"""

from __future__ import annotations

import bisect
import re
import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.damage import Damage, Loss
from spinning_top_sim.recording.mcap_writer import (
    MESSAGE_FIELDS,
    message_indexes,
    record_bytes,
    time_span,
)
from spinning_top_sim.recording.records import (
    CHUNK_HEAD,
    HEAD,
    LOOK_BYTES,
    TEXT_OFFSETS,
    ChunkContents,
    DamagedError,
    StoredMessage,
    TooLargeError,
    looks_right,
    name_of,
    open_chunk,
    parse,
    parse_attachment_head,
    parse_message,
)
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.summary import MAGIC_SIZE, McapSource, Summary
from spinning_top_sim.recording.writer import OUR_LIBRARY

_DATA_END_SIZE = HEAD.size + 4
_INDEX_HEAD = HEAD.size + 2 + 4     # of a message index, before its entries
_ATTACHMENT_HEAD = 1 << 16  # bytes; more than any name and media type
_SEARCH_BLOCK = 1 << 20
_SEARCH_EFFORT = 4  # bytes of candidates read, as a multiple of the size of the file

# What may begin a chunk, a schema, a channel or metadata: opcode and a length below 2^40.
_CANDIDATE = re.compile(rb'[\x03\x04\x06\x0c](?=.{5}\x00\x00\x00)', re.DOTALL)
_SUMMARY_KINDS = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                  Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER)


@dataclass(frozen=True)
class ScannedRecord:
    """
    A usable record of the data section.

    Attributes
    ----------
    opcode : int
        0x10 and above: of an application, or of a later version of the format.
    offset, length : int
        Its place in the file, and its size with its head [bytes].
    record : McapRecord or None
        As it should be.  The index of an attachment; None for a message outside of chunks and
        for unknown kinds.
    raw : bytes
        The record as it stands in the file; b'' where `record` was corrected.  Only for schemas,
        channels and metadata.
    extra : bytes
        What stands behind the known fields of a chunk.
    contents : ChunkContents or None
        Of a chunk, with the messages of known channels; of a message outside of chunks.
    unknown : int
        Messages that were left out because their channel or its schema is unknown.

    """

    opcode: int
    offset: int
    length: int
    record: McapRecord | None = None
    raw: bytes = b''
    extra: bytes = b''
    contents: ChunkContents | None = None
    unknown: int = 0


class _EndOfDataError(Exception):
    """A record of the summary comes before the end of the data section."""


class Scanner:
    """
    One scan through the data section.  Iterate once; `damage` is complete afterwards.

    Parameters
    ----------
    source : McapSource
    summary : Summary

    Attributes
    ----------
    header : Header or None
    schemas, channels : dict
        By id, as far as they are known at the time.

    """

    def __init__(self, source: McapSource, summary: Summary) -> None:
        self._source = source
        self._summary = summary
        self._limit = summary.data_limit
        self._has_limit = summary.closed and not summary.problem    # and not that of the file
        self._effort = _SEARCH_EFFORT * source.size
        self._places = summary.places
        self._place_offsets = sorted(self._places)
        self.header: Header | None = None
        self.schemas = dict(summary.schemas)
        self.channels = dict(summary.channels)

        self._losses: list[Loss] = []
        self._defects: list[str] = []
        self._counts: dict[int, int] = {}        # whole messages by channel
        self._indexed_lost: dict[int, int] = {}  # messages of lost chunks by channel, by indexes
        self._unknown: dict[int, Loss] = {}      # by unknown channel
        self._next_sequence: dict[int, int] = {}
        self._gaps: dict[int, int] = {}          # missing by sequence numbers, by channel
        self._times: list[int] = []              # earliest and latest
        # Over the records as they should be; None once bytes are lost.
        self._crc: int | None = zlib.crc32(MCAP0_MAGIC)
        # What should follow a chunk: its message indexes by channel; what a lost one held.
        self._expected: dict[int, bytes] = {}
        self._lost_chunk: Loss | None = None
        self._chunks_seen = False

    def __iter__(self) -> Iterator[ScannedRecord]:
        if self._source.read(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        offset = MAGIC_SIZE
        while offset < self._limit and not self._is_last(offset):
            try:
                scanned = self._scan(offset)
            except _EndOfDataError:
                break
            except DamagedError as damage:
                offset = yield from self._skip(offset, damage)
            else:
                yield scanned
                offset += scanned.length
        self._check_end(offset)

    def damage(self) -> Damage:
        """Return what was found; call it after the scan."""
        statistics = self._summary.statistics
        losses = sorted([*self._losses, *self._unknown.values()], key=lambda loss: loss.offset)
        missing: dict[int, int] = {}
        if statistics is not None:
            missing = {number: total - self._counts.get(number, 0)
                       for number, total in statistics.channel_message_counts.items()}
            if not losses:
                # A whole file that was made of a truncated one still tells what that had lost.
                for number, lost in self._gaps.items():
                    missing[number] = missing.get(number, 0) + lost
        else:
            for number in {*self._gaps, *self._indexed_lost, *self._unknown}:
                unknown = self._unknown.get(number)
                missing[number] = max(self._gaps.get(number, 0), self._indexed_lost.get(number, 0)
                                      ) + ((unknown and unknown.messages) or 0)
        missing_by_topic: dict[str, int] = {}
        for number, lost in sorted(missing.items()):
            if lost > 0:
                topic = self.channels[number].topic if self._knows(number) else ''
                missing_by_topic[topic] = missing_by_topic.get(topic, 0) + lost
        messages: dict[str, int] = {}
        for number, channel in self.channels.items():
            messages[channel.topic] = (
                messages.get(channel.topic, 0) + self._counts.get(number, 0))
        return Damage(
            truncated=not self._summary.closed, losses=tuple(losses),
            defects=tuple(self._defects), messages=messages, missing=missing_by_topic,
            missing_exactly=statistics is not None,
            start_ns=min(self._times, default=0), end_ns=max(self._times, default=0))

    # Reading records

    def _scan(self, offset: int) -> ScannedRecord:
        """Return the record there.  Raises DamagedError, or _EndOfDataError at a summary's."""
        opcode, length = self._source.head(offset, self._limit)
        end = offset + HEAD.size + length
        place = self._next_place(offset)
        if self._places.get(offset, opcode) != opcode or (place is not None and end > place):
            raise DamagedError('the summary tells of another record there')
        if opcode == Opcode.ATTACHMENT:
            return self._scan_attachment(offset, length)
        if opcode > Opcode.DATA_END:
            return self._scan_unknown_kind(opcode, offset, length)
        content = self._source.content(offset, length)
        if opcode == Opcode.MESSAGE:
            return self._scan_message(offset, content)
        record, extra = parse(opcode, content)
        # Nothing proves that bytes behind the known fields belong to it but what follows.
        if extra and (self._is_ours or not self._is_record(end)):
            raise DamagedError('its length is not that of its content')
        if opcode in (*_SUMMARY_KINDS, Opcode.DATA_END):
            if self._has_limit and (opcode != Opcode.DATA_END or end != self._limit):
                raise DamagedError('it has no place before the end of the data section')
            raise _EndOfDataError
        raw = HEAD.pack(opcode, length) + content
        scanned = ScannedRecord(opcode, offset, len(raw), record, raw)
        if isinstance(record, MessageIndex):
            self._check_message_index(offset, record, raw)
            return scanned
        if isinstance(record, Chunk):
            return self._scan_chunk(scanned, record, content[len(content) - extra:])
        if isinstance(record, Schema | Channel):
            known = self._declare(offset, record)
            if known != record:
                record = known
                scanned = replace(scanned, record=known, raw=b'')
        elif isinstance(record, Header):
            if offset != MAGIC_SIZE:
                raise DamagedError('it has no place but at the beginning')
            self.header = record
        self._forget_chunk()
        self._add_to_crc(scanned.raw or record_bytes(record))
        return scanned

    def _scan_chunk(self, scanned: ScannedRecord, chunk: Chunk, extra: bytes) -> ScannedRecord:
        contents = open_chunk(chunk, self._source.max_bytes)
        self._forget_chunk()
        self._chunks_seen = True
        self._expected = message_indexes(contents.entries)
        for record in contents.declared:
            self._declare(scanned.offset, record)
        raw = scanned.raw
        start, end = time_span(contents.entries)
        if contents.messages and (start, end) != (
                chunk.message_start_time, chunk.message_end_time):
            self._defects.append(f'the chunk at byte {scanned.offset} has wrong times in its head')
            chunk = replace(chunk, message_start_time=start, message_end_time=end)
            raw = raw[:HEAD.size] + record_bytes(chunk)[HEAD.size:] + extra
        self._add_to_crc(raw)
        return self._take_messages(replace(
            scanned, record=chunk, raw=b'', extra=extra, contents=contents))

    def _scan_message(self, offset: int, content: bytes) -> ScannedRecord:
        message = parse_message(content, 0, len(content))
        if self._is_ours or self._summary.indexes_all_messages:
            raise DamagedError('all messages of the file are in chunks')
        end = offset + HEAD.size + len(content)
        # Nothing in a message proves its length but the record that follows.
        if end < self._limit and not 0 < self._source.read(end, 1)[0] <= Opcode.DATA_END:
            try:
                self._source.head(end, self._limit)
            except DamagedError:
                raise DamagedError('no record follows it') from None
        self._forget_chunk()
        self._add_to_crc(HEAD.pack(Opcode.MESSAGE, len(content)) + content)
        return self._take_messages(ScannedRecord(
            Opcode.MESSAGE, offset, HEAD.size + len(content),
            contents=ChunkContents(content, [], [message])))

    def _scan_attachment(self, offset: int, length: int) -> ScannedRecord:
        content = offset + HEAD.size
        index, crc_offset = parse_attachment_head(
            self._source.read(content, min(length, _ATTACHMENT_HEAD)), length)
        if crc_offset + 4 < length and not self._is_record(content + length):
            raise DamagedError('its length is not that of its content')
        crc = 0
        for block in self._source.blocks(content, crc_offset):
            crc = zlib.crc32(block, crc)
        stored = int.from_bytes(self._source.read(content + crc_offset, 4), 'little')
        if stored not in (0, crc):
            raise DamagedError('its checksum is wrong')
        return self._scan_blocks(ScannedRecord(
            Opcode.ATTACHMENT, offset, HEAD.size + length, index))

    def _scan_unknown_kind(self, opcode: int, offset: int, length: int) -> ScannedRecord:
        if self._is_ours:
            raise DamagedError('there is no such kind of record')
        for expected in self._expected.values():
            if len(expected) == HEAD.size + length and (
                    self._source.read(offset + 1, len(expected) - 1) == expected[1:]):
                raise DamagedError('it is a message index but for its kind')
        return self._scan_blocks(ScannedRecord(opcode, offset, HEAD.size + length))

    def _scan_blocks(self, scanned: ScannedRecord) -> ScannedRecord:
        """Add a record of any size to the checksum."""
        self._forget_chunk()
        for block in self._source.blocks(scanned.offset, scanned.length):
            self._add_to_crc(block)
        return scanned

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

    def _add_to_crc(self, data: bytes) -> None:
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)

    @property
    def _is_ours(self) -> bool:
        """Whether this package wrote the file: numbered without gaps, without unknown records."""
        return self.header is not None and self.header.library.startswith(OUR_LIBRARY)

    # Message indexes

    def _check_message_index(self, offset: int, index: MessageIndex, raw: bytes) -> None:
        """Compare an index with its chunk; behind a lost chunk, learn what that held."""
        number = len(index.records)
        if self._lost_chunk is not None:
            self._lost_chunk.messages = (self._lost_chunk.messages or 0) + number
            self._indexed_lost[index.channel_id] = (
                self._indexed_lost.get(index.channel_id, 0) + number)
            return
        expected = self._expected.get(index.channel_id)
        # The entries may be in any order, and a channel without messages may have an index.
        if number and raw != expected and (expected is None or sorted(index.records) != sorted(
                struct.iter_unpack('<QQ', expected[_INDEX_HEAD:]))):
            if self._repair_indexes(offset):
                raise DamagedError('it does not agree with its chunk')
            self._defects.append(f'the message index at byte {offset} is wrong')
        self._expected.pop(index.channel_id, None)
        self._add_to_crc(raw)

    def _repair_indexes(self, offset: int) -> int:
        """Return the size of the expected indexes if damage there is inside of them, else 0."""
        size = sum(map(len, self._expected.values()))
        end = offset + size
        if end > self._limit and not self._summary.closed:
            # Truncated within an index, which tells nothing of its own.
            first = self._source.read(offset, 1)
            return self._limit - offset if first == bytes([Opcode.MESSAGE_INDEX]) else 0
        return size if self._is_record(end) else 0

    def _forget_chunk(self) -> None:
        """Note that a record is not about the chunk before it."""
        self._expected = {}
        self._lost_chunk = None

    # Messages

    def _knows(self, channel_id: int) -> bool:
        """Return whether the channel and its schema are known."""
        channel = self.channels.get(channel_id)
        return channel is not None and (
            channel.schema_id == 0 or channel.schema_id in self.schemas)

    def _take_messages(self, scanned: ScannedRecord) -> ScannedRecord:
        """Count the messages of a record, and return it with those of known channels."""
        contents = scanned.contents
        assert contents is not None
        unknown = {number for number in contents.entries if not self._knows(number)}
        if unknown:
            for message in contents.messages:
                if message.channel_id in unknown:
                    self._lose_message(scanned.offset, message)
            known = [message for message in contents.messages
                     if message.channel_id not in unknown]
            scanned = replace(scanned, unknown=len(contents.messages) - len(known),
                              contents=ChunkContents(contents.plain, contents.declared, known))
            return self._take_messages(scanned)
        for number, entries in contents.entries.items():
            self._counts[number] = self._counts.get(number, 0) + len(entries) // 2
        if contents.messages:
            times = [*self._times, *time_span(contents.entries)]
            self._times = [min(times), max(times)]
        if self._is_ours:
            self._count_gaps(contents.messages)
        return scanned

    def _lose_message(self, offset: int, message: StoredMessage) -> None:
        """Note a message of an unknown channel."""
        number = message.channel_id
        loss = self._unknown.setdefault(number, Loss(
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

    # Damage

    def _skip(self, offset: int, damage: DamagedError) -> Generator[ScannedRecord, None, int]:
        """Yield what is usable behind a damaged record, and return where the scan goes on."""
        size = self._repair_indexes(offset)
        if size:
            self._defects.append(f'the message index at byte {offset} is wrong')
            for expected in self._expected.values():
                self._add_to_crc(expected)
            self._expected = {}
            return offset + size
        opcode = self._source.read(offset, 1)[0]
        place = self._next_place(offset)
        try:
            end = offset + HEAD.size + self._source.head(offset, place or self._limit)[1]
        except DamagedError:
            pass
        else:
            if self._is_record(end):
                self._lose(offset, end, opcode, damage)
                return end
        return (yield from self._resynchronize(offset, opcode, damage))

    def _resynchronize(
        self, offset: int, opcode: int, damage: DamagedError,
    ) -> Generator[ScannedRecord, None, int]:
        """Go on behind a damaged record whose length is wrong; see `_skip`."""
        end = self._limit
        found = False
        if self._summary.indexes_all_chunks:
            end = self._next_place(offset) or end
        else:
            for place, record in self._search(offset + 1):
                found = True
                if isinstance(record, Chunk):
                    end = place
                    break
                raw = record_bytes(record)
                if isinstance(record, Schema | Channel):
                    record = self._declare(place, record)   # noqa: PLW2901
                yield ScannedRecord(raw[0], place, len(raw), record)
        if end == self._limit and not self._summary.closed:
            if not found and self._is_redundant(offset, opcode):
                return end
            if 0 < opcode <= Opcode.DATA_END and type(damage) is DamagedError:
                damage = DamagedError('the file ends within it')
        self._lose(offset, end, opcode, damage)
        if end < self._limit:
            self._lost_chunk = None     # the indexes that follow may be those of another chunk
        return end

    def _lose(self, offset: int, end: int, opcode: int, damage: DamagedError) -> None:
        """Note that a record of this kind is lost."""
        self._forget_chunk()
        self._crc = None
        loss = Loss(offset, end - offset, name_of(opcode), str(damage),
                    refused=isinstance(damage, TooLargeError))
        self._losses.append(loss)
        index = self._summary.chunks.get(offset)
        if index is not None:
            loss.what = name_of(Opcode.CHUNK)
            loss.start_ns, loss.end_ns = index.message_start_time, index.message_end_time
        elif opcode == Opcode.CHUNK:
            head = self._source.read(offset + HEAD.size, CHUNK_HEAD.size)
            if len(head) == CHUNK_HEAD.size:
                start, stop, _, _ = CHUNK_HEAD.unpack(head)
                if 0 < start <= stop:
                    loss.start_ns, loss.end_ns = start, stop
        if loss.what == name_of(Opcode.CHUNK):
            self._chunks_seen = True
            self._lost_chunk = loss

    def _is_redundant(self, offset: int, opcode: int) -> bool:
        """Return whether a truncated record tells nothing of its own."""
        if opcode == Opcode.METADATA:
            name = record_bytes(Metadata(BAG_METADATA, {}))[HEAD.size:-4]
            start = self._source.read(offset + HEAD.size, len(name))
            # Files of this package have no other metadata behind their chunks.
            return start == name or (self._is_ours and self._chunks_seen)
        return opcode == Opcode.DATA_END or opcode in _SUMMARY_KINDS

    def _next_place(self, offset: int) -> int | None:
        """Return where the next record stands that the summary indexes."""
        i = bisect.bisect_right(self._place_offsets, offset)
        return self._place_offsets[i] if i < len(self._place_offsets) else None

    def _is_record(self, offset: int) -> bool:
        """Return whether a record begins there for certain, or the data section ends."""
        try:
            while offset < self._limit:
                opcode, length = self._source.head(offset, self._limit)
                if opcode <= Opcode.DATA_END:
                    break
                offset += HEAD.size + length
            else:
                return offset == self._limit
            if opcode == Opcode.CHUNK or opcode in TEXT_OFFSETS:
                return self._proven(offset)[0] is not None
            if opcode == Opcode.MESSAGE:
                return length >= MESSAGE_FIELDS
            if opcode == Opcode.ATTACHMENT:
                start = self._source.read(offset + HEAD.size, min(length, _ATTACHMENT_HEAD))
                parse_attachment_head(start, length)
            else:
                self._source.record(offset, self._limit)
        except TooLargeError:
            return opcode == Opcode.CHUNK
        except DamagedError:
            return False
        return True

    def _search(self, start: int) -> Iterator[tuple[int, McapRecord]]:
        """Yield chunks, schemas, channels and metadata that prove themselves, and their places."""
        size = HEAD.size
        while start < self._limit:
            size = min(2 * size + 4096, _SEARCH_BLOCK)
            block = self._source.read(start, size + HEAD.size)
            for match in _CANDIDATE.finditer(block, 0, size):
                try:
                    record, extra = self._proven(start + match.start())
                except DamagedError:
                    continue
                if isinstance(record, Chunk) or (record is not None and not extra):
                    yield start + match.start(), record
            start += size

    def _proven(self, offset: int) -> tuple[McapRecord | None, int]:
        """
        Return the record there if its own lengths and checksum prove it, and its extra bytes.

        Raises DamagedError if it is none, TooLargeError if it might be one.
        """
        opcode, length = self._source.head(offset, self._limit)
        # First what needs no more than a look: most candidates are none.
        if not looks_right(opcode, length, self._source.read(offset + HEAD.size, LOOK_BYTES)):
            return None, 0
        self._effort -= length
        if self._effort < 0:    # a file made to have a candidate everywhere
            return None, 0
        record, extra = parse(opcode, self._source.content(offset, length))
        if isinstance(record, Chunk):
            contents = open_chunk(record, self._source.max_bytes)
            return record if contents.messages or contents.declared else None, extra
        return record, extra

    # The end

    def _is_last(self, offset: int) -> bool:
        """Return whether nothing but the end record fits in before the summary."""
        return self._has_limit and self._limit - offset <= _DATA_END_SIZE

    def _stored_crc(self, end: int) -> int:
        """Return the checksum of the data section as it stands in the file."""
        crc = 0
        for block in self._source.blocks(0, end):
            crc = zlib.crc32(block, crc)
        return crc

    def _check_end(self, offset: int) -> None:
        """Look at what ends the data section."""
        if self._summary.problem:
            self._defects.append(self._summary.problem)
        try:
            end = self._source.record(offset, self._limit)
        except DamagedError:
            end = None
        if isinstance(end, DataEnd):
            stored = end.data_section_crc
            if self._crc is not None and stored not in (0, self._crc, self._stored_crc(offset)):
                self._losses.append(Loss(
                    0, 0, 'something besides the messages',
                    'the checksum of the data section is wrong'))
        elif self._summary.closed:
            self._defects.append('the end of the data section is damaged')
        statistics = self._summary.statistics
        if statistics is not None and not self._losses and not self._unknown and (
                statistics.message_count > sum(self._counts.values())):
            self._losses.append(Loss(
                0, 0, 'messages', 'the statistics count more than there are'))
