# SPDX-License-Identifier: Apache-2.0
"""The top as the one entity of a simulator, in messages of simulation_interfaces."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3

from spinning_top_sim.nodes.name_filter import is_found
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.placement import Box, Reals, rotation_matrix, state_of
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.streams.cdr import NANOSECONDS

# Message packages have no types.
Message = Any
TAGS = ('spinning_top', 'heavy_symmetric_top', 'imu')
# How far the pivot may be from the origin [m], how fast it may move [m/s], and by how much the
# length of a quaternion may differ from 1: what a client's rounding makes.
SMALLEST_LENGTH, SMALLEST_SPEED, LENGTH_ERROR = 1e-6, 1e-6, 1e-3


class UnsupportedError(ValueError):
    """What is asked for is possible in the standard, and not here."""


class PoseError(ValueError):
    """The top cannot have this pose."""


def fill_state(message: Message, states: States, stamp_ns: int, frame: str) -> None:
    """Put the state (n = 1) into an EntityState, in the world frame; the pivot is at rest."""
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
    Return what makes the state that a SetEntityState request asks for from the present one.

    Raises PoseError, UnsupportedError or ValueError, which name what is wrong with it.
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


def _check_pose(position: Reals, rotation: Reals) -> None:
    if not np.all(np.abs(position) <= SMALLEST_LENGTH):
        raise PoseError(f'pose.position = {position.tolist()} m: must be the pivot, [0, 0, 0] '
                        f'(within {SMALLEST_LENGTH:g})')
    length = float(np.linalg.norm(rotation))
    if not abs(length - 1.0) <= LENGTH_ERROR:
        raise PoseError(f'pose.orientation = {rotation.tolist()} has length {length!r}: must be 1 '
                        f'(within {LENGTH_ERROR:g})')


def is_chosen(filters: Message, name: str, category: int, top: Top,
              present: Callable[[], States]) -> bool:
    """
    Return whether EntityFilters choose the top.

    present : returns its state (n = 1)

    Raises UnsupportedError or ValueError for filters that cannot be applied.
    """
    chosen = is_found(filters.filter, name)
    if filters.categories:
        chosen &= category in [one.category for one in filters.categories]
    if filters.tags.tags:
        modes = {filters.tags.FILTER_MODE_ANY: any, filters.tags.FILTER_MODE_ALL: all}
        mode = filters.tags.filter_mode
        if mode not in modes:
            raise ValueError(f'tags.filter_mode = {mode}: must be '
                             f'{" or ".join(map(str, modes))}')
        chosen &= modes[mode](tag in TAGS for tag in filters.tags.tags)
    if filters.bounds.type != filters.bounds.TYPE_EMPTY:
        chosen &= _overlaps(filters.bounds, top, present)
    return bool(chosen)


def _overlaps(bounds: Message, top: Top, present: Callable[[], States]) -> bool:
    """Return whether Bounds, in the world frame, and the box of the top have common points."""
    points = np.array([_numbers(point, 'xyz') for point in bounds.points])
    if bounds.type not in (bounds.TYPE_SPHERE, bounds.TYPE_BOX):
        raise UnsupportedError(f'bounds.type = {bounds.type}: must be {bounds.TYPE_EMPTY} (none), '
                               f'{bounds.TYPE_BOX} (box) or {bounds.TYPE_SPHERE} (sphere)')
    if len(points) != 2 or not np.all(np.isfinite(points)):
        raise ValueError(f'bounds.points = {points.tolist()}: must be two finite points')
    box = Box.of(top)
    rotation = rotation_matrix(np.concatenate(present().rows_quaternion))
    if bounds.type == bounds.TYPE_BOX:
        return box.overlaps_box(rotation, Box(points.min(axis=0), points.max(axis=0)))
    radius = float(points[1, 0])
    if radius < 0.0:
        raise ValueError(f'bounds.points[1].x = {radius!r} m: the radius must be >= 0')
    return box.overlaps_sphere(rotation, points[0], radius)


def fill_bounds(bounds: Message, top: Top) -> None:
    """Put the box of the top into Bounds, in the body frame: upper corner, lower corner."""
    box = Box.of(top)
    bounds.type = bounds.TYPE_BOX
    bounds.points = [Vector3(**dict(zip('xyz', corner.tolist(), strict=True)))
                     for corner in (box.upper, box.lower)]


def describe(top: Top) -> str:
    """Return the top in words."""
    return (f'heavy symmetric top on a fixed pivot: mass {top.mass:g} kg, centre of mass '
            f'{top.com_distance:g} m from the pivot, moments of inertia {top.lambda1:g} and '
            f'{top.lambda3:g} kg m^2')


def _numbers(message: Message, names: Sequence[str]) -> Reals:
    return np.array([getattr(message, name) for name in names], float)
