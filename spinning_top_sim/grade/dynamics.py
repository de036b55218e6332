# SPDX-License-Identifier: Apache-2.0
"""
Names what is wrong with a simulator's equations of motion and steps.

The change of its rates in each step is compared with what gravity and the gyroscopic term, both of
its own attitudes and rates, would cause.  Errors do not add up there, so that the method works on
every motion, and for every size of the error.
"""

from collections.abc import Sequence

import numpy as np

from spinning_top_sim.exam.measures import rms
from spinning_top_sim.grade.motion import MARGIN, Motion
from spinning_top_sim.grade.regression import NEAR, Cause, explain, instead
from spinning_top_sim.grade.report import Fault
from spinning_top_sim.grade.scenes import Body, Reals

# Mean over the interval in the middle of six samples, for polynomials of degree 5.
_MEAN = np.array([11.0, -93.0, 802.0, 802.0, -93.0, 11.0]) / 1440.0
UNIMPORTANT = 1e-4  # of the angular acceleration: its error is in the attitudes
EXPLAINED = 0.25    # of the discrepancy is left at most


def faults_of(motions: Sequence[Motion], dt: float) -> list[Fault]:
    """Return the causes of the error of motions."""
    blocks = [_terms(motion, dt) for motion in motions]
    # Motions count the same, unless what is not explained is small there.
    sizes = [rms(target) for target, _ in blocks]
    weights = [1.0 / max(size, 0.1 * max(sizes), UNIMPORTANT) for size in sizes]
    target, columns = (np.concatenate([weight * part for weight, part in zip(
        weights, parts, strict=True)]) for parts in zip(*blocks, strict=True))
    # Columns as `_terms` has them.
    gyroscopic, gyroscopic_step, gravity_step, in_world, damping, axis_damping, *others = (
        columns.transpose(1, 0, 2))
    arms, euler = others[:3], others[3:]
    body = motions[0].body
    if max(sizes) < UNIMPORTANT:
        return []
    faults, residual = explain(target, [
        Cause([gyroscopic], _gyroscopic), Cause([gyroscopic_step, gravity_step], _step),
        Cause([gyroscopic, in_world], instead('inertia_frame', 'the gyroscopic term is that of '
                                              'moments of inertia about axes of the world')),
        Cause([damping, axis_damping], _damping), Cause(arms, lambda found: _com(body, found)),
        Cause(euler, lambda found: _inertia(body, found))])
    return faults if rms(residual) < EXPLAINED * rms(target) else []


def _terms(motion: Motion, dt: float) -> tuple[Reals, Reals]:
    """Return the angular acceleration that is not explained (N, 3), and its causes (N, k, 3)."""
    body, step, w = motion.body, motion.trajectory.step, motion.rates
    rotation = motion.trajectory.rotation[MARGIN:-MARGIN]
    z = rotation.inv().apply((0.0, 0.0, 1.0))
    inertia = np.array(body.inertia)
    zero = np.zeros(len(w))
    weight = body.mass * body.gravity
    gyroscopic = -np.cross(w, inertia * w) / inertia
    arms = [-weight * np.cross(e, z) / inertia for e in np.eye(3)]
    gravity = body.com_distance * arms[2]
    world = rotation.apply(w)
    in_world = rotation.inv().apply(-np.cross(world, inertia * world) / inertia)
    across = w * (1.0, 1.0, 0.0)
    euler = [np.stack(rows, axis=1) for rows in (
        (gravity[:, 0], zero, zero), (zero, gravity[:, 1], zero), (w[:, 1] * w[:, 2], zero, zero),
        (zero, w[:, 2] * w[:, 0], zero), (zero, zero, w[:, 0] * w[:, 1]))]
    nodes = np.stack([gyroscopic, in_world, -across, across - w, *arms, *euler], axis=1)
    means = sum(weight * nodes[at:len(nodes) - 5 + at] for at, weight in enumerate(_MEAN))
    steps = (dt / step) * np.stack([np.diff(part, axis=0)[2:-2]
                                    for part in (gyroscopic, gravity)], axis=1)
    columns = np.concatenate((means[:, :1], steps, means[:, 1:]), axis=1)
    change = np.diff(w, axis=0)[2:-2] / step
    target = change - means[:, 0] - body.com_distance * means[:, 6]
    size = 1.0 / (rms(change) or 1.0)
    return size * target, size * columns


def _gyroscopic(found: Reals) -> Fault:
    share = 1.0 + float(found[0])
    text = f'the gyroscopic term w x I w has {share:.3g} times its size'
    return Fault('no_gyroscopic_term' if abs(share) < NEAR else
                 'coriolis_sign' if share < 0.0 else 'inertia', text, share)


def _step(found: Reals) -> Fault:
    at, gravity_at = (0.5 + found).tolist()
    name, means = (('first_order', f'gravity at {gravity_at:.3g}') if
                   abs(found[0]) < 0.5 * abs(found[1]) else
                   ('implicit_damping', 'it removes energy') if at > 0.5 else
                   ('explicit_gyroscopic_term', 'it adds energy') if at > -0.5 else
                   ('coriolis_sign', 'its derivative in an implicit step has the wrong sign'))
    return Fault(name, f'the gyroscopic term is taken at {at:.3g} of a step, in the mean; right '
                 f'is 0.5: {means}', at)


def _damping(found: Reals) -> Fault:
    across, along = found.tolist()
    return Fault('damping', f'a torque against the rates, {across:.3g} 1/s of them across the '
                 f'axis and {along:.3g} 1/s about it', across)


def _com(body: Body, found: Reals) -> Fault:
    com = found + body.com
    text = f'the torque of gravity is that of a centre of mass at ({_listed(com)}) m, not at ' \
        f'({_listed(body.com)}) m'
    if np.linalg.norm(com + body.com) < 0.1 * abs(body.com_distance):
        return Fault('gravity_sign', f'{text}: gravity points upwards', -1.0)
    return Fault('com_offset', text, float(np.linalg.norm(found)))


def _inertia(body: Body, found: Reals) -> Fault | None:
    shares = 1.0 + found[:2]
    if np.any(shares <= 0.0):
        return None
    first, second = body.lambda1 / shares
    # (I2 - I3)/I1, (I3 - I1)/I2 are told by the first two.
    right = (body.lambda1 - body.lambda3) / body.lambda1
    third = 0.5 * (second - first * (right + found[2]) + first + second * (found[3] - right))
    return Fault('inertia', 'the motion is that of moments of inertia '
                 f'{_listed((first, second, third))} kg m^2, not {_listed(body.inertia)}',
                 float(first))


def _listed(values: Sequence[float] | Reals) -> str:
    return ', '.join(f'{float(value):.4g}' for value in values)
