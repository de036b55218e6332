# SPDX-License-Identifier: Apache-2.0
"""
One run of each solver and sensor, column by column: the same bits everywhere.

`python test/helpers/golden.py` prints them as JSON.  With --write it keeps them in test/data, as
they are without AVX-512: with it, NumPy has other last bits.
"""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

KEPT = Path(__file__).parents[1] / 'data' / 'golden.json'
SAMPLES = 6         # of each column are kept with all their digits, and of all a digest
IMU = {'imu.enabled': True, 'imu_data.enabled': True, 'ground_truth_imu_odom.enabled': True,
       'imu.lever_arm': [0.1, -0.2, 0.3], 'imu.rpy': [0.1, 0.2, -0.3]}
SHUTTLE = {'pivot.waypoints': [0.0, 0.0, 0.0, 1.0, 0.0, 0.5], 'pivot.repeat': True,
           'pivot.speed': 2.0, 'pivot.acceleration': 4.0}
TRUTH = {'pose.enabled': True, 'joint_states.enabled': True, 'ground_truth_odom.enabled': True,
         'invariants.enabled': True}
NOISE = {f'imu.{kind}_{name}': value for kind in ('gyroscope', 'accelerometer')
         for name, value in (('noise_density', 0.01), ('random_walk', 0.001),
                             ('turn_on_bias', 0.02), ('bias_instability', 0.003))}
SECONDS = 2.0       # of each run
# Parameters; streams that are not named are off.
CASES = {
    'exact': {'solver.method': 'exact', **TRUTH},
    'exact, sleeping': {'solver.method': 'exact', 'initial.theta': 0.0, 'spin.l3': 1.0,
                        'spin.lz': 1.0, 'initial.theta_dot': 0.01, **TRUTH},
    'exact, moving pivot': {'solver.method': 'exact', **SHUTTLE, **TRUTH},
    'rk45': {'solver.method': 'rk45', **TRUTH},
    'rk45, moving pivot': {'solver.method': 'rk45', **SHUTTLE, **TRUTH},
    'rk45, euler': {'solver.method': 'rk45', 'solver.equations': 'euler', **TRUTH},
    'imu': {**IMU, **NOISE, 'imu_timing.enabled': True, 'imu.drop_rate': 0.1,
            'imu.duplicate_rate': 0.1, 'imu.stamp_jitter': 1e-4, 'imu.clock_drift': 20.0},
    'imu, low pass, vibration': {
        **IMU, 'imu.bandwidth': 40.0, 'imu.vibration.frequency': 30.0,
        'imu.vibration.force': [0.1, 0.2, 0.3], 'imu.vibration.rate': [0.01, 0.02, 0.03]},
    'imu, means, increments': {**IMU, **NOISE, 'imu.sampling': 'mean',
                               'increments.enabled': True},
    'magnetometer': {'mag.enabled': True},
    'gnss': {'gnss.enabled': True, **SHUTTLE},
}


def columns(case):
    """Return the numbers of a run: {'topic field': array}."""
    from spinning_top_sim.streams import parameters
    from spinning_top_sim.streams.play import Simulation

    values = {name: False for name in parameters.BY_NAME if name.endswith('.enabled')}
    values = parameters.checked({**values, 'seed': 7, **CASES[case]})
    run = Simulation(values, 10 ** 18)
    channels = [one for one in run.channels if parameters.is_enabled(one.name, values)]
    data = {one.topic: [] for one in channels}
    for block in run.play(channels, round(SECONDS * 1e9)):
        for channel, _, rows in block.messages:
            data[channel.topic].append(rows.tobytes())
    return {
        f'{channel.topic} {name} {number}': np.ascontiguousarray(column, float)
        for channel in channels for (name, _, _), field in zip(
            channel.template.fields, channel.template.decode(b''.join(data[channel.topic])),
            strict=True)
        for number, column in enumerate(np.atleast_2d(np.transpose(field)))}


def golden(case):
    """Return what is kept of a case: of each column, a digest and some numbers in full."""
    kept = {}
    for name, column in columns(case).items():
        digest = hashlib.sha256(column.tobytes()).hexdigest()[:16]
        if np.ptp(column) and digest not in {one for one, *_ in kept.values()}:
            kept[name] = [digest, *(x.hex() for x in column[
                ::-(-len(column) // SAMPLES)].tolist())]
    return kept


def computed():
    """Return all cases as a process of its own computes them, as on any processor."""
    found = np.show_config(mode='dicts')['SIMD Extensions']['found']
    done = subprocess.run(
        [sys.executable, __file__], capture_output=True, text=True, check=True, timeout=120,
        env={**os.environ, 'NPY_DISABLE_CPU_FEATURES': ' '.join(found)})
    return json.loads(done.stdout)


if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).parents[2]))
    if sys.argv[1:] == ['--write']:
        KEPT.write_text(json.dumps(computed(), indent=0) + '\n')
    else:
        print(json.dumps({case: golden(case) for case in CASES}))
