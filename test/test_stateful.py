# SPDX-License-Identifier: Apache-2.0
"""
Any order of calls: the motion has the same bits.

EXAMPLES=30 in the environment tries more programs of calls; see helpers/examples.py.
"""


import numpy as np
from helpers.examples import examples
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, simulate
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
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
