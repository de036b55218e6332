# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself, without a node."""

import io
import math
import os
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip('diagnostic_msgs')

from builtin_interfaces.msg import Time

from spinning_top_sim.nodes import reports
from spinning_top_sim.nodes.reports import MotionReport
from spinning_top_sim.nodes.tick_loop import TickLoop
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(reports, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def reported():
    """A report of a paused simulation that stands at 1.25 s, and what it is about."""
    values = parameters.checked({'start_paused': True})
    simulation = LiveSimulation(values)
    session = SimpleNamespace(error=None, warning=None, size='',
                              numbers=lambda: {'recorder': 'off'}, has_room=lambda: True,
                              write_command=print, write_event=lambda *_, **__: None)
    loop = TickLoop(simulation, values, session, update_subscribers=lambda: None, tell=print)
    loop.start()
    loop.step(1, 1.25)
    return SimpleNamespace(report=MotionReport(simulation, loop, session), loop=loop,
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
    reported.loop.step(1, 0.5)
    clock.now += 0.99
    assert factor() == 0.5
    reported.loop.reset(reported.simulation.values, 0)
    reported.loop.step(1, 0.25)
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
    reported.loop.step(1, 1.0)
    level, message, _ = status_of(reported, 1e-300)
    assert level == 1 and 'more than max_error = 1e-300 rad' in message


def test_the_status_line_and_what_is_told_of_a_new_motion(clock, reported):
    told = reported.report.new_motion()
    assert 'cusp' in told and max(map(len, told.splitlines())) <= 80
    assert reported.report.new_motion() is None
    line = reported.report.status_line()
    assert line.startswith('t      1.25 s paused | ') and ' | x' not in line
    assert 'L3 1.6 Lz 1.386' in line and 'no subscribers yet' in line
    clock.now += 1.0
    status_of(reported)
    reported.session.size = '1.2 MB'
    reported.loop.command(2.0, 1.0)
    assert reported.report.new_motion() is not None
    assert ' | log 1.2 MB | ' in reported.report.status_line()
    reported.simulation.outputs[0].sent = 12
    assert ' | 12 messages | ' in reported.report.status_line()
    reported.loop.resume()
    assert re.search(r' \| x\d+\.\d\d \| ', reported.report.status_line())
    reported.report.waits_for_clock = True
    assert ' waiting for /clock | ' in reported.report.status_line()
    assert status_of(reported)[:2] == (1, 'waiting for /clock')
    reported.loop.fail('at a pole')
    assert ' FAILED | ' in reported.report.status_line()


@pytest.mark.parametrize('on_path', [False, True])
def test_the_next_command_works_where_it_is_pasted(monkeypatch, tmp_path, on_path):
    monkeypatch.setattr(reports.sys, 'executable', str(tmp_path / 'my bin/python'))
    monkeypatch.setattr(reports.shutil, 'which', lambda _: '/bin/inspect' if on_path else None)
    log = Path('/a b/run.mcap')
    if not on_path:
        assert reports.inspect_command(log).startswith('ros2 run spinning_top_sim inspect ')
        (tmp_path / 'my bin').mkdir()
        (tmp_path / 'my bin/inspect').touch()
    program, *arguments = shlex.split(reports.inspect_command(log))
    assert program == ('inspect' if on_path else str(tmp_path / 'my bin/inspect'))
    assert arguments == [str(log), '--plot', 'top.png']


class Screen(io.StringIO):
    """A standard output that is a terminal, or none."""

    def __init__(self, columns):
        super().__init__()
        self.columns = columns

    def isatty(self):
        return self.columns is not None


@pytest.fixture
def screen(monkeypatch):
    """Return a terminal of so many columns (None: no terminal), and what is shown."""
    def of(columns):
        out = Screen(columns)
        monkeypatch.setattr(reports.sys, 'stdout', out)
        monkeypatch.setattr(reports.os, 'get_terminal_size', lambda *_: os.terminal_size(
            (out.columns, 24)))
        return reports.Terminal(), out
    return of


def test_the_status_line_fits_the_terminal_also_when_that_becomes_narrower(screen):
    terminal, out = screen(20)
    terminal.show('123456 | 123456 | 123456')
    terminal.show('123456 | 12345678901 | 1')
    out.columns = 5
    terminal.show('123456 | 123456 | 123456')
    assert out.getvalue().split('\r\x1b[K') == ['', '123456 | 123456', '123456', '1234']


def test_a_line_that_stays_stands_below_the_status_line(screen):
    terminal, out = screen(80)
    terminal.show('one | two')
    terminal.end()
    terminal.end()
    terminal.show('three')
    terminal.tell('done')
    assert out.getvalue() == '\r\x1b[Kone | two\n\r\x1b[Kthree\ndone\n'


@pytest.mark.parametrize('columns', [None, 0, OSError(5, 'Input/output error')])
def test_without_a_terminal_under_launch_or_when_it_is_gone_lines_are_whole(
        screen, monkeypatch, columns):
    terminal, out = screen(columns)

    def size(*_):
        if isinstance(columns, OSError):
            raise columns
        return os.terminal_size((columns, 24))
    monkeypatch.setattr(reports.os, 'get_terminal_size', size)
    terminal.show('a | ' * 50 + 'z')
    terminal.show('b')
    terminal.end()
    assert out.getvalue() == 'a | ' * 50 + 'z\nb\n'
    monkeypatch.setattr(reports.sys, 'stdout', None)
    terminal.show('c')                      # a closed standard output is no terminal
