# SPDX-License-Identifier: Apache-2.0
"""
The runs of one exam: what the filter is fed with, and what it answers.

A kick is a turn that the gyroscope alone reads, in one step of a rest.  The difference of the
attitudes with and without it is the filter's answer.  Without a field, nothing but the gyroscope
shows a kick about the vertical: the answer is its use of the rates.  After other kicks, gravity
leads the attitude back.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures, motions
from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.motions import RATE, STARTS, Motion, Reals, Run
from spinning_top_sim.tools.conventions import Convention, Errors, errors_of

# A filter is settled if it is STILL in the second half of rests at the start; slow ones get
# longer ones.
LEADS_S, STILL = (10.0, 30.0, 120.0), math.radians(0.05)
ARM = 0.1, 0.0, 0.0                         # of the IMU off the axis [m]
# Of kicks, and of the field [rad], of first order; of kicks that a step of first order misses.
SMALL, LARGE = 0.05, 0.3
# Samples for an answer: for a late one, too, and before gravity leads back what is wrong; it has
# six times that to lead a tilt back.
ANSWER = 30
# Of the gyroscope [rad/s], 0.7 deg/s in all: so large are those of consumer devices at power-on;
# and how long it lasts in each of two rests [s], so that a slow filter shows where it tends to.
BIAS, BIAS_S = np.array((0.006, -0.0055, 0.009)), 80.0


class Exam:
    """
    The runs of one exam, each fed when a check asks for it.

    convention : of the attitudes
    told : outcomes by the name of their runs in RUNS, as they are told
    """

    def __init__(self, feed: Callable[[Sequence[Run]], list[Outcome]], imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._feed, self.imu, self.seeds = feed, imu, seeds
        self.convention = Convention()
        self.told: dict[str, list[Outcome]] = {}

    def outcomes(self, name: str) -> list[Outcome]:
        """Return the outcomes of a run by its name in RUNS, in our convention."""
        if name not in self.told:
            self.told[name] = self._feed([
                run if run.name.startswith(name) else replace(run, name=name)
                for run in RUNS[name](self)])
        return list(map(self.ours, self.told[name]))

    def ours(self, told: Outcome) -> Outcome:
        """Return an outcome in our convention."""
        return replace(told, estimates=self.convention.undo(told.estimates)
                       ) if self.convention.parts else told

    @cached_property
    def starts(self) -> list[Outcome]:
        """New filters at rest, until they are settled or the patience ends, as they are told."""
        for seconds in LEADS_S:
            outcomes = self._feed([Motion(start).rest(seconds).run('start')
                                   for start in STARTS])
            if all(measures.settled(one.estimates, STILL) for one in outcomes):
                break
        return outcomes

    @property
    def settled(self) -> list[Outcome]:
        """Those of the new filters that have settled, in our convention."""
        return [self.ours(one) for one in self.starts if measures.settled(one.estimates, STILL)]

    @cached_property
    def lead(self) -> int:
        """Samples of the rest at the start, until the filter is settled."""
        return len(self.starts[0].run.dt)

    @cached_property
    def motion(self) -> Motion:
        """The excitation."""
        return motions.excitation(self.lead / RATE)

    @cached_property
    def run(self) -> Run:
        """The excitation as a perfect IMU reads it."""
        return self.motion.run('excitation')

    @cached_property
    def ends(self) -> NDArray[np.intp]:
        """The ends of the rests."""
        return np.array([part.end for part in self.motion.of('rests')])

    @cached_property
    def heading(self) -> bool:
        """Whether the field changes attitudes: only then the heading is judged against north."""
        return measures.differ(*(self.outcomes(name)[0].estimates
                                 for name in ('excitation', 'no field')))

    def errors(self, name: str) -> Errors:
        """Return the errors in the excitation once settled; without north, about their mean."""
        (outcome,) = self.outcomes(name)
        errors = errors_of(outcome.estimates[self.lead:], self.run.truth[self.lead:])
        return errors if self.heading else errors.about_mean()

    def answers(self, name: str) -> tuple[Reals, Reals]:
        """Return kicks of a run (n, 3), and by how much they move attitudes (n, ANSWER, 3)."""
        (still,), (moved,) = self.outcomes('no field'), self.outcomes(name)
        turns = (moved.run.gyroscope - still.run.gyroscope) * moved.run.dt[:, np.newaxis]
        apart = measures.increments(moved.estimates) - measures.increments(still.estimates)
        steps = np.flatnonzero(np.any(turns, axis=1))
        return turns[steps], np.cumsum(apart[steps[:, np.newaxis] + np.arange(ANSWER)], axis=1)

    def kicked(self, steps: NDArray[np.intp], turns: Reals,
               lengths: Reals | float = 1.0 / RATE) -> Run:
        """Return the run without field, with kicks (n, 3) [rad] in steps of these lengths [s]."""
        run = self.run.without_field()
        gyroscope, dt = run.gyroscope.copy(), run.dt.copy()
        dt[steps] = lengths
        gyroscope[steps] += turns / dt[steps, np.newaxis]
        return replace(run, gyroscope=gyroscope, dt=dt)

    def turned(self, size: float, lengths: Reals | float = 1.0 / RATE) -> Run:
        """Return kicks about the vertical in the rests, of so many rad in a step of 1 / RATE."""
        steps, (still,) = self.ends - ANSWER, self.outcomes('no field')
        sizes = np.broadcast_to(size * RATE * np.asarray(lengths), steps.shape)
        return self.kicked(steps, sizes[:, np.newaxis] * measures.up(still.estimates[steps - 1]),
                           lengths)


def _tilts(exam: Exam) -> list[Run]:
    """Return runs with a kick each: about x, y and z where they are most level, and across."""
    up = measures.up(exam.run.truth[exam.ends - 1])
    runs = []
    for axis, k in zip(np.eye(3), np.argmin(np.abs(up), axis=0), strict=True):
        across, end = np.cross(up[k], axis), exam.ends[k]
        runs += [exam.kicked(np.array([end - 6 * ANSWER]), SMALL * kick[np.newaxis]).part(
            slice(end)) for kick in (np.cross(across, up[k]), across)]
    return runs


def _field_turned(exam: Exam) -> list[Run]:
    """Turn the field about the vertical, from the middle on."""
    turns, middle = Rotation.from_quat(exam.run.truth), len(exam.run.dt) // 2
    field = turns.inv().apply(Rotation.from_euler('z', SMALL).apply(motions.FIELD))
    field[:middle] = exam.run.magnetometer[:middle]
    return [replace(exam.run, magnetometer=field)]


def _begin(exam: Exam) -> list[Run]:
    """Read force and field at the begin of each step."""
    force, field = (np.vstack((rows[:1], rows[:-1]))
                    for rows in (exam.run.accelerometer, exam.run.magnetometer))
    return [replace(exam.run, accelerometer=force, magnetometer=field)]


def _arm(exam: Exam) -> list[Run]:
    """Move the IMU off the axis of the top."""
    (part,) = exam.motion.of('top')
    rows, force = slice(part.begin, part.end), exam.run.accelerometer.copy()
    turns = Rotation.from_quat(exam.run.truth[rows])
    velocity = np.gradient(turns.apply(ARM), 1.0 / RATE, axis=0)
    force[rows] += turns.inv().apply(np.gradient(velocity, 1.0 / RATE, axis=0))
    return [replace(exam.run, accelerometer=force)]


def _bias(exam: Exam) -> list[Run]:
    """Add a bias in a rest, and in one in which its axes of the world have other signs."""
    run = Motion(STARTS[0]).rest(BIAS_S).turn((0.0, 1.4, 0.0)).rest(BIAS_S).run('bias')
    return [replace(run, gyroscope=run.gyroscope + BIAS)]


RUNS: Mapping[str, Callable[[Exam], list[Run]]] = {
    # The first seed twice: a filter says the same of the same.
    'noise': lambda exam: [
        motions.noisy(f'noise, seed {seed}', exam.imu, seed, LEADS_S[0], motions.TOP_S)
        for seed in (*exam.seeds, exam.seeds[0])],
    'excitation': lambda exam: [exam.run],
    'no field': lambda exam: [exam.run.without_field()],
    'starts, no field': lambda exam: [one.run.without_field() for one in exam.starts],
    'force of the begin': _begin, 'field turned': _field_turned,
    'turns': lambda exam: [exam.turned(SMALL)],
    'large turns': lambda exam: [exam.turned(LARGE)],
    'uneven turns': lambda exam: [exam.turned(SMALL, np.resize(motions.STEPS, len(exam.ends)))],
    'tilts': _tilts, 'bias': _bias, 'lever arm': _arm}
