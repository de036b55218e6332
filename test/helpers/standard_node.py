# SPDX-License-Identifier: Apache-2.0
"""A sim_node in this process whose handlers of simulation_interfaces are called directly."""

import importlib
import importlib.util

import pytest

from helpers import standard_types
from helpers.own_node import OwnNode
from spinning_top_sim.nodes.simulation_handlers import SimulationHandlers

INSTALLED = importlib.util.find_spec('simulation_interfaces') is not None
KINDS = ('stand-in', 'installed') if INSTALLED else ('stand-in',)


def types_of(kind):
    """Return simulation_interfaces.msg and .srv."""
    if kind == 'stand-in':
        return standard_types.modules()
    return [importlib.import_module(f'simulation_interfaces.{part}')
            for part in ('msg', 'srv')]


class StandardNode(OwnNode):
    """The node, which starts paused; `call` calls a handler as the executor calls it."""

    def __init__(self, folder, kind='stand-in', **values):
        super().__init__(folder, start_paused=True, **values)
        self.messages, self.services = types_of(kind)
        self.handlers = SimulationHandlers(self.node, self.messages)

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


@pytest.fixture(params=KINDS, name='stopped')
def standard_node(request, tmp_path):
    with StandardNode(tmp_path, request.param) as top:
        yield top
