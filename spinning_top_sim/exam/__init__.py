# SPDX-License-Identifier: Apache-2.0
"""Examines attitude filters: `report = examine(make_filter)`; see docs/exam.md."""

from spinning_top_sim.exam.examiner import examine
from spinning_top_sim.tools.report import Report

__all__ = ['Report', 'examine']
