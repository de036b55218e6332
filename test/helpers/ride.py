# SPDX-License-Identifier: Apache-2.0
"""The top on a moving pivot: the pieces of a path, each an exact motion."""

from bisect import bisect_right
from typing import NamedTuple

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.pivot import NEVER_NS, Kinematics
from spinning_top_sim.solvers.vertical import AcceleratedMotion, posture_of


class Sample(NamedTuple):
    """
    What the top does at n times.

    quaternion : (n, 4) x, y, z, w of q(world <- body)
    omega, alpha : (n, 3) angular velocity and acceleration in the body
    position : (n, 3) of a point of the body in the world
    """

    quaternion: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    position: np.ndarray


def kinematics(path, times_ns):
    """Return position, velocity and acceleration (n, 3) of a pivot at times [ns]."""
    rows = [path.piece(int(t)).at(np.array([t])) for t in times_ns]
    return Kinematics(*(np.concatenate(part, axis=1).T for part in zip(*rows, strict=True)))


def changes(path, begin_ns, end_ns):
    """Return the times in [begin_ns, end_ns) at which another piece begins [ns]."""
    found, piece = [], path.piece(begin_ns)
    while piece.start_ns < end_ns:
        found.append(piece.start_ns)
        if piece.end_ns >= NEVER_NS:
            break
        piece = path.piece(piece.end_ns)
    return [t for t in found if t >= begin_ns]


class Ride:
    """The exact motions of a top along a path of its pivot, up to a time [ns]."""

    def __init__(self, top, start, path, until_ns):
        self.path, self.top = path, top
        self.pieces = [path.piece(t) for t in changes(path, path.start_ns, until_ns)]
        self.motions, posture = [], posture_of(top, start)
        for piece in self.pieces:
            self.motions.append(AcceleratedMotion(top, posture, piece.acceleration))
            if piece is not self.pieces[-1]:
                posture = self.motions[-1].posture(piece.end_ns - piece.start_ns)

    def at(self, times_ns, point=(0.0, 0.0, 0.0)):
        """Return a `Sample` at times (n,) [ns] in any order."""
        starts = [piece.start_ns for piece in self.pieces]
        rows = [self._one(int(t), bisect_right(starts, t) - 1, point) for t in times_ns]
        return Sample(*map(np.concatenate, zip(*rows, strict=True)))

    def _one(self, t, k, point):
        motion = self.motions[k]
        states = motion.states(range(t - self.pieces[k].start_ns, t - self.pieces[k].start_ns + 1))
        q = attitude.product(motion.vertical.rows, states.rows_quaternion)
        arm = np.stack(attitude.rotated(q, point), axis=-1)
        pivot = kinematics(self.path, [t])
        return (np.stack(q, axis=-1), states.angular_velocity, states.angular_acceleration,
                pivot.position + arm)
