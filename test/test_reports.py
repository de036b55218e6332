# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself, without a node."""

import re
from types import SimpleNamespace

import pytest

pytest.importorskip('diagnostic_msgs')

from builtin_interfaces.msg import Time
from helpers.simulations import EPOCH_NS, SECOND, simulate

from spinning_top_sim.nodes import status
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.loop import Loop
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.nodes.status import NodeStatus


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(status, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def reported():
    """A report of a paused simulation that stands at 1.25 s, and what it is about."""
    simulation = simulate(start_paused=True)
    recording = Recording(simulation, lambda channels: [])
    loop = Loop(simulation, simulation.values, recording, SimulatedClock(
        lambda: EPOCH_NS, print, steady=lambda: 0), update_subscribers=lambda: None,
                warn=print, error=print)
    loop.start()
    loop.step(5 * SECOND // 4)
    return SimpleNamespace(report=NodeStatus(simulation, loop, recording), loop=loop,
                           recording=recording, simulation=simulation)


def status_of(reported):
    message = reported.report.diagnostics(Time(sec=7), 'top')
    assert message.header.stamp.sec == 7
    (one,) = message.status
    return one.level[0], one.message, {pair.key: pair.value for pair in one.values}


def test_the_real_time_factor_is_measured_between_readings_that_are_apart(clock, reported):
    def factor():
        return float(status_of(reported)[2]['real-time factor'])

    clock.now += 0.5
    assert factor() == 2.5              # at 1.25 s
    clock.now += 0.01                   # a report that was held up
    assert factor() == 2.5
    reported.loop.step(SECOND // 2)
    clock.now += 0.99
    assert factor() == 0.5
    reported.loop.reset(reported.simulation.values)
    reported.loop.step(SECOND // 4)
    clock.now += 1.0
    assert factor() == 0.25


def test_the_worst_problem_is_the_level_and_the_message(reported):
    level, message, numbers = status_of(reported)
    assert (level, message) == (0, 'paused')
    assert numbers['simulated time [s]'] == '1.250000'
    assert numbers['stamp of t = 0 [ns]'] == str(EPOCH_NS)
    assert (numbers['recorder'], numbers['failed messages']) == ('off', '0')
    output, loop = reported.simulation.outputs[0], reported.loop
    output.failed = 3
    assert status_of(reported)[:2] == (1, '3 messages could not be published')
    assert status_of(reported)[:2] == (0, 'paused'), 'nothing has happened since'
    loop.slipped_ns = 1_500_000_000
    level, message, numbers = status_of(reported)
    assert (level, message) == (1, 'this machine cannot keep up')
    assert (numbers['clock slip [s]'], numbers['state']) == ('1.500', 'paused')
    assert numbers['failed messages'] == '3', 'counters are totals'
    loop.resume()
    assert status_of(reported)[2]['state'] == 'running'
    loop.pause()
    reported.recording.error = 'disk full'
    level, message, numbers = status_of(reported)
    assert (level, message, numbers['recorder']) == (2, 'recording: disk full', 'failed')
    reported.recording.error = None
    loop.fail('at a pole')
    assert status_of(reported)[:2] == (2, 'at a pole')
    loop.reset(reported.simulation.values)
    assert status_of(reported)[:2] == (0, 'paused')


def test_the_status_line(clock, reported):
    line = reported.report.status_line()
    assert line.startswith('t      1.25 s paused | ') and ' | x' not in line
    assert 'L3 1.6 Lz 1.386' in line and 'no subscribers yet' in line and 'energy drift ' in line
    clock.now += 1.0
    status_of(reported)
    reported.loop.change('command', lambda: {'l3': 2.0, 'lz': 1.0})
    reported.simulation.outputs[0].sent = 12
    line = reported.report.status_line()
    assert 'L3 2 Lz 1' in line and ' | 12 messages | ' in line
    reported.loop.resume()
    assert re.search(r' \| x\d+\.\d\d \| ', reported.report.status_line())
    reported.report.waits_for_clock = True
    assert ' waiting for /clock | ' in reported.report.status_line()
    assert status_of(reported)[:2] == (1, 'waiting for /clock')
    reported.loop.fail('at a pole')
    assert ' FAILED | ' in reported.report.status_line()
