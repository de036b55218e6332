# SPDX-License-Identifier: Apache-2.0
"""
Scans an MCAP file sequentially and skips damaged records.

- A damaged record whose length leads to another record is skipped alone.  Elsewhere the scan goes
  on at the next record that the summary indexes, or that `RecordFinder` finds.
- Schemas and channels of a summary with a right checksum go before those in the data section.
- The checksum of the data section tells whether a file without any other damage is whole.
- Records of unknown kinds are no damage: they belong to applications or to later versions of the
  format (MCAP specification, "Records").
"""

from __future__ import annotations

import bisect
import contextlib
import struct
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Header, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.chunks import Entries, message_indexes, time_span
from spinning_top_sim.recording.damage import Damage, Loss
from spinning_top_sim.recording.mcap_writer import record_bytes
from spinning_top_sim.recording.records import (
    HEAD,
    ChunkContents,
    DamagedError,
    TooLargeError,
    break_up,
    check_declared,
    check_size,
    name_of,
    open_chunk,
    parse,
    parse_message_index,
)
from spinning_top_sim.recording.resync import RecordFinder
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.summary import MAGIC_SIZE, McapSource, Summary

_TIMES = struct.Struct('<QQ')       # of a chunk, behind its head
_SUMMARY_KINDS = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                  Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER)
_INDEX_KIND = bytes([Opcode.MESSAGE_INDEX])


@dataclass(frozen=True)
class ScannedRecord:
    """A usable record of the data section."""

    opcode: int             # above DATA_END: of an application, or of a later version of MCAP
    offset: int             # in the file
    end: int
    # A schema or channel as the file has it elsewhere.  The index of an attachment; None for
    # single messages, message indexes and unknown kinds.
    record: McapRecord | None = None
    raw: bytes = b''    # with head and extra fields; b'' for attachments and unknown kinds
    # Messages of known channels, of a chunk or a single one.
    contents: ChunkContents | None = None


class Scanner:
    """
    One scan through the data section.  Iterate once; call `damage` afterwards.

    ours : whether this package wrote the file, which numbers messages without gaps, puts all of
        them into chunks, and writes neither records of unknown kinds nor extra fields
    """

    def __init__(self, source: McapSource, summary: Summary, *, ours: bool) -> None:
        self.source = source
        self._summary = summary
        self._ours = ours
        self.schemas, self.channels = summary.schemas, summary.channels     # by id, known so far
        self._all_in_chunks = ours or summary.indexes_all_messages
        self._limit = summary.data_limit
        self._has_limit = summary.closed and not summary.problem    # else that of the file
        self._places: dict[int, int] = {}       # opcodes of indexed records by offset
        for offset, opcode, length in summary.places:
            # Where neither kind nor length is right, the index is wrong and not the record.
            head = source.read(offset, HEAD.size)
            right = HEAD.pack(opcode, (length - HEAD.size) % (1 << 64))
            if head[:1] == right[:1] or head[1:] == right[1:]:
                self._places[offset] = opcode
        self._place_offsets = sorted(self._places)
        self._finder = RecordFinder(source, self._limit)

        self._metadata_bytes = 0
        self._losses: list[Loss] = []
        self._defects: list[str] = []
        self._start_ns, self._end_ns = 1 << 64, 0       # log times of whole messages
        # Messages by channel: whole ones, of damaged chunks, missing by the sequence numbers.
        self._found: Counter[int] = Counter()
        self._in_lost_chunks: Counter[int] = Counter()
        self._gaps: Counter[int] = Counter()
        self._next_sequence: dict[int, int] = {}
        self._unknown: dict[int, Loss] = {}             # messages by unknown channel

    def __iter__(self) -> Iterator[ScannedRecord]:
        if self.source.read(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        offset = MAGIC_SIZE
        in_summary = False      # whose beginning nothing told
        # The last bytes before a summary can only be the end record with its checksum.
        while offset < self._limit - (HEAD.size + 4 if self._has_limit else 0):
            try:
                scanned = self._scan(offset)
            except DamagedError as damage:
                if in_summary:
                    break
                offset = self._skip(offset, damage)
                continue
            if scanned is None:
                break
            offset = scanned.end
            in_summary = scanned.opcode in _SUMMARY_KINDS or (
                in_summary and scanned.opcode in (Opcode.SCHEMA, Opcode.CHANNEL))
            if in_summary:
                continue
            if scanned.contents is not None:
                if scanned.opcode == Opcode.CHUNK:
                    offset = self._check_indexes(offset, scanned.contents.entries)
                self._count(scanned.offset, scanned.contents)
            yield scanned
        self._check_end(offset)

    @property
    def found_late(self) -> bool:
        """Whether a channel became known behind messages of it, so that another scan helps."""
        return any(map(self._summary.knows, self._unknown))

    def damage(self) -> Damage:
        """Return what was found; call it after the scan."""
        statistics = self._summary.statistics
        losses = sorted([*self._losses, *self._unknown.values()], key=lambda loss: loss.offset)
        if statistics is None:
            lost = (self._gaps | self._in_lost_chunks) + Counter(
                {number: loss.messages or 0 for number, loss in self._unknown.items()})
        else:
            lost = Counter(statistics.channel_message_counts)
            lost.subtract(self._found)
            if not losses:
                # A whole file that was made of a truncated one still tells what that had lost.
                lost.update(self._gaps)
        missing: Counter[str] = Counter()
        for number, messages in sorted((+lost).items()):
            missing[self.channels[number].topic if self._summary.knows(number) else ''] += messages
        return Damage(not self._summary.closed, tuple(losses), tuple(self._defects),
                      dict(missing), statistics is not None,
                      self._start_ns if self._found else 0, self._end_ns)

    # Reading records: raises DamagedError

    def _scan(self, offset: int) -> ScannedRecord | None:
        """Return the record there with all of its messages, None where the data section ends."""
        opcode, end = self.source.head(offset, self._limit)
        if self._places.get(offset, opcode) != opcode or end > self._next_place(offset):
            raise DamagedError('the summary tells of another record there')
        check_size(end - offset - HEAD.size, self.source.max_bytes)
        if opcode == Opcode.ATTACHMENT:
            return self._scan_attachment(offset, end)
        if opcode > Opcode.DATA_END:
            if self._ours:
                raise DamagedError('there is no such kind of record')
            return ScannedRecord(opcode, offset, end)
        raw = self.source.raw(offset, end)
        if opcode == Opcode.MESSAGE:
            return self._scan_message(offset, raw)
        if opcode == Opcode.MESSAGE_INDEX:
            _, entries, extra = parse_message_index(raw)
            self._check_extra(extra, end)
            if entries:
                self._defects.append(f'the message index at byte {offset} is wrong')
            return ScannedRecord(opcode, offset, end, raw=raw)
        record, extra = parse(raw)
        self._check_extra(extra, end)
        if isinstance(record, DataEnd) and (
                end == self._limit if self._has_limit else not extra):
            return None
        # Without extra fields, what belongs to a summary is no chunk of a damaged kind.
        if (isinstance(record, DataEnd) or (isinstance(record, Header) and offset != MAGIC_SIZE)
                or (opcode in _SUMMARY_KINDS and (self._has_limit or extra))):
            raise DamagedError('it has no place there')
        if isinstance(record, Chunk):
            return ScannedRecord(opcode, offset, end, record, raw, self._open(offset, record))
        if isinstance(record, Metadata):
            self._metadata_bytes += len(raw)
            check_declared(self._metadata_bytes)
        elif isinstance(record, Schema | Channel):
            known = self._declare(offset, record)
            if known != record:
                record, raw = known, record_bytes(known)
        return ScannedRecord(opcode, offset, end, record, raw)

    def _check_extra(self, extra: int, end: int) -> None:
        # Nothing but what follows proves that bytes behind the known fields belong to the record.
        if extra and (self._ours or not self._finder.is_record(end)):
            raise DamagedError('its length is not that of its content')

    def _open(self, offset: int, chunk: Chunk) -> ChunkContents:
        contents = open_chunk(chunk, self.source.max_bytes)
        declared = [self._declare(offset, record) for record in contents.declared]
        contents.right = declared == contents.declared and all(
            self._summary.knows(record.id) for record in declared if isinstance(record, Channel))
        if contents.entries and time_span(contents.entries) != (
                chunk.message_start_time, chunk.message_end_time):
            self._defects.append(f'the chunk at byte {offset} has wrong times in its head')
            contents.right = False
        return contents

    def _scan_message(self, offset: int, raw: bytes) -> ScannedRecord:
        contents = break_up(raw)
        if self._all_in_chunks:
            raise DamagedError('all messages of the file are in chunks')
        end = offset + len(raw)
        # Nothing in a message proves its length but the record that follows, perhaps truncated.
        if end < self._limit and not 0 < self.source.read(end, 1)[0] <= Opcode.DATA_END:
            self.source.head(end, self._limit)
        return ScannedRecord(Opcode.MESSAGE, offset, end, raw=raw, contents=contents)

    def _scan_attachment(self, offset: int, end: int) -> ScannedRecord:
        index, crc_offset = self.source.attachment(offset, end)
        self._check_extra(end - crc_offset - 4, end)
        crc = int.from_bytes(self.source.read(crc_offset, 4), 'little')
        if crc not in (0, self.source.crc(offset + HEAD.size, crc_offset)):
            raise DamagedError('its checksum is wrong')
        return ScannedRecord(Opcode.ATTACHMENT, offset, end, index)

    def _declare(self, offset: int, record: Schema | Channel) -> Schema | Channel:
        """Make a schema or channel known, and return what is right about it."""
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if record.id not in known:
            self._summary.declared_bytes += len(record_bytes(record))
            check_declared(self._summary.declared_bytes)
        right: Schema | Channel = known.setdefault(record.id, record)
        if right != record:
            self._defects.append(f'the {type(record).__name__.lower()} {record.id} at byte '
                                 f'{offset} is not what the file says elsewhere')
        return right

    def _count(self, offset: int, contents: ChunkContents) -> None:
        """Count messages, and leave out those of unknown channels."""
        unknown = {number for number in contents.entries if not self._summary.knows(number)}
        for message in contents.messages() if unknown or self._ours else ():
            number = message.channel_id
            if number in unknown:
                loss = self._unknown.setdefault(number, Loss(
                    offset, 0, f'messages of channel {number}',
                    'the record of their channel or schema is lost', messages=0))
                loss.bytes += len(message.data)
                loss.messages = (loss.messages or 0) + 1
            elif self._ours:
                gap = (message.sequence - self._next_sequence.get(number, 0)) & 0xFFFFFFFF
                if gap < 1 << 31:  # else it is out of order
                    self._gaps[number] += gap
                    self._next_sequence[number] = message.sequence + 1
        for number in unknown:
            del contents.entries[number]
            contents.right = False
        for number, entries in contents.entries.items():
            self._found[number] += len(entries) // 2
        if contents.entries:
            start_ns, end_ns = time_span(contents.entries)
            self._start_ns = min(self._start_ns, start_ns)
            self._end_ns = max(self._end_ns, end_ns)

    # Message indexes

    def _check_indexes(self, offset: int, entries: Entries) -> int:
        """Compare the message indexes behind a chunk with it, and return where they end."""
        expected = message_indexes(entries)
        for begin, end, channel_id, found in self._indexes(offset):
            # The entries may be in any order, and a channel without messages may have an index.
            wanted = entries.get(channel_id, array('Q'))
            if found and found != wanted and sorted(found) != sorted(wanted):
                self._defects.append(f'the message index at byte {begin} is wrong')
            expected.pop(channel_id, None)
            offset = end
        # What is left of those expected is damaged, or was not written.
        kind = self.source.read(offset, 1)
        if not expected or (kind != _INDEX_KIND and self._finder.is_record(offset) and not any(
                self.source.read(offset + 1, len(raw) - 1) == raw[1:]  # but for its kind
                for raw in expected.values())):
            return offset
        end = offset + sum(map(len, expected.values()))
        if end > self._limit and kind == _INDEX_KIND and not self._summary.closed:
            end = self._limit
        elif not self._finder.is_record(end):
            return offset
        self._defects.append(f'the message index at byte {offset} is wrong')
        return end

    def _indexes(self, offset: int) -> Iterator[tuple[int, int, int, array[int]]]:
        """Yield the message indexes that follow one another: begin, end, channel, entries."""
        with contextlib.suppress(DamagedError):
            while self.source.read(offset, 1) == _INDEX_KIND:
                _, end = self.source.head(offset, self._next_place(offset))
                channel_id, entries, extra = parse_message_index(self.source.raw(offset, end))
                self._check_extra(extra, end)
                yield offset, end, channel_id, entries
                offset = end

    # Damage

    def _skip(self, offset: int, damage: DamagedError) -> int:
        """Note what is damaged, and return where the scan goes on."""
        opcode = self.source.read(offset, 1)[0]
        with contextlib.suppress(DamagedError):
            _, end = self.source.head(offset, self._next_place(offset))
            if self._finder.is_record(end):
                loss = self._lose(offset, end, opcode, damage)
                if loss.what == name_of(Opcode.CHUNK):
                    # Its indexes tell what it held.
                    for _, index_end, channel_id, entries in self._indexes(end):
                        end = index_end
                        loss.messages = (loss.messages or 0) + len(entries) // 2
                        self._in_lost_chunks[channel_id] += len(entries) // 2
                return end
        end = (self._next_place(offset) if self._summary.indexes_all_chunks
               else self._finder.find(offset + 1))
        if end == self._limit and not self._summary.closed:
            if self._is_redundant(offset, opcode):
                return end
            if 0 < opcode <= Opcode.DATA_END and type(damage) is DamagedError:
                damage = DamagedError('the file ends within it')
        self._lose(offset, end, opcode, damage)
        return end

    def _lose(self, offset: int, end: int, opcode: int, damage: DamagedError) -> Loss:
        index = self._summary.chunks.get(offset)
        loss = Loss(offset, end - offset, name_of(opcode if index is None else Opcode.CHUNK),
                    str(damage), refused=isinstance(damage, TooLargeError))
        self._losses.append(loss)
        if index is not None:
            loss.start_ns, loss.end_ns = index.message_start_time, index.message_end_time
        elif opcode == Opcode.CHUNK:
            times = self.source.read(offset + HEAD.size, _TIMES.size)
            start_ns, end_ns = _TIMES.unpack(times) if len(times) == _TIMES.size else (0, 0)
            if 0 < start_ns <= end_ns:
                loss.start_ns, loss.end_ns = start_ns, end_ns
        return loss

    def _is_redundant(self, offset: int, opcode: int) -> bool:
        """Return whether a truncated record tells nothing of its own."""
        if opcode == Opcode.METADATA:
            name = record_bytes(Metadata(BAG_METADATA, {}))[HEAD.size:-4]
            return name.startswith(self.source.read(offset + HEAD.size, len(name)))
        return opcode == Opcode.DATA_END or opcode in _SUMMARY_KINDS

    def _next_place(self, offset: int) -> int:
        """Return where the next record stands that the summary indexes, or the limit."""
        i = bisect.bisect_right(self._place_offsets, offset)
        return self._place_offsets[i] if i < len(self._place_offsets) else self._limit

    def _check_end(self, offset: int) -> None:
        """Look at what ends the data section, and for what no record shows to be lost."""
        end = self.source.record(offset, self._limit, DataEnd)
        if end is not None and not self._losses and not self._defects and (
                end.data_section_crc not in (0, self.source.crc(0, offset))):
            self._losses.append(Loss(0, 0, 'something besides the messages',
                                     'the checksum of the data section is wrong'))
        if self._summary.problem:
            self._defects.append(self._summary.problem)
        if self._summary.closed and end is None:
            self._defects.append('the end of the data section is damaged')
        statistics = self._summary.statistics
        if statistics is not None and not self._losses and not self._unknown and (
                statistics.message_count > self._found.total()):
            self._losses.append(Loss(0, 0, 'messages', 'the statistics count more than there are'))
