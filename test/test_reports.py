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


class Reported:
    """A report of a paused simulation that stands at 1.25 s, and what it is about."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(status, 'time', SimpleNamespace(monotonic=lambda: self.now))
        self.simulation = simulate(start_paused=True)
        self.simulation.epoch_ns = 0        # not started
        self.recording = Recording(self.simulation, lambda channels: [])
        self.loop = Loop(
            self.simulation, self.simulation.values, self.recording, SimulatedClock(
                lambda: EPOCH_NS, print, steady=lambda: 0), update_subscribers=lambda: None,
            error=print)
        self.report = status.NodeStatus(self.simulation, self.loop, self.recording)
        assert self.status[:2] == (1, 'waiting for /clock (use_sim_time is set)')
        self.loop.start()
        self.loop.step(5 * SECOND // 4)

    @property
    def status(self):
        (one,) = self.report.diagnostics(Time(sec=7), 'top').status
        return one.level[0], one.message, {pair.key: pair.value for pair in one.values}


@pytest.fixture
def top(monkeypatch):
    return Reported(monkeypatch)


def test_the_real_time_factor_is_measured_between_readings_that_are_apart(top):
    def factor():
        return float(top.status[2]['real-time factor'])

    top.now += 0.5
    assert factor() == 2.5              # at 1.25 s
    top.now += 0.01                     # a report that was held up
    assert factor() == 2.5
    top.loop.step(SECOND // 2)
    top.now += 0.99
    assert factor() == 0.5
    top.loop.reset(top.simulation.values)
    top.loop.step(SECOND // 4)
    top.now += 1.0
    assert factor() == 0.25


def test_the_worst_problem_is_the_level_and_the_message(top):
    level, message, numbers = top.status
    assert (level, message) == (0, 'paused')
    for key, value in (('simulated time [s]', '1.250000'), ('stamp of t = 0 [ns]', str(EPOCH_NS)),
                       ('recorder', 'off'), ('failed messages', '0')):
        assert numbers[key] == value
    top.simulation.outputs[0].failed = 3
    assert top.status[:2] == (1, '3 messages could not be published')
    assert top.status[:2] == (0, 'paused'), 'nothing has happened since'
    top.loop.slipped_ns = 1_500_000_000
    level, message, numbers = top.status
    assert (level, message) == (1, 'this machine cannot keep up')
    assert (numbers['clock slip [s]'], numbers['failed messages']) == ('1.500', '3'), 'totals'
    top.recording.error = 'disk full'
    level, message, numbers = top.status
    assert (level, message, numbers['recorder']) == (2, 'recording: disk full', 'failed')
    top.recording.error = None
    top.loop.fail('at a pole')
    assert top.status[:2] == (2, 'at a pole')


def test_the_status_line(top):
    top.now += 1.0
    top.loop.change('command', lambda: {'l3': 2.0, 'lz': 1.0})
    top.simulation.outputs[0].sent = 12
    line = top.report.status_line()
    assert line.startswith('t      1.25 s paused | ') and 'energy drift ' in line
    assert ' | x1.25 | 12 messages | L3 2 Lz 1 | ' in line
    top.loop.fail('at a pole')
    assert ' s failed | ' in top.report.status_line()
