# SPDX-License-Identifier: Apache-2.0
"""Extreme parameters and commands: a node lives on, or refuses them in one clear line."""

import time
from types import SimpleNamespace

import pytest
from helpers.extremes import actions, commands, parameter_sets

from spinning_top_sim.nodes.tick_loop import TickLoop
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.pipeline import Simulation

TICK_NS = 5_000_000
REFUSED = ValueError, IntegrationError


class Run:
    """A loop on a clock of its own, which records what is enabled and goes on as the node does."""

    def __init__(self, values):
        self.values, self.now_ns, self.sent = values, 77, 0
        self.simulation = Simulation(values)
        recording = SimpleNamespace(
            has_room=lambda: True, wait_for_room=lambda: None, write_command=lambda *_: None,
            write_event=lambda event, *_, **details: journal.event(event, 0, 0, **details))
        self.loop = TickLoop(
            self.simulation, values, recording, update_subscribers=lambda: None,
            tell=lambda *_: None, source=lambda: self.now_ns,
            steady=lambda: self.now_ns + time.monotonic_ns())
        self.simulation.log_to(self.count, [
            stream for stream in self.simulation.streams
            if journal.is_enabled(stream.parameter, values)])
        self.loop.start()

    def count(self, *_):
        self.sent += 1

    def try_(self, act, *arguments):
        """Do something; what is refused changes nothing, and any other error stops the motion."""
        try:
            act(*arguments)
        except REFUSED as error:
            assert str(error).strip()
        except Exception as error:
            self.loop.fail(str(error))

    def tick(self):
        self.now_ns += TICK_NS
        if self.loop.tick():
            self.loop.idle()

    def ticks(self, count=8):
        for _ in range(count):
            self.try_(self.tick)


def run_of(values):
    """Return a run, or None where one is refused."""
    try:
        return Run(parameters.checked(values))
    except (*REFUSED, ArithmeticError) as error:
        assert str(error).strip() and '\n' not in str(error)
        return None


@pytest.mark.parametrize('first', range(0, 30, 10))
def test_whatever_is_set_and_commanded_a_reset_to_the_default_revives(first):
    for seed in range(first, first + 10):
        given = {name: value for name, value in parameter_sets(seed).items()
                 if name not in ('duration', 'start_paused')}
        run = run_of(given) or run_of({})
        run.ticks()
        for data in commands(seed):
            if len(data) == 2:
                run.try_(run.loop.command, *data)
            run.ticks()
        values = parameters.checked({})
        run.loop.reset(values, 0)
        assert run.loop.failure is None, seed
        sent = run.sent
        run.simulation.log_to(run.count, run.simulation.streams[:1])
        for _ in range(4):
            run.tick()
        assert run.loop.now_ns == 4 * TICK_NS, seed
        assert run.sent == sent + 3, seed


# ------------------------------------------------------------------------------------- real nodes

@pytest.fixture(scope='module')
def peer():
    pytest.importorskip('rclpy')
    from helpers.node_harness import Peer

    with Peer() as peer:
        yield peer


def without_end(values):
    return {name: value for name, value in values.items() if name != 'duration'}


@pytest.mark.parametrize('seed', range(8))
def test_a_node_starts_with_extreme_parameters_or_refuses_them_in_one_line(peer, tmp_path, seed):
    from helpers.node_harness import SimNode, wait_for

    given = {name: str(value).lower() if isinstance(value, bool) else value
             for name, value in without_end(parameter_sets(seed)).items()}
    with SimNode(tmp_path, {'status_period': 1.0} | given) as node:
        wait_for('a service or the end', lambda: not node.alive or node.topic('~/record') in {
            name for name, _ in peer.node.get_service_names_and_types()})
        if node.alive:
            assert peer.switch(node, 'set_pause', True) is not None
            assert node.end() == 0, node.err
        else:
            assert node.wait() == 2, node.err
            assert node.err.count('sim_node: cannot start: ') == 1
    assert 'Traceback' not in node.out + node.err


def test_a_node_survives_extreme_parameters_commands_and_resets(peer, tmp_path):
    from geometry_msgs.msg import PoseStamped
    from helpers.node_harness import Diagnostics, SimNode
    from rclpy.parameter import Parameter

    defaults = {name: list(value) if isinstance(value, tuple) else value
                for name, value in parameters.checked({}).items()
                if parameters.BY_NAME[name].effect is not parameters.Effect.START
                and not name.startswith('spin.')}
    with SimNode(tmp_path, {'status_period': 0.5}) as node:
        peer.introduce(node, Diagnostics(peer))
        for seed in range(20):
            for kind, data in actions(seed):
                if kind == 'set':
                    for name, value in without_end(data).items():
                        peer.set_each(node, **{name: Parameter(name, value=value)
                                               .to_parameter_msg()})
                elif kind == 'command':
                    peer.send_command(node, *data)
                elif kind == 'pause':
                    peer.switch(node, 'set_pause', data)
                elif kind == 'wait':
                    time.sleep(data)
                else:
                    peer.trigger(node, kind)
            assert node.alive, (seed, node.err)
        assert all(result.successful for result in peer.set_each(node, **defaults))
        assert peer.trigger(node, 'reset').success
        assert peer.switch(node, 'set_pause', False).success
        pose = peer.listen(node.topic('pose'), PoseStamped)
        pose.wait_more(50)
        assert node.end() == 0, node.err
        peer.stop_listening(pose)
