# SPDX-License-Identifier: Apache-2.0
"""
Loop, recorder and log in a simulated world, where all goes wrong together.

WORLDS=100000 pytest test/test_world.py tries so many seeds.
"""

import os
import re
import subprocess
import sys

import pytest
from helpers.reference import ROOT
from helpers.world_findings import failure_of, told
from helpers.world_plan import plan_of

from spinning_top_sim.recording.recorder import Recorder

WORLDS, BLOCK = int(os.environ.get('WORLDS', '1000')), 50


@pytest.mark.parametrize('first', range(0, WORLDS, BLOCK))
def test_whatever_happens_what_is_sent_and_promised_is_right(first):
    for seed in range(first, min(first + BLOCK, WORLDS)):
        if failure_of(plan_of(seed)):
            pytest.fail(told(seed), pytrace=False)


def test_a_seed_that_fails_is_shrunk_and_told_with_the_command_that_repeats_it(monkeypatch):
    """A fault: the recorder hides what a power cut takes."""
    monkeypatch.setattr(Recorder, 'possible_loss', 0.0)
    seed = next(seed for seed in range(200) if 'lost: the last' in failure_of(plan_of(seed)))
    first, *actions, _, command = told(seed).splitlines()
    assert first.startswith(f'world: seed {seed}: AssertionError: lost: the last')
    assert any('start_recording' in one for one in actions) and len(actions) <= 3
    # This process has the fault, and another one has not.
    code, = re.fullmatch('To repeat it:  PYTHONPATH=test python -c "(.*)"', command).groups()
    with pytest.raises(AssertionError, match='lost: the last'):
        exec(code, {})
    subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True, timeout=120,
                   env={**os.environ, 'PYTHONPATH': f'{ROOT / "test"}{os.pathsep}{ROOT}'})
