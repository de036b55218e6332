# SPDX-License-Identifier: Apache-2.0
"""Both solvers on any top: what must hold for every one, with each bound and its reason."""

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
    x, y, z, w = motion.quaternion.T.astype(LONG)
    assert abs(np.sqrt(x * x + y * y + z * z + w * w) - 1).max(initial=0) <= UNIT
    # An attitude off by 5e-15 turns L in the body by as much, and rates across, known from it and
    # L, are off by 5e-15 of |L|/lambda1; the energy has the square of the rates across, |L across|
    # times that, and the height of the axis.
    omega = motion.angular_velocity.T.astype(LONG)
    lambda1, torque = LONG(top.lambda1), LONG(top.mass) * LONG(top.gravity) * LONG(
        top.com_distance)
    l3 = LONG(top.lambda3) * omega[2]
    across2 = lambda1 ** 2 * (omega[0] ** 2 + omega[1] ** 2)
    height = w * w + z * z - x * x - y * y
    lz = lambda1 * (omega[0] * 2 * (x * z - w * y) + omega[1] * 2 * (y * z + w * x)) + l3 * height
    largest2 = np.max(across2, initial=0)
    total = np.sqrt(largest2 + l3[:1] ** 2) if len(l3) else LONG(0)
    assert (abs(l3 - start.l3) <= 2.0 * EPS * abs(start.l3)).all()
    assert (abs(lz - start.lz) <= 2.0 * EXACT * total).all()
    c, s = np.cos(LONG(start.theta) / 2), np.sin(LONG(start.theta) / 2)
    momentum = ((LONG(start.lz) - start.l3) + 2 * LONG(start.l3) * s * s if s < c
                else (LONG(start.lz) + start.l3) - 2 * LONG(start.l3) * c * c)
    around = momentum / (2 * s * c) / lambda1 if momentum else LONG(0)
    energy = lambda1 / 2 * (LONG(start.theta_dot) ** 2 + around ** 2) + torque * np.cos(
        LONG(start.theta))
    assert (abs(across2 / (2 * lambda1) + torque * height - energy) <= 2.0 * EXACT * (
        np.sqrt(largest2) * total / lambda1 + abs(torque)) + (EXACT * total) ** 2 / lambda1).all()


def check_motion(top, start):
    """Check the exact solution, and rk45 against it."""
    solution = ExactSolution(top, start)
    period = solution.nutation_period or 1.0 / (
        abs(solution.mean_precession_rate) + abs(solution.mean_spin_rate) or 1.0)
    motion, far = solution.states_at_seconds(period * INSTANTS), period * FAR
    check_constants(motion)
    check_constants(solution.states_at_seconds(far[abs(far) < solution.time_limit]))
    for name in ('theta', 'phi', 'psi', 'theta_dot'):
        wanted = getattr(start, name)
        assert abs(getattr(motion, name)[0] - wanted) <= EXACT * max(1.0, abs(wanted)), name

    # The error of a step is told by an estimate, and magnified where the nutation turns back: the
    # sum of all is within twenty times their count times the tolerance.
    steps = motion_of(top, start, method='rk45', rtol=RTOL, atol=0.1 * RTOL)
    stepped = steps.states_at_seconds(period * INSTANTS)
    assert all(np.all(np.isfinite(getattr(stepped, name))) for name in COLUMNS)
    if solution.m1 > 1e-3:          # near a separatrix neighbouring motions part
        bound = 20.0 * RTOL * (steps.steps + 1)
        sine = np.sin(motion.theta_folded)
        told = sine > 20.0 * bound
        assert abs(stepped.quaternion - motion.quaternion).max() <= bound
        for name in ('theta', 'phi', 'psi'):
            angle = getattr(motion, name)[told]
            assert (abs(getattr(stepped, name)[told] - angle)
                    <= 4.0 * bound / sine[told] + EXACT * abs(angle)).all(), name
