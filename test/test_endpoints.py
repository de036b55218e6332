# SPDX-License-Identifier: Apache-2.0
"""Message types, and services that answer later."""

import importlib

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import PATIENCE_S, Peer, wait_for
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from spinning_top_sim.nodes.node import answers_later
from spinning_top_sim.nodes.publishers import message_class


def test_only_message_classes_of_installed_ros_packages_are_found(monkeypatch):
    assert message_class('geometry_msgs/msg/Twist') is message_class('geometry_msgs/Twist')
    assert message_class('std_msgs/msg/String').__name__ == 'String'
    imported = []
    monkeypatch.setattr(importlib, 'import_module', imported.append)
    for name in ('antigravity/msg/X', '/msg/String', 'std_msgs', 'std_msgs/msg/string',
                 'std_msgs.msg/msg/String', '../std_msgs/msg/String', 'std_msgs/msg/String\n',
                 'nowhere_msgs/msg/Thing'):
        with pytest.raises(LookupError):
            message_class(name)
    assert imported == []
    monkeypatch.undo()
    for name in ('std_msgs/msg/Nothing', 'std_srvs/srv/Trigger', 'std_srvs/msg/Trigger'):
        with pytest.raises(LookupError):
            message_class(name)


def executors():
    yield SingleThreadedExecutor
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return
    yield EventsExecutor


@pytest.mark.parametrize('kind', executors())
def test_a_service_that_answers_later_lets_the_others_answer_meanwhile(kind):
    import rclpy

    context = Context()
    rclpy.init(context=context)
    node, waiting = Node('late', context=context), []

    def later(_, response):
        waiting.append((Future(), response))
        return waiting[-1][0]

    def at_once(_, response):
        response.message = 'at once'
        return response

    answers_later(node.create_service(Trigger, '~/later', later))
    node.create_service(Trigger, '~/at_once', at_once)
    executor = kind(context=context)
    executor.add_node(node)
    with Peer() as peer:
        clients = [peer.node.create_client(Trigger, f'/late/{name}',
                                           callback_group=ReentrantCallbackGroup())
                   for name in ('later', 'at_once')]
        assert all(client.wait_for_service(PATIENCE_S) for client in clients)

        def spin_until(what, condition):
            wait_for(what, lambda: condition() or executor.spin_once(0.1))

        first, second = (clients[0].call_async(Trigger.Request()) for _ in range(2))
        spin_until('both requests', lambda: len(waiting) == 2)
        between = clients[1].call_async(Trigger.Request())
        spin_until('the other answer', between.done)
        assert between.result().message == 'at once' and not first.done()
        for text, (future, response) in zip(('one', 'two'), waiting, strict=True):
            response.message = text
            future.set_result(response)
        spin_until('both answers', lambda: first.done() and second.done())
        assert {first.result().message, second.result().message} == {'one', 'two'}
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
