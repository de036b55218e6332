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
from collections.abc import Callable, Iterable, Sequence
from typing import Any

ENCAPSULATION = b'\x00\x01\x00\x00'
NANOSECONDS = 1_000_000_000


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
    A serialized message whose stamp and numbers are replaced.

    encode(stamp_ns, *runs): return the message with this stamp [ns] and one sequence of numbers a
    run, as bytes.
    """

    encode: Callable[..., bytes]

    def __init__(self, writer: CdrWriter, stamps_at: Sequence[int],
                 fields: Sequence[tuple[int, int]]) -> None:
        """
        Take the bytes, the offsets of the stamp (none, one, or one of each part of an array),
        and (offset, count) of each run of doubles to patch.

        What lies between the runs keeps its bytes.
        """
        self._buffer = writer.buffer
        self._stamps_at = tuple(stamps_at)
        self._fields = tuple(fields)
        self._rows: Any = None
        self.encode = self._written_out()

    def __len__(self) -> int:
        """Return the size of every message [bytes]."""
        return len(self._buffer)

    def with_fixed(self, *runs: Sequence[float]) -> Template:
        """Return the message with these numbers for good: `encode` takes no runs then."""
        writer = CdrWriter()
        writer.buffer[:] = self.encode(0, *runs)
        template = Template(writer, self._stamps_at, ())
        template._fields = self._fields
        return template

    def _written_out(self) -> Callable[..., bytes]:
        """
        Return `encode`: one call that packs what varies between what does not.

        Written out as source text once, because a loop over the runs takes twice the time.
        """
        pieces = [(at, 8 * count, f'{count}d', f'*run{i}')
                  for i, (at, count) in enumerate(self._fields)]
        pieces += [(at, 8, 'iI', f'*divmod(stamp_ns, {NANOSECONDS})') for at in self._stamps_at]
        scope: dict[str, Any] = {}
        formats, arguments, end = ['<'], [], 0
        for at, size, code, argument in [*sorted(pieces), (len(self._buffer), 0, '', '')]:
            if at > end:
                scope[f'fixed{end}'] = bytes(self._buffer[end:at])
                formats.append(f'{at - end}s')
                arguments.append(f'fixed{end}')
            if size:
                formats.append(code)
                arguments.append(argument)
            end = at + size
        scope['pack'] = struct.Struct(''.join(formats)).pack
        names = ', '.join(['stamp_ns', *(f'run{i}' for i in range(len(self._fields)))])
        function: Callable[..., bytes] = eval(
            f'lambda {names}: pack({", ".join(arguments)})', scope)
        return function

    def encode_many(self, stamps_ns: Any, *runs: Any) -> Any:
        """
        Return n messages of equal length as rows of bytes, (n, size) uint8.

        stamps_ns: (n,) int64 [ns];  runs: (n, count) arrays, or tuples of `count` columns or
        numbers.  The rows are valid until the next call.
        """
        import numpy  # noqa: PLC0415 - offline only

        count = len(stamps_ns)
        if self._rows is None or len(self._rows) < count:
            self._rows = numpy.empty(count, self._row_type())
            self._rows.view('u1').reshape(count, -1)[:] = numpy.frombuffer(self._buffer, 'u1')
        rows = self._rows[:count]
        for at in self._stamps_at:
            rows[f'sec{at}'], rows[f'nanosec{at}'] = numpy.divmod(stamps_ns, NANOSECONDS)
        for i, run in enumerate(runs):
            field = rows[f'run{i}']
            if isinstance(run, numpy.ndarray):
                field[:] = run
            else:
                for column, values in enumerate(run):
                    field[:, column] = values
        return rows.view('u1').reshape(count, -1)

    def decode_many(self, data: bytes) -> tuple[Any, ...]:
        """Return the runs, (n, count) arrays each, of n messages one after the other."""
        import numpy  # noqa: PLC0415

        rows = numpy.frombuffer(data, self._row_type())
        return tuple(rows[f'run{i}'] for i in range(len(self._fields)))

    def _row_type(self) -> Any:
        """Return a message as a numpy type: the runs, and the stamps if there are any."""
        import numpy  # noqa: PLC0415

        names = [f'run{i}' for i in range(len(self._fields))]
        formats: list[Any] = [('<f8', (number,)) for _, number in self._fields]
        offsets = [at for at, _ in self._fields]
        for at in self._stamps_at:
            names += [f'sec{at}', f'nanosec{at}']
            formats += ['<i4', '<u4']
            offsets += [at, at + 4]
        return numpy.dtype({'names': names, 'formats': formats, 'offsets': offsets,
                            'itemsize': len(self._buffer)})

    def field_at(self, at: int) -> tuple[int, int, int] | None:
        """Return run, element and offset of what holds a byte: run -1 is the stamp."""
        for stamp_at in self._stamps_at:
            if 0 <= at - stamp_at < 8:
                return -1, 0, stamp_at
        for run, (begin, count) in enumerate(self._fields):
            if 0 <= at - begin < 8 * count:
                element = (at - begin) // 8
                return run, element, begin + 8 * element
        return None
