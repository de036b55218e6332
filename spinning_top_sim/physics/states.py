# SPDX-License-Identifier: Apache-2.0
"""States of a top at many times, as columns that are computed when they are first asked for."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.top import State, Top

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

Point = tuple[float, float, float]
# Times that are evaluated together: the temporaries of more do not fit into the cache.
TIMES_TOGETHER = 8192
_LARGEST = np.finfo(float).max


def relative_drift(values: NDArray[np.float64], start: Column | float) -> Column:
    """
    Return how far a constant of the motion has drifted from its value at the start.

    The drift is relative to that value, or absolute if that is 0.  A ratio that exceeds the range
    of doubles becomes the largest double, with its sign.
    """
    with np.errstate(over='ignore'):
        return np.clip((values - start) / np.where(start, np.abs(start), 1.0), -_LARGEST, _LARGEST)


class States:
    """
    States of a top at n times.

    Who asks for the attitude does not pay for Euler angles.  A value depends on its own time only,
    never on the other times.  A solver has a subclass with its name, `method`, and the columns
    that raise NotImplementedError here; all others follow.

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
        Kinetic energy + P cos(theta) [J].
    l3, lz : (n,) array
        Angular momentum along the axis and along the vertical [kg m^2/s].
    norm_error : (n,) array
        ``|q| - 1``.
    rows_quaternion, rows_axis, rows_vertical, rows_angular_velocity : tuple of (n,) array
        Components of the attitude, of the axis in the world, of the upward vertical in the body
        and of the angular velocity, which cost no copy.
    """

    method: str

    def __init__(self, top: Top, start: State, n: int, *, lz: Column | float | None = None,
                 gravity: Column | float | None = None,
                 torque: Column | float | None = None) -> None:
        self.top, self.start, self._n = top, start, n
        self._l3 = start.l3
        # Columns where the effective gravity of a moving pivot changes.
        self._lz = start.lz if lz is None else lz
        self._gravity = top.gravity if gravity is None else gravity
        self._torque = top.gravity_torque if torque is None else torque

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
    def half_angle_squares(self) -> tuple[Column, Column]:
        """Squares of cosine and sine of theta/2."""
        x, y, z, w = self.rows_quaternion
        return w * w + z * z, x * x + y * y

    @cached_property
    def l3(self) -> Column:
        return np.full(len(self), self._l3)

    @cached_property
    def lz(self) -> Column:
        return np.full(len(self), self._lz)

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
        """Eq. (31) of "Analysis of Symmetric Spinning Top"; NotImplementedError for several Lz."""
        lz = self._lz
        if isinstance(lz, np.ndarray):
            raise NotImplementedError('phi_dot about several verticals: WorldStates has it')
        return attitude.precession_rate(self.top, self._l3, lz, *self.half_angle_squares)

    @cached_property
    def psi_dot(self) -> Column:
        """Eq. (32)."""
        cos2, sin2 = self.half_angle_squares
        return self._l3 / self.top.lambda3 - self.phi_dot * (cos2 - sin2)

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
        """Symmetry axis e3 in the world frame."""
        return attitude.axis_in_world(self.rows_quaternion)

    @cached_property
    def rows_vertical(self) -> tuple[Column, Column, Column]:
        """Upward vertical in the body frame."""
        return attitude.vertical_in_body(self.rows_quaternion)

    @cached_property
    def rows_angular_velocity(self) -> Vector:
        return (*self.transverse_velocity, self._l3 / self.top.lambda3)

    @cached_property
    def angular_velocity(self) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(*self.rows_angular_velocity), axis=-1)

    @cached_property
    def rows_angular_acceleration(self) -> Vector:
        """By Euler's equations."""
        top, (w1, w2, w3), (z1, z2, _) = self.top, self.rows_angular_velocity, self.rows_vertical
        gyroscopic = (top.lambda1 - top.lambda3) * w3
        return ((gyroscopic * w2 + self._torque * z2) / top.lambda1,
                -(gyroscopic * w1 + self._torque * z1) / top.lambda1, 0.0)

    @cached_property
    def angular_acceleration(self) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(*self.rows_angular_acceleration), axis=-1)

    def velocity(self, point: Point) -> Vector:
        """
        Return the velocity omega x r of a point of the body.

        Parameters
        ----------
        point : tuple of three float
            Position r in the body frame, from the pivot [m].

        Returns
        -------
        tuple of three (n,) array
            Components in the body frame [m/s].
        """
        (w1, w2, w3), (r1, r2, r3) = self.rows_angular_velocity, point
        return w2 * r3 - w3 * r2, w3 * r1 - w1 * r3, w1 * r2 - w2 * r1

    def specific_force(self, point: Point) -> Vector:
        """
        Return what an ideal accelerometer at a point of the body measures.

        It is f = omega' x r + omega x (omega x r) + g z with the upward vertical z: at rest +g
        upwards, as REP-145 has it.

        Parameters
        ----------
        point : tuple of three float
            Position r in the body frame, from the pivot [m].

        Returns
        -------
        tuple of three (n,) array
            Components in the body frame [m/s^2].
        """
        gravity, (z1, z2, z3) = self._gravity, self.rows_vertical
        if not any(point):          # the point is the pivot: no rate is needed
            return gravity * z1, gravity * z2, gravity * z3
        r1, r2, r3 = point
        w1, w2, w3 = self.rows_angular_velocity
        a1, a2, a3 = self.rows_angular_acceleration
        along = w1 * r1 + w2 * r2 + w3 * r3
        square = w1 * w1 + w2 * w2 + w3 * w3
        return (a2 * r3 - a3 * r2 + w1 * along - r1 * square + gravity * z1,
                a3 * r1 - a1 * r3 + w2 * along - r2 * square + gravity * z2,
                a1 * r2 - a2 * r1 + w3 * along - r3 * square + gravity * z3)

    @cached_property
    def energy(self) -> Column:
        omega1, omega2, _ = self.rows_angular_velocity
        return (0.5 * self.top.lambda1 * (omega1 * omega1 + omega2 * omega2)
                + 0.5 * self._l3 * self._l3 / self.top.lambda3
                + self._torque * self.rows_vertical[2])

    def plot(self) -> Figure:
        """
        Draw the motion: the path of its axis, tilt, precession rate and energy drift.

        The path is drawn on the sphere and from above.  The bounds of theta are circles there, and
        dotted lines in the plot of the tilt.  The drift is relative to the first sample.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook with `%matplotlib inline` shows it; `savefig` writes it to a file.

        Raises
        ------
        ValueError
            For fewer than two times, or times that do not ascend.
        ImportError
            Without matplotlib.
        """
        with needed('a picture', 'plot'):
            from spinning_top_sim.physics import pictures  # noqa: PLC0415 - matplotlib is slow
        return pictures.plot(self)

    def animate(self, fps: float = 20.0, speed: float = 1.0) -> FuncAnimation:
        """
        Animate the motion: the body, its axis and the path of the tip.

        Parameters
        ----------
        fps : float, default 20
            Frames per second, > 0.  Each frame shows the newest sample: no others are computed.
        speed : float, default 1
            Simulated over real time, > 0.

        Returns
        -------
        matplotlib.animation.FuncAnimation
            `to_jshtml` makes it a part of a notebook, `save` a file.

        Raises
        ------
        ValueError
            For fewer than two times, times that do not ascend, or numbers that are not > 0.
        ImportError
            Without matplotlib.
        """
        with needed('a picture', 'plot'):
            from spinning_top_sim.physics import pictures  # noqa: PLC0415 - matplotlib is slow
        return pictures.animate(self, fps, speed)
