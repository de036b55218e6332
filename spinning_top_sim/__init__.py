# SPDX-License-Identifier: Apache-2.0
"""Real-time and offline simulation of the heavy symmetric top, with a known exact truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spinning_top_sim.physics.top import State, Top

if TYPE_CHECKING:
    from spinning_top_sim.solvers.solve import solve

__all__ = ['State', 'Top', 'scene', 'solve']


def scene(name: str) -> tuple[Top, State]:
    """
    Return the top and the start of a scene, for `solve`.

    Parameters
    ----------
    name : str
        Of a scene that is installed, such as 'looping', or the path of a parameter file.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        For a name that is not known, a wrong file, or a scene whose pivot moves.
    """
    from spinning_top_sim.streams import parameters  # noqa: PLC0415 - numpy with it
    from spinning_top_sim.tools import scene_file  # noqa: PLC0415

    values = parameters.checked(scene_file.read_scene(scene_file.file_of('scene', str(name))))
    if parameters.pivot_path(values) is not None:
        raise ValueError(f'scene {name}: its pivot moves, which `solve` does not know; '
                         f'see spinning-top simulate --scene {name}')
    return parameters.top_of(values), parameters.start_state(values)


def __getattr__(name: str) -> object:
    """Import `solve`, and numpy with it, when it is first asked for."""
    if name == 'solve':
        from spinning_top_sim.solvers.solve import solve  # noqa: PLC0415
        return solve
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
