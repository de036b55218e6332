# SPDX-License-Identifier: Apache-2.0
"""
Our logs in MCAP's reference reader, which is TypeScript: @mcap/core on Node.js.

Skipped where it is not installed: `npm install` in test/mcap_core does that.
"""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from spinning_top_sim.tools.simulate import main

FOLDER = Path(__file__).parent / 'mcap_core'
pytestmark = [
    pytest.mark.skipif(not shutil.which('node'), reason='there is no Node.js'),
    pytest.mark.skipif(not (FOLDER / 'node_modules').exists(),
                       reason='@mcap/core is missing: npm install in test/mcap_core')]


def read_with_mcap_core(path):
    """Return what read.mjs prints of a log."""
    ended = subprocess.run(['node', 'read.mjs', path], cwd=FOLDER, capture_output=True, text=True,
                           check=False, timeout=60)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def read_with_rosbags(path):
    """Return schema, count and digest by topic."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            topic = found.setdefault(connection.topic, {
                'schema': connection.msgtype, 'count': 0, 'digest': hashlib.sha256()})
            topic['count'] += 1
            topic['digest'].update(str(time_ns).encode() + data)
    return {name: {**topic, 'digest': topic['digest'].hexdigest()}
            for name, topic in found.items()}


@pytest.mark.parametrize('compression', ['zstd', 'none'])
def test_it_reads_the_same_messages_as_rosbags(tmp_path, compression):
    path = tmp_path / 'run.mcap'
    assert not main(['-o', str(path), '--duration', '5', '--quiet', '--command', '2:2.0:1.5',
                     '-p', f'record.compression:={compression}'])
    found = read_with_mcap_core(path)
    wanted = read_with_rosbags(path)
    assert found['topics'] == wanted
    assert wanted['/pose']['count'] == 501 and wanted['/imu/data_raw']['count'] == 1001
    assert found['total'] == sum(topic['count'] for topic in wanted.values())
    assert {'rosbag2', 'spinning_top_sim'} <= set(found['metadata'])
    assert found['metadata']['spinning_top_sim']['seed'] == '0'
