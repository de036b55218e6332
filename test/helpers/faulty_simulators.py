# SPDX-License-Identifier: Apache-2.0
"""Simulators of a top with an IMU: right ones, and ones with a defect, most of them published."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim import solve
from spinning_top_sim.physics import attitude


def exact(top, start, times, dt, **options):
    """Return attitudes x y z w, body rates and angular accelerations of the exact motion."""
    motion = solve(top, start, times, **options)
    return motion.quaternion, motion.angular_velocity, motion.angular_acceleration


rk45 = partial(exact, method='rk45')


def right_torque(top, spin, across, up, height):
    """
    Return the derivatives of the rates across the axis, w1 + i w2, and about it.

    up : z1 + i z2 of the vertical in the body, height : z3
    """
    gyroscopic = (top.lambda1 - top.lambda3) / top.lambda1 * spin
    return -1j * (gyroscopic * across + top.gravity_torque / top.lambda1 * up), 0.0


def without_gyroscopic_term(top, spin, across, up, height):
    return -1j * top.gravity_torque / top.lambda1 * up, 0.0


def gyroscopic_sign(top, spin, across, up, height):
    right, _ = right_torque(top, spin, across, up, height)
    return 2.0 * without_gyroscopic_term(top, spin, across, up, height)[0] - right, 0.0


def upwards(top, spin, across, up, height):
    return right_torque(top, spin, across, -up, -height)


def damped(top, spin, across, up, height):
    right, _ = right_torque(top, spin, across, up, height)
    return right - 0.05 * across, -0.05 * spin


def inertia_at_com(top, spin, across, up, height):
    first = top.lambda1_at_com
    return -1j * ((first - top.lambda3) / first * spin * across
                  + top.gravity_torque / first * up), 0.0


def offset_com(offset):
    def torque(top, spin, across, up, height):
        right, _ = right_torque(top, spin, across, up, height)
        weight, (x, y, z), (u, v) = top.mass * top.gravity, offset, (up.real, up.imag)
        more = complex(y * height - z * v, z * u - x * height)
        return (right - weight / top.lambda1 * more, -weight / top.lambda3 * (x * v - y * u))
    return torque


def _turned(q, w, dt):
    """Return the attitude w, x, y, z after a rotation by w dt in the body frame."""
    a, b, c, d = q
    x, y, z = w
    half = 0.5 * dt * math.sqrt(x * x + y * y + z * z)
    s = 0.5 * dt * (math.sin(half) / half if half else 1.0)
    x, y, z, e = s * x, s * y, s * z, math.cos(half)
    return (a * e - b * x - c * y - d * z, a * x + b * e + c * z - d * y,
            a * y - b * z + c * e + d * x, a * z + b * y - c * x + d * e)


def _up(q):
    a, b, c, d = q
    return complex(2.0 * (b * d - a * c), 2.0 * (c * d + a * b)), a * a + d * d - b * b - c * c


def _euler_step(top, torque, q, across, spin, dt, method, turn):
    """Return the state after a first-order step."""
    change, spin_change = torque(top, spin, across, *_up(q))
    gyroscopic = 1j * dt * (top.lambda1 - top.lambda3) / top.lambda1 * spin
    if method == 'implicit':
        change /= 1.0 + gyroscopic
    elif method == 'wrong derivative':
        change /= 1.0 - gyroscopic
    elif method == 'midpoint':
        change /= 1.0 + 0.5 * gyroscopic
    elif method == 'world inertia':
        change = _world_inertia(top, q, across, spin)
    before = across
    across, spin = across + dt * change, spin + dt * spin_change
    used = before if method == 'forward' else across
    return _turned(q, (used.real, used.imag, spin), turn * dt), across, spin


def _world_inertia(top, q, across, spin):
    w, x, y, z = q
    quaternion, rates = ([x], [y], [z], [w]), ([across.real], [across.imag], [spin])
    a, b, c = attitude.rotated([np.array(one) for one in quaternion],
                                [np.array(one) for one in rates])
    share = (top.lambda1 - top.lambda3) / top.lambda1
    change = attitude.rotated_back([np.array(one) for one in quaternion],
                              (share * b * c, -share * a * c, 0.0 * a))
    gravity = -1j * top.gravity_torque / top.lambda1 * _up(q)[0]
    return complex(change[0][0], change[1][0]) + gravity


def _rk4_step(top, torque, q, across, spin, dt, turn):
    def slope(q, across, spin):
        a, b, c, d = q
        x, y, z = turn * across.real, turn * across.imag, turn * spin
        return ((-0.5 * (b * x + c * y + d * z), 0.5 * (a * x + c * z - d * y),
                 0.5 * (a * y - b * z + d * x), 0.5 * (a * z + b * y - c * x)),
                *torque(top, spin, across, *_up(q)))

    def after(slope, dt):
        dq, da, ds = slope
        return tuple(x + dt * y for x, y in zip(q, dq, strict=True)), across + dt * da, \
            spin + dt * ds

    k1 = slope(q, across, spin)
    k2 = slope(*after(k1, 0.5 * dt))
    k3 = slope(*after(k2, 0.5 * dt))
    k4 = slope(*after(k3, dt))
    q = [x + dt / 6.0 * (a + 2.0 * (b + c) + d)
         for x, a, b, c, d in zip(q, k1[0], k2[0], k3[0], k4[0], strict=True)]
    norm = math.sqrt(sum(x * x for x in q))
    across, spin = (x + dt / 6.0 * (k1[k] + 2.0 * (k2[k] + k3[k]) + k4[k])
                    for k, x in ((1, across), (2, spin)))
    return tuple(x / norm for x in q), across, spin


@dataclass
class Stepped:
    """
    A simulator that takes steps.

    method : rk4, or of first order: semi-implicit, forward, implicit, midpoint,
        wrong derivative, world inertia
    turn : factor of the rates with which the attitude turns
    """

    torque: object = right_torque
    method: str = 'rk4'
    turn: float = 1.0

    def __call__(self, top, start, times, dt):
        (x, y, z, w), (w1, w2, spin) = start.attitude, start.rates
        q = w, x, y, z
        across, stride = complex(w1, w2), round((times[1] - times[0]) / dt)
        rows = []
        for number in range((len(times) - 1) * stride + 1):
            if number % stride == 0:
                rows.append((*q, across.real, across.imag, spin))
            if self.method == 'rk4':
                q, across, spin = _rk4_step(top, self.torque, q, across, spin, dt, self.turn)
            else:
                q, across, spin = _euler_step(top, self.torque, q, across, spin, dt, self.method,
                                              self.turn)
        states = np.array(rows)
        attitudes, w = states[:, [1, 2, 3, 0]], states[:, 4:]
        return attitudes, w, np.gradient(w, times, axis=0, edge_order=2)


class Imu:
    """
    A simulator of a motion and of an IMU on it, with a defect.

    motion : function of (top, start, times, dt) that returns attitudes, rates and accelerations
    defect : a method below, which changes the readings
    seed : of the noise
    parts : of what is returned, beside the attitudes
    """

    def __init__(self, motion=exact, defect='none', seed=0,
                 parts=('rates', 'accelerations', 'gyroscope', 'magnetometer')):
        self._motion, self._defect = motion, getattr(self, defect)
        self._random, self._parts = np.random.default_rng(seed), parts
        self.__name__ = defect

    def __call__(self, top, start, times, dt):
        q, w, a = self._motion(top, start, times, dt)
        self.top, self.h = top, times[1] - times[0]
        self.rotation, self.w, self.a = Rotation.from_quat(q), w, a
        self.mounting = Rotation.from_quat(top.mounting)
        self.arm = np.array(top.lever_arm)
        self.up = self.rotation.inv().apply((0.0, 0.0, 1.0))
        said = {'attitudes': q, 'rates': w,
                'accelerations': self.mounting.inv().apply(self.force()),
                'gyroscope': self.mounting.inv().apply(w),
                'magnetometer': self.mounting.inv().apply(self.rotation.inv().apply(top.field))}
        for name, density in (('gyroscope', top.gyroscope_noise_density),
                              ('accelerations', top.accelerometer_noise_density)):
            self.density = density or 0.0
            self.sigma = self.density / math.sqrt(self.h)
            said[name] = said[name] + self.sigma * self._random.standard_normal(w.shape)
        self._defect(said)
        return {name: value for name, value in said.items()
                if name in ('attitudes', 'covariance', *self._parts)}

    def force(self, tangential=1.0, centripetal=1.0, gravity=1.0, arm=None):
        """Return the specific force in the body frame."""
        arm = self.arm if arm is None else arm
        return (gravity * self.top.gravity * self.up + tangential * np.cross(self.a, arm)
                + centripetal * np.cross(self.w, np.cross(self.w, arm)))

    def _set_force(self, said, force):
        """Replace the right force in a reading, whose noise stays."""
        said['accelerations'] += self.mounting.inv().apply(force - self.force())

    def none(self, said):
        pass

    def no_transport_term(self, said):
        """isaac-sim/IsaacSim#735: velocities differentiated in axes of the body, without w x v."""
        self._set_force(said, self.force(centripetal=0.0))

    def without_tangential_term(self, said):
        self._set_force(said, self.force(tangential=0.0))

    def velocity_of_com(self, said):
        """isaac-sim/IsaacSim#825: the velocity of the centre of mass, not of the sensor."""
        self._set_force(said, self.force(arm=np.array(self.top.com)))

    def force_at_pivot(self, said):
        """Field-Robotics-Japan/UnitySensors#162: accelerations of the origin."""
        self._set_force(said, self.force(arm=np.zeros(3)))

    def wrong_dt(self, said):
        """isaac-sim/IsaacLab#7163, o3de/o3de-extras#484: differences over 4 steps, over one dt."""
        self._set_force(said, 4.0 * self._differences() + self.force(0.0, 0.0))

    def differences(self, said):
        """gazebosim/gazebo-classic#893: the difference of the last two velocities."""
        self._set_force(said, self._differences() + self.force(0.0, 0.0))

    def _differences(self):
        v = self.rotation.apply(np.cross(self.w, self.arm))
        a = np.diff(v, axis=0, prepend=v[:1]) / self.h
        return self.rotation.inv().apply(a)

    def gravity_added(self, said):
        """Field-Robotics-Japan/UnitySensors#116: gravity is added, not subtracted."""
        self._set_force(said, self.force(gravity=-1.0))

    def gravity_fixed(self, said):
        """carla-simulator/carla#2795: gravity is added after the rotation into the sensor."""
        self._set_force(said, self.force(gravity=0.0))
        said['accelerations'][:, 2] += self.top.gravity

    def without_gravity(self, said):
        self._set_force(said, self.force(gravity=0.0))

    def in_g(self, said):
        said['accelerations'] /= 9.80665

    def gyroscope_in_world(self, said):
        """carla-simulator/carla#2939: the gyroscope reads in axes of the world."""
        said['gyroscope'] += self.rotation.apply(self.w) - self.mounting.inv().apply(self.w)

    def in_degrees(self, said):
        said['gyroscope'] = np.degrees(said['gyroscope'])

    def mounting_ignored(self, said):
        """opensim-org/opensim-core#3366: rates do not turn with the frame of the IMU."""
        said['gyroscope'] += self.w - self.mounting.inv().apply(self.w)

    def late(self, said, steps=1):
        """google-deepmind/mujoco#430: readings are those of the step before."""
        for name in ('accelerations', 'gyroscope', 'magnetometer'):
            said[name] = np.concatenate((said[name][:1].repeat(steps, axis=0),
                                         said[name][:-steps]))

    def late_by_seven(self, said):
        self.late(said, 7)

    def gyroscope_sign(self, said):
        said['gyroscope'] = -said['gyroscope']

    def field_reversed(self, said):
        """gazebosim/gz-sim#2536: the field turns against the rotation of the sensor."""
        turn = self.rotation * self.mounting
        said['magnetometer'] = turn.apply(self.top.field)

    def field_in_world(self, said):
        said['magnetometer'][:] = self.top.field

    def gyroscope_twice(self, said):
        said['gyroscope'] *= 2.0

    def residuals(self, said):
        """microsoft/AirSim#4661: noise that is declared as none."""
        said['accelerations'] += 0.02 * self._random.standard_normal(self.w.shape)

    def _set_noise(self, said, name, noise):
        right = self.force() if name == 'accelerations' else self.w
        said[name] = self.mounting.inv().apply(right) + noise

    def density_as_deviation(self, said):
        """gazebosim/gazebo-classic#2670: the density is taken for the standard deviation."""
        self._set_noise(said, 'accelerations', self.top.accelerometer_noise_density
                        * self._random.standard_normal(self.w.shape))

    def times_root_two(self, said):
        self._set_noise(said, 'gyroscope', math.sqrt(2.0 / self.h)
                        * self.top.gyroscope_noise_density
                        * self._random.standard_normal(self.w.shape))

    def uniform(self, said):
        """jdelacroix/simiam#3: uniform instead of normal noise."""
        self._set_noise(said, 'accelerations', self.sigma * math.sqrt(3.0)
                        * self._random.uniform(-1.0, 1.0, self.w.shape))

    def covariance_unknown(self, said):
        """ros-simulation/gazebo_ros_pkgs#1240: covariances of zeros beside noise."""
        said['covariance'] = np.zeros((3, 3))

    def covariance_right(self, said):
        said['covariance'] = {
            name: density ** 2 / self.h * np.eye(3) for name, density in (
                ('gyroscope', self.top.gyroscope_noise_density),
                ('accelerations', self.top.accelerometer_noise_density))}


# What is wrong with each simulator, and the faults that name it.  These are published:
PUBLISHED = {
    'no_transport_term': ('no_centripetal_term',),
    'velocity_of_com': ('no_lever_arm',),
    'force_at_pivot': ('no_lever_arm',),
    'wrong_dt': ('acceleration_scale',),
    'differences': ('finite_differences',),
    'gravity_added': ('gravity_sign',),
    'gravity_fixed': ('gravity_frame',),
    'gyroscope_in_world': ('rates_in_world',),
    'mounting_ignored': ('mounting',),
    'late': ('late',),
    'field_reversed': ('rotation_reversed',),
    'residuals': ('noise_scale',),
    'density_as_deviation': ('noise_scale',),
    'uniform': ('uniform_noise',),
    'covariance_unknown': ('covariance_zero',)}
OTHER = {
    'without_tangential_term': ('no_tangential_term',),
    'without_gravity': ('no_gravity',),
    'in_g': ('units',),
    'in_degrees': ('units',),
    'late_by_seven': ('late',),
    'gyroscope_sign': ('reading_sign',),
    'field_in_world': ('reading_in_world',),
    'gyroscope_twice': ('reading_scale',),
    'times_root_two': ('noise_scale',)}
NOISY = ('density_as_deviation', 'uniform', 'covariance_unknown', 'times_root_two')
STEPPED = {
    # avianphysics/avian#420: the term of the begin of a step adds energy.
    'semi-implicit': (Stepped(method='semi-implicit'),
                      ('first_order', 'explicit_gyroscopic_term')),
    # bulletphysics/bullet3#346: that of its end damps.
    'implicit': (Stepped(method='implicit'), ('first_order', 'implicit_damping')),
    # google-deepmind/mujoco_warp#1662: the derivative has the wrong sign.
    'wrong derivative': (Stepped(method='wrong derivative'), ('first_order', 'coriolis_sign')),
    # godotengine/godot#80703, NVIDIAGameWorks/PhysX#394, jrouwe/JoltPhysics#803, google/brax#48.
    'no gyroscopic term': (Stepped(without_gyroscopic_term, 'semi-implicit'),
                           ('no_gyroscopic_term',)),
    # gszauer/GamePhysicsCookbook#14: the inertia of the body in axes of the world.
    'world inertia': (Stepped(method='world inertia'), ('inertia_frame',)),
    # google/brax#62: the attitude turns twice as fast.
    'turns twice': (Stepped(turn=2.0), ('rates_scale',)),
    # dimforge/parry#334: Steiner's term is wrong.
    'inertia at com': (Stepped(inertia_at_com), ('inertia',)),
    'midpoint': (Stepped(method='midpoint'), ('first_order',)),
    'gyroscopic sign': (Stepped(gyroscopic_sign), ('coriolis_sign',)),
    'upwards': (Stepped(upwards), ('gravity_sign',)),
    'damped': (Stepped(damped), ('damping',)),
    'offset': (Stepped(offset_com((0.003, -0.002, 0.004))), ('com_offset',))}
RIGHT = {'exact': exact, 'rk45': rk45, 'RK4': Stepped()}
