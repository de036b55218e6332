# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself, without a node."""

import io
import math
import os
import re
from types import SimpleNamespace

import pytest

pytest.importorskip('diagnostic_msgs')

from builtin_interfaces.msg import Time
from spinning_top_sim.nodes.node_status import NodeStatus
from spinning_top_sim.nodes.tick_loop import TickLoop

from spinning_top_sim.nodes import node_status, terminal
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(node_status, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def reported():
    """A report of a paused simulation that stands at 1.25 s, and what it is about."""
    values = parameters.checked({'start_paused': True})
    simulation = LiveSimulation(values)
    session = SimpleNamespace(error=None, warning=None,
                              numbers=lambda: {'recorder': 'off'}, has_room=lambda: True,
                              write_command=print, write_event=lambda *_, **__: None)
    loop = TickLoop(simulation, values, session, update_subscribers=print, warn=print, error=print)
    loop.start()
    loop.step(1_250_000_000)
    return SimpleNamespace(report=NodeStatus(simulation, loop, session), loop=loop,
                           session=session, simulation=simulation)


def status_of(reported, max_error=1e-6):
    message = reported.report.diagnostics(Time(sec=7), 'top', max_error)
    assert message.header.stamp.sec == 7
    (status,) = message.status
    return status.level[0], status.message, {pair.key: pair.value for pair in status.values}


def test_the_real_time_factor_is_measured_between_readings_that_are_apart(clock, reported):
    def factor():
        return float(status_of(reported)[2]['real-time factor'])

    clock.now += 0.5
    assert factor() == 2.5              # at 1.25 s
    clock.now += 0.01                   # a report that was held up
    assert factor() == 2.5
    reported.loop.step(500_000_000)
    clock.now += 0.99
    assert factor() == 0.5
    reported.loop.reset(reported.simulation.values, 0)
    reported.loop.step(250_000_000)
    clock.now += 1.0
    assert factor() == 0.25


def test_the_worst_problem_is_the_level_and_the_message(reported):
    level, message, numbers = status_of(reported)
    assert (level, message) == (0, 'paused')
    assert numbers['simulated time [s]'] == '1.250000'
    assert 0.0 < float(numbers['orientation error [rad]']) < 1e-9
    assert numbers['recorder'] == 'off'
    level, message, numbers = status_of(reported, max_error=0.0)
    assert math.isnan(float(numbers['orientation error [rad]']))
    reported.loop.slipped_ns = 1_500_000_000
    level, message, numbers = status_of(reported)
    assert (level, message) == (1, 'this machine cannot keep up')
    assert (numbers['clock slip [s]'], numbers['state']) == ('1.500', 'paused')
    reported.loop.resume()
    assert status_of(reported)[2]['state'] == 'running'
    reported.loop.pause()
    reported.loop.slipped_ns = 0
    reported.session.warning = 'the disk is slow'
    assert status_of(reported)[:2] == (1, 'recording: the disk is slow')
    reported.loop.slipped_ns = 1
    reported.session.error = 'disk full'
    assert status_of(reported)[:2] == (2, 'recording: disk full')
    reported.session.error = reported.session.warning = None
    reported.loop.fail('at a pole')
    assert status_of(reported)[:2] == (2, 'at a pole')
    reported.loop.slipped_ns = 0
    reported.loop.reset(reported.simulation.values, 0)
    assert status_of(reported)[:2] == (0, 'paused')
    reported.loop.step(1_000_000_000)
    level, message, _ = status_of(reported, 1e-300)
    assert level == 1 and 'more than max_error = 1e-300 rad' in message


def test_the_status_line(clock, reported):
    line = reported.report.status_line()
    assert line.startswith('t      1.25 s paused | ') and ' | x' not in line
    assert 'L3 1.6 Lz 1.386' in line and 'no subscribers yet' in line and 'energy drift ' in line
    clock.now += 1.0
    status_of(reported)
    reported.loop.command(2.0, 1.0)
    reported.simulation.outputs[0].sent = 12
    assert ' | 12 messages | ' in reported.report.status_line()
    reported.loop.resume()
    assert re.search(r' \| x\d+\.\d\d \| ', reported.report.status_line())
    reported.report.waits_for_clock = True
    assert ' waiting for /clock | ' in reported.report.status_line()
    assert status_of(reported)[:2] == (1, 'waiting for /clock')
    reported.loop.fail('at a pole')
    assert ' FAILED | ' in reported.report.status_line()


def standard_output(monkeypatch, *, isatty):
    """Return a standard output of 12 columns."""
    out = io.StringIO()
    out.isatty = lambda: isatty
    monkeypatch.setattr(terminal.sys, 'stdout', out)
    monkeypatch.setattr(terminal.shutil, 'get_terminal_size', lambda: os.terminal_size((12, 24)))
    return out


def test_a_line_that_stays_stands_below_the_status_line_which_fits_the_terminal(monkeypatch):
    out, line = standard_output(monkeypatch, isatty=True), terminal.Terminal()
    line.show('one | two | three')
    line.end()
    line.end()
    line.show('four')
    line.tell('done')
    assert out.getvalue() == '\r\x1b[Kone | two |\n\r\x1b[Kfour\ndone\n'


def test_without_a_terminal_each_status_is_a_line(monkeypatch):
    out, line = standard_output(monkeypatch, isatty=False), terminal.Terminal()
    line.show('a | b')
    line.end()
    assert out.getvalue() == 'a | b\n'
    monkeypatch.setattr(terminal.sys, 'stdout', None)
    line.show('c')                      # a closed standard output is no terminal
