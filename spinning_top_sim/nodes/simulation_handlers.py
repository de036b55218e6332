# SPDX-License-Identifier: Apache-2.0
"""
Offers simulation_interfaces, the standard of ROS 2 for simulators; the top is its one entity.

The handler of GetEntities is `get_entities`.  A handler takes a request, fills the response, and
may return a text for `error_message`.  RefusedError has the result code of a refusal.
"""

import importlib
import re
import types
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from std_msgs.msg import Header

from spinning_top_sim.nodes.loop import LoopState
from spinning_top_sim.nodes.node import Simulator
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams import parameters

Message = Any           # message packages have no types
Columns = NDArray[np.float64]
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
ON_A_MOTION = ('StepSimulation', 'ResetSimulation', 'SetEntityState')     # they need one
# Tolerances for the rounding of a client: of the pivot's place [m] and velocity [m/s], and of a
# quaternion's length.
NEAR, LENGTH_ERROR = 1e-6, 1e-3


class RefusedError(RuntimeError):
    """A request is refused with a result code."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


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
        self._messages, self._results = messages, messages.Result
        self._unsupported = partial(RefusedError, messages.Result.RESULT_FEATURE_UNSUPPORTED)
        self._name = node.get_name()            # of the entity

    def serve(self, name: str, request: Message, response: Message) -> Message:
        """Handle a request for the service of this type; return the response."""
        def handle() -> Any:
            if name in ON_A_MOTION and self._loop.state in (LoopState.WAITING, LoopState.ENDED):
                raise RefusedError(self._results.RESULT_INCORRECT_STATE, self._loop.state.value)
            if getattr(request, 'entity', self._name) != self._name:
                raise RefusedError(self._results.RESULT_NOT_FOUND,
                                   f'entity = {request.entity!r}: must be {self._name!r}')
            return getattr(self, f'_{service_name(name)}')(request, response)

        error, text = self._node.outcome(handle)
        if hasattr(response, 'result'):
            failed = getattr(response, 'STATE_TRANSITION_ERROR',
                             self._results.RESULT_OPERATION_FAILED)
            response.result.result = self._results.RESULT_OK if error is None else getattr(
                error, 'code', failed)
            response.result.error_message = text
        return response

    def _get_simulator_features(self, _: Message, response: Message) -> None:
        known = self._messages.SimulatorFeatures
        response.features.features = sorted({
            getattr(known, name) for row in FEATURES.values() for name in row
            if hasattr(known, name)})

    @property
    def _state(self) -> str:
        """The state as SimulationState names it."""
        state = self._loop.state
        if state in (LoopState.RUNNING, LoopState.ENDED):
            return 'PLAYING' if state is LoopState.RUNNING else 'QUITTING'
        # A motion that has failed is PAUSED, too.
        return 'STOPPED' if self._simulation.sent_ns < 0 and not self._loop.failure else 'PAUSED'

    def _get_simulation_state(self, _: Message, response: Message) -> str:
        response.state.state = getattr(response.state, f'STATE_{self._state}')
        return self._loop.failure or ''

    def _set_simulation_state(self, request: Message, response: Message) -> None:
        changes: Mapping[str, Callable[[], None]] = {
            'STOPPED': partial(self._node.start_again, paused=True), 'PLAYING': self._node.resume,
            'PAUSED': self._pause, 'QUITTING': self._loop.end}
        numbers = {getattr(request.state, f'STATE_{name}'): name for name in changes}
        wanted, present = numbers.get(request.state.state), self._state
        if wanted == present:
            raise RefusedError(response.ALREADY_IN_TARGET_STATE, f'it is {present} already')
        if wanted is None or present == 'QUITTING':
            raise RefusedError(response.INCORRECT_TRANSITION, (
                f'state = {request.state.state} from {present}: must be one of {numbers}, and '
                'not after QUITTING'))
        changes[wanted]()

    def _pause(self) -> None:
        self._loop.refuse_in(LoopState.WAITING)
        self._loop.pause()
        self._loop.step(0)          # the sample of t = 0 tells PAUSED from STOPPED

    def _step_simulation(self, request: Message, _: Message) -> None:
        loop, length_ns = self._loop, request.steps * self._node.step_ns
        if request.steps < 1:
            raise ValueError(f'steps = {request.steps}: must be >= 1')
        if self._state != 'PAUSED':
            raise RuntimeError(f'the simulation is {self._state}: must be PAUSED')
        end_ns = self._simulation.now_ns + length_ns
        loop.step(length_ns)
        if self._simulation.now_ns < end_ns:
            raise RuntimeError(f'{loop.time_text}: `duration` ends before the steps do')

    def _reset_simulation(self, request: Message, _: Message) -> None:
        values, time_and_state = self._node.values_next, request.SCOPE_TIME | request.SCOPE_STATE
        if request.scope in (request.SCOPE_DEFAULT, request.SCOPE_ALL, time_and_state):
            self._node.start_again()
        elif request.scope == request.SCOPE_STATE:
            self._set_state(lambda _: parameters.start_state(values))
        else:
            raise self._unsupported(
                f'scope = {request.scope}: must be {request.SCOPE_DEFAULT}, {request.SCOPE_ALL} '
                f'or {time_and_state} (time and state), or {request.SCOPE_STATE} (state)')

    def _set_state(self, change: Callable[[States], State]) -> None:
        self._loop.change('state', lambda: asdict(change(self._simulation.state())))
        self._node.show_spin()

    def _get_entities(self, request: Message, response: Message) -> None:
        filters = request.filters
        if (filters.filter or filters.categories or filters.tags.tags
                or filters.bounds.type != filters.bounds.TYPE_EMPTY):
            raise self._unsupported('filters must be empty: there is one entity')
        response.entities = [self._name]

    def _get_entities_states(self, request: Message, response: Message) -> None:
        self._get_entities(request, response)
        response.states = [self._messages.EntityState()]
        self._fill(response.states[0])

    def _get_entity_state(self, _: Message, response: Message) -> None:
        self._fill(response.state)

    def _get_entity_info(self, _: Message, response: Message) -> None:
        response.info.category.category = self._messages.EntityCategory.CATEGORY_ROBOT
        response.info.description = (
            f'heavy symmetric top on a pivot, in SI units: {self._simulation.trajectory.top}')
        response.info.tags = ['spinning_top', 'heavy_symmetric_top', 'imu']

    def _fill(self, message: Message) -> None:
        """Write the present state into an EntityState, in the world frame."""
        simulation, now = self._simulation, self._simulation.state()
        stamp = Time(nanoseconds=simulation.epoch_ns + simulation.now_ns).to_msg()
        message.header = Header(stamp=stamp, frame_id=self._node.values_next['world_frame'])
        rotation, pivot = now.rows_quaternion, now.pivot
        for target, rows in (
                (message.pose.orientation, rotation),
                (message.twist.angular, attitude.rotated(rotation, now.rows_angular_velocity)),
                (message.acceleration.angular,
                 attitude.rotated(rotation, now.rows_angular_acceleration)),
                (message.pose.position, pivot.position), (message.twist.linear, pivot.velocity),
                (message.acceleration.linear, pivot.acceleration)):
            for name, column in zip('xyzw', rows, strict=False):
                setattr(target, name, float(column[0]))

    def _set_entity_state(self, request: Message, response: Message) -> None:
        # Older versions of the message have no flags, and set both.
        if not (getattr(request, 'set_pose', True) or getattr(request, 'set_twist', True)):
            raise ValueError('set_pose and set_twist are false: one of them must be true; the '
                             'acceleration follows from pose and twist')
        frame, given = self._node.values_next['world_frame'], request.state.header.frame_id
        if given not in ('', frame):
            raise self._unsupported(f'header.frame_id = {given!r}: must be {frame!r} or empty')
        self._set_state(partial(self._requested, request, response))

    def _requested(self, request: Message, response: Message, now: States) -> State:
        """Return what a SetEntityState request asks for; the present state holds for the rest."""
        def check_pivot(name: str, given: Message, present: Columns, code: int) -> None:
            if not np.all(np.abs(_numbers(given) - present[:, 0]) <= NEAR):
                raise RefusedError(code, (
                    f'{name} = {_numbers(given).tolist()}: must be that of the pivot, '
                    f'{present[:, 0].tolist()} (within {NEAR:g})'))

        wanted, turned = request.state, now.rows_quaternion
        rotation = np.concatenate(turned)
        rates = np.concatenate(attitude.rotated(turned, now.rows_angular_velocity))
        if getattr(request, 'set_pose', True):
            rotation = _numbers(wanted.pose.orientation)
            if not abs(float(np.linalg.norm(rotation)) - 1.0) <= LENGTH_ERROR:
                raise RefusedError(response.INVALID_POSE, (
                    f'pose.orientation = {rotation.tolist()}: must have the length 1 '
                    f'(within {LENGTH_ERROR:g})'))
            check_pivot('pose.position [m]', wanted.pose.position, now.pivot.position,
                        response.INVALID_POSE)
        if getattr(request, 'set_twist', True):
            rates = _numbers(wanted.twist.angular)
            if not np.all(np.isfinite(rates)):
                raise ValueError(f'twist.angular = {rates.tolist()} rad/s: must be finite')
            check_pivot('twist.linear [m/s]', wanted.twist.linear, now.pivot.velocity,
                        self._results.RESULT_OPERATION_FAILED)
        return state_of(now.top, rotation, rates)


def _numbers(message: Message) -> Columns:
    return np.array([getattr(message, name) for name in 'xyzw' if hasattr(message, name)], float)
