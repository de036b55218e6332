# SPDX-License-Identifier: Apache-2.0
"""Real-time and offline simulation of the heavy symmetric top, with a known exact truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spinning_top_sim.physics.top import State, Top

if TYPE_CHECKING:
    from spinning_top_sim.solvers.solve import solve
    from spinning_top_sim.tools.scene_file import scene

__all__ = ['State', 'Top', 'scene', 'solve']


def __getattr__(name: str) -> object:
    """Import `solve` or `scene`, and numpy with it, when it is first asked for."""
    if name == 'solve':
        from spinning_top_sim.solvers.solve import solve  # noqa: PLC0415
        return solve
    if name == 'scene':
        from spinning_top_sim.tools.scene_file import scene  # noqa: PLC0415
        return scene
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
