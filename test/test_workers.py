# SPDX-License-Identifier: Apache-2.0
"""Many workers, or many runs side by side: none disturbs another."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.own_domain import DOMAINS

TELL = ('import os, sys\n'
        'import helpers.own_domain\n'
        'print(os.environ["ROS_DOMAIN_ID"], os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"])\n'
        'sys.stdout.flush()\n'
        'sys.stdin.read()\n')


def test_test_processes_side_by_side_have_domains_of_their_own(tmp_path):
    """Counted on from the one that the user has chosen, and free again when its process ends."""
    environment = {**os.environ, 'ROS_DOMAIN_ID': '100', 'TMPDIR': str(tmp_path),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}

    def start():
        process = subprocess.Popen(
            [sys.executable, '-c', TELL], cwd=Path(__file__).parent, env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        running.append(process)
        return process.stdout.readline().split()

    running = []
    try:
        assert [start() for _ in range(4)] == [
            [str(domain % DOMAINS), 'LOCALHOST'] for domain in (100, 101, 102, 103)]
        running[1].communicate()
        assert start() == ['101', 'LOCALHOST']
    finally:
        for process in running:
            process.kill()
            process.wait()


MODULE = """
import pytest

@pytest.fixture(scope='module')
def node(request):
    return 1

@pytest.fixture(params=(1, 2))
def topic(node):
    return 2

@pytest.fixture
def own():
    return 3

def test_one(node): pass
def test_two(tmp_path, topic): pass
def test_three(own, peer): pass
"""


def test_tests_that_share_a_fixture_of_their_module_share_a_worker(tmp_path):
    pytest.importorskip('xdist')
    from helpers.scheduling import shared_fixtures

    path = tmp_path / 'test_module.py'
    path.write_text(MODULE)
    assert shared_fixtures(path) == {'test_one': 'node', 'test_two': 'node'}
