# SPDX-License-Identifier: Apache-2.0
"""
Serialized ROS messages (XCDR version 1, little endian), written once and patched ever after.

Format: OMG DDS-XTypes 1.3, sect. 7.4.1 and the RTPS encapsulation header: four bytes 00 01 00 00,
then every primitive aligned to its own size counted from behind that header; a string is its
length with the closing NUL, a sequence its element count, then the elements.  Padding is zero, so
equal messages are equal bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b'\x00\x01\x00\x00'
NANOSECONDS = 1_000_000_000

# The numbers of a field in n messages: an array (n, count), or `count` columns or numbers.
Field = NDArray[np.float64] | Sequence[NDArray[np.float64] | float]


class CdrWriter:
    """Appends fields in the order of the message definition; remembers nothing but the bytes."""

    def __init__(self) -> None:
        self.buffer = bytearray(ENCAPSULATION)

    def _align(self, size: int) -> int:
        """Pad to a multiple of `size`; return where the next field begins."""
        self.buffer += bytes(-(len(self.buffer) - len(ENCAPSULATION)) % size)
        return len(self.buffer)

    def end(self) -> None:
        """Pad to four bytes, as RTPS does: what arrives is then what was sent."""
        self._align(4)

    def _append(self, code: str, size: int, value: float) -> int:
        at = self._align(size)
        self.buffer += struct.pack('<' + code, value)
        return at

    def uint32(self, value: int) -> int:
        """Append a uint32; return its offset."""
        return self._append('I', 4, value)

    def int32(self, value: int) -> int:
        """Append an int32; return its offset."""
        return self._append('i', 4, value)

    def flag(self, value: bool) -> int:
        """Append a bool; return its offset."""
        return self._append('?', 1, value)

    def floats(self, values: Iterable[float]) -> int:
        """Append single precision floats one after the other; return the first one's offset."""
        at = self._align(4)
        for value in values:
            self._append('f', 4, value)
        return at

    def stamp(self) -> int:
        """Append a builtin_interfaces/Time of zero; return its offset."""
        at = self._append('i', 4, 0)
        self._append('I', 4, 0)
        return at

    def string(self, text: str) -> int:
        """Append a string; return its offset."""
        data = text.encode() + b'\0'
        at = self.uint32(len(data))
        self.buffer += data
        return at

    def strings(self, texts: Sequence[str]) -> int:
        """Append a sequence of strings; return its offset."""
        at = self.uint32(len(texts))
        for text in texts:
            self.string(text)
        return at

    def doubles(self, values: Iterable[float]) -> int:
        """Append doubles one after the other (a fixed array); return the first one's offset."""
        at = self._align(8)
        for value in values:
            self._append('d', 8, value)
        return at

    def double_sequence(self, values: Sequence[float]) -> int:
        """Append a sequence of doubles; return the first one's offset."""
        self.uint32(len(values))
        return self.doubles(values) if values else len(self.buffer)


class Template:
    """
    A serialized message whose stamp and numbers are replaced, many messages at a time.

    Parameters
    ----------
    writer : CdrWriter
        The message.
    stamps_at : offsets of its stamps: none, one, or one of each part of an array
    fields : (offset, count) of each run of doubles that is replaced

    Bytes outside of stamps and fields stay as they are.
    """

    def __init__(self, writer: CdrWriter, stamps_at: Sequence[int],
                 fields: Sequence[tuple[int, int]]) -> None:
        self._buffer = writer.buffer
        self._stamps_at = tuple(stamps_at)
        self._fields = tuple(fields)
        self._row_type = self._make_row_type()
        self._rows: NDArray[np.void] = np.empty(0, self._row_type)

    def __len__(self) -> int:
        """Return the size of every message [bytes]."""
        return len(self._buffer)

    def with_fixed(self, *values: Field) -> Template:
        """Return the message with these numbers for good: `encode` takes no fields then."""
        writer = CdrWriter()
        writer.buffer[:] = self.encode_one(0, *values)
        template = Template(writer, self._stamps_at, ())
        template._fields, template._row_type = self._fields, self._row_type
        template._rows = np.empty(0, self._row_type)
        return template

    def encode(self, stamps_ns: NDArray[np.int64], *values: Field) -> NDArray[np.uint8]:
        """
        Return n messages of equal length as rows of bytes (n, size).

        Parameters
        ----------
        stamps_ns : (n,) [ns]
        values : one for each field: an array (n, count), or `count` columns (n,) or numbers

        The rows are valid until the next call.
        """
        count = len(stamps_ns)
        if len(self._rows) < count:
            self._rows = np.empty(count, self._row_type)
            self._rows.view(np.uint8).reshape(count, len(self))[:] = np.frombuffer(
                self._buffer, np.uint8)
        rows = self._rows[:count]
        for at in self._stamps_at:
            rows[f'sec{at}'], rows[f'nanosec{at}'] = np.divmod(stamps_ns, NANOSECONDS)
        for i, value in enumerate(values):
            field = rows[f'field{i}']
            if isinstance(value, np.ndarray):
                field[:] = value
            else:
                for column, numbers in enumerate(value):
                    field[:, column] = numbers
        return rows.view(np.uint8).reshape(count, len(self))

    def encode_one(self, stamp_ns: int, *values: Field) -> bytes:
        """Return one message; see `encode`."""
        return self.encode(np.array([stamp_ns]), *values).tobytes()

    def decode(self, data: bytes) -> tuple[NDArray[np.float64], ...]:
        """Return the fields, (n, count) each, of n messages one after the other."""
        rows = np.frombuffer(data, self._row_type)
        return tuple(rows[f'field{i}'] for i in range(len(self._fields)))

    def _make_row_type(self) -> np.dtype[np.void]:
        """Return a message as a numpy type: the fields, and the stamps if there are any."""
        names = [f'field{i}' for i in range(len(self._fields))]
        formats: list[str | tuple[str, tuple[int]]] = [
            ('<f8', (number,)) for _, number in self._fields]
        offsets = [at for at, _ in self._fields]
        for at in self._stamps_at:
            names += [f'sec{at}', f'nanosec{at}']
            formats += ['<i4', '<u4']
            offsets += [at, at + 4]
        return np.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                         'itemsize': len(self._buffer)})

    def field_at(self, at: int) -> tuple[int, int, int] | None:
        """Return field, element and offset of what holds a byte: field -1 is the stamp."""
        for stamp_at in self._stamps_at:
            if 0 <= at - stamp_at < 8:
                return -1, 0, stamp_at
        for field, (begin, count) in enumerate(self._fields):
            if 0 <= at - begin < 8 * count:
                element = (at - begin) // 8
                return field, element, begin + 8 * element
        return None
