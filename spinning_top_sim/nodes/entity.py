# SPDX-License-Identifier: Apache-2.0
"""The top as the one entity of a simulator, in messages of simulation_interfaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams.cdr import NANOSECONDS

Message = Any           # message packages have no types
TAGS = ('spinning_top', 'heavy_symmetric_top', 'imu')
# Tolerances for the rounding of a client: of the pivot's place [m] and its velocity [m/s], and
# of a quaternion's length.
SMALLEST_LENGTH, SMALLEST_SPEED, LENGTH_ERROR = 1e-6, 1e-6, 1e-3


class RefusedError(RuntimeError):
    """A request is refused with a result code."""

    def __init__(self, code: int, reason: object) -> None:
        super().__init__(str(reason))
        self.code = code


def fill_state(message: Message, states: States, stamp_ns: int, frame: str) -> None:
    """Write a state (n = 1) into an EntityState, in the world frame."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    message.header.frame_id = frame
    rotation, pivot = states.rows_quaternion, states.pivot
    for target, rows, names in (
            (message.pose.orientation, rotation, 'xyzw'),
            (message.twist.angular, attitude.rotated(rotation, states.rows_angular_velocity),
             'xyz'),
            (message.acceleration.angular,
             attitude.rotated(rotation, states.rows_angular_acceleration), 'xyz'),
            (message.pose.position, pivot.position, 'xyz'),
            (message.twist.linear, pivot.velocity, 'xyz'),
            (message.acceleration.linear, pivot.acceleration, 'xyz')):
        for name, column in zip(names, rows, strict=True):
            setattr(target, name, float(column[0]))


def requested_state(request: Message, response: Message, frame: str, now: States) -> State:
    """
    Return the state that a SetEntityState request asks for.

    response : has the codes of refusals
    now : the present state (n = 1), which holds for what the request does not set, and for the
        pivot

    Raises RefusedError or ValueError, which name the value and what is allowed.
    """
    pivot, wanted, requested_frame = now.pivot, request.state, request.state.header.frame_id
    # Older versions of the message have no flags, and set both.
    sets_pose, sets_twist = (getattr(request, name, True) for name in ('set_pose', 'set_twist'))
    if not (sets_pose or sets_twist):
        raise ValueError('set_pose and set_twist are false: one of them must be true; the '
                         'acceleration follows from pose and twist')
    if requested_frame not in ('', frame):
        raise RefusedError(response.result.RESULT_FEATURE_UNSUPPORTED,
                           f'header.frame_id = {requested_frame!r}: must be {frame!r} or empty')
    rotation = np.concatenate(now.rows_quaternion)
    rates = np.concatenate(attitude.rotated(now.rows_quaternion, now.rows_angular_velocity))
    if sets_pose:
        rotation = _numbers(wanted.pose.orientation, 'xyzw')
        position = _numbers(wanted.pose.position, 'xyz')
        if not np.all(np.abs(position - pivot.position[:, 0]) <= SMALLEST_LENGTH):
            raise RefusedError(response.INVALID_POSE, f'pose.position = {position.tolist()} m: '
                               f'must be the pivot, {pivot.position[:, 0].tolist()} (within '
                               f'{SMALLEST_LENGTH:g})')
        length = float(np.linalg.norm(rotation))
        if not abs(length - 1.0) <= LENGTH_ERROR:
            raise RefusedError(response.INVALID_POSE, f'pose.orientation = {rotation.tolist()} '
                               f'has length {length!r}: must be 1 (within {LENGTH_ERROR:g})')
    if sets_twist:
        rates = _numbers(wanted.twist.angular, 'xyz')
        velocity = _numbers(wanted.twist.linear, 'xyz')
        pivot_velocity = pivot.velocity[:, 0]
        if not np.all(np.abs(velocity - pivot_velocity) <= SMALLEST_SPEED):
            raise ValueError(f'twist.linear = {velocity.tolist()} m/s: must be that of the pivot, '
                             f'{pivot_velocity.tolist()} (within {SMALLEST_SPEED:g})')
        if not np.all(np.isfinite(rates)):
            raise ValueError(f'twist.angular = {rates.tolist()} rad/s: must be finite')
    return state_of(now.top, rotation, rates)


def _numbers(message: Message, names: Sequence[str]) -> NDArray[np.float64]:
    return np.array([getattr(message, name) for name in names], float)
