# SPDX-License-Identifier: Apache-2.0
"""
The services and the action of simulation_interfaces, called by clients in another process.

Only where the package is installed; test_simulation_interfaces.py does the same with stand-ins.
"""

import threading
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('simulation_interfaces')

import simulation_interfaces.action
import simulation_interfaces.msg
import simulation_interfaces.srv
from helpers.node_harness import PATIENCE_S, SimNode, wait_for
from helpers.node_logs import (
    QUIET,
    assert_clean_end,
    settled,
    xyzw,
)
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient

from spinning_top_sim.nodes.simulation_standard import service_name

UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
CANCELED, ABORTED = 5, 6


@pytest.fixture(scope='module')
def served(peer, tmp_path_factory):
    folder = tmp_path_factory.mktemp('standard')
    with SimNode(folder, {**QUIET, 'start_paused': True}, namespace='/standard') as node:
        yield SimpleNamespace(node=node, odom=peer.listen(
            node.topic('ground_truth/odom'), Odometry))


@pytest.fixture(scope='module')
def steps(peer, served):
    client = ActionClient(peer.node, simulation_interfaces.action.SimulateSteps,
                          served.node.topic('simulate_steps'))
    assert client.wait_for_server(PATIENCE_S)
    return client


def call(peer, served, name, **request):
    kind = getattr(simulation_interfaces.srv, name)
    return peer.call(kind, served.node.topic(service_name(name)), kind.Request(**request))


def set_state(peer, served, state):
    return call(peer, served, 'SetSimulationState',
                state=simulation_interfaces.msg.SimulationState(state=state)).result.result


def resolved(future):
    """Wait for a future of the peer, whose thread spins; return its result."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(PATIENCE_S)
    return future.result()


def test_steps_publish_and_the_state_is_that_of_the_last_sample(peer, served):
    assert call(peer, served, 'GetSimulationState').state.state == STOPPED
    assert set_state(peer, served, PAUSED) == OK
    wait_for('a subscriber', lambda: peer.node.count_subscribers(
        served.node.topic('ground_truth/odom')))
    count = settled(served.odom)
    response = call(peer, served, 'StepSimulation', steps=25)
    assert response.result.result == OK, response.result.error_message
    served.odom.wait(count + 25)
    count = settled(served.odom)
    state = call(peer, served, 'GetEntityState', entity='spinning_top').state
    last = served.odom.last()
    assert state.header.stamp == last.header.stamp
    assert xyzw(state.pose.orientation) == xyzw(last.pose.pose.orientation)
    state.twist.angular.z = 12.5
    assert call(peer, served, 'SetEntityState', entity='spinning_top', state=state,
                set_twist=True).result.result == OK
    now = call(peer, served, 'GetEntityState', entity='spinning_top').state
    assert now.twist.angular.z == pytest.approx(12.5, abs=1e-12)
    assert call(peer, served, 'GetEntities').entities == ['spinning_top']


def test_simulate_steps_can_be_canceled_and_the_node_answers_meanwhile(peer, served, steps):
    feedback = []
    handle = resolved(steps.send_goal_async(
        simulation_interfaces.action.SimulateSteps.Goal(steps=10 ** 12),
        feedback_callback=feedback.append))
    wait_for('feedback', lambda: feedback)
    assert call(peer, served, 'GetSimulationState').state.state == PAUSED
    assert call(peer, served, 'StepSimulation', steps=1).result.result == FAILED
    other = resolved(steps.send_goal_async(
        simulation_interfaces.action.SimulateSteps.Goal(steps=1)))
    assert resolved(other.get_result_async()).status == ABORTED
    assert resolved(handle.cancel_goal_async()).goals_canceling
    result = resolved(handle.get_result_async())
    assert (result.status, result.result.result.result) == (CANCELED, FAILED)
    assert 'canceled after' in result.result.result.error_message
    assert call(peer, served, 'StepSimulation', steps=1).result.result == OK


def test_play_and_quit(peer, served):
    assert set_state(peer, served, PLAYING) == OK
    served.odom.wait_more(20)
    assert call(peer, served, 'ResetSimulation', scope=4).result.result == UNSUPPORTED
    assert set_state(peer, served, QUITTING) == OK
    assert_clean_end(served.node, served.node.wait())
