# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests that talk to running nodes, and the order of many workers."""

import functools
import os
import signal
from pathlib import Path

import helpers.own_domain  # noqa: F401, before any node starts
import pytest


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Let one worker run the tests of a file that shares fixtures, and any worker the others."""
    from xdist.scheduler import LoadScopeScheduling

    class BySharedFixtures(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.partition('::')[0]
            return file if "scope='module'" in read(config.rootpath / file) else nodeid

    read = functools.cache(Path.read_text)
    return BySharedFixtures(config, log)


def pytest_collection_modifyitems(items):
    """Begin with the files whose tests wait most, so that at the end no worker waits for one."""
    waiting = {f'test_{name}.py' for name in (
        'docs', 'examine_live', 'view_browser', 'view_node', 'sim_node', 'sim_node_life')}
    items.sort(key=lambda item: item.path.name not in waiting)


@pytest.fixture(autouse=True)
def _signals():
    """Restore what a command that is called in this process leaves ignored."""
    handlers = {number: signal.getsignal(number)
                for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture(scope='session')
def peer():
    from helpers.node_harness import Peer

    with Peer() as peer:
        yield peer


@pytest.fixture(scope='session')
def stepped(tmp_path_factory):
    """Four motions by steps, with noise, in a namespace."""
    from helpers.inspected import log_of

    return log_of(tmp_path_factory.mktemp('log') / 'stepped.mcap', '--duration', 3, '--namespace',
                  '/a/b', '--command', '1.0:2.0:1.5', '--command', '0:1.7:1.4', '--command',
                  '2.0031:1.6:1.0', '-p', 'imu.gyroscope_noise_density:=0.01', '-p',
                  'markers.enabled:=true')


@pytest.fixture(scope='session')
def short(tmp_path_factory):
    """Two motions in half a second."""
    from helpers.inspected import log_of

    return log_of(tmp_path_factory.mktemp('log') / 'short.mcap', '--duration', 0.5, '--command',
                  '0.3:1.7:1.4')


@pytest.fixture(scope='session')
def log(tmp_path_factory):
    from helpers.logs import small_log

    return small_log(tmp_path_factory.mktemp('log') / 'run.mcap')


@pytest.fixture
def no_sync(monkeypatch):
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)
