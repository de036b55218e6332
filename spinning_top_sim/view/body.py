# SPDX-License-Identifier: Apache-2.0
"""The meshes of the body, and of its stand."""

import math

import numpy as np
import trimesh
from trimesh import creation
from trimesh.transformations import rotation_matrix

from spinning_top_sim.shape import Shape

Colour = tuple[int, int, int]
BLUE, WHITE, GOLD, STEEL = (43, 98, 176), (245, 247, 250), (246, 178, 38), (92, 99, 110)
SPOKES, SMOOTH = 8, 96              # number of spokes and of the sides of a round


def wheel(shape: Shape, length: float) -> dict[str, tuple[trimesh.Trimesh, Colour]]:
    """
    Return a spoked wheel with a marked rim, on a tapered axle of a signed length.

    As meshes in the frame of the body and their colours, by name.
    """
    radius, height = shape.radius, shape.height
    turns = [rotation_matrix(math.tau * k / SPOKES, (0, 0, 1)) for k in range(SPOKES)]
    spoke = creation.box((0.72 * radius, 0.045 * radius, 0.045 * radius))
    spoke.apply_translation((0.46 * radius, 0.0, 0.0))
    mark = creation.box((0.2 * radius, 0.1 * radius, 1.03 * height))
    mark.apply_translation((0.905 * radius, 0.0, 0.0))
    marks = [mark.copy().apply_transform(turn) for turn in turns]
    marked_spoke = spoke.copy().apply_scale((1.0, 1.6, 1.6))
    hub = creation.cylinder(0.11 * radius, max(0.6 * height, 0.1 * radius), sections=SMOOTH)
    thick = abs(length) * np.array([(0, 0), (.024, .1), (.024, .8), (.012, .95), (0, 1)])
    axle = creation.revolve(np.column_stack((thick[:, 0], thick[:, 1] * np.sign(length))))
    parts = {
        'rim': (creation.annulus(0.82 * radius, radius, height, sections=SMOOTH), BLUE),
        'marks': (_merged(marks[1:]), WHITE), 'mark': (_merged([marks[0], marked_spoke]), GOLD),
        'spokes': (_merged([hub, *(spoke.copy().apply_transform(turn) for turn in turns[1:])]),
                   STEEL)}
    for mesh, _ in parts.values():
        mesh.apply_translation((0.0, 0.0, shape.centre))
    return {**parts, 'axle': (axle, STEEL)}


def stand(radius: float) -> trimesh.Trimesh:
    """Return a peg of height 1 [radius] under the pivot, on a foot."""
    return creation.revolve(radius * np.array(
        [(0, -1), (.2, -1), (.2, -.98), (.05, -.93), (.03, -.6), (.012, -.02), (0, 0)]),
        sections=SMOOTH)


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    merged = trimesh.util.concatenate(meshes)
    assert isinstance(merged, trimesh.Trimesh)
    return merged
