# SPDX-License-Identifier: Apache-2.0
"""Runs a simulator through the scenes, and grades what it returns beside the exact motions."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.bodies import held, undone
from spinning_top_sim.grade.causes import GRAVITY_BAND, LATE, UNEXPLAINED, judge, listed
from spinning_top_sim.grade.columns import AXES, DENSITIES, KINDS, READINGS, STANDARD_GRAVITY
from spinning_top_sim.grade.files import known, unit
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Body, Scene, Start
from spinning_top_sim.physics.top import State, numbers
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.cli import one_line, progress
from spinning_top_sim.tools.identify import NEAR, TARGET, Cause, Model, explain, instead, rms
from spinning_top_sim.tools.kinematics import MOST, Reals, Smoothed, Stretch, along, white
from spinning_top_sim.tools.report import Finding, Mark, Report

Simulate = Callable[[Body, Start, Reals, float], Any]
# The largest error of an attitude that is no fault [rad].
TOLERANCE = math.radians(0.1)
EARLY = 24              # samples at the start by which a convention is known
RIGHT = 0.1             # share of an error that the right convention, or time, leaves
# Mean over the interval in the middle of six samples, for polynomials of degree 5.
_MEAN = np.array([11.0, -93.0, 802.0, 802.0, -93.0, 11.0]) / 1440.0
UNIMPORTANT = 1e-4  # of the angular acceleration, that needs no cause
SIDEWAYS = 1e-2     # of a change of the torque, across the axis, that is none


def grade(run: Simulate, *, dt: float = 0.002, body: Body | None = None,
          scenes: Sequence[Scene] = SCENES, tolerance: float = TOLERANCE) -> Report:
    """
    Grade a simulator.  ValueError: dt or tolerance is not positive.

    Parameters
    ----------
    run : callable
        ``run(top, start, times, dt)`` simulates a `Body` from a `Start` with steps of dt [s] and
        returns the motion at the times (n,) [s]: attitudes q(world <- body) as x, y, z, w (n, 4),
        or a mapping with `attitudes` and any of `rates`, angular velocities of the state in the
        body (n, 3) [rad/s], `gyroscope`, `accelerations`, `magnetometer`, readings in the frame
        of the IMU (n, 3), SI.  The first time is 0, and all are multiples of dt.
    dt : float
        The step [s].  A scene in which the top turns by more than 0.7 rad in it is left out.
    body : Body, optional
        The top with an IMU; default: WHEEL of `spinning_top_sim.grade.scenes`.
    scenes : sequence of Scene
        Its motions; default: all SCENES there.
    tolerance : float
        Largest error of an attitude that is no fault [rad].
    """
    if not (isinstance(dt, Real) and isinstance(tolerance, Real) and min(dt, tolerance) > 0.0):
        raise ValueError(f'dt = {dt!r} s, tolerance = {tolerance!r} rad: must be positive')
    body, unjudged = body or WHEEL, list[str]()
    judgement = Judgement(body, dt, tolerance)
    with progress('graded', len(scenes), 'scenes') as show:
        for number, scene in enumerate(scenes):
            show(number)
            start = Start.of(body, scene.start)
            if dt * max(*map(abs, start.rates), abs(start.l3) / body.lambda1) > MOST:
                unjudged.append(f'{scene.name}: the top turns by more than {MOST:g} rad in a step')
                continue
            times: Reals = np.arange(math.floor(scene.duration / dt + 1e-9) + 1.0) * dt
            try:
                judgement.add(scene.name, start, told_motion(run, body, start, times, dt))
            except ValueError as error:
                judgement.faults.append(Finding('invalid_output', f'{scene.name}: {error}'))
    subject = one_line(getattr(run, '__name__', type(run).__name__))
    for name in DENSITIES:
        without = sum(name not in motion.readings for motion in judgement.motions)
        unjudged += [f'{name}: there is none in {without} scenes'] * bool(without)
    return Report(subject, judgement.faults, unjudged=unjudged).plus(*judgement.reports())


def told_motion(run: Simulate, body: Body, start: Start, times: Reals, dt: float) -> Stretch:
    """Return the motion that a run says.  Raises ValueError."""
    try:
        said = run(body, start, times.copy(), dt)
    except (Exception, SystemExit) as error:
        raise ValueError(f'run raises {type(error).__name__}: {one_line(error)}') from error
    said = said if isinstance(said, Mapping) else {'attitudes': said}
    readings = {name: numbers(name, values, len(times), 4 if name == 'attitudes' else 3)
                for name, values in {'attitudes': None, **said}.items()
                if known(name, ('attitudes', *KINDS)) == 'attitudes' or values is not None}
    attitudes = unit(readings.pop('attitudes'), [f'attitudes[{k}]' for k in range(len(times))])
    return Stretch(times, Rotation.from_quat(attitudes), np.zeros((len(times), 3)), readings,
                   {name: white(values, jumps=False) for name, values in readings.items()})


class Judgement:
    """Motions of a body beside the exact ones; `reports` judges them."""

    def __init__(self, body: Body, dt: float, tolerance: float) -> None:
        self.body, self.dt, self.limit = body, dt, math.degrees(tolerance)
        self.motions, self.faults = list[Stretch](), list[Finding]()
        self.marks: dict[str, Mark] = {}
        # The largest error [deg], of which motion, whether it is at another rate, at first.
        self.worst = 0.0, '', False

    def add(self, name: str, start: State, told: Stretch) -> None:
        """Add a motion; a convention of its attitudes, or a step, is told and undone."""
        values = {'attitudes': told.rotation.as_quat(), **told.readings}
        if holds := [hold for kind in values
                     for hold in held(f'{name}: {kind}', values[kind])[1]]:
            self.faults += holds
            return                              # the motion is no better known
        solution = ExactSolution(self.body, start)
        truth = solution.states(told.t)
        q, exact = values['attitudes'], Rotation.from_quat(truth.quaternion)
        found = conventions.best(q[:EARLY], truth.quaternion[:EARLY])
        if found.convention.parts and found.after < RIGHT * found.before:
            self.faults.append(Finding('convention', f'{name}: attitudes are told as '
                                       f'{found.convention.name}; this is undone', found.before))
            told = undone(told, found.convention)
        # A lag and another rate of the clock turn about the rates.
        errors, w = (exact.inv() * told.rotation).as_rotvec(), truth.angular_velocity[:EARLY]
        model = Model([{TARGET: errors[:EARLY], 'late': -self.dt * w,
                        'slow': told.t[:EARLY, np.newaxis] * w}])
        fit = model.fit(['late', 'slow'])
        late, explained = float(fit.found[0]), fit.rest < RIGHT * model.size(TARGET)
        if explained and abs(late) > LATE:
            self.faults.append(Finding(
                'late' if late > 0.0 else 'early', f'{name}: the attitudes are those of '
                f'{abs(late):.3g} steps {"before" if late > 0.0 else "after"}', late))
            exact = Rotation.from_quat(solution.states(told.t - late * self.dt).quaternion)
        error = math.degrees(np.max((exact.inv() * told.rotation).magnitude()))
        self.motions.append(told)
        self.marks[f'total_error_deg: {name}'] = Mark(error, self.limit)
        self.worst = max(self.worst, (error, name, explained and abs(late) < LATE))

    def reports(self) -> Iterator[Report]:
        """Yield what is wrong with the motions and with each reading."""
        error, name, slow = self.worst
        wrong = error > self.limit
        of_rates = judge('rates', self.motions, self.body, self.body.gravity)
        scaled = wrong and [one.name for one in of_rates.found] == ['rates_scale']
        if scaled or not (of_rates.found or of_rates.unjudged):     # what is told is known
            self.motions = [replace(motion, rates=motion.readings.get('rates'))
                            for motion in self.motions]
        yield Report('', of_rates.found, unjudged=of_rates.unjudged)
        found = [] if slow or not wrong else _equations(self.body, self.motions)
        text = f'{name}: the attitude is up to {error:.3g} deg off'
        yield Report('', [one._replace(evidence=f'{text}; {one.evidence}') for one in found] or [
            Finding('inaccurate', text, error)] * (wrong and not scaled), self.marks)
        yield from (judge(kind, self.motions, self.body, self.body.gravity) for kind in READINGS)


def _equations(body: Body, motions: Sequence[Stretch]) -> list[Finding]:
    """Return what is wrong with the change of rates in each step, where no errors add up."""
    model = Model([_terms(body, motion) for motion in motions])
    found, rest = explain(model, [
        Cause(['gyroscopic'], _gyroscopic), Cause(['gyroscopic step', 'gravity step'], _step),
        Cause(['gyroscopic', 'in world'], instead(
            'inertia_frame', 'the moments of inertia are about axes of the world')),
        Cause(['damping', 'axis damping'], lambda found: Finding(
            'damping', f'a torque against the rates, {found[0]:.3g} 1/s of them across the axis '
            f'and {found[1]:.3g} 1/s about it', float(found[0]))),
        Cause(['arm 0', 'arm 1', 'arm 2'], partial(_com, body)),
        Cause([f'euler {k}' for k in range(5)], partial(_inertia, body))], UNIMPORTANT)
    return found if rest.rest < UNEXPLAINED * model.size(TARGET) else []


def _terms(body: Body, motion: Stretch) -> dict[str, Reals]:
    """Return the angular acceleration that is not explained (N, 3), and effects of causes."""
    smoothed = Smoothed(motion, 1)
    w, inertia = smoothed.rates, body.inertia
    z, world = smoothed.turn[:, 2], along(smoothed.turn, w)
    gyroscopic = -np.cross(w, w * inertia) / inertia
    arms = [-body.mass * body.gravity * np.cross(axis, z) / inertia for axis in AXES]
    gravity, products = body.com_distance * arms[2], w[:, [1, 2, 0]] * w[:, [2, 0, 1]]
    # Effects of other moments: by gravity about e1 and e2, and by (I2 - I3)/I1 and so on.
    euler = [gravity * AXES[0], gravity * AXES[1], *(products * axis for axis in AXES)]
    nodes = {'gyroscopic': gyroscopic, 'gravity': gravity,
             'in world': along(smoothed.back, -np.cross(world, world * inertia) / inertia),
             'damping': -w * (1.0, 1.0, 0.0), 'axis damping': -w * AXES[2],
             **{f'arm {k}': arm for k, arm in enumerate(arms)},
             **{f'euler {k}': term for k, term in enumerate(euler)}}
    effects = {name: np.tensordot(_MEAN, [node[at:len(node) - 5 + at] for at in range(6)], 1)
               for name, node in nodes.items()}
    for name in ('gyroscopic', 'gravity'):
        effects[f'{name} step'] = np.diff(nodes[name], axis=0)[2:-2]
    change = np.diff(w, axis=0)[2:-2] / motion.step
    effects[TARGET] = change - effects['gyroscopic'] - effects['gravity']
    size = rms(change) or 1.0
    return {name: effect / size for name, effect in effects.items()}


def _gyroscopic(found: Reals) -> Finding | None:
    share = 1.0 + float(found[0])
    return None if share >= NEAR else Finding(      # else it is the moments
        'no_gyroscopic_term' if share > -NEAR else 'coriolis_sign',
        f'the gyroscopic term w x I w has {share:z.4f} times its size', share)


def _step(found: Reals) -> Finding:
    at, gravity_at = (0.5 + found).tolist()
    name = ('first_order' if abs(found[0]) < 0.5 * abs(found[1]) else
            'implicit_damping' if at > 0.5 else
            'explicit_gyroscopic_term' if at > -0.5 else 'coriolis_sign')
    return Finding(name, f'in the mean, the gyroscopic term is taken at {at:.3g} of a step, '
                   f'gravity at {gravity_at:.3g}; right is 0.5', at)


def _com(body: Body, found: Reals) -> Finding:
    com, size = found + body.com, float(np.linalg.norm(found))
    ratio = float(com[2]) / (body.com_distance or np.inf)
    along_axis = np.linalg.norm(found[:2]) < SIDEWAYS * size
    name, number = (
        ('gravity', ratio * body.gravity) if along_axis and (
            abs(ratio * body.gravity / STANDARD_GRAVITY - 1.0) < GRAVITY_BAND) else
        ('gravity_sign', ratio) if along_axis and ratio < 0.0 else ('com_offset', size))
    return Finding(name, f'the torque of gravity is {ratio:.5g} times its size, as of a centre of '
                   f'mass at ({listed(com)}) m', number)


def _inertia(body: Body, found: Reals) -> Finding | None:
    shares = 1.0 + found[:2]
    return None if np.any(shares <= 0.0) else Finding(
        'inertia', 'the motion is that of moments of inertia across the axis of '
        f'{listed(body.lambda1 / shares)} kg m^2, not {body.lambda1:.4g}',
        float(body.lambda1 / shares[0]))
