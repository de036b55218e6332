# SPDX-License-Identifier: Apache-2.0
"""Grades the IMU of any rigid body against its poses; no top is needed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.causes import CLEARLY, DENSITIES, LIKE, OFFSETS, cost, judge
from spinning_top_sim.grade.columns import READINGS, STANDARD_GRAVITY, UP, Comparison, Imu
from spinning_top_sim.grade.files import PARTS, Recorded, known
from spinning_top_sim.physics.top import numbers
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.conventions import Convention
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.kinematics import MOST, Parts, Reals, Stretch, stretches
from spinning_top_sim.tools.report import Finding, Report

EXCERPT = 1000          # samples of a motion by which a convention is found, to be fast
SMALL = 0.1             # share of a reading that another convention may leave
HELD_RUNS, HELD_SHARE = 20, 0.95    # of a hold: runs of equal rows, share of equal length
JUMP = 10.0             # times a step of poses is longer than those beside and than usual


def grade_readings(parts: Parts, imu: Imu | None = None, *,
                   gravity: float = STANDARD_GRAVITY) -> Report:
    """
    Grade the IMU of any rigid body against its poses.  ValueError: a part is not as below.

    Parameters
    ----------
    parts : mapping
        Times (n,) [s] and values (n, k) of 'attitudes' (q(world <- body) as x, y, z, w), and of
        'positions', 'gyroscope', 'accelerations', 'magnetometer' where there are any; SI.
    imu : Imu, optional
        What is known of it; default: nothing, along axes of the body.
    gravity : float
        Where the body is [m/s^2]; that of another place on Earth is no fault.
    """
    imu, parts = imu or Imu(), _checked(parts)
    new = {name: held(name, values) for name, (_, values) in parts.items()}
    faults = [fault for _, found in new.values() for fault in found]
    rows = {name: new[name][0] if new[name][1] else slice(None) if name in READINGS else
            smooth(values) for name, (_, values) in parts.items()}
    bodies, left_out = stretches({name: (times[rows[name]], values[rows[name]])
                                  for name, (times, values) in parts.items()})
    unjudged = [f'{left_out:.3g} s in gaps, at jumps of poses, or between'] * bool(left_out > 0.0)
    unjudged += (f'{name}: there is none' for name in DENSITIES if name not in parts)
    why = ('beside held poses' if any(new[name][1] for name in new.keys() - READINGS.keys()) else
           'no part without a gap is long enough' if not bodies else
           f'the body turns by more than {MOST:g} rad between two samples'
           if any(body.coarse for body in bodies) else '')
    if why:
        return Report('readings', faults, unjudged=[f'readings: {why}', *unjudged])

    def judged(bodies: Sequence[Stretch]) -> Report:
        return Report('readings', faults, unjudged=unjudged).plus(*(
            judge(name, bodies, imu, gravity) if 'positions' in parts or name != 'accelerations'
            else Report('', unjudged=[f'{name}: without positions'])
            for name in READINGS if name in parts))

    report = judged(bodies)
    # A z that is down is left to the sign of gravity.
    convention = Convention() if report.faults in ([], ['gravity_sign']) else (
        convention_of(bodies, imu, gravity))
    if convention.parts:
        told = Finding('convention', f'attitudes are told as {convention.name}; this is undone')
        other = judged([undone(body, convention) for body in bodies]).plus(Report('', [told]))
        return other if cost(other.found) <= cost(report.found) else report
    return report


def _checked(told: Parts) -> Parts:
    """Return parts as those of a file are.  Raises ValueError."""
    recorded = Recorded()
    if not isinstance(told, Mapping):
        raise ValueError(f'parts of type {type(told).__name__}: must be a mapping')
    for name, pair in told.items():
        width = len(PARTS[known(name, [*PARTS][1:])][0])
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(f'{name}: must be times (n,) and values (n, {width})')
        values = numbers(name, pair[1], 'n', width)
        times = numbers(f'times of {name}', pair[0], len(values))
        recorded.add(name, '', 1e9 * times, values, [f'{name}[{k}]' for k in range(len(times))])
    recorded.check()
    return recorded.parts


def held(name: str, values: Reals) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Return which rows (n, k) differ from the one before, and a fault if all are repeated."""
    new = np.append(True, np.any(values[1:] != values[:-1], axis=1))
    runs = np.diff(np.flatnonzero(new))
    usual = runs[np.abs(runs - np.median(runs)) <= 1.0] if len(runs) >= HELD_RUNS else runs[:0]
    # Longer runs are allowed: the body rests.
    count = float(np.mean(usual)) if len(usual) > HELD_SHARE * len(runs) else 1.0
    return new, [Finding('held', f'{name}: each row is told {count:.3g} times: the sensor, or the '
                         'log, is slower than its stamps', count)] * (count >= 1.3)


def smooth(values: Reals) -> NDArray[np.bool_]:
    """Return which poses (n, k) are not beside a jump, a step unlike others and those beside."""
    values = np.abs(values) if values.shape[1] == 4 else values     # q and -q are one
    steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
    beside = np.maximum(np.append(steps[1:], 0.0), np.append(0.0, steps[:-1]))
    usual = float(np.median(steps)) or rms(steps)       # places may be rounded
    jumps = steps > JUMP * np.maximum(beside, usual) + 1e-9
    return ~(np.append(False, jumps) | np.append(jumps, False))


def undone(body: Stretch, convention: Convention) -> Stretch:
    """Return a motion whose poses are told in a convention."""
    return replace(body, rotation=Rotation.from_quat(convention.undo(body.rotation.as_quat())),
                   positions=Rotation.from_quat(convention.world).inv().apply(body.positions))


def convention_of(bodies: Sequence[Stretch], imu: Imu, gravity: float) -> Convention:
    """
    Return how attitudes are told: ours, unless another explains readings that ours does not.

    The readings tell axes of the sensor and turns about z, gravity tells a z that points down.
    """
    group = [one for one in conventions.group() if 'sensor' not in one.name and (
        one.conjugate or one.world[3] > 0.9 or Rotation.from_quat(one.world).apply(UP)[2] < 0.9)]
    body = max(bodies, key=lambda one: len(one.t))
    first = max(len(body.t) - EXCERPT, 0) // 2          # it may rest at first, and at last
    body = body.part(slice(first, first + EXCERPT))
    # No convention changes how fast quaternions change, and so none the noise in rates.
    widths = {name: [compared.motions[0][0].width] for name in ('gyroscope', 'accelerations')
              if (compared := Comparison(name, [body], imu, gravity)).motions}

    def left(convention: Convention) -> float:
        """Return the largest share of a reading that is left."""
        told, worst = undone(body, convention), 0.0
        for name, width in widths.items():
            compared = Comparison(name, [told], imu, gravity, width)
            model = compared.model(0)
            fit = model.fit(['total', *OFFSETS])
            size = 1.0 + fit.found[len(compared.always)]
            right = not model.clear('total', CLEARLY) or any(
                abs(size * unit - 1.0) < LIKE for unit in compared.units.values())
            worst = max(worst, fit.beyond * (fit.beyond > 2.0 * fit.noise) if right else 1.0)
            if worst > SMALL:
                break
        return worst

    after = [left(one) for one in group]
    # Of equally good ones the first has the fewest parts.
    best = int(np.argmax(np.array(after) <= conventions.AS_GOOD * min(after) + 1e-6))
    return group[best * (after[best] < SMALL)]
