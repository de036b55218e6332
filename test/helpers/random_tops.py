# SPDX-License-Identifier: Apache-2.0
"""
Random tops, seeded: log-uniform over decades, and dense on every special case of the theory.

`random_case(seed)` is the same case for ever, so a failure is named by its seed alone.
"""

import math
import random

from spinning_top_sim import State, Top


class Draw(random.Random):
    """Random numbers, and a top in its natural units: w0 = sqrt(P/lambda1), l0 = lambda1 w0."""

    def __init__(self, seed):
        super().__init__(seed)
        self.lambda1 = self.log(-6, 3)
        self.lambda3 = self.lambda1 * self.log(-2, 0.7)
        self.mass, self.com_distance = self.log(-3, 3), self.log(-3, 1)
        self.gravity = self.log(-1, 2)
        self.phi, self.psi = self.uniform(-10.0, 10.0), self.uniform(-10.0, 10.0)
        self.theta = self.uniform(1e-3, math.pi - 1e-3)
        torque = self.mass * self.gravity * self.com_distance
        self.w0 = math.sqrt(torque / self.lambda1)
        self.l0, self.critical = self.lambda1 * self.w0, 2.0 * math.sqrt(self.lambda1 * torque)
        self.theta_dot = self.sign() * self.w0 * self.log(-3, 1) if self.random() < 0.6 else 0.0
        self.l3 = self.sign() * self.l0 * self.log(-2, 2)
        self.across(self.sign() * self.l0 * self.log(-2, 1))

    def log(self, low, high):
        return 10.0 ** self.uniform(low, high)

    def sign(self):
        return self.choice((1.0, -1.0))

    def across(self, momentum):
        """Set Lz so that the momentum across the axis, less that of theta', is this."""
        self.lz = self.l3 * math.cos(self.theta) + momentum * math.sin(self.theta)


def generic(d):
    """As drawn, with the centre of mass above or below."""
    d.com_distance *= d.sign()


def at_a_pole(d):
    d.theta, d.lz = (0.0, d.l3) if d.random() < 0.5 else (math.pi, -d.l3)


def next_to_a_pole(d):
    d.theta = d.log(-16, -1) if d.random() < 0.5 else math.pi - d.log(-15.5, -1)
    d.across(d.sign() * d.l0 * d.log(-3, 1))


def near_pass(d):
    """On its way to a near miss of a pole, or through it."""
    d.lz = d.sign() * d.l3 * (1.0 + (d.sign() * d.log(-15.6, -2) if d.random() < 0.7 else 0.0))
    d.theta_dot = d.sign() * d.w0 * d.log(-1, 1)


def planar(d):
    d.l3 = d.lz = 0.0
    d.theta_dot = d.sign() * d.w0 * d.log(-2, 1)


def no_torque(d):
    setattr(d, d.choice(('mass', 'com_distance', 'gravity')), 0.0)
    d.l3 = d.l3 if d.random() < 0.8 else 0.0
    if d.random() < 0.3:
        d.lz = d.l3 * (d.sign() if d.random() < 0.5 else math.cos(d.theta))


def fast(d):
    """Spinning, with cusps or without."""
    d.l3 = d.sign() * d.critical * d.log(0.5, 4)
    d.across(0.0 if d.random() < 0.5 else d.sign() * d.l0 * d.log(-2, 1))


def near_separatrix(d):
    """As far as the upright top's energy goes, and next to it."""
    half = 0.5 * d.theta
    d.l3 = d.lz = d.sign() * d.critical * math.cos(half) * d.uniform(0.0, 0.99)
    square = 4.0 * d.w0 ** 2 * math.sin(half) ** 2 - (d.l3 / d.lambda1 * math.tan(half)) ** 2
    d.theta_dot = d.sign() * math.sqrt(max(square, 0.0)) * (1.0 + d.sign() * d.log(-16, -3))


def steady(d):
    """Slow steady precession, as well as doubles say it, and a little off."""
    cosine, torque = math.cos(d.theta), d.w0 ** 2 * d.lambda1
    d.l3 = d.sign() * d.critical * math.sqrt(max(cosine, 0.1)) * d.log(0.01, 2)
    root = math.sqrt(d.l3 ** 2 - 4.0 * d.lambda1 * torque * cosine)
    d.across(d.lambda1 * 2.0 * torque / (d.l3 + math.copysign(root, d.l3)) * math.sin(d.theta))
    d.theta_dot = 0.0
    d.lz *= 1.0 + (d.sign() * d.log(-16, -4) if d.random() < 0.7 else 0.0)


def near_rest(d):
    """Hanging, sleeping or waking, but for a little."""
    hangs, aside = d.random() < 0.5, d.log(-15, -3)
    d.theta, d.theta_dot = math.pi - aside if hangs else aside, 0.0
    d.l3 = d.l3 if hangs else d.sign() * d.critical * d.uniform(0.1, 4.0)
    d.across(0.0)
    if d.random() < 0.5:
        d.lz, d.theta_dot = -d.l3 if hangs else d.l3, d.w0 * d.log(-12, -2)


KINDS = (generic, at_a_pole, next_to_a_pole, near_pass, planar, no_torque, fast, near_separatrix,
         steady, near_rest)


def random_case(seed):
    """Return a top and its start."""
    d = Draw(seed)
    KINDS[seed % len(KINDS)](d)
    top = Top(lambda1=d.lambda1, lambda3=d.lambda3, mass=d.mass, com_distance=d.com_distance,
              gravity=d.gravity)
    return top, State(theta=d.theta, theta_dot=d.theta_dot, phi=d.phi, psi=d.psi, l3=d.l3, lz=d.lz)
