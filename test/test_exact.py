# SPDX-License-Identifier: Apache-2.0
"""
The exact solution: against 30-digit references, against an integrator, and against itself.

data/reference_cases.json holds 32 motions at four times each, computed with 70 digits; its own
`conventions` say what the numbers mean.  The bound for everything is the one that `ExactSolution`
promises: 5e-15, relative for what is larger than 1.
"""

import gc
import itertools
import json
import math
import random
import subprocess
import sys
import weakref
from dataclasses import replace
from decimal import Context, Decimal, Inexact, localcontext
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.long_decimals import (
    atan2,
    carlson_rf,
    complete_integral,
    pi,
    sin_cos,
    sinh_cosh,
)

BOUND = 5e-15
CASES = json.loads((Path(__file__).parent / 'data' / 'reference_cases.json').read_text())['cases']
G = 9.81
YEAR_NS = 31_557_600 * 10 ** 9


def case_top(case):
    return Top(lambda1=case['lambda1'], lambda3=case['lambda3'], mass=case['M'],
               com_distance=case['R'], gravity=case['g'])


def case_start(case):
    return State(theta=case['theta0'], theta_dot=case['thetadot0'], phi=case['phi0'],
                 psi=case['psi0'], l3=case['L3'], lz=case['Lz'])


def case_id(case):
    return case['name']


def error(value, digits):
    """Error over max(1, |value|) of a double against a decimal string."""
    true = Decimal(digits)
    return float(abs(Decimal(float(value)) - true) / max(Decimal(1), abs(true)))


def difference(a, b):
    """The largest difference of two arrays over max(1, |b|)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return float(np.max(np.abs(a - b) / np.maximum(1.0, np.abs(b)), initial=0.0))


def columns(states):
    return np.column_stack((states.theta, states.theta_dot, states.phi, states.psi,
                            states.quaternion))


def whole_ns(t):
    """Nanoseconds of a double of seconds if that is exact, else None."""
    ns = Fraction(t) * 10 ** 9
    return int(ns) if ns.denominator == 1 else None


# ------------------------------------------------------------------------- against the references


@pytest.mark.parametrize('case', CASES, ids=case_id)
def test_array_states_agree_with_reference(case):
    states = ExactSolution(case_top(case), case_start(case)).states(np.array(case['times']))
    for i, reference in enumerate(case['states']):
        x, y, z, w = states.quaternion[i]
        assert max(map(error, (w, x, y, z), reference['q'])) <= BOUND
        assert error(states.theta[i], reference['theta']) <= BOUND
        assert error(states.theta_dot[i], reference['thetadot']) <= BOUND
        assert error(states.phi[i], reference['phi']) <= BOUND
        assert error(states.psi[i], reference['psi']) <= BOUND


@pytest.mark.parametrize('case', CASES, ids=case_id)
def test_scalar_states_and_grid_agree_with_reference_at_whole_nanoseconds(case):
    solution = ExactSolution(case_top(case), case_start(case))
    compared = 0
    for reference in case['states']:
        ns = whole_ns(reference['t'])
        if ns is None:
            continue
        compared += 1
        theta, theta_dot, phi, psi, *full_q = solution.state_at(ns)
        assert error(theta, reference['theta']) <= BOUND
        assert error(theta_dot, reference['thetadot']) <= BOUND
        assert error(phi, reference['phi']) <= BOUND
        assert error(psi, reference['psi']) <= BOUND
        grid = solution.quaternion_grid(ns - 700 * 1_234_567, 1_234_567, 1400)
        for x, y, z, w in (full_q, solution.quaternion_at(ns), grid[700]):
            assert max(map(error, (w, x, y, z), reference['q'])) <= BOUND
    assert compared


@pytest.mark.parametrize('case', CASES, ids=case_id)
def test_every_way_to_a_state_agrees(case):
    """Scalars, arrays of nanoseconds, grids: over ten years and both directions."""
    solution = ExactSolution(case_top(case), case_start(case))
    years = min(10 * YEAR_NS, solution.ns_limit)
    rng = random.Random(1)
    ns = [0, 1, -1, years, -years] + [rng.randint(-years, years) for _ in range(20)]
    states = solution.states_at_ns(np.array(ns))
    scalars = np.array([solution.full_state_at(n) for n in ns])
    assert difference(columns(states), scalars[:, :8]) <= BOUND
    speed = np.linalg.norm(scalars[:, 8:], axis=1).max()
    assert np.abs(states.angular_velocity - scalars[:, 8:]).max() <= BOUND * max(1.0, speed)
    assert difference([solution.quaternion_at(n) for n in ns], scalars[:, 4:8]) <= BOUND
    for start, step in ((years - 10 ** 12, 10 ** 9 + 1), (-years, 999_999), (5, -1_000)):
        grid = solution.quaternion_grid(start, step, 600)
        picked = (0, 1, 511, 512, 599)
        assert difference(grid[list(picked)],
                          [solution.quaternion_at(start + k * step) for k in picked]) <= BOUND


@pytest.mark.parametrize('case', CASES, ids=case_id)
def test_phases_do_not_drift_in_ten_years(case):
    """The theta functions in long decimals, at times that are exact both in seconds and ns."""
    solution = ExactSolution(case_top(case), case_start(case))
    for seconds in (316_000_000, -316_000_000, 271_828_182):
        if seconds > solution.time_limit:
            continue
        true = decimal_quaternion(solution.theta_motion, Decimal(seconds))
        array = solution.quaternion(np.array([float(seconds)]))[0]
        scalar = solution.quaternion_at(seconds * 10 ** 9)
        assert max(float(abs(Decimal(float(a)) - b))
                   for a, b in zip((*array, *scalar), true * 2, strict=True)) <= BOUND


def decimal_quaternion(motion, t):
    """Evaluate the solution at t seconds in long decimals; x, y, z, w."""
    with localcontext() as context:
        context.prec = motion.digits
        phase = motion.quarter0 + motion.offset0 + motion.quarter_rate * t
        quarters = int(phase.to_integral_value())
        y = (phase - quarters) * pi() / 2
        if motion.imaginary:
            sin, cos = sinh_cosh(motion.stretch * y)
            xi = -sin * sin
        else:
            sin, cos = sin_cos(y)
            xi = sin * sin
        values = []
        for factor in (motion.alpha, motion.beta):
            branch = factor.odd if quarters % 2 else factor.even
            real = factor.sign * branch.real(sin, cos, xi)
            if factor.crosses and quarters % 4 >= 2:
                real = -real
            imag = factor.sense * branch.imag(sin, cos, xi) if branch.imag else Decimal(0)
            angle = factor.rate * t + 2 * pi() * factor.phase_turns + factor.drift * y
            s, c = sin_cos(angle)
            values.append((real * c - imag * s, real * s + imag * c))
        (w, z), (y_, minus_x) = values
        size = (w * w + z * z + y_ * y_ + minus_x * minus_x).sqrt()
        return [x / size for x in (-minus_x, y_, z, w)]


# ------------------------------------------------------------------------------- every regime

TOP = Top(lambda1=0.002, lambda3=0.001, mass=0.5, com_distance=0.05, gravity=G)
UNIT = Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8)


def start(theta, theta_dot=0.0, *, l3, lz, phi=0.3, psi=-0.7):
    return State(theta=theta, theta_dot=theta_dot, phi=phi, psi=psi, l3=l3, lz=lz)


def steady_start(top, theta, l3):
    """Slow steady precession: lambda1 cos(theta) Omega^2 - L3 Omega + P = 0."""
    a, P = top.lambda1 * math.cos(theta), top.gravity_torque
    rate = 2 * P / (l3 + math.sqrt(l3 * l3 - 4 * a * P))
    return start(theta, l3=l3, lz=top.lambda1 * rate * math.sin(theta) ** 2 + l3 * math.cos(theta))


REGIMES = {
    'looping': (UNIT, start(0.6, l3=6.0, lz=4.5)),
    'wavy': (UNIT, start(0.6, l3=6.0, lz=6.0)),
    'cusp': (TOP, start(0.5, l3=0.2, lz=0.2 * math.cos(0.5))),
    'rising nutation': (UNIT, start(1.0, -0.8, l3=5.0, lz=3.0)),
    'near the top pole': (UNIT, start(1e-3, 0.5, l3=2.0, lz=2.0 + 1e-9)),
    'near the bottom pole': (UNIT, start(math.pi - 1e-6, 0.3, l3=2.0, lz=-2.0)),
    'through the top': (UNIT, start(0.4, -6.0, l3=2.0, lz=2.0)),
    'through the bottom': (UNIT, start(2.4, 1.0, l3=2.0, lz=-2.0)),
    'from the top': (UNIT, start(0.0, 1.5, l3=2.0, lz=2.0)),
    'from the bottom': (UNIT, start(math.pi, 1.5, l3=2.0, lz=-2.0)),
    'sleeping, stable': (TOP, start(0.0, l3=0.2, lz=0.2)),
    'sleeping, unstable': (UNIT, start(0.0, l3=1.0, lz=1.0)),
    'sleeping, stable, touched': (TOP, start(1e-8, l3=0.2, lz=0.2)),
    'sleeping, unstable, touched': (UNIT, start(1e-8, l3=1.0, lz=1.0)),
    'hanging': (UNIT, start(math.pi, l3=1.0, lz=-1.0)),
    'hanging, touched': (UNIT, start(math.pi, 1e-9, l3=0.0, lz=0.0)),
    'separatrix, m1 = 2e-25': (UNIT, start(1e-12, l3=0.3, lz=0.3)),
    'separatrix, m1 = 3e-41': (UNIT, start(1e-20, l3=0.3, lz=0.3)),
    'separatrix, m1 = 1e-121': (UNIT, start(1e-60, l3=0.3, lz=0.3)),
    'spherical pendulum': (UNIT, start(2.0, 0.4, l3=0.0, lz=0.9)),
    'planar, oscillating': (UNIT, start(2.0, 0.4, l3=0.0, lz=0.0)),
    'planar, rotating': (UNIT, start(2.0, 7.0, l3=0.0, lz=0.0)),
    'planar, rotating upside down': (replace(UNIT, gravity=-9.8),
                                     start(1.0, -7.0, l3=0.0, lz=0.0)),
    'no gravity': (replace(TOP, gravity=0.0), start(0.5, 2.0, l3=0.2, lz=0.1)),
    'pivot in the centre of mass': (replace(TOP, com_distance=0.0), start(0.5, l3=0.2, lz=0.1)),
    'no mass': (replace(TOP, mass=0.0), start(0.5, 1.0, l3=0.0, lz=0.0)),
    'next to no gravity': (replace(TOP, gravity=1e-12), start(0.5, 2.0, l3=0.2, lz=0.1)),
    'gravity upwards': (replace(TOP, gravity=-G), start(0.5, 1.0, l3=0.02, lz=0.02)),
    'centre of mass below': (replace(UNIT, com_distance=-0.5), start(0.4, -6.0, l3=2.0, lz=2.0)),
    'upside down through the bottom': (replace(UNIT, com_distance=-0.5),
                                       start(2.4, 6.0, l3=2.0, lz=-2.0)),
    'steady precession': (TOP, steady_start(TOP, 0.5, 0.2)),
    'steady precession, touched': (TOP, replace(steady_start(TOP, 0.5, 0.2), theta_dot=1e-6)),
    'nothing moves': (replace(TOP, gravity=0.0), start(0.5, l3=0.0, lz=0.0)),
    'fast': (replace(TOP, gravity=1e-3), start(0.5, l3=2.0, lz=2.0 * math.cos(0.5))),
    'longer than wide': (replace(UNIT, lambda3=1.7), start(0.6, 0.2, l3=-6.0, lz=4.5)),
}
regimes = pytest.mark.parametrize('top, state', REGIMES.values(), ids=REGIMES)


@regimes
def test_regime_starts_where_it_should(top, state):
    solution = ExactSolution(top, state)
    for values in (solution.state_at(0), columns(solution.states(np.zeros(1)))[0]):
        expected = (state.theta, state.theta_dot, state.phi, state.psi, *zyz(state))
        assert difference(values, expected) <= BOUND


def zyz(state):
    half, s, d = state.theta / 2, (state.phi + state.psi) / 2, (state.phi - state.psi) / 2
    return (-math.sin(half) * math.sin(d), math.sin(half) * math.cos(d),
            math.cos(half) * math.sin(s), math.cos(half) * math.cos(s))


@regimes
def test_regime_keeps_energy_and_both_momenta(top, state):
    solution = ExactSolution(top, state)
    t = np.concatenate((np.linspace(-30.0, 30.0, 301) / fastest_rate(top, state),
                        [1e4, 1e6, -1e6]))
    states = solution.states(t)
    x, y, z, w = states.quaternion.T
    omega1, omega2, omega3 = states.angular_velocity.T
    up = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z
    lz = top.lambda1 * (omega1 * up[0] + omega2 * up[1]) + top.lambda3 * omega3 * up[2]
    kinetic = top.lambda1 * (omega1 ** 2 + omega2 ** 2)
    energy = 0.5 * kinetic + top.gravity_torque * up[2]
    momentum = max(abs(state.l3), abs(state.lz), np.sqrt(top.lambda1 * kinetic.max()))
    assert np.abs(lz - state.lz).max() <= 3e-15 * momentum
    assert np.ptp(energy) <= 1e-14 * max(kinetic.max(), abs(top.gravity_torque))
    assert np.abs(np.cos(states.theta) - up[2])[:301].max() <= 1e-14
    assert np.abs(np.linalg.norm(states.quaternion, axis=1) - 1.0).max() <= 1e-15
    assert (np.abs(np.diff(states.quaternion[:301], axis=0)) < 1.0).all()   # sign continuous


@regimes
def test_regime_stays_within_its_bounds(top, state):
    solution = ExactSolution(top, state)
    t = np.linspace(0.0, 3.0 * (solution.nutation_period or 1.0), 400)
    slack = 3e-8                                    # of arccos near the poles
    folded = np.arccos(np.cos(solution.states(t).theta))
    assert folded.min() >= solution.theta_min - slack
    assert folded.max() <= solution.theta_max + slack
    if solution.nutation_period is not None:
        motion, period = solution.theta_motion, solution.nutation_period
        turning = np.array([float((k - motion.quarter0 - motion.offset0) / motion.quarter_rate)
                            for k in (2, 3)])
        folded = np.sort(np.arccos(np.cos(solution.states(turning).theta)))
        assert folded == pytest.approx([solution.theta_min, solution.theta_max], abs=slack)
        first, later = solution.full_state_at(0), solution.full_state_at(round(period * 1e9))
        assert abs(math.cos(first[0]) - math.cos(later[0])) <= 1e-8 * max(1.0, abs(first[1]))
        # One period on, phi and psi have advanced by their mean rates.
        assert later[2] - first[2] == pytest.approx(
            solution.mean_precession_rate * period, rel=1e-6, abs=1e-6)
        assert later[3] - first[3] == pytest.approx(
            solution.mean_spin_rate * period, rel=1e-6, abs=1e-6)


@regimes
def test_regime_agrees_with_an_integrator(top, state):
    """DOP853 on p' = (omega p)/2 with the top's angular momentum: no poles, no theta functions."""
    pytest.importorskip('scipy')
    t = np.array([-2.0, 3.0]) / fastest_rate(top, state)
    quaternions = solution_by_integration(top, state, t)
    assert np.abs(ExactSolution(top, state).quaternion(t) - quaternions).max() <= 1e-10


def fastest_rate(top, state):
    return max(1.0, abs(state.l3) / min(top.lambda1, top.lambda3), abs(state.theta_dot),
               math.sqrt(abs(top.gravity_torque) / top.lambda1))


def solution_by_integration(top, state, t):
    from scipy.integrate import solve_ivp
    l3, lz, lambda1, P = state.l3, state.lz, top.lambda1, top.gravity_torque
    x, y, z, w = zyz(state)
    s, c = math.sin(state.theta), math.cos(state.theta)
    half = math.tan(state.theta / 2)                # lambda1 phi' sin(theta), near the poles too:
    across = ((lz + l3) * half if lz + l3 else 0.0) / 2 + ((lz - l3) / half if lz - l3 else 0) / 2
    # L = across * (horizontal, -e1) + lambda1 theta' e2' + l3 e3, in the world
    cp, sp = math.cos(state.phi), math.sin(state.phi)
    Lx = -across * c * cp - lambda1 * state.theta_dot * sp + l3 * s * cp
    Ly = -across * c * sp + lambda1 * state.theta_dot * cp + l3 * s * sp

    def derivative(_, v):
        x, y, z, w, Lx, Ly = v
        n = 2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z
        o1, o2, o3 = ((L - l3 * e) / lambda1 for L, e in zip((Lx, Ly, lz), n, strict=True))
        k = l3 / top.lambda3
        return (0.5 * (o1 * w + o2 * z - o3 * y + k * y), 0.5 * (o2 * w + o3 * x - o1 * z - k * x),
                0.5 * (o3 * w + o1 * y - o2 * x + k * w),
                0.5 * (-o1 * x - o2 * y - o3 * z - k * z),
                -P * n[1], P * n[0])
    rows = []
    for end in t:
        run = solve_ivp(derivative, (0.0, end), (x, y, z, w, Lx, Ly), method='DOP853',
                        rtol=1e-12, atol=1e-14)
        rows.append(run.y[:4, -1])
    return np.array(rows)


def random_motions(count, seed):
    rng = random.Random(seed)
    for _ in range(count):
        lambda1 = 10 ** rng.uniform(-3, 1)
        top = Top(lambda1=lambda1, lambda3=lambda1 * 10 ** rng.uniform(-1, 0.3),
                  mass=10 ** rng.uniform(-1, 1), gravity=G,
                  com_distance=rng.choice((1, -1)) * 10 ** rng.uniform(-2, 0))
        P = abs(top.gravity_torque)
        scale = math.sqrt(P * lambda1)
        theta = rng.uniform(0.05, 3.1)
        l3 = rng.choice((1, -1)) * scale * 10 ** rng.uniform(-1, 0.7)
        lz = rng.choice((l3 * math.cos(theta), l3, -l3,
                         l3 * math.cos(theta) + rng.gauss(0, 1) * scale * math.sin(theta) ** 2))
        theta_dot = rng.choice((0.0, rng.gauss(0, 1) * math.sqrt(P / lambda1)))
        yield top, State(theta=theta, theta_dot=theta_dot, phi=rng.uniform(-9, 9),
                         psi=rng.uniform(-9, 9), l3=l3, lz=lz)


@pytest.mark.parametrize('top, state', list(random_motions(25, seed=4)))
def test_random_tops_agree_with_an_integrator(top, state):
    pytest.importorskip('scipy')
    t = np.array([-3.0, 5.0]) / fastest_rate(top, state)
    quaternions = solution_by_integration(top, state, t)
    assert np.abs(ExactSolution(top, state).quaternion(t) - quaternions).max() <= 1e-10


@pytest.mark.parametrize('top, state', list(random_motions(10, seed=5)))
def test_angular_velocity_is_the_derivative_of_the_attitude(top, state):
    solution = ExactSolution(top, state)
    rate = max(1.0, float(np.linalg.norm(solution.full_state_at(0)[8:])))
    t = np.linspace(0.0, 20.0, 50) / rate
    h = 1e-4 / rate
    before, now, after = (solution.states(t + k * h) for k in (-1, 0, 1))
    x, y, z, w = now.quaternion.T
    dx, dy, dz, dw = (after.quaternion - before.quaternion).T / (2 * h)
    omega = 2 * np.column_stack((w * dx - x * dw - y * dz + z * dy,
                                 w * dy - y * dw - z * dx + x * dz,
                                 w * dz - z * dw - x * dy + y * dx))
    assert np.abs(omega - now.angular_velocity).max() <= 1e-6 * max(rate, np.abs(omega).max())


# --------------------------------------------------------------------------------- symmetries


@pytest.mark.parametrize('top, state', list(random_motions(12, seed=6)))
class TestSymmetries:
    T = np.linspace(-2.0, 2.0, 41)

    def test_reversal(self, top, state):
        """Momenta turned round, the top goes back the way it came."""
        back = replace(state, theta_dot=-state.theta_dot, l3=-state.l3, lz=-state.lz)
        forth, back = (ExactSolution(top, x).states(t)
                       for x, t in ((state, self.T), (back, -self.T)))
        assert difference(back.theta, forth.theta) <= BOUND
        assert difference(back.theta_dot, -forth.theta_dot) <= BOUND
        assert difference(back.phi, forth.phi) <= BOUND
        assert difference(back.psi, forth.psi) <= BOUND
        assert difference(back.quaternion, forth.quaternion) <= BOUND

    def test_mirror_in_a_vertical_plane(self, top, state):
        image = replace(state, phi=-state.phi, psi=-state.psi, l3=-state.l3, lz=-state.lz)
        this, other = (ExactSolution(top, x).states(self.T) for x in (state, image))
        assert difference(other.theta, this.theta) <= BOUND
        assert difference(other.phi, -this.phi) <= BOUND
        assert difference(other.psi, -this.psi) <= BOUND
        assert difference(other.quaternion, this.quaternion * (-1, 1, -1, 1)) <= BOUND

    def test_turned_and_spun_start(self, top, state):
        turned = replace(state, phi=state.phi + 0.5, psi=state.psi - 1.25)
        this, other = (ExactSolution(top, x).states(self.T) for x in (state, turned))
        assert difference(other.theta, this.theta) <= BOUND
        assert difference(other.phi - turned.phi, this.phi - state.phi) <= 2e-14
        assert difference(other.psi - turned.psi, this.psi - state.psi) <= 2e-14

    def test_upside_down(self, top, state):
        """Seen upside down, theta -> pi - theta, psi -> -psi, L3 -> -L3, P -> -P."""
        other_top = replace(top, gravity=-top.gravity)
        other = replace(state, theta=math.pi - state.theta, theta_dot=-state.theta_dot,
                        psi=-state.psi, l3=-state.l3)
        this, other = (ExactSolution(a, b).states(self.T)
                       for a, b in ((top, state), (other_top, other)))
        # pi - theta was rounded to 1e-16, and the motions part from there.
        fastest = max(1.0, np.abs(this.theta_dot).max())
        assert np.abs(np.cos(other.theta) + np.cos(this.theta)).max() <= 1e-12 * fastest
        assert np.abs(np.abs(other.quaternion) - np.abs(this.quaternion[:, [2, 3, 0, 1]])
                      ).max() <= 1e-11 * fastest

    def test_restart_on_the_way(self, top, state):
        solution = ExactSolution(top, state)
        t = 10 ** 9
        theta, theta_dot, phi, psi, *_ = solution.state_at(t)
        theta %= 2.0 * math.pi
        if theta > math.pi:                         # a State has theta folded
            theta, theta_dot = 2.0 * math.pi - theta, -theta_dot
            phi, psi = phi + math.pi, psi - math.pi
        again = ExactSolution(top, replace(
            state, theta=theta, theta_dot=theta_dot, phi=phi, psi=psi))
        q, q_again = solution.quaternion_at(t + 10 ** 9), again.quaternion_at(10 ** 9)
        sign = math.copysign(1.0, sum(a * b for a, b in zip(q, q_again, strict=True)))
        assert difference(np.array(q_again) * sign, q) <= 1e-9


def test_planar_rotation_counts_turns():
    for gravity, theta_dot in itertools.product((9.8, -9.8, 0.0), (9.0, -9.0)):
        solution = ExactSolution(replace(UNIT, gravity=gravity),
                                 start(1.0, theta_dot, l3=0.0, lz=0.0))
        t = np.linspace(-20.0, 20.0, 20001)
        theta = solution.states(t).theta
        assert (np.sign(np.diff(theta)) == np.sign(theta_dot)).all()
        assert np.abs(np.diff(theta)).max() < 0.03
        assert solution.states(np.array([t[-1]])).theta[0] == theta[-1]
        assert solution.state_at(20 * 10 ** 9)[0] == pytest.approx(theta[-1], rel=1e-15)


def test_unstable_sleeper_leaves_exponentially():
    """Without spin, theta = theta0 cosh(sqrt(P/lambda1) t) while it is small."""
    rate = math.sqrt(UNIT.gravity_torque / UNIT.lambda1)
    for theta0 in (1e-12, 1e-40, 1e-140):
        solution = ExactSolution(UNIT, start(theta0, l3=0.0, lz=0.0))
        t = math.log(1e-6 / theta0) / rate
        expected = theta0 * math.cosh(rate * t)
        assert solution.states(np.array([t])).theta[0] == pytest.approx(expected, rel=1e-11)
        assert solution.theta_max == pytest.approx(math.pi, abs=1e-15)


def test_rates_of_equilibria():
    sleeping = ExactSolution(TOP, start(0.0, l3=0.2, lz=0.2))
    assert sleeping.nutation_period is None
    assert sleeping.mean_precession_rate == 0.2 / (2 * TOP.lambda1)
    assert sleeping.mean_spin_rate == 0.2 / TOP.lambda3 - 0.2 / (2 * TOP.lambda1)
    assert (sleeping.theta_min, sleeping.theta_max) == (0.0, 0.0)
    steady = ExactSolution(TOP, steady_start(TOP, 0.5, 0.2))
    a, P = TOP.lambda1 * math.cos(0.5), TOP.gravity_torque
    rate = 2 * P / (0.2 + math.sqrt(0.2 ** 2 - 4 * a * P))
    assert steady.mean_precession_rate == pytest.approx(rate, rel=1e-14)
    assert ExactSolution(replace(TOP, gravity=0.0), start(0.5, l3=0.0, lz=0.0)
                         ).nutation_period is None


def test_small_oscillation_has_the_pendulum_period():
    solution = ExactSolution(UNIT, start(math.pi - 1e-7, l3=0.0, lz=0.0))
    # u = cos(theta) repeats twice in a swing.
    assert solution.nutation_period == pytest.approx(
        math.pi / math.sqrt(UNIT.gravity_torque / UNIT.lambda1), rel=1e-13)
    assert solution.m1 == pytest.approx(1.0, abs=1e-13)


# ------------------------------------------------------------------------------- edge inputs


def test_empty_single_and_unsorted_times():
    solution = ExactSolution(*REGIMES['looping'])
    assert solution.quaternion(np.zeros(0)).shape == (0, 4)
    assert solution.states(np.zeros(0)).angular_velocity.shape == (0, 3)
    assert solution.quaternion_grid(0, 10 ** 6, 0).shape == (0, 4)
    assert solution.quaternion_grid(7, 0, 3).shape == (3, 4)
    t = np.random.default_rng(3).uniform(-50, 50, 9001)
    order = np.argsort(t)
    assert difference(solution.quaternion(t)[order], solution.quaternion(t[order])) <= 2e-16
    assert difference(solution.quaternion(t[17:18])[0], solution.quaternion(t)[17]) <= 2e-16
    assert (solution.states(t).phi[order] == solution.states(t[order]).phi).all()


def test_columns_belong_to_the_times_that_were_given():
    solution = ExactSolution(*REGIMES['looping'])
    t = np.array([1.0, 2.0])
    states = solution.states(t)
    t += 5.0
    assert (states.theta == solution.states(np.array([1.0, 2.0])).theta).all()


@pytest.mark.parametrize('t', [[math.nan], [0.0, math.inf], [-math.inf], [1e300]])
def test_times_that_are_none_are_refused(t):
    solution = ExactSolution(*REGIMES['looping'])
    with pytest.raises(ValueError, match='t = '):
        solution.states(np.array(t))


def test_grids_of_many_steps_side_by_side():
    solution = ExactSolution(*REGIMES['cusp'])
    for _ in range(2):
        for step in range(1_000_000, 1_000_040):
            grid = solution.quaternion_grid(7, step, 2)
            assert difference(grid[1], solution.quaternion_at(7 + step)) <= BOUND


@pytest.mark.parametrize('theta, l3, lz', [
    (0.0028, 1.0, 1.0 + 1e-7), (0.003, 0.5, 0.5), (0.003, 1.0, 1.0), (0.0032, 0.5, 0.5),
    (0.0036, 0.9, 0.9 + 9e-8), (0.02, 1.5, 1.5)])
def test_near_the_separatrix_a_grid_is_as_good_as_its_angles(theta, l3, lz):
    """m1 from 2e-6 to 2e-4, where the series for a whole turn would cancel."""
    state = start(theta, l3=l3, lz=lz)
    motion = solve(UNIT, state, np.arange(-5_000, 10_000) * 1e-3)
    assert 2e-6 < motion.solution.m1 < 2e-4
    sine, cosine = np.sin(0.5 * motion.theta), np.cos(0.5 * motion.theta)
    plus, minus = 0.5 * (motion.phi + motion.psi), 0.5 * (motion.phi - motion.psi)
    of_angles = np.column_stack((-sine * np.sin(minus), sine * np.cos(minus),
                                 cosine * np.sin(plus), cosine * np.cos(plus)))
    assert np.abs(motion.quaternion - of_angles).max() <= BOUND
    grid = ExactSolution(UNIT, state).quaternion_grid(-5 * 10 ** 9, 10 ** 6, 15_000)
    assert np.abs(grid - of_angles).max() <= BOUND


# The fastest phase in turns per second, by hand: (phi + psi)/2 of a sleeping top, and the
# nutation of a free rotation, which takes two quarter periods a turn.
FASTEST_TURNS = {
    'sleeping': (replace(UNIT, lambda3=0.001), start(0.0, l3=3.0, lz=3.0),
                 0.5 * 3.0 / 0.001 / (2.0 * math.pi)),
    'free rotation': (replace(UNIT, gravity=0.0), start(0.4, 250.0, l3=0.0, lz=0.0),
                      250.0 / math.pi),
}


@pytest.mark.parametrize('name', FASTEST_TURNS)
def test_times_end_where_the_fastest_phase_has_made_2_to_the_52_turns(name):
    top, state, turns_per_second = FASTEST_TURNS[name]
    limit = 2.0 ** 52 / turns_per_second
    assert ExactSolution(top, state).time_limit == pytest.approx(limit, rel=1e-12)
    for sign in (1.0, -1.0):
        inside = solve(top, state, [sign * limit * (1.0 - 1e-9)])
        assert np.isfinite(inside.quaternion).all() and np.isfinite(inside.phi).all()
        with pytest.raises(ValueError, match='must be finite and within'):
            assert solve(top, state, [0.0, sign * limit * (1.0 + 1e-9)]).quaternion is None


def test_bad_arrays_and_counts_are_refused():
    solution = ExactSolution(*REGIMES['looping'])
    with pytest.raises(ValueError, match='shape'):
        solution.states(np.zeros((2, 2)))
    with pytest.raises(ValueError, match='nanoseconds'):
        solution.states_at_ns(np.zeros(2))
    with pytest.raises(ValueError, match='count'):
        solution.quaternion_grid(0, 1, -1)
    with pytest.raises(ValueError, match='t = '):
        solution.quaternion_at(10 ** 400)
    with pytest.raises(ValueError, match='t = '):
        solution.full_state_at(-10 ** 30)
    with pytest.raises(ValueError, match='t = '):
        solution.quaternion_grid(0, 10 ** 20, 10 ** 9)


EXTREMES = (0.0, 5e-324, 1e-310, 1e-150, 1e-20, 1.0, 1e3, 1e20, 1e150, 1.7e308)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('seed', range(6))
def test_extreme_inputs_are_solved_or_refused(seed):
    """A right start and finite numbers, or a ValueError: no other exception, no NaN, no hang."""
    rng = random.Random(seed)
    solved = 0
    for _ in range(100):
        def pick(values=EXTREMES):
            return rng.choice((1, -1)) * rng.choice(values)
        theta = rng.choice((0.0, math.pi, 1.0, 2.0, 1e-8, 1e-100, 1e-160, 5e-324))
        l3 = pick()
        lz = {0.0: l3, math.pi: -l3}.get(theta, rng.choice((pick(), l3, -l3)))
        try:
            top = Top(lambda1=abs(pick(EXTREMES[1:])), lambda3=abs(pick(EXTREMES[1:])),
                      mass=abs(pick()), com_distance=pick(), gravity=pick())
            state = State(theta=theta, theta_dot=pick(), phi=pick(), psi=pick(), l3=l3, lz=lz)
            solution = ExactSolution(top, state)
            t = [x for x in (0.0, 1.0, -3.5, 1e3) if abs(x) <= solution.time_limit]
            states = solution.states(np.array(t))
            values = np.column_stack((columns(states), states.angular_velocity))
            scalar = solution.full_state_at(0)
        except ValueError as refusal:
            assert len(str(refusal)) > 20
            continue
        solved += 1
        assert np.isfinite(values).all()
        assert np.isfinite(scalar).all()
        expected = (state.theta, state.theta_dot, state.phi, state.psi)
        assert difference(scalar[:4], expected) <= 1e-14
    assert solved > 5


@pytest.mark.parametrize('top, state', [
    (Top(lambda1=0.5, lambda3=1.0, mass=2e8, com_distance=1.0, gravity=G),
     start(1.0, 4.838e-20, l3=55810.0, lz=55810.0)),
    (Top(lambda1=0.196, lambda3=1.0, mass=67.69, com_distance=1.0, gravity=G),
     start(math.pi - 8e-14, 3.5e-31, l3=1.07e-12, lz=1.07e-12)),
    (Top(lambda1=15.463371957511931, lambda3=1.0, mass=35086630.49369044, com_distance=1.0,
         gravity=G),
     start(3.141590416121667, 3.199103207571675e-34, l3=0.29947830013747967,
           lz=0.02329830159939593)),
    (Top(lambda1=7.078571047581468e-18, lambda3=1.0, mass=12.19625939538337, com_distance=1.0,
         gravity=G),
     start(3.141592636054256, 1.2982985058408475e-22, l3=-5.702321402634462e-16,
           lz=-5.702321402634462e-16)),
])
def test_a_rate_of_next_to_nothing_is_right_or_refused(top, state):
    """What the constants of the motion lose of the start is not passed over in silence."""
    try:
        motion = solve(top, state, [0.0])
        found = motion.theta[0], motion.theta_dot[0]
    except ValueError as refusal:
        assert 'too far apart' in str(refusal)
        return
    assert found == pytest.approx((state.theta, state.theta_dot), rel=1e-14, abs=1e-14)


def test_huge_start_angles_keep_their_fraction_of_a_turn():
    top, state = REGIMES['looping']
    for phi, psi in ((1e300, 0.0), (1e20, -3.0), (-1e15, 1e15)):
        solution = ExactSolution(top, replace(state, phi=phi, psi=psi))
        with localcontext() as context:
            context.prec = 400
            sine, cosine = sin_cos((Decimal(phi) + Decimal(psi)) / 2)
        _, _, z, w = solution.quaternion_at(0)
        assert z == pytest.approx(float(sine) * math.cos(state.theta / 2), abs=1e-15)
        assert w == pytest.approx(float(cosine) * math.cos(state.theta / 2), abs=1e-15)
        assert solution.state_at(0)[2:4] == (phi, psi)


def test_the_caller_s_decimal_context_does_not_matter():
    expected = ExactSolution(*REGIMES['cusp'])
    with localcontext(Context(prec=3, traps=[Inexact])):
        solution = ExactSolution(*REGIMES['cusp'])
        assert solution.full_state_at(10 ** 15) == expected.full_state_at(10 ** 15)
        grid = solution.quaternion_grid(10 ** 15, 10 ** 6, 5)
    assert (grid == expected.quaternion_grid(10 ** 15, 10 ** 6, 5)).all()


@pytest.mark.parametrize('name', sorted(REGIMES))
def test_a_solution_leaves_nothing_for_the_garbage_collector(name):
    """A node makes one at each command: after use, and after a refusal."""
    top, state = REGIMES[name]
    solution = ExactSolution(top, state)
    attitude = solution.quaternion_at(0)
    assert difference(attitude, zyz(state)) <= BOUND
    assert difference(solution.full_state_at(0)[4:8], zyz(state)) <= BOUND
    with pytest.raises(ValueError, match=r'2\^52 turns'):
        solution.quaternion_at(10 ** 400)
    there = weakref.ref(solution)
    gc.disable()
    try:
        del solution
        assert there() is None
    finally:
        gc.enable()


# ------------------------------------------------------------------------------ long decimals


def test_long_decimal_functions():
    with localcontext() as context:
        context.prec = 60
        digits = Decimal(10) ** -57
        assert abs(pi() - Decimal('3.14159265358979323846264338327950288419716939937510582097494'
                                  '459')) < digits
        s, c = sin_cos(pi() / 6)
        assert abs(s - Decimal('0.5')) < digits
        assert abs(c * c - Decimal('0.75')) < digits
        tiny = Decimal('1e-200')
        assert sin_cos(tiny)[0] == tiny == sinh_cosh(tiny)[0]
        assert abs(atan2(Decimal(-1), Decimal(-1)) + 3 * pi() / 4) < digits
        # K(1/2) in both ways [DLMF 19.25.1]
        half = Decimal('0.5')
        assert abs(carlson_rf(Decimal(0), half, Decimal(1)) - complete_integral(half)) < digits


# ------------------------------------------------------------------------------------ imports


@pytest.mark.parametrize('call, forbidden', [
    ('quaternion_at(5); s.full_state_at(5)', ('numpy', 'scipy')),
    ('states([0.0, 1.0]).quaternion; s.quaternion_grid(0, 1, 9)', ('scipy',)),
])
def test_nothing_is_imported_in_vain(call, forbidden):
    code = f"""
import sys
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
s = ExactSolution(Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8),
                  State(theta=0.5, l3=2.0, lz=1.0))
s.{call}
print([name for name in {forbidden!r} if name in sys.modules])
"""
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True,
                         cwd=Path(__file__).parent.parent)
    assert run.stdout.strip() == '[]'
