# SPDX-License-Identifier: Apache-2.0
"""A few seeds of what `make stress` does for hours."""

import importlib

import pytest


@pytest.mark.parametrize(('part', 'seed'), [('logs', 4), ('nodes', 0)])
def test_a_seed(tmp_path, monkeypatch, request, part, seed):
    pytest.importorskip('rclpy')
    module = importlib.import_module(f'stress.{part}')
    if part == 'nodes':
        peer = request.getfixturevalue('peer')
        monkeypatch.setattr(module, 'shared_peer', lambda: peer)
    assert module.check(seed, tmp_path)
