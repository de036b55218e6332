# SPDX-License-Identifier: Apache-2.0
"""
A ROS domain of this test process alone, in the environment from the first import on.

conftest.py imports this before any test, in every worker of pytest-xdist; so do the programs that
start nodes without pytest.  Domains are counted on from ROS_DOMAIN_ID, if it is set, to the first
that no other test process of this user has.  DDS stays on this machine.
"""

import atexit
import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import TextIO

DOMAINS = 102       # of more, the ports are among those that Linux gives to any program


def _take_domain() -> tuple[int, TextIO]:
    """Return a domain id and what keeps it ours as long as this process lives."""
    folder = Path(tempfile.gettempdir()) / f'spinning_top_sim_domains_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    first = int(os.environ.get('ROS_DOMAIN_ID') or os.getpid())
    for offset in range(DOMAINS):
        domain = (first + offset) % DOMAINS
        handle = (folder / str(domain)).open('w')
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.close()
        else:
            return domain, handle
    raise RuntimeError('all domains are taken')


DOMAIN_ID, _DOMAIN_LOCK = _take_domain()
os.environ['ROS_DOMAIN_ID'] = str(DOMAIN_ID)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.pop('ROS_LOCALHOST_ONLY', None)
os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='spinning_top_sim_log_')
atexit.register(shutil.rmtree, os.environ['ROS_LOG_DIR'], ignore_errors=True)
