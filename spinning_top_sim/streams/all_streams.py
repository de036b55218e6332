# SPDX-License-Identifier: Apache-2.0
"""Every stream there is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spinning_top_sim.streams import topics
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.markers import Markers


def all_streams(values: Mapping[str, Any]) -> list[topics.Stream]:
    """Return every stream, in the order in which samples of one instant are sent."""
    imu = Imu(values)
    return [topics.Clock(values), topics.Pose(values), topics.JointStates(values),
            topics.ImuRaw(values, imu), topics.ImuData(values, imu), topics.ImuBias(values, imu),
            topics.GroundTruthImu(values, imu), topics.GroundTruthOdometry(values),
            topics.Invariants(values), Markers(values)]
