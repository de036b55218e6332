# SPDX-License-Identifier: Apache-2.0
"""
Write the top of a scene as a model for physics engines (MJCF, URDF, SDF).

exit codes:
  0    done
  1    the file cannot be written
  2    wrong arguments or parameters, or a top that no model has
"""

# MJCF (mujoco.readthedocs.io, "XML Reference"), URDF (wiki.ros.org/urdf/XML) and SDF 1.9
# (sdformat.org/spec).  All have the body frame at the pivot with z along the symmetry axis, the
# inertia about the centre of mass, and the IMU.

import argparse
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed, share
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import States
from spinning_top_sim.shape import Shape
from spinning_top_sim.solvers.solve import solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.times import NANOSECONDS, NEVER_NS
from spinning_top_sim.tools import cli, scene_file
from spinning_top_sim.tools import urdf as robot

MJCF_STEP = 0.002       # [s], the default of MuJoCo
# Pieces of the path of a pivot that are listed.
MOST_PIECES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('--model', choices=FORMATS, required=True, help='format of the model')
    scene_file.add_parameters(parser)
    parser.add_argument('-o', '--output', metavar='FILE', type=Path, required=True,
                        help='file to write; an existing one is never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    names = [Path(one).stem for one in (arguments.scene, *arguments.params) if one]
    text = model(parameters.checked(scene_file.given(arguments)), arguments.model,
                 names[0] if names else 'spinning_top')
    cli.check_output(arguments.output)
    with new_file(arguments.output) as file:
        file.write(text)
    return cli.OK


def model(values: Mapping[str, Any], file_format: str, name: str) -> str:
    """
    Return the model of a top.

    values : checked parameters
    file_format : one of FORMATS
    name : of the model

    Raises ValueError if no rigid body has the inertia, or, of URDF, if the frames form no tree.
    """
    if fault := robot.inertia_fault(values):
        raise ValueError(fault)
    return FORMATS[file_format](values, re.sub(r'[^\w.]+', '_', name))


def start_of(values: Mapping[str, Any]) -> States:
    """Return the state at the start, as columns of one."""
    # 'rk45' returns the start as it is, the exact motion rounds it.
    return solve(parameters.top_of(values), parameters.start_state(values), [0.0], method='rk45')


def _mjcf(values: Mapping[str, Any], name: str) -> str:
    top = parameters.top_of(values)
    start = start_of(values)
    x, y, z, w = start.quaternion[0]
    shape, imu = Shape(top), values['imu.frame_id']
    root = ElementTree.Element('mujoco', model=name)
    _add(root, 'compiler', angle='radian', eulerseq='XYZ', balanceinertia='false')
    _add(root, 'option', gravity=_text(0.0, 0.0, -top.gravity), integrator='RK4',
         timestep=_text(MJCF_STEP))
    body = _add(_add(root, 'worldbody'), 'body', name=values['body_frame'])
    _add(body, 'joint', name='pivot', type='ball')
    across = top.lambda1_at_com
    _add(body, 'inertial', pos=_text(0.0, 0.0, top.com_distance), mass=_text(top.mass),
         diaginertia=_text(across, across, top.lambda3))
    # Shapes for the eye: their mass does not count beside <inertial>.
    looks = {'contype': '0', 'conaffinity': '0'}
    _add(body, 'geom', name='body', type='cylinder', pos=_text(0.0, 0.0, shape.centre),
         size=_text(shape.radius, 0.5 * shape.height), rgba='0.2 0.4 0.7 1', **looks)
    _add(body, 'geom', name='axis', type='capsule', size=_text(0.01 * abs(shape.tip)),
         fromto=_text(0.0, 0.0, 0.0, 0.0, 0.0, shape.tip), rgba='0.95 0.75 0.2 1', **looks)
    _add(body, 'site', name=imu, pos=_text(*values['imu.lever_arm']),
         euler=_text(*values['imu.rpy']))
    sensors = _add(root, 'sensor')
    _add(sensors, 'gyro', name='gyroscope', site=imu)
    _add(sensors, 'accelerometer', name='accelerometer', site=imu)
    _add(_add(root, 'keyframe'), 'key', name='start', qpos=_text(w, x, y, z),
         qvel=_text(*start.angular_velocity[0]))
    return _document(root, [
        'Reset to the keyframe start: mj_resetDataKeyframe(model, data, 0).',
        'RK4 is of fourth order; the default, Euler, adds energy to a fast spin.',
        *_facts(values)])


def _urdf(values: Mapping[str, Any], name: str) -> str:
    with needed('a URDF file', 'xacro'):
        text = robot.robot_description(values, share() / 'urdf')
    root = ElementTree.fromstring(text)
    root.set('name', name)
    start, states = parameters.start_state(values), start_of(values)
    return _document(root, [
        'URDF has no ball joint: the three joints are the ZYZ Euler angles.',
        'They are singular where the axis is vertical, and two of their links have no inertia.',
        f'An engine that needs one, or a motion through a vertical, takes {values["body_frame"]}',
        'and what is below it on a ball joint at its origin, the pivot.',
        f'Gravity: {_text(0.0, 0.0, -values["top.gravity"])} m/s^2 in the world, z up.',
        f'Start: joint positions {_text(start.phi, start.theta, start.psi)} rad,',
        f'joint velocities {_text(*states.phi_dot, *states.theta_dot, *states.psi_dot)} rad/s.',
        *_facts(values)])


def _sdf(values: Mapping[str, Any], name: str) -> str:
    top = parameters.top_of(values)
    root = ElementTree.Element('sdf', version='1.9')
    world = _add(root, 'world', name=f'{name}_world')
    _add(world, 'gravity', _text(0.0, 0.0, -top.gravity))
    body_model = _add(world, 'model', name=name)
    _add(body_model, 'pose', _text(0.0, 0.0, 0.0, *start_of(values).quaternion[0]),
         rotation_format='quat_xyzw')
    link = _add(body_model, 'link', name=values['body_frame'])
    inertial = _add(link, 'inertial')
    centre = _text(0.0, 0.0, top.com_distance, 0.0, 0.0, 0.0)
    _add(inertial, 'pose', centre)
    _add(inertial, 'mass', _text(top.mass))
    inertia, across = _add(inertial, 'inertia'), top.lambda1_at_com
    for entry, moment in (('ixx', across), ('ixy', 0.0), ('ixz', 0.0), ('iyy', across),
                          ('iyz', 0.0), ('izz', top.lambda3)):
        _add(inertia, entry, _text(moment))
    visual, shape = _add(link, 'visual', name='body'), Shape(top)
    _add(visual, 'pose', centre)
    cylinder = _add(_add(visual, 'geometry'), 'cylinder')
    _add(cylinder, 'radius', _text(shape.radius))
    _add(cylinder, 'length', _text(shape.height))
    sensor = _add(link, 'sensor', name=values['imu.frame_id'], type='imu')
    _add(sensor, 'pose', _text(*values['imu.lever_arm'], *values['imu.rpy']))
    _add(sensor, 'update_rate', _text(values['imu.rate']))
    _add(sensor, 'always_on', 'true')
    joint = _add(body_model, 'joint', name='pivot', type='ball')
    _add(joint, 'parent', 'world')
    _add(joint, 'child', values['body_frame'])
    return _document(root, [
        'The pose is that of the start. Engines take no rates from SDF: set those below.',
        'Gazebo reads the IMU with its system gz::sim::systems::Imu.', *_facts(values)])


FORMATS: dict[str, Callable[[Mapping[str, Any], str], str]] = {
    'mjcf': _mjcf, 'urdf': _urdf, 'sdf': _sdf}


def _facts(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what each file says about its start and its pivot."""
    start = start_of(values)
    world = attitude.rotated(start.rows_quaternion, tuple(start.angular_velocity[0]))
    yield f'Attitude at the start, q(world <- body) as x y z w: {_text(*start.quaternion[0])}'
    yield f'Angular velocity at the start in the body: {_text(*start.angular_velocity[0])} rad/s,'
    yield f'in the world: {_text(*np.concatenate(world))} rad/s'
    path = parameters.pivot_path(values)
    if path is None:
        return
    yield 'The pivot of this scene moves. Here it rests: this is the frame of the pivot, in which'
    yield 'the attitude is the same, and gravity at a time from the start is:'
    t_ns, gravity = 0, values['top.gravity']
    for _ in range(MOST_PIECES):
        piece = path.piece(t_ns)
        x, y, z = map(float, piece.acceleration)
        yield f'from {t_ns / NANOSECONDS!r} s: {_text(0.0 - x, 0.0 - y, -gravity - z)} m/s^2'
        if piece.end_ns == NEVER_NS:
            return
        t_ns = piece.end_ns
    yield 'and so on.'


def _add(parent: ElementTree.Element, tag: str, text: str = '',
         **attributes: str) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, tag, attributes)
    child.text = text or None
    return child


def _text(*numbers: float) -> str:
    """Return numbers with all the digits that their doubles have."""
    return ' '.join(repr(float(number)) for number in numbers)


def _document(root: ElementTree.Element, comment: list[str]) -> str:
    ElementTree.indent(root)
    lines = '\n     '.join(comment)
    return (f'<?xml version="1.0"?>\n<!-- {lines} -->\n'
            f'{ElementTree.tostring(root, encoding="unicode")}\n')


main = partial(cli.run, 'export', __doc__, add_arguments, _run)
