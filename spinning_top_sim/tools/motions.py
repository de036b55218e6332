# SPDX-License-Identifier: Apache-2.0
"""The motions of a log's run, from start, command or reset to the next, and what samples say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.top import Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams.all_streams import all_streams
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import Stream
from spinning_top_sim.tools.analysis import Attitudes, Measured, from_joint_states
from spinning_top_sim.tools.rerun import DepartureError, Rerun
from spinning_top_sim.tools.run_description import RunDescription

# Streams that measure a motion, the best first: with angles, with exact rates, with neither.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'imu/data', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation: a faster stream shows nothing new


@dataclass
class MotionReport:
    """One motion of the top."""

    cause: str                            # start, command or reset
    begin_ns: int                         # log times [ns]
    end_ns: int
    origin_ns: int                        # log time at which the exact solution has t = 0 [ns]
    top: Top
    l3: float                             # constants of the motion as it began [kg m^2/s], [J]
    lz: float
    energy: float
    exact: ExactSolution | None           # None where it cannot hold the motion
    described: Description | None         # its numbers
    measured: Measured | None = None      # the same numbers from the data
    source: str | None = None             # topic of these data
    regime: str | None = None             # name of the motion by the data

    @property
    def nutation_period(self) -> float:
        """Of the exact solution [s]; inf where there is none."""
        period = None if self.described is None else self.described.nutation_period
        return math.inf if period is None else period


@dataclass
class Section:
    """A part of a motion with the same rates: the samples later than begin_ns, up to end_ns."""

    motion: MotionReport
    begin_ns: int                         # log times [ns]
    end_ns: int
    epoch_ns: int                         # stamp of t = 0 [ns]
    streams: dict[str, Stream]            # with their rates and layouts, by topic of the log
    imu: Imu
    source: str | None                    # topic that measures the motion best


def find_sections(run: RunDescription, end_ns: int) -> tuple[list[Section], str]:
    """
    Return the sections of a log's run.

    Parameters
    ----------
    run : RunDescription
        The run.
    end_ns : int
        Log time of the last message [ns].

    Returns
    -------
    sections : list of Section
        In order.
    error : str
        Why the run cannot be followed beyond the last of them, '' if it can.
    """
    sections: list[Section] = []
    error = ''
    try:
        rerun = Rerun(run)
        values = run.values
        begin_ns = run.epoch_ns + run.begun_ns
        motion = _motion(rerun, 'start', begin_ns)
        sections.append(_section(run, rerun, motion, begin_ns, values))
        for event in rerun.advance(end_ns):
            if event is None:
                continue
            begin_ns = sections[-1].end_ns = motion.end_ns = rerun.stamp_ns
            if event.name == 'reset':
                values = rerun.simulation.values
                begin_ns = rerun.simulation.epoch_ns - 1
            if event.name != 'parameters':
                motion = _motion(rerun, event.name, begin_ns)
            sections.append(_section(run, rerun, motion, begin_ns, values))
    except (DepartureError, ValueError) as departure:
        error = str(departure)
    if sections:
        last = sections[-1]
        last.end_ns = last.motion.end_ns = max(end_ns, last.begin_ns)
    return sections, error


def _motion(rerun: Rerun, cause: str, begin_ns: int) -> MotionReport:
    simulation = rerun.simulation
    segment = simulation.segment
    return MotionReport(
        cause, begin_ns, begin_ns, simulation.epoch_ns + segment.start_ns, simulation.top,
        segment.l3, segment.lz, segment.energy, segment.reference.solution,
        simulation.describe())


def _section(run: RunDescription, rerun: Rerun, motion: MotionReport, begin_ns: int,
             values: Mapping[str, Any]) -> Section:
    """Return a section with copies of the streams as they are now."""
    imu = Imu(values)
    copies = {stream.topic: stream for stream in all_streams(values)}
    for stream in rerun.simulation.streams:
        copies[stream.topic].set_rate(NANOSECONDS / stream.period_ns)
    streams = {topic: copies[name] for topic, name in run.topics.items()}
    return Section(motion, begin_ns, begin_ns, rerun.simulation.epoch_ns, streams, imu,
                   _best_source(motion, streams))


def _best_source(motion: MotionReport, streams: Mapping[str, Stream]) -> str | None:
    """Return the topic that measures a motion best."""
    def samples(topic: str) -> float:
        return min(motion.nutation_period * NANOSECONDS / streams[topic].period_ns,
                   ENOUGH_SAMPLES)

    topics = {stream.topic: topic for topic, stream in streams.items()}
    return max((topics[name] for name in SOURCES if name in topics), key=samples, default=None)


def attitudes_of(stream: Stream, imu: Imu, stamps_ns: NDArray[np.int64],
                 fields: tuple[NDArray[np.float64], ...]) -> Attitudes | None:
    """
    Return the attitudes that a stream's messages hold, None for a stream without.

    Parameters
    ----------
    stream : Stream
        Which stream.
    imu : Imu
        How the IMU is mounted.
    stamps_ns : NDArray[np.int64], shape (n,)
        Log times [ns].
    fields : tuple of NDArray[np.float64], each (n, size)
        Numbers in the messages, as `Template.decode` returns them.
    """
    if stream.topic == 'joint_states':
        return from_joint_states(stamps_ns, *fields)
    if stream.topic == 'pose':
        return Attitudes(stamps_ns, fields[0].copy())
    if stream.topic == 'ground_truth/odom':
        return Attitudes(stamps_ns, fields[0].copy(), fields[1].T.copy())
    if stream.topic in ('ground_truth/imu', 'imu/data'):
        quaternion, rates = imu.in_body(tuple(fields[0].T), tuple(fields[1].T))
        return Attitudes(stamps_ns, np.stack(quaternion, axis=1), np.stack(rates))
    return None
