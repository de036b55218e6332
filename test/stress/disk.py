# SPDX-License-Identifier: Apache-2.0
"""
Recordings on a disk that fails: full, broken, writing in parts, or slow.

A library that is built from disk_faults.c and loaded before libc makes it fail, in turn under a
node that records and under `simulate`.  The node lives, publishes and says why it records no
more; what was written before is there, and right.
"""

import contextlib
import functools
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import stamp_of

import spinning_top_sim
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools import inspect, recover
from stress.nodes import (  # noqa: F401
    MEMORY_MB,
    PATIENCE_S,
    TRACEBACK,
    check_end,
    check_life,
    shared_peer,
    started,
)

SOURCE = Path(__file__).with_name('disk_faults.c')
STOPPING = ('enospc', 'eio')
FAULTS = (*STOPPING, 'short', 'slow')
SLOW_S = 2
HEAD_AND_MORE = range(20_000, 400_000)       # bytes; the head alone takes some 50 000
NO_COMPILER = 'SKIPPED: there is no C compiler (cc) to build the failing disk with'


@functools.cache
def library():
    """Return the path of the built library; None without a compiler."""
    compiler = shutil.which(os.environ.get('CC', 'cc'))
    if compiler is None:
        return None
    built = Path(tempfile.mkdtemp(prefix='disk_faults_'), 'disk_faults.so')
    subprocess.run([compiler, '-shared', '-fPIC', '-O1', '-Wall', '-Werror', '-o', str(built),
                    str(SOURCE), '-ldl'], check=True)
    return built


def check(seed, folder):
    if library() is None:
        print(NO_COMPILER, file=sys.stderr)
        return NO_COMPILER
    rng = random.Random(seed)
    fault = FAULTS[seed // 2 % len(FAULTS)]
    settings = {'DISK_FAULT': fault, 'DISK_FAULT_FOLDER': str(folder),
                'DISK_FAULT_AFTER': str(rng.choice((0, 5000, *rng.sample(HEAD_AND_MORE, 4)))),
                'DISK_FAULT_CALLS': str(rng.choice((0, 0, 1, 3))),
                'DISK_FAULT_SECONDS': str(SLOW_S), 'LD_PRELOAD': str(library())}
    return (check_node if seed % 2 else check_simulate)(fault, settings, folder)


@contextlib.contextmanager
def environment(settings):
    os.environ.update(settings)
    try:
        yield
    finally:
        for name in settings:
            del os.environ[name]


def check_node(fault, settings, folder):
    peer = shared_peer()
    parameters = {'record.enabled': True, 'record.uri': f'{folder}/run.mcap',
                  'pose.rate': 1000.0, 'joint_states.rate': 1000.0}
    node = SimNode(folder, parameters, namespace=f'/disk{os.getpid()}_{folder.stat().st_ino}')
    with contextlib.ExitStack() as stack:
        with environment(settings):
            stack.enter_context(node)
        assert started(node), node.err
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(500)
        if fault in STOPPING:
            try:
                wait_for('the reason', lambda: 'recording stopped' in node.err
                     or 'cannot record' in node.err or not node.alive)
            except AssertionError:
                raise AssertionError(f'no reason: {node.err}{node.out}') from None
        pose.wait_more(1000)
        peer.stop_listening(pose)
        check_life(node, fault)
        if fault in STOPPING:
            code = node.end()
            assert code == 0 and TRACEBACK not in node.err, (code, node.err)
        else:
            check_end(node)
    path = folder / 'run.mcap'
    if fault in STOPPING:
        return f'node {fault}: {what_is_left(path, folder)}'
    assert inspect.main([str(path), '--verify']) == 0
    return f'node {fault}: whole'


def check_simulate(fault, settings, folder):
    path = folder / 'run.mcap'
    command = [sys.executable, '-m', 'spinning_top_sim.tools.simulate', '-o', str(path), '--quiet',
               '--duration', '20', '-p', 'pose.rate:=1000.0']
    source = str(Path(spinning_top_sim.__file__).parents[1])
    ended = subprocess.run(command, env={**os.environ, **settings, 'PYTHONPATH': source},
                           capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert TRACEBACK not in ended.stderr, ended.stderr
    if fault in STOPPING and ended.returncode != 0:
        assert ended.returncode == 1 and ended.stderr.count('\n') == 1, ended
        return f'simulate {fault}: {what_is_left(path, folder)}'
    assert ended.returncode == 0, ended
    assert inspect.main([str(path), '--verify']) == 0
    return f'simulate {fault}: whole'


def what_is_left(path, folder):
    """Whether every pose from t = 0 up to somewhere is there, at the latest after `recover`."""
    if not path.exists():
        return 'nothing'
    whole = folder / 'whole.mcap'
    code = recover.main([str(path), '-o', str(whole)])
    if code == 1:
        with contextlib.suppress(LogError), LogReader(path) as reader:
            assert not list(reader.messages())
        return 'nothing'
    with LogReader(whole) as reader:
        epoch_ns = int(reader.metadata['spinning_top_sim']['epoch_ns'])
        poses = [message for message in reader.messages() if message.topic.endswith('pose')]
    if not poses:
        return f'recover {code}, no pose'
    stamps = np.array([message.log_time for message in poses])
    assert stamps[0] == epoch_ns and set(np.diff(stamps)) <= {1_000_000}
    assert all(stamp_of(message.data) == message.log_time for message in poses)
    return f'recover {code}'
