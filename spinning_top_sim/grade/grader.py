# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator through the scenes, and grades what it returns."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.exam.measures import convergence_order
from spinning_top_sim.grade.motion import Motion
from spinning_top_sim.grade.report import Fault, Report
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Body, Reals, Scene, Start
from spinning_top_sim.grade.trajectory import (
    InvalidTrajectoryError,
    Trajectory,
    equally_spaced,
)
from spinning_top_sim.physics.top import State, Top

Run = Callable[[Body, Start, Reals, float], Any]
# The largest error of an attitude that is no fault [rad].
TOLERANCE = math.radians(0.1)


def grade(run: Run, *, dt: float = 0.002, body: Body = WHEEL, scenes: Sequence[Scene] = SCENES,
          seed: int = 0, tolerance: float = TOLERANCE, subject: str | None = None) -> Report:
    """
    Grade a simulator.

    Parameters
    ----------
    run : callable
        ``run(top, start, times, dt)`` simulates a `Body` from a `Start` with steps of dt [s] and
        returns the motion at the times (n,) [s]: attitudes q(world <- body) as w, x, y, z (n, 4),
        or a mapping or an object with `attitudes` and any other part of a `Trajectory`.  The first
        time is 0, and all are multiples of dt.
    dt : float
        The step [s].  Samples are dt apart, also where the order of convergence is measured with
        smaller steps.
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

    Returns
    -------
    Report
        The faults with their evidence, and the measures.

    Raises
    ------
    TypeError
        If `run` cannot be called.
    ValueError
        Naming the argument, its value and what is allowed.
    """
    if not callable(run):
        raise TypeError(f'run = {run!r}: must be run(top, start, times, dt)')
    if not 0.0 < dt <= 0.05:
        raise ValueError(f'dt = {dt!r} s: must be in (0, 0.05]')
    subject = subject or getattr(run, '__name__', type(run).__name__)
    faults: list[Fault] = []
    motions, finer = [], {}
    for scene in scenes:
        start = scene.start_of(body, seed)
        times = dt * np.arange(math.floor(scene.duration / dt + 1e-9) + 1)
        try:
            motions.append(Motion(scene.name, body, start, _run(run, body, start, times, dt)))
            finer[scene.name] = [
                motions[-1], *(Motion(scene.name, body, start,
                                      _run(run, body, start, times, dt / divided))
                               for divided in scene.divided[1:])]
        except InvalidTrajectoryError as error:
            faults.append(Fault('invalid_output', f'{scene.name}: {error}'))
    if motions:
        first = motions[0]
        again = _run(run, body, first.start, first.trajectory.t, dt)
        if not np.array_equal(again.attitudes, first.trajectory.attitudes):
            faults.append(Fault('not_deterministic', f'{first.name}: attitudes of the same run '
                                'twice differ'))
    return _judge(subject, motions, finer, faults, dt, tolerance)


def grade_trajectory(trajectory: Any, top: Top, start: Start | State, *,
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
    start : Start or State
        At t = 0.
    times : (n,) array, optional
        Times [s], equally spaced; default: the `t` of the trajectory.
    dt : float, optional
        Step of the simulator [s]; default: the time between two samples.
    tolerance, subject :
        As of `grade`.
    **imu :
        Parameters of `Body` beside those of the top: `lever_arm`, `mounting`, ...

    Raises
    ------
    ValueError
        Naming what is no motion, and why.
    """
    body = Body.of(top, **imu)
    if isinstance(start, State):
        start = Start.of(body, start)
    if times is None:
        times = trajectory.get('t') if isinstance(trajectory, Mapping) else getattr(
            trajectory, 't', None)
        if times is None:
            raise ValueError('times = None: must be given, the trajectory has no t')
    motion = Motion(subject, body, start, Trajectory.of(trajectory, equally_spaced(times)))
    return _judge(subject, [motion], {}, [], dt or motion.trajectory.step, tolerance)


def _run(run: Run, body: Body, start: Start, times: Reals, dt: float) -> Trajectory:
    """Return the motion.  Raises InvalidTrajectoryError."""
    try:
        said = run(body, start, times.copy(), dt)
    except Exception as error:
        raise InvalidTrajectoryError(f'run raises {type(error).__name__}: {error}') from error
    return Trajectory.of(said, times)


def _judge(subject: str, motions: Sequence[Motion], finer: Mapping[str, Sequence[Motion]],
           faults: list[Fault], dt: float, tolerance: float) -> Report:
    """Return the report on these motions; `finer` are those with smaller steps."""
    marks: dict[str, float] = {}
    for motion in motions:
        for name, value in motion.marks(motion.rates).items():
            marks[f'{name}: {motion.name}'] = value
    for motion in motions:
        if motion.worst > tolerance:
            faults.append(Fault('inaccurate', f'{motion.name}: {math.degrees(motion.worst):.3g} '
                                'deg', math.degrees(motion.worst)))
            break
    return Report(subject, faults, marks)
