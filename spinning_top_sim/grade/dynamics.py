# SPDX-License-Identifier: Apache-2.0
"""
Names what is wrong with a simulator's equations of motion and steps.

The change of its rates in each step is compared with what gravity and the gyroscopic term, both of
its own attitudes and rates, would cause.  Errors do not add up there, so that the method works on
every motion, and for every size of the error.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from spinning_top_sim.grade.causes import GRAVITY_BAND, listed
from spinning_top_sim.grade.columns import AXES, STANDARD_GRAVITY
from spinning_top_sim.grade.scenes import Body
from spinning_top_sim.tools.identify import NEAR, TARGET, Cause, Model, explain, instead, rms
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch, along
from spinning_top_sim.tools.report import Finding

# Mean over the interval in the middle of six samples, for polynomials of degree 5.
_MEAN = np.array([11.0, -93.0, 802.0, 802.0, -93.0, 11.0]) / 1440.0
UNIMPORTANT = 1e-4  # of the angular acceleration: its error is in the attitudes
EXPLAINED = 0.25    # of the discrepancy is left at most
SIDEWAYS = 1e-2     # of a change of the torque, across the axis, that is none


def faults_of(body: Body, motions: Sequence[Stretch], dt: float) -> list[Finding]:
    """Return the causes of the error of motions of a body."""
    parts = [_terms(body, motion, dt) for motion in motions]
    model = Model({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    if model.size(TARGET) < UNIMPORTANT:
        return []
    found, rest = explain(model, [
        Cause(['gyroscopic'], _gyroscopic), Cause(['gyroscopic step', 'gravity step'], _step),
        Cause(['gyroscopic', 'in world'], instead(
            'inertia_frame', 'the gyroscopic term is that of moments of inertia about axes of the '
            'world')),
        Cause(['damping', 'axis damping'], _damping),
        Cause(['arm 0', 'arm 1', 'arm 2'], partial(_com, body)),
        Cause([f'euler {k}' for k in range(5)], partial(_inertia, body))])
    return found if rest.rest < EXPLAINED * model.size(TARGET) else []


def _terms(body: Body, motion: Stretch, dt: float) -> dict[str, Reals]:
    """Return the angular acceleration that is not explained (N, 3), and effects of causes."""
    smoothed = Smoothed(motion, 1)
    step, w, inertia = motion.step, smoothed.rates, body.inertia
    z, world = smoothed.turn[:, 2], along(smoothed.turn, w)
    gyroscopic = -np.cross(w, w * inertia) / inertia
    arms = [-body.mass * body.gravity * np.cross(axis, z) / inertia for axis in AXES]
    gravity, products = body.com_distance * arms[2], w[:, [1, 2, 0]] * w[:, [2, 0, 1]]
    # Effects of other moments: on the torque of gravity about e1 and e2 (I1, I2), then on
    # (I2 - I3)/I1, (I3 - I1)/I2 and (I1 - I2)/I3, which are fitted, but not read.
    euler = [gravity * AXES[0], gravity * AXES[1], *(products * axis for axis in AXES)]
    nodes = {'gyroscopic': gyroscopic, 'gravity': gravity,
             'in world': along(smoothed.back, -np.cross(world, world * inertia) / inertia),
             'damping': -w * (1.0, 1.0, 0.0), 'axis damping': -w * AXES[2],
             **{f'arm {k}': arm for k, arm in enumerate(arms)},
             **{f'euler {k}': term for k, term in enumerate(euler)}}
    effects: dict[str, Reals] = {name: sum(weight * node[at:len(node) - 5 + at] for at, weight in enumerate(_MEAN))
               for name, node in nodes.items()}
    for name in ('gyroscopic', 'gravity'):
        effects[f'{name} step'] = dt / step * np.diff(nodes[name], axis=0)[2:-2]
    change = np.diff(w, axis=0)[2:-2] / step
    effects[TARGET] = change - effects['gyroscopic'] - effects['gravity']
    size = rms(change) or 1.0
    return {name: effect / size for name, effect in effects.items()}


def _gyroscopic(found: Reals) -> Finding | None:
    share = 1.0 + float(found[0])
    return None if share >= NEAR else Finding(      # else it is the moments
        'no_gyroscopic_term' if share > -NEAR else 'coriolis_sign',
        f'the gyroscopic term w x I w has {share:.3g} times its size', share)


def _step(found: Reals) -> Finding:
    at, gravity_at = (0.5 + found).tolist()
    name, means = (('first_order', f'gravity at {gravity_at:.3g}') if
                   abs(found[0]) < 0.5 * abs(found[1]) else
                   ('implicit_damping', 'it removes energy') if at > 0.5 else
                   ('explicit_gyroscopic_term', 'it adds energy') if at > -0.5 else
                   ('coriolis_sign', 'its derivative in an implicit step has the wrong sign'))
    return Finding(name, f'the gyroscopic term is taken at {at:.3g} of a step, in the mean; right '
                   f'is 0.5: {means}', at)


def _damping(found: Reals) -> Finding:
    return Finding('damping', f'a torque against the rates, {found[0]:.3g} 1/s of them across the '
                   f'axis and {found[1]:.3g} 1/s about it', float(found[0]))


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
