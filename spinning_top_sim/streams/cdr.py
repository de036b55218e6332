# SPDX-License-Identifier: Apache-2.0
"""
Serialized ROS messages (XCDR version 1, little endian), as templates whose numbers are replaced.

Format: OMG DDS-XTypes 1.3, sect. 7.4.1, and the RTPS encapsulation header.  After the header
00 01 00 00 every primitive is aligned to its own size, counted from the end of the header.  A
string is its length with the closing NUL, then its bytes; a sequence is the number of its
elements, then the elements.  Padding is zero, so that equal messages have equal bytes.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b'\x00\x01\x00\x00'
NANOSECONDS = 1_000_000_000
# The seconds of a stamp are an int32: the last stamp is in January 2038.
LAST_STAMP_NS = 2 ** 31 * NANOSECONDS - 1

# The numbers of a field in n messages: an array (n, count), or `count` columns or numbers.
Field = NDArray[Any] | Sequence[NDArray[Any] | float]


class Place(NamedTuple):
    """Where a field stands in a message: its name, code of `struct`, how many, and offset."""

    name: str
    code: str
    numbers: int
    offset: int


def stamp_text(time_ns: int) -> str:
    """Return a time in seconds, to the nanosecond."""
    return f'{time_ns // NANOSECONDS}.{time_ns % NANOSECONDS:09d}'


class CdrWriter:
    """
    Appends the parts of a message in the order of its definition; its methods return itself.

    stamps_at : offset of each stamp
    fields : the numbers that differ from message to message
    """

    def __init__(self) -> None:
        self.buffer = bytearray(ENCAPSULATION)
        self.stamps_at: list[int] = []
        self.fields: list[Place] = []

    def append(self, code: str, *values: float) -> Self:
        """Append numbers of one type, a format character of `struct`, aligned to its size."""
        if values:
            size = struct.calcsize('<' + code)
            self.buffer += bytes(-(len(self.buffer) - len(ENCAPSULATION)) % size)
        self.buffer += struct.pack(f'<{len(values)}{code}', *values)
        return self

    def field(self, name: str, count: int, code: str = 'd') -> Self:
        """Append a field, under its name in the definition."""
        self.append(code, *(count * (0,)))
        self.fields.append(Place(name, code, count, len(self.buffer) - count * struct.calcsize(
            '<' + code)))
        return self

    def stamp(self) -> Self:
        """Append a builtin_interfaces/Time that differs from message to message."""
        self.append('I', 0, 0)
        self.stamps_at.append(len(self.buffer) - 8)
        return self

    def string(self, *texts: str) -> Self:
        for text in texts:
            data = text.encode() + b'\0'
            self.append('I', len(data))
            self.buffer += data
        return self

    def header(self, frame_id: str) -> Self:
        """Append a std_msgs/Header: its stamp, which differs, and a frame."""
        return self.stamp().string(frame_id)


class Template:
    """
    A serialized message whose stamps and fields are replaced, many messages at a time.

    fields : in the order in which `encode` takes them
    """

    def __init__(self, writer: CdrWriter) -> None:
        # RTPS pads to four bytes; a template does so too, so that logs have what subscribers get.
        self._buffer = bytes(writer.buffer + bytes(-len(writer.buffer) % 4))
        self.fields, self._stamps_at = tuple(writer.fields), writer.stamps_at
        # A message as a type of NumPy: the fields by number, then the stamps.
        places: list[tuple[str, Any, int]] = [
            (f'{i}', (f'<{one.code}', (one.numbers,)), one.offset)
            for i, one in enumerate(self.fields)]
        for at in self._stamps_at:
            places += [(f'sec{at}', '<i4', at), (f'nanosec{at}', '<u4', at + 4)]
        names, formats, offsets = zip(*places, strict=True)
        self._row_type = np.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                                   'itemsize': len(self._buffer)})

    def __len__(self) -> int:
        return len(self._buffer)

    def encode(self, stamps_ns: NDArray[np.int64], fields: Sequence[Field]) -> NDArray[np.uint8]:
        """Return messages (n, size) with stamps (n,) [ns]."""
        count = len(stamps_ns)
        rows = np.frombuffer(bytearray(count * self._buffer), self._row_type)
        for at in self._stamps_at:
            rows[f'sec{at}'], rows[f'nanosec{at}'] = np.divmod(stamps_ns, NANOSECONDS)
        fill([rows[f'{i}'] for i in range(len(self.fields))], fields)
        return rows.view(np.uint8).reshape(count, len(self))

    def encode_one(self, stamp_ns: int, *fields: Field) -> bytes:
        return self.encode(np.array([stamp_ns]), fields).tobytes()

    def decode(self, data: bytes | NDArray[np.uint8]) -> tuple[NDArray[Any], ...]:
        """Return the fields, (n, count) each, of n concatenated messages."""
        rows = np.frombuffer(data, self._row_type)
        return tuple(rows[f'{i}'] for i in range(len(self.fields)))

    def stamps_ns(self, data: bytes) -> NDArray[np.int64]:
        """Return the stamps (n,) [ns] of n concatenated messages."""
        rows, at = np.frombuffer(data, self._row_type), self._stamps_at[0]
        stamps: NDArray[np.int64] = rows[f'sec{at}'].astype(np.int64) * NANOSECONDS
        stamps += rows[f'nanosec{at}']
        return stamps

    def shown_at(self, at: int, *messages: bytes) -> tuple[str, list[str]]:
        """Return the name of what the byte at an offset belongs to, and its value in messages."""
        for stamp_at in self._stamps_at:
            if 0 <= at - stamp_at < 8:
                return 'header.stamp', [
                    '{}.{:09d}'.format(*struct.unpack_from('<iI', one, stamp_at))
                    for one in messages]
        for name, code, count, offset in self.fields:
            size = struct.calcsize('<' + code)
            if 0 <= at - offset < count * size:
                element = (at - offset) // size
                return f'{name}[{element}]', [
                    repr(*struct.unpack_from('<' + code, one, offset + element * size))
                    for one in messages]
        return f'byte {at}', [f'0x{one[at]:02x}' for one in messages]


def fill(rows: Sequence[NDArray[Any]], fields: Sequence[Field]) -> None:
    """Fill fields (n, count) from those of n messages."""
    for row, field in zip(rows, fields, strict=True):
        if isinstance(field, np.ndarray):
            row[:] = field
        else:
            for column, numbers in zip(row.T, field, strict=True):
                column[:] = numbers
