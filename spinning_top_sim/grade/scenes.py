# SPDX-License-Identifier: Apache-2.0
"""What a simulator is given: a top with an IMU on it and its start; and the motions graded."""

import math
from dataclasses import dataclass, fields
from functools import partial
from typing import Self

import numpy as np

from spinning_top_sim import solve
from spinning_top_sim.grade.columns import STANDARD_GRAVITY, Imu
from spinning_top_sim.physics.top import ContinuedState, State, Top


@dataclass(frozen=True, kw_only=True)
class Body(Imu, Top):
    """
    A top with an IMU on it.  The pivot is the origin of the body frame, e3 the axis.

    It has the parameters of `Top` and of `Imu`; lever arm and field are known here.
    """

    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    field: tuple[float, float, float] = (0.0, 20e-6, -43e-6)

    def __post_init__(self) -> None:
        vars(self).update(vars(Top(**{one.name: getattr(self, one.name) for one in fields(Top)})))
        Imu.__post_init__(self)

    @property
    def inertia(self) -> tuple[float, float, float]:
        """Principal moments of inertia about the pivot [kg m^2]."""
        return self.lambda1, self.lambda1, self.lambda3

    @property
    def inertia_at_com(self) -> tuple[float, float, float]:
        """Principal moments of inertia about the centre of mass [kg m^2]."""
        return self.lambda1_at_com, self.lambda1_at_com, self.lambda3

    @property
    def com(self) -> tuple[float, float, float]:
        """Position of the centre of mass in the body frame [m]."""
        return 0.0, 0.0, self.com_distance


@dataclass(frozen=True, kw_only=True)
class Start(ContinuedState):
    """
    A state with what engines need.

    attitude : (4,) q(world <- body) as x, y, z, w; z of the world points up
    rates : (3,) angular velocity in the body frame [rad/s]
    """

    attitude: tuple[float, float, float, float]
    rates: tuple[float, float, float]

    @classmethod
    def of(cls, top: Top, state: State) -> Self:
        """Return the start of a state."""
        first = solve(top, state, np.zeros(1))
        return cls(**vars(state), attitude=tuple(first.quaternion[0].tolist()),
                   rates=tuple(first.angular_velocity[0].tolist()))


@dataclass(frozen=True)
class Scene:
    """A motion that is graded."""

    name: str               # in reports
    start: State
    duration: float         # [s]


# The bicycle wheel of config/cusp.yaml, with an IMU off its axis.
WHEEL = Body(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=STANDARD_GRAVITY,
             lever_arm=(0.12, -0.05, 0.2), mounting=(0.4, -0.2, 0.4, 0.8),
             gyroscope_noise_density=0.0, accelerometer_noise_density=0.0)
TILT = math.radians(30.0)
TURNED = partial(State, phi=0.861, psi=-1.447)      # along no axes of the world
# As in config/, but for the last two: one passes the upward vertical, one spins at 60 rad/s.
SCENES = (
    Scene('cusps', TURNED(theta=TILT, l3=1.6, lz=1.6 * math.cos(TILT)), 10.0),
    Scene('waves', TURNED(theta=TILT, l3=1.6, lz=1.42), 4.0),
    Scene('loops', TURNED(theta=TILT, l3=1.6, lz=1.3), 4.0),
    Scene('near the separatrix', TURNED(theta=1.179087, l3=1.0, lz=1.0), 4.0),
    Scene('pole', TURNED(theta=0.6, theta_dot=-4.0, l3=1.0, lz=1.0), 4.0),
    Scene('fast spin', TURNED(theta=TILT, l3=9.0, lz=9.0 * math.cos(TILT)), 2.0))
