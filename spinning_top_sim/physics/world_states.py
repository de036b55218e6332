# SPDX-License-Identifier: Apache-2.0
"""States of a top on a pivot that accelerates, as they are in the world."""

from __future__ import annotations

from functools import cached_property
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion
from spinning_top_sim.physics.pivot import Kinematics, Piece, kinematics
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import Top


class WorldStates(States):
    """
    States about another vertical, seen from the world.

    Attitude and Euler angles are those in the world: theta in [0, pi], phi and psi in
    [-2 pi, 2 pi].  Energy, Lz and `start` are those in the frame of the pivot about the vertical
    there; energy and Lz are constants of the motion.

    Parameters
    ----------
    top : Top
        In the gravity of the world.
    moved : States
        In the frame of the vertical.
    rotation : (4, 1)
        q(world <- frame) as x, y, z, w.
    ride : Piece
        What the pivot does.
    times_ns : (n,)
        Simulated times [ns], on which the pivot depends.
    """

    # What is the same.
    t, l3, lz, transverse_velocity = (cached_property(attrgetter(f'_moved.{name}')) for name in (
        't', 'l3', 'lz', 'transverse_velocity'))

    def __init__(self, top: Top, moved: States, rotation: Quaternion, ride: Piece,
                 times_ns: NDArray[np.int64]) -> None:
        super().__init__(top, moved.start, len(moved))
        self.method, self._moved, self._rotation = moved.method, moved, rotation
        self._ride, self._times_ns = ride, times_ns
        self._acceleration = tuple(ride.begins[6:].tolist())

    @cached_property
    def pivot(self) -> Kinematics:
        return kinematics([self._ride], [len(self)], self._times_ns)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        # Without -0.0, which a product with the identity leaves or not.
        x, y, z, w = (part + 0.0 for part in attitude.product(
            self._rotation, self._moved.rows_quaternion))
        return x, y, z, w

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        x, y, z, w = self.rows_quaternion
        half_sum, half_difference = np.arctan2(z, w), np.arctan2(-x, y)
        return half_sum + half_difference, self.theta_folded, half_sum - half_difference

    @cached_property
    def _meridian(self) -> tuple[Column, Column, Column]:
        """Cosine and sine of psi, and sin(theta)/2: alpha times the conjugate of beta."""
        x, y, z, w = self.rows_quaternion
        cosine, sine = w * y - z * x, w * x + z * y
        half = np.sqrt(cosine * cosine + sine * sine)
        at_pole = half == 0.0
        if at_pole.any():
            cosine, sine = np.where(at_pole, w + y, cosine), np.where(at_pole, z + x, sine)
        scale = np.where(at_pole, 1.0, half)
        return cosine / scale, sine / scale, half

    @cached_property
    def theta_dot(self) -> Column:
        (w1, w2), (cosine, sine, _) = self.transverse_velocity, self._meridian
        theta_dot: Column = w1 * sine + w2 * cosine
        return theta_dot

    @cached_property
    def phi_dot(self) -> Column:
        """0 where the axis is vertical."""
        (w1, w2), (cosine, sine, half) = self.transverse_velocity, self._meridian
        tilts = half > 0.0
        return np.where(tilts, 0.5 * (w2 * sine - w1 * cosine) / np.where(tilts, half, 1.0), 0.0)
