# SPDX-License-Identifier: Apache-2.0
"""simulation_interfaces of nodes that end, or that have not begun; and where it is offered."""


import pytest

pytest.importorskip('rclpy')

from helpers.own_node import as_a_process
from helpers.standard_node import StandardNode, finished

from spinning_top_sim.nodes import sim_node, simulation_handlers

FAILED, INCORRECT_STATE, STOPPED, QUITTING, TRANSITION_ERROR = 4, 3, 0, 3, 102
ENDS = '`duration` ends before the steps do'


def test_before_the_clock_nothing_can_be_set(tmp_path):
    with StandardNode(tmp_path, use_sim_time=True) as top:
        assert top.state == STOPPED
        for name in ('PLAYING', 'PAUSED'):
            assert top.set_state(name) == TRANSITION_ERROR
        for expected, name, request in (
                (FAILED, 'StepSimulation', {'steps': 1}),
                (INCORRECT_STATE, 'ResetSimulation', {'scope': 0}),
                (INCORRECT_STATE, 'SetEntityState', {'entity': 'spinning_top'})):
            code, text = top.refused(name, **request)
            assert (code, text) == (expected, 'waiting for /clock (use_sim_time is set)')


def test_steps_beyond_the_duration_say_so(tmp_path):
    with StandardNode(tmp_path, duration=0.05) as top:
        goal, coroutine = top.pause().steps(9)
        assert finished(coroutine).result.error_message == (
            f'interrupted after 5 of 9 steps: {ENDS}')
        assert (goal.end, top.state) == ('aborted', QUITTING)
    with StandardNode(tmp_path, duration=0.05) as top:
        assert top.pause().refused('StepSimulation', steps=6) == (
            FAILED, f'at t = 0.050000000 s: {ENDS}')


@pytest.mark.parametrize(('installed', 'wanted'), [(True, True), (False, True), (True, False)])
def test_it_is_offered_where_it_is_installed_and_not_switched_off(
        monkeypatch, installed, wanted):
    offered = []
    monkeypatch.setattr(sim_node, 'find_spec', lambda name: installed or None)
    monkeypatch.setattr(simulation_handlers, 'offer', offered.append)
    argv = ['--ros-args', '-p', f'simulation_interfaces:={str(wanted).lower()}']
    with as_a_process():
        import rclpy
        rclpy.init(args=argv)
        node = sim_node._prepare(argv)()
        assert offered == ([node] if installed and wanted else [])
        node.stop()
        node.destroy_node()
