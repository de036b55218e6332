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
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from gmpy2 import mpfr
from helpers.tops import EXACT

from spinning_top_sim import State, Top
from spinning_top_sim.physics import attitude, pivot
from spinning_top_sim.physics.pivot import Kinematics, PivotPath
from spinning_top_sim.physics.states import States, joined
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.solvers.theta import precision
from spinning_top_sim.solvers.vertical import Posture
from spinning_top_sim.streams.trajectory import Trajectory

S = 10 ** 9
CASES = {case['name']: case for case in json.loads(
    (Path(__file__).parent / 'data' / 'ride.json').read_text())['cases']}
TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)


def kinematics(path, times_ns):
    """Return position, velocity and acceleration (n, 3) of a pivot at times [ns]."""
    found = [pivot.kinematics(path.ride(int(t)), np.array([t])) for t in times_ns]
    return Kinematics(*(np.hstack(rows).T for rows in zip(*found, strict=True)))


def trajectory(case, **settings):
    path = PivotPath(case['pieces'], position=case['position'], velocity=case['velocity'])
    return Trajectory(Top(**case['top']), State(**case['start']), path, settings,
                      most_acceleration=2.0)


def worst_error(trajectory, case):
    """
    Return the worst error of a component of each quantity over max(1, its true size).

    Euler's equations give alpha as a difference of products of rates: it has the size of omega^2.
    """
    worst = 0.0
    for t_ns, state in zip(case['times_ns'], case['states'], strict=True):
        states = trajectory.after(t_ns).states(np.array([t_ns]))
        squares = [Decimal(x) ** 2 for x in state['omega']]
        for name, found, least in (
                ('q', np.roll(states.quaternion[0], 1), 1),
                ('omega', states.angular_velocity[0], 1),
                ('alpha', states.angular_acceleration[0],
                 max(1, *squares, *(abs(Decimal(x)) for x in state['alpha']))),
                ('position', np.ravel(states.position(case['point'])), 1)):
            worst = max(worst, *(
                float(abs(Decimal(float(x)) - y) / max(least, abs(y)))
                for x, y in zip(found, map(Decimal, state[name]), strict=True)))
    return worst


@pytest.mark.parametrize('name', CASES)
def test_a_chain_of_exact_motions_is_the_motion_on_a_moving_pivot(name):
    """Also after a thousand changes, and what is handed over last has all digits."""
    case = CASES[name]
    run = trajectory(case, method='exact')
    # In the longest one an error grows by some 1e10: the true motion is chaotic.
    assert worst_error(run, case) <= EXACT
    end, found = case['times_ns'][-1], []
    alpha, beta, transverse, l3, *_ = run.after(end).posture(end)
    with precision():
        last = {key: [*map(mpfr, values)] for key, values in case['states'][-1].items()}
        parts = (alpha.real, -beta.imag, beta.real, alpha.imag, transverse.real,
                 transverse.imag)
        for value, true in zip(parts, (*last['q'], *last['omega'][:2]), strict=True):
            found.append(min(abs(value - true), abs(value + true)) / max(1, abs(true)))
    assert l3 == case['start']['l3']
    # Half of the thirtieth digit, unless the motion is chaotic.
    assert max(found) <= (1e-26 if len(case['pieces']) == 1000 else 5e-30), found


@pytest.mark.parametrize('name', ['vertical turned by 1e-09 rad', 'vertical turned by 3e-08 rad',
                                  'vertical turned by 30 deg', 'sleeping top pushed'])
def test_steps_on_a_moving_pivot_are_the_motion(name):
    assert worst_error(trajectory(CASES[name], method='rk45', rtol=1e-11), CASES[name]) <= 1e-8


def ride(acceleration):
    """Return a piece of a path of the pivot that begins at rest in the origin and never ends."""
    return pivot.REST._replace(acceleration=tuple(map(Fraction, acceleration)),
                               at_start=Kinematics(*np.reshape((*6 * (0.0,), *acceleration),
                                                               (3, 3, 1))))


@pytest.mark.parametrize('acceleration', [
    (0.0, 0.0, 0.0), (0.0, 0.0, -9.80665), (1e-9, 0.0, -30.0), (-1e-9, 1e-9, 0.0),
    (1e4, 0.0, 0.0)])
@pytest.mark.parametrize('start', [
    State(theta=0.0, theta_dot=0.7, phi=1.0, psi=2.0, l3=0.5, lz=0.5),
    State(theta=math.pi, phi=1.0, psi=2.0, l3=0.5, lz=-0.5),
    State(theta=1e-9, theta_dot=0.2, phi=1.0, psi=2.0, l3=0.5, lz=0.5),
    State(theta=1e-6, l3=0.0, lz=5e-26), State(theta=0.0, theta_dot=1e-50, l3=0.5, lz=0.5),
    State(theta=1e-20, l3=0.0, lz=1e-50), Posture(5e-21 + 0j, 1 + 0j, 0.7 + 0.1j, 0.0),
    State(theta=0.8, theta_dot=-3.5, l3=0.5, lz=0.5),
    State(theta=3.0, theta_dot=9.0, l3=0.5, lz=-0.5), State(theta=0.8, theta_dot=-9.0, l3=0, lz=0),
    State(theta=0.0018, theta_dot=0.008803139254, l3=0.0, lz=0.0)])     # next to the separatrix
def test_a_posture_is_handed_over_to_30_digits(start, acceleration):
    """And while the pivot rests, the motion is that about the vertical of the world."""
    piece = back = Piece(TOP, start, 0, ride(acceleration), method='exact')
    for now in (1000, S // 3, S):
        back = Piece(TOP, back.posture(now), now, ride(acceleration), method='exact')
    with precision():
        for one, other in zip(piece.posture(S)[:3], back.posture(S)[:3], strict=True):
            assert abs(one - other) < max(1, abs(one)) * 1e-30
    states = piece.states(np.array([S]))
    force = np.add(acceleration, (0.0, 0.0, TOP.gravity))
    felt = np.ravel(attitude.rotated(states.rows_quaternion,
                                     states.specific_force((0.0, 0.0, 0.0))))
    assert abs(felt - force).max() <= EXACT * max(1.0, np.linalg.norm(force))
    if not any(acceleration):
        one, other = (of.states(np.arange(0, 20 * S, S // 3)).quaternion for of in (
            piece, Piece(TOP, start, 0, method='exact')))
        assert np.minimum(abs(one - other), abs(one + other)).max() <= EXACT


def test_steps_beside_a_pole_begin_with_all_that_is_handed_over():
    """A sleeping top: in doubles, Lz is L3, and the state rests."""
    posture, times_ns = Posture(1.0 + 0j, 5e-9 + 0j, 1e-7j, 1.6), range(0, 2 * S, S // 10)
    exact, steps = (np.array(Piece(TOP, posture, 0, method=method).states(times_ns).rows_axis[:2])
                    for method in ('exact', 'rk45'))
    assert abs(exact).max() < 5e-8 and abs(steps - exact).max() <= 1e-9 * abs(exact).max()


def test_an_error_says_up_to_when_states_can_be_had():
    piece = Piece(TOP, State(theta=0.8, theta_dot=-3.5, l3=0.5, lz=0.5), 5 * S, equations='euler')
    with pytest.raises(IntegrationError, match='pole') as error:
        piece.states(np.array([9 * S]))
    assert piece.states(np.array([error.value.reached_ns])).theta[0] < 0.1


def test_a_piece_goes_on_as_long_as_another_ride():
    longer = ride((0.5, 0, 0))._replace(end_ns=9 * S)
    piece = Piece(TOP, State(theta=0.5, l3=1.6, lz=1.3), 0, ride((0.5, 0, 0)))
    assert piece.with_ride(longer).ride is longer


def test_joined_states_have_the_columns_of_their_parts():
    """All of them, though the parts have starts, verticals and solvers of their own."""
    parts = [Piece(TOP, State(theta=0.5, theta_dot=0.3, l3=l3, lz=1.3), 0, where,
                   method=method).states(range(0, S, S // 3))
             for l3, where, method in ((1.6, pivot.REST, 'exact'), (1.1, pivot.REST, 'rk45'),
                                       (0.7, ride((1.0, 2.0, 0.5)), 'exact'))]

    def rows(of, name):
        value = getattr(of, name)
        return [np.broadcast_to(row, (*np.shape(row)[:-1], len(of)))
                for row in (value if isinstance(value, tuple) else [value.T])]

    whole, columns = joined(parts), [
        name for name, of in vars(States).items()
        if isinstance(of, property | cached_property)]
    assert 'psi_dot' in columns
    for name in columns:
        assert np.array_equal(rows(whole, name), np.concatenate(
            [rows(part, name) for part in parts], axis=-1)), name


TRIANGLE = [(0.1, 0.2, 0.3), (1.7, 0.3, -0.4), (0.6, 2.1, 0.9)]


@pytest.mark.parametrize('waypoints', [TRIANGLE, TRIANGLE[:2]])
def test_a_repeated_path_closes(waypoints):
    path = PivotPath.through(waypoints, speed=0.7, acceleration=1.3, repeat=True)
    now, ends = path.ride(0), []
    while len(ends) < len(waypoints):
        now = path.ride(now.end_ns)
        if not kinematics(path, [now.start_ns]).velocity.any():
            ends.append(now.start_ns)
    cycle = ends[-1]
    for times in (0, cycle // 3, ends[0], cycle - 1):
        once, late = (kinematics(path, [t]) for t in (times, times + 10 ** 15 // cycle * cycle))
        assert all(map(np.array_equal, once, late))
    corners = kinematics(path, np.array([0, *ends]))
    assert abs(corners.position - [*waypoints, waypoints[0]]).max() <= 4e-16
    assert not corners.velocity.any()


def test_a_repeated_path_that_does_not_close_goes_on():
    """With a velocity that is the same after a cycle, but for rounding."""
    path = PivotPath([(S, (1.0, 0.0, 0.3)), (3 * S, (-1.0 / 3.0, 0.0, -0.1))],
                     repeat=True, velocity=(0.0, 0.5, 0.0))
    found = kinematics(path, [S, 4 * S - 1, 4 * S, 4 * S * 10 ** 6 + S])
    # 0.5 m in the first second, and 1 s + 3 s at a mean of 0.5 m/s in a cycle.
    assert found.position[:, 0] == pytest.approx([0.5, 2.0, 2.0, 2e6 + 0.5], rel=1e-15)
    assert found.velocity[:, 0] == pytest.approx([1.0, 1e-9 / 3.0, 0.0, 1.0], abs=1e-15)
    assert found.acceleration[:, 2].tolist() == [-0.1, -0.1, 0.3, -0.1]


def test_a_path_that_is_not_repeated_ends_at_its_last_waypoint():
    """The first leg has ramps of 0.75 s and a cruise of 1.25 s, the other two ramps of 0.5 s."""
    path = PivotPath.through([(1, 0, 0), (4, 0, 0), (4, 0.5, 0)], speed=1.5, acceleration=2.0)
    found = kinematics(path, [0, 3 * S // 4, 2 * S, 11 * S // 4, 13 * S // 4, 15 * S // 4, 9 * S])
    assert found.position.sum(1).tolist() == [1.0, 1.5625, 3.4375, 4.0, 4.25, 4.5, 4.5]
    assert found.velocity.sum(1).tolist() == [0.0, 1.5, 1.5, 0.0, 1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match='t = -1 ns: must not be before the start of'):
        path.ride(-1)
