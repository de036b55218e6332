# SPDX-License-Identifier: Apache-2.0
"""States of a top at many times, as columns that are computed when they are first asked for."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from operator import attrgetter, methodcaller
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.pivot import AT_REST, Kinematics, Ride, kinematics
from spinning_top_sim.physics.top import State, Top

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from spinning_top_sim.table import FilePath

Point = tuple[float, float, float]
_LARGEST = np.finfo(float).max


def relative_drift(values: NDArray[np.float64], start: Column | float) -> Column:
    """
    Return how far a constant of the motion has drifted from its value at the start.

    Relative to that value, or absolute if that is 0; at most the largest double.
    """
    with np.errstate(over='ignore'):
        return np.clip((values - start) / np.where(start, np.abs(start), 1.0), -_LARGEST, _LARGEST)


class States:
    """
    States of a top at n times, in columns that are computed when they are first asked for.

    A value depends on its own time only, never on the other times.  A solver has a subclass with
    its name, `method`, and the columns t, angles, theta_dot, rows_quaternion and
    transverse_velocity; all others follow.

    Attributes
    ----------
    top, start : Top, State
        The top, and its state at t = 0.
    t : (n,) array
        Times since the start of the motion [s].
    theta, phi, psi : (n,) array
        ZYZ Euler angles [rad], unwrapped and continued through the poles.
    theta_dot, phi_dot, psi_dot : (n,) array
        Nutation, precession and spin rate [rad/s].
    theta_folded : (n,) array
        Tilt from the upward vertical [rad], in [0, pi].
    quaternion : (n, 4) array
        Attitude q(world <- body) as x, y, z, w, its sign continuous in time.
    angular_velocity, angular_acceleration : (n, 3) array
        In the body frame [rad/s], [rad/s^2].
    energy : (n,) array
        Kinetic energy + P cos(theta) [J], about the vertical of `start`.
    l3, lz : (n,) array
        Angular momentum along the axis and along the vertical of `start` [kg m^2/s].  What follows
        from L3 is computed from its constant; steps let l3 drift from that by some rounding.
    pivot : Kinematics
        Position, velocity and acceleration of the pivot in the world.
    norm_error : (n,) array
        ``|q| - 1``.
    rows_quaternion, rows_axis, rows_vertical, rows_angular_velocity : tuple of (n,) array
        Components of the attitude, of the axis in the world, of the upward vertical in the body
        and of the angular velocity, which cost no copy.
    """

    method: str

    def __init__(self, top: Top, start: State, n: int) -> None:
        self.top, self.start, self._n = top, start, n
        # (n,) where it is measured.  Columns that read it or `start` stand in `_Joined`, too.
        self._constant_l3: Any = start.l3

    def __len__(self) -> int:
        return self._n

    def __repr__(self) -> str:
        span = f' from {self.t.min():g} to {self.t.max():g} s' if self._n else ''
        return f'<States by {self.method!r}: {self._n} times{span}>'

    @cached_property
    def t(self) -> Column:
        raise NotImplementedError

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        """Phi, theta and psi [rad]."""
        raise NotImplementedError

    @cached_property
    def theta_dot(self) -> Column:
        raise NotImplementedError

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        raise NotImplementedError

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        """Angular velocity about the first two body axes [rad/s]."""
        raise NotImplementedError

    @cached_property
    def pivot(self) -> Kinematics:
        return AT_REST

    @cached_property
    def half_angle_squares(self) -> tuple[Column, Column]:
        """Squares of cosine and sine of theta/2."""
        x, y, z, w = self.rows_quaternion
        return w * w + z * z, x * x + y * y

    @cached_property
    def l3(self) -> Column:
        return np.full(len(self), self._constant_l3)

    @cached_property
    def lz(self) -> Column:
        return np.full(len(self), self.start.lz)

    @property
    def phi(self) -> Column:
        return self.angles[0]

    @property
    def theta(self) -> Column:
        return self.angles[1]

    @property
    def psi(self) -> Column:
        return self.angles[2]

    @cached_property
    def phi_dot(self) -> Column:
        """Eq. (31) of "Analysis of Symmetric Spinning Top"."""
        return attitude.precession_rate(self.top, self._constant_l3, self.start.lz,
                                        *self.half_angle_squares)

    @cached_property
    def psi_dot(self) -> Column:
        """Eq. (32)."""
        cos2, sin2 = self.half_angle_squares
        return self.rows_angular_velocity[2] - self.phi_dot * (cos2 - sin2)

    @cached_property
    def theta_folded(self) -> Column:
        cos2, sin2 = self.half_angle_squares
        return 2.0 * np.arctan2(np.sqrt(sin2), np.sqrt(cos2))

    @cached_property
    def quaternion(self) -> NDArray[np.float64]:
        return np.stack(self.rows_quaternion, axis=-1)

    @cached_property
    def norm_error(self) -> Column:
        x, y, z, w = self.rows_quaternion
        return np.sqrt((x * x + y * y) + (z * z + w * w)) - 1.0

    @cached_property
    def rows_axis(self) -> tuple[Column, Column, Column]:
        return attitude.axis_in_world(self.rows_quaternion)

    @cached_property
    def rows_vertical(self) -> tuple[Column, Column, Column]:
        return attitude.vertical_in_body(self.rows_quaternion)

    @cached_property
    def rows_angular_velocity(self) -> Vector:
        return (*self.transverse_velocity, self._constant_l3 / self.top.lambda3)

    @cached_property
    def angular_velocity(self) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(*self.rows_angular_velocity), axis=-1)

    @cached_property
    def _support(self) -> Vector:
        """Specific force of the pivot in the body [m/s^2]: g z + its acceleration."""
        gravity, (z1, z2, z3) = self.top.gravity, self.rows_vertical
        return gravity * z1, gravity * z2, gravity * z3

    @cached_property
    def rows_angular_acceleration(self) -> Vector:
        """By Euler's equations, with the torque R e3 x (-M f) of the specific force f."""
        top, (w1, w2, w3), (f1, f2, _) = self.top, self.rows_angular_velocity, self._support
        gyroscopic = (top.lambda1 - top.lambda3) * w3
        return ((gyroscopic * w2 + top.mass * f2 * top.com_distance) / top.lambda1,
                -(gyroscopic * w1 + top.mass * f1 * top.com_distance) / top.lambda1, 0.0)

    @cached_property
    def angular_acceleration(self) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(*self.rows_angular_acceleration), axis=-1)

    @cached_property
    def energy(self) -> Column:
        top, (w1, w2, w3) = self.top, self.rows_angular_velocity
        # In this order only what is too large itself overflows, not the square of a rate.
        kinetic: Column = 0.5 * (top.lambda1 * w1 * w1 + top.lambda1 * w2 * w2
                                 + w3 * self._constant_l3)
        return kinetic + top.mass * self._support[2] * top.com_distance

    def position(self, point: Point) -> Vector:
        """Return where a point of the body [m] is in the world, as components (n,) [m]."""
        (x, y, z), (a, b, c) = attitude.rotated(self.rows_quaternion, point), self.pivot.position
        return x + a, y + b, z + c

    def world_velocity(self, point: Point) -> Vector:
        """Return the velocity of a point of the body [m] in the world, in body axes [m/s]."""
        (v1, v2, v3), (u, v, w) = self.velocity(point), self.pivot.velocity
        u1, u2, u3 = attitude.rotated_back(self.rows_quaternion, (u, v, w))
        return v1 + u1, v2 + u2, v3 + u3

    def velocity(self, point: Point) -> Vector:
        """
        Return the velocity omega x r of a point of the body relative to the pivot.

        As three (n,) arrays in the body frame [m/s].

        Parameters
        ----------
        point : three floats
            From the pivot, in the body frame [m].
        """
        (w1, w2, w3), (r1, r2, r3) = self.rows_angular_velocity, point
        return w2 * r3 - w3 * r2, w3 * r1 - w1 * r3, w1 * r2 - w2 * r1

    def specific_force(self, point: Point) -> Vector:
        """
        Return what an ideal accelerometer at a point of the body measures.

        It is omega' x r + omega x (omega x r) + g z + a with the acceleration a of the pivot: at
        rest +g upwards, as REP-145 has it.  As three (n,) arrays in the body frame [m/s^2].

        Parameters
        ----------
        point : three floats
            From the pivot, in the body frame [m].
        """
        f1, f2, f3 = self._support
        if not any(point):          # the point is the pivot: no rate is needed
            return f1, f2, f3
        r1, r2, r3 = point
        w1, w2, w3 = self.rows_angular_velocity
        a1, a2, _ = self.rows_angular_acceleration      # omega_3 is constant
        along = w1 * r1 + w2 * r2 + w3 * r3
        square = w1 * w1 + w2 * w2 + w3 * w3
        return (a2 * r3 + w1 * along - r1 * square + f1,
                w2 * along - a1 * r3 - r2 * square + f2,
                a1 * r2 - a2 * r1 + w3 * along - r3 * square + f3)

    def to_csv(self, path: FilePath) -> None:
        """
        Write the columns of `simulate -o FILE.csv`, with a head of names and units.

        Numbers are read back to the last bit.

        Parameters
        ----------
        path : str or path
            A new file; an existing one raises FileExistsError.
        """
        from spinning_top_sim import table  # noqa: PLC0415 - few need it
        moves = bool(self.pivot.position.any() or self.pivot.velocity.any())
        rows = np.column_stack(np.broadcast_arrays(*table.columns(
            self.t, self, pivot_moves=moves)))
        table.write_csv(path, [rows], table.RIDE_UNITS if moves else table.UNITS)

    def plot(self) -> Figure:
        """
        Return a figure of the motion: the path of its axis, tilt, precession rate, energy.

        Raises ValueError for fewer than two times, or times that do not ascend, and ImportError
        without matplotlib.
        """
        with needed('a picture', 'plot'):
            from spinning_top_sim import pictures  # noqa: PLC0415 - matplotlib is slow
        return pictures.plot(self, relative_drift(self.energy, self.energy[:1]))


class WorldStates(States):
    """
    States about another vertical, seen from the world.

    Attitude and Euler angles are those in the world: theta in [0, pi], phi and psi in
    [-2 pi, 2 pi].  `start`, and with it energy and Lz, which are constants, stays that about the
    other vertical, in the frame of the pivot.

    moved : states in the frame of the vertical
    rotation : q(world <- frame)
    ride, times_ns : what the pivot does, at simulated times (n,) [ns]
    """

    t, l3, transverse_velocity, _support = (
        cached_property(attrgetter(f'_moved.{name}')) for name in (
            't', 'l3', 'transverse_velocity', '_support'))

    def __init__(self, top: Top, moved: States, rotation: Quaternion, ride: Ride,
                 times_ns: NDArray[np.int64]) -> None:
        super().__init__(top, moved.start, len(moved))
        self.method, self._moved, self._rotation = moved.method, moved, rotation
        self._ride, self._times_ns = ride, times_ns

    @cached_property
    def pivot(self) -> Kinematics:
        return kinematics(self._ride, self._times_ns)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        # Without -0.0, which a product with the identity leaves or not.
        x, y, z, w = (part + 0.0 for part in attitude.product(
            self._rotation, self._moved.rows_quaternion))
        return x, y, z, w

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        x, y, z, w = self.rows_quaternion
        half_sum, half_difference = np.arctan2(z, w), np.arctan2(-x, y)
        return half_sum + half_difference, self.theta_folded, half_sum - half_difference

    @cached_property
    def _axis_rates(self) -> tuple[Column, Column]:
        """Theta' and phi', which is 0 where the axis is vertical, from the angular velocity."""
        # alpha conj(beta) = sin(theta)/2 exp(i psi); at a pole the angle of what is left of it
        x, y, z, w = self.rows_quaternion
        cosine, sine = w * y - z * x, w * x + z * y
        half = np.sqrt(cosine * cosine + sine * sine)
        at_pole = half == 0.0
        cosine, sine = np.where(at_pole, w + y, cosine), np.where(at_pole, z + x, sine)
        scale, (w1, w2) = np.where(at_pole, 1.0, half), self.transverse_velocity
        return ((w1 * sine + w2 * cosine) / scale,
                np.where(at_pole, 0.0, 0.5 * (w2 * sine - w1 * cosine) / scale / scale))

    @cached_property
    def theta_dot(self) -> Column:
        return self._axis_rates[0]

    @cached_property
    def phi_dot(self) -> Column:
        return self._axis_rates[1]


def joined(parts: Sequence[States]) -> States:
    """Return the states of one top at the times of all parts, in their order."""
    return parts[0] if len(parts) == 1 else _Joined(parts)


class _Joined(States):
    """
    Every column is that of the parts, so no value depends on what it is joined with.

    Joined is what a subclass of `States` may have of its own, and what needs the start of a part.
    Each other column follows from these time by time, as in a part.
    """

    def __init__(self, parts: Sequence[States]) -> None:
        super().__init__(parts[0].top, parts[0].start, sum(map(len, parts)))
        self._parts, self.method = parts, parts[0].method

    def _column(self, name: str) -> Any:
        return np.concatenate([getattr(one, name) for one in self._parts])

    def _rows(self, name: str) -> Any:
        """Return a tuple of columns, of which some parts may have one number for all times."""
        return tuple(np.concatenate([
            np.broadcast_to(row, (*np.shape(row)[:-1], len(one)))
            for one, row in zip(self._parts, rows, strict=True)], axis=-1)
            for rows in zip(*(getattr(one, name) for one in self._parts), strict=True))

    t, theta_dot, phi_dot, l3, lz, energy = (
        cached_property(methodcaller('_column', name)) for name in (
            't', 'theta_dot', 'phi_dot', 'l3', 'lz', 'energy'))
    angles, rows_quaternion, transverse_velocity, rows_angular_velocity, _support = (
        cached_property(methodcaller('_rows', name)) for name in (
            'angles', 'rows_quaternion', 'transverse_velocity', 'rows_angular_velocity',
            '_support'))

    @cached_property
    def pivot(self) -> Kinematics:
        return Kinematics(*self._rows('pivot'))
