# SPDX-License-Identifier: Apache-2.0
"""
What the services and the action of simulation_interfaces do; no executor and no DDS.

The handler of GetEntities is `_get_entities`: it takes a request and fills its response, or raises
RefusedError with a code, or ValueError or RuntimeError, which mean RESULT_OPERATION_FAILED.
"""

import types
from collections.abc import Callable, Coroutine, Generator
from typing import Any

from spinning_top_sim.nodes import entity, worlds
from spinning_top_sim.nodes.pacing import FairLock
from spinning_top_sim.nodes.simulation_standard import (
    FEATURES,
    Node,
    RefusedError,
    service_name,
)
from spinning_top_sim.nodes.tick_loop import LoopState, TickLoop
from spinning_top_sim.nodes.worlds import World
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.simulation import Simulation


class SimulationHandlers:
    """
    The handlers of one simulation.

    messages, actions : the modules simulation_interfaces.msg and .action
    name, frame : of the entity, and of the world
    """

    def __init__(self, node: Node, loop: TickLoop, simulation: Simulation, lock: FairLock,
                 messages: types.ModuleType, actions: types.ModuleType, name: str,
                 frame: str) -> None:
        self._node, self._loop, self._simulation, self._lock = node, loop, simulation, lock
        self._messages, self._actions = messages, actions
        self._name, self._frame = name, frame
        self._results, self._states = messages.Result, messages.SimulationState
        self._category = messages.EntityCategory.CATEGORY_ROBOT
        self._world: World | None = None        # the one loaded last
        self._pause_at_start = -1               # `interruptions` when one was asked for at t = 0
        self._quits = self._steps = False

    def serve(self, name: str, request: object, response: object) -> object:
        """Fill a response, its result too; unexpected errors stop the motion."""
        result: Any = getattr(response, 'result', None)
        act = getattr(self, f'_{service_name(name)}')
        code, text = self._outcome(lambda: act(request, response))
        if result is not None:
            # YAML can name what UTF-8 cannot: such a response would end the executor.
            result.result = code
            result.error_message = text.encode(errors='backslashreplace').decode()
        return response

    def _outcome(self, act: Callable[[], str | None]) -> tuple[int, str]:
        """Return the code of what `act` does, and what is to say about it."""
        try:
            return self._results.RESULT_OK, act() or ''
        except RefusedError as error:
            return error.code, str(error)
        except entity.UnsupportedError as error:
            return self._results.RESULT_FEATURE_UNSUPPORTED, str(error)
        except (ValueError, RuntimeError, OSError) as error:
            return self._results.RESULT_OPERATION_FAILED, str(error)
        except Exception as error:
            self._node.fail(error)
            return self._results.RESULT_OPERATION_FAILED, f'{type(error).__name__}: {error}'

    def _get_simulator_features(self, _: Any, response: Any) -> None:
        names = dict.fromkeys(name for row in FEATURES.values() for name in row)
        known = self._messages.SimulatorFeatures
        response.features.features = sorted(
            getattr(known, name) for name in names if hasattr(known, name))
        response.features.custom_info = (
            'spinning_top_sim, docs/simulation_interfaces.md; a step is the parameter step.dt')

    # The state of the simulation.

    def _state(self) -> int:
        """Return the constant of SimulationState; the caller has the lock."""
        loop, states = self._loop, self._states
        if self._quits or loop.state is LoopState.ENDED:
            return states.STATE_QUITTING
        if loop.state is LoopState.WAITING:
            return states.STATE_STOPPED
        if loop.state is LoopState.RUNNING:
            return states.STATE_PLAYING
        # A motion that has failed is paused, too.
        is_at_start = (loop.state is LoopState.PAUSED and self._simulation.now_ns < 0
                       and loop.interruptions != self._pause_at_start)
        return states.STATE_STOPPED if is_at_start else states.STATE_PAUSED

    def _get_simulation_state(self, _: Any, response: Any) -> str:
        with self._lock:
            response.state.state = self._state()
            return self._loop.failure or ''

    def _set_simulation_state(self, request: Any, response: Any) -> None:
        states, loop, target = self._states, self._loop, request.state.state
        allowed = {states.STATE_STOPPED: 'STOPPED', states.STATE_PLAYING: 'PLAYING',
                   states.STATE_PAUSED: 'PAUSED', states.STATE_QUITTING: 'QUITTING'}
        if target not in allowed:
            raise RefusedError(response.INCORRECT_TRANSITION, f'state = {target}: must be ' + (
                ', '.join(f'{number} ({name})' for number, name in allowed.items())))
        with self._lock:
            present, failure = self._state(), loop.failure
        if target == present and not (failure and target == states.STATE_PAUSED
                                      and not loop.paused):
            raise RefusedError(response.ALREADY_IN_TARGET_STATE,
                               f'the simulation is {allowed[present]} already')
        if present == states.STATE_QUITTING:
            raise RefusedError(response.INCORRECT_TRANSITION, 'the simulator is quitting')
        if target == states.STATE_QUITTING:
            with self._lock:
                loop.pause()
                self._quits = True
            self._node.finish()
            return
        try:
            self._node.check_started()
            if target == states.STATE_STOPPED:
                self._node.start_again(paused=True)
                return
            with self._lock:
                if failure and target == states.STATE_PLAYING:
                    raise RuntimeError(f'the motion stands still: {failure}; STATE_STOPPED '
                                       'resets it')
                if target == states.STATE_PLAYING:
                    loop.resume()
                elif present == states.STATE_STOPPED:
                    self._pause_at_start = loop.interruptions
                else:
                    loop.pause()
                if loop.failure and not failure:
                    raise RuntimeError(loop.failure)
        except (ValueError, RuntimeError) as error:
            raise RefusedError(response.STATE_TRANSITION_ERROR, error) from error

    # Steps and resets.

    def _step_simulation(self, request: Any, _: Any) -> None:
        self._check_steps(request.steps)
        if self._steps:
            raise RuntimeError('SimulateSteps is stepping: wait for its end, or cancel it')
        self._step(request.steps)

    def _check_steps(self, steps: int) -> None:
        if steps < 1:
            raise ValueError(f'steps = {steps}: must be >= 1')
        self._node.check_started()
        with self._lock:
            if self._state() != self._states.STATE_PAUSED:
                raise RuntimeError('the simulation is not paused: SetSimulationState must set '
                                   'STATE_PAUSED first')

    def _step(self, count: int) -> None:
        loop = self._loop
        # A step is a whole number of nanoseconds: n steps are n times one step.
        step_ns = round(self._node.values['step.dt'] * NANOSECONDS)
        with self._lock:
            target_ns = loop.now_ns + count * step_ns
            loop.step_by(count * step_ns)
            if loop.now_ns < target_ns:
                raise RuntimeError(f'{loop.time_text}: `duration` ends before the steps do')

    def _check_runs(self) -> None:
        """Raise RefusedError before the motion begins, and when the process ends."""
        with self._lock:
            quits = self._state() == self._states.STATE_QUITTING
        try:
            self._node.check_started()
            if quits:
                raise RuntimeError('the simulator is quitting')
        except RuntimeError as error:
            raise RefusedError(self._results.RESULT_INCORRECT_STATE, error) from error

    @property
    def steps_action(self) -> Callable[[object], Coroutine[None, None, object]]:
        """The coroutine function of SimulateSteps, for an action server."""
        return self._simulate_steps

    async def _simulate_steps(self, goal: Any) -> Any:
        try:
            return await self._step_one_by_one(goal)
        except Exception:
            if self._node.can_send():
                raise
        # A signal has ended the context.  To tell the goal so would crash the executor, which is
        # about to end and does not come back here.
        while True:
            await _turn()

    def _check_context(self) -> None:
        if not self._node.can_send():
            raise RuntimeError('the context has ended')

    async def _step_one_by_one(self, goal: Any) -> Any:
        """Step up to the goal; between two steps the executor has its turn."""
        action = self._actions.SimulateSteps
        steps, done = goal.request.steps, 0
        result, feedback = action.Result(), action.Feedback()
        mine = False

        def begin() -> None:
            nonlocal mine
            self._check_steps(steps)
            if self._steps:
                raise RuntimeError('another SimulateSteps is stepping')
            self._steps = mine = True

        code, text = self._outcome(begin)
        interruptions = self._loop.interruptions

        def step() -> None:
            loop = self._loop
            if self._quits or loop.interruptions != interruptions:
                why = ('`duration` ends before the steps do' if loop.state is LoopState.ENDED else
                       loop.failure or 'the simulation was reset, or its state set')
                raise RuntimeError(f'interrupted after {done} of {steps} steps: {why}')
            self._step(1)

        try:
            while code == self._results.RESULT_OK and done < steps:
                self._check_context()
                if goal.is_cancel_requested:
                    goal.canceled()
                    result.result.result = self._results.RESULT_OPERATION_FAILED
                    result.result.error_message = f'canceled after {done} of {steps} steps'
                    return result
                code, text = self._outcome(step)
                if code == self._results.RESULT_OK:
                    done += 1
                    feedback.completed_steps, feedback.remaining_steps = done, steps - done
                    goal.publish_feedback(feedback)
                await _turn()
        finally:
            if mine:
                self._steps = False
        self._check_context()
        result.result.result, result.result.error_message = code, text
        if code == self._results.RESULT_OK:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _reset_simulation(self, request: Any, _: Any) -> None:
        time_and_state = request.SCOPE_TIME | request.SCOPE_STATE
        self._check_runs()
        if request.scope in (request.SCOPE_DEFAULT, request.SCOPE_ALL, time_and_state):
            self._node.start_again()
        elif request.scope == request.SCOPE_STATE:
            values = self._node.start_values
            with self._lock:
                self._loop.set_state(lambda _: parameters.start_state(values))
            self._node.show_spin()
        else:
            raise RefusedError(
                self._results.RESULT_FEATURE_UNSUPPORTED,
                f'scope = {request.scope}: must be {request.SCOPE_DEFAULT} or '
                f'{request.SCOPE_ALL} (all), {request.SCOPE_STATE} (state) or {time_and_state} '
                '(time and state): time goes back with the state only, and nothing is spawned')

    # The entity.

    def _check_entity(self, name: str) -> None:
        if name != self._name:
            raise RefusedError(self._results.RESULT_NOT_FOUND,
                               f'entity = {name!r}: there is {self._name!r} only')

    def _chosen(self, filters: Any) -> list[str]:
        """Return the entities that filters choose; the caller has the lock."""
        chosen = entity.is_chosen(filters, self._name, self._category, self._simulation.top,
                                  self._simulation.state)
        return [self._name] if chosen else []

    def _fill_state(self, message: Any) -> None:
        """Put the present state into an EntityState; the caller has the lock."""
        simulation = self._simulation
        entity.fill_state(message, simulation.state(), simulation.epoch_ns + self._loop.now_ns,
                          self._frame)

    def _get_entities(self, request: Any, response: Any) -> None:
        with self._lock:
            response.entities = self._chosen(request.filters)

    def _get_entities_states(self, request: Any, response: Any) -> None:
        with self._lock:
            chosen = self._chosen(request.filters)
            states = [self._messages.EntityState() for _ in chosen]
            for message in states:
                self._fill_state(message)
        response.entities, response.states = chosen, states

    def _get_entity_state(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        with self._lock:
            self._fill_state(response.state)

    def _set_entity_state(self, request: Any, response: Any) -> str:
        self._check_entity(request.entity)
        self._check_runs()
        try:
            change = entity.changed_state(request, self._simulation.top, self._frame)
        except entity.PoseError as error:
            raise RefusedError(response.INVALID_POSE, error) from error
        with self._lock:
            self._loop.set_state(change)
        self._node.show_spin()
        return ('the acceleration follows from pose and twist: that of the request is not used'
                if getattr(request, 'set_acceleration', False) else '')

    def _get_entity_info(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        response.info.category.category = self._category
        response.info.description = entity.describe(self._simulation.top)
        response.info.tags = list(entity.TAGS)

    def _get_entity_bounds(self, request: Any, response: Any) -> None:
        self._check_entity(request.entity)
        entity.fill_bounds(response.bounds, self._simulation.top)

    # Worlds.

    def _fill_world(self, message: Any, world: World) -> None:
        resource = _resource_of(message)
        message.name, message.description = world.name, world.description
        resource.uri, resource.resource_string = world.uri, '' if world.uri else world.text

    def _get_available_worlds(self, request: Any, response: Any) -> str:
        if request.filter.tags:
            raise RefusedError(self._results.RESULT_FEATURE_UNSUPPORTED,
                               f'filter.tags = {list(request.filter.tags)}: must be empty, as '
                               'worlds have no tags')
        found: dict[str, World] = {}
        errors: list[str] = []
        scenes = worlds.scene_files()
        for source in (*map(str, scenes.values()), *request.additional_sources):
            try:
                found |= {world.uri: world for world in worlds.worlds_in(source)}
            except (OSError, ValueError) as error:
                errors.append(f'{source}: {error}')
                is_default = source not in request.additional_sources
                if not request.continue_on_error:
                    raise RefusedError(
                        response.DEFAULT_SOURCES_FAILED if is_default
                        else self._results.RESULT_OPERATION_FAILED, errors[0]) from error
        if not (scenes or request.continue_on_error):
            raise RefusedError(response.DEFAULT_SOURCES_FAILED, 'no scene is installed')
        if not found:
            raise RuntimeError('; '.join(errors) or 'there is no world')
        response.worlds = [self._messages.WorldResource() for _ in found]
        for message, world in zip(response.worlds, found.values(), strict=True):
            self._fill_world(message, world)
        return '; '.join(errors)

    def _load_world(self, request: Any, response: Any) -> str:
        resource = _resource_of(request)
        if not (resource.uri or resource.resource_string):
            raise RefusedError(response.NO_RESOURCE, 'uri and resource_string are empty: one of '
                               'them must be a world')
        try:
            world = (World.read(resource.uri) if resource.uri
                     else World.parse(resource.resource_string))
            values = world.values(self._node.values)
        except FileNotFoundError as error:
            raise RefusedError(self._results.RESULT_NOT_FOUND, error) from error
        except worlds.FormatError as error:
            raise RefusedError(response.UNSUPPORTED_FORMAT, error) from error
        except ValueError as error:
            raise RefusedError(response.RESOURCE_PARSE_ERROR, error) from error
        ignored = (f'not used, as no parameters that a running node can change: '
                   f'{", ".join(world.ignored)}' if world.ignored else '')
        if ignored and request.fail_on_unsupported_element:
            raise RefusedError(response.UNSUPPORTED_ELEMENTS, ignored)
        self._check_runs()
        self._node.start_again(values, paused=True)
        self._world = world
        self._fill_world(response.world, world)
        return ignored

    def _get_current_world(self, _: Any, response: Any) -> None:
        self._fill_world(response.world,
                         worlds.present_world(self._simulation.values, self._world))


def _resource_of(message: Any) -> Any:
    """Return the Resource of a message; before version 2.1 it has another name."""
    return getattr(message, 'world_resource', None) or message.level_resource


@types.coroutine
def _turn() -> Generator[None, None, None]:
    """Let the executor do what else is to do; it resumes a task that yields nothing."""
    yield
