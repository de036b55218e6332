# SPDX-License-Identifier: Apache-2.0
"""The top as the one entity of a simulator, in messages of simulation_interfaces."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3
from numpy.typing import NDArray

from spinning_top_sim.nodes.simulation_standard import UnsupportedError
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.placement import state_of
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import Shape, State, Top
from spinning_top_sim.streams.cdr import NANOSECONDS

Message = Any           # message packages have no types
TAGS = ('spinning_top', 'heavy_symmetric_top', 'imu')
# Tolerances for the rounding of a client: distance of the pivot from the origin [m], its velocity
# [m/s], and the difference of a quaternion's length from 1.
SMALLEST_LENGTH, SMALLEST_SPEED, LENGTH_ERROR = 1e-6, 1e-6, 1e-3


class PoseError(ValueError):
    """The top cannot have this pose."""


def fill_state(message: Message, states: States, stamp_ns: int, frame: str) -> None:
    """Write a state (n = 1) into an EntityState, in the world frame; the pivot is at rest."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    message.header.frame_id = frame
    rotation = states.rows_quaternion
    for target, rows, names in (
            (message.pose.orientation, rotation, 'xyzw'),
            (message.twist.angular, attitude.in_world(rotation, states.rows_angular_velocity),
             'xyz'),
            (message.acceleration.angular,
             attitude.in_world(rotation, states.rows_angular_acceleration), 'xyz')):
        for name, column in zip(names, rows, strict=True):
            setattr(target, name, float(column[0]))


def changed_state(request: Message, top: Top, frame: str) -> Callable[[States], State]:
    """
    Return a function that computes the state a SetEntityState request asks for.

    The function takes the present state (n = 1), which holds for what the request does not set.
    Raises PoseError, UnsupportedError or ValueError, which name the value and what is allowed.
    """
    wanted, asked_frame = request.state, request.state.header.frame_id
    # Older versions of the message have no flags, and set both.
    sets_pose, sets_twist = (getattr(request, name, True) for name in ('set_pose', 'set_twist'))
    if not (sets_pose or sets_twist):
        raise ValueError('set_pose and set_twist are false: one of them must be true; the '
                         'acceleration follows from pose and twist')
    if asked_frame not in ('', frame):
        raise UnsupportedError(f'header.frame_id = {asked_frame!r}: must be {frame!r} or empty')
    rotation = _numbers(wanted.pose.orientation, 'xyzw')
    rates = _numbers(wanted.twist.angular, 'xyz')
    if sets_pose:
        _check_pose(_numbers(wanted.pose.position, 'xyz'), rotation)
    if sets_twist:
        velocity = _numbers(wanted.twist.linear, 'xyz')
        if not np.all(np.abs(velocity) <= SMALLEST_SPEED):
            raise ValueError(f'twist.linear = {velocity.tolist()} m/s: must be 0, as the pivot '
                             f'is fixed (within {SMALLEST_SPEED:g})')
        if not np.all(np.isfinite(rates)):
            raise ValueError(f'twist.angular = {rates.tolist()} rad/s: must be finite')

    def change(now: States) -> State:
        present = np.concatenate(now.rows_quaternion)
        spin = rates if sets_twist else np.concatenate(attitude.in_world(
            now.rows_quaternion, tuple(now.angular_velocity.T)))
        return state_of(top, rotation if sets_pose else present, spin)
    return change


def _check_pose(position: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
    if not np.all(np.abs(position) <= SMALLEST_LENGTH):
        raise PoseError(f'pose.position = {position.tolist()} m: must be the pivot, [0, 0, 0] '
                        f'(within {SMALLEST_LENGTH:g})')
    length = float(np.linalg.norm(rotation))
    if not abs(length - 1.0) <= LENGTH_ERROR:
        raise PoseError(f'pose.orientation = {rotation.tolist()} has length {length!r}: must be 1 '
                        f'(within {LENGTH_ERROR:g})')


def is_chosen(filters: Message, name: str, category: int) -> bool:
    """
    Return whether EntityFilters choose an entity with this name, this category and TAGS.

    Raises UnsupportedError or ValueError for filters that cannot be applied.
    """
    if filters.bounds.type != filters.bounds.TYPE_EMPTY:
        raise UnsupportedError(f'bounds.type = {filters.bounds.type}: must be '
                               f'{filters.bounds.TYPE_EMPTY} (none); filtering by bounds is not '
                               'supported')
    modes = {filters.tags.FILTER_MODE_ANY: any, filters.tags.FILTER_MODE_ALL: all}
    if filters.tags.tags and filters.tags.filter_mode not in modes:
        raise ValueError(f'tags.filter_mode = {filters.tags.filter_mode}: must be '
                         f'{" or ".join(map(str, modes))}')
    return (is_found(filters.filter, name)
            and (not filters.categories
                 or category in [one.category for one in filters.categories])
            and (not filters.tags.tags or modes[filters.tags.filter_mode](
                tag in TAGS for tag in filters.tags.tags)))


def is_found(expression: str, name: str) -> bool:
    """Return whether a regular expression matches a part of a name.  Raises ValueError."""
    if not expression:
        return True
    try:
        # Its time is linear in the text; some expressions take `re` exponential time.
        from re2 import Options, error, search  # noqa: PLC0415
    except ImportError as missing:
        raise UnsupportedError(f'filter = {expression!r}: must be empty, because the Python '
                               'package google-re2 is not installed') from missing
    options = Options()
    options.log_errors = False
    try:
        return search(expression, name, options=options) is not None
    except (error, UnicodeError) as wrong:
        reason = wrong.args[0]
        raise ValueError(
            f'filter = {expression!r}: must be a POSIX extended regular expression: '
            f'{reason.decode() if isinstance(reason, bytes) else wrong}') from wrong


def fill_bounds(bounds: Message, top: Top) -> None:
    """Write the box around the top into Bounds, in the body frame: upper corner, lower corner."""
    shape = Shape(top)
    bounds.type = bounds.TYPE_BOX
    bounds.points = [Vector3(**dict(zip('xyz', corner, strict=True)))
                     for corner in (shape.upper, shape.lower)]


def describe(top: Top) -> str:
    """Return a description of the top in words."""
    return (f'heavy symmetric top on a fixed pivot: mass {top.mass:g} kg, centre of mass '
            f'{top.com_distance:g} m from the pivot, moments of inertia {top.lambda1:g} and '
            f'{top.lambda3:g} kg m^2')


def _numbers(message: Message, names: Sequence[str]) -> NDArray[np.float64]:
    return np.array([getattr(message, name) for name in names], float)
