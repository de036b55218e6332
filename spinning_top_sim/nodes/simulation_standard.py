# SPDX-License-Identifier: Apache-2.0
"""What a node offers of simulation_interfaces, and what the handlers need of the node."""

import re
from collections.abc import Mapping
from typing import Any, Protocol

# Services, and the values of SimulatorFeatures that say that they are there.
FEATURES: Mapping[str, tuple[str, ...]] = {
    'GetSimulatorFeatures': (),
    'GetSimulationState': ('SIMULATION_STATE_GETTING',),
    'SetSimulationState': ('SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE'),
    'StepSimulation': ('STEP_SIMULATION_SINGLE', 'STEP_SIMULATION_MULTIPLE'),
    'SimulateSteps': ('STEP_SIMULATION_ACTION',),
    'ResetSimulation': ('SIMULATION_RESET', 'SIMULATION_RESET_STATE'),
    'GetEntities': ('ENTITY_TAGS', 'ENTITY_CATEGORIES', 'ENTITY_BOUNDS_BOX'),
    'GetEntitiesStates': ('ENTITY_STATE_GETTING',),
    'GetEntityState': ('ENTITY_STATE_GETTING',),
    'SetEntityState': ('ENTITY_STATE_SETTING',),
    'GetEntityInfo': ('ENTITY_INFO_GETTING',),
    'GetEntityBounds': ('ENTITY_BOUNDS',),
    'GetAvailableWorlds': ('AVAILABLE_WORLDS',),
    'LoadWorld': ('WORLD_LOADING', 'WORLD_RESOURCE_STRING'),
    'GetCurrentWorld': ('WORLD_INFO_GETTING',),
}
ACTION = 'SimulateSteps'
SERVICES = tuple(name for name in FEATURES if name != ACTION)


def service_name(type_name: str) -> str:
    """Return the name of a service by that of its type: get_entities for GetEntities."""
    return re.sub(r'(?<!^)(?=[A-Z])', '_', type_name).lower()


class RefusedError(Exception):
    """A request is refused with a result code."""

    def __init__(self, code: int, reason: object) -> None:
        super().__init__(str(reason))
        self.code = code


class Node(Protocol):
    """What the handlers ask of the node."""

    @property
    def values(self) -> Mapping[str, Any]:
        """The parameters, with the spin as last commanded."""

    @property
    def start_values(self) -> dict[str, Any]:
        """The parameters that a reset starts with."""

    def check_started(self) -> None:
        """Raise RuntimeError before the motion begins."""

    def start_again(self, values: Mapping[str, Any] | None = None,
                    paused: bool | None = None) -> None:
        """Reset, as `TickLoop.reset`; with other parameters if these are given."""

    def show_spin(self) -> None:
        """Let the parameters spin.l3 and spin.lz show the present ones."""

    def fail(self, error: Exception) -> None:
        """Stop the motion after an unexpected error."""

    def finish(self) -> None:
        """End the process soon."""

    def can_send(self) -> bool:
        """Return False when a signal has ended the context: then nothing can be sent any more."""
