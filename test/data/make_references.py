# SPDX-License-Identifier: Apache-2.0
"""
Compute hard_cases.json, increments.json and ride.json again, from the starts that are in them.

    PYTHONPATH=.:test python test/data/make_references.py

Euler's equations and the quaternion are integrated by extrapolated midpoint steps (Gragg, Bulirsch
and Stoer; Hairer et al., sect. II.9) in 70 digits, with none of the package's formulas.  In the
frame of a pivot that moves the force m (g - a) acts at the centre of mass.  phi and psi are
quadratures beside them.  In half angles the rate of phi has no term that cancels:

    phi' = ((Lz - L3)/(4 sin^2(theta/2)) + (Lz + L3)/(4 cos^2(theta/2)))/lambda1
"""

import json
from pathlib import Path

import gmpy2
import numpy as np
from gmpy2 import atan2, cos, cot, mpfr, sin, tan
from helpers.reference import scene_parameters, start_of, top_of

from spinning_top_sim import State, Top
from spinning_top_sim.streams import parameters

gmpy2.get_context().precision = 240
COLUMNS, TOLERANCE = 22, mpfr('1e-42')      # of the extrapolation; relative error of a step
HERE = Path(__file__).parent


def numbers(values):
    return np.array([mpfr(x) for x in values], object)


def product(p, q):
    """Return p q of quaternions x, y, z, w."""
    (a, b, c, d), (x, y, z, w) = p, q
    return np.array([d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                     d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z])


def conjugate(q):
    return q * (-1, -1, -1, 1)


def rotated(q, v):
    return product(product(q, [*v, mpfr(0)]), conjugate(q))[:3]


def about(axis, angle):
    half = mpfr(angle) / 2
    return np.array([sin(half) * (k == axis) for k in range(3)] + [cos(half)])


class Motion:
    """
    A top from its start: q (x, y, z, w), omega, and the quadratures of some rates.

    rates : rates(q, omega, alpha) returns them
    """

    def __init__(self, top, start, rates=lambda q, omega, alpha: (), count=0):
        self.rates, self.step = rates, mpfr('0.1')
        self.lambda1, self.lambda3 = mpfr(top.lambda1), mpfr(top.lambda3)
        self.moment, self.gravity = mpfr(top.mass) * mpfr(top.com_distance), mpfr(top.gravity)
        self.push((0, 0, 0))
        half, plus, minus = (mpfr(start.theta) / 2, mpfr(start.lz) + mpfr(start.l3),
                             mpfr(start.lz) - mpfr(start.l3))
        across = ((plus * tan(half) if plus else 0) + (minus * cot(half) if minus else 0)) / (
            2 * self.lambda1)
        theta_dot, s, c = mpfr(start.theta_dot), sin(mpfr(start.psi)), cos(mpfr(start.psi))
        self.now = np.array([
            *product(product(about(2, start.phi), about(1, start.theta)), about(2, start.psi)),
            theta_dot * s - across * c, theta_dot * c + across * s, start.l3 / self.lambda3,
            *count * [mpfr(0)]])

    def push(self, acceleration):
        """Let the pivot accelerate so; keep the force times the distance of the mass."""
        self.force = -self.moment * (numbers(acceleration) + numbers((0, 0, self.gravity)))

    @property
    def parts(self):
        """Q, omega, and quadratures."""
        return np.split(self.now, (4, 7))

    def derivative(self, y):
        q, omega, _ = np.split(y, (4, 7))
        (f1, f2, _), (o1, o2, o3) = rotated(conjugate(q), self.force), omega
        gyroscopic = (self.lambda1 - self.lambda3) * o3
        alpha = np.array([(gyroscopic * o2 - f2) / self.lambda1,
                          (f1 - gyroscopic * o1) / self.lambda1, mpfr(0)])
        return np.array([*product(q, [*omega / 2, mpfr(0)]), *alpha,
                         *self.rates(q, omega, alpha)])

    def go_on(self, seconds):
        """Integrate over a time, forwards or backwards."""
        left = mpfr(seconds)
        while left:
            h = left if abs(left) <= self.step else self.step * gmpy2.sign(left)
            row = []
            for k in range(1, COLUMNS + 1):
                s, before = h / (2 * k), self.now
                then = before + s * self.derivative(before)
                for _ in range(2 * k - 1):
                    before, then = then, before + 2 * s * self.derivative(then)
                last, row = row, [(before + then + s * self.derivative(then)) / 2]
                for j, one in enumerate(last):
                    row.append(row[j] + (row[j] - one) / (mpfr(k) ** 2 / (k - j - 1) ** 2 - 1))
            error = max(abs(row[-1] - row[-2]) / np.maximum(abs(row[-1]), 1))
            if error <= TOLERANCE:
                self.now, left = row[-1], left - h
            self.step = abs(h) * max(min((TOLERANCE / (error + TOLERANCE ** 2)) ** (
                1 / mpfr(2 * COLUMNS - 1)) * 0.8, 4), mpfr('0.1'))


def states(case):
    """Return the states of a hard case at its times."""
    top, start, found = top_of(case), start_of(case), []
    plus, minus = mpfr(start.lz) + mpfr(start.l3), mpfr(start.lz) - mpfr(start.l3)

    def rates(q, omega, _):
        sin2, cos2 = q[0] ** 2 + q[1] ** 2, q[2] ** 2 + q[3] ** 2
        phi_dot = ((minus / sin2 if minus else 0) + (plus / cos2 if plus else 0)) / (
            4 * mpfr(top.lambda1))
        return phi_dot, omega[2] - phi_dot * (cos2 - sin2)

    for t in case['times']:
        motion = Motion(top, start, rates, 2)
        motion.go_on(t)
        (x, y, z, w), (o1, o2, _), turned = motion.parts
        phi, psi = numbers((start.phi, start.psi)) + turned
        # cos(theta/2) = alpha exp(-i (phi + psi)/2), sin(theta/2) = beta exp(-i (phi - psi)/2)
        a, b = (phi + psi) / 2, (phi - psi) / 2
        theta = 2 * atan2(y * cos(b) - x * sin(b), w * cos(a) + z * sin(a))
        found.append({'t': t, **{name: shown(value) for name, value in (
            ('theta', theta), ('thetadot', o1 * sin(psi) + o2 * cos(psi)), ('phi', phi),
            ('psi', psi))}, 'q': [*map(shown, (w, x, y, z))]})
    return found


def shown(value):
    return f'{value:.30g}'


def increments(case):
    """Return what an IMU measures in the interval of a case."""
    values = parameters.checked(scene_parameters(case['scene']))
    top, start = parameters.top_of(values), parameters.start_state(values)
    arm, g = numbers(case['lever_arm']), mpfr(top.gravity)

    def measured(q, omega, alpha):
        return (*omega, *(np.cross(alpha, arm) + omega * (omega @ arm) - arm * (omega @ omega)
                          + g * rotated(conjugate(q), (0, 0, 1))))

    motion, seconds = Motion(top, start, measured, 6), mpfr(case['length_ns']) / 10 ** 9
    motion.go_on(mpfr(case['begin_ns']) / 10 ** 9)
    q, omega, first = motion.parts
    motion.go_on(seconds)
    later, faster, last = motion.parts
    means, (roll, pitch, yaw) = (last - first) / seconds, case['rpy']
    mounting = product(product(about(2, yaw), about(1, pitch)), about(0, roll))
    change = (rotated(later, np.cross(faster, arm)) - rotated(q, np.cross(omega, arm))
              + numbers((0, 0, g * seconds)))
    of_body = conjugate(mounting)
    return {name: [*map(shown, found)] for name, found in (
        ('dq', product(product(of_body, product(conjugate(q), later)), mounting)),
        ('dv', rotated(conjugate(product(q, mounting)), change)),
        ('rates', rotated(of_body, means[:3])), ('force', rotated(of_body, means[3:])))}


def ride(case):
    """Return the states of a case with a moving pivot: q, omega, alpha, and where a point is."""
    motion, found, now = Motion(Top(**case['top']), State(**case['start'])), [], 0
    place, velocity = numbers(case['position']), numbers(case['velocity'])
    for length, acceleration in (*case['pieces'], (10 ** 18, 3 * [0.0])):
        motion.push(acceleration)
        stops = [t for t in case['times_ns'] if now <= t < now + length]
        for t in (*stops, now + length):
            if len(found) == len(case['times_ns']):
                return found
            seconds, now = mpfr(t - now) / 10 ** 9, t
            motion.go_on(seconds)
            place = place + seconds * (velocity + seconds * numbers(acceleration) / 2)
            velocity = velocity + seconds * numbers(acceleration)
            if t in stops:
                q, omega, _ = motion.parts
                found.append({name: [*map(shown, values)] for name, values in (
                    ('q', np.roll(q, 1)), ('omega', omega),
                    ('alpha', motion.derivative(motion.now)[4:7]),
                    ('position', place + rotated(q, numbers(case['point']))))})
    raise AssertionError('a time is behind the end')


if __name__ == '__main__':
    for name, key, compute in (('hard_cases', 'states', states), ('ride', 'states', ride),
                               ('increments', None, increments)):
        path = HERE / f'{name}.json'
        kept = json.loads(path.read_text())
        cases = kept if key is None else kept['cases']
        for case in cases:
            case.update({key: compute(case)} if key else compute(case))
        rows = ',\n'.join(json.dumps(case, separators=(',', ':')) for case in cases)
        head = '' if key is None else (
            '{"note":"q is w x y z; made by make_references.py","cases":')
        path.write_text(f'{head}[\n{rows}\n]{"}" if key else ""}\n')
