# SPDX-License-Identifier: Apache-2.0
"""
The messages of simulation_interfaces 2.1 for machines without that package: stand-ins.

They have its fields and constants, and no others, but no type support: they cannot be sent.
"""

from dataclasses import field, make_dataclass
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import Accel, Pose, Twist
from std_msgs.msg import Header


def message(name, fields=None, **constants):
    """Return a class; fields are by name a type, or a list with the type of the items."""
    return make_dataclass(name, [
        (field_name, object, field(default_factory=list if isinstance(kind, list) else kind))
        for field_name, kind in (fields or {}).items()], namespace=constants, slots=True)


def service(request=None, response=None, *, constants=None, codes=None, result=True):
    answer = {**({'result': Result} if result else {}), **(response or {})}
    return SimpleNamespace(Request=message('Request', request, **(constants or {})),
                           Response=message('Response', answer, **(codes or {})))


def numbered(names, start=0):
    return {name: number for number, name in enumerate(names.split(), start)}


Result = message('Result', {'result': int, 'error_message': str}, **numbered(
    'RESULT_FEATURE_UNSUPPORTED RESULT_OK RESULT_NOT_FOUND RESULT_INCORRECT_STATE '
    'RESULT_OPERATION_FAILED'))
SimulationState = message('SimulationState', {'state': int}, **numbered(
    'STATE_STOPPED STATE_PLAYING STATE_PAUSED STATE_QUITTING STATE_NO_WORLD STATE_LOADING_WORLD'))
SimulatorFeatures = message(
    'SimulatorFeatures', {'features': [int], 'spawn_formats': [str], 'custom_info': str},
    **numbered('ENTITY_STATE_GETTING ENTITY_STATE_SETTING ENTITY_INFO_GETTING', 10),
    **numbered('SIMULATION_RESET SIMULATION_RESET_TIME SIMULATION_RESET_STATE '
               'SIMULATION_RESET_SPAWNED SIMULATION_STATE_GETTING SIMULATION_STATE_SETTING '
               'SIMULATION_STATE_PAUSE', 20),
    **numbered('STEP_SIMULATION_SINGLE STEP_SIMULATION_MULTIPLE STEP_SIMULATION_ACTION', 31))
EntityCategory = message('EntityCategory', {'category': int}, CATEGORY_DYNAMIC_OBJECT=4,
                         CATEGORY_STATIC_OBJECT=5,
                         **numbered('CATEGORY_OBJECT CATEGORY_ROBOT CATEGORY_HUMAN'))
Bounds = message('Bounds', {'type': int}, TYPE_EMPTY=0)
TagsFilter = message('TagsFilter', {'tags': [str], 'filter_mode': int}, **numbered(
    'FILTER_MODE_ANY FILTER_MODE_ALL'))
EntityFilters = message('EntityFilters', {
    'filter': str, 'categories': [EntityCategory], 'tags': TagsFilter, 'bounds': Bounds})
EntityInfo = message('EntityInfo', {'category': EntityCategory, 'description': str, 'tags': [str]})
EntityState = message('EntityState', {
    'header': Header, 'pose': Pose, 'twist': Twist, 'acceleration': Accel})

MESSAGES = (Result, SimulationState, SimulatorFeatures, EntityCategory, Bounds, TagsFilter,
            EntityFilters, EntityInfo, EntityState)
FILTERED, NAMED = {'filters': EntityFilters}, {'entity': str}
SERVICES = {
    'GetSimulatorFeatures': service(response={'features': SimulatorFeatures}, result=False),
    'GetSimulationState': service(response={'state': SimulationState}),
    'SetSimulationState': service({'state': SimulationState}, codes=numbered(
        'ALREADY_IN_TARGET_STATE STATE_TRANSITION_ERROR INCORRECT_TRANSITION', 101)),
    'StepSimulation': service({'steps': int}),
    'ResetSimulation': service({'scope': int}, constants={
        'SCOPE_DEFAULT': 0, 'SCOPE_TIME': 1, 'SCOPE_STATE': 2, 'SCOPE_SPAWNED': 4,
        'SCOPE_ALL': 255}),
    'GetEntities': service(FILTERED, {'entities': [str]}),
    'GetEntitiesStates': service(FILTERED, {'entities': [str], 'states': [EntityState]}),
    'GetEntityState': service(NAMED, {'state': EntityState}),
    'SetEntityState': service({**NAMED, 'state': EntityState, 'set_pose': bool, 'set_twist': bool,
                               'set_acceleration': bool}, codes={'INVALID_POSE': 101}),
    'GetEntityInfo': service(NAMED, {'info': EntityInfo}),
}


def modules():
    """Return simulation_interfaces.msg and .srv."""
    found = [ModuleType(f'simulation_interfaces.{kind}') for kind in ('msg', 'srv')]
    for module, content in zip(found, (
            {one.__name__: one for one in MESSAGES}, SERVICES), strict=True):
        vars(module).update(content)
    return found
