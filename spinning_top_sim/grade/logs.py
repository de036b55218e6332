# SPDX-License-Identifier: Apache-2.0
"""Reads motions and readings from ROS 2 logs, by the types of their topics."""

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.grade.files import Recorded
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.messages import EXACT_VARIANCE
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.foreign_messages import NO_ORIENTATION, deserialized

# By type: where position and attitude are; of TFMessage those of one of its transforms.
POSES = {'geometry_msgs/msg/PoseStamped': ('pose.position', 'pose.orientation'),
         'geometry_msgs/msg/PoseWithCovarianceStamped': (
             'pose.pose.position', 'pose.pose.orientation'),
         'nav_msgs/msg/Odometry': ('pose.pose.position', 'pose.pose.orientation'),
         'geometry_msgs/msg/TransformStamped': ('transform.translation', 'transform.rotation'),
         'tf2_msgs/msg/TFMessage': ('transform.translation', 'transform.rotation')}
IMU, FIELD = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/MagneticField'
READINGS = {IMU: {'gyroscope': 'angular_velocity', 'accelerations': 'linear_acceleration'},
            FIELD: {'magnetometer': 'magnetic_field'}}
# Topics of this package that are graded where its log has them, the first of each.
OURS = 'pose', 'ground_truth/odom', 'imu/data_raw', 'imu/data', 'ground_truth/imu', 'imu/mag'
NANOSECONDS = 1e-9
Rows = list[tuple[int, list[float]]]        # stamps [ns] and numbers


def read_log(path: Path, wanted: Sequence[str]) -> Recorded:
    """
    Read a log.

    wanted : topics to read, of transforms as TOPIC:CHILD; none: the only ones of each kind

    Raises OSError, LogError or ValueError, which name the file and what to type.
    """
    recorded, end_ns = Recorded(), 1 << 63
    with LogReader(path) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics
                 if topic.type_name in {*POSES, *READINGS}}
        with contextlib.suppress(recorded_run.ForeignLogError):
            recorded.run = recorded_run.read_run_description(reader)
            end_ns = next((one.stamp_ns for one in recorded.run.events
                           if one.name != 'start'), end_ns)
        if not reader.whole:
            recorded.notes.append('the log is truncated: read as far as it goes')
        parts = _parts(reader, types, {name.partition(':')[0] for name in wanted}, end_ns,
                       recorded)
    origin = min((rows[0][0] for rows in parts.values()), default=0)
    recorded.notes.append(f'times of headers: the first is {origin * NANOSECONDS:.9f} s')
    attitudes = [source for kind, source in parts if kind == 'attitudes']
    chosen = {kind: _chosen(kind, [source for one, source in parts if one == kind], wanted,
                            recorded)
              for kind in dict.fromkeys(kind for kind, _ in parts)}
    if not attitudes:
        raise ValueError(f'{path} has no topic with attitudes; it has '
                         f'{", ".join(types) or "none of a type that is read"}')
    try:
        for kind, source in chosen.items():
            rows = parts[kind, source]
            times = np.array([(stamp - origin) * NANOSECONDS for stamp, _ in rows])
            recorded.add(kind, source, times, np.array([row for _, row in rows]), 'message {}')
        recorded.check()
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    if unused := sorted({source for _, source in parts} - {*chosen.values()}):
        recorded.notes.append(f'not used: {", ".join(unused)}')
    return recorded


def _chosen(kind: str, sources: Sequence[str], wanted: Sequence[str],
            recorded: Recorded) -> str:
    """Return the topic of a kind.  Raises ValueError where it is not the only one."""
    named = [source for source in sources if source in wanted]
    if not named and recorded.run is not None:
        named = [source for name in OURS for source in sources if source.endswith('/' + name)
                 ][:1]
    if len(named or sources) > 1:
        raise ValueError(f'{kind} are in {", ".join(sources)}: choose by --topic '
                         f'{sources[0]}')
    return (named or sources)[0]


def _parts(reader: LogReader, types: dict[str, str], topics: set[str], end_ns: int,
           recorded: Recorded) -> dict[tuple[str, str], Rows]:
    """Return rows by kind and source.  Raises LogError."""
    parts: dict[tuple[str, str], Rows] = defaultdict(list)
    oriented: dict[tuple[str, str], Rows] = defaultdict(list)   # attitudes that an IMU tells
    unstamped = set()
    for topic, log_time, one in _contents(reader, types, end_ns):
        stamp = one.header.stamp.sec * 10 ** 9 + one.header.stamp.nanosec
        if not stamp:
            unstamped.add(topic)
        stamp = stamp or log_time
        kind = types[topic]
        if kind in POSES:
            source = f'{topic}:{one.child_frame_id}' if hasattr(one, 'transforms') or (
                kind == 'tf2_msgs/msg/TFMessage') else topic
            for part, place in zip(('positions', 'attitudes'), POSES[kind], strict=True):
                parts[part, source].append((stamp, _numbers(one, place)))
            continue
        for part, place in READINGS[kind].items():
            covariance = getattr(one, f'{place}_covariance')
            if covariance[0] == NO_ORIENTATION:     # there are no such readings
                continue
            if not parts[part, topic] and not 0.0 < np.max(covariance) <= EXACT_VARIANCE:
                recorded.covariance[part] = np.reshape(covariance, (3, 3))
            parts[part, topic].append((stamp, _numbers(one, place)))
        if kind == IMU and one.orientation_covariance[0] != NO_ORIENTATION:
            oriented['attitudes', topic].append((stamp, _numbers(one, 'orientation')))
    # Frames that rest are no motion.
    moving = {source for (kind, source), rows in parts.items()
              if kind == 'attitudes' and any(row != rows[0][1] for _, row in rows)}
    parts = {(kind, source): rows for (kind, source), rows in parts.items() if rows and (
        kind not in ('attitudes', 'positions') or source in moving)}
    for key, rows in oriented.items():
        if key[1] in topics or not moving:
            parts[key] = rows
    for topic in sorted(unstamped):
        recorded.notes.append(f'{topic}: headers without a time: that of the log is used')
    return parts


def _numbers(message: Any, place: str) -> list[float]:
    for name in place.split('.'):
        message = getattr(message, name)
    return [getattr(message, axis) for axis in ('x', 'y', 'z', 'w') if hasattr(message, axis)]


def _contents(reader: LogReader, types: dict[str, str],
              end_ns: int) -> Iterator[tuple[str, int, Any]]:
    """Yield topics, log times and messages, or transforms in them.  Raises LogError."""
    for message in reader.messages(types, end=end_ns):
        try:
            content = deserialized(message.data, types[message.topic])
        except ValueError as error:
            raise LogError(f'cannot read {reader.path}: a message of {message.topic} is '
                           f'{error}') from error
        for one in getattr(content, 'transforms', [content]):
            yield message.topic, message.log_time, one
