# SPDX-License-Identifier: Apache-2.0
"""The services of simulation_interfaces that a node offers, and how requests are refused."""

import re
from collections.abc import Mapping

# Each service, and the values of SimulatorFeatures that announce it.
FEATURES: Mapping[str, tuple[str, ...]] = {
    'GetSimulatorFeatures': (),
    'GetSimulationState': ('SIMULATION_STATE_GETTING',),
    'SetSimulationState': ('SIMULATION_STATE_SETTING', 'SIMULATION_STATE_PAUSE'),
    'StepSimulation': ('STEP_SIMULATION_SINGLE', 'STEP_SIMULATION_MULTIPLE'),
    'SimulateSteps': ('STEP_SIMULATION_ACTION',),
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


class RefusedError(RuntimeError):
    """A request is refused with a result code."""

    def __init__(self, code: int, reason: object) -> None:
        super().__init__(str(reason))
        self.code = code
