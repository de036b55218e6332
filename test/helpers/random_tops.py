# SPDX-License-Identifier: Apache-2.0
"""
Random tops, seeded: log-uniform over decades, and dense on every special case of the theory.

`random_case(seed)` is the same case for ever, so a failure is named by its seed alone.
"""

import math
from dataclasses import dataclass

import numpy as np

from spinning_top_sim import State, Top


@dataclass(frozen=True)
class Case:
    seed: int
    kind: str
    top: Top
    start: State

    def __str__(self):
        return f'random_case({self.seed}) [{self.kind}]: {self.top} from {self.start}'


class Draw:
    """Random numbers, and a top in its natural units: w0 = sqrt(P/lambda1), l0 = lambda1 w0."""

    def __init__(self, seed):
        self.rng = np.random.default_rng([20230923, seed])
        self.lambda1 = self.log(-6, 3)
        self.lambda3 = self.lambda1 * self.log(-2, 0.7)
        self.mass, self.com_distance = self.log(-3, 3), self.log(-3, 1)
        self.gravity = self.log(-1, 2)
        self.phi, self.psi = self.uniform(-10.0, 10.0), self.uniform(-10.0, 10.0)
        if self.chance(0.1):
            self.phi, self.psi = self.phi * 1e5, self.psi * 1e5
        self.tilt()
        self.theta_dot = self.sign() * self.w0 * self.log(-3, 1) if self.chance(0.6) else 0.0
        self.l3 = self.sign() * self.l0 * self.log(-2, 2)
        self.lz = self.consistent_lz(self.sign() * self.l0 * self.log(-2, 1))

    def uniform(self, low, high):
        return float(self.rng.uniform(low, high))

    def log(self, low, high):
        return 10.0 ** self.uniform(low, high)

    def chance(self, probability):
        return self.uniform(0.0, 1.0) < probability

    def sign(self):
        return 1.0 if self.chance(0.5) else -1.0

    @property
    def torque(self):
        return self.mass * self.gravity * self.com_distance

    @property
    def w0(self):
        return math.sqrt(abs(self.torque) / self.lambda1)

    @property
    def l0(self):
        return self.lambda1 * self.w0

    def tilt(self):
        self.theta = self.uniform(1e-3, math.pi - 1e-3)

    def consistent_lz(self, across):
        """Lz of a top with L3 whose momentum across the axis, less that of theta', is this."""
        return self.l3 * math.cos(self.theta) + across * math.sin(self.theta)

    def critical_l3(self):
        """Below this a sleeping top is unstable."""
        return 2.0 * math.sqrt(self.lambda1 * abs(self.torque))

    def case(self, seed, kind):
        top = Top(lambda1=self.lambda1, lambda3=self.lambda3, mass=self.mass,
                  com_distance=self.com_distance, gravity=self.gravity)
        return Case(seed, kind, top, State(theta=self.theta, theta_dot=self.theta_dot,
                                           phi=self.phi, psi=self.psi, l3=self.l3, lz=self.lz))


def generic(d):
    """As drawn."""


def at_a_pole(d):
    d.theta, d.lz = (0.0, d.l3) if d.chance(0.5) else (math.pi, -d.l3)


def next_to_a_pole(d):
    d.theta = d.log(-16, -1) if d.chance(0.5) else math.pi - d.log(-15.5, -1)
    d.lz = d.consistent_lz(d.sign() * d.l0 * d.log(-3, 1))


def near_pass(d):
    """On its way to a near miss of a pole."""
    side = d.sign()
    d.lz = side * d.l3 * (1.0 + d.sign() * d.log(-15.6, -2))
    d.theta_dot = d.sign() * d.w0 * d.log(-1, 1)


def crosses_a_pole(d):
    d.lz = d.sign() * d.l3


def planar(d):
    d.l3 = d.lz = 0.0
    d.theta_dot = d.sign() * d.w0 * d.log(-2, 1)


def no_torque(d):
    l0, w0 = d.l0, d.w0
    setattr(d, ('mass', 'com_distance', 'gravity')[int(d.uniform(0, 3))], d.sign() * 0.0)
    d.l3 = d.l3 if d.chance(0.8) else 0.0
    d.theta_dot = d.theta_dot if l0 and w0 and d.chance(0.7) else 0.0
    if d.chance(0.3):
        d.lz = d.l3 * (d.sign() if d.chance(0.5) else math.cos(d.theta))


def upside_down(d):
    name = 'gravity' if d.chance(0.5) else 'com_distance'
    setattr(d, name, -getattr(d, name))
    if d.chance(0.3):
        separatrix_from(d, math.pi - d.theta)


def fast(d):
    d.gravity *= d.log(-30, 0) if d.chance(0.3) else 1.0
    d.l3 = d.sign() * d.critical_l3() * d.log(0.5, 4)
    d.lz = d.consistent_lz(0.0 if d.chance(0.5) else d.sign() * d.l0 * d.log(-2, 1))


def separatrix_from(d, from_top):
    """As far as the upright top's energy goes, and next to it: Lz = L3 upright, or -L3."""
    upward = 1.0 if d.torque > 0.0 else -1.0
    d.l3 = d.sign() * d.critical_l3() * math.cos(0.5 * from_top) * d.uniform(0.0, 0.99)
    d.lz = upward * d.l3
    square = (4.0 * abs(d.torque) / d.lambda1 * math.sin(0.5 * from_top) ** 2
              - (d.l3 / d.lambda1 * math.tan(0.5 * from_top)) ** 2)
    d.theta_dot = d.sign() * math.sqrt(max(square, 0.0)) * (1.0 + d.sign() * d.log(-16, -3))


def near_separatrix(d):
    separatrix_from(d, d.theta)


def waking_sleeper(d):
    d.theta = d.log(-15, -3)
    d.l3 = d.sign() * d.critical_l3() * d.uniform(0.1, 0.999)
    d.lz = d.l3 if d.chance(0.5) else d.consistent_lz(0.0)
    d.theta_dot = 0.0


def cusp(d):
    d.lz, d.theta_dot = d.l3 * math.cos(d.theta), 0.0


def steady(d):
    """Steady precession, as well as doubles say it, and a little off."""
    cosine = math.cos(d.theta)
    d.l3 = d.sign() * d.critical_l3() * math.sqrt(max(cosine, 0.0)) * d.log(0.01, 2)
    if d.l3 == 0.0:
        d.l3 = d.sign() * d.l0
    root = math.sqrt(d.l3 ** 2 - 4.0 * d.lambda1 * d.torque * cosine)
    rate = ((d.l3 + math.copysign(root, d.l3)) / (2.0 * d.lambda1 * cosine) if d.chance(0.5)
            else 2.0 * d.torque / (d.l3 + math.copysign(root, d.l3)))
    d.lz = d.l3 * cosine + d.lambda1 * rate * math.sin(d.theta) ** 2
    d.theta_dot = 0.0
    if d.chance(0.7):
        d.lz *= 1.0 + d.sign() * d.log(-16, -4)


def near_rest(d):
    """Hanging or sleeping, but for a little."""
    hangs, aside = d.chance(0.5), d.log(-15, -3)
    d.theta = math.pi - aside if hangs else aside
    d.l3 = d.l3 if hangs else d.sign() * d.critical_l3() * d.uniform(1.0, 4.0)
    d.lz, d.theta_dot = (-d.l3 if hangs else d.l3, d.w0 * d.log(-12, -2)) if d.chance(0.5) else (
        d.consistent_lz(0.0), 0.0)


KINDS = (generic, at_a_pole, next_to_a_pole, near_pass, crosses_a_pole, planar, no_torque,
         upside_down, fast, near_separatrix, waking_sleeper, cusp, steady, near_rest)


def random_case(seed):
    draw = Draw(seed)
    kind = KINDS[seed % len(KINDS)]
    kind(draw)
    return draw.case(seed, kind.__name__)
