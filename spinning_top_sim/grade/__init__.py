# SPDX-License-Identifier: Apache-2.0
"""Grades simulators of rigid bodies and IMUs: `report = grade(run)`; see docs/grade.md."""

from spinning_top_sim.grade.bodies import grade_readings
from spinning_top_sim.grade.columns import Imu
from spinning_top_sim.grade.scenes import Body, Start
from spinning_top_sim.grade.simulators import grade
from spinning_top_sim.tools.report import Finding, Report

__all__ = ['Body', 'Finding', 'Imu', 'Report', 'Start', 'grade', 'grade_readings']
