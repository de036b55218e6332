# SPDX-License-Identifier: Apache-2.0
"""What a replay sends when, without ROS and with a clock of its own."""

import math
from fractions import Fraction

import pytest

from spinning_top_sim.nodes.playback import Playback

EPOCH_NS = 1_700_000_000_123_456_789


def play(offsets, rate=1.0, plan=None, cost_ns=0, fails=(), paused=False):
    """
    Play messages with a clock that stands except for a wait and `cost_ns` of a message.

    plan : by time, what is done then
    Returns [(index, time from the start)] and the playback.
    """
    now, sent, plan = [77], [], {77 + at: act for at, act in (plan or {}).items()}

    def send(data):
        now[0] += cost_ns
        if data in fails:
            raise RuntimeError('a reader has stalled')
        sent.append((data, now[0] - 77 - cost_ns))

    player = Playback(EPOCH_NS, lambda: now[0])
    player.go_on(rate, paused)
    for left_ns in player.play(EPOCH_NS, ((EPOCH_NS + offset, send, index)
                                          for index, offset in enumerate(offsets))):
        until = math.inf if left_ns == math.inf else now[0] + math.ceil(left_ns)
        planned = min(plan, default=math.inf)
        now[0] = min(until, planned)
        if planned <= until:
            plan.pop(planned)(player)
    return sent, player


@pytest.mark.parametrize('rate', [0.1, 3.0])
def test_every_message_has_its_own_deadline_from_the_start(rate):
    # Periods that no binary fraction is: rounding that added up would show at the end.
    offsets = [n * 3_333_333 for n in range(5_000)]
    sent, player = play(offsets, rate)
    assert [index for index, _ in sent] == list(range(5_000))
    for (_, at), offset in zip(sent, offsets, strict=True):
        assert 0 <= at - Fraction(offset) / Fraction(rate) <= 8, 'never before its time'
    assert player.late == 0


def test_what_is_late_is_sent_at_once_and_counted_and_later_deadlines_stay():
    cost = 30_000_000
    sent, player = play([0, 1_000_000, 2_000_000, 500_000_000], cost_ns=cost)
    assert sent == [(0, 0), (1, cost), (2, 2 * cost), (3, 500_000_000)]
    assert (player.sent, player.late, player.failed) == (4, 2, 0)


def test_a_message_that_cannot_be_published_is_counted_and_the_others_are_played():
    sent, player = play([0, 10, 20], fails=[1])
    assert [index for index, _ in sent] == [0, 2]
    assert (player.sent, player.failed) == (2, 1)


def test_a_pause_shifts_what_follows_and_catches_nothing_up():
    sent, player = play([0, 100, 200, 300], paused=True, plan={
        1_000: lambda p: p.go_on(1.0, False), 1_150: lambda p: p.go_on(1.0, True),
        5_000: lambda p: p.go_on(1.0, True), 1_000_150: lambda p: p.go_on(1.0, False)})
    assert [at for _, at in sent] == [1_000, 1_100, 1_000_200, 1_000_300]
    assert player.late == 0


def test_a_new_rate_holds_from_its_moment_on():
    sent, _ = play([0, 1_000, 3_000], plan={1_500: lambda p: p.go_on(0.5, False)})
    assert [at for _, at in sent] == [0, 1_000, 1_500 + 3_000]


def test_one_call_sends_for_20_ms_at_most_so_that_services_have_their_turn():
    now = [0]

    def send(_):
        now[0] += 1_000_000

    player = Playback(EPOCH_NS, lambda: now[0])
    assert next(player.play(EPOCH_NS, ((EPOCH_NS, send, b'') for _ in range(1_000)))) == 0.0
    assert 20 <= player.sent <= 22
    assert player.now_ns == EPOCH_NS
