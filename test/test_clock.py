# SPDX-License-Identifier: Apache-2.0
"""Simulated time by the steady clock and by a /clock of another node, without ROS."""

from types import SimpleNamespace

import pytest

from spinning_top_sim.nodes.clock import EPOCH_GRID_NS, SimulatedClock

MS = 1_000_000
S = 1000 * MS


class Top:
    """What follows a clock: it sends at once what is due, and stamps it."""

    def __init__(self, scale=1.0, publishers=None):
        self.warnings = []
        self.steady_ns = self.date_ns = 0
        self.clock = SimulatedClock(
            lambda: self.date_ns, self.warnings.append, publishers and (lambda: self.publishers),
            lambda: self.steady_ns)
        self.clock.set_scale(scale)
        self.publishers = publishers
        self.sent_ns = self.epoch_ns = 0

    def begin(self, date_ns, source_ns=None):
        self.date_ns, self.steady_ns = date_ns, date_ns if source_ns is None else source_ns
        self.epoch_ns = self.clock.next_epoch(self.epoch_ns + self.sent_ns)
        self.clock.begin(self.epoch_ns)
        self.sent_ns = 0
        return self

    def tick(self, steady_ns, source_ns=None):
        self.steady_ns, self.date_ns = steady_ns, steady_ns if source_ns is None else source_ns
        due_ns, late_ns, shift_ns = self.clock.due(self.epoch_ns)
        self.epoch_ns += shift_ns
        self.sent_ns = max(self.sent_ns, due_ns)
        return SimpleNamespace(due_ns=due_ns, late_ns=late_ns, both=(due_ns, late_ns))

    @property
    def stamp_ns(self):
        return self.epoch_ns + self.sent_ns


@pytest.mark.parametrize('scale', [1.0, 0.25, 4.0])
def test_by_the_steady_clock_t_0_is_due_when_the_date_of_its_stamp_has_come(scale):
    top = Top(scale).begin(1_000 * S + 3 * MS, 77 * S)
    assert top.epoch_ns == 1_000 * S + 10 * MS
    assert top.tick(77 * S + 7 * MS - 10).due_ns <= 0 == top.tick(77 * S + 7 * MS).due_ns
    assert top.tick(77 * S + 107 * MS).both == (100 * MS * scale, -400 * MS * scale)
    assert top.clock.until_grid(30 * MS) == 20 * MS, '100 ms of real time from t = 0'
    before, date_ns = top.stamp_ns, 1_000 * S + 113 * MS
    top.begin(date_ns, 80 * S)
    assert top.epoch_ns == max(before + 10 * MS, 1_000 * S + 120 * MS), 'stamps do not go back'
    assert top.tick(80 * S + 10 * MS).due_ns >= 0, 'it takes 10 ms at most'


def test_what_one_message_on_a_slow_clock_makes_due_is_on_time():
    step_ns = 2 * S
    top = Top(publishers=1).begin(100 * S + 4 * MS)
    assert top.epoch_ns == 100 * S
    assert top.tick(0, 100 * S + 4 * MS).both == (4 * MS, -1), 't = 0 is on time'
    for k in range(1, 1000):
        steady_ns = k * 10 * MS
        before, source_ns = top.sent_ns, 100 * S + 4 * MS + steady_ns // step_ns * step_ns
        due = top.tick(steady_ns, source_ns)
        assert due.late_ns <= before and top.stamp_ns == source_ns
    assert top.clock.slip(0) == 0 and top.warnings == []


def test_what_is_not_sent_half_a_second_after_its_message_is_late():
    top = Top(publishers=1).begin(100 * S)
    for steady_ns, source_ns in ((0, 101 * S), (400 * MS, 102 * S), (499 * MS, 102 * S)):
        assert top.tick(steady_ns, source_ns).late_ns == -1
    assert top.tick(500 * MS, 102 * S).late_ns == 1 * S
    assert top.tick(900 * MS, 102 * S).late_ns == 2 * S


@pytest.mark.parametrize('jump_ns', [10 * S, 985 * S])
def test_a_jump_forward_moves_the_stamps_and_not_the_motion(jump_ns):
    top = Top(publishers=1).begin(10 * S + 7 * MS)
    top.tick(1 * S, 11 * S)
    sent_ns = top.sent_ns
    top.tick(2 * S, 11 * S + jump_ns)
    assert top.sent_ns == sent_ns and top.epoch_ns % EPOCH_GRID_NS == 0
    assert top.warnings == [
        f'/clock jumped forward by {jump_ns // S} s: so do the stamps']
    top.tick(3 * S, 12 * S + jump_ns)
    assert top.sent_ns == sent_ns + S
    assert 0 <= 12 * S + jump_ns - top.stamp_ns < EPOCH_GRID_NS
    assert len(top.warnings) == 1


def test_a_step_back_is_named_and_a_reset_brings_the_stamps_back():
    top = Top(publishers=1).begin(300 * S)
    top.tick(1 * S, 301 * S)
    top.tick(2 * S, 10 * MS)
    top.tick(3 * S, 1010 * MS)
    assert top.stamp_ns == 302 * S
    (warning,) = top.warnings
    assert warning.startswith('/clock stepped back by 300.99 s:')
    top.begin(1015 * MS)
    assert top.epoch_ns == 1010 * MS
    top.tick(4 * S, 1515 * MS)
    assert 0 <= 1515 * MS - top.stamp_ns < EPOCH_GRID_NS
    top.begin(1515 * MS)
    assert top.epoch_ns == 1520 * MS, 'a reset that follows no step back keeps the order'
    assert top.tick(4 * S, 1515 * MS).due_ns < 0


@pytest.mark.parametrize('lag_ns', [5 * MS, 30 * MS, 990 * S])
@pytest.mark.parametrize('leads_first', [True, False])
def test_of_two_clocks_the_latest_counts_and_stamps_are_never_ahead_of_it(lag_ns, leads_first):
    top = Top(publishers=1).begin(2000 * S if leads_first else 2000 * S - lag_ns)
    newest = 0
    for k in range(400):
        source_ns = 2000 * S + k // 2 * 4 * MS - (lag_ns if k % 2 == leads_first else 0)
        top.publishers = 2 if k > 0 else 1
        newest = max(newest, source_ns)
        top.tick(k * 2 * MS, source_ns)
        assert newest - EPOCH_GRID_NS < top.stamp_ns <= newest
    assert len([one for one in top.warnings if 'several nodes' in one]) == 1
    assert len(top.warnings) <= 2, 'and the jump to the other'
    top.publishers = 1
    top.tick(5 * S, 2000 * S + 796 * MS - lag_ns)
    assert 'stepped back' in top.warnings[-1]


def test_the_last_message_of_clocks_that_have_gone_is_no_step_back():
    top = Top(publishers=1).begin(100 * S)
    top.tick(0, 101 * S)
    top.publishers = 0
    top.tick(1 * S, 100 * S)
    assert top.warnings == [] and top.sent_ns == 1 * S


def test_a_clock_is_missing_before_it_begins_and_2_s_after_it_has_stopped():
    top, missing = Top(publishers=1), []
    for second, date_ns in enumerate((0, 0, 7 * S, 8 * S, 9 * S, 9 * S, 9 * S, 9 * S, 10 * S)):
        top.steady_ns, top.date_ns = second * S, date_ns
        missing.append(top.clock.is_missing())
    assert missing == [True, True, *5 * [False], True, False]


def test_a_date_behind_the_last_stamp_is_refused_and_0_is_no_time():
    with pytest.raises(ValueError, match='2038'):
        Top().begin(2 ** 31 * S, 0)
    top = Top(publishers=1).begin(5)
    assert (top.epoch_ns, top.tick(0, 5).due_ns) == (EPOCH_GRID_NS, 5 - EPOCH_GRID_NS)
