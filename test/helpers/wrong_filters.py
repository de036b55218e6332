# SPDX-License-Identifier: Apache-2.0
"""Filters of three kinds, right or wrong by their parameters."""

import math
from collections import deque
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from helpers.faulty_filters import longer
from spinning_top_sim.exam import reference

X, Y, Z = np.eye(3)


class Part:
    """The part of a filter that can be wrong: what it takes, and what it says."""

    def __init__(self, gyroscope=None, accelerometer=None, magnetometer=None, late=(0, 0, 0, 0),
                 smooth=(0.0, 0.0, 0.0), said=None, report=None, step=None, **settings):
        self._maps = [
            one if one is not None else (lambda v: v)
            for one in (gyroscope, accelerometer, magnetometer)]
        self._lines = [deque() for _ in range(4)]
        self._late, self._smooth, self._smoothed = late, smooth, [None] * 3
        self._said, self._report = said or (lambda q: q), report or (lambda b: b)
        self._step = step or (lambda dt: dt)
        self.bias = np.zeros(3)
        self.start(**settings)

    @staticmethod
    def _delay(line, value, n):
        if not n:
            return value
        line.append(value)
        return line.popleft() if len(line) > n else line[0]

    def _read(self, k, reading, dt):
        reading = self._delay(self._lines[k], self._maps[k](reading), self._late[k])
        before = self._smoothed[k]
        if self._smooth[k] and before is not None:
            reading = before + dt / (dt + self._smooth[k]) * (reading - before)
        self._smoothed[k] = reading
        return reading

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        q = self.turn(*(None if reading is None else self._read(k, reading, dt) for k, reading
                        in enumerate((gyroscope, accelerometer, magnetometer))), self._step(dt))
        self.bias = self._report(self._bias)
        return self._said(self._delay(self._lines[3], q, self._late[3]))


def cross(one, other):
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))


def body(q, turn):
    return reference.product(q, reference.exponential(turn))


def world(q, turn):
    return reference.product(reference.exponential(turn), q)


def euler(q, turn):
    angles = Rotation.from_quat(q).as_euler('ZYX') + turn[::-1]
    return Rotation.from_euler('ZYX', angles).as_quat()


class Mahony(Part):
    """A filter of Mahony (2008) with exact steps."""

    def start(self, up=0.3, north=0.3, learns=0.15, most=np.inf, advance=body, triad=True,
              level=True, declination=0.0, about=None, angle=math.atan2, felt=(X, Y, Z)):
        self._gains, self._most, self._advance = (up, north, learns), most, advance
        self._triad, self._level, self._declination, self._about = triad, level, declination, about
        self._angle, self._felt = angle, np.array(felt)
        self._q, self._bias = None, np.zeros(3)

    def turn(self, w, a, m, dt):
        if self._q is None:
            self._q = np.array((0.0, 0.0, 0.0, 1.0))
            if self._triad:
                self._q = reference.from_two_vectors(a, m)
        up, north, learns = self._gains
        self._q = self._advance(self._q, (w - self._bias) * dt)
        r = reference.matrix_of(self._q)
        e = up * self._felt @ cross(a, r[2]) / math.sqrt(a @ a)
        if m is not None:
            h = r @ m
            if not self._level:
                yaw = Rotation.from_quat(self._q).as_euler('ZYX')[0]
                h = Rotation.from_euler('z', yaw).apply(m)
            angle = self._angle(h[0], h[1]) + self._declination
            e = e + north * angle * (r[2] if self._about is None else self._about)
        self._bias = np.minimum(np.maximum(self._bias - learns * e * dt, -self._most), self._most)
        self._q = body(self._q, e * dt)
        return self._q.copy()


class Complementary(Part):
    """It turns by the gyroscope, then a part of the way to the attitude of gravity and field."""

    def start(self, share=0.003, learns=0.0004, most=np.inf, advance=body):
        self._share, self._learns, self._advance, self._q = share, learns, advance, None
        self._most, self._bias = most, np.zeros(3)

    def turn(self, w, a, m, dt):
        if self._q is None:
            self._q = reference.from_two_vectors(a, m)
        self._q = self._advance(self._q, (w - self._bias) * dt)
        if m is None:
            r = reference.matrix_of(self._q)
            e = cross(a, r[2]) / math.sqrt(a @ a)
        else:
            e = reference.product(self._q * (-1.0, -1.0, -1.0, 1.0),
                                  reference.from_two_vectors(a, m))
            e = 2.0 * e[:3] * np.sign(e[3])
        self._bias = np.minimum(np.maximum(self._bias - self._learns * e, -self._most), self._most)
        self._q = body(self._q, self._share * e)
        return self._q.copy()


class Ekf(Part):
    """The reference filter of the exam."""

    def start(self, fields=10 ** 9, **settings):
        self._filter, self._bias = reference.ReferenceFilter(**settings), np.zeros(3)
        self._fields = iter(range(fields))

    def turn(self, w, a, m, dt):
        q = self._filter.update(w, a, None if next(self._fields, None) is None else m, dt)
        self._bias = self._filter.bias
        return q


def axes(*rows):
    """Return what reads other axes: numbers from 1 on, negative where the sign is changed."""
    chosen, signs = np.abs(rows) - 1, np.sign(rows)
    return lambda v: signs * v[chosen]


def scaled(*by):
    return lambda v: np.array(by) * v


def added(*offset):
    return lambda v: v + offset


GYROSCOPE, GRAVITY, FIELD = 'gyroscope_wiring', 'accelerometer_wiring', 'magnetometer_wiring'
UNITS, STEP, LAG, OFF = 'gyroscope_units', 'time_step', 'lag', 'inaccurate'
# For each kind of filter: the changes, and the causes that may be named; none is a right filter.
CHANGES = {
    'right': ({}, ''),
    'rates y x z': ({'gyroscope': axes(2, 1, 3)}, GYROSCOPE),
    'rates -x y z': ({'gyroscope': axes(-1, 2, 3)}, GYROSCOPE),
    'rates negated': ({'gyroscope': axes(-1, -2, -3)}, GYROSCOPE),
    'rates z x y': ({'gyroscope': axes(3, 1, 2)}, GYROSCOPE),
    'rates x 1.05': ({'gyroscope': scaled(1.05, 1.0, 1.0)}, GYROSCOPE),
    'rates in deg': ({'gyroscope': np.degrees}, UNITS),
    'rates twice in rad': ({'gyroscope': np.radians}, UNITS),
    'rates clipped': ({'gyroscope': lambda v: np.clip(v, -8.0, 8.0)}, OFF),
    'rates late': ({'late': (5, 0, 0, 0)}, LAG),
    'rates smoothed': ({'smooth': (0.05, 0.0, 0.0)}, LAG),
    'force y x z': ({'accelerometer': axes(2, 1, 3)}, GRAVITY),
    'force x -y z': ({'accelerometer': axes(1, -2, 3)}, GRAVITY),
    'force x -y -z': ({'accelerometer': axes(1, -2, -3)}, GRAVITY),
    'force negated': ({'accelerometer': axes(-1, -2, -3)}, 'gravity_sign'),
    'force x 1.2': ({'accelerometer': scaled(1.2, 1.0, 1.0)}, GRAVITY),
    'force late': ({'late': (0, 8, 0, 0)}, LAG),
    'force smoothed': ({'smooth': (0.0, 0.1, 0.0)}, LAG),
    'field y x z': ({'magnetometer': axes(2, 1, 3)}, FIELD),
    'field x y -z': ({'magnetometer': axes(1, 2, -3)}, FIELD),
    'hard iron': ({'magnetometer': added(1e-5, 0.0, 0.0)}, 'hard_iron'),
    'soft iron': ({'magnetometer': scaled(1.4, 1.0, 1.0)}, FIELD),
    'conjugated': ({'said': lambda q: q * (-1.0, -1.0, -1.0, 1.0)}, 'conjugated'),
    'w first': ({'said': lambda q: q[[3, 0, 1, 2]]}, 'component_order'),
    'vector longer': ({'said': longer}, OFF),
    'vector positive': ({'said': np.abs}, OFF),
    'vector y x z': ({'said': lambda q: q[[1, 0, 2, 3]]}, 'component_order'),
    'attitude late': ({'late': (0, 0, 0, 5)}, 'stamp_offset'),
    'twice dt': ({'step': lambda dt: 2.0 * dt}, f'{GYROSCOPE} {STEP}'),
    'dt of 100 Hz': ({'step': lambda dt: 0.01}, STEP)}
OWN = {     # and these
    'mahony': {
        'wrong side': ({'advance': world}, GYROSCOPE),
        'Euler angles': ({'advance': euler}, GYROSCOPE),
        # It ends upside down, and its error grows until then.
        'gain < 0': ({'up': -0.3}, f'gravity_sign {GRAVITY} diverges {OFF}'),
        'no gravity': ({'up': 0.0}, GRAVITY), 'no field': ({'north': 0.0}, FIELD),
        'field of a level sensor': ({'level': False}, FIELD),
        'heading by atan': ({'angle': lambda x, y: math.atan(x / y)}, OFF),
        'heading from 0 on': ({'angle': lambda x, y: math.atan2(x, y) % math.tau}, OFF),
        'heading about z': ({'about': np.array((0.0, 0.0, 1.0))}, f'{FIELD} {OFF}'),
        'tilt about x as y': ({'felt': (X, X, Z)}, f'{OFF} {GRAVITY}'),
        'tilt about y as x': ({'felt': (Y, Y, Z)}, f'{OFF} {GRAVITY}'),
        'no tilt about y': ({'felt': (X, 0 * Y, Z)}, GRAVITY),
        'slow turns dropped': ({'gyroscope': lambda v: v * (v @ v > 0.04)}, OFF),
        'dt at most 10 ms': ({'step': lambda dt: min(dt, 0.01)}, STEP),
        'dt cut': ({'step': lambda dt: int(100.0 * dt) / 100.0}, STEP),
        'dt rounded': ({'step': lambda dt: round(dt, 3)}, STEP),
        'slow heading': ({'north': 0.01, 'learns': 0.02}, 'no_bias_estimate'),
        'declination': ({'declination': np.radians(5.0)}, 'heading_offset'),
        'bias gain < 0': ({'learns': -0.15}, f'no_bias_estimate diverges {OFF}'),
        'no bias': ({'learns': 0.0}, 'no_bias_estimate'),
        'bias about z': ({'learns': np.array((0.0, 0.0, 0.15))}, 'no_bias_estimate'),
        'bias off': ({'report': lambda b: b + 0.02}, 'bias_report'),
        'bias in deg/s': ({'report': np.degrees}, 'bias_report'),
        'bias turned': ({'learns': 0.06, 'report': lambda b: b + np.cross(b, (-0.3, -0.3, -0.9))},
                        'bias_report'),
        'bias clamped': ({'most': np.radians(0.1)}, 'no_bias_estimate'),
        'bias negated': ({'report': np.negative}, 'bias_report')},
    'complementary': {
        'wrong side': ({'advance': world}, GYROSCOPE),
        'Euler angles': ({'advance': euler}, GYROSCOPE),
        'never corrects': ({'share': 0.0, 'learns': 0.0}, f'{GRAVITY} {FIELD}'),
        'corrects by the bias': ({'share': 0.0}, f'{OFF} no_bias_estimate')},
    'ekf': {
        # It takes the lag for motion of the device, and follows such forces little.
        'force smoothed': ({'smooth': (0.0, 0.1, 0.0)}, f'{LAG} {OFF}'),
        'field at its start': ({'fields': 50}, FIELD),
        'bias negated': ({'report': np.negative}, 'bias_report')}}
KINDS = {'mahony': Mahony, 'complementary': Complementary, 'ekf': Ekf}
TABLE = {f'{kind}, {name}': (partial(make, **change), set(causes.split()))
         for kind, make in KINDS.items()
         for name, (change, causes) in {**CHANGES, **OWN[kind]}.items()}
