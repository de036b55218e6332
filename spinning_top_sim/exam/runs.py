# SPDX-License-Identifier: Apache-2.0
"""The runs of one exam: what the filter is fed with, and what it answers."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import answers, bias, measures, motions
from spinning_top_sim.exam.feeding import Feed, MakeFilter, Outcome
from spinning_top_sim.exam.motions import NEAR, RATE, STILL, Motion, Run
from spinning_top_sim.tools.conventions import Convention, Errors, errors_of

# A filter is settled if it is STILL in the second half of a rest at the start; slow ones get
# longer ones.
LEADS_S = 10.0, 40.0, 160.0
ARM = 0.1, 0.0, 0.0                         # of the IMU [m]
STARTS = NEAR, (60.0, -35.0, 20.0), (-110.0, 15.0, -50.0)      # yaw, pitch, roll [deg]
FIELD_TURN = math.radians(3.0)              # of the field about the vertical
NOISE_LEAD_S, NOISE_S = 6.0, 20.0           # rest and motion of the noisy runs


class Exam:
    """
    The runs of one exam, each fed when a check asks for it.

    convention : of the attitudes; it is undone in all outcomes
    done : outcomes by the name of their runs in RUNS
    """

    def __init__(self, make_filter: MakeFilter, feed: Feed, imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._make_filter, self._feed = make_filter, feed
        self.imu, self.seeds = imu, seeds
        self.convention = Convention()
        self.done: dict[str, list[Outcome]] = {}

    def outcomes(self, name: str) -> list[Outcome]:
        """Return the outcomes of a run by its name in RUNS, in our convention."""
        if name not in self.done:
            self.done[name] = self.fed(RUNS[name](self))
        return self.done[name]

    @cached_property
    def ends(self) -> NDArray[np.intp]:
        """The ends of the rests in many attitudes."""
        return np.array([part.end for part in self.attitudes.of('rest')[1:]])

    @cached_property
    def level(self) -> list[Outcome]:
        """Return 'attitudes' up to the rests with x, y and z most level: three, or none."""
        (whole,) = self.outcomes('attitudes')
        ups, true = (measures.up(rows[self.ends + answers.LONG - 1])
                     for rows in (whole.estimates, whole.run.truth))
        # Gravity leads away a filter that is upside down.
        least = np.where(np.sum(ups * true, axis=1) > 0.0, np.abs(ups).T, np.inf)
        return [whole.part(slice(self.ends[np.argmin(row)])) for row in least if min(row) < np.inf]

    def fed(self, runs: Sequence[Run]) -> list[Outcome]:
        """Return the outcomes of other runs, in our convention."""
        told = self._feed(self._make_filter, runs)
        return [replace(one, estimates=self.convention.undo(one.estimates)) for one in told
                ] if self.convention.parts else told

    def read_in(self, convention: Convention) -> None:
        """
        Read the attitudes of all runs in another convention than before.

        The kicks of 'turns' are about the vertical of the old one: they are fed anew.
        """
        self.done = {name: [replace(one, estimates=convention.undo(
            self.convention.tell(one.estimates))) for one in outcomes]
            for name, outcomes in self.done.items() if name != 'turns'}
        self.convention = convention

    @cached_property
    def lead_s(self) -> float:
        """How long the filter rests at the start until it is settled [s]."""
        return next((one for one in LEADS_S[:-1] if self._settles_in(one)), LEADS_S[-1])

    @cached_property
    def settles(self) -> bool:
        """Whether the filter settles at all: one that is unstable, or very slow, does not."""
        return self.lead_s < LEADS_S[-1] or self._settles_in(LEADS_S[-1])

    def _settles_in(self, seconds: float) -> bool:
        (outcome,) = self.fed([Motion(motions.euler(NEAR)).rest(seconds).run('rest')])
        later = outcome.estimates[len(outcome.estimates) // 2:]
        return measures.largest_turn(later[:1], later) < STILL

    @cached_property
    def motion(self) -> Motion:
        """The excitation."""
        return motions.excitation(self.lead_s)

    @cached_property
    def attitudes(self) -> Motion:
        """Rests in many attitudes, in which a filter is kicked when it has settled."""
        return motions.attitudes(self.lead_s)

    @cached_property
    def run(self) -> Run:
        """The excitation as a perfect IMU reads it."""
        return self.motion.run('excitation')

    @cached_property
    def heading(self) -> bool:
        """Whether the field changes attitudes: only then the heading is judged against north."""
        return measures.differ(*(self.outcomes(name)[0].estimates
                                 for name in ('excitation', 'field turned')))

    @cached_property
    def bias(self) -> bias.Effects:
        """The effects of a bias."""
        return bias.effects(self.fed)

    def errors(self, name: str = 'excitation') -> Errors:
        """Return the errors in the excitation; without north, the heading from when settled on."""
        errors = errors_of(self.outcomes(name)[0].estimates, self.run.truth)
        if not self.heading:
            turned = errors.heading - errors.heading[round(self.lead_s * RATE)]
            errors = errors._replace(heading=(turned + math.pi) % math.tau - math.pi)
        return errors

    @cached_property
    def clean(self) -> Errors:
        """The errors in the excitation; filters may read force and field at the begin of steps."""
        errors, settled = self.errors(), slice(round(self.lead_s * RATE), None)
        if np.max(errors.whole[settled]) < STILL:
            return errors
        return min(errors, self.errors('force of the begin'),
                   key=lambda one: float(np.max(one.whole[settled])))


def _field_turned(exam: Exam) -> list[Run]:
    """Turn the field about the vertical, to one side and then to the other."""
    middle = len(exam.run.dt) // 2
    turns = Rotation.from_quat(exam.run.truth)
    west = np.where(np.arange(len(turns)) < middle, FIELD_TURN, -FIELD_TURN)
    field = turns.inv().apply(Rotation.from_euler('z', west[:, np.newaxis]).apply(
        turns.apply(exam.run.magnetometer)))
    return [replace(exam.run, name='field turned', magnetometer=field)]


def _begin(exam: Exam) -> list[Run]:
    """Read force and field at the begin of each step."""
    force, field = (np.vstack((rows[:1], rows[:-1]))
                    for rows in (exam.run.accelerometer, exam.run.magnetometer))
    return [replace(exam.run, name='force of the begin', accelerometer=force, magnetometer=field)]


def _uneven_turns(exam: Exam) -> list[Run]:
    """Return the run of uneven steps with a kick in a step of each length."""
    (still,) = exam.outcomes('uneven')
    settled = 4 * len(still.run.dt) // 5
    lengths, first = np.unique(still.run.dt[settled:].round(6), return_index=True)
    # In the third period after the one before; as fast in each length.
    steps = settled + first + 3 * len(motions.STEPS) * np.arange(len(first))
    return [answers.kicked(still.run, steps, answers.SMALL * RATE * lengths[:, np.newaxis]
                           * measures.up(still.estimates[steps - 1]))]


def _turns(exam: Exam, size: float) -> list[Run]:
    """Return the run with a kick about the vertical in each attitude: nothing leads it back."""
    ((still,), steps) = exam.outcomes('attitudes'), exam.ends + answers.SHORT
    sizes = np.resize((size, -size), (len(steps), 1))
    return [answers.kicked(still.run, steps, sizes * measures.up(still.estimates[steps - 1]))]


def _tilts(exam: Exam) -> list[Run]:
    """Return runs with one kick each: about x, y and z as far as level, and across them."""
    runs = []
    for axis, still in zip(np.eye(3), exam.level, strict=True):
        up = measures.up(still.estimates[answers.LONG - 1])
        across = np.cross(up, axis) * answers.SMALL / np.linalg.norm(np.cross(up, axis))
        runs += [answers.kicked(still.run, [answers.LONG], kick)
                 for kick in (np.cross(across, up), across)]
    return runs


RUNS: Mapping[str, Callable[[Exam], list[Run]]] = {
    'twice': lambda exam: 2 * [motions.noisy('twice', motions.CALIBRATED, 0, 1.0, 1.0)],
    'excitation': lambda exam: [exam.run],
    'force of the begin': _begin,
    'field turned': _field_turned,
    'uneven': lambda exam: [motions.uneven(1000).without_field()],
    'uneven turns': _uneven_turns,
    'attitudes': lambda exam: [exam.attitudes.run('attitudes').without_field()],
    'turns': lambda exam: _turns(exam, answers.SMALL),
    'large turns': lambda exam: _turns(exam, answers.LARGE),
    'starts': lambda exam: [Motion(motions.euler(one)).rest(exam.lead_s).run('start')
                            for one in STARTS],
    'starts, no field': lambda exam: [one.run.without_field() for one in exam.outcomes('starts')],
    'tilts': _tilts,
    'arm': lambda exam: [motions.with_arm(exam.motion, exam.run, ARM)],
    'noise': lambda exam: [motions.noisy(f'noise, seed {seed}', exam.imu, seed, NOISE_LEAD_S,
                                         NOISE_S) for seed in exam.seeds]}
