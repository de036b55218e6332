# SPDX-License-Identifier: Apache-2.0
"""
Make hard_cases.json: starts that are hard for a closed form, solved without one.

    pip install mpmath;  python make_hard_cases.py > hard_cases.json

Newton's and Euler's equations in the world frame, as Taylor series in long decimals: the
quaternion p of a frame that turns with L/lambda1 only, and the horizontal angular momentum,

    p' = (1/2) (L/lambda1) p,    L' = P e3 x z,

where q is p turned about its e3 at the uniform rate L3 (1/lambda3 - 1/lambda1).  phi and psi are
quadratures beside them; in half angles their rates have no term that cancels:

    phi' = ((Lz - L3)/(4 sin^2(theta/2)) + (Lz + L3)/(4 cos^2(theta/2)))/lambda1.

The step is a share of the radius of convergence, of the quadrature too, so that it resolves the
passage of a pole however close.  Every case is computed twice, with other digits, orders and
steps, and must agree to 1e-30.
"""

import json
import sys
from decimal import Decimal, getcontext
from operator import mul

import mpmath

# digits, order of the series, step over the radius of convergence
COARSE, FINE = (75, 48, Decimal('0.11')), (95, 60, Decimal('0.1'))
AGREE = Decimal('1e-30')

TIMES = (0.7, -1.3, 4.1, 11.9)


def case(name, theta, theta_dot, l3, lz, *, lambda1=0.131, lambda3=0.17, distance=0.15,
         phi=0.3, psi=-0.7, times=TIMES):
    """Return a case of a top of 2 kg; distance: of the centre of mass [m]."""
    return {'name': name, 'lambda1': lambda1, 'lambda3': lambda3, 'M': 2.0, 'R': distance,
            'g': 9.81, 'theta0': theta, 'thetadot0': theta_dot, 'phi0': phi, 'psi0': psi,
            'L3': l3, 'Lz': lz, 'times': list(times)}


CASES = [
    # A start next to the pole that is passed, hanging upside down: one root of the cubic is tiny.
    case('below, theta 3e-26', 3e-26, 10.0, -0.05, -0.05, distance=-0.15),
    case('below, theta 2e-28', 2e-28, 8.5, 0.12, 0.12, distance=-0.15),
    case('below, theta 2e-31', 2e-31, 8.5, 0.12, 0.12, distance=-0.15),
    case('below, theta 7e-44', 7e-44, 10.0, -0.05, -0.05, distance=-0.15),
    case('below, theta 1e-99', 1e-99, 8.5, 0.12, 0.12, distance=-0.15),
    case('next to pi', 3.1415926535897927, 8.5, 0.12, -0.12),
    # A start next to a turning point.
    case('theta_dot 5e-53', 2.271, -5.41e-53, -0.393, -0.994, lambda1=0.2737, lambda3=0.1609),
    case('theta_dot 6e-63', 2.366, 6.34e-63, -0.764, -0.366, lambda1=0.156, lambda3=0.284),
    case('theta_dot 2e-53', 1.193, 1.61e-53, -0.717, 0.811, lambda1=0.2352, lambda3=0.0908,
         distance=-0.15),
    case('theta_dot 8e-91', 2.095, -7.7e-91, -0.285, -0.484, lambda1=0.0454, lambda3=0.0612),
    case('theta_dot 2e-19', 2.79, 1.9e-19, 0.877, -0.824, lambda1=0.159, lambda3=0.074,
         distance=-0.15),
    # Past a pole at 1e-11 rad, half a quarter period from the start: theta' and the precession
    # there depend on the last digits of the phase.
    case('past the top 1', 1.373540131905947, -10.106, 0.765, 0.7650000000140897, lambda1=0.196,
         lambda3=0.178, phi=0.8, psi=1.4,
         times=(0.1418938855314753, 0.14189388553130503, 0.14189388553062393)),
    case('past the top 2', 1.0445874187174946, 8.102, 0.564, 0.5640000000079013, lambda1=0.061,
         lambda3=0.058, phi=0.8, psi=1.4,
         times=(-0.14311016380529526, -0.14311016380489455, -0.1431101638039214)),
    case('past the top 3', 1.1906552848871776, -9.131, 0.684, 0.6840000000148682, lambda1=0.097,
         lambda3=0.049, phi=0.8, psi=1.4,
         times=(0.13815953864642375, 0.13815953864609215, 0.13815953864448952)),
    case('past the top 4', 1.2, 10.5, 0.3, 0.3000000007, times=(0.7, -1.3)),
    # An unstable sleeper, and angles of many turns.
    case('nearly at rest', 3e-41, -2e-20, 0.1, 0.1),
    case('wide phi', 0.66, -0.078, -0.42, -0.38, phi=-1140.25, psi=2.5e6),
]


def dec(x):
    """Return a double, or a number of mpmath, as a decimal."""
    return Decimal(x) if isinstance(x, float) else Decimal(mpmath.nstr(x, mpmath.mp.dps))


def cos_sin(x):
    """Return the cosine and the sine of a decimal."""
    x = mpmath.mpf(str(x))
    return dec(mpmath.cos(x)), dec(mpmath.sin(x))


class Path:
    """One case, from t = 0 on or back; `at` takes times in order of their distance from 0."""

    def __init__(self, case, order, share):
        self.order, self.share = order, share
        names = ('lambda1', 'lambda3', 'theta0', 'thetadot0', 'phi0', 'psi0', 'L3', 'Lz')
        (self.lambda1, self.lambda3, theta, theta_dot, phi, psi, self.l3, self.lz) = (
            Decimal(case[name]) for name in names)
        self.fall = Decimal(case['M']) * Decimal(case['g']) * Decimal(case['R']) / self.lambda1
        c, s = cos_sin(theta / 2)
        cos_sum, sin_sum = cos_sin((phi + psi) / 2)
        cos_difference, sin_difference = cos_sin((phi - psi) / 2)
        cos_phi, sin_phi = cos_sin(phi)
        # L/lambda1 = theta' e2' + (L3/lambda1) e3 + phi' sin(theta) (e3 x e2')
        plus, minus = self.lz + self.l3, self.lz - self.l3
        around = ((plus * s / c if plus else 0) + (minus * c / s if minus else 0)
                  ) / 2 / self.lambda1
        outward = self.l3 / self.lambda1 * 2 * s * c - around * (c * c - s * s)
        self.t = Decimal(0)
        self.y = [c * cos_sum, -s * sin_difference, s * cos_difference, c * sin_sum,
                  outward * cos_phi - theta_dot * sin_phi,
                  outward * sin_phi + theta_dot * cos_phi, phi, psi]

    def _series(self):
        """Return the series of p (w, x, y, z), of L/lambda1 (x, y), of phi and of psi."""
        rows = [[value] for value in self.y]
        w, a, b, c, lx, ly, phi, psi = rows
        lz, fall = self.lz / self.lambda1, self.fall
        cos2, sin2, over_cos2, over_sin2, tilt = [], [], [], [], []
        to_cos, to_sin = ((self.lz + self.l3) / (4 * self.lambda1),
                          (self.lz - self.l3) / (4 * self.lambda1))
        phi_dot = []

        def times(f, g):
            return sum(map(mul, f, reversed(g)))

        def reciprocal(f, inverse):
            inverse.append(1 / f[0] if not inverse else
                           -sum(map(mul, f[1:], reversed(inverse))) / f[0])

        for k in range(self.order):
            cos2.append(times(w, w) + times(c, c))
            sin2.append(times(a, a) + times(b, b))
            tilt.append(cos2[-1] - sin2[-1])
            rate = Decimal(0)
            if to_cos:
                reciprocal(cos2, over_cos2)
                rate += to_cos * over_cos2[-1]
            if to_sin:
                reciprocal(sin2, over_sin2)
                rate += to_sin * over_sin2[-1]
            phi_dot.append(rate)
            new = (((-times(lx, a) - times(ly, b)) - lz * c[k]) / 2,
                   ((times(lx, w) + times(ly, c)) - lz * b[k]) / 2,
                   ((times(ly, w) - times(lx, c)) + lz * a[k]) / 2,
                   ((times(lx, b) - times(ly, a)) + lz * w[k]) / 2,
                   -2 * fall * (times(b, c) - times(w, a)),
                   2 * fall * (times(a, c) + times(w, b)),
                   rate, -times(phi_dot, tilt))
            for row, value in zip(rows, new, strict=True):
                row.append(value / (k + 1))
        psi[1] += self.l3 / self.lambda3
        return rows

    def _radius(self, rows):
        """Return the radius of convergence, from the last terms of three kinds of unknowns."""
        radii = []
        for group, first in ((rows[:4], 0), (rows[4:6], 0), (rows[6:], 1)):
            scale = max(abs(row[first]) for row in group)
            for k in (self.order - 1, self.order):
                last = max(abs(row[k]) for row in group)
                if last and scale:
                    radii.append((scale / last) ** (Decimal(1) / (k - first)))
        return min(radii, default=Decimal(1000))

    def at(self, t):
        """Return theta, theta', phi, psi, and q as w, x, y, z."""
        t = Decimal(t)
        while self.t != t:
            rows = self._series()
            step = self.share * self._radius(rows)
            left = t - self.t
            if step >= abs(left):
                self.t, step = t, left
            else:
                step = step if left > 0 else -step
                self.t += step
            self.y = [self._horner(row, step) for row in rows]
        return self._state()

    @staticmethod
    def _horner(row, step):
        value = Decimal(0)
        for term in reversed(row):
            value = value * step + term
        return value

    def _state(self):
        (w, a, b, c, lx, ly, phi, psi), lz = self.y, self.lz / self.lambda1
        size = (w * w + a * a + b * b + c * c).sqrt()
        assert abs(size - 1) < AGREE
        cosine, sine = cos_sin(self.l3 * (1 / self.lambda3 - 1 / self.lambda1) / 2 * self.t)
        spun = [(row[0] * cosine - row[3] * sine, row[1] * cosine + row[2] * sine,
                 row[2] * cosine - row[1] * sine, row[3] * cosine + row[0] * sine)
                for row in ((w, a, b, c),
                            # p' of the equations above
                            ((-lx * a - ly * b - lz * c) / 2, (lx * w + ly * c - lz * b) / 2,
                             (ly * w - lx * c + lz * a) / 2, (lx * b - ly * a + lz * w) / 2))]
        (w, x, y, z), (dw, dx, dy, dz) = spun
        # alpha = w + iz = cos(theta/2) exp(i(phi+psi)/2), beta = y - ix = sin(theta/2) exp(..)
        cos_sum, sin_sum = cos_sin((phi + psi) / 2)
        cos_difference, sin_difference = cos_sin((phi - psi) / 2)
        alpha = w * cos_sum + z * sin_sum, z * cos_sum - w * sin_sum
        beta = y * cos_difference - x * sin_difference, -x * cos_difference - y * sin_difference
        assert abs(alpha[1]) < AGREE and abs(beta[1]) < AGREE, 'attitude and angles part'
        theta = 2 * dec(mpmath.atan2(mpmath.mpf(str(beta[0])), mpmath.mpf(str(alpha[0]))))
        # The spin about e3 only turns the phases of alpha' and beta', which are projected here.
        theta_dot = 2 * ((dy * cos_difference - dx * sin_difference) * alpha[0]
                         - (dw * cos_sum + dz * sin_sum) * beta[0])
        return [theta, theta_dot, phi, psi, w, x, y, z]


def solved(case, digits, order, share):
    """Return the states at the case's times."""
    getcontext().prec = mpmath.mp.dps = digits
    states = {}
    for sign in (1, -1):
        path = Path(case, order, share)
        for t in sorted((t for t in case['times'] if t * sign > 0), key=abs):
            states[t] = path.at(t)
    return [states[t] for t in case['times']]


def main():
    made = []
    for case in CASES:
        coarse, fine = solved(case, *COARSE), solved(case, *FINE)
        for one, two in zip(coarse, fine, strict=True):
            worst = max(abs(a - b) / max(1, abs(b)) for a, b in zip(one, two, strict=True))
            assert worst < AGREE, (case['name'], worst)
        texts = [[format(+value, '.28e') for value in state] for state in fine]
        made.append({**case, 'states': [
            {'t': t, 'theta': state[0], 'thetadot': state[1], 'phi': state[2], 'psi': state[3],
             'q': state[4:]} for t, state in zip(case['times'], texts, strict=True)]})
        print(case['name'], file=sys.stderr, flush=True)
    cases = ',\n'.join(json.dumps(case, separators=(',', ':')) for case in made)
    print('{"note":"q is w x y z; made by make_hard_cases.py","cases":[\n' + cases + '\n]}')


if __name__ == '__main__':
    main()
