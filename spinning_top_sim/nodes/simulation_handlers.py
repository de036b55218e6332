# SPDX-License-Identifier: Apache-2.0
"""
Offers simulation_interfaces, the standard of ROS 2 for simulators.

The handler of GetEntities is `_get_entities`.  A handler takes a request, fills the response, and
may return a text for `error_message`.  RefusedError has the result code of a refusal; other errors
mean RESULT_OPERATION_FAILED.
"""

import importlib
import re
import types
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from spinning_top_sim.nodes import entity
from spinning_top_sim.nodes.entity import RefusedError
from spinning_top_sim.nodes.loop import LoopState
from spinning_top_sim.nodes.node import Simulator
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS

# Each service, and the values of SimulatorFeatures that announce it.
FEATURES: Mapping[str, tuple[str, ...]] = {
    'GetSimulatorFeatures': (),
    'GetSimulationState': ('SIMULATION_STATE_GETTING',),
    'SetSimulationState': ('SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE'),
    'StepSimulation': ('STEP_SIMULATION_SINGLE', 'STEP_SIMULATION_MULTIPLE'),
    'ResetSimulation': ('SIMULATION_RESET', 'SIMULATION_RESET_STATE'),
    'GetEntities': (),
    'GetEntitiesStates': ('ENTITY_STATE_GETTING',),
    'GetEntityState': ('ENTITY_STATE_GETTING',),
    'SetEntityState': ('ENTITY_STATE_SETTING',),
    'GetEntityInfo': ('ENTITY_INFO_GETTING',),
}


def service_name(type_name: str) -> str:
    """Return the name of a service from its type: get_entities for GetEntities."""
    return re.sub(r'(?<!^)(?=[A-Z])', '_', type_name).lower()


def offer(node: Simulator) -> None:
    """Create the services that are installed, in the node's namespace."""
    messages, services = (importlib.import_module(f'simulation_interfaces.{kind}')
                          for kind in ('msg', 'srv'))
    handlers = SimulationHandlers(node, messages)
    for name in FEATURES:
        if hasattr(services, name):
            node.create_service(getattr(services, name), service_name(name),
                                partial(handlers.serve, name))


class SimulationHandlers:
    """The handlers of one node; `messages`: the module simulation_interfaces.msg."""

    def __init__(self, node: Simulator, messages: types.ModuleType) -> None:
        self._node, self._loop, self._simulation = node, node.loop, node.simulation
        self._messages = messages
        self._results, self._states = messages.Result, messages.SimulationState
        self._name = node.get_name()            # of the entity
        self._pause_at_start = -1               # `loop.interruptions` when PAUSED was set at t = 0
        self._quits = False

    def serve(self, name: str, request: object, response: object) -> object:
        """Handle a request for the service of this type; return the response."""
        result: Any = getattr(response, 'result', None)
        act = getattr(self, f'_{service_name(name)}')
        error, text = self._node.outcome(lambda: act(request, response))
        if result is not None:
            result.result = self._results.RESULT_OK if error is None else getattr(
                error, 'code', self._results.RESULT_OPERATION_FAILED)
            # A request in YAML can hold text that UTF-8 cannot; sending it would raise an error.
            result.error_message = text.encode(errors='backslashreplace').decode()
        return response

    def _get_simulator_features(self, _: Any, response: Any) -> None:
        known = self._messages.SimulatorFeatures
        response.features.features = sorted({
            getattr(known, name) for row in FEATURES.values() for name in row
            if hasattr(known, name)})

    def _state(self) -> int:
        """Return the constant of SimulationState."""
        loop, states = self._loop, self._states
        if self._quits or loop.state is LoopState.ENDED:
            return states.STATE_QUITTING
        if loop.state is LoopState.WAITING:
            return states.STATE_STOPPED
        if loop.state is LoopState.RUNNING:
            return states.STATE_PLAYING
        # A failed motion is PAUSED, too.
        is_at_start = (loop.state is LoopState.PAUSED and self._simulation.now_ns < 0
                       and loop.interruptions != self._pause_at_start)
        return states.STATE_STOPPED if is_at_start else states.STATE_PAUSED

    def _get_simulation_state(self, _: Any, response: Any) -> str:
        response.state.state = self._state()
        return self._loop.failure or ''

    def _set_simulation_state(self, request: Any, response: Any) -> None:
        states, target = self._states, request.state.state
        changes: dict[int, tuple[str, Callable[[], None]]] = {
            states.STATE_STOPPED: ('STOPPED', partial(self._node.start_again, paused=True)),
            states.STATE_PLAYING: ('PLAYING', self._play),
            states.STATE_PAUSED: ('PAUSED', self._pause),
            states.STATE_QUITTING: ('QUITTING', self._quit)}
        if target not in changes:
            raise RefusedError(response.INCORRECT_TRANSITION, f'state = {target}: must be ' + (
                ', '.join(f'{number} ({name})' for number, (name, _) in changes.items())))
        name, change = changes[target]
        present = self._state()
        if target == present:
            raise RefusedError(response.ALREADY_IN_TARGET_STATE,
                               f'the simulation is {name} already')
        if present == states.STATE_QUITTING:
            raise RefusedError(response.INCORRECT_TRANSITION, 'the simulator is quitting')
        try:
            change()
        except (ValueError, RuntimeError) as error:
            raise RefusedError(response.STATE_TRANSITION_ERROR, error) from error

    def _play(self) -> None:
        self._node.check_started()
        self._loop.resume()

    def _pause(self) -> None:
        self._node.check_started()
        if self._state() == self._states.STATE_STOPPED:
            self._pause_at_start = self._loop.interruptions
        else:
            self._loop.pause()

    def _quit(self) -> None:
        self._loop.pause()
        self._quits = True
        self._node.finish()

    def _step_simulation(self, request: Any, _: Any) -> None:
        loop, steps = self._loop, request.steps
        if steps < 1:
            raise ValueError(f'steps = {steps}: must be >= 1')
        self._node.check_started()
        if self._state() != self._states.STATE_PAUSED:
            raise RuntimeError('the simulation is not paused: SetSimulationState must set '
                               'STATE_PAUSED first')
        length_ns = steps * round(self._node.values['step.dt'] * NANOSECONDS)
        target_ns = loop.now_ns + length_ns
        loop.step(length_ns)
        if loop.now_ns < target_ns:
            raise RuntimeError(f'{loop.time_text}: `duration` ends before the steps do')

    def _check_runs(self) -> None:
        """Raise RefusedError before the motion begins, and when the process ends."""
        quits = self._state() == self._states.STATE_QUITTING
        error, reason = self._node.outcome(self._node.check_started)
        if quits or error:
            raise RefusedError(self._results.RESULT_INCORRECT_STATE,
                               reason or 'the simulator is quitting')

    def _reset_simulation(self, request: Any, _: Any) -> None:
        time_and_state = request.SCOPE_TIME | request.SCOPE_STATE
        self._check_runs()
        if request.scope in (request.SCOPE_DEFAULT, request.SCOPE_ALL, time_and_state):
            self._node.start_again()
        elif request.scope == request.SCOPE_STATE:
            values = self._node.start_values
            self._set_state(lambda _: parameters.start_state(values))
        else:
            raise RefusedError(
                self._results.RESULT_FEATURE_UNSUPPORTED,
                f'scope = {request.scope}: must be {request.SCOPE_DEFAULT} or '
                f'{request.SCOPE_ALL} (all), {request.SCOPE_STATE} (state) or {time_and_state} '
                '(time and state): time goes back with the state only, and nothing is spawned')

    def _set_state(self, change: Callable[[States], State]) -> None:
        self._loop.set_state(change)
        self._node.show_spin()

    def _check_entity(self, name: str) -> None:
        if name != self._name:
            raise RefusedError(self._results.RESULT_NOT_FOUND,
                               f'entity = {name!r}: there is {self._name!r} only')

    def _fill_state(self, message: Any) -> None:
        simulation = self._simulation
        entity.fill_state(message, simulation.state(),
                          simulation.epoch_ns + self._loop.now_ns,
                          self._node.values['world_frame'])

    def _get_entities(self, request: Any, response: Any) -> None:
        filters = request.filters
        if (filters.filter or filters.categories or filters.tags.tags
                or filters.bounds.type != filters.bounds.TYPE_EMPTY):
            raise RefusedError(self._results.RESULT_FEATURE_UNSUPPORTED,
                               'filters must be empty: there is one entity')
        response.entities = [self._name]

    def _get_entities_states(self, request: Any, response: Any) -> None:
        self._get_entities(request, response)
        response.states = [self._messages.EntityState()]
        self._fill_state(response.states[0])

    def _get_entity_state(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        self._fill_state(response.state)

    def _set_entity_state(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        self._check_runs()
        frame = self._node.values['world_frame']
        self._set_state(lambda now: entity.requested_state(request, response, frame, now))

    def _get_entity_info(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        response.info.category.category = self._messages.EntityCategory.CATEGORY_ROBOT
        top = self._simulation.trajectory.top
        response.info.description = (
            f'heavy symmetric top on a pivot: mass {top.mass:g} kg, centre of mass '
            f'{top.com_distance:g} m from the pivot, moments of inertia {top.lambda1:g} and '
            f'{top.lambda3:g} kg m^2')
        response.info.tags = list(entity.TAGS)
