# SPDX-License-Identifier: Apache-2.0
"""
Serialized ROS messages (XCDR version 1, little endian), as templates whose numbers are replaced.

Format: OMG DDS-XTypes 1.3, sect. 7.4.1, and the RTPS encapsulation header.  After the header
00 01 00 00 every primitive is aligned to its own size, counted from the end of the header.  A
string is its length with the closing NUL, then its bytes; a sequence is the number of its
elements, then the elements.  Padding is zero, so that equal messages have equal bytes.
"""

import struct
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b'\x00\x01\x00\x00'
NANOSECONDS = 1_000_000_000
# The seconds of a stamp are an int32: the last stamp is in January 2038.
LAST_STAMP_NS = 2 ** 31 * NANOSECONDS - 1

# The numbers of a field in n messages: an array (n, count), or `count` columns or numbers.
Field = NDArray[np.float64] | Sequence[NDArray[np.float64] | float]


def stamp_text(time_ns: int) -> str:
    """Return a time in seconds, to the nanosecond."""
    return f'{time_ns // NANOSECONDS}.{time_ns % NANOSECONDS:09d}'


class CdrWriter:
    """
    Appends the parts of a message in the order of its definition; its methods return itself.

    stamps_at : offset of each stamp
    fields : offset and number of doubles of each field, which differ from message to message
    """

    def __init__(self) -> None:
        self.buffer = bytearray(ENCAPSULATION)
        self.stamps_at: list[int] = []
        self.fields: list[tuple[int, int]] = []

    def append(self, code: str, *values: float) -> Self:
        """Append numbers of one type, a format character of `struct`, aligned to its size."""
        if values:
            size = struct.calcsize('<' + code)
            self.buffer += bytes(-(len(self.buffer) - len(ENCAPSULATION)) % size)
        self.buffer += struct.pack(f'<{len(values)}{code}', *values)
        return self

    def field(self, *counts: int) -> Self:
        """Append fields of so many doubles each."""
        for count in counts:
            self.append('d', *(count * (0.0,)))
            self.fields.append((len(self.buffer) - 8 * count, count))
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

    counts : how many numbers each field has
    """

    def __init__(self, writer: CdrWriter) -> None:
        # RTPS pads to four bytes; a template does so too, so that logs have what subscribers get.
        self._buffer = writer.buffer + bytes(-len(writer.buffer) % 4)
        self._stamps_at, self._fields = writer.stamps_at, writer.fields
        self.counts = tuple(count for _, count in self._fields)
        self._rows: NDArray[np.void] = np.empty(0, np.void)

    @cached_property
    def _row_type(self) -> np.dtype[np.void]:
        """A message as a numpy type: the fields, and the stamps if there are any."""
        columns: list[tuple[str, object, int]] = [
            (f'field{i}', ('<f8', (count,)), at) for i, (at, count) in enumerate(self._fields)]
        for at in self._stamps_at:
            columns += [(f'sec{at}', '<i4', at), (f'nanosec{at}', '<u4', at + 4)]
        names, formats, offsets = zip(*columns, strict=True) if columns else ((), (), ())
        return np.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                         'itemsize': len(self._buffer)})

    def __len__(self) -> int:
        return len(self._buffer)

    def encode(self, stamps_ns: NDArray[np.int64], *values: Field) -> NDArray[np.uint8]:
        """Return messages (n, size) with stamps (n,) [ns]; they are valid until the next call."""
        return self.encode_runs(stamps_ns, ((len(stamps_ns), values),))

    def encode_runs(self, stamps_ns: NDArray[np.int64],
                    runs: Iterable[tuple[int, Sequence[Field]]]) -> NDArray[Any]:
        """
        Return messages as `encode` does, from consecutive runs of them.

        runs : of each the number of its messages, and their fields
        """
        count = len(stamps_ns)
        if len(self._rows) < count:
            self._rows = np.frombuffer(count * self._buffer, self._row_type)
        rows = self._rows[:count]
        for at in self._stamps_at:
            rows[f'sec{at}'], rows[f'nanosec{at}'] = np.divmod(stamps_ns, NANOSECONDS)
        fill([rows[f'field{i}'] for i in range(len(self._fields))], runs)
        return rows.view(np.uint8).reshape(count, len(self))

    def encode_one(self, stamp_ns: int, *values: Field) -> bytes:
        return self.encode(np.array([stamp_ns]), *values).tobytes()

    def decode(self, data: bytes | NDArray[np.uint8]) -> tuple[NDArray[np.float64], ...]:
        """Return the fields, (n, count) each, of n concatenated messages."""
        rows = np.frombuffer(data, self._row_type)
        return tuple(rows[f'field{i}'] for i in range(len(self._fields)))

    def stamps_ns(self, data: bytes) -> NDArray[np.int64]:
        """Return the stamps (n,) [ns] of n concatenated messages."""
        rows, at = np.frombuffer(data, self._row_type), self._stamps_at[0]
        stamps: NDArray[np.int64] = rows[f'sec{at}'].astype(np.int64) * NANOSECONDS
        stamps += rows[f'nanosec{at}']
        return stamps

    def field_at(self, at: int) -> tuple[int, int, int] | None:
        """
        Return what the byte at an offset belongs to: field, element, and offset of the element.

        The field is -1 for a stamp; None is returned for a byte that is the same in all messages.
        """
        for stamp_at in self._stamps_at:
            if 0 <= at - stamp_at < 8:
                return -1, 0, stamp_at
        for field, (begin, count) in enumerate(self._fields):
            if 0 <= at - begin < 8 * count:
                return field, (at - begin) // 8, at - (at - begin) % 8
        return None


def fill(fields: Sequence[NDArray[np.float64]],
         runs: Iterable[tuple[int, Sequence[Field]]]) -> None:
    """Fill fields (n, count) from runs, as those of `Template.encode_runs`."""
    begin = 0
    for size, values in runs:
        for field, value in zip(fields, values, strict=True):
            rows = field[begin:begin + size]
            if isinstance(value, np.ndarray):
                rows[:] = value
            else:
                for column, numbers in zip(rows.T, value, strict=True):
                    column[:] = numbers
        begin += size
