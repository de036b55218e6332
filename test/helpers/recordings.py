# SPDX-License-Identifier: Apache-2.0
"""Messages for the tests of recordings, and logs of other programs with any messages."""

import struct
from collections import Counter

from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.recording.rosbag2 import RecordedTopic

JAZZY = get_typestore(Stores.ROS2_JAZZY)
POSE = 'geometry_msgs/msg/PoseStamped'
ARRAY = 'std_msgs/msg/Float64MultiArray'
TOPICS = (
    RecordedTopic('/top/pose', POSE),
    RecordedTopic('/top/spinning_top/invariants', ARRAY, {'depth': 3, 'reliability': 2}),
    RecordedTopic('/top/silent', POSE),
)
METADATA = {'seed': '7', 'top.mass': '0.5', 'note': 'θ: "quoted"\nline'}
EPOCH_NS = 1_700_000_000_000_000_000


def pose_cdr(number: int) -> bytes:
    """The CDR of a PoseStamped in the frame `world`, packed by hand."""
    return struct.pack('<4sIII6s6x7d', b'\x00\x01\x00\x00', 1_700_000_000, number, 6, b'world\x00',
                       1.0, 2.0, number, 0.0, 0.6, 0.0, 0.8)


def array_cdr(number: int) -> bytes:
    """The CDR of a Float64MultiArray without labels, packed by hand."""
    return struct.pack('<4sIII4xd', b'\x00\x01\x00\x00', 0, 0, 1, float(number))


def write_rows(path, topics, rows, per_chunk=None, **metadata):
    """Write rows (number of a topic, stamp [ns], data) by mcap's writer, so many in a chunk."""
    with open(path, 'wb') as file:
        writer, counts = Writer(file), Counter()
        writer.start('ros2')
        for name, content in metadata.items():
            writer.add_metadata(name, content)
        channels = [writer.register_channel(topic.name, 'cdr', writer.register_schema(
            topic.type_name, 'ros2msg', JAZZY.generate_msgdef(
                topic.type_name, ros_version=2)[0].encode())) for topic in topics]
        for number, (topic, stamp, data) in enumerate(rows, start=1):
            writer.add_message(channels[topic], stamp, data, stamp, counts[topic])
            counts[topic] += 1
            if per_chunk and number % per_chunk == 0:
                writer.flush()
        writer.finish()
    return path


def some_messages(count: int) -> list[tuple[int, int, bytes]]:
    """Messages of the first two topics in turn, 1 ms apart."""
    makers = (pose_cdr, array_cdr)
    return [(n % 2, EPOCH_NS + n * 1_000_000, makers[n % 2](n)) for n in range(count)]
