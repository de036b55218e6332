# SPDX-License-Identifier: Apache-2.0
"""The grade of random simulators and bodies: each defect is named, no right one is blamed."""

from dataclasses import replace

import numpy as np
from helpers import bodies
from helpers.bodies import FAULTS, NAMES, told
from helpers.faulty_simulators import DEFECTS, MOVED, NOISY, RIGHT, Imu, exact

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
    for name in (*DEFECTS, *RIGHT):
        scenes = [SHORT[k] for k in sorted(random.choice(len(SCENES), 3, replace=False))]
        simulator = Imu(RIGHT[name], seed=seed) if name in RIGHT else Imu(exact, name, seed)
        report = grade(simulator, body=_body(random, name in NOISY or bool(seed % 2)), seed=seed,
                       dt=random.choice((0.001, 0.002, 0.004)), scenes=scenes)
        # Differences are half a step late.
        found = {*report.faults} - ({'late'} if name == 'wrong dt' else set())
        wrong += [f'{name}: {report}'] * (
            found != ({DEFECTS[name][0]} if name in DEFECTS else set()))
    for name, (simulator, faults) in MOVED.items():
        # Smaller steps would be right within the tolerance.
        report = grade(Imu(simulator, seed=seed), body=_body(random, bool(seed % 2)), seed=seed,
                       dt=random.choice((0.002, 0.004)), scenes=SHORT)
        wrong += [f'{name}: {report}'] * (report.faults != list(faults))
    for fault in (None, *FAULTS):
        moving = bodies.body(seed, seconds=10.0)
        known = Known(lever_arm=tuple(moving.arm) if seed % 2 or fault == 'no lever arm' else None)
        report = grade_readings(told(moving, fault), known)
        # What the poses are too coarse to tell may be missing, or stay unexplained.
        allowed = {NAMES[fault], 'inaccurate'} if fault else set()
        wrong += [f'body, {fault}: {report}'] * (not set(report.faults) <= allowed)
    assert not wrong, '\n'.join(wrong)
    return f'{len(DEFECTS) + len(MOVED) + len(FAULTS)} defects'


def _body(random, noisy):
    """Return the wheel with an IMU somewhere else."""
    arm, turn = random.uniform(-0.2, 0.2, 3), random.standard_normal(4)
    arm[:2] += np.copysign(0.03, arm[:2])
    turn[1:] += np.copysign(0.3, turn[1:])
    noise = (1.7e-4, 1.2e-3) if noisy else (0.0, 0.0)
    return replace(WHEEL, lever_arm=tuple(arm), mounting=tuple(turn / np.linalg.norm(turn)),
                   gyroscope_noise_density=noise[0], accelerometer_noise_density=noise[1])
