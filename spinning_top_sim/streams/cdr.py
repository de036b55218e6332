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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b'\x00\x01\x00\x00'
NANOSECONDS = 1_000_000_000
# The seconds of a stamp are an int32: the last stamp is in January 2038.
LAST_STAMP_NS = 2 ** 31 * NANOSECONDS - 1

# The numbers of a field in n messages: an array (n, count), or `count` columns or numbers.
Values = NDArray[Any] | Sequence[NDArray[Any] | float]


def stamp_text(time_ns: int) -> str:
    """Return a time in seconds, to the nanosecond."""
    return f'{time_ns // NANOSECONDS}.{time_ns % NANOSECONDS:09d}'


class Field(NamedTuple):
    """Numbers that differ from message to message: name in the definition, how many, type."""

    name: str
    size: int
    code: str = 'd'         # a format character of `struct`


class Numbers(NamedTuple):
    """Numbers of one type that are the same in all messages."""

    code: str
    values: tuple[float, ...]


class Header(NamedTuple):
    """A std_msgs/Header: its stamp, which differs, and a frame; None: the stamp alone."""

    frame_id: str | None


# In the order of the definition; a str is a string that is the same in all messages.
Part = Field | Numbers | Header | str


class Template:
    """
    A serialized message whose stamps and fields are replaced, many messages at a time.

    fields : in the order in which `encode` takes them
    data : the message with zeros in their place
    """

    def __init__(self, *parts: Part) -> None:
        buffer, self._stamps_at, self._places = bytearray(ENCAPSULATION), [], []
        self.fields = tuple(part for part in parts if isinstance(part, Field))
        for part in parts:
            if isinstance(part, Header):
                self._stamps_at.append(_append(buffer, 'I', (0, 0)))
                _append_text(buffer, part.frame_id)
            elif isinstance(part, str):
                _append_text(buffer, part)
            elif isinstance(part, Field):
                self._places.append(_append(buffer, part.code, part.size * (0,)))
            else:
                _append(buffer, *part)
        # RTPS pads to four bytes; a template does so too, so that logs have what subscribers get.
        self.data = bytes(buffer + bytes(-len(buffer) % 4))
        # A message as a type of NumPy: the fields by number, then the stamps.
        columns: list[tuple[str, Any, int]] = [
            (f'{i}', (f'<{field.code}', (field.size,)), at)
            for i, (field, at) in enumerate(zip(self.fields, self._places, strict=True))]
        for at in self._stamps_at:
            columns += [(f'sec{at}', '<i4', at), (f'nanosec{at}', '<u4', at + 4)]
        self._row_type = np.dtype({
            'names': [name for name, _, _ in columns], 'formats': [one for _, one, _ in columns],
            'offsets': [at for _, _, at in columns], 'itemsize': len(self.data)})

    def __len__(self) -> int:
        return len(self.data)

    def encode(self, stamps_ns: NDArray[np.int64], fields: Sequence[Values]) -> NDArray[np.uint8]:
        """Return messages (n, size) with stamps (n,) [ns]."""
        count = len(stamps_ns)
        rows = np.frombuffer(bytearray(count * self.data), self._row_type)
        for at in self._stamps_at:
            rows[f'sec{at}'], rows[f'nanosec{at}'] = np.divmod(stamps_ns, NANOSECONDS)
        fill([rows[f'{i}'] for i in range(len(self.fields))], fields)
        return rows.view(np.uint8).reshape(count, len(self))

    def encode_one(self, stamp_ns: int, *fields: Values) -> bytes:
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
        for field, offset in zip(self.fields, self._places, strict=True):
            size = struct.calcsize('<' + field.code)
            if 0 <= at - offset < field.size * size:
                element = (at - offset) // size
                return f'{field.name}[{element}]', [
                    repr(*struct.unpack_from('<' + field.code, one, offset + element * size))
                    for one in messages]
        return f'byte {at}', [f'0x{one[at]:02x}' for one in messages]


def _append(buffer: bytearray, code: str, values: Sequence[float]) -> int:
    """Append numbers of one type, aligned to its size; return the offset of the first."""
    size = struct.calcsize('<' + code)
    if values:
        buffer += bytes(-(len(buffer) - len(ENCAPSULATION)) % size)
    buffer += struct.pack(f'<{len(values)}{code}', *values)
    return len(buffer) - len(values) * size


def _append_text(buffer: bytearray, text: str | None) -> None:
    if text is not None:
        data = text.encode() + b'\0'
        _append(buffer, 'I', (len(data),))
        buffer += data


def fill(rows: Sequence[NDArray[Any]], fields: Sequence[Values]) -> None:
    """Fill fields (n, count) from those of n messages."""
    for row, field in zip(rows, fields, strict=True):
        if isinstance(field, np.ndarray):
            row[:] = field
        else:
            for column, numbers in zip(row.T, field, strict=True):
                column[:] = numbers
