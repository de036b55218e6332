# SPDX-License-Identifier: Apache-2.0
"""
Scans the data section of an MCAP file from record to record, around what is damaged.

Behind damage the scan goes on at the record to which the damaged one's length leads, or else at
the next chunk, schema, channel or metadata that can be decoded.
"""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import parsing
from spinning_top_sim.recording.chunks import time_span
from spinning_top_sim.recording.damage import Damage, Loss, count
from spinning_top_sim.recording.log_file import MAGIC_SIZE, LogFile, Summary, known_topics
from spinning_top_sim.recording.parsing import HEAD, DamagedError, Messages, check_size

_DATA_END_SIZE = HEAD.size + 4
_RUN_BYTES = 1 << 20    # of messages outside of chunks that are read at a time
_BLOCK = 1 << 16        # bytes searched at a time
# What may begin a record that is searched: opcode, a length below 2^40, and behind the fields of
# fixed size a name of less than 2^16 bytes; of a chunk, a compression, or one size twice.  Offsets
# in the record, of which the expression, that stands behind the opcode, has one less:
#   03 schema: name 11; 04 channel: topic 13; 0c metadata: name 9
#   06 chunk: uncompressed size 25, checksum 33, compression 37, size of the records 41 without one
# Single messages are not looked for: nothing in them tells them from chance.
_CANDIDATE = re.compile(
    rb'[\x03\x04\x06\x0c](?=.{5}\0{3})(?:'
    rb'(?<=\x03)(?=.{10}..\0\0)|(?<=\x04)(?=.{12}..\0\0)|(?<=\x0c)(?=.{8}..\0\0)|'
    rb'(?<=\x06)(?=.{24}(?!\0{8})(.{8}).{4}\0{4}\1|.{36}(?:\x03\0{3}lz4|\x04\0{3}zstd)))',
    re.DOTALL)
_CANDIDATE_BYTES = HEAD.size + 28 + 4 + 8       # that the expression looks at
_SEARCHED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.CHUNK)
_MAX_EFFORT = 4         # bytes of candidates read, as a multiple of the file's size


class Part(NamedTuple):
    """A chunk, adjacent messages outside of chunks, metadata or an attachment."""

    opcode: int
    offset: int
    end: int
    channel_ids: frozenset[int] = frozenset()   # of its messages
    start_ns: int = 0                           # their earliest log time
    end_ns: int = 0                             # the latest


@dataclass
class Index:
    """Where the messages of a log are, and what it says of them."""

    parts: list[Part]                       # in file order
    metadata: dict[str, dict[str, str]]     # by name
    schemas: dict[int, Schema]              # by id
    channels: dict[int, Channel]

    @cached_property
    def topics(self) -> dict[int, str]:
        """The topics, by channel id, of channels whose schema is there, or that have none."""
        return known_topics(self.schemas, self.channels)


class _Decoded(NamedTuple):
    """A record and the messages in it; or the number of entries of a message index."""

    record: McapRecord | None = None
    messages: Messages = Messages(b'')
    index_entries: int | None = None


class Scan:
    """
    All that can be decoded of the data section, and the damage of the file.

    ours : whether this package wrote the file: all messages are in chunks, all kinds are known
    progress : is called with the offset that is reached
    """

    def __init__(self, file: LogFile, summary: Summary, *, ours: bool,
                 progress: Callable[[int], object] = lambda offset: None) -> None:
        self.index = Index([], {}, summary.schemas.copy(), summary.channels.copy())
        self._file = file
        self._summary = summary
        self._ours = ours
        self._all_in_chunks = ours or summary.indexes_all_messages
        self._limit = summary.data_limit
        self._losses: list[Loss] = []
        self._defects: list[str] = []
        self._found: Counter[int] = Counter()   # messages by channel id
        self._lost = 0                  # messages of lost chunks, by their message indexes
        self._behind_chunk = False      # only message indexes since the last chunk
        self._is_proven = True          # all messages are in chunks with checksums
        self._small_bytes = 0           # of schemas, channels and metadata
        # Bytes of candidates that may be read and unpacked, so that a search ends in time.
        self._effort = _MAX_EFFORT * file.size
        self._unpacking = _MAX_EFFORT * (file.size + file.max_bytes)

        if file.read(0, MAGIC_SIZE) != MCAP0_MAGIC:
            self._defects.append('the first eight bytes are not those of an MCAP file')
        self._walk(progress)
        self.damage = self._damage()

    def _walk(self, progress: Callable[[int], object]) -> None:
        offset = MAGIC_SIZE
        # Where a summary or a footer tells the end, the last bytes can only be the data end.
        end_is_known = not self._summary.problem
        limit = self._limit - _DATA_END_SIZE * end_is_known
        while offset < limit:
            progress(offset)
            try:
                opcode, end = self._file.head(offset, self._limit)
                if opcode == Opcode.DATA_END and (
                        end == self._limit if end_is_known else end - offset == _DATA_END_SIZE):
                    break
                end = self._take(opcode, offset, end)
            except DamagedError as damage:
                end = self._skip(offset, damage)
            offset = end
        self._check_end(offset)

    def _take(self, opcode: int, offset: int, end: int) -> int:
        """Note what is in a record, and return where the next one begins."""
        record, messages, index_entries = self._decode(opcode, offset, end)
        end = self._true_end(record, offset, end)
        if index_entries is not None:
            self._lost += 0 if self._behind_chunk else index_entries
            return end
        self._behind_chunk = opcode == Opcode.CHUNK
        if isinstance(record, Schema | Channel | Metadata):
            self._small_bytes += end - offset
            check_size(self._small_bytes, parsing.MAX_DECLARED)
        for declared in (record, *messages.declared):
            if isinstance(declared, Schema):
                self.index.schemas.setdefault(declared.id, declared)
            elif isinstance(declared, Channel):
                self.index.channels.setdefault(declared.id, declared)
        if isinstance(record, Metadata):
            self.index.metadata[record.name] = record.metadata
        if messages.entries:
            self._is_proven &= isinstance(record, Chunk) and record.uncompressed_crc != 0
            self._add(opcode, offset, end, messages)
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            self.index.parts.append(Part(opcode, offset, end))
        return end

    def _decode(self, opcode: int, offset: int, end: int) -> _Decoded:
        if opcode > Opcode.DATA_END:    # of an application, or of a later version of the format
            if self._ours:
                raise DamagedError('there is no such kind of record')
            check_size(end - offset - HEAD.size, self._file.max_bytes)
            return _Decoded()
        raw = self._file.raw(offset, end)
        if opcode == Opcode.MESSAGE_INDEX:
            return _Decoded(index_entries=parsing.index_entries(raw))
        if opcode == Opcode.MESSAGE:
            if self._all_in_chunks:
                raise DamagedError('all messages of the file are in chunks')
            return _Decoded(messages=parsing.find_messages(raw))
        record = parsing.parse(raw)
        if isinstance(record, Chunk):
            return _Decoded(record, parsing.open_chunk(record, self._file.max_bytes))
        return _Decoded(record)

    def _true_end(self, record: McapRecord | None, offset: int, end: int) -> int:
        """Return the end that its fields or the next record prove; else raise DamagedError."""
        if record is not None:
            own = offset + parsing.size_of(record)
            # Such a length would take in the records that follow.
            if own < end and isinstance(record, Schema | Channel) and self._is_record(own):
                self._defects.append(f'{type(record).__name__.lower()} at byte {offset}: its '
                                     'length is wrong')
                return own
            is_right = own == end or self._is_record(end) or (
                end == self._limit and not self._summary.problem)
        else:
            is_right = end == self._limit or self._is_head(end)
        if not is_right:
            raise DamagedError('its length is not that of its content')
        return end

    def _is_head(self, offset: int) -> bool:
        """Return whether a record seems to begin there, which may be truncated."""
        head = self._file.read(offset, HEAD.size)
        opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\0'))
        return opcode > 0 and (offset + HEAD.size + length <= self._limit or (
            opcode <= Opcode.DATA_END and length <= self._file.max_bytes))

    def _add(self, opcode: int, offset: int, end: int, messages: Messages) -> None:
        """Note a part with messages, or add a message to the part that ends before it."""
        for channel_id, entries in messages.entries.items():
            self._found[channel_id] += len(entries) // 2
        part = Part(opcode, offset, end, frozenset(messages.entries), *time_span(messages.entries))
        parts = self.index.parts
        last = parts[-1] if parts else part
        if opcode == Opcode.MESSAGE == last.opcode and (
                last.end == offset < last.offset + _RUN_BYTES):
            part = Part(opcode, last.offset, end, part.channel_ids | last.channel_ids,
                        min(part.start_ns, last.start_ns), max(part.end_ns, last.end_ns))
            parts.pop()
        parts.append(part)

    # ------------------------------------------------------------------------------- damage

    def _skip(self, offset: int, damage: DamagedError) -> int:
        """Note a damaged record, and return where the next one begins, or the limit."""
        opcode = self._file.read(offset, 1)[0]
        is_chunk = opcode == Opcode.CHUNK or offset in self._summary.chunks
        is_index = opcode == Opcode.MESSAGE_INDEX and not is_chunk
        what = ('chunk' if is_chunk
                else Opcode(opcode).name.lower().replace('_', ' ') if opcode in set(Opcode)
                else 'record of unknown kind')
        try:
            _, stated_end = self._file.head(offset, self._limit)
        except DamagedError:
            stated_end = 0
        end = (stated_end if stated_end == self._limit or self._is_record(stated_end)
               else self._search(offset + 1))
        is_truncated = not stated_end and not self._summary.closed and end == self._limit
        # A recovery makes these anew; behind messages, we write no other metadata.
        is_bag = opcode == Opcode.METADATA and self._ours and self._found.total() > 0
        if is_index or (is_truncated and (opcode == Opcode.DATA_END or is_bag)):
            self._defects.append(f'{what} at byte {offset}: {damage}')
            if offset < stated_end < end:
                self._losses.append(Loss(stated_end, end - stated_end, 'something',
                                         'no record can be decoded there'))
        else:
            self._losses.append(Loss(offset, end - offset, what, str(damage), is_chunk))
        self._behind_chunk &= opcode == Opcode.MESSAGE_INDEX
        return end

    def _search(self, offset: int) -> int:
        """Return where the next record begins that can be found and decoded, or the limit."""
        while offset < self._limit:
            block = self._file.read(offset, _BLOCK + _CANDIDATE_BYTES)
            for match in _CANDIDATE.finditer(block, 0, len(block)):
                start = match.start()
                if start < _BLOCK and self._is_record(offset + start):
                    return offset + start
            offset += _BLOCK
        return self._limit

    def _is_record(self, offset: int) -> bool:
        """Return whether a record begins there that can be decoded; False without effort left."""
        try:
            opcode, end = self._file.head(offset, self._limit)
            if opcode in _SEARCHED:
                self._effort -= end - offset
            if opcode == Opcode.CHUNK:
                stated = int.from_bytes(self._file.read(offset + HEAD.size + 16, 8), 'little')
                self._unpacking -= min(stated, self._file.max_bytes)
            if self._effort < 0 or self._unpacking < 0:
                return False
            messages = self._decode(opcode, offset, end).messages
        except DamagedError:
            return False
        # Zeros look like an empty chunk.
        return opcode != Opcode.CHUNK or bool(messages.plain)

    # ------------------------------------------------------------------------- end of the scan

    def _check_end(self, offset: int) -> None:
        """Look at the checksum in the data end."""
        try:
            end = self._file.record(offset, self._limit)
        except DamagedError:
            end = None
        if not isinstance(end, DataEnd):
            if self._summary.closed:
                self._defects.append('the end of the data section is damaged')
            return
        if not self._losses and end.data_section_crc not in (0, self._file.crc(offset)):
            reason = 'the checksum of the data section is wrong'
            if self._is_proven:
                self._defects.append(reason)
            else:
                self._losses.append(Loss(0, 0, 'something', reason))

    def _damage(self) -> Damage:
        if self._summary.problem:
            self._defects.append(self._summary.problem)
        topics = self.index.topics
        found = sum(self._found[number] for number in topics)
        unknown = self._found.total() - found
        if unknown:
            self._losses.append(Loss(0, 0, count(unknown, 'message'),
                                     'no whole record declares their channels'))
        statistics = self._summary.statistics
        parts = [part for part in self.index.parts if part.channel_ids & topics.keys()]
        return Damage(
            truncated=not self._summary.closed, losses=tuple(self._losses),
            defects=tuple(self._defects),
            missing_messages=(self._lost + unknown if statistics is None
                              else max(0, statistics.message_count - found)),
            missing_exactly=statistics is not None,
            start_ns=min((part.start_ns for part in parts), default=0),
            end_ns=max((part.end_ns for part in parts), default=0))
