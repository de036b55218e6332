# SPDX-License-Identifier: Apache-2.0
"""
Any order of calls: the motion has the same bits, and a node answers all and stays what it says.

EXAMPLES=30 in the environment tries more programs of calls; see helpers/examples.py.
"""

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from helpers.examples import examples
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, simulate
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from spinning_top_sim.streams.events import Event

SCENES = ('cusp', 'looping', 'planar_pendulum', 'sleeping', 'shuttle')
MOMENTA = st.floats(-3.0, 3.0)


def columns(states):
    return np.column_stack((states.quaternion, states.angular_velocity, states.theta, states.phi,
                            states.psi, np.transpose(states.position((0.1, 0.0, 0.2)))))


class Motion(RuleBasedStateMachine):
    """A trajectory that is asked in any order, beside one to which only its events happen."""

    @initialize(scene=st.sampled_from(SCENES), method=st.sampled_from(['rk45', 'exact']))
    def begin(self, scene, method):
        values = {**scene_parameters(scene), 'solver.method': method}
        self.asked, self.silent = (simulate(values).trajectory for _ in range(2))
        self.now_ns = self.oldest_ns = 0
        self.found = {}             # by time: what was returned

    @rule(after_ns=st.integers(0, 300 * MILLISECOND), count=st.integers(1, 20))
    def evaluate(self, after_ns, count):
        times_ns = self.oldest_ns + np.unique(np.linspace(0, after_ns, count).astype(np.int64))
        states = columns(self.asked.evaluate(times_ns))
        for t_ns, row in zip(times_ns.tolist(), states, strict=True):
            if t_ns <= self.now_ns:
                assert (self.found.setdefault(t_ns, row) == row).all()

    @rule(ahead_ns=st.integers(0, 2000 * MILLISECOND))
    def look_ahead(self, ahead_ns):
        self.asked.evaluate(np.array([self.now_ns + ahead_ns]))

    @rule(later_ns=st.integers(0, 200 * MILLISECOND))
    def go_on(self, later_ns):
        self.now_ns += later_ns

    @rule(margin_ns=st.integers(0, 100 * MILLISECOND))
    def forget(self, margin_ns):
        self.oldest_ns = max(self.oldest_ns, self.now_ns - margin_ns)
        self.asked.forget(self.oldest_ns, self.oldest_ns)
        self.found = {t_ns: row for t_ns, row in self.found.items() if t_ns >= self.oldest_ns}

    @rule(l3=MOMENTA, lz=MOMENTA)
    def command(self, l3, lz):
        self._happen(Event('command', self.now_ns, self.now_ns, {'l3': l3, 'lz': lz}))

    @rule(x=st.sampled_from([0.0, 0.5, -1.0]), for_ns=st.sampled_from([MILLISECOND, 10 ** 9]))
    def drive(self, x, for_ns):
        self._happen(Event('drive', self.now_ns, self.now_ns, {
            'x': x, 'y': 0.0, 'z': 0.1, 'stop_ns': self.now_ns + for_ns}))

    def _happen(self, event):
        """Both refuse an event with the same words, or take it."""
        outcomes = []
        for name in ('asked', 'silent'):
            try:
                setattr(self, name, getattr(self, name).then(event))
                outcomes.append('')
            except ValueError as error:
                outcomes.append(str(error))
        assert outcomes[0] == outcomes[1]

    def teardown(self):
        if hasattr(self, 'asked'):
            times_ns = np.unique([*self.found, self.now_ns, self.now_ns + 50 * MILLISECOND])
            once = columns(self.silent.evaluate(times_ns))
            kept = times_ns >= self.oldest_ns
            assert (columns(self.asked.evaluate(times_ns[kept])) == once[kept]).all()
            for t_ns, row in zip(times_ns.tolist(), once, strict=True):
                assert (self.found.get(t_ns, row) == row).all()
            assert self.asked.momenta(self.now_ns) == self.silent.momenta(self.now_ns)


def test_any_order_of_evaluation_events_and_forgetting_gives_the_same_bits():
    run_state_machine_as_test(Motion, settings=examples(40))


class Node(RuleBasedStateMachine):
    """A node in this process, by services, parameters and topics, beside what it should say."""

    @initialize()
    def begin(self):
        from helpers.own_node import OwnNode

        self.folder = tempfile.TemporaryDirectory(prefix='node_')
        self.node = OwnNode(Path(self.folder.name), tick_rate=100.0).listen('pose').__enter__()
        self.paused = self.recording = False
        self.logs, self.commands, self.refused = [], 0, 0
        self.now_ns = self.epoch_ns = -1

    def _counted(self, l3, lz):
        """Count a command; return whether it should be taken."""
        is_right = math.isfinite(l3) and math.isfinite(lz)
        self.commands += is_right
        self.refused += not is_right
        return is_right

    @rule(l3=MOMENTA, lz=st.one_of(MOMENTA, st.just(math.nan)))
    def command(self, l3, lz):
        self.node.command(l3, lz)
        if self._counted(l3, lz):
            assert self.node.get('spin.l3', 'spin.lz') == [l3, lz]

    @rule(l3=MOMENTA, lz=st.one_of(MOMENTA, st.just(math.inf)))
    def set_spin(self, l3, lz):
        before = self.node.get('spin.l3', 'spin.lz')
        answer = self.node.set(spin__l3=l3, spin__lz=lz)
        is_right = self._counted(l3, lz)
        assert answer.successful == is_right and bool(answer.reason) != is_right
        assert self.node.get('spin.l3', 'spin.lz') == ([l3, lz] if is_right else before)

    @rule()
    def send_a_wrong_command(self):
        self.node.command(1.0)
        self.refused += 1

    @rule(rate=st.sampled_from([20.0, 100.0, 333.0, -1.0, 1e9]))
    def set_rate(self, rate):
        before, = self.node.get('pose.rate')
        assert self.node.set(pose__rate=rate).successful == (0.0 < rate < 1e6)
        assert self.node.get('pose.rate') == [rate if 0.0 < rate < 1e6 else before]

    @rule(pause=st.booleans())
    def pause(self, pause):
        assert self.node.switch('set_pause', pause).success
        self.paused = pause

    @rule(count=st.integers(1, 30))
    def step(self, count):
        assert self.node.set(step__count=count).successful
        before_ns = self.node.loop.now_ns
        assert self.node.trigger('step').success == self.paused
        if self.paused:
            assert self.node.loop.now_ns == before_ns + count * self.node.node.step_ns

    @rule()
    def reset(self):
        assert self.node.trigger('reset').success
        self.now_ns = -1

    @rule(on=st.booleans())
    def record(self, on):
        if on and not self.recording:
            self.logs.append(Path(self.folder.name, f'{len(self.logs)}.mcap'))
            assert self.node.set(record__uri=str(self.logs[-1])).successful
        answer = self.node.switch('record', on)
        assert answer.success and (not on or str(self.logs[-1]) in answer.message)
        self.recording = on

    @rule()
    def wait(self):
        import rclpy

        for _ in range(4):
            rclpy.spin_once(self.node.node, timeout_sec=0.01)

    @invariant()
    @precondition(lambda self: hasattr(self, 'node'))
    def says_what_is(self):
        loop, simulation = self.node.loop, self.node.simulation
        level, message, said = self.node.diagnostics()
        assert said['state'] == ('paused' if self.paused else 'running'), message
        assert (loop.commands, loop.rejected_commands) == (self.commands, self.refused)
        assert (said['commands'], said['rejected commands']) == (
            str(self.commands), str(self.refused))
        assert said['recorder'] == ('recording' if self.recording else 'off')
        stamps = self.epoch_ns + self.now_ns, simulation.epoch_ns + simulation.now_ns
        assert stamps == tuple(sorted(stamps)) or simulation.now_ns < 0
        self.epoch_ns, self.now_ns = simulation.epoch_ns, simulation.now_ns

    def teardown(self):
        from helpers.node_logs import verified

        if hasattr(self, 'node'):
            self.node.__exit__()
            for path in self.logs:
                found = verified(path)
                assert found['identical'], found
            self.folder.cleanup()


def test_a_node_answers_and_says_what_is_in_any_order_of_calls():
    pytest.importorskip('rclpy')
    run_state_machine_as_test(Node, settings=settings(examples(6), stateful_step_count=15))
