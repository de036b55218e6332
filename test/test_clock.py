# SPDX-License-Identifier: Apache-2.0
"""Simulated time by the steady clock and by a /clock of another node, without ROS."""

import pytest

from spinning_top_sim.nodes.clock import EPOCH_GRID_NS, SimulatedClock

MS = 1_000_000
S = 1000 * MS


class Top:
    """What follows a clock: it sends at once what is due, and stamps it."""

    def __init__(self, scale=1.0, publishers=None):
        self.warnings = []
        self.steady_ns = self.date_ns = self.sent_ns = self.epoch_ns = 0
        self.clock = SimulatedClock(
            lambda: self.date_ns, self.warnings.append, follows=publishers is not None,
            publishers=lambda: self.publishers, steady=lambda: self.steady_ns)
        self.clock.set_scale(scale)
        self.publishers = publishers

    def begin(self, date_ns, steady_ns=0):
        self.date_ns, self.steady_ns = date_ns, steady_ns
        self.epoch_ns = self.clock.next_epoch(self.epoch_ns + self.sent_ns)
        self.clock.begin(self.epoch_ns)
        self.sent_ns = 0
        return self

    def tick(self, steady_ns, date_ns=0):
        """Return what is due, and what is late."""
        self.steady_ns, self.date_ns = steady_ns, date_ns
        due_ns, late_ns, shift_ns = self.clock.due(self.epoch_ns)
        self.epoch_ns += shift_ns
        self.sent_ns = max(self.sent_ns, due_ns)
        return due_ns, late_ns

    @property
    def stamp_ns(self):
        return self.epoch_ns + self.sent_ns


@pytest.mark.parametrize('scale', [1.0, 0.25, 4.0])
def test_by_the_steady_clock_t_0_is_due_when_the_date_of_its_stamp_has_come(scale):
    top = Top(scale).begin(1_000 * S + 3 * MS, 77 * S)
    assert top.epoch_ns == 1_000 * S + 10 * MS
    assert top.tick(77 * S + 7 * MS - 10)[0] <= 0 == top.tick(77 * S + 7 * MS)[0]
    assert top.tick(77 * S + 107 * MS) == (100 * MS * scale, -400 * MS * scale)
    assert top.clock.until_grid(30 * MS) == 20 * MS, '100 ms of real time from t = 0'
    before = top.stamp_ns
    top.begin(1_000 * S + 113 * MS, 80 * S)
    assert top.epoch_ns == max(before + 10 * MS, 1_000 * S + 120 * MS), 'stamps do not go back'
    assert top.tick(80 * S + 10 * MS)[0] >= 0, 'it takes 10 ms at most'


def test_what_a_slow_clock_makes_due_is_on_time_for_half_a_second():
    top = Top(publishers=1).begin(100 * S + 4 * MS)
    assert top.epoch_ns == 100 * S
    assert top.tick(0, 100 * S + 4 * MS) == (4 * MS, -1), 't = 0 is on time'
    assert top.begin(100 * S + 6 * MS).epoch_ns == 100 * S + 10 * MS, 'stamps do not go back'
    top.begin(200 * S)
    for steady_ns, second, late_ns in (
            (0, 201, -1), (400, 202, -1), (499, 202, -1), (500, 202, 1 * S), (900, 202, 2 * S)):
        assert top.tick(steady_ns * MS, second * S)[1] == late_ns
    top.begin(300 * S, 950 * MS)
    assert top.tick(1400 * MS, 301 * S)[1] == -1, 'what was due of the motion before'


@pytest.mark.parametrize('lag_ns', [5 * MS, 30 * MS, 990 * S])
@pytest.mark.parametrize('leads_first', [True, False])
def test_of_two_clocks_the_latest_counts_and_stamps_are_never_ahead_of_it(lag_ns, leads_first):
    top = Top(publishers=1).begin(2000 * S if leads_first else 2000 * S - lag_ns)
    newest = 0
    for k in range(400):
        date_ns = 2000 * S + k // 2 * 4 * MS - (lag_ns if k % 2 == leads_first else 0)
        top.publishers = 2 if k > 0 else 1
        newest = max(newest, date_ns)
        top.tick(k * 2 * MS, date_ns)
        assert newest - EPOCH_GRID_NS < top.stamp_ns <= newest
    assert len([one for one in top.warnings if 'several nodes' in one]) == 1
    assert len(top.warnings) <= 2, 'and the jump to the other'
    top.publishers = 0
    top.tick(4 * S, newest - lag_ns)
    assert top.stamp_ns > newest - EPOCH_GRID_NS, 'the last message of one that has gone'
    top.publishers = 1
    top.tick(5 * S, newest - lag_ns)
    assert 'stepped back' in top.warnings[-1]
    top.tick(6 * S, newest + 2000 * S)
    assert -EPOCH_GRID_NS < top.stamp_ns - (newest + 2000 * S) <= 0, 'at the clock again'
