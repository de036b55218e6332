# SPDX-License-Identifier: Apache-2.0
"""
Serialized ROS messages (XCDR version 1, little endian), as templates whose numbers are replaced.

Format: OMG DDS-XTypes 1.3, sect. 7.4.1, and the RTPS encapsulation header.  After the header
00 01 00 00 every primitive is aligned to its own size, counted from the end of the header.  A
string is its length with the closing NUL, then its bytes; a sequence is the number of its
elements, then the elements.  Padding is zero, so that equal messages have equal bytes.

Parts are in the order of the .msg definitions (ROS 2 Jazzy, common_interfaces 5.3), fields have
the names there; a test reads every template with rclpy and rosbags.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.times import NANOSECONDS, Times

ENCAPSULATION = b'\x00\x01\x00\x00'
STAMP = np.dtype([('sec', '<i4'), ('nanosec', '<u4')])
UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
# A covariance of zeros means unknown (sensor_msgs/Imu), so that exact values have this variance.
EXACT_VARIANCE = 1e-18
ORIGIN, NO_ROTATION = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
# The numbers of a field in n messages: an array (n, count), or `count` columns or numbers.
Values = NDArray[Any] | Sequence[NDArray[Any] | float]


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
        buffer = bytearray(ENCAPSULATION)
        self.fields = tuple(part for part in parts if isinstance(part, Field))
        self._stamps: list[str] = []
        # What is replaced, by name: the type of NumPy and the offset.
        self._places: dict[str, tuple[np.dtype[Any], int]] = {}
        for part in parts:
            if isinstance(part, Header):
                self._stamps.append(f'stamp {len(self._stamps)}')
                self._places[self._stamps[-1]] = STAMP, _append(buffer, 'I', (0, 0))
                if part.frame_id is not None:
                    _append_text(buffer, part.frame_id)
            elif isinstance(part, str):
                _append_text(buffer, part)
            elif isinstance(part, Field):
                self._places[part.name] = (np.dtype((f'<{part.code}', (part.size,))),
                                           _append(buffer, part.code, part.size * (0,)))
            else:
                _append(buffer, *part)
        # RTPS pads to four bytes; a template does so too, so that logs have what subscribers get.
        self.data = bytes(buffer + bytes(-len(buffer) % 4))
        places = self._places.values()
        self._row_type = np.dtype({
            'names': [*self._places], 'formats': [kind for kind, _ in places],
            'offsets': [at for _, at in places], 'itemsize': len(self.data)})

    def __len__(self) -> int:
        return len(self.data)

    def encode(self, stamps_ns: Times, fields: Sequence[Values]) -> NDArray[np.uint8]:
        """Return messages (n, size) with stamps (n,) [ns]."""
        rows = np.frombuffer(bytearray(len(stamps_ns) * self.data), self._row_type)
        for name in self._stamps:
            rows[name]['sec'], rows[name]['nanosec'] = np.divmod(stamps_ns, NANOSECONDS)
        for field, numbers in zip(self.fields, fields, strict=True):
            if isinstance(numbers, np.ndarray):
                rows[field.name] = numbers
            else:
                for column, given in zip(rows[field.name].T, numbers, strict=True):
                    column[:] = given
        return rows.view(np.uint8).reshape(len(stamps_ns), len(self))

    def encode_one(self, stamp_ns: int, *fields: Values) -> bytes:
        return self.encode(np.array([stamp_ns]), fields).tobytes()

    def decode(self, data: bytes | NDArray[np.uint8]) -> tuple[NDArray[Any], ...]:
        """Return the fields, (n, count) each, of n concatenated messages."""
        rows = np.frombuffer(data, self._row_type)
        return tuple(rows[field.name] for field in self.fields)

    def stamps_ns(self, data: bytes) -> Times:
        """Return the stamps (n,) [ns] of n concatenated messages."""
        stamps = np.frombuffer(data, self._row_type)[self._stamps[0]]
        return np.asarray(stamps['sec'].astype(np.int64) * NANOSECONDS + stamps['nanosec'])

    def shown_at(self, at: int, *messages: bytes) -> tuple[str, list[str]]:
        """Return the name of what the byte at an offset belongs to, and its value in messages."""
        rows = np.frombuffer(b''.join(messages), self._row_type)
        for name, (kind, offset) in self._places.items():
            if 0 <= at - offset < kind.itemsize:
                if name in self._stamps:
                    return 'header.stamp', [
                        '{}.{:09d}'.format(*stamp) for stamp in rows[name].tolist()]
                element = (at - offset) // kind.base.itemsize
                return f'{name}[{element}]', list(map(repr, rows[name][:, element].tolist()))
        return f'byte {at}', [f'0x{one[at]:02x}' for one in messages]


def _append(buffer: bytearray, code: str, values: Sequence[float]) -> int:
    """Append numbers of one type, aligned to its size; return the offset of the first."""
    size = struct.calcsize('<' + code)
    if values:
        buffer += bytes(-(len(buffer) - len(ENCAPSULATION)) % size)
    buffer += struct.pack(f'<{len(values)}{code}', *values)
    return len(buffer) - len(values) * size


def _append_text(buffer: bytearray, text: str) -> None:
    data = text.encode() + b'\0'
    _append(buffer, 'I', (len(data),))
    buffer += data


def diagonal(*variances: float) -> tuple[float, ...]:
    """Return a row-major covariance with these variances; 0 becomes EXACT_VARIANCE."""
    count = len(variances)
    return tuple(variances[row] or EXACT_VARIANCE if row == column else 0.0
                 for row in range(count) for column in range(count))


EXACT = diagonal(0.0, 0.0, 0.0)


# Ensembles make the same ones in every run.
message = lru_cache(256)(Template)


def imu(frame_id: str, rates: tuple[float, ...], forces: tuple[float, ...],
        orientation: tuple[float, ...] = ()) -> Template:
    """Return sensor_msgs/Imu with these covariances; without an orientation where it has none."""
    return message(
        Header(frame_id), Field('orientation', 4) if orientation else Numbers('d', NO_ROTATION),
        Numbers('d', orientation or UNKNOWN_ORIENTATION), Field('angular_velocity', 3),
        Numbers('d', rates), Field('linear_acceleration', 3), Numbers('d', forces))


def odometry(frame_id: str, child_frame_id: str) -> Template:
    """Return nav_msgs/Odometry with exact values; the twist is in the child frame."""
    exact = Numbers('d', diagonal(*6 * (0.0,)))
    return message(
        Header(frame_id), child_frame_id, Field('pose.pose.position', 3),
        Field('pose.pose.orientation', 4), exact, Field('twist.twist.linear', 3),
        Field('twist.twist.angular', 3), exact)


def float64_multi_array(labels: tuple[str, ...]) -> Template:
    """Return std_msgs/Float64MultiArray, one dimension labelled with its columns."""
    count = len(labels)
    # Number of dimensions; label, size and stride; offset of the data, their number.
    return message(Numbers('I', (1,)), ','.join(labels),
                   Numbers('I', (count, count, 0, count)), Field('data', count))


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    return Template(text).data
