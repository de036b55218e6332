# SPDX-License-Identifier: Apache-2.0
"""The executor that attends to ticks and messages itself and leaves all else to rclpy."""

import contextlib

import pytest

pytest.importorskip('rclpy')

import rclpy
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import QUIET, assert_clean_end
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from spinning_top_sim.nodes.prompt import PromptExecutor, PromptGroup

# How often rclpy looked for what is ready, in so many ticks.
WAITS = """
import sys
from rclpy.executors import SingleThreadedExecutor
from spinning_top_sim.nodes.sim_node import main
from spinning_top_sim.nodes.simulator import Simulator
counts = {'ticks': 0, 'waits': 0}
def counted(kind, name, count):
    original = getattr(kind, name)
    def call(self, *arguments, **keywords):
        counts[count] += 1
        return original(self, *arguments, **keywords)
    setattr(kind, name, call)
counted(Simulator, '_tick', 'ticks')
counted(SingleThreadedExecutor, '_wait_for_ready_callbacks', 'waits')
code = main()
print('counts', counts['ticks'], counts['waits'])
sys.exit(code)
"""


class Spun:
    """A node, what spins it, and a prompt timer that gives up after so many calls."""

    LONGEST = 4000

    def __init__(self, executor_class=PromptExecutor, group=None):
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = Node('spun', context=self.context)
        self.executor = executor_class(context=self.context)
        self.executor.add_node(self.node)
        self.calls, self.done, self.at = 0, Future(), {}
        self.timer = self.node.create_timer(0.001, self._call, callback_group=group)
        self.seen = []

    def _call(self):
        self.calls += 1
        self.at.get(self.calls, lambda: None)()
        if self.calls == self.LONGEST and not self.done.done():
            self.done.set_result('nothing else has ended it')

    def end(self):
        self.done.set_result('as meant')

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def run(self):
        self.executor.run_until(self.done)
        return self.done.result()


@pytest.fixture
def spun():
    with Spun(group=PromptGroup()) as spun:
        yield spun


def test_ticks_do_without_rclpys_search(tmp_path):
    with SimNode(tmp_path, {**QUIET, 'duration': 2.0, 'tick_rate': 500.0},
                 program=('-c', WAITS)) as node:
        assert_clean_end(node, node.wait())
        line = next(line for line in node.out.splitlines() if line.startswith('counts'))
    ticks, waits = (int(word) for word in line.split()[1:])
    print(f'{waits} waits by rclpy in {ticks} ticks')
    assert ticks >= 200
    assert 1 <= waits < ticks / 4


def test_other_executors_call_a_prompt_timer_too():
    with Spun(SingleThreadedExecutor, PromptGroup()) as spun:
        spun.at[5] = spun.end
        spun.executor.spin_until_future_complete(spun.done, 30.0)
        assert spun.done.result() == 'as meant'


def test_other_timers_are_called_where_none_is_prompt():
    with Spun() as spun:
        spun.at[5] = spun.end
        assert spun.run() == 'as meant'


def test_what_is_made_and_destroyed_meanwhile_is_seen(spun):
    def make():
        spun.other = spun.node.create_timer(0.01, other)

    def other():
        spun.seen.append(spun.calls)
        if len(spun.seen) == 3:
            spun.node.destroy_timer(spun.other)
            spun.at[spun.calls + 50] = spun.end

    spun.at[10] = make
    assert spun.run() == 'as meant'
    assert len(spun.seen) == 3
    assert min(spun.seen) >= 10


def test_prompt_timers_can_be_cancelled_reset_and_destroyed(spun):
    def other():
        spun.seen.append(spun.calls)
        if len(spun.seen) == 5:
            spun.timer.reset()
        elif len(spun.seen) == 10:
            spun.node.destroy_timer(spun.timer)
        elif len(spun.seen) == 15:
            spun.end()

    spun.node.create_timer(0.01, other)
    spun.at[20] = spun.timer.cancel
    assert spun.run() == 'as meant'
    assert 20 in spun.seen, 'it was silent for a while'
    assert spun.seen[8] > 20, 'and called again'
    assert spun.seen[10] == spun.seen[14], 'and never once it was gone'


def test_services_and_clients_of_the_node_itself_work(spun):
    """A client has the node fall back to rclpy's way; its timer goes on."""
    def answer(_, response):
        response.message = f'{spun.calls} calls'
        return response

    def ask():
        client = spun.node.create_client(Trigger, 'asked')
        client.call_async(Trigger.Request()).add_done_callback(answered)

    def answered(future):
        spun.seen.append(future.result().message)
        spun.at[spun.calls + 20] = spun.end

    spun.node.create_service(Trigger, 'asked', answer)
    spun.at[10] = ask
    assert spun.run() == 'as meant'
    assert spun.seen[0].endswith(' calls')


def test_subscriptions_get_every_message_without_rclpys_search(spun, monkeypatch):
    looks, told = [], []
    original = spun.executor._wait_for_ready_callbacks

    def look(*arguments, **keywords):
        looks.append(spun.calls)
        return original(*arguments, **keywords)

    def received(message):
        spun.seen.append(message.data)
        if len(spun.seen) == 100:
            spun.end()

    monkeypatch.setattr(spun.executor, '_wait_for_ready_callbacks', look)
    spun.node.create_subscription(Int32, 'numbers', received, 10)
    spun.node.create_subscription(Int32, 'numbers', told.append, 10, raw=True)
    spun.node.create_subscription(Int32, 'numbers', lambda _, info: told.append(info), 10)
    publisher = spun.node.create_publisher(Int32, 'numbers', 10)
    wait_for('itself', lambda: publisher.get_subscription_count() == 3)
    for number in range(1, 101):
        spun.at[number] = lambda number=number: publisher.publish(Int32(data=number))
    assert spun.run() == 'as meant'
    assert spun.seen == list(range(1, 101))
    assert {type(one) for one in told} == {bytes, dict}
    assert len(told) >= 190
    assert len(looks) < 20


def test_tasks_and_the_exceptions_of_callbacks_come_through(spun):
    def fail():
        raise ZeroDivisionError

    spun.at[10] = lambda: spun.executor.create_task(lambda: spun.seen.append(spun.calls))
    spun.at[30] = fail
    with pytest.raises(ZeroDivisionError):
        spun.run()
    assert spun.seen and 10 <= spun.seen[0] < 30


def test_a_callback_that_takes_longer_than_the_period_leaves_others_their_turn(spun):
    def busy():
        sum(range(200_000))             # some milliseconds
        spun.at[spun.calls + 1] = busy

    def other():
        spun.seen.append(spun.calls)
        if len(spun.seen) == 3:
            spun.end()

    spun.at[1] = busy
    spun.node.create_timer(0.02, other)
    assert spun.run() == 'as meant'


def test_a_shutdown_ends_it(spun):
    spun.at[10] = lambda: rclpy.shutdown(context=spun.context)
    with contextlib.suppress(ExternalShutdownException):
        spun.executor.run_until(spun.done)
    assert spun.calls < 20
