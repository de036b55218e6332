# SPDX-License-Identifier: Apache-2.0
"""The grade of random simulators and bodies: each defect is named, no right one is blamed."""

from dataclasses import replace

import numpy as np
from helpers import bodies
from helpers.bodies import FAULTS, NAMES, told
from helpers.faulty_simulators import NOISY, OTHER, PUBLISHED, RIGHT, STEPPED, Imu, exact

from spinning_top_sim.grade import Imu as Known
from spinning_top_sim.grade import grade, grade_readings
from spinning_top_sim.grade.scenes import SCENES, WHEEL

PATIENCE_S = 600.0
MEMORY_MB = 2000
SHORT = tuple(replace(scene, duration=0.4 * scene.duration, divided=scene.divided[:2])
              for scene in SCENES)


def check(seed, folder):
    """Grade a simulator with each defect, and every right one; raise for those judged wrong."""
    random = np.random.default_rng(seed)
    wrong = []
    for name, faults in {**PUBLISHED, **OTHER}.items():
        body = _body(random, noisy=name in NOISY or bool(seed % 2))
        report = grade(Imu(_either(random), name, seed), body=body, seed=seed,
                       **_conditions(random))
        wrong += _judged(name, report, faults)
    for name, (simulator, faults) in STEPPED.items():
        # Smaller steps would be right within the tolerance.
        report = grade(Imu(simulator, seed=seed), body=_body(random, bool(seed % 2)), seed=seed,
                       dt=random.choice((0.002, 0.004)), scenes=SHORT)
        wrong += _judged(name, report, faults)
    for name, simulator in RIGHT.items():
        report = grade(Imu(simulator, 'covariance_right', seed), seed=seed, scenes=SHORT,
                       body=_body(random, bool((seed + len(name)) % 2)))
        wrong += _judged(name, report, ())
    for fault in (None, *FAULTS):
        moving = bodies.body(seed, seconds=10.0)
        parts = told(moving, fault)
        known = Known(lever_arm=tuple(moving.arm) if seed % 2 or fault == 'no lever arm' else None)
        report = grade_readings(parts, known)
        # What the poses are too coarse to tell may be missing, or stay unexplained.
        allowed = {NAMES[fault], 'inaccurate'} if fault else set()
        if not set(report.faults) <= allowed:
            wrong.append(f'body, {fault}: {report}')
    assert not wrong, '\n'.join(wrong)
    return f'{len(PUBLISHED) + len(OTHER) + len(STEPPED) + len(FAULTS)} defects'


def _judged(name, report, faults):
    if report.faults == list(faults):
        return []
    return [f'{name}: {", ".join(faults) or "passed"} expected\n{report}']


def _either(random):
    """Return the motion of an exact simulator or of one with steps."""
    return exact if random.random() < 0.8 else RIGHT['RK4']


def _conditions(random):
    names = random.choice(len(SCENES), 3, replace=False)
    return {'dt': random.choice((0.001, 0.002, 0.004)),
            'scenes': [replace(SHORT[k], divided=(1,)) for k in sorted(names)]}


def _body(random, noisy):
    """Return the wheel with an IMU somewhere else."""
    arm, turn = random.uniform(-0.2, 0.2, 3), random.standard_normal(4)
    arm[:2] += np.copysign(0.03, arm[:2])
    turn[1:] += np.copysign(0.3, turn[1:])
    noise = (1.7e-4, 1.2e-3) if noisy else (0.0, 0.0)
    return replace(WHEEL, lever_arm=tuple(arm), mounting=tuple(turn / np.linalg.norm(turn)),
                   gyroscope_noise_density=noise[0], accelerometer_noise_density=noise[1])
