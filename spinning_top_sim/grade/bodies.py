# SPDX-License-Identifier: Apache-2.0
"""Grades the IMU of any rigid body against its poses; no top is needed."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.causes import OFFSETS, judge
from spinning_top_sim.grade.columns import READINGS, STANDARD_GRAVITY, Comparison, Imu
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
        if hold:
            faults.append(hold)
            if name not in READINGS:
                return Report(subject, faults, unjudged=['readings, beside held poses'])
            parts[name] = times[new], values[new]
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


def held(name: str, values: Reals) -> tuple[NDArray[np.bool_], Finding | None]:
    """Return which rows (n, k) are not those before, and the fault if each is told again."""
    new = np.append(True, np.any(values[1:] != values[:-1], axis=1))
    runs = np.diff(np.flatnonzero(new))
    if len(runs) < HELD_RUNS:
        return new, None
    usual = math.floor(float(np.median(runs)))
    # Others are longer: the body rests.
    near = max((runs[(runs == usual + k) | (runs == usual + k + 1)] for k in (-1, 0)), key=len)
    count = float(np.mean(near))
    return new, Finding('held', f'{name}: each row is told {count:.3g} times: the sensor, or the '
                        'log, is slower than its stamps', count) if (
                            len(near) >= HELD_SHARE * len(runs) and count >= 1.3) else None


def undone(body: Stretch, convention: Convention) -> Stretch:
    """Return a motion whose poses are told in a convention."""
    return replace(body, rotation=Rotation.from_quat(convention.undo(body.rotation.as_quat())),
                   positions=Rotation.from_quat(convention.world).inv().apply(body.positions))


def convention_of(bodies: Sequence[Stretch], imu: Imu, gravity: float) -> Convention:
    """
    Return how attitudes are told: ours, unless another explains readings that ours does not.

    Axes of the sensor are left to the readings, and a z that is down to the sign of gravity.
    """
    ours, *others = [one for one in conventions.group() if not any(
        part.startswith('sensor') for part in one.parts)]
    body = max(bodies, key=lambda one: len(one.t))
    angles = np.append(0.0, np.cumsum((body.rotation[:-1].inv() * body.rotation[1:]).magnitude()))
    count = int(np.clip(EXCERPT_S / body.step, *SAMPLES))
    first = int(np.argmax(angles[count:] - angles[:-count])) if len(angles) > count else 0
    body = body.part(slice(first, first + count))       # in which it turns the most

    # No convention changes how fast quaternions change, and so none the noise in rates.
    widths = {name: compared.motions[0][0].width for name in ('gyroscope', 'accelerations')
              if (compared := Comparison(name, [body], imu, gravity)).motions}
    if not widths:
        return ours

    def left(convention: Convention, sign: float = 1.0, most: float = math.inf) -> Reals:
        """Return the shares of readings that are not right in any unit; inf after one > most."""
        told, shares = undone(body, convention), np.full(len(widths), math.inf)
        for k, (name, width) in enumerate(widths.items()):
            compared = Comparison(name, [told], imu, sign * gravity, [width])
            model = compared.model(0)
            fit = model.fit(['total', *OFFSETS])
            right = not model.clear('total', 10.0) or any(
                abs((1.0 + fit.found[len(compared.always)]) * size - 1.0) < 0.1
                for size in compared.units.values())
            shares[k] = fit.beyond if right else 1.0
            if shares[k] > most:
                break
        return shares

    before = left(ours)
    enough = min(RIGHT * float(np.max(before)), SMALL)
    if np.max(before) < WRONG or np.max(left(ours, -1.0)) < enough:
        return ours
    after = np.array([left(one, most=enough) for one in others])
    # No reading may agree less.
    worst = np.where(np.any(after > 1.5 * before + 1e-3, axis=1), np.inf, np.max(after, axis=1))
    # Of equally good ones the first has the fewest parts.
    best = int(np.argmax(worst <= 1.5 * np.min(worst) + 1e-6))
    return others[best] if worst[best] < enough else ours
