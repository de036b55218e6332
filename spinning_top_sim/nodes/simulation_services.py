# SPDX-License-Identifier: Apache-2.0
"""Offers simulation_interfaces, the standard of ROS 2 for simulators, where it is installed."""

import functools
import importlib

import rclpy.node
from rclpy.action import ActionServer, CancelResponse

from spinning_top_sim.nodes import simulation_standard
from spinning_top_sim.nodes.pacing import FairLock
from spinning_top_sim.nodes.simulation_handlers import SimulationHandlers
from spinning_top_sim.nodes.simulation_standard import ACTION, SERVICES, service_name
from spinning_top_sim.nodes.tick_loop import TickLoop
from spinning_top_sim.streams.simulation import Simulation

PACKAGE = 'simulation_interfaces'


def offer(node: rclpy.node.Node, control: simulation_standard.Node, loop: TickLoop,
          simulation: Simulation, lock: FairLock, frame: str) -> ActionServer:
    """
    Create the services, in the namespace of the node, and return the action server.

    Services that the installed version of the package does not have are left out.
    """
    messages, services, actions = (
        importlib.import_module(f'{PACKAGE}.{kind}') for kind in ('msg', 'srv', 'action'))
    handlers = SimulationHandlers(control, loop, simulation, lock, messages, actions,
                                  node.get_name(), frame)
    for name in SERVICES:
        if hasattr(services, name):
            node.create_service(getattr(services, name), service_name(name),
                                functools.partial(handlers.serve, name))
    return ActionServer(node, getattr(actions, ACTION), service_name(ACTION),
                        handlers.steps_action, cancel_callback=lambda _: CancelResponse.ACCEPT)
