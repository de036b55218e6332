# SPDX-License-Identifier: Apache-2.0
"""Grades the IMU of any rigid body against its poses; no top is needed."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.causes import CLEARLY, OFFSETS, judge
from spinning_top_sim.grade.columns import READINGS, STANDARD_GRAVITY, UP, Comparison, Imu
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.conventions import Convention
from spinning_top_sim.tools.kinematics import MOST, Parts, Reals, Stretch, stretches
from spinning_top_sim.tools.report import Finding, Report

EXCERPT_S, SAMPLES = 5.0, (1000, 3000)        # of a motion by which a convention is found
# Share of a reading left in ours, of that in another convention, and of the reading there.
WRONG, RIGHT, SMALL = 0.2, 0.3, 0.1
HELD_RUNS, HELD_SHARE = 20, 0.95    # runs of equal readings that are a hold, and as long as usual


def grade_readings(parts: Parts, imu: Imu | None = None, *, gravity: float = STANDARD_GRAVITY,
                   subject: str = 'readings') -> Report:
    """
    Grade the IMU of any rigid body against its poses.

    Parameters
    ----------
    parts : mapping
        Times (n,) [s] and values (n, k) of 'attitudes' (q(world <- body) as x, y, z, w), and of
        'positions', 'gyroscope', 'accelerations', 'magnetometer' where there are any; SI.
    imu : Imu, optional
        What is known of it; default: nothing, along axes of the body.
    gravity : float
        Where the body is [m/s^2]; that of another place on Earth is no fault.
    subject : str
        Name of what is graded.
    """
    imu, parts, faults = imu or Imu(), dict(parts), list[Finding]()
    for name, (times, values) in parts.items():
        new, hold = held(name, values)
        if hold and name not in READINGS:
            return Report(subject, hold, unjudged=['readings, beside held poses'])
        faults += hold
        parts[name] = (times[new], values[new]) if hold else (times, values)
    bodies, left_out = stretches(parts)
    notes = [f'{left_out:.3g} s in gaps, or between them, are not graded'] if left_out else []
    if not bodies:
        return Report(subject, faults, {}, notes, unjudged=[
            'readings: no part without a gap is long enough'])
    if any(body.coarse for body in bodies):
        return Report(subject, faults, {}, notes, unjudged=[
            f'readings: the body turns by more than {MOST:g} rad between two samples'])
    convention = convention_of(bodies, imu, gravity)
    if convention.parts:
        faults.append(Finding('convention', f'attitudes are told as {convention.name}; this is '
                              'undone'))
        bodies = [undone(body, convention) for body in bodies]
    return Report(subject, faults, {}, notes).plus(*(
        judge(name, bodies, imu, gravity, placed='positions' in parts) for name in READINGS))


def held(name: str, values: Reals) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Return which rows (n, k) are not those before, and the fault if each is told again."""
    new = np.append(True, np.any(values[1:] != values[:-1], axis=1))
    runs = np.diff(np.flatnonzero(new))
    usual = runs[np.abs(runs - np.median(runs)) < 1.0] if len(runs) >= HELD_RUNS else runs[:0]
    # Others are longer: the body rests.
    count = float(np.mean(usual)) if len(usual) > HELD_SHARE * len(runs) else 1.0
    return new, [Finding('held', f'{name}: each row is told {count:.3g} times: the sensor, or the '
                         'log, is slower than its stamps', count)] * (count >= 1.3)


def undone(body: Stretch, convention: Convention) -> Stretch:
    """Return a motion whose poses are told in a convention."""
    return replace(body, rotation=Rotation.from_quat(convention.undo(body.rotation.as_quat())),
                   positions=Rotation.from_quat(convention.world).inv().apply(body.positions))


def _turned(one: Convention) -> bool:
    """Return whether a world with the same z is turned: the same as other axes of the sensor."""
    turn = Rotation.from_quat(one.world)
    return bool(turn.magnitude() > 0.1 and turn.apply(UP)[2] > 0.9 and not one.conjugate)


def convention_of(bodies: Sequence[Stretch], imu: Imu, gravity: float) -> Convention:
    """
    Return how attitudes are told: ours, unless another explains readings that ours does not.

    Axes of the sensor are left to the readings, and a z that is down to the sign of gravity.
    """
    ours, *others = (one for one in conventions.group() if not (
        any(part.startswith('sensor') for part in one.parts) or _turned(one)))
    body = max(bodies, key=lambda one: len(one.t))
    angles = np.append(0.0, np.cumsum((body.rotation[:-1].inv() * body.rotation[1:]).magnitude()))
    count = min(int(np.clip(EXCERPT_S / body.step, *SAMPLES)), len(angles) - 1)
    first = int(np.argmax(angles[count:] - angles[:-count]))
    body = body.part(slice(first, first + count))       # in which it turns the most

    # No convention changes how fast quaternions change, and so none the noise in rates.
    widths = {name: [compared.motions[0][0].width] for name in ('gyroscope', 'accelerations')
              if (compared := Comparison(name, [body], imu, gravity)).motions}

    def left(convention: Convention, most: float = math.inf, sign: float = 1.0) -> float:
        """Return the largest share of a reading that is not right in any unit, or one > most."""
        told, worst = undone(body, convention), 0.0
        for name, width in widths.items():
            compared = Comparison(name, [told], imu, sign * gravity, width)
            model = compared.model(0)
            fit = model.fit(['total', *OFFSETS])
            size = 1.0 + fit.found[len(compared.always)]
            right = not model.clear('total', CLEARLY) or any(
                abs(size * unit - 1.0) < 0.1 for unit in compared.units.values())
            worst = max(worst, fit.beyond if right else 1.0)
            if worst > most:
                break
        return worst

    before = left(ours)
    enough = min(RIGHT * before, SMALL)
    if before < WRONG or left(ours, sign=-1.0) < enough:
        return ours
    after = [left(one, enough) for one in others]
    # Of equally good ones the first has the fewest parts.
    best = int(np.argmax(np.array(after) <= 1.5 * min(after) + 1e-6))
    return others[best] if after[best] < enough else ours
