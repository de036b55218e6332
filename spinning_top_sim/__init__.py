# SPDX-License-Identifier: Apache-2.0
"""Real-time and offline simulation of the heavy symmetric top, with a known exact truth."""

from __future__ import annotations

from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers import solve

__all__ = ['State', 'Top', 'solve']
