# SPDX-License-Identifier: Apache-2.0
"""
An independent integration of many tops at once: Taylor series of high order, in long doubles.

Newton and Euler in the world frame, no Euler angle and none of the package's formulas: the
quaternion p of a frame that turns with L/lambda1 only, and L itself,

    p' = (1/2) (L/lambda1) p,    L' = -P z x ... = torque of the weight,    n = p e3 p*

q is p turned about its e3 by the uniform rate L3 (1/lambda3 - 1/lambda1).  Every right-hand side
is a product of two unknowns, so the series follow from products of series.  The step is a share of
the radius of convergence (Jorba & Zou, Experimental Mathematics 14 (2005) 99-117).
"""

import numpy as np

LONG = np.longdouble
ORDER = 24
MOST_STEPS = 20_000


class Path:
    """
    What many tops do: `samples` (tops, times, 7) of p (w, x, y, z) and L/lambda1, at `times`.

    share: of the radius of convergence, a step; e^-2 leaves e^-(2 * 24), below a long double
    nudge: moves the start by so many roundings of a long double, of 1 in p, of its scale in L:
    more than all roundings on the way do together, so that the distance shows their effect
    way: of two, across each other; by one alone a start may stay on the path that is not left
    """

    WAYS = ((1, -1, -1, 1, 1, -1, 1), (1, 1, -1, -1, 1, 1, -1))

    def __init__(self, cases, times, share, nudge=0.0, way=0):
        self.nudge = np.array(self.WAYS[way]) * nudge * np.finfo(LONG).eps
        self.cases, self.times = cases, np.asarray(times, LONG)
        self.lambda1 = _column(cases, lambda c: LONG(c.top.lambda1))
        self.fall = _column(cases, lambda c: LONG(c.top.mass) * LONG(c.top.gravity)
                            * LONG(c.top.com_distance) / LONG(c.top.lambda1))
        self.l3, self.lz = (_column(cases, lambda c, n=n: LONG(getattr(c.start, n)))
                            for n in ('l3', 'lz'))
        self.theta, self.theta_dot, self.phi, self.psi = (
            _column(cases, lambda c, n=n: LONG(getattr(c.start, n)))
            for n in ('theta', 'theta_dot', 'phi', 'psi'))
        self.samples = self._run(share)

    def _start(self):
        c, s = np.cos(self.theta / 2), np.sin(self.theta / 2)
        half_sum, half_difference = (self.phi + self.psi) / 2, (self.phi - self.psi) / 2
        sine, around = 2 * s * c, around_the_axis(self.theta, self.l3, self.lz)
        outward = self.l3 * sine - around * (c * c - s * s)
        across = self.lambda1 * self.theta_dot
        cosine, sine = np.cos(self.phi), np.sin(self.phi)
        return np.stack((
            c * np.cos(half_sum), -s * np.sin(half_difference), s * np.cos(half_difference),
            c * np.sin(half_sum), (outward * cosine - across * sine) / self.lambda1,
            (outward * sine + across * cosine) / self.lambda1, self.lz / self.lambda1))

    def _run(self, share):
        y = self._start()
        scale = np.ones_like(y)
        scale[4:] = np.maximum(np.abs(y[4:]).max(axis=0), np.sqrt(np.abs(self.fall)))
        y += self.nudge[:, None] * scale
        count, n = self.times.shape
        out = np.empty((count, n, 7), LONG)
        t, following = np.zeros(count, LONG), np.zeros(count, int)
        active = np.arange(count)
        steps = 0
        while active.size:
            steps += 1
            if steps > MOST_STEPS:
                raise ArithmeticError(f'no end after {steps} steps: '
                                      f'{[str(self.cases[i]) for i in active]}')
            series = self._series(y[:, active], active)
            goal = self.times[active, following[active]] - t[active]
            step = np.minimum(share * _radius(series), goal)
            y[:, active] = _horner(series, step)
            t[active] += step
            there = active[step == goal]
            out[there, following[there]] = y[:, there].T
            t[there] = self.times[there, following[there]]
            following[there] += 1
            active = active[following[active] < n]
        return out

    def _series(self, y, active):
        p, rates = np.zeros((ORDER + 1, *y.shape), LONG), self.fall[active]
        p[0] = y
        w, a, b, c, lx, ly, lz = (p[:, i] for i in range(7))
        half_z = lz[0] / 2
        for k in range(ORDER):
            def times(f, g, k=k):
                return np.einsum('ij,ij->j', f[:k + 1], g[k::-1])
            divisor = LONG(k + 1)       # dividing rounds anew each time: no common bias
            w[k + 1] = ((-times(lx, a) - times(ly, b)) / 2 - half_z * c[k]) / divisor
            a[k + 1] = ((times(lx, w) + times(ly, c)) / 2 - half_z * b[k]) / divisor
            b[k + 1] = ((times(ly, w) - times(lx, c)) / 2 + half_z * a[k]) / divisor
            c[k + 1] = ((times(lx, b) - times(ly, a)) / 2 + half_z * w[k]) / divisor
            # n_x = 2(xz + wy), n_y = 2(yz - wx);  L' = R e3 x (0, 0, -M g)
            lx[k + 1] = -rates * 2 * (times(b, c) - times(w, a)) / divisor
            ly[k + 1] = rates * 2 * (times(a, c) + times(w, b)) / divisor
        return p

    def quaternions(self):
        """Return (tops, times, 4): x, y, z, w of q(world <- body)."""
        w, x, y, z = np.moveaxis(self.samples[..., :4], -1, 0)
        lambda3 = _column(self.cases, lambda case: LONG(case.top.lambda3))
        half = (self.l3 * (1 / lambda3 - 1 / self.lambda1) / 2)[:, None] * self.times
        c, s = np.cos(half), np.sin(half)
        return np.stack((x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s), axis=-1)

    def tilt(self):
        """Return theta in [0, pi] and its rate |theta'| where the axis is not vertical."""
        w, x, y, z, lx, ly, _ = np.moveaxis(self.samples, -1, 0)
        half_sine, half_cosine = np.hypot(x, y), np.hypot(w, z)
        nx, ny = 2 * (x * z + w * y), 2 * (y * z - w * x)
        sine = np.hypot(nx, ny)
        rate = np.divide(nx * ly - ny * lx, sine, out=np.zeros_like(sine), where=sine != 0)
        return 2 * np.arctan2(half_sine, half_cosine), rate


def around_the_axis(theta, l3, lz):
    """Return lambda1 phi' sin(theta) = (Lz - L3 cos(theta))/sin(theta), without cancellation."""
    c, s = np.cos(theta / 2), np.sin(theta / 2)
    numerator = np.where(s * s < c * c, (lz - l3) + 2 * l3 * s * s, (lz + l3) - 2 * l3 * c * c)
    sine = 2 * s * c
    return np.divide(numerator, sine, out=np.zeros_like(sine), where=sine != 0)


def _column(cases, read):
    return np.array([read(case) for case in cases], LONG)


def _radius(series):
    """Return the radius of convergence, from the last two terms of p and of L apart."""
    radius = np.full(series.shape[2], LONG(np.inf))
    for part in (slice(0, 4), slice(4, 7)):
        size = np.abs(series[:, part]).max(axis=1)
        for k in (ORDER - 1, ORDER):
            with np.errstate(divide='ignore', invalid='ignore'):
                here = (size[0] / size[k]) ** (LONG(1) / k)
            radius = np.fmin(radius, here)
    return radius


def _horner(series, step):
    y = series[-1]
    for term in series[-2::-1]:
        y = y * step + term
    return y
