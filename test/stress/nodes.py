# SPDX-License-Identifier: Apache-2.0
"""
Extreme parameters, commands and services at a real node, one after the other.

It refuses to start in one line, or answers everything, lives, ends properly when it is told to,
and leaves whole logs.
"""

import functools
import random
import time

from helpers.extremes import actions, parameter_set
from helpers.node_harness import PATIENCE_S, Peer, SimNode, wait_for
from helpers.node_logs import TRACEBACK
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

from spinning_top_sim.recording.reader import LogReader

PATIENCE_S = 5.0 * PATIENCE_S
MEMORY_MB = 4000            # of the worker; DDS maps memory that it does not use
NODE_MB = 500               # of the node
LINES = 'spinning-top node: cannot start:'


@functools.cache
def shared_peer():
    return Peer()


def started(node):
    """Wait until the node serves, or has ended; return whether it serves."""
    peer = shared_peer()
    client = peer.node.create_client(SetBool, node.topic('~/set_pause'))
    wait_for('a start or an end', lambda: not node.alive or client.service_is_ready())
    return node.alive


def check_refusal(node):
    code = node.wait()
    assert code == 2, (code, node.err[-3000:])
    assert TRACEBACK not in node.err, node.err[-3000:]
    assert sum(line.startswith(LINES) for line in node.err.splitlines()) == 1, node.err[-3000:]


def check_life(node, what):
    assert node.alive, (what, node.process.returncode, node.err[-3000:])
    assert TRACEBACK not in node.err, (what, node.err[-3000:])
    assert node.memory() < NODE_MB * 1e6, f'{node.memory() / 1e6:.0f} MB after {what}'


def check_end(node):
    """End it; its logs are whole."""
    code = node.end()
    assert code == 0, (code, node.err[-3000:])
    assert TRACEBACK not in node.err, node.err[-3000:]
    for path in node.folder.glob('*.mcap'):
        with LogReader(path) as reader:
            assert reader.whole, path


def check(seed, folder):
    rng = random.Random(seed)
    given = {**parameter_set(rng), 'record.enabled': seed % 2 == 0}
    with SimNode(folder, given, namespace=f'/stress{seed}') as node:
        if not started(node):
            check_refusal(node)
            return 'refused'
        refused = sum(not done(node, kind, value) for kind, value in actions(rng))
        check_end(node)
    return f'ran, {"some" if refused else "none"} refused'


def done(node, kind, value):
    """Do it; return whether the node has agreed."""
    peer = shared_peer()
    agreed = True
    if kind == 'set':
        try:
            answer = peer.set_together(
                node, **{name.replace('.', '__'): one for name, one in value.items()})
        except (AssertionError, TypeError, ValueError, OverflowError, AttributeError) as error:
            if 'no answer' in str(error) or 'no service' in str(error):
                raise
            return True         # rclpy itself has no such value
        agreed = answer.successful
        assert agreed or (answer.reason and '\n' not in answer.reason), (value, answer.reason)
    elif kind == 'command':
        publisher = peer.node.create_publisher(Float64MultiArray, node.topic('~/commands'), 10)
        wait_for('a subscriber', lambda: publisher.get_subscription_count() or not node.alive)
        publisher.publish(Float64MultiArray(data=value))
    elif kind == 'pause':
        agreed = peer.switch(node, 'set_pause', value).success
    elif kind in ('step', 'reset'):
        agreed = peer.trigger(node, kind).success
    else:
        time.sleep(value)
    check_life(node, (kind, value))
    return agreed
