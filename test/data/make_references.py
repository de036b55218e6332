# SPDX-License-Identifier: Apache-2.0
"""
Compute hard_cases.json, increments.json and ride.json again, from the starts that are in them.

    pip install mpmath;  PYTHONPATH=.:test python test/data/make_references.py

Euler's equations and the quaternion are integrated by Taylor series in 60 digits, with none of the
package's formulas.  In the frame of a pivot that moves the force m (g - a) acts at the centre of
mass.  phi and psi are quadratures beside them.  In half angles the rate of phi has no term that
cancels:

    phi' = ((Lz - L3)/(4 sin^2(theta/2)) + (Lz + L3)/(4 cos^2(theta/2)))/lambda1
"""

import json
from pathlib import Path

import numpy as np
from helpers.reference import scene_parameters, start_of, top_of
from mpmath import atan2, cos, cot, expj, fdot, mp, mpc, mpf, nstr, sin, tan

from spinning_top_sim import State, Top
from spinning_top_sim.streams import parameters

mp.dps = 60
ORDER, SHARE = 50, mpf('0.1')     # of a series, and a step over its radius of convergence
HERE = Path(__file__).parent


def numbers(values):
    return np.array([mpf(x) for x in values], object)


def product(p, q):
    """Return p q of quaternions x, y, z, w."""
    (a, b, c, d), (x, y, z, w) = p, q
    return np.array([d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                     d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z])


def conjugate(q):
    return q * (-1, -1, -1, 1)


def rotated(q, v):
    return product(product(q, [*v, mpf(0)]), conjugate(q))[:3]


def about(axis, angle):
    half = mpf(angle) / 2
    return np.array([sin(half) * (k == axis) for k in range(3)] + [cos(half)])


def times(f, g):
    """Return the series of the product of two series."""
    return np.convolve(f, g)[:ORDER]


def reciprocal(f):
    inverse = [1 / f[0]]
    for k in range(1, ORDER):
        inverse.append(-fdot(f[1:k + 1], reversed(inverse)) / f[0])
    return np.array(inverse)


class Motion:
    """
    A top from its start: q (x, y, z, w), omega, and the quadratures of some rates, at time t.

    rates: rates(q, omega) returns their series from those of q and omega
    """

    def __init__(self, top, start, rates=lambda q, omega: (), count=0):
        self.t, self.rates, self.quadratures = mpf(0), rates, count * [mpf(0)]
        self.lambda1, self.lambda3 = mpf(top.lambda1), mpf(top.lambda3)
        self.moment, self.gravity = mpf(top.mass) * mpf(top.com_distance), mpf(top.gravity)
        self.push((0, 0, 0))
        half, plus, minus = (mpf(start.theta) / 2, mpf(start.lz) + mpf(start.l3),
                             mpf(start.lz) - mpf(start.l3))
        across = ((plus * tan(half) if plus else 0) + (minus * cot(half) if minus else 0)) / (
            2 * self.lambda1)
        self.q = product(product(about(2, start.phi), about(1, start.theta)), about(2, start.psi))
        omega = mpc(-across, start.theta_dot) * expj(-mpf(start.psi))
        self.omega = np.array([omega.real, omega.imag, mpf(start.l3) / self.lambda3])

    def push(self, acceleration):
        """Let the pivot accelerate so; keep the force times the distance of the mass."""
        self.force = -self.moment * (numbers(acceleration) + numbers((0, 0, self.gravity)))

    def go_to(self, t):
        """Integrate forwards or backwards."""
        while self.t != t:
            q, omega = self.series()
            rates = self.rates(q, omega)
            step = SHARE * min(radius(group) for group in (q, omega, rates) if len(group))
            step = t - self.t if step >= abs(t - self.t) else step if t > self.t else -step
            self.t = t if step == t - self.t else self.t + step
            powers = step ** np.arange(ORDER)
            self.q, self.omega = q @ powers, omega @ powers
            self.quadratures = [value + step * (f / np.arange(1, ORDER + 1)) @ powers
                                for value, f in zip(self.quadratures, rates, strict=True)]

    def series(self):
        """Return the Taylor series of q and omega."""
        def term(f, g):
            return fdot(f, g[::-1])

        x, y, z, w = q = [[value] for value in self.q]
        o1, o2, o3 = omega = [[value] for value in self.omega]
        gyroscopic = (self.lambda1 - self.lambda3) * o3[0]
        for k in range(1, ORDER):
            xx, yy, zz, ww = (term(f, f) for f in q)
            # Components 1 and 2 in the body of the force at (0, 0, 1).
            f1 = fdot(self.force, (ww + xx - yy - zz, 2 * (term(x, y) + term(z, w)),
                                   2 * (term(x, z) - term(y, w))))
            f2 = fdot(self.force, (2 * (term(x, y) - term(z, w)), ww - xx + yy - zz,
                                   2 * (term(y, z) + term(x, w))))
            new = ((term(w, o1) + term(y, o3) - term(z, o2)) / 2,
                   (term(w, o2) + term(z, o1) - term(x, o3)) / 2,
                   (term(w, o3) + term(x, o2) - term(y, o1)) / 2,
                   -(term(x, o1) + term(y, o2) + term(z, o3)) / 2,
                   (gyroscopic * o2[-1] - f2) / self.lambda1,
                   (f1 - gyroscopic * o1[-1]) / self.lambda1, mpf(0))
            for f, rate in zip((*q, *omega), new, strict=True):
                f.append(rate / k)
        return np.array(q), np.array(omega)


def radius(group):
    """Return the radius of convergence of series, from two of their last terms."""
    sizes = abs(np.array(group)).max(axis=0)
    return min(((sizes[0] / sizes[k]) ** (mpf(1) / k) for k in (ORDER - 2, ORDER - 1)
                if sizes[0] and sizes[k]), default=mpf(1000))


def states(case):
    """Return the states of a hard case at its times."""
    top, start, found = top_of(case), start_of(case), {}
    plus, minus = mpf(start.lz) + mpf(start.l3), mpf(start.lz) - mpf(start.l3)

    def rates(q, omega):
        xx, yy, zz, ww = (times(f, f) for f in q)
        phi_dot = sum((momentum / (4 * mpf(top.lambda1)) * reciprocal(square)
                       for momentum, square in ((minus, xx + yy), (plus, zz + ww)) if momentum),
                      0 * xx)
        return phi_dot, omega[2] - times(phi_dot, zz + ww - xx - yy)

    for sense in (1, -1):
        motion = Motion(top, start, rates, 2)
        for t in sorted((t for t in case['times'] if t * sense > 0), key=abs):
            motion.go_to(mpf(t))
            (x, y, z, w), omega = motion.q, motion.omega
            phi, psi = (mpf(a) + b for a, b in zip(
                (start.phi, start.psi), motion.quadratures, strict=True))
            # cos(theta/2) = alpha exp(-i (phi + psi)/2), sin(theta/2) = beta exp(-i (phi - psi)/2)
            theta = 2 * atan2((mpc(y, -x) * expj((psi - phi) / 2)).real,
                              (mpc(w, z) * expj(-(phi + psi) / 2)).real)
            theta_dot = (mpc(omega[0], omega[1]) * expj(psi)).imag
            found[t] = {'t': t, **{name: nstr(value, 29) for name, value in (
                ('theta', theta), ('thetadot', theta_dot), ('phi', phi), ('psi', psi))},
                'q': [nstr(value, 29) for value in (w, x, y, z)]}
    return [found[t] for t in case['times']]


def increments(case):
    """Return what an IMU measures in the interval of a case."""
    values = parameters.checked(scene_parameters(case['scene']))
    top, start = parameters.top_of(values), parameters.start_state(values)
    arm, g = numbers(case['lever_arm']), mpf(top.gravity)

    def measured(q, omega):
        x, y, z, w = q
        up = np.array((2 * (times(x, z) - times(w, y)), 2 * (times(y, z) + times(w, x)),
                       times(w, w) + times(z, z) - times(x, x) - times(y, y)))
        alpha = np.hstack((omega[:, 1:] * np.arange(1, ORDER), np.zeros((3, 1), object)))
        along, square = arm @ omega, sum(times(f, f) for f in omega)
        return (*omega, *(np.cross(alpha.T, arm).T + [times(f, along) for f in omega]
                          - np.outer(arm, square) + g * up))

    motion, seconds = Motion(top, start, measured, 6), mpf(case['length_ns']) / 10 ** 9
    motion.go_to(mpf(case['begin_ns']) / 10 ** 9)
    q, omega, first = motion.q, motion.omega, numbers(motion.quadratures)
    motion.go_to(motion.t + seconds)
    means = (numbers(motion.quadratures) - first) / seconds
    roll, pitch, yaw = case['rpy']
    mounting = product(product(about(2, yaw), about(1, pitch)), about(0, roll))
    change = (rotated(motion.q, np.cross(motion.omega, arm)) - rotated(q, np.cross(omega, arm))
              + numbers((0, 0, g * seconds)))
    of_body = conjugate(mounting)
    return {name: [nstr(x, 30) for x in found] for name, found in (
        ('dq', product(product(of_body, product(conjugate(q), motion.q)), mounting)),
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
            seconds, now = mpf(t - now) / 10 ** 9, t
            motion.go_to(motion.t + seconds)
            place = place + seconds * (velocity + seconds * numbers(acceleration) / 2)
            velocity = velocity + seconds * numbers(acceleration)
            if t in stops:
                point = place + rotated(motion.q, numbers(case['point']))
                found.append({name: [nstr(x, 30) for x in values] for name, values in (
                    ('q', np.roll(motion.q, 1)), ('omega', motion.omega),
                    ('alpha', motion.series()[1][:, 1]), ('position', point))})
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
