# SPDX-License-Identifier: Apache-2.0
"""Extreme parameters and commands: a node lives on, or refuses them in one clear line."""

import math
import random
import time

import pytest
from helpers.examples import examples
from helpers.extremes import actions, commands, parameter_set
from helpers.simulations import doubles
from hypothesis import given
from hypothesis import strategies as st
from test_tick_loop import POSE_NS, TICK_NS, Run

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters

CLOCK_STEP_NS = 5_000_000   # by which time goes on whenever it is read, so that budgets end
REFUSED = ValueError, RuntimeError, IntegrationError


class Recorded:
    """Takes what is recorded: stamps ascend, and attitudes are unit quaternions."""

    def __init__(self, simulation):
        self._last = {}
        self._topics = [stream.topic for stream in simulation.streams]
        simulation.log_to(self._write, simulation.streams)

    def _write(self, numbers, stamp_ns, messages, size):
        assert size == sum(map(len, messages))
        for number, message in zip(numbers, messages, strict=True):
            assert stamp_ns > self._last.get(number, -1), (self._topics[number], stamp_ns)
            self._last[number] = stamp_ns
            if self._topics[number] == 'pose':
                quaternion = doubles(message, 4)
                assert all(map(math.isfinite, quaternion)), quaternion
                assert abs(math.hypot(*quaternion) - 1.0) < 1e-15, quaternion


def run_of(given_values):
    """Return a run that records, or None where one is refused."""
    try:
        run = Run(**given_values)
    except REFUSED as error:
        check_reason(error)
        return None
    run.clock.step_ns = CLOCK_STEP_NS
    Recorded(run.simulation)
    run.loop.start()
    return run


def check_reason(error):
    """Whether a refusal is one line that people can read."""
    assert str(error).strip() and '\n' not in str(error), error


def angles(simulation):
    state = simulation.state()
    return [getattr(state, name)[0] for name in ('theta', 'theta_dot', 'phi', 'psi')]


def act(run, kind, value):
    """Do as the node does."""
    simulation, loop = run.simulation, run.loop
    if kind == 'set':
        changed = parameters.checked({**run.values, **without_end(value)})
        simulation.apply(changed)
        loop.set_pace(changed)
        run.values = changed
    elif kind == 'command' and len(value) == 2:
        loop.command(*value)
    elif kind == 'pause':
        (loop.pause if value else loop.resume)()
    elif kind == 'step':
        loop.step(run.values['step.count'], run.values['step.dt'])
    elif kind == 'reset':
        loop.reset(run.values, 0)


def without_end(values):
    return {name: value for name, value in values.items()
            if name not in ('duration', 'start_paused')}


@examples(2)
@given(st.randoms(), st.booleans())
def test_whatever_is_set_and_commanded_a_reset_to_the_default_revives(rng, allowed):
    run = run_of(without_end(parameter_set(rng, allowed))) or run_of({})
    for kind, value in [*actions(rng), *(('command', data) for data in commands(rng))]:
        before, now_ns = angles(run.simulation), run.loop.now_ns
        try:
            act(run, kind, value)
        except REFUSED as error:
            check_reason(error)
            if kind == 'set' and run.loop.now_ns == now_ns:
                assert angles(run.simulation) == before, 'a refusal changes nothing'
        run.tick(rng.choice((1_000_000, TICK_NS, 300_000_000)))
        run.ticks(5)
    run.clock.step_ns = 0
    values = parameters.checked({})
    run.simulation.apply(values)
    run.loop.set_pace(values)
    run.loop.reset(values, run.simulation.epoch_ns)
    run.loop.resume()
    assert run.loop.failure is None
    run.stamps.clear()
    run.record().ticks(4)
    assert [stamp - run.simulation.epoch_ns for stamp in run.stamps] == [0, POSE_NS, 2 * POSE_NS]


# ------------------------------------------------------------------------------------- real nodes

@pytest.fixture(scope='module')
def peer():
    pytest.importorskip('rclpy')
    from helpers.node_harness import Peer

    with Peer() as peer:
        yield peer


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
            for kind, data in actions(random.Random(seed)):
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
