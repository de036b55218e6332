# SPDX-License-Identifier: Apache-2.0
"""
What may be wrong with a filter.

A constant misinterpretation of readings or attitudes is identified by inverting it: if the error
disappears, it was the cause.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.scenarios import GRAVITY, Reals, Run

# From a run to that whose readings are fed instead.
ChangeReadings = Callable[[Run], Run]
ChangeRows = Callable[[Reals], Reals]

AXES = 'xyz'
LIKELY = 4                      # signed permutations of a sensor that are tried
SIGNED = [sign * one for one in Rotation.create_group('O').as_matrix().round()
          for sign in (1.0, -1.0) if np.trace(sign * one) < 3.0]


class Hypothesis(NamedTuple):
    """A possible cause of errors, and its inverse."""

    faults: tuple[str, ...] = ()    # names; none if it is no fault
    text: str = ''                  # what its inverse is
    on_readings: ChangeReadings | None = None       # the inverse; None: nothing is fed again
    on_attitudes: ChangeRows = lambda estimates: estimates      # the inverse
    shift: bool = False             # it shifts the time: rates are compared without its inverse


def changed(names: Sequence[str], change: ChangeRows) -> ChangeReadings:
    """Return what changes these columns of a run, such as the readings (n, 3) of a sensor."""
    def with_changes(run: Run) -> Run:
        readings: Any = {name: change(getattr(run, name)) for name in names}
        return replace(run, **readings)
    return with_changes


def _turned(left: Sequence[float], right: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
            ) -> ChangeRows:
    """Return the multiplication of attitudes by quaternions x, y, z, w on both sides."""
    return lambda estimates: (Rotation.from_quat(left) * Rotation.from_quat(estimates)
                              * Rotation.from_quat(right)).as_quat()


def wired(name: str, text: str, matrix: Any, offset: Any = 0.0,
          fault: str = '') -> Hypothesis:
    """Return the hypothesis that the readings of a sensor need this matrix and offset."""
    return Hypothesis((fault or f'{name}_wiring',), text, on_readings=changed(
        (name,), lambda rows: rows @ matrix.T + offset))


def shifted(rows: Reals, samples: int) -> Reals:
    """Return rows whose k-th is the one at k + samples; the first or the last is repeated."""
    return rows[np.clip(np.arange(len(rows)) + samples, 0, len(rows) - 1)]


def of_world(run: Run) -> Run:
    """Return rates about axes of the world."""
    return replace(run, gyroscope=Rotation.from_quat(run.truth).apply(run.gyroscope))


def untilted(run: Run) -> Run:
    """Return the field as if the sensor were level, with the same heading (z, y', x'')."""
    true = Rotation.from_quat(run.truth)
    level = Rotation.from_euler('z', true.as_euler('ZYX')[:, :1])
    return replace(run, magnetometer=level.inv().apply(true.apply(run.magnetometer)))


def axes(matrix: Reals) -> str:
    """Return a signed permutation in words."""
    return ', '.join(f'{"-" if row.sum() < 0 else ""}{AXES[int(np.argmax(np.abs(row)))]}'
                     for row in matrix)


def permuted(name: str, fit: Callable[[Reals], Any]) -> list[Hypothesis]:
    """Return the hypotheses that the filter has those signed permutations that fit best."""
    return [wired(name, f'with {axes(one.T)} of the {name} for its x, y, z', one.T)
            for one in sorted(SIGNED, key=fit, reverse=True)[:LIKELY]]


def relabelled(matrix: Reals) -> Hypothesis:
    """Return the hypothesis that the vector part of the attitude has other axes or signs."""
    if np.linalg.det(matrix) > 0.0:
        name = 'frame_ned'
    else:
        name = 'conjugated' if np.all(np.diag(matrix)) else 'component_order'
    return Hypothesis((name,), f'read with {axes(matrix)} of its vector part for x, y, z',
                      on_attitudes=lambda q: np.hstack((q[:, :3] @ matrix.T, q[:, 3:])))


def delayed(names: Sequence[str], samples: float) -> Hypothesis:
    """Return the hypothesis that sensors are so many samples late, rounded."""
    return Hypothesis(('lag',), f'with the {" and ".join(names)} {round(samples)} samples earlier',
                      on_readings=changed(names, lambda rows: shifted(rows, round(samples))))


def sharpened(names: Sequence[str], samples: float) -> Hypothesis:
    """Return the hypothesis of a low pass of first order with this time constant [samples]."""
    return Hypothesis(('lag',), f'with the inverse of a low pass of {samples:.3g} samples on the '
                      f'{" and ".join(names)}', on_readings=changed(
                          names, lambda rows: rows + samples * np.diff(
                              rows, axis=0, prepend=rows[:1])))


# For filters that correct before they take the step: readings of the step before.  It is no fault.
CORRECTS_FIRST = delayed(('accelerometer', 'magnetometer'), -1)._replace(faults=(), shift=True)
_HALF = 0.5 ** 0.5
_CONJUGATE, _W_LAST = np.array((-1.0, -1.0, -1.0, 1.0)), [1, 2, 3, 0]
GRAVITY_SIGN = Hypothesis(('gravity_sign',), 'with the sign of the accelerometer changed',
                          on_readings=changed(('accelerometer',), np.negative))
# Of attitudes; nothing is fed again.
MISREADINGS = (
    Hypothesis(('component_order',), 'read as w, x, y, z', on_attitudes=lambda q: q[:, _W_LAST]),
    Hypothesis(('conjugated',), 'conjugated', on_attitudes=lambda q: q * _CONJUGATE),
    Hypothesis(('frame_ned',), 'read as attitude in a world north-east-down',
               on_attitudes=_turned((_HALF, _HALF, 0.0, 0.0))),
    Hypothesis(('frame_ned',), 'read as attitude of axes forward-right-down in a world '
               'north-east-down',
               on_attitudes=_turned((_HALF, _HALF, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),
    Hypothesis(('frame_ned',), 'read as attitude in a world north-west-up',
               on_attitudes=_turned((0.0, 0.0, _HALF, _HALF))),
    Hypothesis(('conjugated', 'component_order'), 'read as w, x, y, z and conjugated',
               on_attitudes=lambda q: q[:, _W_LAST] * _CONJUGATE),
    *map(relabelled, SIGNED))
UNITS = [wired('accelerometer', f'with the accelerometer multiplied by {by:.4g}', by * np.eye(3))
         for by in (GRAVITY, 1.0 / GRAVITY)]
LEVEL = Hypothesis(('magnetometer_wiring',), 'with the field of a level sensor',
                   on_readings=untilted)


def ambiguous(one: Hypothesis, absolute: bool) -> Hypothesis:
    """Return a hypothesis that has both names where two cannot be told apart."""
    if absolute or one.faults not in (('gravity_sign',), ('frame_ned',)):
        return one
    return one._replace(faults=('frame_ned', 'gravity_sign'),
                        text=f'{one.text}; the two cannot be told apart without a heading')
