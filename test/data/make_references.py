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

from helpers.reference import scene_parameters, start_of, top_of
from mpmath import atan2, cos, cot, expj, fdot, mp, mpc, mpf, nstr, polyval, sin, tan

from spinning_top_sim import State, Top
from spinning_top_sim.streams import parameters

mp.dps = 60
ORDER, SHARE = 50, mpf('0.1')     # of a series, and a step over its radius of convergence
HERE = Path(__file__).parent


def product(p, q):
    """Return p q of quaternions x, y, z, w."""
    (a, b, c, d), (x, y, z, w) = p, q
    return [d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z]


def conjugate(q):
    return [-q[0], -q[1], -q[2], q[3]]


def rotated(q, v):
    return product(product(q, [*v, mpf(0)]), conjugate(q))[:3]


def about(axis, angle):
    half = mpf(angle) / 2
    return [sin(half) * (k == axis) for k in range(3)] + [cos(half)]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def times(f, g):
    """Return the series of the product of two series."""
    return [fdot(f[:k + 1], g[k::-1]) for k in range(ORDER)]


def reciprocal(f):
    inverse = [1 / f[0]]
    for k in range(1, ORDER):
        inverse.append(-fdot(f[1:k + 1], reversed(inverse)) / f[0])
    return inverse


def combined(*terms):
    """Return the sum of factor * series."""
    return [sum(factor * f[k] for factor, f in terms) for k in range(ORDER)]


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
        self.omega = [omega.real, omega.imag, mpf(start.l3) / self.lambda3]

    def push(self, acceleration):
        """Let the pivot accelerate so; keep the force times the distance of the mass."""
        a, b, c = map(mpf, acceleration)
        self.force = [-self.moment * part for part in (a, b, c + self.gravity)]

    def go_to(self, t):
        """Integrate forwards or backwards."""
        while self.t != t:
            q, omega = self.series()
            rates = self.rates(q, omega)
            step = SHARE * min(radius(group) for group in (q, omega, rates) if group)
            step = t - self.t if step >= abs(t - self.t) else step if t > self.t else -step
            self.t = t if step == t - self.t else self.t + step
            self.q, self.omega = ([polyval(f[::-1], step) for f in group] for group in (q, omega))
            self.quadratures = [value + step * polyval(
                [c / (k + 1) for k, c in enumerate(f)][::-1], step)
                for value, f in zip(self.quadratures, rates, strict=True)]

    def series(self):
        """Return the Taylor series of q and omega."""
        def term(f, g, k):
            return fdot(f[:k + 1], g[k::-1])

        x, y, z, w = q = [[value] for value in self.q]
        o1, o2, o3 = omega = [[value] for value in self.omega]
        gyroscopic = (self.lambda1 - self.lambda3) * o3[0]
        for k in range(ORDER):
            xx, yy, zz, ww = (term(f, f, k) for f in q)
            xy, xz, xw = term(x, y, k), term(x, z, k), term(x, w, k)
            yz, yw, zw = term(y, z, k), term(y, w, k), term(z, w, k)
            # Components 1 and 2 in the body of the force at (0, 0, 1).
            f1 = fdot(self.force, (ww + xx - yy - zz, 2 * (xy + zw), 2 * (xz - yw)))
            f2 = fdot(self.force, (2 * (xy - zw), ww - xx + yy - zz, 2 * (yz + xw)))
            new = ((term(w, o1, k) + term(y, o3, k) - term(z, o2, k)) / 2,
                   (term(w, o2, k) + term(z, o1, k) - term(x, o3, k)) / 2,
                   (term(w, o3, k) + term(x, o2, k) - term(y, o1, k)) / 2,
                   -(term(x, o1, k) + term(y, o2, k) + term(z, o3, k)) / 2,
                   (gyroscopic * o2[k] - f2) / self.lambda1,
                   (f1 - gyroscopic * o1[k]) / self.lambda1, mpf(0))
            for f, rate in zip((*q, *omega), new, strict=True):
                f.append(rate / (k + 1))
        return q, omega


def radius(group):
    """Return the radius of convergence of series, from two of their last terms."""
    first = max(abs(f[0]) for f in group)
    found = [(first / last) ** (mpf(1) / k) for k in (ORDER - 2, ORDER - 1)
             if (last := max(abs(f[k]) for f in group)) and first]
    return min(found, default=mpf(1000))


def states(case):
    """Return the states of a hard case at its times."""
    top, start, found = top_of(case), start_of(case), {}
    plus, minus = mpf(start.lz) + mpf(start.l3), mpf(start.lz) - mpf(start.l3)

    def rates(q, omega):
        x, y, z, w = q
        sine2 = combined((1, times(x, x)), (1, times(y, y)))
        cosine2 = combined((1, times(z, z)), (1, times(w, w)))
        phi_dot = combined(*((momentum / (4 * mpf(top.lambda1)), reciprocal(square))
                             for momentum, square in ((minus, sine2), (plus, cosine2))
                             if momentum))
        height = combined((1, cosine2), (-1, sine2))
        return phi_dot, combined((1, omega[2]), (-1, times(phi_dot, height)))

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
    arm, g = [mpf(x) for x in case['lever_arm']], mpf(top.gravity)

    def measured(q, omega):
        x, y, z, w = q
        up = (combined((2, times(x, z)), (-2, times(w, y))),
              combined((2, times(y, z)), (2, times(w, x))),
              combined((1, times(w, w)), (1, times(z, z)), (-1, times(x, x)), (-1, times(y, y))))
        along = combined(*zip(arm, omega, strict=True))
        square = combined(*((1, times(f, f)) for f in omega))
        alpha = [[(k + 1) * f[k + 1] for k in range(ORDER)] for f in omega]
        force = [combined((arm[b], alpha[a]), (-arm[a], alpha[b]), (1, times(omega[i], along)),
                          (-arm[i], square), (g, up[i]))
                 for i, a, b in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
        return *omega, *force

    motion, seconds = Motion(top, start, measured, 6), mpf(case['length_ns']) / 10 ** 9
    motion.go_to(mpf(case['begin_ns']) / 10 ** 9)
    q, omega, first = motion.q, motion.omega, motion.quadratures
    motion.go_to(motion.t + seconds)
    q1, omega1, last = motion.q, motion.omega, motion.quadratures
    roll, pitch, yaw = case['rpy']
    mounting = product(product(about(2, yaw), about(1, pitch)), about(0, roll))
    change = [b - a for a, b in zip(
        rotated(q, cross(omega, arm)), rotated(q1, cross(omega1, arm)), strict=True)]
    change[2] += g * seconds
    means = [(b - a) / seconds for a, b in zip(first, last, strict=True)]
    of_body = conjugate(mounting)
    return {name: [nstr(x, 30) for x in numbers] for name, numbers in (
        ('dq', product(product(of_body, product(conjugate(q), q1)), mounting)),
        ('dv', rotated(conjugate(product(q, mounting)), change)),
        ('rates', rotated(of_body, means[:3])), ('force', rotated(of_body, means[3:])))}


def ride(case):
    """Return the states of a case with a moving pivot: q, omega, alpha, and where a point is."""
    motion, found, now = Motion(Top(**case['top']), State(**case['start'])), [], 0
    place, velocity = ([mpf(x) for x in case[name]] for name in ('position', 'velocity'))
    for length, acceleration in (*case['pieces'], (10 ** 18, 3 * [0.0])):
        motion.push(acceleration)
        stops = [t for t in case['times_ns'] if now <= t < now + length]
        for t in (*stops, now + length):
            if len(found) == len(case['times_ns']):
                return found
            seconds, now = mpf(t - now) / 10 ** 9, t
            motion.go_to(motion.t + seconds)
            for k, a in enumerate(map(mpf, acceleration)):
                place[k] += seconds * (velocity[k] + seconds * a / 2)
                velocity[k] += seconds * a
            if t in stops:
                q, omega = motion.series()
                point = rotated(motion.q, list(map(mpf, case['point'])))
                found.append({name: [nstr(x, 30) for x in values] for name, values in (
                    ('q', (motion.q[3], *motion.q[:3])), ('omega', motion.omega),
                    ('alpha', [f[1] for f in omega]),
                    ('position', [p + r for p, r in zip(place, point, strict=True)]))})
    raise AssertionError('a time is behind the end')


def write(name, head, rows, tail):
    lines = ',\n'.join(json.dumps(row, separators=(',', ':')) for row in rows)
    (HERE / name).write_text(f'{head}[\n{lines}\n]{tail}\n')


def main():
    hard = json.loads((HERE / 'hard_cases.json').read_text())
    cases = [{**case, 'states': states(case)} for case in hard['cases']]
    write('hard_cases.json', '{"note":"q is w x y z; made by make_references.py","cases":', cases,
          '}')
    rows = json.loads((HERE / 'increments.json').read_text())
    write('increments.json', '', [{**row, **increments(row)} for row in rows], '')
    rides = json.loads((HERE / 'ride.json').read_text())['cases']
    write('ride.json', '{"note":"q is w x y z; made by make_references.py","cases":',
          [{**case, 'states': ride(case)} for case in rides], '}')


if __name__ == '__main__':
    main()
