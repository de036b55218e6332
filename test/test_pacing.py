# SPDX-License-Identifier: Apache-2.0
"""When ticks come: the thread that paces them, on a clock of its own."""

import threading
import time

import pytest

from spinning_top_sim.nodes import pacing

BEGIN = 1000.0
PERIOD = 1.0 / 128          # sums of it are exact


class Time:
    """Stands in for the module `time`: sleeping takes as long as it says, and all else nothing."""

    def __init__(self):
        self.now, self.naps = BEGIN, []

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.naps.append(seconds)
        self.now += seconds


class Run:
    """
    A DeadlineThread run here; `seen` are its ticks, in periods after the begin.

    costs: time that some ticks take, by their number [periods];  wants: ticks that ask for idle
    work;  at: what happens in some ticks, by their number
    """

    def __init__(self, monkeypatch, count, costs=None, wants=(), at=None):
        self.time, self.seen, self.idled = Time(), [], []
        self._count, self._costs, self._wants, self._at = count, costs or {}, wants, at or {}
        monkeypatch.setattr(pacing, 'time', self.time)
        self.origin, self.period = BEGIN, PERIOD
        self.thread = pacing.DeadlineThread(self._tick, self._idle,
                                            lambda: (self.origin, self.period), pytest.fail)
        self.thread.run()

    def _tick(self):
        number = len(self.seen)
        self.seen.append((self.time.now - BEGIN) / PERIOD)
        self.time.now += PERIOD * self._costs.get(number, 0.25)
        self._at.get(number, lambda run: None)(self)
        if len(self.seen) == self._count:
            self.thread._stopped = True
        return number in self._wants

    def _idle(self):
        self.idled.append((self.time.now - BEGIN) / PERIOD)
        self.time.now += 0.125 * PERIOD


def test_a_late_tick_comes_at_once_what_has_passed_is_skipped_and_the_grid_stays(monkeypatch):
    assert Run(monkeypatch, 5).seen == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert Run(monkeypatch, 5, {1: 1.25}).seen == [1.0, 2.0, 3.25, 4.0, 5.0]
    assert Run(monkeypatch, 5, {1: 3.75}).seen == [1.0, 2.0, 5.75, 6.0, 7.0]


def test_a_new_rate_holds_from_the_next_deadline_on(monkeypatch):
    def set_period(period):
        return lambda run: setattr(run, 'period', period)

    seen = Run(monkeypatch, 6, at={1: set_period(2.0 * PERIOD)}).seen
    assert seen == [1.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    seen = Run(monkeypatch, 4, at={1: set_period(0.5 * PERIOD)}).seen
    assert seen == [1.0, 2.0, 2.5, 3.0]


def test_the_thread_tells_of_errors_and_goes_on(monkeypatch):
    class Failing(Run):
        def _tick(self):
            wants = super()._tick()
            if len(self.seen) in (2, 3):
                raise ZeroDivisionError(len(self.seen))
            return wants

    told = []
    monkeypatch.setattr(pytest, 'fail', lambda error: told.append(str(error)))
    run = Failing(monkeypatch, 5)
    assert told == ['2', '3']
    assert len(run.seen) == 5


def test_a_lock_is_left_to_who_waits_for_it():
    lock, theirs, overtaken, done = pacing.FairLock(), [], [], threading.Event()

    def busy():
        turn = 0                                    # that another thread waits for
        while not done.is_set():
            with lock:
                overtaken.append(len(theirs) < turn)
                turn = len(theirs) + 1 if lock._next.locked() else 0

    thread = threading.Thread(target=busy, daemon=True)
    thread.start()
    for _ in range(50):
        count = len(overtaken)
        while len(overtaken) < count + 10:          # it is busy again
            time.sleep(1e-5)
        with lock:
            theirs.append(None)
    done.set()
    thread.join(60.0)
    assert not thread.is_alive()
    assert not any(overtaken)
