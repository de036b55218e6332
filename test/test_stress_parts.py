# SPDX-License-Identifier: Apache-2.0
"""A few seeds of what `make stress` does for hours; and that its runner sees what goes wrong."""

import importlib
import os
import time

import pytest
from stress import runner


@pytest.mark.parametrize(('part', 'seed'), [('logs', 4), ('nodes', 0)])
def test_a_seed(tmp_path, monkeypatch, request, part, seed):
    pytest.importorskip('rclpy')
    module = importlib.import_module(f'stress.{part}')
    if part == 'nodes':
        peer = request.getfixturevalue('peer')
        monkeypatch.setattr(module, 'shared_peer', lambda: peer)
    assert module.check(seed, tmp_path)


PATIENCE_S = 2.0
MEMORY_MB = 500


def check(seed, folder):
    """A part whose seeds go wrong, each in another way."""
    (folder / 'left').write_text('')
    if seed == 1:
        raise ValueError('a fault')
    if seed == 2:
        time.sleep(600.0)
    if seed == 3:
        os.abort()
    if seed == 4:
        bytearray(10 ** 9)
    return 'fine'


def test_the_runner_sees_errors_hangs_deaths_and_memory():
    result = runner.run('broken', 0, 7, module='test_stress_parts')
    assert result.seeds == 7
    assert result.outcomes == {'fine': 3, 'FAILED': 4}
    for seed, (failure, words) in enumerate(zip(sorted(result.failures), (
            ('ValueError', 'a fault', 'in check'), ('not done after 2 s',),
            ('died with code -6',), ('MemoryError',)), strict=True), start=1):
        assert failure.startswith(f'broken: seed {seed}: ')
        assert failure.endswith(f'python test/stress broken --first {seed} --count 1')
        for word in words:
            assert word in failure, (word, failure)
