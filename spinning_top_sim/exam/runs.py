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

from spinning_top_sim.exam import measures, motions
from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.motions import RATE, STARTS, Motion, Reals, Run
from spinning_top_sim.tools.conventions import Convention, Errors, errors_of

# A filter is settled if it is STILL in the second half of rests at the start; slow ones get
# longer ones.
LEADS_S, STILL = (10.0, 30.0, 120.0), math.radians(0.05)
# Of kicks, and of the field [rad], of first order; of kicks that a step of first order misses.
SMALL, LARGE = 0.05, 0.3
# Samples for an answer, for a late one, too, before gravity leads back what is wrong; and for
# gravity to lead a tilt back.
ANSWER, BACK = 30, 180
# Of the gyroscope [rad/s], 0.7 deg/s in all: so large are those of consumer devices at power-on;
# and how long it lasts in each of two rests [s], so that a slow filter shows where it tends to.
BIAS, BIAS_S = np.array((0.006, -0.0055, 0.009)), 80.0


class Exam:
    """The runs of one exam, each fed when a check asks for it; `told`: outcomes by name."""

    def __init__(self, feed: Callable[[Sequence[Run]], list[Outcome]], imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._feed, self.imu, self.seeds = feed, imu, seeds
        self.convention = Convention()
        self.told: dict[str, list[Outcome]] = {}

    def outcomes(self, name: str, make_runs: Callable[[], Sequence[Run]]) -> list[Outcome]:
        """Return the outcomes of runs in our convention; those of a name are fed once."""
        if name not in self.told:
            self.told[name] = self._feed(make_runs())
        return list(map(self.ours, self.told[name]))

    def outcome(self, name: str, run: Run) -> Outcome:
        """Return the outcome of a run; see `outcomes`."""
        return self.outcomes(name, lambda: [replace(run, name=name)])[0]

    def ours(self, told: Outcome) -> Outcome:
        """Return an outcome in our convention."""
        return replace(told, estimates=self.convention.undo(told.estimates)
                       ) if self.convention.parts else told

    @cached_property
    def starts(self) -> list[Outcome]:
        """New filters at rest, until they are settled or the patience ends, as they are told."""
        for seconds in LEADS_S:
            runs = [Motion(start).rest(seconds).run('start') for start in STARTS]
            for run in runs:
                run.gyroscope[-1] = 0.0         # some filters divide by the norm of the rates
            outcomes = self._feed(runs)
            if all(measures.settled(one.estimates, STILL) for one in outcomes):
                break
        return outcomes

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
        kinds = np.array([*self.motion.kinds, ''])
        rests = np.isin(kinds, ('start', 'rests'))
        return np.flatnonzero(rests[:-1] & (kinds[:-1] != kinds[1:])) + 1

    @property
    def plain(self) -> Outcome:
        """The excitation."""
        return self.outcome('excitation', self.run)

    def shifted(self, force: float, field: float) -> Outcome:
        """Return the excitation, with the force and the field that it has so many steps later."""
        if not (force or field):
            return self.plain
        steps, run = np.arange(len(self.run.dt)), self.run
        forces, fields = (np.stack([np.interp(steps + by, steps, one) for one in rows.T], axis=1)
                          for rows, by in ((run.accelerometer, force), (run.magnetometer, field)))
        return self.outcome(f'shifted by {force:g}, {field:g}', replace(
            run, accelerometer=forces, magnetometer=fields))

    @property
    def still(self) -> Outcome:
        """The excitation without a field."""
        return self.outcome('no field', self.run.without_field())

    @property
    def noise(self) -> list[Outcome]:
        """Runs with noise, and once more the first: a filter says the same of the same."""
        return self.outcomes('noise', lambda: [
            motions.noisy(f'noise, seed {seed}', self.imu, seed, LEADS_S[0], motions.TOP_S)
            for seed in (*self.seeds, self.seeds[0])])

    @property
    def biased(self) -> Outcome:
        """A bias in a rest, and in one in which its axes of the world have other signs."""
        # Slow, for fields read late; first about the vertical, for a heading that begins with 0.
        run = Motion(STARTS[0]).turn((-0.105, -0.087, 1.995), 0.5).rest(BIAS_S).turn(
            (0.0, 1.4, 0.0), 0.5).rest(BIAS_S).run('bias')
        return self.outcome('bias', replace(run, gyroscope=run.gyroscope + BIAS))

    @cached_property
    def heading(self) -> bool:
        """Whether the field changes attitudes: only then the heading is judged against north."""
        return measures.largest_turn(self.plain.estimates,
                                     self.still.estimates) > measures.ROUNDING

    def errors(self, outcome: Outcome) -> Errors:
        """Return the errors of an outcome; without north, about their mean."""
        errors = errors_of(outcome.estimates, outcome.run.truth)
        return errors if self.heading else errors.about_mean()

    def kicks_of_tilt(self, start: Sequence[float], axes: tuple[int, int]) -> list[Outcome]:
        """Return new filters at rest with a kick about each of two axes, and without one."""
        run = Motion(start).rest((self.lead + BACK) / RATE).run('tilt').without_field()
        fed = np.repeat(run.gyroscope[np.newaxis], 3, axis=0)
        fed[[0, 1], -BACK, axes] += SMALL * RATE
        return self.outcomes(f'{start}{axes}', lambda: [replace(run, gyroscope=g) for g in fed])

    def answers(self, size: float = 0.6 * SMALL,
                lengths: Reals | float = 1.0 / RATE) -> tuple[Reals, Reals]:
        """
        Return kicks about the vertical (n, 3), and how they move attitudes (n, ANSWER, 3).

        size : of a kick in 1 / RATE [rad], small in degrees, too; in other steps it is as fast
        lengths : of the steps, one in the end of each rest [s]
        """
        steps, still, run = self.ends - ANSWER, self.still.estimates, self.run.without_field()
        gyroscope, dt = run.gyroscope.copy(), run.dt.copy()
        dt[steps] = lengths
        # Of both signs: what grows with the square of a rate is then no matrix.
        sizes = size * RATE * dt[steps] * (-1.0) ** np.arange(len(steps))
        turns = measures.up(still[steps - 1]) * sizes[:, np.newaxis]
        gyroscope[steps] += turns / dt[steps, np.newaxis]
        uneven = ', uneven steps' * np.ndim(lengths)
        moved = self.outcome(f'turns of {size:g} rad{uneven}', replace(
            run, gyroscope=gyroscope, dt=dt)).estimates
        if uneven:              # what drifts does so in such steps without kicks, too
            still = self.outcome(f'no turns{uneven}', replace(run, dt=dt)).estimates
        apart = measures.increments(moved) - measures.increments(still)
        return turns, np.cumsum(apart[steps[:, np.newaxis] + np.arange(ANSWER)], axis=1)
