# SPDX-License-Identifier: Apache-2.0
"""Grades the IMU of any rigid body against its poses; no top is needed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spinning_top_sim.grade import sensors
from spinning_top_sim.grade.effects import STANDARD_GRAVITY, Comparison, Imu
from spinning_top_sim.grade.kinematics import Reals, Stretch, stretches
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.conventions import Convention
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.report import Finding, Mark

READINGS = 'gyroscope', 'accelerations', 'magnetometer'
Parts = Mapping[str, tuple[Reals, Reals]]
# Runs of equal readings are a hold if most are as long as each other, and there are enough.
HELD_RUNS, HELD_SHARE = 20, 0.9
EXCERPT = 3000                  # samples by which a convention is found
WRONG, RIGHT = 0.2, 0.3         # share left of a reading in ours, and of that in another convention


def judge(parts: Parts, imu: Imu, gravity: float = STANDARD_GRAVITY, *,
          exact_gravity: bool = False, covariance: Mapping[str, Reals] | None = None,
          ) -> sensors.Judged:
    """
    Return what is wrong with the readings, and with how attitudes are told.

    parts : times (n,) [s] and values (n, k) by name, as of `files.Recorded`
    gravity, exact_gravity : where the body is [m/s^2]; whether another value is a fault
    covariance : (3, 3) that is declared, by name
    """
    faults: list[Finding] = []
    notes: list[str] = []
    marks: dict[str, Mark] = {}
    parts = dict(parts)
    for name, (times, values) in parts.items():
        if name in READINGS and (count := held(values)):
            faults.append(Finding('held', f'{name}: each reading is told {count:.3g} times: '
                                  'the sensor, or the log, is slower than its stamps', count))
            new = np.append(True, np.any(values[1:] != values[:-1], axis=1))
            parts[name] = times[new], values[new]
    bodies = stretches(parts, notes)
    if not bodies:
        return sensors.Judged(faults, marks, [*notes, 'no part without a gap is long enough'])
    convention = found_convention(bodies, imu, gravity)
    if convention.parts:
        faults.append(Finding('convention', f'attitudes are told as {convention.name}; this is '
                              'undone'))
        bodies = [undone(one, convention) for one in bodies]
    for name in READINGS:
        found = sensors.judge(name, bodies, imu, gravity, exact_gravity=exact_gravity,
                              covariance=(covariance or {}).get(name))
        faults, notes = [*faults, *found.faults], [*notes, *found.notes]
        marks.update(found.marks)
    return sensors.Judged(faults, marks, notes)


def held(values: Reals) -> float:
    """Return how many times each reading is told in a hold, 0 where there is none."""
    new = np.flatnonzero(np.append(True, np.any(values[1:] != values[:-1], axis=1)))
    runs = np.diff(new)
    if len(runs) < HELD_RUNS or np.mean(runs) < 1.3:
        return 0.0
    usual = math.floor(float(np.median(runs)))
    near = max(np.mean((runs == usual + shift) | (runs == usual + shift + 1))
               for shift in (-1, 0))
    return float(np.mean(runs)) if near >= HELD_SHARE else 0.0


def undone(body: Stretch, convention: Convention) -> Stretch:
    """Return a motion whose poses were told in a convention."""
    told = body.rotation.as_quat()
    ours = conventions.Rotation.from_quat(convention.undo(told))
    world = conventions.Rotation.from_quat(convention.world).inv()
    return replace(body, rotation=ours, positions=world.apply(body.positions))


def found_convention(bodies: Sequence[Stretch], imu: Imu, gravity: float) -> Convention:
    """
    Return how attitudes are told: ours, unless another explains readings that ours does not.

    Axes of the sensor and the sign of gravity are left to the readings.
    """
    ours, *others = [one for one in conventions.group(WORLDS, 3) if not any(
        part.startswith('sensor') for part in one.parts)]
    bodies = [excerpt(max(bodies, key=lambda one: len(one.t)))]
    present = [name for name in READINGS[:2] if name in bodies[0].readings]
    before = [_left(name, bodies, imu, gravity) for name in present]
    if not present or max(before) < WRONG:
        return ours
    after = np.array([[_left(name, [undone(body, one) for body in bodies], imu, gravity)
                       for name in present] for one in others])
    # No reading may agree less.
    worst = np.where(np.any(after > 1.5 * np.array(before) + 1e-3, axis=1), np.inf,
                     np.max(after, axis=1))
    # Of equally good ones the first has the fewest parts.
    best = int(np.argmax(worst <= 1.5 * np.min(worst) + 1e-6))
    return others[best] if worst[best] < RIGHT * max(before) else ours


def excerpt(body: Stretch) -> Stretch:
    """Return the part of a motion, of EXCERPT samples at most, in which it turns the most."""
    angles = np.append(0.0, np.cumsum((body.rotation[:-1].inv() * body.rotation[1:]).magnitude()))
    first = int(np.argmax(angles[EXCERPT:] - angles[:-EXCERPT])) if len(angles) > EXCERPT else 0
    part = slice(first, first + EXCERPT)
    return replace(body, t=body.t[part], rotation=body.rotation[part],
                   positions=body.positions[part],
                   readings={name: values[part] for name, values in body.readings.items()})


WORLDS = 'east-up-south', 'north-up-east'


def _left(name: str, bodies: Sequence[Stretch], imu: Imu, gravity: float) -> float:
    """Return the share of a reading that is not a positive multiple of the right one."""
    comparison = Comparison(name, bodies, imu, gravity)
    if not comparison.smoothed:
        return 0.0
    stack = comparison.stack(0)
    names = ['total', *stack.always, 'offset 0', 'offset 1', 'offset 2']
    found, _, residual = stack.fit(names)
    sizes = 1.0, *sensors.KINDS[name].units.values()
    right = any(abs((1.0 + found[0]) / size - 1.0) < 0.1 for size in sizes)
    return rms(residual) if right else 1.0
