# SPDX-License-Identifier: Apache-2.0
"""Filters of three kinds, right or wrong by their parameters."""

from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.reference import (
    ReferenceFilter,
    exponential,
    from_two_vectors,
    matrix_of,
    product,
)

G, Z = 9.80665, np.array((0.0, 0.0, 1.0))


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

    def _delay(self, line, value, n):
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


def body(q, turn):
    return product(q, exponential(turn))


def world(q, turn):
    return product(exponential(turn), q)


def euler(q, turn):
    angles = Rotation.from_quat(q).as_euler('ZYX') + turn[::-1]
    return Rotation.from_euler('ZYX', angles).as_quat()


class Mahony(Part):
    """A filter of Mahony (2008) with exact steps."""

    def start(self, up=1.0, north=1.0, learns=0.1, most=np.inf, advance=body, triad=True,
              level=True, declination=0.0):
        self._gains, self._most, self._advance = (up, north, learns), most, advance
        self._triad, self._level, self._declination = triad, level, declination
        self._q, self._bias = None, np.zeros(3)

    def turn(self, w, a, m, dt):
        if self._q is None:
            self._q = from_two_vectors(a, m) if self._triad else np.array((0.0, 0.0, 0.0, 1.0))
        up, north, learns = self._gains
        self._q = self._advance(self._q, (w - self._bias) * dt)
        r = matrix_of(self._q)
        e = up * np.cross(a / np.linalg.norm(a), r[2])
        if m is not None:
            h = r @ m
            if not self._level:
                yaw = Rotation.from_quat(self._q).as_euler('ZYX')[0]
                h = Rotation.from_euler('z', yaw).apply(m)
            angle = np.arctan2(h[0], h[1]) + self._declination
            e = e + north * angle * r[2]
        self._bias = np.clip(self._bias - learns * e * dt, -self._most, self._most)
        self._q = body(self._q, e * dt)
        return self._q.copy()


class Complementary(Part):
    """It turns by the gyroscope, then a part of the way to the attitude of gravity and field."""

    def start(self, share=0.02, learns=0.002, most=np.inf, advance=body, gated=False):
        self._share, self._learns, self._advance, self._q = share, learns, advance, None
        self._most, self._gated = most, gated
        self._bias = np.zeros(3)

    def turn(self, w, a, m, dt):
        if self._q is None:
            self._q = from_two_vectors(a, m)
        self._q = self._advance(self._q, (w - self._bias) * dt)
        if self._gated:
            return self._q.copy()
        if m is None:
            r = matrix_of(self._q)
            e = np.cross(a / np.linalg.norm(a), r[2])
        else:
            e = (Rotation.from_quat(self._q).inv()
                 * Rotation.from_quat(from_two_vectors(a, m))).as_rotvec()
        self._bias = np.clip(self._bias - self._learns * e, -self._most, self._most)
        self._q = body(self._q, self._share * e)
        return self._q.copy()


class Ekf(Part):
    """The reference filter of the exam."""

    def start(self, **settings):
        self._filter, self._bias = ReferenceFilter(**settings), np.zeros(3)

    def turn(self, w, a, m, dt):
        q = self._filter.update(w, a, m, dt)
        self._bias = self._filter.bias
        return q


def matrix(rows):
    rows = np.array(rows, float)
    return lambda v: rows @ v


def scaled(*by):
    return lambda v: np.array(by) * v


def vector_scaled(by):
    def said(q):
        q = q * (by, by, by, 1.0)
        return q / np.linalg.norm(q)
    return said
