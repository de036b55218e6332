# SPDX-License-Identifier: Apache-2.0
"""A sim_node in this process whose handlers of simulation_interfaces are called directly."""

import importlib
import importlib.util
from functools import partial

import pytest

from helpers import standard_types
from helpers.own_node import OwnNode
from spinning_top_sim.nodes.simulation_handlers import SimulationHandlers

INSTALLED = importlib.util.find_spec('simulation_interfaces') is not None
KINDS = ('stand-in', 'installed') if INSTALLED else ('stand-in',)


def types_of(kind):
    """Return simulation_interfaces.msg, .srv and .action."""
    if kind == 'stand-in':
        return standard_types.modules()
    return [importlib.import_module(f'simulation_interfaces.{part}')
            for part in ('msg', 'srv', 'action')]


class StandardNode(OwnNode):
    """
    The node; `call` calls a handler as the executor calls it, `steps` is an action's coroutine.

    The node starts paused.
    """

    def __init__(self, folder, kind='stand-in', **values):
        super().__init__(folder, start_paused=True, **values)
        self.messages, self.services, self.actions = types_of(kind)
        self._first_values = dict(self.node.start_values)
        self._forget()

    def _forget(self):
        self.handlers = SimulationHandlers(self.node, self.messages, self.actions)

    def renew(self):
        """Go back to the state after the start."""
        self.begin_again(self._first_values)
        self._forget()

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

    def steps(self, count):
        """Return a goal of SimulateSteps, and the coroutine that executes it."""
        goal = Goal(self.actions.SimulateSteps.Goal(steps=count))
        return goal, self.handlers.simulate_steps(goal)


@pytest.fixture(scope='module', params=KINDS, name='node')
def standard_node(request, tmp_path_factory):
    with StandardNode(tmp_path_factory.mktemp('node'), request.param) as node:
        yield node


class Goal:
    """A goal handle of an action server: what has become of it, and the feedback."""

    def __init__(self, request):
        self.request, self.feedback, self.end = request, [], None
        self.is_cancel_requested = False
        self.succeed, self.abort, self.canceled = (
            partial(setattr, self, 'end', end) for end in ('succeeded', 'aborted', 'canceled'))

    def publish_feedback(self, feedback):
        self.feedback.append((feedback.completed_steps, feedback.remaining_steps))


def finished(coroutine, turns=10_000):
    """Execute a coroutine as an executor does; return what it returns."""
    for _ in range(turns):
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
    raise AssertionError(f'not finished after {turns} turns')
