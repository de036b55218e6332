# SPDX-License-Identifier: Apache-2.0
"""
Compute ride.json: a top on a moving pivot, to 30 digits.

    pip install mpmath;  python test/data/make_ride_references.py

In the frame of the pivot the force m (g - a) acts at the centre of mass.  Newton's and Euler's
equations and the quaternion of the body in the world are integrated by Taylor series: no Euler
angle, no other frame, and nothing of the package.  Two orders and steps agree in all digits that
are written.
"""

import json
import random
from pathlib import Path

from mpmath import cos, cot, fdot, mp, mpf, nstr, polyval, sin, sqrt, tan

HERE = Path(__file__).parent
G = 9.80665
SLOW = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': G}
FAST = {'lambda1': 0.002, 'lambda3': 0.001, 'mass': 0.5, 'com_distance': 0.05, 'gravity': G}


def product(p, q):
    """Return p q of quaternions x, y, z, w."""
    (a, b, c, d), (x, y, z, w) = p, q
    return [d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z]


def about(axis, angle):
    half = mpf(angle) / 2
    return [sin(half) * (k == axis) for k in range(3)] + [cos(half)]


class Body:
    """The top as a rigid body: q (x, y, z, w) and omega in the body, at the time t."""

    def __init__(self, top, start, order, share):
        self.order, self.share = order, mpf(share)
        self.lambda1, self.lambda3 = mpf(top['lambda1']), mpf(top['lambda3'])
        self.mass, self.distance = mpf(top['mass']), mpf(top['com_distance'])
        self.gravity = mpf(top['gravity'])
        theta, phi, psi = (start[name] for name in ('theta', 'phi', 'psi'))
        self.q = product(product(about(2, phi), about(1, theta)), about(2, psi))
        l3, lz, half = mpf(start['l3']), mpf(start['lz']), mpf(theta) / 2
        swing = (((lz + l3) * tan(half) if lz + l3 else 0)
                 + ((lz - l3) * cot(half) if lz - l3 else 0)) / (2 * self.lambda1)
        c, s, rate = cos(mpf(psi)), sin(mpf(psi)), mpf(start['theta_dot'])
        self.omega = [rate * s - swing * c, rate * c + swing * s, l3 / self.lambda3]

    def series(self, acceleration):
        """Return the Taylor series of q and omega while the pivot accelerates so."""
        force = [-self.mass * mpf(a) for a in acceleration]
        force[2] -= self.mass * self.gravity

        def term(f, g, k):
            return fdot(f[:k + 1], g[k::-1])

        x, y, z, w = q = [[value] for value in self.q]
        o1, o2, o3 = omega = [[value] for value in self.omega]
        spin, ratio = o3[0], self.lambda1 - self.lambda3
        for k in range(self.order):
            xx, yy, zz, ww = (term(f, f, k) for f in q)
            xy, xz, xw = term(x, y, k), term(x, z, k), term(x, w, k)
            yz, yw, zw = term(y, z, k), term(y, w, k), term(z, w, k)
            # Components 1 and 2 in the body of the force at (0, 0, distance).
            f1 = (ww + xx - yy - zz) * force[0] + 2 * (xy + zw) * force[1] \
                + 2 * (xz - yw) * force[2]
            f2 = 2 * (xy - zw) * force[0] + (ww - xx + yy - zz) * force[1] \
                + 2 * (yz + xw) * force[2]
            new = ((term(w, o1, k) + spin * y[k] - term(z, o2, k)) / 2,
                   (term(w, o2, k) + term(z, o1, k) - spin * x[k]) / 2,
                   (spin * w[k] + term(x, o2, k) - term(y, o1, k)) / 2,
                   -(term(x, o1, k) + term(y, o2, k) + spin * z[k]) / 2,
                   (ratio * spin * o2[k] - self.distance * f2) / self.lambda1,
                   (-ratio * spin * o1[k] + self.distance * f1) / self.lambda1, mpf(0))
            for f, rate in zip((*q, *omega), new, strict=True):
                f.append(rate / (k + 1))
        return q, omega

    def go_on(self, seconds, acceleration):
        while True:
            q, omega = self.series(acceleration)
            step = self.share * min(self.radius(q), self.radius(omega))
            last = step >= seconds
            step = seconds if last else step
            self.q, self.omega = ([polyval(f[::-1], step) for f in group] for group in (q, omega))
            if last:
                return
            seconds -= step

    def radius(self, group):
        first = max(abs(f[0]) for f in group)
        found = [(first / size) ** (mpf(1) / k) for k in (self.order - 1, self.order)
                 if (size := max(abs(f[k]) for f in group)) and first]
        return min(found, default=mpf(1000))

    def in_world(self, v):
        x, y, z, w = self.q
        conjugate = [-x, -y, -z, w]
        return product(product(self.q, [*map(mpf, v), mpf(0)]), conjugate)[:3]


def states(case, order=60, share='0.12'):
    """Return q (w, x, y, z), omega, alpha and the position of the point at the times of a case."""
    body, found = Body(case['top'], case['start'], order, share), []
    place, velocity = ([mpf(x) for x in case[name]] for name in ('position', 'velocity'))
    times, now = list(case['times_ns']), 0
    pieces = [*case['pieces'], [10 ** 18, [0.0, 0.0, 0.0]]]
    for length, acceleration in pieces:
        end = now + length
        while times and now <= times[0] and (times[0] < end):
            now = advance(body, place, velocity, acceleration, now, times.pop(0))
            q, omega = body.series(acceleration)
            found.append({
                'q': [f[0] for f in (q[3], *q[:3])], 'omega': [f[0] for f in omega],
                'alpha': [f[1] for f in omega],
                'position': [p + r for p, r in zip(place, body.in_world(case['point']),
                                                   strict=True)]})
        if not times:
            break
        now = advance(body, place, velocity, acceleration, now, end)
    return found


def advance(body, place, velocity, acceleration, now, end):
    seconds = mpf(end - now) / 10 ** 9
    if seconds:
        body.go_on(seconds, acceleration)
    for k, a in enumerate(map(mpf, acceleration)):
        place[k] += seconds * (velocity[k] + seconds * a / 2)
        velocity[k] += seconds * a
    return end


def toward(theta, phi, size):
    """Return the acceleration that makes the effective vertical so inclined, in doubles."""
    return [float(size * sin(theta) * cos(phi)), float(size * sin(theta) * sin(phi)),
            float(size * cos(theta) - mpf(G))]


def made(name, top, start, pieces, times, **more):
    start = {'theta': 0.5, 'theta_dot': 0.0, 'phi': 0.0, 'psi': 0.0, 'l3': 0.0, 'lz': 0.0, **start}
    return {'name': name, 'top': top, 'start': start, 'position': [0.0, 0.0, 0.0],
            'velocity': [0.0, 0.0, 0.0], 'point': [0.02, -0.01, 0.3],
            'pieces': [[round(t * 1e9), a] for t, a in pieces],
            'times_ns': [round(t * 1e9) for t in times], **more}


def cases():
    general = {'theta': 0.5, 'theta_dot': 0.3, 'phi': 0.1, 'psi': 0.2, 'l3': 1.6, 'lz': 1.3}
    rest = [0.0, 0.0, 0.0]
    for degrees in (1, 30, 60, 90):
        a = toward(mpf(degrees) * mp.pi / 180, mpf('0.4'), G / cos(mpf(degrees) * mp.pi / 180)
                   if degrees < 90 else mpf(12))
        back = [-x for x in a] if degrees < 90 else toward(mp.pi / 2, mpf('3.5'), mpf(12))
        yield made(f'vertical turned by {degrees} deg', SLOW, general,
                   [(0.7, a), (0.4, rest), (0.7, back), (0.3, rest), (0.55, [1.5, -2.0, 0.5])],
                   (0.2, 0.7, 0.9, 1.3, 1.8, 2.2, 2.65, 4.0), velocity=[0.3, 0.0, -0.1])
    yield made('free fall', SLOW, general,
               [(0.5, rest), (1.2, [0.0, 0.0, -G]), (0.3, [0.0, 0.0, 2.5 * G]),
                (0.5, [0.0, 0.0, -G])], (0.4, 0.5, 1.1, 1.69, 1.9, 2.3, 3.5),
               point=[0.0, 0.0, 0.3])
    n = mpf(0.6), mpf(0.3)
    tilted = {'theta': 0.6, 'theta_dot': 0.0, 'phi': 0.3, 'psi': -0.4, 'l3': 1.1,
              'lz': float(mpf(1.1) * cos(mpf(0.6)))}
    for name, offset in (('on the new vertical', 0), ('1e-3 rad from the new vertical', '1e-3'),
                         ('1e-7 rad from the new vertical', '1e-7'),
                         ('1e-9 rad from the new vertical', '1e-9')):
        a = toward(n[0] + mpf(offset), n[1], mpf(12))
        yield made(f'axis {name}', SLOW, tilted, [(0.8, a), (0.5, rest), (0.4, [2.0, 1.0, 0.0])],
                   (0.3, 0.8, 1.0, 1.3, 1.6, 2.5))
    down = [0.0, 0.0, -2 * G]
    yield made('upside down', SLOW, general, [(0.6, down), (0.6, [0.0, 0.0, 2 * G]), (0.3, down),
                                              (0.3, [1e-9, 0.0, -2 * G])],
               (0.3, 0.6, 0.9, 1.2, 1.4, 1.8, 3.0))
    yield made('upside down at the pole, axis moving', SLOW,
               {'theta': 0.0, 'theta_dot': 0.8, 'phi': 0.7, 'psi': 0.2, 'l3': 0.9, 'lz': 0.9},
               [(0.5, down), (0.5, rest), (0.25, [0.0, 3.0, 0.0])], (0.25, 0.5, 0.9, 1.2, 2.0))
    asleep = {'theta': 0.0, 'phi': 0.7, 'psi': 0.2, 'l3': 1.6, 'lz': 1.6}
    yield made('sleeping top pushed', SLOW, asleep,
               [(0.3, rest), (0.2, [0.0, 0.0, 1.0]), (0.2, [0.5, 0.0, 0.0]),
                (0.2, [-0.5, 0.0, 0.0]), (0.3, [0.0, 0.0, -1.0])], (0.2, 0.45, 0.6, 0.8, 1.1, 2.5))
    yield made('unstable sleeper pushed', SLOW, {**asleep, 'l3': 0.7, 'lz': 0.7},
               [(0.3, rest), (0.2, [0.0, 1e-3, 0.0]), (0.3, [0.0, -1e-3, 0.0])],
               (0.2, 0.5, 0.8, 1.4, 2.0))
    hanging = {'theta': 3.141592653589793, 'phi': 0.7, 'psi': 0.2, 'l3': 0.6, 'lz': -0.6}
    yield made('hanging top shaken', SLOW, hanging,
               [(0.3, rest), (0.4, [3.0, 0.0, 0.0]), (0.4, [-3.0, 0.0, 0.0]), (0.2, down)],
               (0.2, 0.5, 0.9, 1.2, 2.0))
    yield made('fast top', FAST, {'theta': 0.5235987755982988, 'l3': 0.2,
                                  'lz': float(mpf(0.2) * cos(mpf(0.5235987755982988)))},
               [(0.2, [3.0, 0.0, 0.0]), (0.2, rest), (0.2, [-3.0, 0.0, 0.0]),
                (0.1, [0.0, 4.0, -2.0])], (0.1, 0.2, 0.35, 0.6, 0.65, 1.0))
    # Almost without spin, with the energy of the separatrix: theta decays, and then grows.
    w = sqrt(mpf(2.0) * mpf(G) * mpf(0.15) / mpf(0.123))
    yield made('slow, near the separatrix', SLOW,
               {'theta': 1.0, 'theta_dot': -float(2 * w * sin(mpf('0.5'))), 'l3': 1e-3,
                'lz': 1e-3},
               [(0.9, rest), (0.3, [0.02, 0.0, 0.0]), (0.3, [-0.02, 0.0, 0.0]),
                (0.5, [0.0, 1.0, 0.0])],
               (0.5, 0.9, 1.2, 1.5, 1.9, 2.2))


def thousand():
    """Return a case with 1000 changes of acceleration in 120 s."""
    chance = random.Random(1)
    pieces = []
    for _ in range(500):
        a = [round(chance.uniform(-4.0, 4.0), 3) for _ in range(2)] + [round(
            chance.uniform(-3.0, 3.0), 3)]
        length = chance.randrange(40, 200) * 10 ** 6 + chance.randrange(10 ** 6)
        pieces += [[length, a], [length, [-x for x in a]]]
    end = sum(length for length, _ in pieces)
    case = made('1000 changes', SLOW, {'theta': 0.5, 'theta_dot': 0.3, 'phi': 0.1, 'psi': 0.2,
                                       'l3': 3.2, 'lz': 2.7}, [], [])
    return {**case, 'pieces': pieces, 'times_ns': [end // 10, end // 2, end]}


def shown(found):
    return [{name: [nstr(x, 30) for x in values] for name, values in one.items()} for one in found]


def agreed(case):
    """Return the states to 30 digits, which two computations agree in."""
    mp.dps = 60
    first = states(case)
    mp.dps = 50
    second = states(case, 48, '0.08')
    worst = max(abs(a - b) for one, other in zip(first, second, strict=True)
                for name in one for a, b in zip(one[name], other[name], strict=True))
    print(f'{case["name"]}: two computations differ by {nstr(worst, 2)}', flush=True)
    assert worst < mpf(10) ** -31
    mp.dps = 60
    return {**case, 'states': shown(first)}


def main():
    mp.dps = 60
    rows = [agreed(case) for case in (*cases(), thousand())]
    lines = ',\n'.join(json.dumps(row, separators=(',', ':')) for row in rows)
    (HERE / 'ride.json').write_text(
        f'{{"note":"q is w x y z; made by make_ride_references.py","cases":[\n{lines}\n]}}\n')


if __name__ == '__main__':
    main()
