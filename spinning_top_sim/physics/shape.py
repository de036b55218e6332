# SPDX-License-Identifier: Apache-2.0
"""What a top looks like: the solid cylinder that has its mass and moments of inertia."""

import math
from dataclasses import dataclass

from spinning_top_sim.physics.top import Top

# The thinnest disc that can still be seen, by its radius.
THINNEST = 0.02
# What can be drawn in single precision [m].
SMALLEST, LARGEST = 1e-6, 1e6


@dataclass(frozen=True)
class Shape:
    """
    A solid cylinder about the axis e3, and the end of the axis [m].

    centre : of the cylinder along e3, signed: the centre of mass
    tip : along e3, on the side of the centre of mass, half a radius out of the cylinder
    """

    radius: float
    height: float
    centre: float
    tip: float


def shape_of(top: Top) -> Shape:
    """
    Return the cylinder to draw for a top.

    It has lambda3 = M r^2/2 along its axis and M (3 r^2 + h^2)/12 across it, about the centre of
    mass.  Where there is none (see `Top.is_realizable`) it is a thin disc with the same lambda3,
    and without a mass it is drawn as of 1 kg.
    """
    mass = top.mass or 1.0
    radius = _drawable(math.sqrt(2.0 * (top.lambda3 / mass)))
    square = 12.0 * ((top.lambda1_at_com - 0.5 * top.lambda3) / mass)
    height = _drawable(max(math.sqrt(max(square, 0.0)), THINNEST * radius))
    reach = abs(top.com_distance) + 0.5 * height + 0.5 * radius
    return Shape(radius, height, top.com_distance, math.copysign(reach, top.com_distance or 1.0))


def _drawable(length: float) -> float:
    return min(max(length, SMALLEST), LARGEST)
