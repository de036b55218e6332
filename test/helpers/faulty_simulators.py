# SPDX-License-Identifier: Apache-2.0
"""Simulators of a top with an IMU: right ones, and ones with a defect, most of them published."""

import math
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spinning_top_sim import solve


def exact(top, start, times, dt, **options):
    """Return attitudes x y z w, body rates and angular accelerations of the exact motion."""
    motion = solve(top, start, times, **options)
    return motion.quaternion, motion.angular_velocity, motion.angular_acceleration


def euler(top, start, times, dt, *, inertia=None, com=None, gyroscopic=1.0, world=False,
          damping=0.0, turn=1.0):
    """Return the same by Euler's equations, of which something may differ from the top's."""
    inertia = np.array(top.inertia if inertia is None else inertia)
    com = np.array(top.com if com is None else com)

    def accelerations(q, w):
        """Return those of states (4, n), (3, n)."""
        rotation, rates = Rotation.from_quat(q.T), w.T
        term = np.cross(rates, rates * inertia)
        if world:
            rates = rotation.apply(rates)
            term = inertia * rotation.inv().apply(np.cross(rates, rates * inertia) / inertia)
        up = rotation.inv().apply((0.0, 0.0, 1.0))
        torque = -top.mass * top.gravity * np.cross(com, up) - gyroscopic * term
        return (torque / inertia - damping * w.T).T

    def slope(t, y):
        q, w = y[:4], y[4:]
        x, y, z = 0.5 * turn * w
        return np.concatenate((
            [q[3] * x + q[1] * z - q[2] * y, q[3] * y + q[2] * x - q[0] * z,
             q[3] * z + q[0] * y - q[1] * x, -q[0] * x - q[1] * y - q[2] * z],
            accelerations(q[:, np.newaxis], w[:, np.newaxis])[:, 0]))

    y = solve_ivp(slope, (0.0, times[-1]), [*start.attitude, *start.rates], 'DOP853', times,
                  rtol=1e-10, atol=1e-12).y
    return y[:4].T, y[4:].T, accelerations(y[:4], y[4:]).T


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
    return complex(2.0 * (b * d - a * c), 2.0 * (c * d + a * b))


def stepped(top, start, times, dt, method):
    """
    Return the same by steps of first order.

    method : of the gyroscopic term: explicit, implicit, midpoint, or wrong derivative, where an
        implicit step has its derivative with the wrong sign
    """
    (x, y, z, w), (w1, w2, spin) = start.attitude, start.rates
    q, across, rows = (w, x, y, z), complex(w1, w2), []
    share = (top.lambda1 - top.lambda3) / top.lambda1 * spin
    at = {'explicit': 0.0, 'midpoint': 0.5, 'implicit': 1.0, 'wrong derivative': -1.0}[method]
    stride = round((times[1] - times[0]) / dt)
    for number in range((len(times) - 1) * stride + 1):
        if number % stride == 0:
            rows.append((*q, across.real, across.imag, spin))
        change = -1j * (share * across + top.gravity_torque / top.lambda1 * _up(q))
        across += dt * change / (1.0 + at * 1j * dt * share)
        q = _turned(q, (across.real, across.imag, spin), dt)
    states = np.array(rows)
    return states[:, [1, 2, 3, 0]], states[:, 4:], np.gradient(states[:, 4:], times, axis=0,
                                                              edge_order=2)


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
    'uniform': ('uniform_noise',)}
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
NOISY = ('density_as_deviation', 'uniform', 'times_root_two')
MOVED = {
    # avianphysics/avian#420: the term of the begin of a step adds energy.
    'explicit': (partial(stepped, method='explicit'), ('first_order', 'explicit_gyroscopic_term')),
    # bulletphysics/bullet3#346: that of its end damps.
    'implicit': (partial(stepped, method='implicit'), ('first_order', 'implicit_damping')),
    # google-deepmind/mujoco_warp#1662: the derivative has the wrong sign.
    'wrong derivative': (partial(stepped, method='wrong derivative'),
                         ('first_order', 'coriolis_sign')),
    'midpoint': (partial(stepped, method='midpoint'), ('first_order',)),
    # godotengine/godot#80703, NVIDIAGameWorks/PhysX#394, jrouwe/JoltPhysics#803, google/brax#48.
    'no gyroscopic term': (partial(euler, gyroscopic=0.0), ('no_gyroscopic_term',)),
    # gszauer/GamePhysicsCookbook#14: the inertia of the body in axes of the world.
    'world inertia': (partial(euler, world=True), ('inertia_frame',)),
    # google/brax#62: the attitude turns twice as fast.
    'turns twice': (partial(euler, turn=2.0), ('rates_scale',)),
    # dimforge/parry#334: Steiner's term is wrong.
    'inertia at com': (lambda top, *given: euler(top, *given, inertia=top.inertia_at_com),
                       ('inertia',)),
    'gyroscopic sign': (partial(euler, gyroscopic=-1.0), ('coriolis_sign',)),
    'upwards': (lambda top, *given: euler(top, *given, com=(0.0, 0.0, -top.com_distance)),
                ('gravity_sign',)),
    'damped': (partial(euler, damping=0.05), ('damping',)),
    'offset': (lambda top, *given: euler(top, *given, com=np.add(top.com, (
        0.003, -0.002, 0.004))), ('com_offset',))}
RIGHT = {'exact': exact, 'rk45': partial(exact, method='rk45'), 'euler': euler}
