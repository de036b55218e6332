# SPDX-License-Identifier: Apache-2.0
"""
Navigate by the noise-free increments of the IMU alone, and compare with the truth:

    PYTHONPATH=. python benchmark/increments.py

The start is the first message of `ground_truth/imu_odom`, and the truth its last one. Attitude
and velocity are the sums of `imu/dq` and `imu/dv`. The position is the integral of the velocity,
by the trapezoidal rule with Gregory's corrections at both ends. With long doubles the increments'
own errors are left; with doubles those of the user's sums are added.
"""

from __future__ import annotations

import argparse
from fractions import Fraction

import numpy as np
import report
from cases import ROOT
from columns import simulated

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene

LONG = np.longdouble
RATE = 200
# Scene, lever arm [m], mounting [rad].
CASES = (
    ('cusp', (0.1, -0.2, 0.3), (0.0, 0.0, 0.0)),
    ('looping', (0.0, 0.0, 0.0), (0.1, 0.2, 0.3)),
    ('wavy', (0.05, 0.0, 0.0), (3.0, 0.0, 0.0)),
    ('steady_slow', (0.0, 0.3, -0.1), (0.0, -1.2, 0.4)),
    ('steady_fast', (-0.2, 0.02, 0.1), (1.0, 1.0, -2.0)),
    ('near_separatrix', (0.1, 0.1, 0.1), (0.0, 0.0, 1.5)),
    ('spherical_pendulum', (0.0, 0.0, 0.5), (0.3, -0.7, 1.9)),
    ('free_top', (0.07, -0.01, 0.2), (-0.4, 0.2, 0.0)),
    ('fast_gyroscope', (0.0, 0.0, 0.05), (0.2, 0.2, 0.2)),
    ('heavy_top', (0.0, 0.0, 0.1), (-1.0, 0.5, 2.5)))
TERMS = 12          # of Gregory's corrections


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--duration', type=int, default=1000, help='[s], default %(default)d')
    duration = parser.parse_args().duration
    runs = [Run(*case, duration) for case in CASES]
    errors = [navigate(runs, number) for number in (LONG, np.float64)]
    rows = []
    for k, run in enumerate(runs):
        rows.append([run.scene, f'{run.fastest:.3g}', *(
            f'{value[k]:.1e}' for both in zip(*errors, strict=True) for value in both)])
        print(*rows[-1])
    head = ('scene', 'rate [rad/s]', 'attitude [rad]', 'in doubles', 'velocity [m/s]',
            'in doubles', 'position [m]', 'in doubles')
    report.write('increments_1000s.md' if duration == 1000 else f'increments_{duration}s.md',
                 '\n'.join((
        report.preamble(f'A strapdown of the increments, {duration} s at {RATE} Hz',
                        ('numpy', 'scipy')),
        __doc__.split('\n\n')[-1].strip() + '\n', report.table(head, rows),
        'The nutation of fast_gyroscope turns by more than a radian in a sample, too much to '
        'integrate the velocity.\n'
    )))


class Run:
    """The messages of a scene: increments and the truth at both ends."""

    def __init__(self, scene: str, arm: tuple[float, ...], rpy: tuple[float, ...],
                 duration: int) -> None:
        scene_file = ROOT / f'config/{scene}.yaml'
        run = simulated([str(scene_file), {
            'increments.enabled': True, 'imu.rate': float(RATE), 'imu.lever_arm': list(arm),
            'imu.rpy': list(rpy), 'ground_truth_imu_odom.rate': 1.0}],
            ['increments', 'ground_truth_imu_odom'], duration)
        self.scene = scene
        self.gravity = LONG(parameters.checked(read_scene(scene_file))['top.gravity'])
        self.dq, self.dv = run('imu/dq.quaternion', 'xyzw'), run('imu/dv.vector')
        truth = 'ground_truth/imu_odom'
        position = run(f'{truth}.pose.pose.position')
        orientation = run(f'{truth}.pose.pose.orientation', 'xyzw')
        velocity = run(f'{truth}.twist.twist.linear')
        self.fastest = float(np.linalg.norm(run(f'{truth}.twist.twist.angular'), axis=1).max())
        self.start, self.end = ((orientation[k], rotate(orientation[k], velocity[k]), position[k])
                                for k in (0, -1))


def navigate(runs: list[Run], number: type) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors at the end of each run: [rad], [m/s], [m]."""
    # Components by runs.
    q, v, p = (np.array([run.start[k] for run in runs]).astype(number).T for k in range(3))
    period = number(1) / number(RATE)
    fall = np.array([run.gravity for run in runs]).astype(number) * period
    dq, dv = (np.stack([getattr(run, name) for run in runs], axis=-1).astype(number)
              for name in ('dq', 'dv'))
    velocities = np.empty((len(dq), *v.shape), number)
    velocities[0] = v
    for k in range(1, len(dq)):
        v = v + rotate(q, dv[k])
        v[2] -= fall
        q = product(q, dq[k])
        q = q * (number(1.5) - number(0.5) * (q * q).sum(axis=0))       # of unit length
        velocities[k] = v
    p = p + period * gregory(velocities)
    ends = [np.array([run.end[k] for run in runs]).T for k in range(3)]
    apart = product(ends[0] * np.array((-1, -1, -1, 1))[:, np.newaxis], q)
    return (2.0 * np.linalg.norm(apart[:3].astype(float), axis=0),
            np.linalg.norm((v - ends[1]).astype(float), axis=0),
            np.linalg.norm((p - ends[2]).astype(float), axis=0))


def gregory(values: np.ndarray) -> np.ndarray:
    """Return the sum that, times the step, is the integral of samples along the first axis."""
    coefficients = [Fraction(1)]
    for n in range(1, TERMS + 2):       # of z/log(1 + z)
        coefficients.append(-sum(Fraction((-1) ** k, k + 1) * coefficients[n - k]
                                 for k in range(1, n + 1)))
    total = values.sum(axis=0) - (values[0] + values[-1]) / 2
    forward, backward = values[:TERMS + 1], values[:-TERMS - 2:-1]
    for order in range(1, TERMS + 1):
        forward, backward = np.diff(forward, axis=0), np.diff(backward, axis=0)
        factor = coefficients[order + 1]
        total = total - (forward[0] + backward[0]) * (
            values.dtype.type(factor.numerator) / values.dtype.type(factor.denominator))
    return total


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    (a, b, c, d), (x, y, z, w) = p, q
    return np.array((d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                     d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z))


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return a vector in the frame that the quaternion q leads to."""
    axis = q[:3]
    across = 2 * np.cross(axis, v, axis=0)
    return v + q[3] * across + np.cross(axis, across, axis=0)


if __name__ == '__main__':
    main()
