#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
What the page costs: `python benchmark/view.py` (extras `ros` and `view`).

A sim_node records at 200 Hz; the page has one client, which counts the attitudes that arrive.
Rounds with and without the page alternate.
"""

import argparse
import re
import tempfile
import threading
import time

import msgspec
import viser
import zstandard
from processes import SIM_NODE, Process, median, ros_arguments, script
from websockets.sync.client import connect

NAMESPACE = '/view_cost'
VIEW = ('-P', '-u', '-m', 'spinning_top_sim.view.command', '--no-browser')


class Client(threading.Thread):
    """A browser without pictures: counts the attitudes of the body."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._socket = connect(address.replace('http', 'ws'), max_size=None,
                               subprotocols=[f'viser-v{viser.__version__}'])
        self.count = 0

    def run(self) -> None:
        unzip = zstandard.ZstdDecompressor()
        for message in self._socket:
            size = int.from_bytes(message[8:16], 'little')
            content = msgspec.msgpack.decode(unzip.decompress(message[16:16 + size]))
            self.count += sum(
                part['type'] == 'SetOrientationMessage' and part['name'] == '/top0/body'
                for part in content['messages'])


def measure(sim: Process, seconds: float, view: Process | None = None,
            client: Client | None = None) -> tuple[float, float, float]:
    """Return the shares of a core of sim_node and page, and the attitudes a second."""
    begin = sim.cpu_ns(), view.cpu_ns() if view else 0, client.count if client else 0
    begun = time.monotonic()
    time.sleep(seconds)
    taken = time.monotonic() - begun
    return ((sim.cpu_ns() - begin[0]) * 1e-9 / taken,
            (view.cpu_ns() - begin[1]) * 1e-9 / taken if view else 0.0,
            (client.count - begin[2]) / taken if client else 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--rounds', type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        parameters = {
            'record.enabled': True, 'record.uri': f'{folder}/run.mcap', 'status_period': 0.0,
            **{f'{stream}.rate': 200.0 for stream in ('pose', 'joint_states', 'imu')}}
        with Process(SIM_NODE, ros_arguments(NAMESPACE, parameters)) as sim:
            time.sleep(5.0)
            compare('sim_node, recording at 200 Hz', sim, options)
            with Process(script('listener.py'), [NAMESPACE], talks=True) as listener:
                listener.line()         # it is ready
                compare('the same with another subscriber of pose, joint_states and imu', sim,
                        options)
                listener.tell('')


def compare(title: str, sim: Process, options: argparse.Namespace) -> None:
    """Print what the page costs the node, and itself."""
    alone, watched, page, rates = [], [], [], []
    for _ in range(options.rounds):
        alone.append(measure(sim, options.seconds)[0])
        with Process(VIEW, ros_arguments(NAMESPACE, {}), talks=True) as view:
            found = re.search(r'http://[\w.:]+', view.line())
            assert found
            client = Client(found.group())
            client.start()
            time.sleep(5.0)
            node_share, page_share, rate = measure(sim, options.seconds, view, client)
            watched.append(node_share)
            page.append(page_share)
            rates.append(rate)
    print(f'{title}: {median(alone):.1%} of a core; with the page {median(watched):.1%}, '
          f'{median(watched) / median(alone):.2f} times')
    print(f'page: {median(page):.1%} of a core, {median(rates):.1f} attitudes a second',
          flush=True)


if __name__ == '__main__':
    main()
