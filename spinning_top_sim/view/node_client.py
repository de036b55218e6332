# SPDX-License-Identifier: Apache-2.0
"""What the page asks of the sim_node."""

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Twist, Vector3
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.topics import NODE_NAME
from spinning_top_sim.tools.scene_file import read_scene

ANSWER_S = 5.0                  # timeout of a service call


class RequestError(Exception):
    """The sim_node refuses or does not answer; the text is the reason."""


class NodeClient:
    """
    A client of the sim_node in the namespace of a node, for threads that may wait for answers.

    Requests raise RequestError, or return the text to show.

    is_stale : whether the parameters have to be read, as after a reset
    """

    def __init__(self, node: Node) -> None:
        self.name = node.resolve_topic_name(NODE_NAME)
        self.is_stale = True
        self._velocity = node.create_publisher(Twist, f'{NODE_NAME}/cmd_vel', 10)
        self._services = {
            name: node.create_client(kind, f'{NODE_NAME}/{name}') for name, kind in (
                ('get_parameters', GetParameters),
                ('set_parameters_atomically', SetParametersAtomically), ('set_pause', SetBool),
                ('record', SetBool), ('step', Trigger), ('reset', Trigger))}

    @property
    def is_there(self) -> bool:
        """Whether the sim_node can be asked."""
        return self._services['get_parameters'].service_is_ready()

    def values(self) -> dict[str, Any]:
        """Return the parameters, with the present spin."""
        self.is_stale = False
        names = [name for name in parameters.BY_NAME if name not in SPIN]
        try:
            answer = self._ask('get_parameters', GetParameters.Request(names=[*names, *SPIN]))
        except RequestError:
            self.is_stale = True
            raise
        shown = list(map(parameter_value_to_python, answer.values))
        # The present spin is not checked: it need not be possible at the start.
        return {**parameters.checked(dict(zip(names, shown, strict=False))),
                **dict(zip(SPIN, shown[-len(SPIN):], strict=True))}

    def _ask(self, name: str, request: object) -> Any:
        """Return the answer of a service."""
        client = self._services[name]
        if not client.service_is_ready():
            raise RequestError(f'there is no {self.name}')
        answer = client.call(request, ANSWER_S)
        if answer is None:
            raise RequestError(f'{self.name}/{name} has not answered')
        return answer

    def call(self, name: str, *on: bool) -> str:
        """Call a service; return its message."""
        answer = self._ask(name, SetBool.Request(data=on[0]) if on else Trigger.Request())
        if not answer.success:
            raise RequestError(answer.message)
        return f'{name.removeprefix("set_")}: {answer.message}'

    def command(self, l3: float, lz: float) -> str:
        """Set L3 and Lz [kg m^2/s]; return them."""
        self._set(dict(zip(SPIN, (l3, lz), strict=True)))
        return f'spin.l3 = {l3:.4g}, spin.lz = {lz:.4g}'

    def drive(self, x: float, y: float) -> str:
        """Send a velocity of the pivot [m/s]; return it."""
        if not self._velocity.get_subscription_count():
            raise RequestError(f'there is no {self.name}')
        self._velocity.publish(Twist(linear=Vector3(x=x, y=y)))
        return f'pivot: {x:g}, {y:g} m/s'

    def choose(self, scene: str) -> str:
        """Set the top and the start of an installed scene, and reset."""
        values = parameters.checked(read_scene(parameter_files('scene')[scene]))
        values['spin.lz'] = parameters.start_state(values).lz
        try:
            self._set({name: list(value) if isinstance(value, tuple) else value
                       for name, value in values.items()
                       if name.startswith(('top.', 'initial.', 'spin.', 'pivot.'))})
            return f'{scene}, {self.call("reset")}'
        finally:
            self.is_stale = True      # the node may do what it has not answered in time

    def _set(self, values: Mapping[str, object]) -> None:
        result = self._ask('set_parameters_atomically', SetParametersAtomically.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()
                        for name, value in values.items()])).result
        if not result.successful:
            raise RequestError(result.reason)
