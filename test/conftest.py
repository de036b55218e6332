# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests that talk to running nodes."""

import pytest


@pytest.fixture(scope='module')
def peer():
    from helpers.node_harness import Peer

    with Peer() as peer:
        yield peer


@pytest.fixture(scope='module')
def diagnostics(peer):
    from helpers.node_harness import Diagnostics

    return Diagnostics(peer)
