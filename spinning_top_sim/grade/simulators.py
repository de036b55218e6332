# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator through the scenes, and grades what it returns beside the exact motions."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import dynamics
from spinning_top_sim.grade.causes import judge
from spinning_top_sim.grade.columns import KINDS, READINGS
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Body, Scene, Start
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line, progress
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch, white
from spinning_top_sim.tools.report import Finding, Mark, Report

Simulate = Callable[[Body, Start, Reals, float], Any]
# The largest error of an attitude that is no fault [rad].
TOLERANCE = math.radians(0.1)
EARLY = 24              # samples at the start by which a convention is known
WRONG, RIGHT = math.radians(10.0), 0.2      # of their error, in ours, and as a share in another
MOST = 0.7              # that the top turns in a step [rad]: in longer ones rates are not known
LEAST_SAMPLES = 30
NORM = 1e-2             # by which the norm of a quaternion may differ from 1


class InvalidTrajectoryError(ValueError):
    """A simulator has returned no motion; the text names what and why."""


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
        or a mapping or an object with `attitudes` and any of `rates`, angular velocities of the
        state in the body (n, 3) [rad/s], `gyroscope`, `accelerations`, `magnetometer`, readings
        in the frame of the IMU (n, 3), SI, and `covariance` of the first two, (3, 3) by name or
        one for both.  The first time is 0, and all are multiples of dt.
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
                          body, tolerance)
    with progress('graded', len(scenes), 'scenes') as show:
        for number, scene in enumerate(scenes):
            show(number)
            start = scene.start_of(body, seed)
            if dt * max(*map(abs, start.rates), abs(start.l3) / body.lambda1) > MOST:
                judgement.notes.append(f'{scene.name}: the top turns by more than {MOST:g} rad in '
                                       'a step: not graded')
                continue
            try:
                judgement.run(run, scene, start)
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
    trajectory : mapping, object or (n, 4) array
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
    told = told_motion(trajectory, times)
    judgement = Judgement(subject, dt or told.step, Body.of(top, **imu), tolerance)
    judgement.motions.append(judgement.motion(subject, start, told))
    return judgement.report()


def told_motion(said: Any, times: Any = None) -> Stretch:
    """
    Return the motion that a run has said, by default at its `t`.

    Raises InvalidTrajectoryError.
    """
    names = 't', 'attitudes', *KINDS, 'covariance'
    if not isinstance(said, Mapping):
        said = {name: getattr(said, name, None) for name in names} if (
            hasattr(said, 'attitudes')) else {'attitudes': said}
    said = {str(name): part for name, part in said.items() if part is not None}
    if 'attitudes' not in said:
        raise InvalidTrajectoryError(f'what is returned has {sorted(said) or "nothing"}: must '
                                     'have attitudes')
    times = said.get('t') if times is None else times
    if times is None:
        raise InvalidTrajectoryError('times = None: must be given, the trajectory has no t')
    t = _numbers('times', times, (np.size(times),))
    if len(t) < LEAST_SAMPLES:
        raise InvalidTrajectoryError(f'{len(t)} times: must be {LEAST_SAMPLES} at least')
    steps, usual = np.diff(t), np.median(np.diff(t))
    for at in np.flatnonzero(~(np.abs(steps - usual) <= 1e-3 * usual) | (steps <= 0.0))[:1]:
        raise InvalidTrajectoryError(f'times[{at + 1}] - times[{at}] = {steps[at]:g} s where '
                                     f'{usual:g} s is usual: must be equally spaced, > 0')
    attitudes = _numbers('attitudes', said['attitudes'], (len(t), 4))
    norms = np.linalg.norm(attitudes, axis=1)
    for at in np.flatnonzero(~(np.abs(norms - 1.0) < NORM))[:1]:
        raise InvalidTrajectoryError(f'attitudes[{at}] = {attitudes[at].tolist()}: the norm '
                                     'must be 1')
    told = said.get('covariance', {})
    if not isinstance(told, Mapping):
        told = {name: told for name, kind in READINGS.items() if kind.density}
    if others := [*map(str, told.keys() - {'gyroscope', 'accelerations'})]:
        raise InvalidTrajectoryError(f'covariance of {", ".join(others)}: must be of gyroscope'
                                     ' or accelerations')
    readings = {name: _numbers(name, said[name], (len(t), 3)) for name in KINDS if name in said}
    return Stretch(
        t, Rotation.from_quat(attitudes), np.zeros((len(t), 3)), readings,
        {name: white(values, jumps=False) for name, values in readings.items()},
        covariance={name: _numbers(f'covariance of {name}', matrix, (3, 3))
                    for name, matrix in told.items()})


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Reals:
    """Return an array of this shape.  Raises InvalidTrajectoryError."""
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidTrajectoryError(f'{name}: {error}') from error
    if numbers.shape != shape:
        raise InvalidTrajectoryError(f'{name} has shape {numbers.shape}: must be {shape}')
    for at in np.argwhere(~np.isfinite(numbers))[:1]:
        raise InvalidTrajectoryError(f'{name}{at.tolist()} = {numbers[tuple(at)]}: must be finite')
    return numbers


class Motion:
    """
    A motion beside the exact one from the same state.

    told : what is said of it
    errors : angles to the exact attitudes (n,) [rad]
    """

    def __init__(self, name: str, body: Body, start: State, told: Stretch) -> None:
        self.name, self.body, self.told = name, body, told
        self.solution = ExactSolution(body, start)
        self.truth: Reals = self.solution.states_at_seconds(told.t).quaternion
        self.errors: Reals = (Rotation.from_quat(self.truth).inv() * told.rotation).magnitude()
        self.worst = float(np.max(self.errors))

    @property
    def slack(self) -> float:
        """By how much readings may differ from attitudes: half a step may be between them."""
        first, second = self.told.rotation[0], self.told.rotation[1]
        told = self.told.rates is not None
        return 0.0 if told else float(0.5 * (first.inv() * second).magnitude()) ** 2

    @property
    def marks(self) -> dict[str, float]:
        """The largest error, and the largest relative changes of the constants of the motion."""
        smoothed = Smoothed(self.told, 1)
        body, w, up = self.body, smoothed.rates, smoothed.turn[:, 2]
        momenta = w * body.inertia
        values = {'energy': 0.5 * np.sum(momenta * w, axis=1) + body.gravity_torque * up[:, 2],
                  'l3': momenta[:, 2], 'lz': np.sum(momenta * up, axis=1)}
        first = self.solution.states_at_seconds(np.zeros(1))
        return {'total_error_deg': math.degrees(self.worst), **{
            f'{name}_drift': float(np.max(np.abs(relative_drift(
                value, float(getattr(first, name)[0]))))) for name, value in values.items()}}


class Judgement:
    """What is found of motions beside exact ones; `report` judges them."""

    def __init__(self, subject: str, dt: float, body: Body, tolerance: float) -> None:
        self.subject, self.dt, self.body, self.tolerance = subject, dt, body, tolerance
        self.motions: list[Motion] = []
        self.faults: list[Finding] = []
        self.notes: list[str] = []
        self.orders: dict[str, float] = {}

    def run(self, run: Simulate, scene: Scene, start: Start) -> None:
        """Add the motion of a scene.  Raises InvalidTrajectoryError."""
        times: Reals = np.arange(math.floor(scene.duration / self.dt + 1e-9) + 1.0) * self.dt

        def motion_of(step: float) -> Stretch:
            try:
                said = run(self.body, start, times.copy(), step)
            except (Exception, SystemExit) as error:
                raise InvalidTrajectoryError(f'run raises {type(error).__name__}: '
                                             f'{one_line(error)}') from error
            return told_motion(said, times)

        told = [motion_of(self.dt / divided) for divided in scene.divided]
        if not self.motions and not np.array_equal(told[0].matrices, motion_of(self.dt).matrices):
            self.faults.append(Finding('not_deterministic', f'{scene.name}: the attitudes of the '
                                       'same run twice differ'))
        same = [self.motion(scene.name, start, one) for one in told]
        self.motions.append(same[0])
        errors = [one.worst for one in same]
        if len(same) > 1 and min(errors) > 1e-9:        # beyond rounding: errors ~ dt^p
            self.orders[scene.name] = -float(np.polyfit(
                np.log(scene.divided), np.log(errors), 1)[0])

    def motion(self, name: str, start: State, told: Stretch) -> Motion:
        """Return a motion; a convention of its attitudes, or a step, is told and undone."""
        motion, early = Motion(name, self.body, start, told), slice(0, EARLY)
        error = float(np.max(motion.errors[early]))
        for steps in (1, -1) if error > min(WRONG, 2.0 * self.tolerance) else ():
            other = Motion(name, self.body, start, replace(told, t=told.t + steps * self.dt))
            if np.max(other.errors[early]) < RIGHT * error and (
                    np.median(other.errors) < RIGHT * np.median(motion.errors)):
                self._tell('early' if steps > 0 else 'late', f'{name}: the attitudes are those of '
                           f'one step {"after" if steps > 0 else "before"}', -float(steps))
                return other
        if error > WRONG:
            q = told.rotation.as_quat()
            found = conventions.best(q[early], motion.truth[early])
            if found.convention.parts and found.after < RIGHT * found.before:
                self._tell('convention', f'{name}: attitudes are told as '
                           f'{found.convention.name}; this is undone', found.before)
                return Motion(name, self.body, start, replace(
                    told, rotation=Rotation.from_quat(found.convention.undo(q))))
        return motion

    def _tell(self, name: str, evidence: str, number: float) -> None:
        if name not in [fault.name for fault in self.faults]:
            self.faults.append(Finding(name, evidence, number))

    def report(self) -> Report:
        """Return the report on the motions."""
        whole = Report(self.subject, self.faults, {}, self.notes)
        if not self.motions:
            return whole
        of_rates = self._readings('rates').found
        first = of_rates[0].name if of_rates else ''
        if first in ('', 'rates_scale', 'rates_in_world'):      # rates that are told are known
            for motion in self.motions:
                rates = motion.told.readings.get('rates')
                if rates is not None and first == 'rates_in_world':
                    rates = motion.told.rotation.inv().apply(rates)
                motion.told = replace(motion.told, rates=rates)
        of_motions = Report('', [
            *of_rates, *(fault for fault in self._of_motions() if not (
                first == 'rates_scale' and fault.name == 'inaccurate'))], {
            **{f'{measure}: {motion.name}': Mark(value, math.degrees(self.tolerance) if (
                measure == 'total_error_deg') else math.nan)
                for motion in self.motions for measure, value in motion.marks.items()},
            **{f'order: {motion.name}': Mark(self.orders.get(motion.name, math.nan))
               for motion in self.motions}},
            [] if READINGS.keys() & self.motions[0].told.readings.keys() else [
                'no readings: the IMU is not graded'])
        return whole.plus(of_motions, *map(self._readings, READINGS))

    def _readings(self, kind: str) -> Report:
        return judge(kind, [motion.told for motion in self.motions], self.body, self.body.gravity,
                     slack=max(motion.slack for motion in self.motions) * (kind != 'rates'))

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
        causes = [fault for fault in dynamics.faults_of(
            self.body, [motion.told for motion in self.motions], self.dt)
            if not (first and fault.name == 'first_order')]
        yield from (Finding(fault.name, f'{text}; {fault.evidence}', fault.number)
                    for fault in causes)
        if not (first or causes):
            yield Finding('inaccurate', text, math.degrees(worst.worst))
