# SPDX-License-Identifier: Apache-2.0
"""
Several clients at a real node at once: parameters, commands, pause, step, reset, recordings.

Each is answered, no recording has a gap or a byte that `inspect --verify` does not find, and the
memory stays.
"""

import contextlib
import functools
import io
import random
import threading

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import Peer, SimNode

from spinning_top_sim.tools import inspect
from stress.nodes import MEMORY_MB, PATIENCE_S, check_end, check_life, started  # noqa: F401

CLIENTS, CALLS = 3, 30
RATES = (1.0, 7.5, 50.0, 100.0, 333.0, 1000.0)


@functools.cache
def peers():
    """Return one more than clients: the last listens."""
    return [Peer(f'peer{number}') for number in range(CLIENTS + 1)]


def check(seed, folder):
    *clients, listener = peers()
    failures = []
    with SimNode(folder, {'record.uri': f'{folder}/', 'seed': seed % 1000},
                 namespace=f'/hammered{seed}') as node:
        assert started(node), node.err
        pose = listener.listen(node.topic('pose'), PoseStamped)

        def hammer(number):
            rng = random.Random(f'{seed} {number}')
            for _ in range(CALLS):
                try:
                    call(clients[number], node, rng)
                    check_life(node, 'a call')
                except BaseException as error:
                    failures.append(error)
                    return

        threads = [threading.Thread(target=hammer, args=(number,)) for number in range(CLIENTS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if failures:
            raise failures[0]
        listener.switch(node, 'record', False)
        assert listener.set_together(node, pose__enabled=True, pose__rate=100.0,
                                     time_scale=1.0).successful
        assert listener.switch(node, 'set_pause', False).success
        assert listener.trigger(node, 'reset').success
        pose.wait_more(20)
        listener.stop_listening(pose)
        check_life(node, 'all calls')
        check_end(node)
    logs = sorted(folder.glob('*.mcap'))
    for path in logs:
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            assert inspect.main([str(path), '--verify']) == 0, said.getvalue()[-3000:]
    return f'{min(len(logs), 5)} logs{" or more" if len(logs) >= 5 else ""}'


def call(peer, node, rng):
    kind = rng.choice(('rates', 'rates', 'spin', 'spin', 'enabled', 'scale', 'pause', 'resume',
                       'step', 'reset', 'record', 'record', 'stop', 'get', 'dump'))
    stream = rng.choice(('pose', 'joint_states', 'imu', 'ground_truth_odom', 'invariants'))
    if kind == 'rates':
        assert peer.set_together(node, **{f'{stream}__rate': rng.choice(RATES)}).successful
    elif kind == 'spin':
        l3 = rng.uniform(-3.0, 3.0)
        peer.set_together(node, spin__l3=l3, spin__lz=rng.uniform(-abs(l3), abs(l3)))
    elif kind == 'enabled':
        assert peer.set_each(node, **{f'{stream}__enabled': rng.random() < 0.7})[0].successful
    elif kind == 'scale':
        assert peer.set_together(node, time_scale=rng.choice((0.1, 1.0, 3.0)),
                                 step__count=rng.randint(1, 20)).successful
    elif kind in ('pause', 'resume'):
        assert peer.switch(node, 'set_pause', kind == 'pause').success
    elif kind in ('step', 'reset'):
        peer.trigger(node, kind)
    elif kind in ('record', 'stop'):
        peer.switch(node, 'record', kind == 'record')
    elif kind == 'get':
        assert len(peer.get(node, 'spin.l3', 'spin.lz')) == 2
    else:
        assert node.name in peer.dump(node)
