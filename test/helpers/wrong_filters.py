# SPDX-License-Identifier: Apache-2.0
"""Filters that are right, and filters with one mistake each and the faults that may be named."""

import math
import runpy
from collections import deque
from functools import partial
from operator import itemgetter
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from helpers.faulty_simulators import cross
from helpers.reference import ROOT
from spinning_top_sim.exam.adapters import Vqf
from spinning_top_sim.exam.measures import from_two_vectors
from spinning_top_sim.physics import attitude

reference = SimpleNamespace(**runpy.run_path(str(ROOT / 'examples/reference_filter.py')))
ReferenceFilter, product = reference.ReferenceFilter, reference.product


class Part:
    """Another filter, of which something is taken for what it is not."""

    def __init__(self, make=Vqf, rates=None, force=None, field=None, said=None, step=None,
                 late=(0, 0, 0, 0), taken=itemgetter(0), report=None, covariance=None):
        self._filter = make()
        self._maps = [one or (lambda v: v) for one in (rates, force, field, said)]
        self._step, self._report, self._covariance = step or (lambda dt: dt), report, covariance
        self._lines, self._taken = [deque(maxlen=n + 1) for n in late], taken

    def _read(self, k, value):
        if value is None:
            return None
        self._lines[k].append(self._maps[k](value))
        return self._taken(self._lines[k])

    def update(self, *readings):
        *sensors, dt = readings
        read = [self._read(k, value) for k, value in enumerate(sensors)]
        return self._read(3, self._filter.update(*read, self._step(dt)))

    @property
    def bias(self):
        bias = getattr(self._filter, 'bias', None)
        return self._report(bias) if self._report else bias

    @property
    def covariance(self):
        covariance = getattr(self._filter, 'covariance', None)
        return covariance if self._covariance is None else self._covariance * covariance


def body(q, turn):
    return product(q, reference.exponential(turn))


def world(q, turn):
    return product(reference.exponential(turn), q)


def first_order(q, turn):
    return product(q, np.array((*(0.5 * turn), 1.0)))


class Mahony:
    """A filter of Mahony (2008): gains of tilt, heading [1/s] and bias [1/s^2]."""

    def __init__(self, up=0.3, north=0.3, learns=0.02, advance=body, triad=True, first=False,
                 number=None, level=True, most=None, feels=(1.0, 1.0, 1.0), six=False,
                 in_world=False):
        self._gains, self._advance, self._triad, self._first = (
            (up, north, learns), advance, triad, first)
        self._number, self._level, self._most, self._feels = number, level, most, feels
        self._six, self._in_world, self._q, self.bias = six, in_world, None, np.zeros(3)

    def _turn(self, a, m, dt):
        up, north, learns = self._gains
        q, a, turn = self._q.tolist(), a.tolist(), 0.0
        vertical, weight = attitude.vertical_in_body(q), up / math.hypot(*a)
        if m is not None:
            if not self._level:
                yaw = Rotation.from_quat(q).as_euler('ZYX')[0]
                q = Rotation.from_euler('z', yaw).as_quat().tolist()
            east, ahead, _ = attitude.rotated(q, m.tolist())
            turn = north * math.atan2(east, ahead)
        e = np.array([weight * tilt * feels + turn * v for tilt, feels, v in zip(
            cross(a, vertical), self._feels, vertical, strict=True)])
        self.bias = self.bias - learns * dt * e
        if self._most:
            self.bias = self.bias.clip(-self._most, self._most)
        return e * dt

    def update(self, w, a, m, dt):
        before, m = self._q, None if self._six else m
        if self._q is None:
            self._q = from_two_vectors(a, m) if self._triad else np.array((0.0, 0.0, 0.0, 1.0))
        elif self._first:       # corrects by the force of the end before it turns
            self._q = self._advance(self._q, self._turn(a, m, dt) + (w - self.bias) * dt)
        else:
            self._q = self._advance(self._q, (w - self.bias) * dt)
            self._q = body(self._q, self._turn(a, m, dt))
        if self._number:
            self._q = self._q.astype(self._number).astype(float)
            self._q /= math.sqrt(self._q @ self._q)
        if self._in_world and before is not None:       # the integral is in axes of the world
            self.bias = reference.matrix_of(self._q).T @ reference.matrix_of(before) @ self.bias
        return self._q.copy()


EAST = Rotation.from_euler('z', 5.0, degrees=True).as_quat()
NED = Rotation.from_matrix([(0, 1, 0), (1, 0, 0), (0, 0, -1)]).as_quat()
RIGHT = {
    'vqf': Vqf, 'vqf, six axes': partial(Vqf, magnetic=False),
    'vqf, slow': partial(Vqf, tauAcc=30.0),
    'reference': ReferenceFilter, 'mahony': Mahony, 'mahony, six axes': partial(Mahony, six=True),
    'mahony, slow': partial(Mahony, 0.1, 0.1, 0.01), 'mahony, slower': partial(
        Mahony, 0.1, 0.05, 0.001), 'mahony, fast': partial(Mahony, 1.0, 1.0, 0.1),
    'mahony, float32': partial(Mahony, number=np.float32),
    'mahony, from the identity': partial(Mahony, triad=False),
    'mahony, slow from the identity': partial(Mahony, 0.1, 0.1, 0.01, triad=False),
    'mahony, corrects first': partial(Mahony, 1.0, 0.5, 0.1, first=True),
    'mahony, means of two': partial(Part, partial(Mahony, 1.0, 1.0, 0.1), late=(0, 1, 1, 0),
                                    taken=lambda values: 0.5 * (values[0] + values[-1])),
    'mahony, field a step late': partial(Part, partial(Mahony, 3.0, 3.0, 0.5),
                                         late=(0, 0, 1, 0))}
# Each with the faults that may be named.
WRONG = {
    'rates y x z': (partial(Part, rates=lambda v: v[[1, 0, 2]]), 'gyroscope'),
    'rates negated': (partial(Part, rates=np.negative), 'gyroscope'),
    'rates x 1.05': (partial(Part, rates=lambda v: v * (1.05, 1.0, 1.0)), 'gyroscope'),
    'rates x 1.015': (partial(Part, Mahony, rates=lambda v: 1.015 * v), 'accuracy'),
    'rates clipped': (partial(Part, rates=lambda v: np.clip(v, -8.0, 8.0)), 'gyroscope'),
    'rates late': (partial(Part, late=(5, 0, 0, 0)), 'timing'),
    'slow turns dropped': (partial(Part, Mahony, rates=lambda v: v * (v @ v > 0.04)), 'accuracy'),
    'force y x z': (partial(Part, force=lambda v: v[[1, 0, 2]]), 'accelerometer'),
    'force negated': (partial(Part, force=np.negative), 'accelerometer'),
    'force x 1.2': (partial(Part, force=lambda v: v * (1.2, 1.0, 1.0)), 'accelerometer'),
    'force late': (partial(Part, Mahony, late=(0, 10, 0, 0)), 'accuracy'),
    'no tilt about y': (partial(Mahony, feels=(1.0, 0.0, 1.0)), 'accelerometer'),
    'gain < 0': (partial(Mahony, -0.3), 'accelerometer'),
    'no gravity': (partial(Mahony, 0.0), 'accelerometer'),
    'field y x z': (partial(Part, field=lambda v: v[[1, 0, 2]]), 'magnetometer'),
    'hard iron': (partial(Part, field=partial(np.add, (1e-5, 0.0, 0.0))), 'magnetometer'),
    'field of a level sensor': (partial(Mahony, level=False), 'accuracy'),
    'no field': (partial(Mahony, north=0.0), 'magnetometer'),
    'declination': (partial(Part, said=partial(product, EAST)), 'magnetometer'),
    'conjugated': (partial(Part, said=lambda q: q * (-1.0, -1.0, -1.0, 1.0)), 'convention'),
    'w first': (partial(Part, said=lambda q: q[[3, 0, 1, 2]]), 'convention'),
    'w first, NED': (partial(Part, said=lambda q: product(NED, q)[[3, 0, 1, 2]]), 'convention'),
    'vector positive': (partial(Part, said=np.abs), 'accuracy'),
    'rounded': (partial(Part, said=lambda q: np.round(q, 2) / np.linalg.norm(np.round(q, 2))),
                'accuracy'),
    'one step late': (partial(Part, late=(0, 0, 0, 1)), 'timing'),
    'dt of 100 Hz': (partial(Part, Mahony, step=lambda dt: 0.01), 'timing'),
    'wrong side': (partial(Mahony, advance=world), 'accuracy'),
    'first order': (partial(Mahony, advance=first_order), 'integration'),
    'follows forces': (partial(Vqf, tauAcc=0.1), 'lever_arm'),
    'no bias': (partial(Mahony, learns=0.0), 'bias'),
    'bias gain < 0': (partial(Mahony, learns=-0.02), 'bias'),
    'bias clamped': (partial(Mahony, most=math.radians(0.1)), 'bias'),
    'bias negated': (partial(Part, report=np.negative), 'bias'),
    'bias in the world': (partial(Mahony, 0.5, 0.5, 0.05, in_world=True), 'bias'),
    'covariance / 16': (partial(Part, ReferenceFilter, covariance=1.0 / 16.0), 'covariance'),
    'covariance in deg^2': (partial(Part, ReferenceFilter, covariance=3283.0), 'covariance'),
    'not a number': (partial(Part, said=lambda q: q * np.nan), 'invalid_output')}
TABLE = {**{name: (make, '') for name, make in RIGHT.items()}, **WRONG}
