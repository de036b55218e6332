# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories of scenes, for programs in any language that check a simulator."""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spinning_top_sim.installation import version
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.streams.stream import period_ns
from spinning_top_sim.tools.models import FORMATS, model, start_of
from spinning_top_sim.tools.table import UNITS, Table, write_csv, write_parquet

ADDED = {f'{name}_{axis}': unit for name, unit in (
    ('gyroscope', 'rad/s'), ('accelerometer', 'm/s^2'), ('pivot_acceleration', 'm/s^2'))
    for axis in 'xyz'}
COLUMNS = {**UNITS, **ADDED}
# The IMU where a scene has one at the pivot: off the axis and turned, so that its readings show
# every term of a simulator's formulas.
PLACE = {'imu.lever_arm': (0.03, -0.02, 0.05), 'imu.rpy': (0.3, -0.2, 1.1)}
SUFFIXES = {'mjcf': 'mjcf.xml', 'urdf': 'urdf', 'sdf': 'sdf'}

SCHEMA = """# Reference trajectories of the heavy symmetric top

Written by spinning_top_sim {version}.
Licence: CC0 1.0, https://creativecommons.org/publicdomain/zero/1.0/

Each scene has `NAME.csv` and `NAME.parquet` with the same numbers, and models `NAME.mjcf.xml`,
`NAME.urdf` and `NAME.sdf`. `scenes.json` has the top, the start and the IMU of each, in SI units:
`lambda1` (moment of inertia across the axis, about the pivot), `lambda3` (along the axis), `mass`,
`com_distance` (from the pivot along +z of the body), `gravity` (downwards), and the IMU's
`lever_arm` in the body and its `rpy`, roll, pitch and yaw about fixed axes.

A row is one time; there are {rate:g} a second, for {duration:g} s. The numbers are doubles. In CSV
each has the shortest decimals, 17 at most, that are read back as the same double. The motion is
the exact solution, evaluated in doubles.

The world has z up and its origin at the pivot. The body has its origin there too, and z along the
symmetry axis. R(world <- body) = Rz(phi) Ry(theta) Rz(psi).

| column | unit | meaning |
|---|---|---|
{columns}
Where the pivot moves (`pivot_moves` in scenes.json), theta is in [0, pi], and phi and psi are
within two turns; energy and lz are those in the frame of the pivot about the effective vertical
there, constant as long as the acceleration of the pivot is.
"""
MEANINGS = (
    (('t',), 'time since the start'),
    (('theta', 'phi', 'psi'), 'tilt from the upward vertical, precession and spin angle, '
     'unwrapped and continued through the poles'),
    (('theta_dot', 'phi_dot', 'psi_dot'), 'their rates'),
    (('qx', 'qy', 'qz', 'qw'), 'attitude q(world <- body), its sign continuous'),
    (('omega_1', 'omega_2', 'omega_3'), 'angular velocity in the body'),
    (('energy',), 'kinetic energy + M g R cos(theta)'),
    (('l3', 'lz'), 'angular momentum along the axis and along the upward vertical'),
    (tuple(f'gyroscope_{axis}' for axis in 'xyz'), 'angular velocity in the frame of the IMU'),
    (tuple(f'accelerometer_{axis}' for axis in 'xyz'),
     'acceleration minus gravity at the IMU, in its frame: +g upwards at rest'),
    (tuple(f'pivot_acceleration_{axis}' for axis in 'xyz'),
     'acceleration of the pivot in the world, of the piece that ends where two meet'))


def with_imu(given: Mapping[str, object]) -> dict[str, Any]:
    """Return the checked parameters of a scene for a reference: exact, with the IMU of PLACE."""
    return parameters.checked({**PLACE, **given, 'solver.method': 'exact'})


def write(folder: Path, scenes: Mapping[str, Mapping[str, Any]], duration: float,
          rate: float) -> None:
    """
    Write trajectories, models, scenes.json and README.md into a new folder.

    scenes : checked parameters by name
    duration, rate : of the trajectories [s], [Hz]

    Raises FileExistsError if the folder exists, ValueError for what no model or motion has, and
    ImportError without pyarrow or xacro.
    """
    folder.mkdir(parents=True)
    facts = {}
    for name, values in scenes.items():
        imu = Imu(values)
        table = Table(period_ns(rate), COLUMNS, lambda samples, imu=imu: (  # type: ignore[misc]
            *itertools.chain(*imu.true(samples.states)), *samples.pivot.acceleration))
        rows = [rows for block in Simulation(values).play([table], round(duration * NANOSECONDS))
                for _, _, rows in block.parts]
        write_parquet(folder / f'{name}.parquet', rows, COLUMNS)
        write_csv(folder / f'{name}.csv', rows, COLUMNS)
        for file_format in FORMATS:
            (folder / f'{name}.{SUFFIXES[file_format]}').write_text(
                model(values, file_format, name), encoding='utf-8')
        facts[name] = _facts(values)
    (folder / 'scenes.json').write_text(json.dumps(facts, indent=2) + '\n', encoding='utf-8')
    lines = (f'| {", ".join(f"`{name}`" for name in names)} | {COLUMNS[names[0]]} | {text} |\n'
             for names, text in MEANINGS)
    (folder / 'README.md').write_text(SCHEMA.format(
        version=version(), rate=rate, duration=duration, columns=''.join(lines)), encoding='utf-8')


def _facts(values: Mapping[str, Any]) -> dict[str, Any]:
    start, (quaternion, rates, _) = parameters.start_state(values), start_of(values)
    return {'top': vars(parameters.top_of(values)), 'start': {
        **vars(start), 'quaternion_xyzw': quaternion, 'angular_velocity_body': rates},
        'imu': {'lever_arm': values['imu.lever_arm'], 'rpy': values['imu.rpy']},
        'pivot_moves': parameters.pivot_path(values) is not None}
