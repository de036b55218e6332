# SPDX-License-Identifier: Apache-2.0
"""What a top looks like: in markers, models and pages."""

import math

from spinning_top_sim.physics.top import Top

# The thinnest disc that can still be seen, by its radius.
THINNEST = 0.02
# What can be drawn in single precision [m].
SMALLEST, LARGEST = 1e-6, 1e6


class Shape:
    """
    The solid cylinder about the axis e3 that is drawn for a top, and the end of the axis [m].

    It has lambda3 = M r^2/2 along its axis and M (3 r^2 + h^2)/12 across it, about the centre of
    mass.  Where there is none (see `Top.is_realizable`) it is a thin disc with the same lambda3,
    and without a mass it is drawn as of 1 kg.

    centre : of the cylinder along e3, signed: the centre of mass
    tip : along e3, on the side of the centre of mass, half a radius out of the cylinder
    """

    def __init__(self, top: Top) -> None:
        mass = top.mass or 1.0
        square = 12.0 * ((top.lambda1_at_com - 0.5 * top.lambda3) / mass)
        self.radius = _drawable(math.sqrt(2.0 * (top.lambda3 / mass)))
        self.height = _drawable(max(math.sqrt(max(square, 0.0)), THINNEST * self.radius))
        self.centre = top.com_distance
        reach = abs(self.centre) + 0.5 * self.height + 0.5 * self.radius
        self.tip = math.copysign(reach, self.centre or 1.0)


def _drawable(length: float) -> float:
    return min(max(length, SMALLEST), LARGEST)
