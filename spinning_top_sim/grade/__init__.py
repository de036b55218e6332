# SPDX-License-Identifier: Apache-2.0
"""Grades simulators of rigid bodies and IMUs: `report = grade(run)`; see docs/grade.md."""

from spinning_top_sim.grade.grader import grade, grade_trajectory
from spinning_top_sim.grade.report import Fault, Report
from spinning_top_sim.grade.scenes import Body, Start

__all__ = ['Body', 'Fault', 'Report', 'Start', 'grade', 'grade_trajectory']
