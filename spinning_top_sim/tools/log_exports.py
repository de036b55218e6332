# SPDX-License-Identifier: Apache-2.0
"""
Writes files for other tools from a log.

TUM: "timestamp tx ty tz qx qy qz qw", in s and m (vision.in.tum.de, RGB-D dataset, file formats).
EuRoC: state_groundtruth_estimate0/data.csv and imu0/data.csv (M. Burri et al., "The EuRoC micro
aerial vehicle datasets", IJRR 35, 2016).
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.files import new_file
from spinning_top_sim.physics import attitude
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.times import Times, stamp_text
from spinning_top_sim.tools.recorded_run import RunDescription, channels_of

RAW, BIAS = 'imu/data_raw', 'ground_truth/imu_bias'
ODOMETRY, BODY = 'ground_truth/imu_odom', 'ground_truth/odom'
EUROC_HEAD = ('#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],'
              'q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],'
              'b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],'
              'b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]\n')
EUROC_IMU_HEAD = ('#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
                  'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n')


def add_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument --export."""
    parser.add_argument(
        '--export', type=_parse, metavar='KIND:FILE', action='append', default=[],
        help='write a file for other tools: tum or euroc, the true trajectory of the IMU '
        f'(tum: of the body where the log has no {ODOMETRY}); euroc_imu, its readings (CSV); '
        'may be repeated; an existing file is never overwritten')


def _parse(text: str) -> tuple[str, Path]:
    kind, colon, name = text.partition(':')
    if kind not in KINDS or not name:
        raise argparse.ArgumentTypeError(
            f'{text}: must be KIND:FILE with one of {", ".join(KINDS)}, such as tum:truth.tum')
    return kind, Path(name)


def check(run: RunDescription, exports: Sequence[tuple[str, Path]]) -> None:
    """Raise ValueError if the log lacks a topic that an export needs."""
    for kind, _ in exports:
        for topic in KINDS[kind][0]:
            if topic not in run.topics and (kind != 'tum' or BODY not in run.topics):
                name = next(channel.name for channel in channels_of(run.values_in_effect)
                            if channel.topic == topic)
                raise ValueError(f'--export {kind}: the log has no {topic}; a run has it with '
                                 f'{name}.enabled:=true, and {name} in record.streams')


def write(reader: LogReader, run: RunDescription,
          exports: Sequence[tuple[str, Path]]) -> Iterator[str]:
    """Write the files; yield a line about each.  Raises ValueError or OSError."""
    for kind, path in exports:
        with new_file(path) as file:
            file.writelines(KINDS[kind][1](reader, run))
        of_body = kind == 'tum' and ODOMETRY not in run.topics
        yield f'{path}: {kind}{f" of the body, from {BODY}" if of_body else ""}'


def _tum(reader: LogReader, run: RunDescription) -> Iterator[str]:
    topic = ODOMETRY if ODOMETRY in run.topics else BODY
    for stamps_ns, (position, orientation, *_) in _blocks(reader, run, topic):
        yield from _rows(' ', map(stamp_text, stamps_ns), position, orientation)


def _euroc(reader: LogReader, run: RunDescription) -> Iterator[str]:
    biases = [*_blocks(reader, run, BIAS)]
    bias_ns = np.concatenate([np.empty(0, np.int64), *(stamps_ns for stamps_ns, _ in biases)])
    if not len(bias_ns):
        raise ValueError(f'--export euroc: the log has no sample of {BIAS}')
    bias = np.concatenate([np.hstack(fields) for _, fields in biases])
    yield EUROC_HEAD
    for stamps_ns, (position, orientation, velocity, _) in _blocks(reader, run, ODOMETRY):
        world = attitude.rotated(tuple(orientation.T), tuple(velocity.T))
        # The bias of the last reading before the sample.
        newest = np.maximum(np.searchsorted(bias_ns, stamps_ns, 'right') - 1, 0)
        yield from _rows(',', stamps_ns, position, np.roll(orientation, 1, axis=1),
                        np.column_stack(world), bias[newest])


def _euroc_imu(reader: LogReader, run: RunDescription) -> Iterator[str]:
    yield EUROC_IMU_HEAD
    for stamps_ns, (rates, accelerations) in _blocks(reader, run, RAW):
        yield from _rows(',', stamps_ns, rates, accelerations)


def _rows(separator: str, stamps: Iterable[object],
          *columns: NDArray[np.float64]) -> Iterator[str]:
    for stamp, row in zip(stamps, np.hstack(columns).tolist(), strict=True):
        yield f'{stamp}{separator}{separator.join(map(repr, row))}\n'


def _blocks(reader: LogReader, run: RunDescription, topic: str,
            ) -> Iterator[tuple[Times, tuple[NDArray[np.float64], ...]]]:
    """Yield stamps (n,) [ns] and fields of the messages of a stream, block by block."""
    template = next(channel.template for channel in channels_of(run.values_in_effect)
                    if channel.topic == topic)
    for _, group in reader.groups([run.topics[topic]]):
        data = b''.join(message.data for message in group if len(message.data) == len(template))
        yield template.stamps_ns(data), template.decode(data)


# Of each kind: the topics that it needs, and the generator of its text.
KINDS: dict[str, tuple[Sequence[str], Callable[..., Iterator[str]]]] = {
    'tum': ((ODOMETRY,), _tum), 'euroc': ((ODOMETRY, BIAS), _euroc),
    'euroc_imu': ((RAW,), _euroc_imu)}
