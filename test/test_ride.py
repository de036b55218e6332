# SPDX-License-Identifier: Apache-2.0
"""
The top on a moving pivot.

data/ride.json holds motions to 30 digits, from Taylor series of Newton's and Euler's equations in
the frame of the pivot (data/make_references.py): nothing of a closed form is in them.
"""

import json
import math
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from gmpy2 import mpfr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top
from spinning_top_sim.physics import attitude, pivot
from spinning_top_sim.physics.pivot import Kinematics, PivotPath
from spinning_top_sim.physics.states import joined
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.solvers.multiprecision import BITS, precision
from spinning_top_sim.streams.trajectory import Trajectory

BOUND = 5e-15
S = 10 ** 9
CASES = {case['name']: case for case in json.loads(
    (Path(__file__).parent / 'data' / 'ride.json').read_text())['cases']}
GENERAL = State(theta=0.5, theta_dot=0.3, phi=0.1, psi=0.2, l3=1.6, lz=1.3)
TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
NOWHERE = (0.0, 0.0, 0.0)
RIDE = PivotPath([]).lasting(0)


def kinematics(path, times_ns):
    """Return position, velocity and acceleration (n, 3) of a pivot at times [ns]."""
    found = [pivot.kinematics(path.piece(int(t)), np.array([t])) for t in times_ns]
    return Kinematics(*(np.hstack(rows).T for rows in zip(*found, strict=True)))


def sample(trajectory, t_ns, point):
    """Return attitude w x y z, omega and alpha in the body, and where a point is at a time."""
    states = trajectory.after(t_ns).states(np.array([t_ns]))
    return (np.roll(states.quaternion[0], 1), states.angular_velocity[0],
            states.angular_acceleration[0], np.ravel(states.position(point)))


def errors(trajectory, case):
    """
    Return the worst error of a component of each quantity over max(1, its true size).

    Euler's equations give alpha as a difference of products of rates: it has the size of omega^2.
    """
    found = [sample(trajectory, t, case['point']) for t in case['times_ns']]
    worst = {}
    for name, rows in zip(('q', 'omega', 'alpha', 'position'), zip(*found, strict=True),
                          strict=True):
        worst[name] = 0.0
        for row, state in zip(rows, case['states'], strict=True):
            true = [Decimal(x) for x in state[name]]
            least = 1 if name != 'alpha' else max(
                1, *map(abs, true), *(Decimal(x) ** 2 for x in state['omega']))
            worst[name] = max(worst[name], *(
                float(abs(Decimal(float(x)) - y) / max(least, abs(y)))
                for x, y in zip(row, true, strict=True)))
    return worst


@pytest.mark.parametrize('name', CASES)
def test_a_chain_of_exact_motions_is_the_motion_on_a_moving_pivot(name):
    """Also after a thousand changes, and what is handed over last has all digits."""
    case = CASES[name]
    path = PivotPath(case['pieces'], position=case['position'], velocity=case['velocity'])
    run = Trajectory(Top(**case['top']), State(**case['start']), path, {'method': 'exact'},
                     most_acceleration=2.0)
    worst = errors(run, case)
    # In the longest one an error grows by some 1e10: the true motion is chaotic.
    assert max(worst.values()) <= BOUND, worst
    end, found = case['times_ns'][-1], []
    alpha, beta, across, l3 = run.after(end).posture(end)
    with precision(BITS):
        last = {key: [*map(mpfr, values)] for key, values in case['states'][-1].items()}
        parts = (alpha.real, -beta.imag, beta.real, alpha.imag, across.real, across.imag)
        for value, true in zip(parts, (*last['q'], *last['omega'][:2]), strict=True):
            found.append(min(abs(value - true), abs(value + true)) / max(1, abs(true)))
    assert l3 == case['start']['l3']
    # Half of the thirtieth digit, unless the motion is chaotic.
    assert max(found) <= (1e-26 if len(case['pieces']) == 1000 else 5e-30), found


@pytest.mark.parametrize('acceleration', [
    NOWHERE, (0.0, 0.0, -9.80665), (0.0, 0.0, -30.0), (4.0, -3.0, 2.0), (1e-12, 0.0, -9.80665),
    (1e-9, 0.0, -30.0), (-1e-9, 1e-9, 0.0), (1e4, 0.0, 0.0)])
@pytest.mark.parametrize('start', [
    GENERAL, State(theta=0.0, theta_dot=0.7, phi=1.0, psi=2.0, l3=0.5, lz=0.5),
    State(theta=math.pi, phi=1.0, psi=2.0, l3=0.5, lz=-0.5),
    State(theta=1e-9, theta_dot=0.2, phi=1.0, psi=2.0, l3=0.5, lz=0.5),
    State(theta=1.5707963267948966, l3=0.0, lz=0.0), State(theta=1e-6, l3=0.0, lz=0.0),
    State(theta=0.0018, theta_dot=0.008803139254, l3=0.0, lz=0.0),     # next to the separatrix
    State(theta=0.0, theta_dot=1e-50, l3=0.5, lz=0.5),
    State(theta=1e-15, theta_dot=1e-15, psi=1.0, l3=0.5, lz=0.5)])
def test_a_posture_is_handed_over_to_30_digits(start, acceleration):
    def begun(first, start_ns):
        return Piece(TOP, first, start_ns, ride(acceleration), method='exact')
    piece = begun(start, 0)
    first, whole, back, now = piece.posture(0), piece.posture(S), piece, 0
    for length in (1000, S // 3, S - S // 3 - 1000):
        now += length
        back = begun(back.posture(now), now)
    with precision(BITS):
        for one, other in zip(whole[:3], back.posture(S)[:3], strict=True):
            assert abs(one - other) < max(1, abs(one)) * 1e-30
    for t, (alpha, beta, across, _) in (0, first), (S, whole):
        states = piece.states(np.array([t]))
        q = states.quaternion[0]
        assert abs(q - [-beta.imag, beta.real, alpha.imag, alpha.real]).max() < 2e-15
        rates = np.array([across.real, across.imag], float)
        assert abs(states.angular_velocity[0, :2] - rates).max() < 5e-15 * max(1.0, *abs(rates))
    assert back.l3 == start.l3 == piece.l3
    force = np.array(acceleration) + np.array((0.0, 0.0, TOP.gravity))
    felt = np.ravel(attitude.rotated(states.rows_quaternion, states.specific_force(NOWHERE)))
    assert abs(felt - force).max() <= BOUND * max(1.0, np.linalg.norm(force))


def ride(acceleration):
    """Return a piece of a path of the pivot that begins at rest in the origin and never ends."""
    return RIDE._replace(acceleration=tuple(map(Fraction, acceleration)),
                         begins=np.array((*NOWHERE, *NOWHERE, *acceleration)))


def integrated(start, acceleration, times):
    """
    Return attitudes (n, 4), x y z w, by Newton and Euler in the world frame.

    q' = (1/2) omega q and L' = R e3 x M (g - a), with omega = L/lambda1 + (L3/lambda3 -
    L3/lambda1) e3: no frame of a vertical, no Euler angle but at the start.
    """
    first = Rotation.from_euler('ZYZ', (start.phi, start.theta, start.psi))
    sine = math.sin(start.theta)
    around = (start.lz - start.l3 * math.cos(start.theta)) / (TOP.lambda1 * sine)
    across = (-around + 1j * start.theta_dot) * np.exp(-1j * start.psi)
    momentum = first.apply((TOP.lambda1 * across.real, TOP.lambda1 * across.imag, start.l3))
    pull = TOP.mass * (np.array((0.0, 0.0, -TOP.gravity)) - acceleration) * TOP.com_distance

    def derivative(_, state):
        (x, y, z, w), momentum = state[:4], state[4:]
        axis = np.array((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))
        omega = momentum / TOP.lambda1 + (
            start.l3 / TOP.lambda3 - start.l3 / TOP.lambda1) * axis
        a, b, c = 0.5 * omega
        return [a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x,
                -a * x - b * y - c * z, *np.cross(axis, pull)]
    found = solve_ivp(derivative, (0.0, times[-1]), (*first.as_quat(), *momentum), 'DOP853',
                      times, rtol=3e-14, atol=4e-15)
    return found.y[:4].T


@pytest.mark.parametrize('tilt', [1e-9, 1e-8, 3e-8, 1e-6, 1e-3, 1.0])
def test_a_vertical_that_turns_by_little_is_not_the_one_of_the_world(tilt):
    acceleration = (TOP.gravity * math.tan(tilt), 0.0, 0.0)
    expected = integrated(GENERAL, acceleration, np.linspace(0.0, 0.5, 6))
    for method, bound in (('exact', 1e-13), ('rk45', 1e-9)):
        piece = Piece(TOP, GENERAL, 0, ride(acceleration), method=method)
        found = piece.states(np.arange(0, S // 2 + 1, S // 10)).quaternion
        assert abs(found - expected).max() <= bound
        assert (piece.states(np.arange(S // 10, S // 10 + 1)).quaternion[0] == found[1]).all()


def test_where_the_equations_cannot_go_on_the_error_says_up_to_when_they_do():
    piece = Piece(TOP, State(theta=0.8, theta_dot=-3.5, l3=0.5, lz=0.5), 5 * S,
                  equations='euler')
    with pytest.raises(IntegrationError, match='pole') as error:
        piece.states(np.arange(5 * S, 9 * S, S // 100))
    reached_ns = error.value.reached_ns
    assert len(piece.states(np.arange(5 * S, reached_ns + 1, S // 100))) > 10
    assert piece.states(np.arange(reached_ns, reached_ns + 1)).theta[0] < 0.1
    with pytest.raises(IntegrationError):
        piece.states(np.arange(reached_ns + S // 10, reached_ns + S // 10 + 1))


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_pieces_are_joined_and_known_again_with_another_end(method):
    """States of two pieces side by side, the pivot with them; a piece that turns too fast."""
    path = PivotPath([(S, (1.0, 2.0, 0.5)), (S, (0.0, 0.0, -9.80665))])
    first = Piece(TOP, GENERAL, 0, path.lasting(0), method=method)
    second = Piece(TOP, first.posture(S), S, path.lasting(S), method=method)
    parts = first.states(np.arange(0, S, S // 10)), second.states(np.arange(S, 2 * S, S // 10))
    both = joined(parts)
    for name in ('t', 'phi', 'phi_dot', 'psi_dot', 'theta_dot', 'theta_folded', 'quaternion',
                 'angular_velocity', 'angular_acceleration', 'energy', 'l3', 'lz'):
        assert (getattr(both, name) == np.concatenate([getattr(x, name) for x in parts])).all()
    point = (0.1, -0.2, 0.3)
    for name in ('specific_force', 'velocity', 'position', 'world_velocity'):
        assert (np.array(getattr(both, name)(point)) == np.hstack(
            [getattr(one, name)(point) for one in parts])).all(), name
    assert both.pivot.velocity[:, 11] == pytest.approx([1.0, 2.0, 0.5 - 0.980665])
    at = 1e-4                       # the velocity is that of the position
    near = first.states(np.arange(S // 2 - 100_000, S // 2 + 100_001, 100_000))
    moved = np.diff(np.array(near.position(point))[:, ::2], axis=1)[:, 0] / (2.0 * at)
    velocity = np.array(attitude.rotated(near.rows_quaternion, near.world_velocity(point)))[:, 1]
    assert moved == pytest.approx(velocity, abs=1e-6)
    truth = joined([one.truth(begin + np.arange(0, S, S // 10)) for one, begin in (
        (first, 0), (second, S))])
    assert abs(both.quaternion - truth.quaternion).max() < 1e-9
    braked = first.with_ride(first.ride._replace(end_ns=S // 2))
    assert braked.ride.end_ns == S // 2 < first.ride.end_ns
    assert (braked.states(np.arange(5)).quaternion == first.states(np.arange(5)).quaternion).all()
    with pytest.raises(ValueError, match=r'it turns at up to .* rad/s: must be at most 3.3e\+06'):
        Piece(TOP, State(theta=0.5, l3=1e6, lz=1.0), 0, method=method)


@pytest.mark.parametrize(('theta', 'lz'), [(1e-6, 5e-26), (1e-10, 5e-34), (1e-20, 1e-50)])
def test_a_pole_that_is_missed_by_little_is_not_passed_exactly(theta, lz):
    """The motion about a line of effective gravity is the one about the vertical."""
    times, start = np.arange(0, 20 * S, S // 3), State(theta=theta, l3=0.0, lz=lz)
    one, other = (Piece(TOP, start, 0, *pivot_moves, method='exact').states(times).quaternion
                  for pivot_moves in ((), (ride(NOWHERE),)))
    assert np.minimum(abs(one - other).max(1), abs(one + other).max(1)).max() <= BOUND


def test_next_to_the_line_of_effective_gravity_an_axis_stays_what_it_is():
    """Within 1e-30 rad it is taken for the line, as the documentation says."""
    for theta, falls in ((1e-29, True), (1e-31, False)):
        piece = Piece(TOP, State(theta=theta, l3=0.0, lz=0.0), 0, ride(NOWHERE), method='exact')
        assert (piece.states(np.array([20 * S])).theta_folded[0] > 0.0) == falls


# The path of the pivot

SQUARE = [(0.0, 0.0, 0.5), (1.1, 0.0, 0.5), (1.1, 1.1, 0.5), (0.0, 1.1, 0.5)]
TRIANGLE = [(0.1, 0.2, 0.3), (1.7, 0.3, -0.4), (0.6, 2.1, 0.9)]


@pytest.mark.parametrize('waypoints', [SQUARE, TRIANGLE, TRIANGLE[:2]])
def test_a_repeated_path_closes_exactly(waypoints):
    path = PivotPath.through(waypoints, speed=0.7, acceleration=1.3, repeat=True)
    piece, ends = path.piece(0), []
    while len(ends) < len(waypoints):
        piece = path.piece(piece.end_ns)
        if not kinematics(path, range(piece.start_ns, piece.start_ns + 1)).velocity.any():
            ends.append(piece.start_ns)
    cycle = ends[-1]
    for times in (0, cycle // 3, ends[0], cycle - 1):
        once, late = (kinematics(path, [t]) for t in (times, times + 10 ** 15 // cycle * cycle))
        assert all(map(np.array_equal, once, late))
    corners = kinematics(path, np.array([0, *ends]))
    assert abs(corners.position - [*waypoints, waypoints[0]]).max() <= 4e-16
    assert not corners.velocity.any()
    PivotPath([(S, (1.0, 0.0, 0.0)), (3 * S, (-1.0 / 3.0, 0.0, 0.0))], repeat=True)     # rounded


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 10 ** 11), st.tuples(*3 * [st.floats(-50, 50)])),
                min_size=1, max_size=6), st.booleans())
def test_position_and_velocity_are_those_of_exact_arithmetic(pieces, there_and_back):
    if there_and_back := there_and_back and min(pieces)[0] >= 10 ** 6:
        pieces = [*pieces, *((length, tuple(-x for x in a)) for length, a in pieces)]
    path = PivotPath(pieces, repeat=there_and_back)
    cycle = sum(length for length, _ in pieces)
    place, velocity, now = [Fraction(0)] * 3, [Fraction(0)] * 3, 0
    for length, a in (2 if there_and_back else 1) * pieces:
        t = Fraction(length, S)
        place = [p + t * v + t * t / 2 * Fraction(x) for p, v, x in zip(
            place, velocity, a, strict=True)]
        velocity = [v + t * Fraction(x) for v, x in zip(velocity, a, strict=True)]
        now += length
        # One before the boundary, where the parabola ends that leads here.
        found = kinematics(path, np.array([now - 1, now]))
        # Sums of terms that may cancel: each is within the largest speed times the time.
        scale = max(1.0, 50 * (cycle / S), 50 * (cycle / S) ** 2)
        assert abs(found.position[1] - [float(x) for x in place]).max() <= 1e-15 * scale
        assert abs(found.velocity[1] - [float(x) for x in velocity]).max() <= 1e-15 * scale
        assert abs(np.diff(found.position, axis=0)).max() <= 1e-15 * scale + 2e-9 * (
            1e2 * cycle / S + 1)
