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
    """Appends fields in the order of the message definition; returns the offsets of numbers."""

    def __init__(self) -> None:
        self.buffer = bytearray(ENCAPSULATION)

    def _append(self, code: str, *values: float) -> int:
        """Append numbers of one type one after the other; return the first one's offset."""
        if values:
            size = struct.calcsize('<' + code)
            self.buffer += bytes(-(len(self.buffer) - len(ENCAPSULATION)) % size)
        at = len(self.buffer)
        self.buffer += struct.pack(f'<{len(values)}{code}', *values)
        return at

    def uint32(self, value: int) -> int:
        """Append a uint32."""
        return self._append('I', value)

    def int32(self, value: int) -> int:
        """Append an int32."""
        return self._append('i', value)

    def flag(self, value: bool) -> int:
        """Append a bool."""
        return self._append('?', value)

    def floats(self, values: Iterable[float]) -> int:
        """Append single precision floats (a fixed array)."""
        return self._append('f', *values)

    def doubles(self, values: Iterable[float]) -> int:
        """Append doubles (a fixed array)."""
        return self._append('d', *values)

    def double_sequence(self, values: Sequence[float]) -> int:
        """Append a sequence of doubles."""
        self.uint32(len(values))
        return self.doubles(values)

    def stamp(self) -> int:
        """Append a builtin_interfaces/Time of zero."""
        return self._append('I', 0, 0)

    def string(self, text: str) -> None:
        """Append a string."""
        data = text.encode() + b'\0'
        self.uint32(len(data))
        self.buffer += data

    def strings(self, texts: Sequence[str]) -> None:
        """Append a sequence of strings."""
        self.uint32(len(texts))
        for text in texts:
            self.string(text)

    def end(self) -> None:
        """Pad to four bytes, as RTPS does: what arrives is then what was sent."""
        self.buffer += bytes(-len(self.buffer) % 4)


class Template:
    """
    A serialized message whose stamp and numbers are replaced, many messages at a time.

    Bytes outside of stamps and fields stay as they are.

    Parameters
    ----------
    writer : CdrWriter
        The message.
    stamps_at : sequence of int
        Offsets of its stamps: none, one, or one of each part of an array.
    fields : sequence of (int, int)
        Offset and number of the doubles of each field.
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

    def encode(self, stamps_ns: NDArray[np.int64], *values: Field) -> NDArray[np.uint8]:
        """
        Return n messages as rows of bytes, valid until the next call.

        Parameters
        ----------
        stamps_ns : (n,) int64
            Stamps [ns].
        *values : Field
            The numbers of each field.

        Returns
        -------
        (n, size) uint8
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
