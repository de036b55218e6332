# SPDX-License-Identifier: Apache-2.0
"""Rigid bodies of any kind with an IMU: right readings, and readings with one fault each."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = 9.80665
SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class Moving:
    """A body with an IMU at `arm`: times, poses, rates, accelerations, exact."""

    t: np.ndarray
    rotation: Rotation
    p: np.ndarray
    w: np.ndarray
    alpha: np.ndarray
    a: np.ndarray                   # of the origin in the world
    arm: np.ndarray
    noise: dict = field(default_factory=dict)
    random: np.random.Generator = None

    def force(self, gravity=1.0, centripetal=1.0, arm=None):
        arm = self.arm if arm is None else arm
        return (self.rotation.inv().apply(self.a + gravity * np.array((0.0, 0.0, GRAVITY)))
                + np.cross(self.alpha, arm)
                + centripetal * np.cross(self.w, np.cross(self.w, arm)))

    def parts(self):
        """Return right parts, without noise."""
        return {'attitudes': self.rotation.as_quat(), 'positions': self.p.copy(),
                'gyroscope': self.w.copy(), 'accelerations': self.force()}


def forced(t, random, rate):
    """Return rotation, rates, angular acceleration of a body that is turned to and fro."""
    sizes = random.uniform(0.4, 1.2, (3, 2))
    speeds = random.uniform(0.3, 1.0, (3, 2)) * rate
    phases = random.uniform(0.0, 2.0 * np.pi, (3, 2))

    def turned(t):
        return Rotation.from_euler('ZYX', np.sum(
            sizes * np.sin(speeds * t[:, np.newaxis, np.newaxis] + phases), axis=2))

    h = 1e-3
    one, less, two, least = ((turned(t).inv() * turned(t + k * h)).as_rotvec()
                             for k in (1, -1, 2, -2))
    return (turned(t), (8.0 * (one - less) - (two - least)) / (12.0 * h),
            (16.0 * (one + less) - (two + least)) / (12.0 * h * h))


def free(t, random, rate):
    """Return the same of a free symmetric body."""
    w0, turn = random.standard_normal(3), random.uniform(0.4, 0.8)
    w0 *= rate / np.linalg.norm(w0)
    # It precesses about its angular momentum, and the rates turn about its axis.
    about = Rotation.from_rotvec(np.outer(t, (0.0, 0.0, turn * w0[2])))
    w = about.apply(w0)
    start = Rotation.random(random_state=int(random.integers(1 << 30)))
    precession = Rotation.from_rotvec(np.outer(t, start.apply(w0 * (1.0, 1.0, 1.0 + turn))))
    return precession * start * about.inv(), w, np.cross((0.0, 0.0, turn * w0[2]), w)


def body(seed, noisy=None, seconds=20.0, kind=None, rate=None):
    """Return a random body; `noisy`: whether its poses are, by chance where None."""
    random = np.random.default_rng(seed)
    hz = rate or random.choice((50.0, 100.0, 200.0, 500.0, 1000.0))
    t = np.arange(round(seconds * hz)) / hz
    make = {'free': free, 'forced': forced}[kind or random.choice(('free', 'forced', 'forced'))]
    rotation, w, alpha = make(t, random, random.uniform(2.0, 6.0))
    if random.random() < 0.3 and make is forced:
        p, a = np.zeros((2, len(t), 3))
    else:
        size, speed = random.uniform(0.05, 0.5, 3), random.uniform(1.0, 6.0, 3)
        p = size * np.sin(t[:, np.newaxis] * speed)
        a = -size * speed ** 2 * np.sin(t[:, np.newaxis] * speed)
        if make is free:
            p, a = 2.0 * t[:, np.newaxis] * size, 0.0 * a
            p[:, 2] -= 0.5 * GRAVITY * t ** 2
            a[:, 2] = -GRAVITY
    arm = random.uniform(0.05, 0.3, 3) * random.choice((-1.0, 1.0), 3)
    noisy = random.random() < 0.5 if noisy is None else noisy
    noise = {'attitudes': 10.0 ** random.uniform(-4.0, -2.7),
             'positions': 10.0 ** random.uniform(-4.0, -2.7)} if noisy else {}
    if random.random() < 0.5:
        noise |= {'gyroscope': 2e-3, 'accelerations': 2e-2}
    return Moving(t, rotation, p, w, alpha, a, arm, noise, random)


def rolled(values, steps=1):
    return np.concatenate((values[:1].repeat(steps, axis=0), values[:-steps]))


# By name: what changes in the parts.
FAULTS = {
    'late': lambda b, s: s.update(gyroscope=rolled(s['gyroscope']),
                                  accelerations=rolled(s['accelerations'])),
    'swapped': lambda b, s: s.update(gyroscope=s['gyroscope'] @ SWAPPED),
    'swapped force': lambda b, s: s.update(accelerations=s['accelerations'] @ SWAPPED),
    'negated': lambda b, s: s.update(gyroscope=-s['gyroscope']),
    'negated axis': lambda b, s: s.update(gyroscope=s['gyroscope'] * (1.0, -1.0, 1.0)),
    'degrees': lambda b, s: s.update(gyroscope=np.degrees(s['gyroscope'])),
    'g': lambda b, s: s.update(accelerations=s['accelerations'] / GRAVITY),
    'no gravity': lambda b, s: s.update(accelerations=b.force(gravity=0.0)),
    'no lever arm': lambda b, s: s.update(accelerations=b.force(arm=np.zeros(3))),
    'no centripetal': lambda b, s: s.update(accelerations=b.force(centripetal=0.0)),
    'world rates': lambda b, s: s.update(gyroscope=b.rotation.apply(b.w)),
    'w first': lambda b, s: s.update(attitudes=s['attitudes'][:, [3, 0, 1, 2]]),
    'conjugated': lambda b, s: s.update(attitudes=b.rotation.inv().as_quat()),
    'y up': lambda b, s: s.update(
        attitudes=(Y_UP * b.rotation).as_quat(), positions=Y_UP.apply(b.p)),
    'biased': lambda b, s: s.update(gyroscope=s['gyroscope'] + (0.05, -0.03, 0.04)),
    'biased force': lambda b, s: s.update(accelerations=s['accelerations'] + (0.3, -0.2, 0.25)),
    'held': lambda b, s: s.update(gyroscope=s['gyroscope'][::3].repeat(3, axis=0)[:len(b.t)])}
Y_UP = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
NAMES = {
    'late': 'late', 'swapped': 'axes', 'swapped force': 'axes', 'negated': 'reading_sign',
    'negated axis': 'sign', 'degrees': 'units', 'g': 'units', 'no gravity': 'no_gravity',
    'no lever arm': 'no_lever_arm', 'no centripetal': 'no_centripetal_term',
    'world rates': 'rates_in_world', 'w first': 'convention', 'conjugated': 'convention',
    'y up': 'convention', 'biased': 'bias', 'biased force': 'bias', 'held': 'held'}


def told(moving, fault=None):
    """Return the times and values of all parts, with noise, and a fault or none."""
    parts = moving.parts()
    if fault:
        FAULTS[fault](moving, parts)
    for name, sigma in moving.noise.items():
        white = sigma * moving.random.standard_normal((len(moving.t), 3))
        if name == 'attitudes':
            parts[name] = (Rotation.from_quat(parts[name]) * Rotation.from_rotvec(white)).as_quat()
        elif fault == 'held' and name == 'gyroscope':
            parts[name] = parts[name] + white[::3].repeat(3, axis=0)[:len(moving.t)]
        else:
            parts[name] = parts[name] + white
    return {name: (moving.t, values) for name, values in parts.items()}
