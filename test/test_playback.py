# SPDX-License-Identifier: Apache-2.0
"""What a replay sends when, without ROS and with a clock of its own."""

import itertools
import threading
from fractions import Fraction

import pytest

from spinning_top_sim.nodes import playback
from spinning_top_sim.nodes.playback import Playback, read_ahead

EPOCH_NS = 1_700_000_000_123_456_789


class FakeTime:
    """A steady clock that stands, except while somebody sleeps."""

    def __init__(self):
        self.now_ns = 77
        self.at_rest = {}       # time: what to do when it has come
        self.sleeps = 0

    def monotonic_ns(self):
        return self.now_ns

    def wait(self, seconds):
        self.sleeps += 1
        for_ever = seconds == threading.TIMEOUT_MAX
        wanted = None if for_ever else self.now_ns + max(1, round(seconds * 1e9))
        planned = min(self.at_rest, default=None)
        if planned is not None and (wanted is None or planned <= wanted):
            self.now_ns = planned
            self.at_rest.pop(planned)()
        else:
            assert wanted is not None, 'sleeps for ever'
            self.now_ns = wanted

    def set(self):
        """Wake who waits: nobody else does while this runs."""

    clear = set


def play(messages, rate=1.0, plan=None, cost_ns=0, **options):
    """Play with a fake clock; return [(index, time from the start)] and the playback."""
    fake = FakeTime()
    sent = []

    def send(data):
        sent.append((int(data), fake.now_ns - 77))
        fake.now_ns += cost_ns

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(playback, 'time', fake)
        player = Playback(EPOCH_NS, **options)
        player._changed = fake
        player.set_rate(rate)
        fake.at_rest = {77 + at: (lambda act=act: act(player)) for at, act in (plan or {}).items()}
        player.run((at_ns, send, data) for at_ns, _, data in messages)
    return sent, player, fake


def messages_at(*offsets, send=None):
    return [(EPOCH_NS + offset, send, str(index).encode()) for index, offset in enumerate(offsets)]


@pytest.mark.parametrize('rate', [0.1, 3.0])
def test_every_message_has_its_own_deadline_from_the_start(rate):
    # Periods that no binary fraction is: rounding that added up would show at the end.
    offsets = [n * 3_333_333 for n in range(5_000)]
    sent, player, _ = play(messages_at(*offsets), rate)
    assert [index for index, _ in sent] == list(range(5_000))
    for (_, at), offset in zip(sent, offsets, strict=True):
        assert abs(at - Fraction(offset) / Fraction(rate)) <= 1
    assert player.late == 0


def test_what_is_late_is_sent_at_once_and_counted_and_later_deadlines_stay():
    cost = 30_000_000
    offsets = [0, 1_000_000, 2_000_000, 500_000_000]
    sent, player, _ = play(messages_at(*offsets), cost_ns=cost)
    assert sent == [(0, 0), (1, cost), (2, 2 * cost), (3, 500_000_000)]
    assert player.late == 2
    assert player.sent == 4


def test_a_pause_shifts_what_follows_and_catches_nothing_up():
    sent, player, _ = play(messages_at(0, 100, 200, 300), paused=True, plan={
        1_000: lambda p: p.pause(False), 1_150: lambda p: p.pause(True),
        5_000: lambda p: p.pause(True), 1_000_150: lambda p: p.pause(False)})
    assert [at for _, at in sent] == [1_000, 1_100, 1_000_200, 1_000_300]
    assert player.late == 0


def test_a_new_rate_holds_from_its_moment_on():
    sent, _, _ = play(messages_at(0, 1_000, 3_000), plan={1_500: lambda p: p.set_rate(0.5)})
    assert [at for _, at in sent] == [0, 1_000, 1_500 + 3_000]


def test_reading_ahead_is_bounded_in_order_and_ends():
    last = [0]

    def endless():
        for number in itertools.count():
            last[0] = number
            yield number, 0, b'x' * 100

    ahead = read_ahead(endless())
    first = list(itertools.islice(ahead, 1_000))
    assert [number for number, _, _ in first] == list(range(1_000))
    ahead.close()
    assert last[0] < 1_000 + (playback.BATCHES + 3) * playback.BATCH_MESSAGES
