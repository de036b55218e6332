# SPDX-License-Identifier: Apache-2.0
"""
Writes increments.json: what an IMU measures between two samples, in 30 digits.

    pip install mpmath;  PYTHONPATH=.:test python test/data/make_increments.py

Taylor series of Euler's equations and of the quaternion, in 45 digits, share no formula with the
package.  The rotation increment is that of the attitudes at both ends, the velocity increment that
of the velocities there; the means are integrals of the series.
"""

import json
from pathlib import Path

import mpmath
from helpers.reference import scene_parameters
from mpmath import mp, mpf

from spinning_top_sim.streams import parameters

mp.dps = 45
ORDER = 30
LENGTHS_NS = (5_000_000, 100_000)
# Scene, lever arm [m], mounting [rad], begin of the intervals [ns].
CASES = (
    ('cusp', (0.1, -0.2, 0.3), (0.0, 0.0, 0.0), 1_000_000_000),
    ('looping', (0.0, 0.0, 0.0), (0.1, 0.2, 0.3), 730_000_000),
    ('wavy', (0.05, 0.0, 0.0), (3.0, 0.0, 0.0), 1_500_000_000),
    ('steady_slow', (0.0, 0.3, -0.1), (0.0, -1.2, 0.4), 500_000_000),
    ('steady_fast', (-0.2, 0.02, 0.1), (1.0, 1.0, -2.0), 250_000_000),
    ('near_separatrix', (0.1, 0.1, 0.1), (0.0, 0.0, 1.5), 900_000_000),
    ('spherical_pendulum', (0.0, 0.0, 0.5), (0.3, -0.7, 1.9), 1_200_000_000),
    ('planar_pendulum', (0.3, 0.0, 0.0), (0.5, 0.0, 0.0), 1_000_000_000),
    ('free_top', (0.07, -0.01, 0.2), (-0.4, 0.2, 0.0), 640_000_000),
    ('fast_gyroscope', (0.02, 0.01, 0.05), (0.2, 0.2, 0.2), 300_000_000),
    ('heavy_top', (0.1, 0.0, -0.1), (-1.0, 0.5, 2.5), 800_000_000),
)


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
    return [mpmath.sin(half) * (k == axis) for k in range(3)] + [mpmath.cos(half)]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


class Body:
    """A top from its start: q, omega, and the integrals of omega and of the specific force."""

    def __init__(self, top, start, arm):
        self.lambda1, self.lambda3 = mpf(top.lambda1), mpf(top.lambda3)
        self.gravity, self.arm = mpf(top.gravity), [mpf(x) for x in arm]
        self.torque = mpf(top.mass) * self.gravity * mpf(top.com_distance)
        theta, psi, l3 = mpf(start.theta), mpf(start.psi), mpf(start.l3)
        self.q = product(product(about(2, start.phi), about(1, start.theta)), about(2, start.psi))
        across = (mpf(start.lz) - l3 * mpmath.cos(theta)) / (self.lambda1 * mpmath.sin(theta))
        omega = mpmath.mpc(-across, start.theta_dot) * mpmath.expj(-psi)
        self.omega = [omega.real, omega.imag, l3 / self.lambda3]
        self.angle, self.force = 3 * [mpf(0)], 3 * [mpf(0)]

    def advance(self, time):
        """Go on by a time [s], in steps of a small part of a turn."""
        rate = sum(abs(x) for x in self.omega) + mpmath.sqrt(abs(self.torque) / self.lambda1)
        steps = int(time * rate / mpf('0.15')) + 1
        for _ in range(steps):
            self._step(time / steps)

    def velocity(self):
        """Return that of the lever arm's end in the world [m/s]."""
        return rotated(self.q, cross(self.omega, self.arm))

    def _step(self, h):
        def times(f, g, k):
            return mpmath.fdot(f[:k + 1], reversed(g[:k + 1]))
        x, y, z, w = ([value] for value in self.q)
        o1, o2, o3 = ([value] for value in self.omega)
        gyroscopic = (self.lambda1 - self.lambda3) * o3[0]
        up = [], [], []
        for k in range(ORDER):
            up[0].append(2 * (times(x, z, k) - times(w, y, k)))
            up[1].append(2 * (times(y, z, k) + times(w, x, k)))
            up[2].append(times(w, w, k) + times(z, z, k) - times(x, x, k) - times(y, y, k))
            n = 2 * (k + 1)
            o3.append(mpf(0))
            x.append((times(w, o1, k) + times(y, o3, k) - times(z, o2, k)) / n)
            y.append((times(w, o2, k) + times(z, o1, k) - times(x, o3, k)) / n)
            z.append((times(w, o3, k) + times(x, o2, k) - times(y, o1, k)) / n)
            w.append(-(times(x, o1, k) + times(y, o2, k) + times(z, o3, k)) / n)
            o1.append((gyroscopic * o2[k] + self.torque * up[1][k]) / self.lambda1 / (k + 1))
            o2.append(-(gyroscopic * o1[k] + self.torque * up[0][k]) / self.lambda1 / (k + 1))
        omega = o1, o2, o3
        for axis in range(3):
            force = []
            for k in range(ORDER):
                acceleration = [(k + 1) * part[k + 1] for part in omega]
                square = sum(times(part, part, k) for part in omega)
                along = sum(times(omega[axis], part, k) * r
                            for part, r in zip(omega, self.arm, strict=True))
                force.append(cross(acceleration, self.arm)[axis] + along
                             - square * self.arm[axis] + self.gravity * up[axis][k])
            self.angle[axis] += sum(c * h ** (k + 1) / (k + 1)
                                    for k, c in enumerate(omega[axis][:-1]))
            self.force[axis] += sum(c * h ** (k + 1) / (k + 1) for k, c in enumerate(force))
        self.q = [mpmath.polyval(c[::-1], h) for c in (x, y, z, w)]
        self.omega = [mpmath.polyval(c[::-1], h) for c in omega]


def case(scene, arm, rpy, begin_ns):
    values = parameters.checked(scene_parameters(scene))
    top, start = parameters.top_of(values), parameters.start_state(values)
    mounting = product(product(about(2, rpy[2]), about(1, rpy[1])), about(0, rpy[0]))
    body = Body(top, start, arm)
    body.advance(mpf(begin_ns) / 10 ** 9)
    first, begin = body.q, [list(x) for x in (body.q, body.velocity())]
    result = []
    for length_ns in sorted(LENGTHS_NS):
        one = Body(top, start, arm)
        one.q, one.omega = list(first), list(body.omega)
        seconds = mpf(length_ns) / 10 ** 9
        one.advance(seconds)
        dq = product(product(conjugate(mounting), product(conjugate(first), one.q)), mounting)
        change = [b - a for a, b in zip(begin[1], one.velocity(), strict=True)]
        change[2] += one.gravity * seconds
        back = conjugate(product(first, mounting))
        of_body = conjugate(mounting)
        result.append({
            'scene': scene, 'lever_arm': arm, 'rpy': rpy, 'begin_ns': begin_ns,
            'length_ns': length_ns, **{name: [mpmath.nstr(x, 30) for x in numbers]
                                       for name, numbers in (
                ('dq', dq), ('dv', rotated(back, change)),
                ('rates', rotated(of_body, [x / seconds for x in one.angle])),
                ('force', rotated(of_body, [x / seconds for x in one.force])))}})
    return result


if __name__ == '__main__':
    rows = [row for arguments in CASES for row in case(*arguments)]
    Path(__file__).with_name('increments.json').write_text(
        '[\n' + ',\n'.join(json.dumps(row, separators=(',', ':')) for row in rows) + '\n]\n')
