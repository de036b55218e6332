# SPDX-License-Identifier: Apache-2.0
"""
Conventions of attitudes: which of a finite group a stream of quaternions follows.

Ours is q(world <- sensor) as x, y, z, w, in a world of east, north, up.  Others are left factors
(another world), right factors (other axes of the sensor), the conjugate, and w first; a
left-handed program changes world and sensor at once.
"""

import itertools
import math
from functools import cache
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.physics.attitude import product
from spinning_top_sim.tools.identify import AXES, Reals, rms

# Directions of the axes x, y, z of worlds that programs use, in ours.
_DIRECTIONS = {'east': (1, 0, 0), 'north': (0, 1, 0), 'up': (0, 0, 1),
               'west': (-1, 0, 0), 'south': (0, -1, 0), 'down': (0, 0, -1)}
WORLDS = ('north-east-down', 'north-west-up', 'south-east-up', 'east-up-south', 'north-up-east',
          'south-up-west')
TURNS = Rotation.create_group('O')          # the 24 right-handed signed permutations
# A simpler convention is preferred to one that leaves up to this factor, or angle [rad], less.
AS_GOOD, SAME = 1.5, math.radians(0.1)
MOST = 3                # parts of a convention
IDENTITY, INVERSE = np.array(((0.0, 0.0, 0.0, 1.0), (-1.0, -1.0, -1.0, 1.0)))   # by factors


class Convention(NamedTuple):
    """
    How attitudes are told; the default is ours.

    w_first, conjugate : order w, x, y, z; q(sensor <- world)
    world : (4,) quaternion from our world to theirs: they tell `world` q `sensor`
    sensor : (4,) quaternion from their axes of the sensor to ours
    parts : what differs from ours, in words
    """

    w_first: bool = False
    conjugate: bool = False
    world: Reals = IDENTITY
    sensor: Reals = IDENTITY
    parts: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What differs from ours, in words; empty for ours."""
        return ', '.join(self.parts)

    def undo(self, told: Reals) -> Reals:
        """Return attitudes (n, 4) in our convention from those that are told."""
        q: Any = told[:, [1, 2, 3, 0]] if self.w_first else told
        if self.conjugate:
            q = q * INVERSE
        ours = np.array(product(product(self.world * INVERSE, q.T), self.sensor * INVERSE))
        return (ours / np.sqrt(np.sum(ours * ours, axis=0))).T


class Found(NamedTuple):
    """The best convention, and the rms errors [rad] of the attitudes read in ours and in it."""

    convention: Convention
    before: float
    after: float


@cache
def group() -> list[Convention]:
    """Return the conventions with at most MOST parts, those with the fewest first."""
    lefts = [((), Rotation.identity()), *(((f'world {name}',), Rotation.from_matrix(
        [_DIRECTIONS[word] for word in name.split('-')])) for name in WORLDS)]
    rights = [(() if turn.magnitude() < SAME else (f'sensor axes {axes(turn.as_matrix())}',), turn)
              for turn in TURNS]
    found = []
    for (said, left), (felt, right), w_first, conjugate in itertools.product(
            lefts, rights, (False, True), (False, True)):
        parts = (('w, x, y, z',) * w_first + ('conjugated',) * conjugate + said + felt)
        if len(parts) <= MOST:
            found.append(Convention(w_first, conjugate, left.as_quat(), right.as_quat(), parts))
    # Other axes of world and sensor at once are another order or sign of the vector part.
    for turn, w_first, sign in itertools.product(TURNS, (False, True), (1.0, -1.0)):
        parts = ('w, x, y, z',) * w_first + (f'vector part {axes(sign * turn.as_matrix())}',)
        found.append(Convention(w_first, sign < 0.0, turn.as_quat(), turn.inv().as_quat(), parts))
    return sorted(found, key=lambda one: len(one.parts))


def axes(matrix: Any) -> str:
    """Return a signed permutation in words: which of our axes their x, y, z are."""
    return ', '.join(f'{"-" if row.sum() < 0.0 else ""}{AXES[int(np.argmax(np.abs(row)))]}'
                     for row in matrix)


def best(told: Reals, truth: Reals, steady: bool = False) -> Found:
    """
    Return the convention in which attitudes agree best with the truth.

    told, truth : attitudes as they are told, and in our convention (n, 4)
    steady : whether a constant turn about the vertical is no error

    Some dozen attitudes that differ from each other by large turns suffice.
    """
    every = [(one, errors_of(one.undo(told), truth)) for one in group()]
    found = [Found(one, 0.0, rms((errors.about_mean() if steady else errors).whole))
             for one, errors in every]
    least = min(one.after for one in found)
    return next(one for one in found if one.after <= max(AS_GOOD * least, SAME))._replace(
        before=found[0].after)


class Errors(NamedTuple):
    """Attitude errors [rad]: tilt (n,) >= 0, and heading (n,) in [-pi, pi]."""

    tilt: Reals
    heading: Reals

    def about_mean(self) -> 'Errors':
        """Return the errors with the heading about its mean."""
        phase = np.exp(1j * self.heading)
        return self._replace(heading=np.angle(phase * np.conj(np.mean(phase))))

    @property
    def whole(self) -> Reals:
        """Tilt and heading together (n,)."""
        return np.hypot(self.tilt, self.heading)


def errors_of(estimates: Reals, truth: Reals) -> Errors:
    """
    Split q_est q_true^-1 into heading and tilt (Laidig et al. 2021, eq. 2-4).

    estimates, truth : q(world <- sensor) as x, y, z, w (n, 4)
    """
    x, y, z, w = product(cast(Any, estimates.T), (truth * INVERSE).T)
    return Errors(2.0 * np.arctan2(np.hypot(x, y), np.hypot(z, w)),
                  2.0 * np.arctan2(np.copysign(z, z * w), np.abs(w)))
