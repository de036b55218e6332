# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric (Lagrange) top: its constants and its states.

A rigid symmetric body turns about a fixed point on its axis, without friction.  Euler angles are
ZYZ (Taylor, *Classical Mechanics*, sect. 10.9): body to space is Rz(phi) Ry(theta) Rz(psi), phi is
the precession, theta the tilt from the upward vertical, psi the spin about the symmetry axis.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The largest number, and the inverse of the least moment of inertia: doubles hold the products.
LARGEST = 1e50


@dataclass(frozen=True, kw_only=True)
class Top:
    """
    The constants of a top.

    Parameters
    ----------
    lambda1 : float
        Principal moment of inertia across the axis, *about the pivot* [kg m^2], >= 1e-50.
    lambda3 : float
        Principal moment of inertia along the axis [kg m^2], >= 1e-50.
    mass : float
        Mass [kg], >= 0.
    com_distance : float
        Signed distance from pivot to centre of mass along +e3 [m].
    gravity : float
        Acceleration of gravity [m/s^2], downwards positive.

    Raises
    ------
    ValueError
        Naming the field, its value and what is allowed; no number may be larger than 1e50.
    """

    lambda1: float
    lambda3: float
    mass: float
    com_distance: float
    gravity: float

    def __post_init__(self) -> None:
        _freeze_as_floats(self)
        for name in ('lambda1', 'lambda3'):
            if getattr(self, name) < 1.0 / LARGEST:
                raise ValueError(f'{name} = {getattr(self, name)!r} kg m^2: must be at least '
                                 f'{1.0 / LARGEST:g}')
        if self.mass < 0.0:
            raise ValueError(f'mass = {self.mass!r} kg: must be >= 0')

    @property
    def gravity_torque(self) -> float:
        """P = M g R [N m]: the potential energy is P cos(theta)."""
        return self.mass * self.gravity * self.com_distance

    @property
    def is_realizable(self) -> bool:
        """Whether some body has this inertia: the triangle inequality about its centre of mass."""
        return self.lambda3 <= 2.0 * self.lambda1_at_com * (1.0 + 1e-12)

    @property
    def objection(self) -> str:
        """Why no rigid body has this inertia, in names of parameters; '' if one has."""
        return '' if self.is_realizable else (
            f'top.lambda3 = {self.lambda3!r} kg m^2: no rigid body has more than '
            f'2 (lambda1 - M R^2) = {2.0 * self.lambda1_at_com:g}; simulated all the same')

    @property
    def lambda1_at_com(self) -> float:
        """Moment of inertia across the axis about the centre of mass [kg m^2], by Steiner."""
        return self.lambda1 - self.mass * self.com_distance * self.com_distance


@dataclass(frozen=True, kw_only=True)
class State:
    """
    Where the top is and how it moves at one instant.

    The rates of phi and psi follow from l3 and lz.

    Parameters
    ----------
    theta : float
        Tilt of the axis from the upward vertical [rad], in [0, pi].
    theta_dot : float
        Nutation rate [rad/s].
    phi, psi : float
        Precession and spin angle [rad].
    l3, lz : float
        Angular momentum along the body axis and along the vertical [kg m^2/s].  Where the axis
        is vertical, lz must be l3 at the top and -l3 at the bottom.

    Raises
    ------
    ValueError
        Naming the field, its value and what is allowed.
    """

    theta: float
    theta_dot: float = 0.0
    phi: float = 0.0
    psi: float = 0.0
    l3: float
    lz: float

    def __post_init__(self) -> None:
        _freeze_as_floats(self)
        if not 0.0 <= self.theta <= math.pi:
            raise ValueError(f'theta = {self.theta!r} rad: must be in [0, pi]')
        pole = pole_momentum(self.theta, self.l3)
        if pole is not None and self.lz != pole:
            raise ValueError(
                f'lz = {self.lz!r} kg m^2/s: with the axis at a pole (theta = {self.theta!r} rad) '
                f'it must equal {"l3" if self.theta == 0.0 else "-l3"} = {pole!r}')

    @classmethod
    def from_rates(cls, theta: float, precession: float, nutation: float = 0.0,
                   spin: float = 0.0, *, top: Top, phi: float = 0.0, psi: float = 0.0) -> State:
        """
        Return the state of a top that turns at these rates of its Euler angles.

        L3 = lambda3 (psi' + phi' cos theta) and Lz = lambda1 phi' sin^2 theta + L3 cos theta,
        eqs. (7) and (11) of "Analysis of Symmetric Spinning Top".

        Parameters
        ----------
        theta : float
            Tilt of the axis from the upward vertical [rad], in [0, pi].
        precession, nutation, spin : float
            phi', theta' and psi' [rad/s].
        top : Top
            Whose moments of inertia count.
        phi, psi : float, default 0
            Precession and spin angle [rad].

        Raises
        ------
        ValueError
            Naming the argument or field, its value and what is allowed.
        """
        theta, precession, spin = (_float(name, value) for name, value in (
            ('theta', theta), ('precession', precession), ('spin', spin)))
        cosine = math.cos(theta)
        l3 = top.lambda3 * (spin + precession * cosine)
        pole = pole_momentum(theta, l3)
        lz = top.lambda1 * precession * math.sin(theta) ** 2 + l3 * cosine
        return cls(theta=theta, theta_dot=nutation, phi=phi, psi=psi, l3=l3,
                   lz=lz if pole is None else pole)


class ContinuedState(State):
    """A state that a motion through a pole has reached: theta may be any real number."""

    def __post_init__(self) -> None:
        """Accept every theta."""


def pole_momentum(theta: float, l3: float) -> float | None:
    """Return the only lz a top with a vertical axis can have, or None where the axis tilts."""
    return {0.0: l3, math.pi: -l3}.get(theta)


def shown(value: object) -> str:
    """Return `repr(value)`, which Python refuses for integers of more than 4300 digits."""
    try:
        return repr(value)
    except ValueError:
        return f'<{type(value).__name__} with too many digits>'


def numbers(name: str, values: Any, *shape: int | str) -> NDArray[np.float64]:
    """Return finite numbers of a shape, in which a letter is any length.  Raises ValueError."""
    array = np.array(math.nan)
    with suppress(TypeError, ValueError):
        array = np.array(np.ma.filled(values, math.nan), dtype=float)     # masked: none
    if array.ndim != len(shape) or any(
            isinstance(one, int) and one != has for one, has in zip(shape, array.shape,
                                                                    strict=True)):
        is_of = f'shape {array.shape}' if array.ndim else f'type {type(values).__name__}'
        said = str(shape).replace("'", '')
        raise ValueError(f'{name} of {is_of}: must have shape {said}')
    for at in np.argwhere(~np.isfinite(array))[:1]:
        raise ValueError(f'{name}{at.tolist()} = {array[*at]}: must be finite')
    return array


def _freeze_as_floats(record: Top | State) -> None:
    """Store every field as a float, or say which one cannot be."""
    for field in fields(record):
        object.__setattr__(record, field.name, _float(
            field.name, getattr(record, field.name)))


def _float(name: str, value: Any) -> float:
    """Return a value as a float.  Raises ValueError, naming it, if it is no number in range."""
    with suppress(TypeError, ValueError, OverflowError):
        if not isinstance(value, bool) and abs(number := float(value)) <= LARGEST:
            return number
    raise ValueError(f'{name} = {shown(value)}: must be a number of at most {LARGEST:g}')
