# SPDX-License-Identifier: Apache-2.0
"""
Scans the data section of an MCAP file from record to record, around what is damaged.

A *loss* is a part that is not used.  A *defect* is wrong, but known from elsewhere in the file.

found by        what the file has                                  told as          what is kept
--------------  -------------------------------------------------  ---------------  -------------
__iter__        first eight bytes that are not MCAP's              defect           all
_declare        two different declarations of a schema or channel  defect           the first
_open_chunk     a chunk with wrong times in its head               defect           its messages
_check_indexes  a message index that is damaged or wrong           defect           its chunk
_skip           a damaged record, or one that has no place there   loss             all others
_skip           a record that is larger than `max_bytes`           loss, refused    all others
_skip           the end of the file within a record                loss             all before
_skip           the same in bag metadata, data end or summary      truncated        all before
_MessageCounts  messages of a channel that nothing declares        loss, counted    all others
_check_end      an end of the file or a summary that is damaged    defect           all
_check_end      no data end before a whole footer                  defect           all
_check_end      a wrong checksum of a section without all these    loss of 0 bytes  all
_check_end      fewer messages than the statistics count, no loss  loss of 0 bytes  all

Schemas and channels of a usable summary come before those in the data section.

Behind a damaged record the scan goes on where its length leads, if another record is there.
Otherwise it goes on at the next record that the summary indexes, if this has all chunks, or at
the next one that `RecordFinder` finds.

Records of unknown kinds are no damage: they belong to applications or to later versions of the
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

from spinning_top_sim.recording import records
from spinning_top_sim.recording.chunks import Entries, message_indexes, time_span
from spinning_top_sim.recording.damage import Damage, Loss
from spinning_top_sim.recording.mcap_writer import record_bytes
from spinning_top_sim.recording.records import HEAD, ChunkContents, DamagedError, TooLargeError
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.source import MAGIC_SIZE, McapSource, RecordFinder, Summary

_CHUNK_TIMES = struct.Struct('<QQ')     # behind the head of a chunk
_DATA_END_SIZE = HEAD.size + 4
_SUMMARY_KINDS = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                  Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER)
_INDEX_KIND = bytes([Opcode.MESSAGE_INDEX])


@dataclass(frozen=True)
class ScannedRecord:
    """A usable record of the data section."""

    opcode: int             # above DATA_END: of an application, or of a later version of MCAP
    offset: int             # in the file
    end: int
    # Of a schema or channel the version that is valid, of an attachment its index.  None for
    # single messages, message indexes and unknown kinds.
    record: McapRecord | None = None
    raw: bytes = b''    # of a record, with head and extra fields; b'' for attachments
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
        self._limit_is_summary = not summary.problem   # else the end of the file
        self._finder = RecordFinder(source, self._limit)
        self._indexed: dict[int, int] = {}      # opcodes by offset, of records in the summary
        for offset, opcode, length in summary.places:
            # Where neither kind nor length is right, the index is wrong and not the record.
            head = source.read(offset, HEAD.size)
            right = HEAD.pack(opcode, (length - HEAD.size) % (1 << 64))
            if head[:1] == right[:1] or head[1:] == right[1:]:
                self._indexed[offset] = opcode
        self._indexed_offsets = sorted(self._indexed)
        self._metadata_bytes = 0
        self._counts = _MessageCounts(summary, ours=ours)
        self._losses: list[Loss] = []
        self._defects: list[str] = []

    def __iter__(self) -> Iterator[ScannedRecord]:
        if self.source.read(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        offset = MAGIC_SIZE
        # Behind a data end that is damaged: the records of a summary are not yielded, and damage
        # among them ends the scan.
        in_summary = False
        # The last bytes before a known end can only be the data end.
        while offset < self._limit - (_DATA_END_SIZE if self._limit_is_summary else 0):
            try:
                scanned = self._read(offset)
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
                self._counts.count(scanned.offset, scanned.contents)
            yield scanned
        self._check_end(offset)

    @property
    def found_late(self) -> bool:
        """Whether a channel became known behind messages of it, so that another scan helps."""
        return any(map(self._summary.knows, self._counts.unknown))

    def damage(self) -> Damage:
        """Return what was found; call it after the scan."""
        counts = self._counts
        losses = sorted([*self._losses, *counts.unknown.values()], key=lambda loss: loss.offset)
        return Damage(not self._summary.closed, tuple(losses), tuple(self._defects),
                      counts.missing(lossless=not losses), self._summary.statistics is not None,
                      counts.start_ns if counts.found else 0, counts.end_ns)

    # ---------------------------------------------------- records; damaged ones raise DamagedError

    def _read(self, offset: int) -> ScannedRecord | None:
        """Return the record there with all of its messages, None where the data section ends."""
        opcode, end = self.source.head(offset, self._limit)
        if self._indexed.get(offset, opcode) != opcode or end > self._next_indexed(offset):
            raise DamagedError('the summary tells of another record there')
        records.check_size(end - offset - HEAD.size, self.source.max_bytes)
        if opcode == Opcode.ATTACHMENT:
            return self._read_attachment(offset, end)
        if opcode > Opcode.DATA_END:
            if self._ours:
                raise DamagedError('there is no such kind of record')
            return ScannedRecord(opcode, offset, end)
        raw = self.source.raw(offset, end)
        if opcode == Opcode.MESSAGE:
            return self._read_message(offset, raw)
        if opcode == Opcode.MESSAGE_INDEX:      # not behind its chunk
            _, entries, extra = records.parse_message_index(raw)
            self._check_extra(extra, end)
            if entries:
                if not self._finder.is_record(end):
                    raise DamagedError('its length is not that of its content')
                self._defects.append(f'the message index at byte {offset} is wrong')
            return ScannedRecord(opcode, offset, end)
        record, extra = records.parse(raw)
        self._check_extra(extra, end)
        if isinstance(record, DataEnd) and (
                end == self._limit if self._limit_is_summary else not extra):
            return None
        # Without extra fields, what belongs to a summary is no chunk of a damaged kind.
        if (isinstance(record, DataEnd) or (isinstance(record, Header) and offset != MAGIC_SIZE)
                or (opcode in _SUMMARY_KINDS and (self._limit_is_summary or extra))):
            raise DamagedError('it has no place there')
        if isinstance(record, Chunk):
            contents = self._open_chunk(offset, record)
            return ScannedRecord(opcode, offset, end, record, raw, contents)
        if isinstance(record, Metadata):
            self._metadata_bytes += len(raw)
            records.check_declared(self._metadata_bytes)
        elif isinstance(record, Schema | Channel):
            known = self._declare(offset, record)
            if known != record:
                record, raw = known, record_bytes(known)
        return ScannedRecord(opcode, offset, end, record, raw)

    def _read_attachment(self, offset: int, end: int) -> ScannedRecord:
        index, crc_offset = self.source.attachment(offset, end)
        self._check_extra(end - crc_offset - 4, end)
        crc = int.from_bytes(self.source.read(crc_offset, 4), 'little')
        if crc not in (0, self.source.crc(offset + HEAD.size, crc_offset)):
            raise DamagedError('its checksum is wrong')
        return ScannedRecord(Opcode.ATTACHMENT, offset, end, index)

    def _read_message(self, offset: int, raw: bytes) -> ScannedRecord:
        contents = records.break_up(raw)
        if self._all_in_chunks:
            raise DamagedError('all messages of the file are in chunks')
        end = offset + len(raw)
        # Nothing in a message proves its length but the record that follows, perhaps truncated.
        if end < self._limit and not 0 < self.source.read(end, 1)[0] <= Opcode.DATA_END:
            self.source.head(end, self._limit)
        return ScannedRecord(Opcode.MESSAGE, offset, end, contents=contents)

    def _open_chunk(self, offset: int, chunk: Chunk) -> ChunkContents:
        contents = records.open_chunk(chunk, self.source.max_bytes)
        declared = [self._declare(offset, record) for record in contents.declared]
        contents.right &= declared == contents.declared and all(
            self._summary.knows(record.id) for record in declared if isinstance(record, Channel))
        if contents.entries and time_span(contents.entries) != (
                chunk.message_start_time, chunk.message_end_time):
            self._defects.append(f'the chunk at byte {offset} has wrong times in its head')
            contents.right = False
        return contents

    def _declare(self, offset: int, record: Schema | Channel) -> Schema | Channel:
        """Make a schema or channel known, and return what is right about it."""
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if record.id not in known:
            self._summary.declared_bytes += len(record_bytes(record))
            records.check_declared(self._summary.declared_bytes)
        right: Schema | Channel = known.setdefault(record.id, record)
        if right != record:
            self._defects.append(f'the {type(record).__name__.lower()} {record.id} at byte '
                                 f'{offset} is not what the file says elsewhere')
        return right

    def _check_extra(self, extra: int, end: int) -> None:
        # Nothing but what follows proves that bytes behind the known fields belong to the record.
        if extra and (self._ours or not self._finder.is_record(end)):
            raise DamagedError('its length is not that of its content')

    # ---------------------------------------------------------------- message indexes of a chunk

    def _check_indexes(self, offset: int, entries: Entries) -> int:
        """Compare the message indexes behind a chunk with it, and return where they end."""
        expected = message_indexes(entries)
        for begin, end, channel_id, found in self._indexes(offset):
            # The entries may be in any order, and a channel without messages may have an index.
            wanted = entries.get(channel_id, array('Q'))
            if found and found != wanted and sorted(found) != sorted(wanted):
                if not self._finder.is_record(end):
                    break       # bytes are missing in it, or too many
                self._defects.append(f'the message index at byte {begin} is wrong')
            expected.pop(channel_id, None)
            offset = end
        # What is left of those expected is damaged, or was not written.
        kind = self.source.read(offset, 1)
        only_kind_is_wrong = any(self.source.read(offset + 1, len(raw) - 1) == raw[1:]
                                 for raw in expected.values())
        other_record = kind != _INDEX_KIND and self._finder.is_record(offset)
        if not expected or (other_record and not only_kind_is_wrong):
            return offset
        end = offset + sum(map(len, expected.values()))
        if end > self._limit and kind == _INDEX_KIND and not self._summary.closed:
            end = self._limit
        elif not self._finder.is_record(end):
            # Bytes are missing in it if another record begins before.
            following = self._finder.find(offset, end + 1)
            if following > end:
                return offset
            end = following
        self._defects.append(f'the message index at byte {offset} is wrong')
        return end

    def _indexes(self, offset: int) -> Iterator[tuple[int, int, int, array[int]]]:
        """Yield the message indexes that follow one another: begin, end, channel, entries."""
        with contextlib.suppress(DamagedError):
            while self.source.read(offset, 1) == _INDEX_KIND:
                _, end = self.source.head(offset, self._next_indexed(offset))
                channel_id, entries, extra = records.parse_message_index(
                    self.source.raw(offset, end))
                self._check_extra(extra, end)
                yield offset, end, channel_id, entries
                offset = end

    # -------------------------------------------------------------------------- damaged records

    def _skip(self, offset: int, damage: DamagedError) -> int:
        """Note the loss of a damaged record, and return where the scan goes on."""
        opcode = self.source.read(offset, 1)[0]
        end = self._proven_end(offset)
        length_is_right = end is not None
        if end is None:
            end = (self._next_indexed(offset) if self._summary.indexes_all_chunks
                   else self._finder.find(offset + 1))
            if end == self._limit and not self._summary.closed:
                if self._only_repeats(offset, opcode):
                    return end
                if 0 < opcode <= Opcode.DATA_END and type(damage) is DamagedError:
                    damage = DamagedError('the file ends within it')

        index = self._summary.chunks.get(offset)
        what = records.name_of(opcode if index is None else Opcode.CHUNK)
        loss = Loss(offset, end - offset, what, str(damage),
                    refused=isinstance(damage, TooLargeError))
        self._losses.append(loss)
        if index is not None:
            loss.start_ns, loss.end_ns = index.message_start_time, index.message_end_time
        elif opcode == Opcode.CHUNK:
            with contextlib.suppress(struct.error):     # where the file ends within them
                start_ns, end_ns = _CHUNK_TIMES.unpack(
                    self.source.read(offset + HEAD.size, _CHUNK_TIMES.size))
                if 0 < start_ns <= end_ns:
                    loss.start_ns, loss.end_ns = start_ns, end_ns
        if length_is_right and what == records.name_of(Opcode.CHUNK):
            # Its indexes tell what it held.
            for _, index_end, channel_id, entries in self._indexes(end):
                end = index_end
                loss.messages = (loss.messages or 0) + len(entries) // 2
                self._counts.in_lost_chunks[channel_id] += len(entries) // 2
        return end

    def _proven_end(self, offset: int) -> int | None:
        """Return where a damaged record ends if another one is there, else None."""
        with contextlib.suppress(DamagedError):
            _, end = self.source.head(offset, self._next_indexed(offset))
            if self._finder.is_record(end):
                return end
        return None

    def _only_repeats(self, offset: int, opcode: int) -> bool:
        """Return whether a truncated record tells nothing of its own."""
        if opcode == Opcode.METADATA:
            name = record_bytes(Metadata(BAG_METADATA, {}))[HEAD.size:-4]
            return name.startswith(self.source.read(offset + HEAD.size, len(name)))
        return opcode == Opcode.DATA_END or opcode in _SUMMARY_KINDS

    def _next_indexed(self, offset: int) -> int:
        """Return where the next record stands that the summary indexes, or the limit."""
        i = bisect.bisect_right(self._indexed_offsets, offset)
        return self._indexed_offsets[i] if i < len(self._indexed_offsets) else self._limit

    # ------------------------------------------------------------------- end of the data section

    def _check_end(self, offset: int) -> None:
        """Look at what ends the data section, and for what no record shows to be lost."""
        end = self.source.record(offset, self._limit, DataEnd)
        if end is not None and not self._losses and not self._defects and (
                end.data_section_crc not in (0, self.source.crc(0, offset))):
            self._losses.append(Loss(0, 0, 'something besides the messages',
                                     'the checksum of the data section is wrong'))
        if end is not None and not self._limit_is_summary:
            self._look_behind(offset + _DATA_END_SIZE)
        if self._summary.problem:
            self._defects.append(self._summary.problem)
        if self._summary.closed and end is None:
            self._defects.append('the end of the data section is damaged')
        statistics = self._summary.statistics
        if statistics is not None and not self._losses and not self._counts.unknown and (
                statistics.message_count > self._counts.found.total()):
            self._losses.append(Loss(0, 0, 'messages', 'the statistics count more than there are'))

    def _look_behind(self, offset: int) -> None:
        """Tell of another log behind the end of this one; a summary has no chunks."""
        while (offset := self._finder.find(offset)) < self._limit:
            if self.source.read(offset, 1)[0] == Opcode.CHUNK:
                self._losses.append(Loss(offset, self._limit - offset, 'another log',
                                         'it stands behind the end of this one'))
                return
            offset += 1


class _MessageCounts:
    """Counts by channel id the messages that a scan finds, and those that the log has lost."""

    def __init__(self, summary: Summary, *, ours: bool) -> None:
        self._summary = summary
        self._ours = ours       # numbered without gaps
        self.found: Counter[int] = Counter()    # without those of unknown channels
        self.unknown: dict[int, Loss] = {}      # of channels that nothing has declared so far
        self.in_lost_chunks: Counter[int] = Counter()   # by their message indexes
        self.start_ns, self.end_ns = 1 << 64, 0     # earliest and latest log time of those found
        self._gaps: Counter[int] = Counter()    # in the sequence numbers
        self._next_sequence: dict[int, int] = {}

    def count(self, offset: int, contents: ChunkContents) -> None:
        """Count messages, and remove those of unknown channels."""
        unknown = {number for number in contents.entries if not self._summary.knows(number)}
        for message in contents.messages() if unknown or self._ours else ():
            number = message.channel_id
            if number in unknown:
                loss = self.unknown.setdefault(number, Loss(
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
            self.found[number] += len(entries) // 2
        if contents.entries:
            start_ns, end_ns = time_span(contents.entries)
            self.start_ns = min(self.start_ns, start_ns)
            self.end_ns = max(self.end_ns, end_ns)

    def missing(self, *, lossless: bool) -> dict[str, int]:
        """Return the lost messages by topic; '' stands for topics that nothing declares."""
        if self._summary.statistics is None:
            lost = (self._gaps | self.in_lost_chunks) + Counter(
                {number: loss.messages or 0 for number, loss in self.unknown.items()})
        else:
            lost = Counter(self._summary.statistics.channel_message_counts)
            lost.subtract(self.found)
            if lossless:
                # A whole file that was made of a truncated one still tells what that had lost.
                lost.update(self._gaps)
        missing: Counter[str] = Counter()
        for number, messages in sorted((+lost).items()):
            known = self._summary.knows(number)
            missing[self._summary.channels[number].topic if known else ''] += messages
        return dict(missing)
