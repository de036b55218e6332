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


def cross(one, other):
    (a, b, c), (x, y, z) = one, other       # np.cross takes long for one
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))


def euler(top, start, times, dt, *, inertia=None, com=None, gyroscopic=1.0, world=False,
          damping=0.0, turn=1.0):
    """Return the same by Euler's equations, of which something may differ from the top's."""
    inertia = np.array(top.inertia if inertia is None else inertia)
    com = np.array(top.com if com is None else com)

    def accelerations(q, w):
        """Return those of states (4, n), (3, n), or of one."""
        x, y, z, s = q
        up = 2.0 * np.array((x * z - s * y, y * z + s * x, 0.5 - x * x - y * y))
        term = cross(w, (w.T * inertia).T)
        if world:
            rotation = Rotation.from_quat(q.T)
            rates = rotation.apply(w.T)
            term = (rotation.inv().apply(np.cross(rates, rates * inertia) / inertia) * inertia).T
        torque = -top.mass * top.gravity * cross(com, up) - gyroscopic * term
        return (torque.T / inertia - damping * w.T).T

    def slope(t, y):
        q, w = y[:4], y[4:]
        x, y, z = 0.5 * turn * w
        return np.concatenate((
            [q[3] * x + q[1] * z - q[2] * y, q[3] * y + q[2] * x - q[0] * z,
             q[3] * z + q[0] * y - q[1] * x, -q[0] * x - q[1] * y - q[2] * z],
            accelerations(q, w)))

    y = solve_ivp(slope, (0.0, times[-1]), [*start.attitude, *start.rates], 'DOP853', times,
                  rtol=1e-10, atol=1e-12).y
    return y[:4].T, y[4:].T, accelerations(y[:4], y[4:]).T


def stepped(top, start, times, dt, method):
    """Return the same by steps of first order, with a method for the gyroscopic term."""
    turn, (w1, w2, spin) = Rotation.from_quat(start.attitude), start.rates
    across, rows = complex(w1, w2), []
    share = (top.lambda1 - top.lambda3) / top.lambda1 * spin
    at = {'explicit': 0.0, 'midpoint': 0.5, 'implicit': 1.0, 'wrong derivative': -1.0}[method]
    stride = round((times[1] - times[0]) / dt)
    for number in range((len(times) - 1) * stride + 1):
        if number % stride == 0:
            rows.append((*turn.as_quat(), across.real, across.imag, spin))
        up = complex(*turn.as_matrix()[2, :2])
        change = -1j * (share * across + top.gravity_torque / top.lambda1 * up)
        across += dt * change / (1.0 + at * 1j * dt * share)
        turn = turn * Rotation.from_rotvec(dt * np.array((across.real, across.imag, spin)))
    states = np.array(rows)
    return states[:, :4], states[:, 4:], np.gradient(states[:, 4:], times, axis=0, edge_order=2)


class Imu:
    """
    A simulator of a motion and of an IMU on it, with a defect.

    motion : function of (top, start, times, dt) that returns attitudes, rates and accelerations
    defect : a name in DEFECTS, or a function that returns readings along axes of the body
    parts : of what is returned, beside the attitudes
    """

    def __init__(self, motion=exact, defect=None, seed=0,
                 parts=('rates', 'accelerations', 'gyroscope', 'magnetometer')):
        self._motion, self._parts = motion, parts
        self._defect = DEFECTS[defect][1] if isinstance(defect, str) else defect
        self.random = np.random.default_rng(seed)

    def __call__(self, top, start, times, dt):
        self.q, self.w, self.a = self._motion(top, start, times, dt)
        self.top, self.h, self.arm = top, times[1] - times[0], np.array(top.lever_arm)
        self.rotation, self.mounting = Rotation.from_quat(self.q), Rotation.from_quat(top.mounting)
        self.sigma = {'gyroscope': (top.gyroscope_noise_density or 0.0) / math.sqrt(self.h),
                      'accelerations': (top.accelerometer_noise_density or 0.0)
                      / math.sqrt(self.h), 'magnetometer': 0.0}
        said = {'rates': self.w, 'gyroscope': self.w, 'accelerations': self.force(),
                'magnetometer': self.rotation.inv().apply(top.field), 'attitudes': self.q}
        said.update((self._defect and self._defect(self)) or {})
        for name, sigma in self.sigma.items():
            said[name] = self.mounting.inv().apply(
                said[name]) + sigma * self.random.standard_normal(self.w.shape)
        return {name: said[name] for name in ('attitudes', *self._parts)}

    def force(self, tangential=1.0, centripetal=1.0, gravity=1.0, arm=None):
        """Return the specific force along axes of the body."""
        arm = self.arm if arm is None else arm
        up = self.rotation.inv().apply((0.0, 0.0, 1.0))
        return (gravity * self.top.gravity * up + tangential * np.cross(self.a, arm)
                + centripetal * np.cross(self.w, np.cross(self.w, arm)))

    def differences(self, size):
        """Return the same by differences of the last two velocities, times a size."""
        v = self.rotation.apply(np.cross(self.w, self.arm))
        a = np.diff(v, axis=0, prepend=v[:1]) / self.h
        return {'accelerations': size * self.rotation.inv().apply(a) + self.force(0.0, 0.0)}


def late(b):
    return {name: np.concatenate((values[:1], values[:-1])) for name, values in (
        ('gyroscope', b.w), ('accelerations', b.force()),
        ('magnetometer', b.rotation.inv().apply(b.top.field)))}


# By name: the fault that tells a defect, and what readings are, or a change of `sigma`.
DEFECTS = {
    # isaac-sim/IsaacSim#735: velocities differentiated in axes of the body, without w x v.
    'no transport term': ('no_centripetal_term', lambda b: {
        'accelerations': b.force(centripetal=0.0)}),
    # Field-Robotics-Japan/UnitySensors#162: accelerations of the origin.
    'force at pivot': ('no_lever_arm', lambda b: {'accelerations': b.force(arm=np.zeros(3))}),
    # isaac-sim/IsaacSim#825: the velocity of the centre of mass, not of the sensor.
    'velocity of com': ('no_lever_arm', lambda b: {
        'accelerations': b.force(arm=np.array(b.top.com))}),
    # isaac-sim/IsaacLab#7163, o3de/o3de-extras#484: differences over 4 steps, over one dt.
    'wrong dt': ('acceleration_scale', lambda b: b.differences(4.0)),
    # gazebosim/gazebo-classic#893: the difference of the last two velocities.
    'differences': ('finite_differences', lambda b: b.differences(1.0)),
    # Field-Robotics-Japan/UnitySensors#116: gravity is added, not subtracted.
    'gravity added': ('gravity_sign', lambda b: {'accelerations': b.force(gravity=-1.0)}),
    # carla-simulator/carla#2795: gravity is added after the rotation into the sensor.
    'gravity fixed': ('gravity_frame', lambda b: {
        'accelerations': b.force(gravity=0.0) + b.mounting.apply((0.0, 0.0, b.top.gravity))}),
    # carla-simulator/carla#2939: the gyroscope reads in axes of the world.
    'gyroscope in world': ('rates_in_world', lambda b: {
        'gyroscope': b.mounting.apply(b.rotation.apply(b.w))}),
    # opensim-org/opensim-core#3366: rates do not turn with the frame of the IMU.
    'mounting ignored': ('mounting', lambda b: {'gyroscope': b.mounting.apply(b.w)}),
    # google-deepmind/mujoco#430: readings are those of the step before.
    'late': ('late', late),
    # gazebosim/gz-sim#2536: the field turns against the rotation of the sensor.
    'field reversed': ('rotation_reversed', lambda b: {
        'magnetometer': (b.mounting * b.rotation * b.mounting).apply(b.top.field)}),
    # microsoft/AirSim#4661: noise that is declared as none.
    'residuals': ('noise_scale', lambda b: b.sigma.update(
        accelerations=math.hypot(b.sigma['accelerations'], 0.02))),
    # gazebosim/gazebo-classic#2670: the density is taken for the standard deviation.
    'density as deviation': ('noise_scale', lambda b: b.sigma.update(
        accelerations=b.sigma['accelerations'] * math.sqrt(b.h))),
    'no tangential term': ('no_tangential_term', lambda b: {
        'accelerations': b.force(tangential=0.0)}),
    'field in world': ('reading_in_world', lambda b: {
        'magnetometer': b.mounting.apply(np.tile(b.top.field, (len(b.w), 1)))}),
    'gyroscope twice': ('reading_scale', lambda b: {'gyroscope': 2.0 * b.w})}
NOISY = 'density as deviation',
MOVED = {
    # avianphysics/avian#420: the term of the begin of a step adds energy.
    'explicit': (partial(stepped, method='explicit'), ('explicit_gyroscopic_term',)),
    # bulletphysics/bullet3#346: that of its end damps.
    'implicit': (partial(stepped, method='implicit'), ('implicit_damping',)),
    # google-deepmind/mujoco_warp#1662: the derivative has the wrong sign.
    'wrong derivative': (partial(stepped, method='wrong derivative'),
                         ('coriolis_sign',)),
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
