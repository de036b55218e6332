# SPDX-License-Identifier: Apache-2.0
"""Finds where records begin in a file that does not tell it."""

import re

from mcap.opcode import Opcode
from mcap.records import Chunk

from spinning_top_sim.recording import records
from spinning_top_sim.recording.chunks import MESSAGE_FIELDS
from spinning_top_sim.recording.records import HEAD, DamagedError, TooLargeError
from spinning_top_sim.recording.summary import McapSource

# What may begin a chunk, a schema, a channel or metadata: opcode and a length below 2^40.
_CANDIDATE = re.compile(rb'[\x03\x04\x06\x0c](?=.{5}\x00\x00\x00)', re.DOTALL)
# Where the length of the first text is in the content; a chunk's is followed by that of the data.
_NAME_OFFSETS: dict[int, int] = {
    Opcode.SCHEMA: 2, Opcode.CHANNEL: 4, Opcode.METADATA: 0, Opcode.CHUNK: 28}

_LOOK_BYTES = 64                # of the content, enough for a chunk's fields before its data
_MAX_NAME = 1 << 12
_MAX_EXTRA = 1 << 10
_BLOCK = 1 << 16                # searched at a time
_MAX_EFFORT = 4                 # bytes of candidates read, as a multiple of the file's size


class RecordFinder:
    """
    Finds records that prove themselves by their inner lengths and, if chunks, their checksum.

    limit : where the data section ends
    """

    def __init__(self, source: McapSource, limit: int) -> None:
        self._source = source
        self._limit = limit
        # Bytes of candidates to be read and to be uncompressed, so that the time is limited.
        self._effort = _MAX_EFFORT * source.size
        self._unpacking = _MAX_EFFORT * (source.size + source.max_bytes)

    def is_record(self, offset: int) -> bool:
        """Return whether a record of a known kind begins there, or the data section ends."""
        try:
            opcode, end = self._source.head(offset, self._limit)
            while opcode > Opcode.DATA_END:
                offset = end
                opcode, end = self._source.head(offset, self._limit)
            if opcode == Opcode.MESSAGE:
                return end - offset >= HEAD.size + MESSAGE_FIELDS
            if opcode in _NAME_OFFSETS:
                return self._is_proven(opcode, offset, end)
            if opcode == Opcode.ATTACHMENT:
                self._source.attachment(offset, end)
            elif opcode == Opcode.MESSAGE_INDEX:
                records.parse_message_index(self._source.raw(offset, end))
            else:
                records.parse(self._source.raw(offset, end))
        except TooLargeError:
            return opcode == Opcode.CHUNK
        except DamagedError:
            return offset == self._limit
        return True

    def find(self, offset: int) -> int:
        """
        Return where the next chunk, schema, channel or metadata begins, or the limit.

        Single messages are not looked for: nothing in them tells them from chance.
        """
        while offset < self._limit:
            block = self._source.read(offset, _BLOCK + HEAD.size)
            for match in _CANDIDATE.finditer(block, 0, _BLOCK + HEAD.size - 1):
                place = offset + match.start()
                if self.is_record(place):
                    return place
            offset += _BLOCK
        return self._limit

    def _is_proven(self, opcode: int, offset: int, end: int) -> bool:
        """Return whether it is a chunk, schema, channel or metadata; raises DamagedError."""
        # First what needs no more than a look: most candidates are none.
        start = offset + HEAD.size
        if not _looks_right(opcode, end - start, self._source.read(start, _LOOK_BYTES)):
            return False
        self._effort -= end - start
        if self._effort < 0:
            return False
        record, _ = records.parse(self._source.raw(offset, end))
        if not isinstance(record, Chunk):
            return True
        self._unpacking -= record.uncompressed_size
        if self._unpacking < 0:
            return False
        contents = records.open_chunk(record, self._source.max_bytes)
        return bool(contents.entries or contents.declared)      # zeros look like an empty chunk


def _looks_right(opcode: int, length: int, start: bytes) -> bool:
    """Return whether a chunk, schema, channel or metadata of this length may start so."""
    name_start = _NAME_OFFSETS[opcode] + 4
    name_size = int.from_bytes(start[name_start - 4:name_start], 'little')
    if opcode == Opcode.CHUNK:
        data_start = name_start + name_size + 8
        data_size = int.from_bytes(start[data_start - 8:data_start], 'little')
        return 0 <= length - data_start - data_size <= _MAX_EXTRA
    return 0 < name_size < _MAX_NAME and length <= records.MAX_DECLARED
