# SPDX-License-Identifier: Apache-2.0
"""
Names what is wrong with a simulator's equations of motion and steps.

The change of its rates in each step is compared with what gravity and the gyroscopic term, both of
its own attitudes and rates, would cause.  Errors do not add up there, so that the method works on
every motion, and for every size of the error.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from spinning_top_sim.grade.causes import GRAVITY_BAND, listed
from spinning_top_sim.grade.columns import STANDARD_GRAVITY
from spinning_top_sim.grade.scenes import Body
from spinning_top_sim.tools.identify import (
    NEAR,
    Cause,
    Verdict,
    explain,
    fitted,
    instead,
    pooled,
    rms,
    verdicts,
)
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch

# Mean over the interval in the middle of six samples, for polynomials of degree 5.
_MEAN = np.array([11.0, -93.0, 802.0, 802.0, -93.0, 11.0]) / 1440.0
UNIMPORTANT = 1e-4  # of the angular acceleration: its error is in the attitudes
EXPLAINED = 0.25    # of the discrepancy is left at most
SIDEWAYS = 1e-2     # of a change of the torque, across the axis, that is none


def faults_of(body: Body, motions: Sequence[Stretch], dt: float) -> list[Verdict]:
    """Return the causes of the error of motions of a body."""
    target, effects = pooled(_terms(body, motion, dt) for motion in motions)
    if rms(target) < UNIMPORTANT:
        return []
    chosen = explain(target, effects, [
        Cause(['gyroscopic'], _gyroscopic), Cause(['gyroscopic step', 'gravity step'], _step),
        Cause(['gyroscopic', 'in world'], instead(
            'inertia_frame', 'the gyroscopic term is that of moments of inertia about axes of the '
            'world')),
        Cause(['damping', 'axis damping'], _damping),
        Cause(['arm 0', 'arm 1', 'arm 2'], partial(_com, body)),
        Cause([f'euler {k}' for k in range(5)], partial(_inertia, body))])
    names = [name for cause in chosen for name in cause.effects]
    if not names:
        return []
    found, residual = fitted(target, [effects[name] for name in names])
    explained = rms(residual) < EXPLAINED * rms(target)
    return [one for one in verdicts(chosen, found) if one and one.name and explained]


def _terms(body: Body, motion: Stretch, dt: float) -> tuple[Reals, Mapping[str, Reals]]:
    """Return the angular acceleration that is not explained (N, 3), and effects of causes."""
    smoothed = Smoothed(motion, 1)
    step, w, inertia = motion.step, smoothed.rates, body.inertia
    rotation = motion.rotation[smoothed.inner]
    axes = np.eye(3)
    z, world = rotation.inv().apply((0.0, 0.0, 1.0)), rotation.apply(w)
    gyroscopic = -np.cross(w, w * inertia) / inertia
    arms = [-body.mass * body.gravity * np.cross(axis, z) / inertia for axis in axes]
    gravity, products = body.com_distance * arms[2], w[:, [1, 2, 0]] * w[:, [2, 0, 1]]
    # Effects of other moments: on the torque of gravity about e1 and e2 (I1, I2), then on
    # (I2 - I3)/I1, (I3 - I1)/I2 and (I1 - I2)/I3; the last is fitted, but not read.
    euler = [gravity * axes[0], gravity * axes[1], *(products * axis for axis in axes)]
    nodes = {'gyroscopic': gyroscopic, 'gravity': gravity,
             'in world': rotation.inv().apply(-np.cross(world, world * inertia) / inertia),
             'damping': -w * (1.0, 1.0, 0.0), 'axis damping': -w * axes[2],
             **{f'arm {k}': arm for k, arm in enumerate(arms)},
             **{f'euler {k}': term for k, term in enumerate(euler)}}
    effects = {name: sum(weight * node[at:len(node) - 5 + at] for at, weight in enumerate(_MEAN))
               for name, node in nodes.items()}
    for name in ('gyroscopic', 'gravity'):
        effects[f'{name} step'] = dt / step * np.diff(nodes[name], axis=0)[2:-2]
    change = np.diff(w, axis=0)[2:-2] / step
    size = 1.0 / (rms(change) or 1.0)
    return size * (change - effects['gyroscopic'] - effects['gravity']), {
        name: size * effect for name, effect in effects.items()}


def _gyroscopic(found: Reals) -> Verdict | None:
    share = 1.0 + float(found[0])
    if share >= NEAR:               # `_inertia` tells the moments
        return None
    return Verdict('no_gyroscopic_term' if share > -NEAR else 'coriolis_sign',
                 f'the gyroscopic term w x I w has {share:.3g} times its size', share)


def _step(found: Reals) -> Verdict:
    at, gravity_at = (0.5 + found).tolist()
    name, means = (('first_order', f'gravity at {gravity_at:.3g}') if
                   abs(found[0]) < 0.5 * abs(found[1]) else
                   ('implicit_damping', 'it removes energy') if at > 0.5 else
                   ('explicit_gyroscopic_term', 'it adds energy') if at > -0.5 else
                   ('coriolis_sign', 'its derivative in an implicit step has the wrong sign'))
    return Verdict(name, f'the gyroscopic term is taken at {at:.3g} of a step, in the mean; right '
                 f'is 0.5: {means}', at)


def _damping(found: Reals) -> Verdict:
    across, along = found.tolist()
    return Verdict('damping', f'a torque against the rates, {across:.3g} 1/s of them across the '
                 f'axis and {along:.3g} 1/s about it', across)


def _com(body: Body, found: Reals) -> Verdict:
    com = found + body.com
    text = f'the torque of gravity is that of a centre of mass at ({listed(com)}) m, not at ' \
        f'({listed(body.com)}) m'
    gravity = body.gravity * com[2] / (body.com_distance or math.inf)
    if abs(gravity / STANDARD_GRAVITY - 1.0) < GRAVITY_BAND and np.linalg.norm(com[:2]) < (
            SIDEWAYS * np.linalg.norm(found)):
        return Verdict('gravity', f'the torque is that of gravity of {gravity:.5g} m/s^2, not '
                       f'{body.gravity:.5g} m/s^2', float(gravity))
    if np.linalg.norm(com + body.com) < 0.1 * abs(body.com_distance):
        return Verdict('gravity_sign', f'{text}: gravity points upwards', -1.0)
    return Verdict('com_offset', text, float(np.linalg.norm(found)))


def _inertia(body: Body, found: Reals) -> Verdict | None:
    shares = 1.0 + found[:2]
    if np.any(shares <= 0.0):
        return None
    first, second = body.lambda1 / shares
    # The others are changes of (I2 - I3)/I1 and (I3 - I1)/I2; each of them tells I3.
    right = (body.lambda1 - body.lambda3) / body.lambda1
    third = 0.5 * (second - first * (right + found[2]) + first + second * (found[3] - right))
    return Verdict('inertia', 'the motion is that of moments of inertia '
                 f'{listed((first, second, third))} kg m^2, not {listed(body.inertia)}',
                 float(first))
