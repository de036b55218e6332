# SPDX-License-Identifier: Apache-2.0
"""
The methods that the benchmarks compare, with one interface.

`Peer.ready(case, setting)` compiles a model, which is not timed.  The runner that it returns
computes attitudes, which is timed, or `Samples`, which can be checked.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from cases import Case

from spinning_top_sim.physics import attitude
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.times import NANOSECONDS


class FailedError(Exception):
    """The method itself reports that it failed."""


class Samples(NamedTuple):
    """
    Result of a method at n instants.

    quaternion (n, 4) x, y, z, w;  omega (n, 3) body rates [rad/s];  phi, psi (n,) unwrapped
    [rad], None where the method has none.
    """

    quaternion: np.ndarray
    omega: np.ndarray
    phi: np.ndarray | None = None
    psi: np.ndarray | None = None

    def invariants(self, case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return energy, L3 and Lz, from attitude and rates alone: the same for every method."""
        top, omega = case.top, self.omega
        x, y, z, w = (self.quaternion
                      / np.linalg.norm(self.quaternion, axis=1, keepdims=True)).T
        vertical = np.stack((2 * (x * z - w * y), 2 * (y * z + w * x),
                             w * w + z * z - x * x - y * y), axis=1)
        momentum = omega * (top.lambda1, top.lambda1, top.lambda3)
        energy = 0.5 * np.sum(momentum * omega, axis=1) + top.gravity_torque * vertical[:, 2]
        return energy, momentum[:, 2], np.sum(momentum * vertical, axis=1)


class Runner:
    """One method at one setting on one case."""

    work: int | None = None         # of the last run, in `Peer.unit`

    def __init__(self, case: Case, setting: float) -> None:
        self.case, self.setting = case, setting

    def attitudes(self, ns: np.ndarray) -> np.ndarray:
        """Return (n, 4) x, y, z, w at the instants ns [ns]: a uniform grid from 0 on."""
        raise NotImplementedError

    def samples(self, ns: np.ndarray) -> Samples:
        raise NotImplementedError


@dataclass(frozen=True)
class Peer:
    """A method: its name, its family (the package), its tolerances, and the unit of its work."""

    name: str
    family: str
    ready: Callable[[Case, float], Runner]
    settings: tuple[float, ...]
    unit: str = 'evaluations'

    def label(self, setting: float) -> str:
        """Return the name with a tolerance."""
        return f'{self.name} {setting:.2g}' if setting else self.name

    def missing(self) -> str | None:
        """Return why the method cannot be run here, or None."""
        absent = self.family == 'heyoka' and find_spec('heyoka') is None
        return 'heyoka is not installed' if absent else None


class _Ours(Runner):
    def __init__(self, case: Case, setting: float, **options: Any) -> None:
        super().__init__(case, setting)
        self._options = options
        if setting:
            self._options |= {'rtol': setting, 'atol': 0.1 * setting}

    def _states(self, ns):
        propagator = motion_of(self.case.top, self.case.start, **self._options)
        states = propagator.states(ns, NANOSECONDS)
        self.work = propagator.evaluations or None
        return states

    def attitudes(self, ns):
        return self._states(ns).quaternion

    def samples(self, ns):
        states = self._states(ns)
        return Samples(states.quaternion, states.angular_velocity, states.phi, states.psi)


def attitudes_of_angles(theta, phi, psi) -> np.ndarray:
    """Return (n, 4) x, y, z, w."""
    half, plus, minus = 0.5 * theta, 0.5 * (phi + psi), 0.5 * (phi - psi)
    c, s = np.cos(half), np.sin(half)
    return np.stack((-s * np.sin(minus), s * np.cos(minus), c * np.sin(plus),
                     c * np.cos(plus)), axis=1)


class _SciPy(Runner):
    """Eqs. (29)-(32) of the paper, written literally."""

    def __init__(self, case: Case, setting: float, method: str) -> None:
        super().__init__(case, setting)
        self._method = method
        top, start = case.top, case.start
        self._start = [start.theta, start.theta_dot, start.phi, start.psi]
        lambda1, l3, lz = top.lambda1, start.l3, start.lz
        ratio, fall = top.lambda3 / lambda1, top.gravity_torque / lambda1
        spin = l3 / top.lambda3

        def rates(t, y):
            theta, theta_dot, _, _ = y.tolist()
            s, c = math.sin(theta), math.cos(theta)
            phi_dot = (lz - l3 * c) / (lambda1 * s * s)
            psi_dot = spin - phi_dot * c
            return (theta_dot, phi_dot * phi_dot * s * c
                    - ratio * (psi_dot + phi_dot * c) * phi_dot * s + fall * s, phi_dot, psi_dot)

        self._rates = rates

    def angles(self, ns: np.ndarray) -> np.ndarray:
        """Return theta, theta', phi, psi, (4, n).  Raises FailedError, or ZeroDivisionError."""
        from scipy.integrate import solve_ivp
        t = ns / 1e9
        result = solve_ivp(self._rates, (0.0, t[-1]), self._start, method=self._method,
                           t_eval=t, rtol=self.setting, atol=0.1 * self.setting)
        self.work = result.nfev
        if result.status:
            reached = result.t[-1] if len(result.t) else 0.0
            raise FailedError(f'status {result.status} at t = {reached} s: {result.message}')
        return result.y

    def attitudes(self, ns):
        theta, _, phi, psi = self.angles(ns)
        return attitudes_of_angles(theta, phi, psi)

    def samples(self, ns):
        theta, theta_dot, phi, psi = self.angles(ns)
        top, start = self.case.top, self.case.start
        phi_dot = (start.lz - start.l3 * np.cos(theta)) / (top.lambda1 * np.sin(theta) ** 2)
        transverse = (-phi_dot * np.sin(theta) + 1j * theta_dot) * np.exp(-1j * psi)
        spin = np.full(len(ns), start.l3 / top.lambda3)
        return Samples(attitudes_of_angles(theta, phi, psi),
                       np.stack((transverse.real, transverse.imag, spin), axis=1), phi, psi)


def quadratic_rates(y: Any, half_over_lambda1: Any, torque: Any, lz: Any) -> tuple[Any, ...]:
    """
    Return p' = (1/2) (0, L/lambda1) p and L' = torque: polynomials, regular everywhere.

    y: p (w, x, y, z), a quaternion that lacks the uniform spin (L3/lambda3 - L3/lambda1) t about
    the axis, and Lx, Ly.
    """
    w, x, yy, z, lx, ly = y
    a, b, c = half_over_lambda1 * lx, half_over_lambda1 * ly, half_over_lambda1 * lz
    return (-(a * x + b * yy + c * z), a * w + b * z - c * yy, b * w + c * x - a * z,
            c * w + a * yy - b * x, -torque * (2 * (yy * z - w * x)),
            torque * (2 * (x * z + w * yy)))


def quadratic_start(case: Case) -> list[float]:
    top, start = case.top, case.start
    cosine, sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
    phi_dot = attitude.precession_rate(top, start.l3, start.lz, cosine ** 2, sine ** 2)
    # Lx + i Ly from l3 along the axis and the rates across it.
    momentum = cmath.rect(1.0, start.phi) * complex(
        math.sin(start.theta) * (start.l3 - top.lambda1 * phi_dot * math.cos(start.theta)),
        top.lambda1 * start.theta_dot)
    x, y, z, w = attitudes_of_angles(*np.array([[start.theta], [start.phi], [start.psi]]))[0]
    return [w, x, y, z, momentum.real, momentum.imag]


def _spun(p: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return p turned about its own axis by `angle`; p (n, 4+) w, x, y, z; result x, y, z, w."""
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
    w, x, y, z = p.T[:4]
    return np.stack((x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s), axis=1)


class _Heyoka(Runner):
    """Taylor series of quaternion equations without poles."""

    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        import heyoka as hy
        top, l3 = case.top, case.start.l3
        self._spin = l3 / top.lambda3 - l3 / top.lambda1
        unknowns = hy.make_vars('w', 'x', 'y', 'z', 'lx', 'ly')
        rates = quadratic_rates(unknowns, 0.5 / top.lambda1, top.gravity_torque, case.start.lz)
        self._start = quadratic_start(case)
        self._integrator = hy.taylor_adaptive(list(zip(unknowns, rates, strict=True)),
                                              self._start, tol=setting)

    def states(self, ns: np.ndarray) -> np.ndarray:
        """Return (n, 6): p and Lx, Ly."""
        self._integrator.time = 0.0
        self._integrator.state[:] = self._start
        outcome, _, _, self.work, _, states = self._integrator.propagate_grid(ns / 1e9)
        if outcome.name != 'time_limit':        # heyoka's name for reaching the last instant
            raise FailedError(f'{outcome.name} at t = {self._integrator.time} s')
        return states

    def attitudes(self, ns):
        return _spun(self.states(ns), self._spin * (ns / 1e9))

    def samples(self, ns):
        y = self.states(ns)
        quaternion = _spun(y, self._spin * (ns / 1e9))
        momentum = y[:, 4], y[:, 5], self.case.start.lz
        top = self.case.top
        first, second, third = attitude.rotated_back(tuple(quaternion.T), momentum)
        return Samples(quaternion, np.stack(
            (first / top.lambda1, second / top.lambda1, third / top.lambda3), axis=1))


SCIPY = 1e-6, 1e-9, 1e-12
PEERS = (
    Peer('exact', 'ours', partial(_Ours, method='exact'), (0.0,), unit=''),
    *(Peer(f'rk45 {equations}', 'ours', partial(_Ours, method='rk45', equations=equations),
           (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)) for equations in ('transport', 'euler')),
    Peer('SciPy RK45', 'SciPy', partial(_SciPy, method='RK45'), (1e-3, 1e-6, 1e-9)),
    Peer('SciPy DOP853', 'SciPy', partial(_SciPy, method='DOP853'), SCIPY),
    Peer('SciPy LSODA', 'SciPy', partial(_SciPy, method='LSODA'), SCIPY),
    Peer('heyoka quadratic', 'heyoka', _Heyoka, (*SCIPY, 2.0 ** -52), unit='steps'),
)


def peer(name: str) -> Peer:
    return next(p for p in PEERS if p.name == name)
