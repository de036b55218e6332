# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator through the scenes, and grades what it returns."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from spinning_top_sim.grade import dynamics, sensors
from spinning_top_sim.grade.motion import READINGS, InvalidTrajectoryError, Motion, Trajectory
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Body, Scene, Start
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line, progress
from spinning_top_sim.tools.kinematics import Reals
from spinning_top_sim.tools.report import Finding, Mark, Report

Simulate = Callable[[Body, Start, Reals, float], Any]
# The largest error of an attitude that is no fault [rad].
TOLERANCE = math.radians(0.1)
EARLY = 24              # samples at the start by which a convention is known
WRONG, RIGHT = math.radians(10.0), 0.2      # of their error, in ours, and as a share in another
MOST = 0.7              # that the top turns in a step [rad]: in longer ones rates are not known


def grade(run: Simulate, *, dt: float = 0.002, body: Body = WHEEL,
          scenes: Sequence[Scene] = SCENES, seed: int = 0, tolerance: float = TOLERANCE,
          subject: str | None = None) -> Report:
    """
    Grade a simulator.

    Parameters
    ----------
    run : callable
        ``run(top, start, times, dt)`` simulates a `Body` from a `Start` with steps of dt [s] and
        returns the motion at the times (n,) [s]: attitudes q(world <- body) as x, y, z, w (n, 4),
        or a mapping or an object with `attitudes` and any other part of a `Trajectory`.  The first
        time is 0, and all are multiples of dt.
    dt : float
        The step [s].  Samples are dt apart, also where the order of convergence is measured with
        smaller steps.  A scene in which the top turns by more than 0.7 rad in a step is left out.
    body : Body
        The top and the IMU on it.
    scenes : sequence of Scene
        Motions to run.
    seed : int
        Determines how the top is turned at the start.
    tolerance : float
        Largest error of an attitude that is no fault [rad].
    subject : str, optional
        Name of the simulator; default: that of `run`.

    Raises
    ------
    TypeError
        If `run` cannot be called.
    ValueError
        Naming the argument, its value and what is allowed.
    """
    if not callable(run):
        raise TypeError(f'run = {run!r}: must be run(top, start, times, dt)')
    if not 0.0 < dt <= 1.0:
        raise ValueError(f'dt = {dt!r} s: must be in (0, 1]')
    if not scenes:
        raise ValueError(f'scenes = {scenes!r}: must have one at least')
    judgement = Judgement(one_line(subject or getattr(run, '__name__', type(run).__name__)), dt,
                          tolerance)
    with progress('graded', len(scenes), 'scenes') as show:
        for number, scene in enumerate(scenes):
            show(number)
            start = scene.start_of(body, seed)
            if dt * max(*map(abs, start.rates), abs(start.l3) / body.lambda1) > MOST:
                judgement.notes.append(f'{scene.name}: the top turns by more than {MOST:g} rad in '
                                       'a step: not graded')
                continue
            try:
                _run_scene(run, judgement, scene, body, start)
            except InvalidTrajectoryError as error:
                judgement.faults.append(Finding('invalid_output', f'{scene.name}: {error}'))
    if not judgement.motions and not judgement.faults:
        raise ValueError(f'dt = {dt!r} s: the top turns by more than {MOST:g} rad in a step')
    return judgement.report()


def grade_trajectory(trajectory: Any, top: Top, start: State, *,
                     times: Any = None, dt: float | None = None, tolerance: float = TOLERANCE,
                     subject: str = 'trajectory', **imu: Any) -> Report:
    """
    Grade a motion that exists.

    Parameters
    ----------
    trajectory : Trajectory, mapping, object or (n, 4) array
        As `run` of `grade` returns it.
    top : Top or Body
        The top; a `Body` has the IMU, too.
    start : State
        At t = 0.
    times : (n,) array, optional
        Times [s], equally spaced; default: the `t` of the trajectory.
    dt : float, optional
        Step of the simulator [s]; default: the time between two samples.
    tolerance, subject : float, str
        As of `grade`.
    **imu :
        Parameters of `Body` beside those of the top: `lever_arm`, `mounting`, ...

    Raises
    ------
    ValueError
        Naming what is no motion, and why.
    """
    if dt is not None and not 0.0 < dt < math.inf:
        raise ValueError(f'dt = {dt!r} s: must be > 0, or None')
    told = Trajectory.of(trajectory, times)
    judgement = Judgement(subject, dt or told.step, tolerance)
    judgement.motions.append(judgement.motion(subject, Body.of(top, **imu), start, told))
    return judgement.report()


def _run_scene(run: Simulate, judgement: 'Judgement', scene: Scene, body: Body,
               start: Start) -> None:
    """Add the motions of a scene.  Raises InvalidTrajectoryError."""
    dt = judgement.dt
    times: Reals = np.arange(math.floor(scene.duration / dt + 1e-9) + 1.0) * dt

    def motion_of(step: float) -> Trajectory:
        try:
            said = run(body, start, times.copy(), step)
        except (Exception, SystemExit) as error:
            raise InvalidTrajectoryError(f'run raises {type(error).__name__}: '
                                         f'{one_line(error)}') from error
        return Trajectory.of(said, times)

    told = [motion_of(dt / divided) for divided in scene.divided]
    if not judgement.motions and not np.array_equal(told[0].attitudes, motion_of(dt).attitudes):
        judgement.faults.append(Finding('not_deterministic', f'{scene.name}: the attitudes of the '
                                        'same run twice differ'))
    same = [judgement.motion(scene.name, body, start, one) for one in told]
    judgement.motions.append(same[0])
    errors = [one.worst for one in same]
    if len(same) > 1 and min(errors) > 1e-9:        # beyond rounding: errors ~ dt^p
        judgement.orders[scene.name] = -float(np.polyfit(
            np.log(scene.divided), np.log(errors), 1)[0])


class Judgement:
    """What is found of motions beside exact ones; `report` judges them."""

    def __init__(self, subject: str, dt: float, tolerance: float) -> None:
        self.subject, self.dt, self.tolerance = subject, dt, tolerance
        self.motions: list[Motion] = []
        self.faults: list[Finding] = []
        self.notes: list[str] = []
        self.orders: dict[str, float] = {}

    def motion(self, name: str, body: Body, start: State, told: Trajectory) -> Motion:
        """Return a motion; a convention of its attitudes, or a step, is told and undone."""
        motion, early = Motion(name, body, start, told), slice(0, EARLY)
        error = float(np.max(motion.errors[early]))
        for steps in (1, -1) if error > min(WRONG, 2.0 * self.tolerance) else ():
            other = Motion(name, body, start, replace(told, t=told.t + steps * self.dt))
            if np.max(other.errors[early]) < RIGHT * error and (
                    np.median(other.errors) < RIGHT * np.median(motion.errors)):
                self._tell('early' if steps > 0 else 'late', f'{name}: the attitudes are those of '
                           f'one step {"after" if steps > 0 else "before"}', -float(steps))
                return other
        if error > WRONG:
            found = conventions.best(told.attitudes[early], motion.truth[early])
            if found.convention.parts and found.after < RIGHT * found.before:
                self._tell('convention', f'{name}: attitudes are told as '
                           f'{found.convention.name}; this is undone', found.before)
                return Motion(name, body, start, replace(
                    told, attitudes=found.convention.undo(told.attitudes)))
        return motion

    def _tell(self, name: str, evidence: str, number: float) -> None:
        if name not in [fault.name for fault in self.faults]:
            self.faults.append(Finding(name, evidence, number))

    def report(self) -> Report:
        """Return the report on the motions."""
        if not self.motions:
            return Report(self.subject, self.faults, {}, self.notes)
        of_rates = self._readings('rates').faults
        first = of_rates[0].name if of_rates else ''
        for motion in self.motions:
            motion.use_rates(told=first in ('', 'rates_scale', 'rates_in_world'),
                             in_world=first == 'rates_in_world')
        marks = {f'{measure}: {motion.name}': Mark(value, math.degrees(self.tolerance) if (
            measure == 'total_error_deg') else math.nan)
            for motion in self.motions for measure, value in motion.marks.items()}
        marks.update({f'order: {motion.name}': Mark(self.orders.get(motion.name, math.nan))
                      for motion in self.motions})
        faults = [*self.faults, *of_rates, *(fault for fault in self._of_motions() if not (
            first == 'rates_scale' and fault.name == 'inaccurate'))]
        for kind in READINGS[1:]:
            found = self._readings(kind)
            faults, marks = [*faults, *found.faults], {**marks, **found.marks}
            self.notes.extend(found.notes)
        if not {*self.motions[0].stretch.readings} - {'rates'}:
            self.notes.append('no readings: the IMU is not graded')
        return Report(self.subject, faults, marks, self.notes)

    def _readings(self, kind: str) -> sensors.Judged:
        body = self.motions[0].body
        return sensors.judge(
            kind, [motion.stretch for motion in self.motions], body, body.gravity,
            covariance=self.motions[0].trajectory.covariance.get(kind),
            slack=max(motion.slack for motion in self.motions) if kind != 'rates' else 0.0)

    def _of_motions(self) -> Iterator[Finding]:
        """Yield what is wrong with the motions."""
        worst = max(self.motions, key=lambda motion: motion.worst)
        if worst.worst <= self.tolerance:
            return
        text = f'{worst.name}: the attitude is up to {math.degrees(worst.worst):.3g} deg off'
        first = [(scene, order) for scene, order in self.orders.items() if 0.5 < order < 1.5][:1]
        for scene, order in first:
            yield Finding('first_order', f'{text}; {scene}: the error falls as dt^{order:.2f}',
                          order)
        causes = [fault for fault in dynamics.faults_of(self.motions, self.dt)
                  if not (first and fault.name == 'first_order')]
        yield from (fault._replace(evidence=f'{text}; {fault.evidence}') for fault in causes)
        if not (first or causes):
            yield Finding('inaccurate', text, math.degrees(worst.worst))
