# SPDX-License-Identifier: Apache-2.0
"""A few seeds of what `make stress` does for hours; and that its runner sees what goes wrong."""

import os
import time

import pytest

pytest.importorskip('rclpy')

from stress import runner
from stress.disk import NO_COMPILER


@pytest.mark.parametrize(('part', 'first', 'count'), [
    ('logs', 4, 1), ('nodes', 0, 1), ('disk', 0, 1), ('sensor', 1, 1)])
def test_a_few_seeds(part, first, count):
    result = runner.run(part, first, count)
    assert not result.failures, '\n'.join(result.failures)
    assert result.seeds == count
    if NO_COMPILER in result.outcomes:
        pytest.skip(NO_COMPILER)
    print(f'{dict(result.outcomes)}, {result.peak_mb:.0f} MB at most')


PATIENCE_S = 4.0
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


def test_the_runner_sees_errors_hangs_deaths_and_memory(monkeypatch):
    monkeypatch.setenv('STRESS_MODULE', 'test_stress_parts')
    result = runner.run('broken', 0, 7)
    assert result.seeds == 7
    assert result.outcomes == {'fine': 3, 'FAILED': 4}
    for seed, (failure, words) in enumerate(zip(sorted(result.failures), (
            ('ValueError', 'a fault', 'in check'), ('not done after 4 s', 'in check'),
            ('died with code -6', 'Aborted'), ('MemoryError',)), strict=True), start=1):
        assert failure.startswith(f'broken: seed {seed}: ')
        assert failure.endswith(f'python test/stress broken --first {seed} --count 1')
        for word in words:
            assert word in failure, (word, failure)
