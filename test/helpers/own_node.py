# SPDX-License-Identifier: Apache-2.0
"""A sim_node in this process: a test calls what the executor would call, or lets it spin."""

import gc
import re
import sys
from types import SimpleNamespace
from unittest import mock

import rclpy
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from helpers.node_harness import options, wait_for
from spinning_top_sim.nodes import loop
from spinning_top_sim.nodes.node import Simulator


class InThisProcess:
    """What is made with `node` runs within the `with`."""

    def __enter__(self):
        self.node.start()
        return self

    def __exit__(self, *_):
        self.node.stop()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def switch(self, name, on):
        return self._serve(SetBool, name, data=on)

    def trigger(self, name):
        return self._serve(Trigger, name)

    def _serve(self, kind, name, **request):
        (service,) = (one for one in self.node.services if one.srv_name.endswith(f'/{name}'))
        answer = service.callback(kind.Request(**request), kind.Response())
        if isinstance(answer, Future):
            self.spin_until('an answer', answer.done)
            return answer.result()
        return answer

    def spin_until(self, what, condition):
        wait_for(what, lambda: condition() or rclpy.spin_once(self.node, timeout_sec=0.1))


class OwnNode(InThisProcess):
    """
    The node; it runs within the `with`.  In keywords `__` stands for a dot.

    arguments: more of --ros-args;  heard: messages by topic, of those that `listen` names
    """

    def __init__(self, folder, *arguments, **values):
        given = {'status_period': 0.0, 'record.uri': f'{folder}/run.mcap',
                 'record.min_free_bytes': 0, **dotted(values)}
        argv = ['--ros-args', *options(given), *arguments]
        rclpy.init(args=argv)
        self.node = Simulator({})
        self.loop, self.simulation = self.node.loop, self.node.simulation
        self.heard, self._diagnosed = {}, []
        self.publisher('diagnostics').publish = self._diagnosed.append

    def publisher(self, topic):
        """Return the publisher of this topic; `topic` is the end of its name."""
        (found,) = (one for one in self.node.publishers if one.topic_name.endswith(f'/{topic}'))
        return found

    def listen(self, *topics):
        """Let these topics have a subscriber, which needs no DDS."""
        for topic in topics:
            self.heard[topic] = []
            publisher = self.publisher(topic)
            publisher.publish = lambda data, topic=topic: self.heard[topic].append(data)
            publisher.get_subscription_count = lambda: 1
            publisher.wait_for_all_acked = lambda timeout: None
        return self

    def set(self, **values):
        """Set parameters all or none; return the result."""
        return self.node.set_parameters_atomically([
            Parameter(name, value=value) for name, value in dotted(values).items()])

    def get(self, *names):
        return [self.node.get_parameter(name).value for name in names]

    def receive(self, topic, message):
        (found,) = (one for one in self.node.subscriptions
                    if one.topic_name.endswith(f'/{topic}'))
        found.callback(message)

    def command(self, *data):
        self.receive('commands', Float64MultiArray(data=[float(one) for one in data]))

    def step(self, count):
        """Step a paused motion, by 10 ms each; the samples are sent afterwards."""
        assert self.set(step__count=count).successful
        with mock.patch.object(loop, 'STEP_BUDGET_NS', 10 ** 11):    # on a slow machine, too
            answer = self.trigger('step')
        assert answer.success, answer.message

    def diagnostics(self):
        """Return level, message and values of a new report."""
        (timer,) = (one for one in self.node.timers if one.timer_period_ns == 10 ** 9)
        timer.callback()
        (status,) = self._diagnosed[-1].status
        return status.level[0], status.message, {
            pair.key: pair.value for pair in status.values}

    def wait_until(self, t_ns):
        self.spin_until(f't = {t_ns} ns', lambda: self.simulation.sent_ns >= t_ns)


def dotted(values):
    return {name.replace('__', '.'): value for name, value in values.items()}


def run_main(main, capfd, *arguments):
    """Run the `main` of a node; return its exit code, and what it has printed."""
    capfd.readouterr()
    interval = sys.getswitchinterval()
    try:
        code = main([*map(str, arguments)])
    except SystemExit as error:         # of argparse
        code = error.code
    finally:                            # what `main` changes for all of its process
        rclpy.try_shutdown()
        sys.setswitchinterval(interval)
        gc.unfreeze()
    printed = capfd.readouterr()
    return SimpleNamespace(code=code, out=printed.out, err=re.sub(r'\x1b\[\d*m', '', printed.err))
