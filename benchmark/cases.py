# SPDX-License-Identifier: Apache-2.0
"""The motions of the benchmarks, and the instants of their samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml

from spinning_top_sim import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters

ROOT = Path(__file__).resolve().parent.parent

# Samples fall on multiples of 2^-9 s = 1 953 125 ns: whole nanoseconds that are doubles of
# seconds as well, so that every method is asked for the same instants.
FINEST_NS = 1_953_125
FINEST_HZ = 512


@dataclass(frozen=True)
class Case:
    """A top, its start and its title."""

    title: str
    top: Top
    start: State

    @cached_property
    def exact(self) -> ExactSolution:
        return ExactSolution(self.top, self.start)

    @property
    def swiftness(self) -> float:
        """L3^2/(4 lambda1 P): a top that stands upright is stable above 1."""
        return self.start.l3 ** 2 / (4.0 * self.top.lambda1 * abs(self.top.gravity_torque))


def grid_ns(duration: int, rate: int) -> np.ndarray:
    """Return the instants [ns] from 0 to `duration` [s]; rate [Hz] must divide 512."""
    assert FINEST_HZ % rate == 0
    return np.arange(duration * rate + 1, dtype=np.int64) * (FINEST_NS * (FINEST_HZ // rate))


def scene(name: str) -> tuple[Top, State]:
    """Return the top and the start of config/<name>.yaml."""
    text = (ROOT / 'config' / f'{name}.yaml').read_text()
    values = parameters.checked(yaml.safe_load(text)['/**']['ros__parameters'])
    return parameters.top_of(values), parameters.start_state(values)


def _from_scene(title: str, name: str) -> Case:
    return Case(title, *scene(name))


WHEEL = scene('cusp')[0]
# A toy top, spun about its axis only and released at 30 degrees.
TOY = Top(lambda1=0.002, lambda3=0.001, mass=0.5, com_distance=0.05, gravity=9.80665)


def _toy(spin: float) -> Case:
    theta, l3 = math.radians(30.0), TOY.lambda3 * spin
    return Case(f'fast spin: cusps at {spin:g} rad/s', TOY,
                State(theta=theta, l3=l3, lz=l3 * math.cos(theta)))


def near_pole(theta_min: float, theta: float = 1.0, theta_dot: float = -1.5, l3: float = 0.3
              ) -> Case:
    """
    Return a top that passes the upright position at a distance of about theta_min.

    Its velocity there is v, and (Lz - L3)/(lambda1 theta_min) = v.
    """
    top = WHEEL
    # Energy at theta, with Lz = L3: phi' = L3/(lambda1 (1 + cos theta)).
    across = l3 / (top.lambda1 * (1.0 + math.cos(theta))) * math.sin(theta)
    square = (theta_dot ** 2 + across ** 2
              - 2.0 * top.gravity_torque / top.lambda1 * (1.0 - math.cos(theta)))
    if square <= 0.0:
        raise ValueError(f'theta_dot = {theta_dot!r} rad/s: too slow to reach the top')
    lz = l3 + top.lambda1 * theta_min * math.sqrt(square)
    return Case(f'near pole: passes at {theta_min:.0e} rad', top,
                State(theta=theta, theta_dot=theta_dot, l3=l3, lz=lz))


CUSP = _from_scene('cusps', 'cusp')
LOOPING = _from_scene('loops', 'looping')
SLOW = Case('slow spin', WHEEL,
            State(theta=math.radians(30.0), l3=0.3, lz=0.2))
NEAR_POLE = near_pole(1e-6, theta_dot=-6.0)
HEAVY_TOP = _from_scene('Brüls, Cardona and Arnold', 'heavy_top')
TOY_200 = _toy(200.0)

WORK_PRECISION = (CUSP, LOOPING, SLOW, NEAR_POLE, HEAVY_TOP)
