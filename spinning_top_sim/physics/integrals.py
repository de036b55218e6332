# SPDX-License-Identifier: Apache-2.0
"""
Rotation and velocity increments of a body, exact to rounding however short the interval is.

Increments are differences of the states at both ends, whose rounding does not add up in a sum.
Over a short time, such as 0.1 ms, it is large beside the difference: there they are integrals of
the body's rates, as means are, by a Gauss-Legendre rule at whole nanoseconds.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.physics.top import Top
from spinning_top_sim.times import ns_array

# Increments over panels of a larger angle are differences: the rounding is below 1e-13 of them.
LEAST_ANGLE = 0.05
# A panel is at most so many times 1/`fastest_rate` long; with n nodes for an angle of a = rate *
# length, where (a/2)^n is less than this, the error of the rule, some (a/2)^2n, is a rounding.
# So many panels hold 8 turns; with more the integrals become less exact.
LONGEST_PANEL, HALF_THE_DIGITS, MOST_PANELS = 0.5, 1e-8, 100
Matrix = NDArray[np.float64]


class Increments(NamedTuple):
    """What a body did in an interval [a, b), for n intervals at a time."""

    rotation: Matrix        # (4, n) q(body at a <- body at b) as x, y, z, w
    # (3, n) integrals of the specific force f of a point of the body [m/s] and of the angular
    # velocity [rad/s]: of f in the body frame at a; of both in the body frame of each moment
    velocity: Matrix
    angles: Matrix
    forces: Matrix

    def then(self, later: 'Increments') -> 'Increments':
        """Return the increments over this interval and the one that follows it."""
        (x, y, z, w), (a, b, c, d), (v1, v2, v3) = self.rotation, later.rotation, later.velocity
        return Increments(
            np.stack(attitude.product((x, y, z, w), (a, b, c, d))),
            self.velocity + np.stack(attitude.rotated((x, y, z, w), (v1, v2, v3))),
            self.angles + later.angles, self.forces + later.forces)


def impulse(velocity: Vector) -> Increments:
    """Return the increments of a moment (n = 1) in which the velocity of the point jumps [m/s]."""
    jump, zeros = np.stack(velocity), np.zeros((3, 1))
    return Increments(np.array([[0.0], [0.0], [0.0], [1.0]]), jump, zeros, jump)


def fastest_rate(top: Top, l3: float, energy: float) -> float:
    """
    Return a bound on how fast the attitude and the body's rates change [rad/s].

    The energy bounds the angular velocity across the axis; by Euler's equations this turns in the
    body at |1 - lambda3/lambda1| omega3, and the torque adds a pendulum's rate.
    """
    spin = l3 / top.lambda3
    kinetic = max(energy - 0.5 * l3 * spin + abs(top.gravity_torque), 0.0)
    return (math.hypot(spin, math.sqrt(2.0 * kinetic / top.lambda1))
            + abs((1.0 - top.lambda3 / top.lambda1) * spin)
            + math.sqrt(abs(top.gravity_torque) / top.lambda1))


def panels(rate: float, length_ns: int) -> int:
    """Return into how many panels an interval is divided for motions of this `fastest_rate`."""
    return max(1, math.ceil(min(rate * length_ns * 1e-9 / LONGEST_PANEL, MOST_PANELS)))


def increments(states: Callable[[NDArray[np.int64]], States], begins: range, length_ns: int,
               point: Point, rate: float) -> Increments:
    """
    Return the increments over panels of one length that begin at these times [ns].

    states : gives the states at times [ns], throughout which the pivot accelerates uniformly
    point : of which the specific force is taken, in the body [m]
    rate : `fastest_rate` of the motion
    """
    angle = rate * length_ns * 1e-9
    rule = _rule(length_ns, _nodes(angle))
    # Of each panel both ends and the nodes between them, (n, nodes and ends).
    times_ns = ns_array(begins)[:, np.newaxis] + np.array(
        [0, *(offset_ns for offset_ns, _ in rule), length_ns])
    now = states(times_ns.ravel())

    def rows_of(vector: Sequence[Column | float]) -> Matrix:
        """Return components of the states, (components, nodes and ends, n)."""
        rows = np.empty((len(vector), times_ns.size))
        for row, component in zip(rows, vector, strict=True):
            row[:] = component      # perhaps one number for all
        return rows.reshape(-1, *times_ns.shape).swapaxes(1, 2)

    quaternions, rates, forces = map(rows_of, (
        now.rows_quaternion, now.rows_angular_velocity, now.specific_force(point)))
    (x, y, z, w), nodes = quaternions[:, :1], slice(1, -1)
    (a, b, c, d), (w1, w2, w3), (f1, f2, f3) = (
        rows[:, nodes] for rows in (quaternions, rates, forces))
    x, y, z, w = rotation = attitude.product((-x, -y, -z, w), (a, b, c, d))
    # The derivative of the rotation is half of its product with the angular velocity.
    derivatives = np.concatenate([
        attitude.product(rotation, (0.5 * w1, 0.5 * w2, 0.5 * w3, 0.0 * w3)),
        attitude.rotated_back((-x, -y, -z, w), (f1, f2, f3)), (w1, w2, w3), (f1, f2, f3)])
    sums = np.zeros((len(derivatives), len(times_ns)))
    for node, (_, weight) in enumerate(rule):
        sums += weight * derivatives[:, node]
    found = Increments(sums[:4], sums[4:7], sums[7:10], sums[10:])
    found.rotation[3] += 1.0            # w of the identity
    if angle >= LEAST_ANGLE:
        seconds = 1e-9 * length_ns
        fall = now.pivot.acceleration[:, :1] * seconds
        fall[2] += now.top.gravity * seconds
        found.rotation[:], found.velocity[:] = _differences(
            quaternions[:, [0, -1]], rows_of(now.velocity(point))[:, [0, -1]], fall)
    return found


def joined(parts: Sequence[Increments]) -> Increments:
    """Return the increments over these intervals together."""
    return parts[0] if len(parts) == 1 else Increments(*(
        np.concatenate(rows, axis=1) for rows in zip(*parts, strict=True)))


def _differences(quaternions: Matrix, velocities: Matrix,
                 fall: Matrix) -> tuple[Quaternion, Vector]:
    """
    Return rotation and velocity of `Increments` from the states at both ends.

    The latter is R(a)^T (v(b) - v(a) + fall), with velocities v relative to the pivot.

    quaternions, velocities : (components, 2, n); velocities in the body [m/s]
    fall : (3, 1) g z and the acceleration of the pivot times b - a, in the world [m/s]
    """
    now, last = ((x, y, z, w) for x, y, z, w in quaternions.swapaxes(0, 1))
    (x, y, z, w), (a, b, c, d) = now, last
    # conj(q) p = 1 + conj(q) (p - q) rounds less than the product.
    *axis, shrunk = attitude.product((-x, -y, -z, w), (a - x, b - y, c - z, d - w))
    # The lengths of q and p, rounded like their components, would scale all the small angles.
    too_long, longer = _excess(now), _excess(last)
    scale = 1.0 - 0.5 * (too_long + longer)
    (v1, v2, v3), (u1, u2, u3) = (
        attitude.rotated(turn, (x, y, z)) for turn, (x, y, z) in zip(
            (now, last), velocities.swapaxes(0, 1), strict=True))
    x, y, z = fall
    change = u1 - v1 + x, u2 - v2 + y, u3 - v3 + z
    x, y, z = (scale * part for part in axis)
    return ((x, y, z, 1.0 + (shrunk + 0.5 * (too_long - longer))),
            attitude.rotated_back(now, change))


def _excess(q: Quaternion) -> Column:
    """Return |q|^2 - 1, exact to 2^-76: the squares of numbers of 26 bits are exact."""
    coarse = [np.rint(2.0 ** 26 * part) * 2.0 ** -26 for part in q]
    (x, y, z, w), (a, b, c, d) = coarse, ((part - one) * (part + one)
                                          for part, one in zip(q, coarse, strict=True))
    return ((x * x + y * y + z * z + w * w) - 1.0) + (a + b + c + d)


def _nodes(angle: float) -> int:
    """Return how many nodes a panel has in which the motion turns by up to `angle` [rad]."""
    angle = min(max(angle, 1e-8), LONGEST_PANEL)
    return max(4, math.ceil(math.log(HALF_THE_DIGITS) / math.log(0.5 * angle)))


@lru_cache(64)          # 200 increments take 0.53 ms, and would take 0.80 ms
def _rule(length_ns: int, count: int) -> tuple[tuple[int, float], ...]:
    """Return rounded Gauss nodes [ns] and weights [s], by rational numbers: the same anywhere."""
    gauss, _ = np.polynomial.legendre.leggauss(count)
    nodes = sorted({round(0.5 * (1.0 + node) * length_ns) for node in gauss.tolist()})
    rule = []
    for node in nodes:
        # Lagrange's polynomial of this node, lowest power first, and its integral.
        polynomial, scale = [1], 1
        for other in nodes:
            if other != node:
                polynomial = [a - other * b for a, b in zip(
                    (0, *polynomial), (*polynomial, 0), strict=True)]
                scale *= node - other
        integral = sum(Fraction(factor * length_ns ** power, power)
                       for power, factor in enumerate(polynomial, start=1))
        rule.append((node, float(integral / scale / 10 ** 9)))
    return tuple(rule)
