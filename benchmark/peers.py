# SPDX-License-Identifier: Apache-2.0
"""
The methods that the benchmarks compare, with one interface.

`Peer.ready(case, setting)` compiles or loads a model, which is not timed.  The runner that it
returns computes attitudes, which is timed, or `Samples`, which can be checked.  Each method is
used at its fastest: MuJoCo steps in its own C loop, heyoka and diffrax compile.
"""

from __future__ import annotations

import cmath
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from cases import FINEST_HZ, FINEST_NS, Case

from spinning_top_sim import solve
from spinning_top_sim.physics import attitude
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.solve import motion_of


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

    def compile(self, ns: np.ndarray) -> None:
        """Compile what depends on the number of instants, untimed."""

    def attitudes(self, ns: np.ndarray) -> np.ndarray:
        """Return (n, 4) x, y, z, w at the instants ns [ns]: a uniform grid from 0 on."""
        raise NotImplementedError

    def samples(self, ns: np.ndarray) -> Samples:
        raise NotImplementedError


@dataclass(frozen=True)
class Peer:
    """A method: its name, its family (the package), its settings, and the unit of its work."""

    name: str
    family: str
    ready: Callable[[Case, float], Runner]
    settings: tuple[float, ...]
    unit: str = 'evaluations'
    needs: str = ''

    def label(self, setting: float) -> str:
        """Return the name with a setting: a tolerance, or steps a second."""
        text = f'{1e3 / setting:.3g} ms' if setting > 1.0 else f'{setting:.2g}' if setting else ''
        return f'{self.name} {text}'.strip()

    def missing(self) -> str | None:
        """Return why the method cannot be run here, or None."""
        absent = self.needs and find_spec(self.needs) is None
        return f'{self.needs} is not installed' if absent else None


class _Ours(Runner):
    def __init__(self, case: Case, setting: float, **options: Any) -> None:
        super().__init__(case, setting)
        self._options = options
        if setting:
            self._options |= {'rtol': setting, 'atol': 0.1 * setting}

    def _states(self, ns):
        propagator = motion_of(self.case.top, self.case.start, **self._options)
        states = propagator.states(ns)
        self.work = propagator.evaluations or None
        return states

    def attitudes(self, ns):
        return self._states(ns).quaternion

    def samples(self, ns):
        states = self._states(ns)
        return Samples(states.quaternion, states.angular_velocity, states.phi, states.psi)


class _ExactGrid(Runner):
    def attitudes(self, ns):
        solution = ExactSolution(self.case.top, self.case.start)
        return solution.states(range(0, int(ns[1]) * len(ns), int(ns[1]))).quaternion


def literal_rates(case: Case, y: Any, sin: Callable, cos: Callable) -> tuple[Any, ...]:
    """Return eqs. (29)-(32) of the paper, written literally."""
    top, start = case.top, case.start
    theta, theta_dot = y[0], y[1]
    s, c = sin(theta), cos(theta)
    phi_dot = (start.lz - start.l3 * c) / (top.lambda1 * s * s)
    psi_dot = start.l3 / top.lambda3 - phi_dot * c
    ratio, fall = top.lambda3 / top.lambda1, top.gravity_torque / top.lambda1
    return (theta_dot, phi_dot * phi_dot * s * c - ratio * (psi_dot + phi_dot * c) * phi_dot * s
            + fall * s, phi_dot, psi_dot)


def literal_start(case: Case) -> list[float]:
    start = case.start
    return [start.theta, start.theta_dot, start.phi, start.psi]


def attitudes_of_angles(theta, phi, psi) -> np.ndarray:
    """Return (n, 4) x, y, z, w."""
    half, plus, minus = 0.5 * theta, 0.5 * (phi + psi), 0.5 * (phi - psi)
    c, s = np.cos(half), np.sin(half)
    return np.stack((-s * np.sin(minus), s * np.cos(minus), c * np.sin(plus),
                     c * np.cos(plus)), axis=1)


class _Literal(Runner):
    """Whatever integrates (29)-(32): subclasses return theta, theta', phi, psi, (4, n)."""

    def angles(self, ns: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def attitudes(self, ns):
        theta, _, phi, psi = self.angles(ns)
        return attitudes_of_angles(theta, phi, psi)

    def samples(self, ns):
        y = self.angles(ns)
        theta, theta_dot, phi, psi = y
        with np.errstate(all='ignore'):
            phi_dot = literal_rates(self.case, y, np.sin, np.cos)[2]
            transverse = (-phi_dot * np.sin(theta) + 1j * theta_dot) * np.exp(-1j * psi)
        spin = np.full(len(ns), self.case.start.l3 / self.case.top.lambda3)
        return Samples(attitudes_of_angles(theta, phi, psi),
                       np.stack((transverse.real, transverse.imag, spin), axis=1), phi, psi)


class _SciPy(_Literal):
    def __init__(self, case: Case, setting: float, method: str) -> None:
        super().__init__(case, setting)
        self._method = method
        top, start, sin, cos = case.top, case.start, math.sin, math.cos
        lambda1, l3, lz = top.lambda1, start.l3, start.lz
        ratio, fall = top.lambda3 / lambda1, top.gravity_torque / lambda1
        spin = l3 / top.lambda3

        def rates(t, y):                # literal_rates with all constants at hand
            theta, theta_dot, _, _ = y.tolist()
            s, c = sin(theta), cos(theta)
            phi_dot = (lz - l3 * c) / (lambda1 * s * s)
            psi_dot = spin - phi_dot * c
            return (theta_dot, phi_dot * phi_dot * s * c
                    - ratio * (psi_dot + phi_dot * c) * phi_dot * s + fall * s, phi_dot, psi_dot)

        def rates_with_numpy(t, y):     # where Python would raise ZeroDivisionError: NaN
            return literal_rates(case, y, np.sin, np.cos)

        self._rates = rates_with_numpy if math.sin(start.theta) == 0.0 else rates

    def angles(self, ns):
        from scipy.integrate import solve_ivp
        t = ns / 1e9
        with np.errstate(all='ignore'):
            result = solve_ivp(self._rates, (0.0, t[-1]), literal_start(self.case),
                               method=self._method, t_eval=t, rtol=self.setting,
                               atol=0.1 * self.setting)
        self.work = result.nfev
        if result.status:
            reached = result.t[-1] if len(result.t) else 0.0
            raise FailedError(f'status {result.status} at t = {reached} s: {result.message}')
        return result.y


class _HeyokaLiteral(_Literal):
    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        import heyoka as hy
        unknowns = hy.make_vars('theta', 'theta_dot', 'phi', 'psi')
        rates = literal_rates(case, unknowns, hy.sin, hy.cos)
        # phi' and psi' as constants too: no symbol, no expression otherwise.
        self._integrator = hy.taylor_adaptive(
            list(zip(unknowns, rates, strict=True)), literal_start(case), tol=setting)

    def angles(self, ns):
        return _heyoka_grid(self, literal_start(self.case), ns).T


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


class _Quadratic(Runner):
    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        top, l3 = case.top, case.start.l3
        self._spin = l3 / top.lambda3 - l3 / top.lambda1

    def states(self, ns: np.ndarray) -> np.ndarray:
        """Return (n, 6): p and Lx, Ly."""
        raise NotImplementedError

    def attitudes(self, ns):
        return _spun(self.states(ns), self._spin * (ns / 1e9))

    def samples(self, ns):
        y = self.states(ns)
        quaternion = _spun(y, self._spin * (ns / 1e9))
        q = tuple(quaternion.T)
        momentum = y[:, 4], y[:, 5], self.case.start.lz
        top = self.case.top
        first, second, third = attitude.rotated_back(q, momentum)
        return Samples(quaternion, np.stack(
            (first / top.lambda1, second / top.lambda1, third / top.lambda3), axis=1))


class _HeyokaQuadratic(_Quadratic):
    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        import heyoka as hy
        unknowns = hy.make_vars('w', 'x', 'y', 'z', 'lx', 'ly')
        rates = quadratic_rates(unknowns, 0.5 / case.top.lambda1, case.top.gravity_torque,
                                case.start.lz)
        self._start = quadratic_start(case)
        self._integrator = hy.taylor_adaptive(list(zip(unknowns, rates, strict=True)),
                                              self._start, tol=setting)

    def states(self, ns):
        return _heyoka_grid(self, self._start, ns)


def _heyoka_grid(runner: Any, start: list[float], ns: np.ndarray) -> np.ndarray:
    integrator = runner._integrator
    integrator.time = 0.0
    integrator.state[:] = start
    outcome, _, _, steps, _, states = integrator.propagate_grid(ns / 1e9)
    runner.work = steps
    if outcome.name != 'time_limit':        # heyoka's name for reaching the last instant
        raise FailedError(f'{outcome.name} at t = {integrator.time} s')
    return states


@functools.cache
def _diffrax_solve() -> Callable:
    """Return run(t, start, constants, tolerance), compiled once for each shape of t."""
    import diffrax
    import jax
    jax.config.update('jax_enable_x64', True)
    import jax.numpy as jnp

    def rates(t, y, constants):
        return jnp.stack(quadratic_rates(y, *constants))

    @jax.jit
    def run(t, start, constants, tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates), diffrax.Dopri8(), 0.0, t[-1], None, start, constants,
            saveat=diffrax.SaveAt(ts=t), max_steps=100_000_000,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=0.1 * tolerance))
        return solution.ys, solution.stats['num_steps']
    return run


class _Diffrax(_Quadratic):
    """Dopri8 of diffrax, in doubles, compiled for the CPU."""

    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        self._run = _diffrax_solve()
        self._constants = 0.5 / case.top.lambda1, case.top.gravity_torque, case.start.lz

    def compile(self, ns):
        self._run(ns * 0.0, np.array(quadratic_start(self.case)), self._constants, 1e-3)

    def states(self, ns):
        states, steps = self._run(ns / 1e9, np.array(quadratic_start(self.case)),
                                  self._constants, self.setting)
        self.work = int(steps)
        return np.asarray(states)


class _MuJoCo(Runner):
    """A body on a ball joint at the pivot; setting: steps a second, a multiple of 512."""

    MODEL = """
    <mujoco><compiler balanceinertia="false" inertiafromgeom="false"/>
      <option timestep="{step!r}" gravity="0 0 {gravity!r}" integrator="{integrator}">
        <flag contact="disable" constraint="disable"/></option>
      <worldbody><body><joint type="ball"/>
        <inertial pos="0 0 {com!r}" mass="{mass!r}"
          diaginertia="{across!r} {across!r} {along!r}"/></body></worldbody></mujoco>"""

    def __init__(self, case: Case, setting: float, integrator: str) -> None:
        super().__init__(case, setting)
        import mujoco
        top, start = case.top, case.start
        assert setting % FINEST_HZ == 0
        self._model = mujoco.MjModel.from_xml_string(self.MODEL.format(
            step=1.0 / setting, gravity=-top.gravity, integrator=integrator, mass=top.mass,
            com=top.com_distance, along=top.lambda3,
            across=top.lambda1 - top.mass * top.com_distance ** 2))
        self._data = data = mujoco.MjData(self._model)
        x, y, z, w = attitudes_of_angles(*np.array([[start.theta], [start.phi], [start.psi]]))[0]
        omega = solve(top, start, [0.0]).angular_velocity[0]
        data.qpos[:], data.qvel[:] = (w, x, y, z), omega
        which = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._start = np.empty((1, mujoco.mj_stateSize(self._model, which)))
        mujoco.mj_getState(self._model, data, self._start[0], which)

    def states(self, ns: np.ndarray) -> np.ndarray:
        """Return (n, 7): w, x, y, z and body rates, every k-th step of MuJoCo's own loop."""
        from mujoco import rollout
        every = int(self.setting) * int(ns[1]) // (FINEST_HZ * FINEST_NS)
        result = np.empty((len(ns), 7))
        result[0] = self._start[0, 1:8]
        state, done, piece = self._start, 0, max(1, 200_000 // every)
        self.work = every * (len(ns) - 1)
        while done < len(ns) - 1:
            count = min(piece, len(ns) - 1 - done)
            states, _ = rollout.rollout(self._model, self._data, state, nstep=count * every)
            result[done + 1:done + 1 + count] = states[0, every - 1::every, 1:8]
            state, done = states[:, -1], done + count
        return result

    def attitudes(self, ns):
        return self.states(ns)[:, [1, 2, 3, 0]]

    def samples(self, ns):
        states = self.states(ns)
        return Samples(states[:, [1, 2, 3, 0]], states[:, 4:])


RTOL = 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13
SCIPY = 1e-6, 1e-9, 1e-12
TAYLOR = *SCIPY, 2.0 ** -52
RATES = 512.0, 2048.0, 8192.0
PEERS = (
    Peer('exact, any times', 'ours', partial(_Ours, method='exact'), (0.0,), unit=''),
    Peer('exact, grid', 'ours', _ExactGrid, (0.0,), unit=''),
    *(Peer(f'rk45 {equations}', 'ours', partial(_Ours, method='rk45', equations=equations), RTOL)
      for equations in ('transport', 'euler')),
    Peer('SciPy RK45', 'SciPy', partial(_SciPy, method='RK45'), (1e-3, 1e-6, 1e-9)),
    Peer('SciPy DOP853', 'SciPy', partial(_SciPy, method='DOP853'), SCIPY),
    Peer('SciPy LSODA', 'SciPy', partial(_SciPy, method='LSODA'), SCIPY),
    Peer('heyoka Euler', 'heyoka', _HeyokaLiteral, TAYLOR, unit='steps', needs='heyoka'),
    Peer('heyoka quadratic', 'heyoka', _HeyokaQuadratic, TAYLOR, unit='steps', needs='heyoka'),
    Peer('diffrax Dopri8 quadratic', 'diffrax', _Diffrax, SCIPY, unit='steps', needs='diffrax'),
    *(Peer(f'MuJoCo {integrator}', 'MuJoCo', partial(_MuJoCo, integrator=integrator), RATES,
           unit='steps', needs='mujoco') for integrator in ('RK4', 'implicit')),
)


def peer(name: str) -> Peer:
    return next(p for p in PEERS if p.name == name)
