# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself, without a node."""

from types import SimpleNamespace

import pytest

pytest.importorskip('diagnostic_msgs')

from builtin_interfaces.msg import Time
from helpers.simulations import EPOCH_NS, SECOND, simulate

from spinning_top_sim.nodes import status
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.loop import Loop
from spinning_top_sim.nodes.recording import Recording


def test_the_worst_problem_is_told_and_the_real_time_factor_is_that_since_the_last_time(
        monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(status, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    simulation = simulate(start_paused=True)
    recording = Recording(simulation, lambda channels: [])
    loop = Loop(simulation, simulation.values_at_start, recording, SimulatedClock(
        lambda: EPOCH_NS, print, steady=lambda: 0), update_subscribers=print, error=print)
    report = status.NodeStatus(simulation, loop, recording)
    loop.start()

    def told(after_s=0.0):
        clock.now += after_s
        (one,) = report.diagnostics(Time(sec=7), 'top').status
        return one.level[0], one.message, {pair.key: pair.value for pair in one.values}

    def factor(after_s):
        return float(told(after_s)[2]['real-time factor'])

    loop.step(5 * SECOND // 4)
    assert factor(0.5) == 2.5
    assert factor(0.01) == 2.5, 'a report that was held up'
    loop.step(SECOND // 2)
    assert factor(0.99) == 0.5
    loop.reset(simulation.values_at_start)
    loop.step(SECOND // 4)
    assert factor(1.0) == 0.25

    level, message, numbers = told()
    assert (level, message) == (0, 'paused')
    assert (numbers['simulated time [s]'], numbers['recorder']) == ('0.250000', 'off')
    simulation.outputs[0].failed, simulation.outputs[0].sent = 3, 12
    assert told()[:2] == (1, '3 messages could not be published')
    assert told()[:2] == (0, 'paused'), 'nothing has happened since'
    loop.slipped_ns = 1_500_000_000
    level, message, numbers = told()
    assert (level, message) == (1, 'this machine cannot keep up')
    assert (numbers['clock slip [s]'], numbers['failed messages']) == ('1.500', '3'), 'totals'
    recording.error = 'disk full'
    assert told()[:2] == (2, 'recording: disk full')
    line = report.status_line()
    assert line.startswith('t      0.25 s paused | theta  41.21 deg | x')
    assert line.endswith(' | 12 messages to subscribers')
    recording.error = None
    loop.fail('at a pole')
    assert told()[:2] == (2, 'at a pole') and ' s failed | ' in report.status_line()
