# SPDX-License-Identifier: Apache-2.0
"""
A node in a process of its own, and a peer that talks to it, in the domain of own_domain.

A test waits for an event, at most PATIENCE_S: the speed of the machine decides nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

import helpers.own_domain  # noqa: F401, for programs without conftest.py
import spinning_top_sim

PATIENCE_S = 60.0           # for what takes a second on an idle machine


def wait_for(what, condition):
    """Wait until a condition holds, and return its value; fail with `what` after PATIENCE_S."""
    end = time.monotonic() + PATIENCE_S
    while not (result := condition()):
        assert time.monotonic() < end, f'{PATIENCE_S:g} s and still not: {what}'
        time.sleep(0.005)
    return result


class SimNode:
    """
    A sim_node in its own process group; it ends with the `with` at the latest.

    parameters: by name;  arguments: more of --ros-args;  program: arguments of python instead of
    the module;  executor: 'single' hides rclpy's EventsExecutor;  out, err: its output so far
    """

    _number = itertools.count(1)

    def __init__(self, folder, parameters=None, *, namespace=None, arguments=(), program=None,
                 executor='events'):
        namespace = namespace or f'/top{next(self._number)}'    # tests share a domain, not names
        self.namespace = namespace.rstrip('/')
        self.name = f'{self.namespace}/spinning_top'
        self.folder = Path(folder) / (namespace.strip('/') or 'root')
        self.folder.mkdir(parents=True, exist_ok=True)
        if executor == 'single':
            (self.folder / 'sitecustomize.py').write_text(
                "import sys; sys.modules['rclpy.experimental'] = None")
        self.command = [        # it ends with the test process, also if that is killed
            *(('setpriv', '--pdeathsig', 'KILL') if shutil.which('setpriv') else ()),
            sys.executable, *(program or ('-m', 'spinning_top_sim', 'node')), '--ros-args', '-r',
            f'__ns:={namespace}', *options(parameters or {}), *arguments]

    def __enter__(self):
        source = Path(spinning_top_sim.__file__).parents[1]
        environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(
            [f'{self.folder}', f'{source}', os.environ.get('PYTHONPATH', '')]).rstrip(os.pathsep)}
        if 'LD_LIBRARY_PATH' not in environment:        # then the wheels must start python anew
            environment.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None)
        with (self.folder / 'out').open('wb') as out, (self.folder / 'err').open('wb') as err:
            self.process = subprocess.Popen(
                self.command, cwd=self.folder, env=environment, start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        return self

    def __exit__(self, *_):
        self.signal(signal.SIGKILL)
        self.process.wait()

    def signal(self, number):
        """Signal the process group, if it is there."""
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)

    def end(self, *numbers):
        """Signal the process group, wait, and return the exit code."""
        for number in numbers or (signal.SIGINT,):
            self.signal(number)
        return self.process.wait(PATIENCE_S)

    @property
    def out(self):
        return (self.folder / 'out').read_text()

    @property
    def err(self):
        return (self.folder / 'err').read_text()

    def topic(self, name):
        """Return the full name of a topic or service, `~` for the node's own."""
        return self.name + name[1:] if name.startswith('~') else f'{self.namespace}/{name}'


def options(parameters):
    """Return the arguments that set parameters."""
    return [item for name, value in parameters.items() for item in ('-p', f'{name}:=' + (
        value if isinstance(value, str)
        else json.dumps(value).replace('Infinity', '.inf').replace('NaN', '.nan')))]


class Peer:
    """A node in the test's process, with a thread that listens, within the `with`."""

    def __init__(self):
        context = Context()
        rclpy.init(context=context)
        self.node = Node('peer', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)
        self._closed = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        # Not spin(): shutdown() may destroy its guard condition before it waits for it.
        with contextlib.suppress(ExternalShutdownException):
            while not self._closed:
                self._executor.spin_once(timeout_sec=0.5)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._closed = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.node.context)

    def listen(self, name, kind):
        """Return the list to which the serialized messages on a topic are appended."""
        heard = []
        self.node.create_subscription(kind, name, heard.append, QoSProfile(depth=20_000), raw=True)
        return heard

    def call(self, kind, name, request):
        """Call a service, again where no answer comes, and return the answer."""
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(PATIENCE_S), f'no service {name}'
        # A server that has not discovered a new client drops its answer after 0.1 s, and a node
        # that has ended stays in the graph for seconds.
        asked = []

        def answered():
            if not asked or time.monotonic() > asked[-1][0] + PATIENCE_S / 10:
                asked.append((time.monotonic(), client.call_async(request)))
            return next((future for _, future in asked if future.done()), None)

        return wait_for(f'an answer from {name}', answered).result()

    def switch(self, node, name, on):
        return self.call(SetBool, node.topic(f'~/{name}'), SetBool.Request(data=on))

    def set_together(self, node, **values):
        """Set parameters all or none (`__` for the dot); return the one result."""
        request = SetParametersAtomically.Request(parameters=[
            Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
            for name, value in values.items()])
        return self.call(SetParametersAtomically, node.topic('~/set_parameters_atomically'),
                         request).result
