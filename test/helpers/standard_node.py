# SPDX-License-Identifier: Apache-2.0
"""A sim_node in this process whose handlers of simulation_interfaces are called directly."""

import importlib
import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import rclpy

from helpers import standard_types
from helpers.node_harness import as_yaml, wait_for
from spinning_top_sim.nodes import simulation_services
from spinning_top_sim.nodes.simulation_handlers import SimulationHandlers
from spinning_top_sim.nodes.simulator import Simulator

INSTALLED = importlib.util.find_spec('simulation_interfaces') is not None
KINDS = ('stand-in', 'installed') if INSTALLED else ('stand-in',)


def types_of(kind):
    """Return simulation_interfaces.msg, .srv and .action."""
    if kind == 'stand-in':
        return standard_types.modules()
    return [importlib.import_module(f'simulation_interfaces.{part}')
            for part in ('msg', 'srv', 'action')]


class StandardNode:
    """
    The node; `call` calls a handler as the executor calls it, `steps` is an action's coroutine.

    The node starts paused, unless told otherwise.
    """

    def __init__(self, kind, monkeypatch, folder, **values):
        self.messages, self.services, self.actions = types_of(kind)
        package = ModuleType('simulation_interfaces')
        package.__spec__ = SimpleNamespace()
        monkeypatch.setitem(sys.modules, 'simulation_interfaces', package)
        monkeypatch.setattr(simulation_services, 'offer', self._offer)
        given = {'start_paused': True, 'status_period': 0.0, 'record.uri': f'{folder}/run.mcap',
                 'record.min_free_bytes': 0,
                 **{name.replace('__', '.'): value for name, value in values.items()}}
        options = [item for name, value in given.items()
                   for item in ('-p', f'{name}:={as_yaml(value)}')]
        rclpy.init(args=['sim_node', '--ros-args', *options])
        self.node = Simulator()

    def _offer(self, node, control, loop, simulation, lock, frame):
        self.loop, self.simulation = loop, simulation
        self.handlers = SimulationHandlers(control, loop, simulation, lock, self.messages,
                                           self.actions, node.get_name(), frame)

    def __enter__(self):
        self.node.start()
        return self

    def __exit__(self, *_):
        self.node.stop()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def call(self, name, **request):
        """Return the response to a request with these fields."""
        service = getattr(self.services, name)
        return self.handlers.serve(name, service.Request(**request), service.Response())

    def done(self, name, **request):
        """Return the response to a request that succeeds."""
        response = self.call(name, **request)
        assert response.result.result == self.messages.Result.RESULT_OK, (
            response.result.error_message)
        return response

    def refused(self, name, **request):
        """Return the code of a refusal, and its text."""
        result = self.call(name, **request).result
        assert result.result != self.messages.Result.RESULT_OK
        assert result.error_message
        return result.result, result.error_message

    @property
    def state(self):
        return self.done('GetSimulationState').state.state

    def set_state(self, name):
        """Ask for a state; return the code of the result."""
        number = getattr(self.messages.SimulationState, f'STATE_{name}')
        return self.call('SetSimulationState', state=self.messages.SimulationState(
            state=number)).result.result

    def pause(self):
        """Leave the stopped state without a step."""
        assert self.set_state('PAUSED') == self.messages.Result.RESULT_OK
        return self

    def wait_until(self, t_ns):
        wait_for(f't = {t_ns} ns', lambda: self.simulation.now_ns >= t_ns)

    def steps(self, count):
        """Return a goal of SimulateSteps, and the coroutine that executes it."""
        goal = Goal(self.actions.SimulateSteps.Goal(steps=count))
        return goal, self.handlers.steps_action(goal)

    def parameter(self, name):
        return self.node.get_parameter(name).value


class Goal:
    """A goal handle of an action server: what has become of it, and the feedback."""

    def __init__(self, request):
        self.request, self.feedback, self.end = request, [], None
        self.is_cancel_requested = False

    def publish_feedback(self, feedback):
        self.feedback.append((feedback.completed_steps, feedback.remaining_steps))

    def succeed(self):
        self.end = 'succeeded'

    def abort(self):
        self.end = 'aborted'

    def canceled(self):
        self.end = 'canceled'


def finished(coroutine, turns=10_000):
    """Execute a coroutine as an executor does; return what it returns."""
    for _ in range(turns):
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
    raise AssertionError(f'not finished after {turns} turns')
