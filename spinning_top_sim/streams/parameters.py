# SPDX-License-Identifier: Apache-2.0
"""
The parameters of a simulation, by the table in parameters.toml, and what they describe.

The node (descriptors, validation), the command line and the documentation use the same table.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from itertools import chain, pairwise
from typing import Any

from spinning_top_sim.installation import read_table, remedy
from spinning_top_sim.physics.pivot import SHORTEST_S, PivotPath
from spinning_top_sim.physics.top import State, Top, shown
from spinning_top_sim.streams.parameter import ANY, Effect, Parameter, Range

FRAMES = ('world_frame', 'body_frame', 'imu.frame_id')      # each the parent of the next one
REMOVED = ('pacing', 'max_error', 'publish_clock')      # in logs of 1.x
# Those that rclpy declares for every node, and the group that it declares for publishers.
OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def _described(name: str, row: Mapping[str, Any]) -> Iterator[Parameter]:
    """Yield the parameters that an entry of the table describes."""
    if name != 'streams':
        given: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value
                                 for key, value in row.items()}
        given['range'] = Range(**row['range']) if 'range' in row else ANY
        given['effect'] = Effect[row.get('effect', 'reset').upper()]
        yield Parameter(name, **given)
        return
    for stream, one in row.items():
        yield Parameter(f'{stream}.enabled', f'Whether there is {one["text"]}; a recording keeps '
                        'the streams that it began with', one['enabled'], effect=Effect.NOW)
        if 'rate' in one:
            yield Parameter(f'{stream}.rate', f'Rate of {one["text"]}', one['rate'],
                            Range(one.get('lowest_rate', 1e-6), 1e4), unit='Hz',
                            effect=Effect.NOW)


_CONTENT = read_table('streams/parameters.toml')
# Descriptions of the streams, by name.
STREAMS: Mapping[str, str] = {name: row['text'] for name, row in _CONTENT['streams'].items()}
TABLE = tuple(chain.from_iterable(_described(*entry) for entry in _CONTENT.items()))
BY_NAME: Mapping[str, Parameter] = {parameter.name: parameter for parameter in TABLE}
# What a change of them does is an event of the run.
AT_ONCE = frozenset(one.name for one in TABLE if one.effect is Effect.NOW)
LONGEST = BY_NAME['duration'].range.highest     # time [s], three years
FASTEST = BY_NAME['pivot.speed'].range.highest  # speed of the pivot [m/s]


def checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `valid` values.  Raises ValueError also where a library that they need is missing."""
    result = valid(values)
    for name, value, library in (('gnss.enabled', True, 'pymap3d'),
                                 ('solver.method', 'exact', 'gmpy2')):
        if result[name] == value and find_spec(library) is None:
            raise ValueError(f'{name} = {value}: needs {library}, which is not installed: '
                             f'{remedy(library)}')
    return result


def valid(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters: these values, else defaults.  Raises ValueError for bad values."""
    result = {parameter.name: parameter.default for parameter in TABLE} | checked_changes(values)
    _check_together(result)
    for describe in (top_of, start_state, pivot_path):      # they refuse what cannot be
        describe(result)
    return result


def checked_changes(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return these values, each checked alone, without those of ROS.  Raises ValueError."""
    for name, value in values.items():
        if not (name in BY_NAME or name in REMOVED or is_of_ros(name)):
            raise ValueError(f'{name} = {shown(value)}: there is no such parameter')
    return {name: BY_NAME[name].check(value) for name, value in values.items() if name in BY_NAME}


def is_of_ros(name: str) -> bool:
    """Return whether rclpy declares a parameter of this name."""
    return name.partition('.')[0] in OF_ROS


def _check_together(values: Mapping[str, Any]) -> None:
    """Raise ValueError for values that are wrong only together."""
    def need(allowed: bool, name: str, text: str) -> None:
        if not allowed:
            value = list(values[name]) if isinstance(values[name], tuple) else values[name]
            raise ValueError(f'{name} = {value!r}: {text}')

    frames = [values[name] for name in FRAMES]
    for name, frame in zip(FRAMES, frames, strict=True):
        need(frame != '' and not frame.startswith('/'), name,
             'must be the name of a frame, without a slash at its begin')
        need(frames.index(frame) == FRAMES.index(name), name,
             'must be another frame than its parent')
    for name in values['record.streams']:
        need(name in ('all', *STREAMS), 'record.streams',
             f'{name!r} is no stream; must be all or some of {", ".join(STREAMS)}')
    need(_ascend(values['imu.bias_instability_band']), 'imu.bias_instability_band',
         'the second number must be larger than the first')
    need(values['imu.sampling'] != 'mean' or not values['imu.bandwidth'], 'imu.bandwidth',
         'must be 0 with imu.sampling = mean, which is a low pass itself')
    for name in ('imu.vibration.force_psd', 'imu.vibration.rate_psd'):
        profile = values[name]
        is_profile = len(profile) >= 4 and all(profile) and _ascend(profile[::2])
        need(is_profile or not any(profile), name,
             'must be two or more ascending frequencies > 0, each with a density > 0')
    for name in ('mag.disturbance.world', 'mag.disturbance.body'):
        for begin, end in zip(values[name][::5], values[name][1::5], strict=True):
            need(begin <= end, name,
                 f'an event from {begin!r} to {end!r} s: must not end before it begins')
    latitude, longitude, _ = values['gnss.origin']
    need(abs(latitude) <= 90.0 and abs(longitude) <= 180.0, 'gnss.origin',
         'must be a latitude from -90 to 90, a longitude from -180 to 180, and a height')
    need(not any(values['gnss.outages']) or _ascend(values['gnss.outages']), 'gnss.outages',
         'must be begin and end of each, ascending')


def _ascend(numbers: Iterable[float]) -> bool:
    return all(one < next_one for one, next_one in pairwise(numbers))


def is_enabled(stream: str, values: Mapping[str, Any]) -> bool:
    """Return whether streams with this prefix are on; increments bring the truth with them."""
    return bool(values[f'{stream}.enabled'] or (
        stream == 'ground_truth_imu_odom' and values['increments.enabled']))


def top_of(values: Mapping[str, Any]) -> Top:
    """Return the top that these parameters describe.  Raises ValueError like `Top`."""
    return Top(**{name: values[f'top.{name}']
                  for name in ('lambda1', 'lambda3', 'mass', 'com_distance', 'gravity')})


def pivot_path(values: Mapping[str, Any]) -> PivotPath | None:
    """Return the path of the pivot; None if it rests.  Raises ValueError."""
    path, points = (
        list(zip(*count * [iter(values[name])], strict=True)) if any(values[name]) else []
        for name, count in (('pivot.path', 4), ('pivot.waypoints', 3)))
    if path and points:
        raise ValueError(f'pivot.waypoints = {points!r}: must be zeros with pivot.path')
    for duration, *_ in path:
        if not duration >= SHORTEST_S:
            raise ValueError(f'pivot.path: the duration {duration!r} s: must be >= '
                             f'{SHORTEST_S:g} s')
    repeat = values['pivot.repeat']
    try:
        if path:
            return PivotPath([(round(duration * 1e9), a) for duration, *a in path], repeat=repeat)
        return PivotPath.through(points, speed=values['pivot.speed'], repeat=repeat,
                                 acceleration=values['pivot.acceleration']) if points else None
    except ValueError as error:
        raise ValueError(f'pivot.{"path" if path else "waypoints"}: {error}') from error


def start_state(values: Mapping[str, Any]) -> State:
    """Return the start state; an unset `spin.lz` is that of the cusp.  Raises like `State`."""
    theta, l3, lz = values['initial.theta'], values['spin.l3'], values['spin.lz']
    if lz is None:      # "Analysis of Symmetric Spinning Top" (2023), sect. 4.1 and eq. (33)
        lz = l3 * math.cos(theta)
    return State(theta=theta, theta_dot=values['initial.theta_dot'], phi=values['initial.phi'],
                 psi=values['initial.psi'], l3=l3, lz=lz)
