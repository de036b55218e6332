# SPDX-License-Identifier: Apache-2.0
"""What a sensor reads in a motion, what it should read, and the effects of defects."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.measures import rms
from spinning_top_sim.grade.motion import MARGIN, Motion
from spinning_top_sim.grade.scenes import Reals, rotation_of

FORCES = ('accelerations', 'velocities')
_per_step = partial(np.gradient, axis=0)        # change per step of values (m, 3)


class Readings(NamedTuple):
    """What a sensor reads in one motion, and what it should read, over its rms `size`."""

    reading: Reals                  # (n, 3)
    first: int                      # reading at which the effects begin
    effects: Mapping[str, Reals]    # terms, their sum `total`, and its change by defects (m, 3)
    terms: Sequence[str]            # of the right reading
    size: float

    def at_lag(self, lag: int, names: Sequence[str] = ()) -> tuple[Reals, dict[str, Reals]]:
        """Return reading less total, and the effects, for a reading that is `lag` samples late."""
        total, begin = self.effects['total'], self.first + lag
        end = min(begin + len(total), len(self.reading))
        skip = max(0, -begin)
        part = slice(skip, end - begin)
        return self.reading[begin + skip:end] - total[part], {
            name: self.effects[name][part] for name in names or self.effects}


def readings_of(kind: str, motion: Motion) -> Readings | None:
    """Return the readings of a kind of sensor, None if there are none."""
    said, body, inner, w = motion.trajectory, motion.body, slice(MARGIN, -MARGIN), motion.rates
    reading: Reals | None = getattr(said, 'increments' if kind in ('rotations', 'velocities')
                                    else kind)
    if reading is None:
        return None
    rotation, first, arms = said.rotation[inner], MARGIN, np.empty((0, len(w), 3))
    mounting = Rotation.identity() if kind == 'rates' else rotation_of(body.mounting)
    if kind in ('rates', 'gyroscope'):
        terms = {'rates': w}
    elif kind == 'magnetometer':
        terms = {'field': rotation.inv().apply(body.field)}
    elif kind == 'rotations':
        reading, first = reading[:, :3] / said.step, first + 1
        terms = {'rates': (rotation[:-1].inv() * rotation[1:]).as_rotvec() / said.step}
    else:
        first, a, w = 2 * MARGIN, motion.angular_accelerations, w[inner]
        axes = np.eye(3)[:, np.newaxis]
        tangential, centripetal = np.cross(a, axes), np.cross(w, np.cross(w, axes))
        arms = tangential + centripetal
        terms = {'gravity': body.gravity * rotation[inner].inv().apply((0.0, 0.0, 1.0)),
                 'tangential': np.tensordot(body.lever_arm, tangential, 1),
                 'centripetal': np.tensordot(body.lever_arm, centripetal, 1)}
        if kind == 'velocities':
            reading, first = reading[:, 3:] / said.step, first + 1
            arms = 0.5 * (arms[:, :-1] + arms[:, 1:])
            terms = {name: 0.5 * (term[:-1] + term[1:]) for name, term in terms.items()}
    effects = {name: mounting.inv().apply(term) for name, term in terms.items()}
    effects['total'] = total = sum(effects.values(), np.zeros(1))
    turn = said.rotation[first:first + len(total)] * mounting
    effects |= {
        'step': _per_step(total),                       # a step later
        'world': (world := turn.apply(total)),          # in axes of the world
        'reversed': turn.apply(world)}                  # as if the IMU turned the other way
    if kind in FORCES:
        back, kinematic = turn.inv().apply, total - effects['gravity']
        effects |= {
            'kinematic': kinematic,                     # of the motion
            # The motion a step later, then the axes, then the angular acceleration.
            'difference': back(_per_step(turn.apply(kinematic))),
            'axes late': back(_per_step(world)) - effects['step'],
            'tangential step': _per_step(effects['tangential']),
            # 1 m/s^2 along axes of the IMU; a lever arm longer by 1 m along axes of the body.
            **{f'fixed {k}': 0.0 * total + axis for k, axis in enumerate(np.eye(3))},
            **{f'arm {k}': mounting.inv().apply(arm) for k, arm in enumerate(arms)}}
    size = rms(reading) or 1.0
    return Readings(reading / size, first, {
        name: effect / size for name, effect in effects.items()}, [*terms], size)
