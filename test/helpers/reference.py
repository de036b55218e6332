# SPDX-License-Identifier: Apache-2.0
"""The reference cases of data/reference_cases.json: 30 digits, from 70-digit arithmetic."""

import functools
import json
import math
from pathlib import Path

import yaml

from spinning_top_sim import State, Top

ROOT = Path(__file__).resolve().parents[2]
CASES = {case['name']: case for case in json.loads(
    (ROOT / 'test/data/reference_cases.json').read_text())['cases']}
# Those with a pivot at rest, and the others.
SCENES, RIDES = (sorted(path.stem for path in (ROOT / 'config').glob('*.yaml')
                        if ('  pivot.' in path.read_text()) == moves) for moves in (False, True))


@functools.cache
def scene_parameters(name):
    """Return the parameters that a scene file sets."""
    text = (ROOT / 'config' / f'{name}.yaml').read_text()
    return yaml.safe_load(text)['/**']['ros__parameters']


def top_of(case):
    return Top(lambda1=case['lambda1'], lambda3=case['lambda3'], mass=case['M'],
               com_distance=case['R'], gravity=case['g'])


def start_of(case):
    return State(theta=case['theta0'], theta_dot=case['thetadot0'], phi=case['phi0'],
                 psi=case['psi0'], l3=case['L3'], lz=case['Lz'])


def quaternion_of(state):
    """Return x, y, z, w of a reference state, which has w first."""
    w, x, y, z = map(float, state['q'])
    return x, y, z, w


def angle(p, q):
    """Return the rotation angle between two quaternions, sign counted: q and -q are 2 pi apart."""
    return 4.0 * math.asin(min(1.0, 0.5 * math.dist(p, q)))
