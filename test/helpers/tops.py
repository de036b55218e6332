# SPDX-License-Identifier: Apache-2.0
"""Both solvers on any top: what must hold for every one, with each bound and its reason."""

import math
import signal
from contextlib import contextmanager

import numpy as np

from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.solve import motion_of

LONG = np.longdouble
EPS = 2.0 ** -53
# Of |q|: the scale 1/sqrt(sum of squares) is off by 4 roundings at most, and each part by 3 more:
# its sine, and two products.
UNIT = 7.0 * EPS
# What `ExactSolution` promises of each column, over max(1, |value|).
EXACT = 5e-15
# Instants in nutation periods: anything but commensurable, and the start.  Far away the phase is
# all there is to get wrong.
INSTANTS = np.array([0.0, 0.1371, 0.533, 0.981, 1.77, 2.9])
FAR = np.array([-1e9, -12345.678, -3.3, 1e3 + 0.1, 1e6 + 0.2, 1e9 + 0.3])
RTOL = 1e-9
COLUMNS = ('quaternion', 'theta', 'theta_dot', 'phi', 'psi', 'phi_dot', 'psi_dot',
           'angular_velocity', 'angular_acceleration', 'energy')


@contextmanager
def time_limit(seconds):
    """Raise TimeoutError after so much processor time: a hang becomes a failure."""
    def stop(signum, frame):
        raise TimeoutError(f'not done after {seconds} s')
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def check_constants(motion):
    """No NaN, unit quaternions, and the constants of the motion from attitude and rates alone."""
    top, start = motion.top, motion.start
    assert all(np.all(np.isfinite(getattr(motion, name))) for name in COLUMNS)
    assert abs(np.linalg.norm(motion.quaternion.astype(LONG), axis=1) - 1).max(initial=0) <= UNIT
    # An attitude off by 5e-15 turns L in the body by as much, and rates across, known from it and
    # L, are off by 5e-15 of |L|/lambda1; the energy has the square of these.
    momentum = motion.angular_velocity * (top.lambda1, top.lambda1, top.lambda3)
    total = np.linalg.norm(momentum, axis=1).max(initial=0.0)
    across = np.linalg.norm(momentum[:, :2], axis=1).max(initial=0.0)
    lz = np.sum(momentum * np.stack(motion.rows_vertical, axis=1), axis=1)
    assert (abs(momentum[:, 2] - start.l3) <= 4.0 * EPS * abs(start.l3)).all()
    assert (abs(lz - start.lz) <= 2.0 * EXACT * total).all()
    kinetic = 0.5 * np.sum(momentum[:, :2] ** 2, axis=1) / top.lambda1
    energy = kinetic + top.gravity_torque * motion.rows_axis[2]
    at_start = kinetic[:1] + top.gravity_torque * math.cos(start.theta)
    assert (abs(energy - at_start) <= 4.0 * EXACT * (
        across * total / top.lambda1 + abs(top.gravity_torque))).all()


def check_motion(top, start):
    """Check the exact solution, and rk45 against it."""
    solution = ExactSolution(top, start)
    period = solution.nutation_period or 1.0 / (
        abs(solution.mean_precession_rate) + abs(solution.mean_spin_rate) or 1.0)
    times = period * np.concatenate((INSTANTS, FAR))
    motion = solution.states(period * INSTANTS)
    check_constants(solution.states(times[abs(times) < solution.time_limit]))
    for name in ('theta', 'phi', 'psi', 'theta_dot'):
        wanted = getattr(start, name)
        assert abs(getattr(motion, name)[0] - wanted) <= EXACT * max(1.0, abs(wanted)), name

    # The error of a step is told by an estimate, and magnified where the nutation turns back: the
    # sum of all is within twenty times their count times the tolerance.
    steps = motion_of(top, start, method='rk45', rtol=RTOL, atol=0.1 * RTOL)
    stepped = steps.states(period * INSTANTS)
    assert all(np.all(np.isfinite(getattr(stepped, name))) for name in COLUMNS)
    # Near a separatrix neighbouring motions part.
    if solution.describe().separatrix_distance > 1e-3:
        bound = 20.0 * RTOL * (steps.steps + 1)
        sine = np.sin(motion.theta_folded)
        told = sine > 20.0 * bound
        assert abs(stepped.quaternion - motion.quaternion).max() <= bound
        for name in ('theta', 'phi', 'psi'):
            angle = getattr(motion, name)[told]
            assert (abs(getattr(stepped, name)[told] - angle)
                    <= 4.0 * bound / sine[told] + EXACT * abs(angle)).all(), name
