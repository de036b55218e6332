# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator through the scenes, and grades what it returns."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.grade import dynamics, sensors
from spinning_top_sim.grade.motion import InvalidTrajectoryError, Motion, Trajectory
from spinning_top_sim.grade.report import Report
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Body, Reals, Scene, Start
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.verdict import Fault

Simulate = Callable[[Body, Start, Reals, float], Any]
# The largest error of an attitude that is no fault [rad].
TOLERANCE = math.radians(0.1)
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
        returns the motion at the times (n,) [s]: attitudes q(world <- body) as w, x, y, z (n, 4),
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
    name = one_line(subject or getattr(run, '__name__', type(run).__name__))
    faults: list[Fault] = []
    motions: list[Motion] = []
    orders = {}
    for scene in scenes:
        start = scene.start_of(body, seed)
        if dt * max(*map(abs, start.rates), abs(start.state_of(body).l3) / body.lambda1) > MOST:
            continue
        times: Reals = np.arange(math.floor(scene.duration / dt + 1e-9) + 1.0) * dt
        try:
            same = [Motion(scene.name, body, start, _run(run, body, start, times, dt / divided))
                    for divided in scene.divided]
            motions.append(same[0])
            orders[scene.name] = convergence_order(
                scene.divided, [motion.worst for motion in same])
            if len(motions) == 1:
                again = _run(run, body, start, times, dt).attitudes
                if not np.array_equal(again, same[0].trajectory.attitudes):
                    faults.append(Fault('not_deterministic', f'{scene.name}: the attitudes of the '
                                        'same run twice differ'))
        except InvalidTrajectoryError as error:
            faults.append(Fault('invalid_output', f'{scene.name}: {error}'))
    if not motions and not faults:
        raise ValueError(f'dt = {dt!r} s: the top turns by more than {MOST:g} rad in a step')
    return _judge(name, motions, orders, faults, dt, tolerance)


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
    body = Body.of(top, **imu)
    start = Start.of(body, start) if isinstance(start, State) else start
    motion = Motion(subject, body, start, Trajectory.of(trajectory, times))
    return _judge(subject, [motion], {}, [], dt or motion.trajectory.step, tolerance)


def _run(run: Simulate, body: Body, start: Start, times: Reals, dt: float) -> Trajectory:
    """Return the motion.  Raises InvalidTrajectoryError."""
    try:
        said = run(body, start, times.copy(), dt)
    except (Exception, SystemExit) as error:
        raise InvalidTrajectoryError(f'run raises {type(error).__name__}: '
                                     f'{one_line(error)}') from error
    return Trajectory.of(said, times)


def _judge(subject: str, motions: Sequence[Motion], orders: Mapping[str, float],
           faults: list[Fault], dt: float, tolerance: float) -> Report:
    """Return the report on these motions, and orders of convergence by the name of the scene."""
    if not motions:
        return Report(subject, faults, {})
    of_rates, _ = sensors.judge('rates', motions)
    faults += of_rates
    first = of_rates[0].name if of_rates else ''
    if first in ('', 'rates_scale', 'rates_in_world'):      # they can be used
        for motion in motions:
            motion.use_told_rates(in_world=first == 'rates_in_world')
    marks = {f'{measure}: {motion.name}': value for motion in motions
             for measure, value in motion.marks.items()}
    marks.update({f'order: {scene}': order for scene, order in orders.items()})
    known = any(fault.name == 'rates_scale' for fault in faults)
    faults += [fault for fault in _motion_faults(motions, orders, dt, tolerance)
               if not (known and fault.name == 'inaccurate')]
    faults += dynamics.energy_fault(motions[0])
    for kind in sensors.KINDS:
        if kind != 'rates':
            more, found = sensors.judge(kind, motions)
            faults, marks = [*faults, *more], {**marks, **found}
    return Report(subject, faults, marks)


def _motion_faults(motions: Sequence[Motion], orders: Mapping[str, float], dt: float,
                   tolerance: float) -> Iterator[Fault]:
    """Yield what is wrong with the motions."""
    worst = max(motions, key=lambda motion: motion.worst)
    if worst.worst <= tolerance:
        return
    text = f'{worst.name}: the attitude is up to {math.degrees(worst.worst):.3g} deg off'
    first = {scene: order for scene, order in orders.items() if 0.5 < order < 1.5}
    if first:
        scene, order = next(iter(first.items()))
        yield Fault('first_order', f'{text}; {scene}: the error falls as dt^{order:.2f}', order)
    causes = [fault for fault in dynamics.faults_of(motions, dt)
              if not (first and fault.name == 'first_order')]
    yield from (fault._replace(evidence=f'{text}; {fault.evidence}') for fault in causes)
    if not (first or causes):
        yield Fault('inaccurate', text, math.degrees(worst.worst))


def convergence_order(rates: Sequence[float], errors: Sequence[float]) -> float:
    """Return p where errors fall as rate^-p; NaN for one rate or errors of rounding size."""
    if len(rates) < 2 or min(errors) < 1e-9:
        return math.nan
    return float(-np.polyfit(np.log(rates), np.log(errors), 1)[0])
