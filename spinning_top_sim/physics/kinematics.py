# SPDX-License-Identifier: Apache-2.0
"""
What can be said about a state, or about many, from a few numbers that a solver provides.

A solver hands over the Cayley-Klein parameters with their unwrapped half angles, and how the axis
moves; each column below is computed when it is first asked for, so that a pose costs no angle and
an angle no angular velocity.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import Top

Value = TypeVar('Value')

PIVOT = (0.0, 0.0, 0.0)


class lazy(Generic[Value]):  # noqa: N801 - a decorator, like functools.cached_property
    """A column computed at its first use: functools.cached_property without its 3.11 lock."""

    def __init__(self, compute: Callable[[Any], Value]) -> None:
        self._compute = compute
        self.__doc__ = compute.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> lazy[Value]: ...
    @overload
    def __get__(self, instance: object, owner: type) -> Value: ...

    def __get__(self, instance: object | None, owner: type) -> lazy[Value] | Value:
        """Compute, and store where the next look-up finds it before this descriptor."""
        if instance is None:
            return self
        value = instance.__dict__[self._name] = self._compute(instance)
        return value


class Columns:
    """
    Columns derived from alpha, beta and the axis' motion; one state or n of them.

    A subclass provides, besides `top`, `l3_start` and `lz_start` (what the motion began with):
    alpha, beta (complex), half_sum, half_difference ((phi + psi)/2 and (phi - psi)/2, unwrapped
    [rad]), theta (continued through the poles [rad]) and theta_dot [rad/s], l3 and transverse_rate
    (omega_1 + i omega_2, body frame [rad/s]).
    """

    top: Top
    l3_start: float
    lz_start: float
    alpha: Any
    beta: Any
    half_sum: Any
    half_difference: Any
    theta: Any
    theta_dot: Any
    l3: Any
    lz: Any
    transverse_rate: Any
    quaternion: Any
    norm_error: Any

    @lazy
    def phi(self) -> Any:
        """Precession angle, unwrapped [rad]."""
        return self.half_sum + self.half_difference

    @lazy
    def psi(self) -> Any:
        """Spin angle, unwrapped [rad]."""
        return self.half_sum - self.half_difference

    @property
    def euler_angles(self) -> tuple[Any, Any, Any]:
        """(phi, theta, psi), unwrapped and continued [rad]."""
        return self.phi, self.theta, self.psi

    @property
    def euler_rates(self) -> tuple[Any, Any, Any]:
        """(phi', theta', psi') [rad/s]."""
        return self.phi_dot, self.theta_dot, self.psi_dot

    @lazy
    def phi_dot(self) -> Any:
        """Precession rate [rad/s], eq. (31)."""
        return attitude.precession_rate(
            self.top, self.l3_start, self.lz_start, attitude.squared_modulus(self.alpha),
            attitude.squared_modulus(self.beta))

    @lazy
    def psi_dot(self) -> Any:
        """Spin rate [rad/s], eq. (32)."""
        return self.l3_start / self.top.lambda3 - self.phi_dot * self.axis[1]

    @lazy
    def axis(self) -> Any:
        """e3 in the world: (x + iy, z)."""
        return attitude.axis_in_world(self.alpha, self.beta)

    @lazy
    def vertical(self) -> Any:
        """Upward vertical in the body: (z_1 + i z_2, z_3)."""
        return attitude.vertical_in_body(self.alpha, self.beta)

    @lazy
    def body_rates(self) -> tuple[Any, Any, Any]:
        """omega_1, omega_2 and the constant omega_3 in the body frame [rad/s]."""
        rate = self.transverse_rate
        return rate.real, rate.imag, self.l3_start / self.top.lambda3

    @lazy
    def body_acceleration(self) -> tuple[Any, Any, float]:
        """Angular acceleration in the body frame [rad/s^2]."""
        return (*attitude.angular_acceleration(self.top, self.body_rates, self.vertical[0]), 0.0)

    def specific_force(self, point: tuple[float, float, float]) -> tuple[Any, Any, Any]:
        """Return the specific force at a body point r [m], in the body frame [m/s^2]."""
        transverse, along = self.vertical
        if point == PIVOT:                      # at rest: nothing of the motion is needed
            gravity = self.top.gravity
            return gravity * transverse.real, gravity * transverse.imag, gravity * along
        return attitude.specific_force(
            self.top.gravity, point, self.body_rates, self.body_acceleration,
            (transverse.real, transverse.imag, along))

    @lazy
    def energy(self) -> Any:
        """E = kinetic energy + P cos(theta) [J]."""
        top, l3 = self.top, self.l3_start
        return (0.5 * top.lambda1 * attitude.squared_modulus(self.transverse_rate)
                + 0.5 * l3 * l3 / top.lambda3 + top.gravity_torque * self.axis[1])


class OneState(Columns):
    """
    One state in plain Python numbers; see `Columns`.

    quaternion: (x, y, z, w) of q(world <- body);  angular_velocity: (3,) body frame [rad/s].
    """

    @lazy
    def quaternion(self) -> tuple[float, float, float, float]:
        """Attitude q(world <- body), sign continuous in time."""
        return attitude.quaternion(self.alpha, self.beta)

    @property
    def angular_velocity(self) -> tuple[float, float, float]:
        """Body rates [rad/s]."""
        return self.body_rates

    @property
    def norm_error(self) -> float:
        """|q| - 1."""
        return math.hypot(*self.quaternion) - 1.0


class AxisState(OneState):
    """A state known by its Euler angles, or by more: subclasses override what they know better."""

    def __init__(self, top: Top, l3: float, lz: float, theta: float, theta_dot: float,
                 phi: float, psi: float) -> None:
        self.top, self.l3_start, self.lz_start, self.l3, self.lz = top, l3, lz, l3, lz
        self.theta, self.theta_dot, self.phi, self.psi = theta, theta_dot, phi, psi

    @lazy
    def alpha(self) -> complex:
        """cos(theta/2) exp(i (phi + psi)/2)."""
        return cmath.rect(1.0, 0.5 * (self.phi + self.psi)) * math.cos(0.5 * self.theta)

    @lazy
    def beta(self) -> complex:
        """sin(theta/2) exp(i (phi - psi)/2)."""
        return cmath.rect(1.0, 0.5 * (self.phi - self.psi)) * math.sin(0.5 * self.theta)

    @lazy
    def transverse_rate(self) -> complex:
        """omega_1 + i omega_2 = (-phi' sin(theta) + i theta') exp(-i psi), eq. (4)."""
        return complex(-self.phi_dot * math.sin(self.theta), self.theta_dot) * cmath.rect(
            1.0, -self.psi)
