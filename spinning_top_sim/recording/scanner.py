# SPDX-License-Identifier: Apache-2.0
"""
Scans an MCAP file sequentially and skips damaged records.

- A damaged record whose length leads to another record is skipped alone.  Elsewhere the scan goes
  on at the next record that the summary indexes, or that `RecordFinder` finds.
- Schemas and channels of a summary with a right checksum go before those in the data section.
- The checksum of the data section is taken over the records as they should be, where something
  else tells that (magic, schemas, channels, message indexes, times of chunks).  If it is right
  then, nothing was lost.
- Records of unknown kinds are no damage: they belong to applications or to later versions of the
  format (MCAP specification, "Records").
"""

from __future__ import annotations

import bisect
import struct
import zlib
from collections.abc import Iterator
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

from spinning_top_sim.recording.chunks import message_indexes, time_span
from spinning_top_sim.recording.damage import Damage, Loss
from spinning_top_sim.recording.mcap_writer import record_bytes
from spinning_top_sim.recording.records import (
    CHUNK_HEAD,
    HEAD,
    ChunkContents,
    DamagedError,
    TooLargeError,
    name_of,
    open_chunk,
    parse,
    parse_message,
)
from spinning_top_sim.recording.resync import RecordFinder
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.summary import MAGIC_SIZE, McapSource, Summary
from spinning_top_sim.recording.tally import MessageTally
from spinning_top_sim.recording.writer import OUR_LIBRARY

_DATA_END_SIZE = HEAD.size + 4
_INDEX_HEAD = HEAD.size + 2 + 4     # of a message index, before its entries
_SUMMARY_KINDS = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                  Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER)
_DATA_KINDS = (Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX,
               Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END)


@dataclass(frozen=True)
class ScannedRecord:
    """A usable record of the data section."""

    opcode: int             # above DATA_END: of an application, or of a later version of MCAP
    offset: int             # in the file
    length: int             # with its head
    # As it should be.  The index of an attachment; None for single messages and unknown kinds.
    record: McapRecord | None = None
    # `record` with its head and its extra fields; only what fits into memory.
    raw: bytes = b''
    # Messages of known channels, of a chunk or a single one.
    contents: ChunkContents | None = None
    unknown: int = 0        # messages left out, whose channel or its schema is unknown


class _EndOfDataError(Exception):
    """The data section ends, or a record of the summary comes before its end."""


class Scanner:
    """
    One scan through the data section.  Iterate once; `damage` is complete afterwards.

    `schemas` and `channels` (by id) are those that are known at the time.
    """

    def __init__(self, source: McapSource, summary: Summary) -> None:
        self.header: Header | None = None
        self.schemas = dict(summary.schemas)
        self.channels = dict(summary.channels)

        self._source = source
        self._summary = summary
        self._limit = summary.data_limit
        self._has_limit = summary.closed and not summary.problem    # else that of the file
        self._places = summary.places
        self._place_offsets = sorted(self._places)
        self._finder = RecordFinder(source, self._limit)

        self._tally = MessageTally()
        self._losses: list[Loss] = []
        self._defects: list[str] = []
        # Over the records as they should be; None once bytes are lost.
        self._crc: int | None = zlib.crc32(MCAP0_MAGIC)
        # What should follow a chunk: its message indexes by channel; what a lost one held.
        self._expected: dict[int, bytes] = {}
        self._lost_chunk: Loss | None = None
        self._chunks_seen = False
        self._data_until = 0    # a record of the data section stands there

    def __iter__(self) -> Iterator[ScannedRecord]:
        if self._source.read(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        offset = MAGIC_SIZE
        # The last bytes before a summary can only be the end record.
        while offset < self._limit - (_DATA_END_SIZE if self._has_limit else 0):
            try:
                scanned = self._scan(offset)
            except _EndOfDataError:
                break
            except DamagedError as damage:
                offset = self._skip(offset, damage)
            else:
                yield scanned
                offset += scanned.length
        self._check_end(offset)

    @property
    def found_late(self) -> bool:
        """Whether a channel became known behind messages of it, so that another scan helps."""
        return any(map(self._knows, self._tally.unknown))

    def damage(self) -> Damage:
        """Return what was found; call it after the scan."""
        statistics = self._summary.statistics
        losses = sorted([*self._losses, *self._tally.unknown.values()],
                        key=lambda loss: loss.offset)
        missing: dict[str, int] = {}
        for number, lost in sorted(self._tally.missing(statistics, lossless=not losses).items()):
            if lost > 0:
                topic = self.channels[number].topic if self._knows(number) else ''
                missing[topic] = missing.get(topic, 0) + lost
        messages: dict[str, int] = {}
        for number, channel in self.channels.items():
            messages[channel.topic] = (
                messages.get(channel.topic, 0) + self._tally.found.get(number, 0))
        start_ns, end_ns = self._tally.span
        return Damage(
            truncated=not self._summary.closed, losses=tuple(losses),
            defects=tuple(self._defects), messages=messages, missing=missing,
            missing_exactly=statistics is not None, start_ns=start_ns, end_ns=end_ns)

    # Reading records.  All of these raise DamagedError.

    def _scan(self, offset: int) -> ScannedRecord:
        """Return the record there.  Raises _EndOfDataError where the data section ends."""
        opcode, length = self._source.head(offset, self._limit)
        end = offset + HEAD.size + length
        if self._places.get(offset, opcode) != opcode or end > self._next_place(offset):
            raise DamagedError('the summary tells of another record there')
        if opcode != Opcode.MESSAGE_INDEX and self._is_index_but_for_its_kind(offset, end):
            raise DamagedError('it is a message index but for its kind')
        if opcode == Opcode.ATTACHMENT:
            return self._scan_attachment(offset, length)
        if opcode > Opcode.DATA_END:
            return self._scan_unknown_kind(opcode, offset, length)
        content = self._source.content(offset, length)
        raw = HEAD.pack(opcode, length) + content
        if opcode == Opcode.MESSAGE:
            return self._scan_message(offset, raw)
        record, extra = parse(opcode, content)
        # Nothing but what follows proves that bytes behind the known fields belong to the record.
        if extra and (self._is_ours or not self._finder.is_record(end)):
            raise DamagedError('its length is not that of its content')
        if opcode == Opcode.DATA_END or opcode in _SUMMARY_KINDS:
            certain = opcode == Opcode.DATA_END and (
                end == self._limit if self._has_limit else not extra)
            if certain or (not self._has_limit and self._is_data_over(end)):
                raise _EndOfDataError
            raise DamagedError('it has no place before the end of the data section')
        scanned = ScannedRecord(opcode, offset, len(raw), record, raw)
        if isinstance(record, MessageIndex):
            self._check_message_index(offset, record, raw)
            return scanned
        if isinstance(record, Chunk):
            return self._scan_chunk(scanned, record, content[length - extra:])
        if isinstance(record, Schema | Channel):
            known = self._declare(offset, record)
            if known != record:
                scanned = replace(scanned, record=known, raw=record_bytes(known))
        elif isinstance(record, Header):
            if offset != MAGIC_SIZE:
                raise DamagedError('it has no place but at the beginning')
            self.header = record
        self._accept([scanned.raw])
        return scanned

    def _scan_chunk(self, scanned: ScannedRecord, chunk: Chunk, extra: bytes) -> ScannedRecord:
        contents = open_chunk(chunk, self._source.max_bytes)
        for record in contents.declared:
            self._declare(scanned.offset, record)
        raw = scanned.raw
        start, end = time_span(contents.entries)
        if contents.messages and (start, end) != (
                chunk.message_start_time, chunk.message_end_time):
            self._defects.append(f'the chunk at byte {scanned.offset} has wrong times in its head')
            chunk = replace(chunk, message_start_time=start, message_end_time=end)
            raw = raw[:HEAD.size] + record_bytes(chunk)[HEAD.size:] + extra
        self._accept([raw])
        self._chunks_seen = True
        self._expected = message_indexes(contents.entries)
        return self._take_messages(replace(scanned, record=chunk, raw=raw), contents)

    def _scan_message(self, offset: int, raw: bytes) -> ScannedRecord:
        message = parse_message(raw, HEAD.size, len(raw))
        if self._is_ours or self._summary.indexes_all_messages:
            raise DamagedError('all messages of the file are in chunks')
        end = offset + len(raw)
        # Nothing in a message proves its length but the record that follows.
        if end < self._limit and not 0 < self._source.read(end, 1)[0] <= Opcode.DATA_END:
            try:
                self._source.head(end, self._limit)
            except DamagedError:
                raise DamagedError('no record follows it') from None
        self._accept([raw])
        return self._take_messages(
            ScannedRecord(Opcode.MESSAGE, offset, len(raw)), ChunkContents(raw, [], [message]))

    def _scan_attachment(self, offset: int, length: int) -> ScannedRecord:
        index, crc_offset = self._source.attachment(offset, length)
        end = offset + HEAD.size + length
        if crc_offset + 4 < end and not self._finder.is_record(end):
            raise DamagedError('its length is not that of its content')
        start = offset + HEAD.size
        crc = self._source.crc(start, crc_offset - start)
        if int.from_bytes(self._source.read(crc_offset, 4), 'little') not in (0, crc):
            raise DamagedError('its checksum is wrong')
        self._accept(self._source.blocks(offset, index.length))
        return ScannedRecord(Opcode.ATTACHMENT, offset, index.length, index)

    def _scan_unknown_kind(self, opcode: int, offset: int, length: int) -> ScannedRecord:
        if self._is_ours:
            raise DamagedError('there is no such kind of record')
        size = HEAD.size + length
        self._accept(self._source.blocks(offset, size))
        return ScannedRecord(opcode, offset, size)

    def _accept(self, blocks: Iterator[bytes] | list[bytes]) -> None:
        """Note a record that is not about the chunk before it."""
        self._forget_chunk()
        for block in blocks:
            self._add_to_crc(block)

    def _add_to_crc(self, data: bytes) -> None:
        if self._crc is not None:
            self._crc = zlib.crc32(data, self._crc)

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

    def _take_messages(self, scanned: ScannedRecord, contents: ChunkContents) -> ScannedRecord:
        """Count messages, and return the record with those of known channels."""
        if not all(map(self._knows, contents.entries)):
            known = []
            for message in contents.messages:
                if self._knows(message.channel_id):
                    known.append(message)
                else:
                    self._tally.add_unknown(scanned.offset, message)
            scanned = replace(scanned, unknown=len(contents.messages) - len(known))
            contents = ChunkContents(contents.plain, contents.declared, known)
        self._tally.add(contents, numbered=self._is_ours)
        return replace(scanned, contents=contents)

    def _knows(self, channel_id: int) -> bool:
        """Return whether the channel and its schema are known."""
        channel = self.channels.get(channel_id)
        return channel is not None and (
            channel.schema_id == 0 or channel.schema_id in self.schemas)

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
            self._tally.add_lost(index.channel_id, number)
            return
        expected = self._expected.get(index.channel_id)
        # The entries may be in any order, and a channel without messages may have an index.
        if number and raw != expected and (expected is None or sorted(index.records) != sorted(
                struct.iter_unpack('<QQ', expected[_INDEX_HEAD:]))):
            if self._damaged_indexes(offset):
                raise DamagedError('it does not agree with its chunk')
            self._defects.append(f'the message index at byte {offset} is wrong')
        self._expected.pop(index.channel_id, None)
        self._add_to_crc(raw)

    def _damaged_indexes(self, offset: int) -> int:
        """Return the size of the indexes that are expected there, 0 if something else is there."""
        end = offset + sum(map(len, self._expected.values()))
        if end > self._limit and not self._summary.closed:
            # Truncated within an index, which tells nothing of its own.
            first = self._source.read(offset, 1)
            return self._limit - offset if first == bytes([Opcode.MESSAGE_INDEX]) else 0
        return end - offset if self._finder.is_record(end) else 0

    def _is_index_but_for_its_kind(self, offset: int, end: int) -> bool:
        return any(
            len(expected) == end - offset
            and self._source.read(offset + 1, len(expected) - 1) == expected[1:]
            for expected in self._expected.values())

    def _forget_chunk(self) -> None:
        """Note that what follows is not about the chunk before it."""
        self._expected = {}
        self._lost_chunk = None

    # Damage

    def _skip(self, offset: int, damage: DamagedError) -> int:
        """Note what is damaged, and return where the scan goes on."""
        size = self._damaged_indexes(offset) if self._expected else 0
        if size:
            self._defects.append(f'the message index at byte {offset} is wrong')
            self._accept([*self._expected.values()])
            return offset + size
        opcode = self._source.read(offset, 1)[0]
        try:
            _, length = self._source.head(offset, self._next_place(offset))
        except DamagedError:
            pass
        else:
            end = offset + HEAD.size + length
            if self._finder.is_record(end):
                self._lose(offset, end, opcode, damage)
                return end
        if self._summary.indexes_all_chunks:
            end = self._next_place(offset)
        else:
            end = self._finder.find(offset + 1)
        if end == self._limit and not self._summary.closed:
            if self._is_redundant(offset, opcode):
                return end
            if 0 < opcode <= Opcode.DATA_END and type(damage) is DamagedError:
                damage = DamagedError('the file ends within it')
        self._lose(offset, end, opcode, damage)
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

    def _is_data_over(self, offset: int) -> bool:
        """Return whether no record of a data section follows, up to what is damaged."""
        while self._data_until < offset < self._limit:
            try:
                opcode, length = self._source.head(offset, self._limit)
            except DamagedError:
                break
            if opcode in _DATA_KINDS:
                self._data_until = offset       # so that all looks together take linear time
                return False
            offset += HEAD.size + length
        return offset > self._data_until

    def _next_place(self, offset: int) -> int:
        """Return where the next record stands that the summary indexes, or the limit."""
        i = bisect.bisect_right(self._place_offsets, offset)
        return self._place_offsets[i] if i < len(self._place_offsets) else self._limit

    def _check_end(self, offset: int) -> None:
        """Look at what ends the data section."""
        if self._summary.problem:
            self._defects.append(self._summary.problem)
        try:
            end = self._source.record(offset, self._limit)
        except DamagedError:
            end = None
        if isinstance(end, DataEnd):
            crc = end.data_section_crc
            # A writer may have been wrong: its checksum is that of what it wrote.
            if self._crc is not None and crc not in (0, self._crc) and (
                    crc != self._source.crc(0, offset)):
                self._losses.append(Loss(
                    0, 0, 'something besides the messages',
                    'the checksum of the data section is wrong'))
        elif self._summary.closed:
            self._defects.append('the end of the data section is damaged')
        statistics = self._summary.statistics
        if statistics is not None and not self._losses and not self._tally.unknown and (
                statistics.message_count > sum(self._tally.found.values())):
            self._losses.append(Loss(
                0, 0, 'messages', 'the statistics count more than there are'))
