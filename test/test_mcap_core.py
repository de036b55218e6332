# SPDX-License-Identifier: Apache-2.0
"""
Our logs in MCAP's reference reader, which is TypeScript, as in Foxglove: @mcap/core on Node.js.

Skipped where it is not installed: `npm install` in test/mcap_core does that.
"""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers.inspected import log_of
from helpers.logs import seen_by_rosbags

FOLDER = Path(__file__).parent / 'mcap_core'


@pytest.mark.skipif(not (shutil.which('node') and (FOLDER / 'node_modules').exists()),
                    reason='@mcap/core is missing: npm install in test/mcap_core')
@pytest.mark.parametrize('compression', ['zstd', 'none'])
def test_it_reads_the_same_messages_as_rosbags(tmp_path, compression):
    path = log_of(tmp_path / 'run.mcap', '--duration', 5, '--command', '2:2.0:1.5',
                  '-p', f'record.compression:={compression}')
    ended = subprocess.run(['node', 'read.mjs', path], cwd=FOLDER, capture_output=True, text=True,
                           check=True, timeout=60)
    found, digests = json.loads(ended.stdout), {}
    for topic, time_ns, data in seen_by_rosbags(path):
        digests.setdefault(topic, hashlib.sha256()).update(str(time_ns).encode() + data)
    assert {name: topic['digest'] for name, topic in found['topics'].items()} == {
        name: digest.hexdigest() for name, digest in digests.items()}
    assert {'rosbag2', 'spinning_top_sim'} <= set(found['metadata'])
