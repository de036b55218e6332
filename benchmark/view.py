#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure what the page in the browser costs the node: `python benchmark/view.py`.

Two sim_nodes record at 200 Hz, each in a domain of its own.  In turn one has the page, which has
one client that counts the attitudes that arrive, and the other has not.  Both are measured at the
same time, and each in both parts: what else this machine does cancels in the ratio.
"""

import argparse
import contextlib
import math
import os
import re
import tempfile
import threading
import time
from collections.abc import Sequence

import msgspec
import report
import viser
import zstandard
from processes import SIM_NODE, Process, median, ros_arguments, script
from websockets.sync.client import connect

NAMESPACE = '/view_cost'
VIEW = ('-P', '-u', '-m', 'spinning_top_sim.view.command', '--no-browser')
DOMAINS = os.environ['ROS_DOMAIN_ID'], str((int(os.environ['ROS_DOMAIN_ID']) + 100) % 200)
WARM_UP_S = 5.0
HEADS = ('sim_node', 'of a core', 'with the page', 'ratio', 'page, of a core',
         'attitudes a second')
PACKAGES = ('ros-jazzy-rclpy', 'viser', 'websockets')


class Client(threading.Thread):
    """A browser without pictures: counts the attitudes of the body."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._socket = connect(address.replace('http', 'ws'), max_size=None,
                               subprotocols=[f'viser-v{viser.__version__}'], origin=address)
        self.count = 0

    def run(self) -> None:
        unzip = zstandard.ZstdDecompressor()
        for message in self._socket:
            size = int.from_bytes(message[8:16], 'little')
            content = msgspec.msgpack.decode(unzip.decompress(message[16:16 + size]))
            self.count += sum(
                part['type'] == 'SetOrientationMessage' and part['name'] == '/top0/body'
                for part in content['messages'])


def started(number: int, program: Sequence[str], arguments: Sequence[str], *,
            talks: bool = False) -> Process:
    """Return a process in one of the two domains."""
    os.environ['ROS_DOMAIN_ID'] = DOMAINS[number]
    return Process(program, arguments, talks=talks)


def measure(processes: Sequence[Process], client: Client, seconds: float) -> list[float]:
    """Return the share of a core of each process, and the attitudes a second."""
    begin, count, begun = [one.cpu_ns() for one in processes], client.count, time.monotonic()
    time.sleep(seconds)
    taken = time.monotonic() - begun
    return [*((one.cpu_ns() - before) * 1e-9 / taken
              for one, before in zip(processes, begin, strict=True)),
            (client.count - count) / taken]


def compare(title: str, sims: Sequence[Process], options: argparse.Namespace) -> list[str]:
    """Return a row of HEADS: what the page costs the node, and itself."""
    ratios, parts = [], []
    for _ in range(options.rounds):
        part = []
        for number, sim in enumerate(sims):
            with started(number, VIEW, ros_arguments(NAMESPACE, {}), talks=True) as view:
                found = re.search(r'http://[\w.:]+', view.line())
                assert found
                client = Client(found.group())
                client.start()
                time.sleep(WARM_UP_S)
                part.append(measure((sim, sims[1 - number], view), client, options.seconds))
        ratios.append(math.sqrt(math.prod(watched / alone for watched, alone, *_ in part)))
        parts += part
    watched, alone, page, rate = (median(column) for column in zip(*parts, strict=True))
    row = [title, f'{alone:.1%}', f'{watched:.1%}',
           f'{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})', f'{page:.1%}',
           f'{rate:.1f}']
    print(*row, sep=' | ', flush=True)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=5.0)
    parser.add_argument('--rounds', type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        parameters = {
            'record.enabled': True, 'status_period': 0.0,
            **{f'{stream}.rate': 200.0 for stream in ('pose', 'joint_states', 'imu')}}
        sims = [stack.enter_context(started(number, SIM_NODE, ros_arguments(
            NAMESPACE, {**parameters, 'record.uri': f'{folder}/run{number}.mcap'})))
            for number in range(2)]
        time.sleep(WARM_UP_S)
        rows = [compare('recording at 200 Hz', sims, options)]
        listeners = [stack.enter_context(started(number, script('listener.py'), [NAMESPACE],
                                                 talks=True)) for number in range(2)]
        for listener in listeners:
            listener.line()         # it is ready
        rows.append(compare('and publishing pose, joint_states and imu', sims, options))
        for listener in listeners:
            listener.tell('')
    assert __doc__
    report.write('view_cost.md', '\n'.join((
        report.preamble('What the page costs', PACKAGES), __doc__.strip().split('\n\n')[-1] + '\n',
        'The ratio is the median of the rounds, and their range.\n',
        report.table(HEADS, rows))))


if __name__ == '__main__':
    main()
