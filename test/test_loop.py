# SPDX-License-Identifier: Apache-2.0
"""What a tick does, on a clock of its own: late ticks, overload, pause, step, reset."""

from types import SimpleNamespace

import pytest
from helpers.simulations import SECOND, channel, simulate

from spinning_top_sim.nodes import loop as module
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.loop import Loop, LoopState

TICK_NS, POSE_NS = 5_000_000, 10_000_000        # 200 Hz, 100 Hz
DATE_NS = 1_700_000_000 * SECOND                # on the grid of the stamps


class Run:
    """
    A loop that has started, on a steady clock that goes on by `step_ns` whenever it is read.

    times: of the poses recorded since the start or the last reset
    told: warnings, errors and events
    """

    def __init__(self, follows=False, **values):
        self.now_ns, self.step_ns, self.room, self.told = 77, 0, True, []
        self.counted = 0            # how often subscribers were
        self.simulation = simulate(**values)
        self.values, self._taken = self.simulation.values_at_start, []
        recording = SimpleNamespace(has_room=lambda *_: self.room, is_on=True,
                                    write=self.told.append)
        self.loop = Loop(
            self.simulation, self.values, recording, SimulatedClock(
                lambda: DATE_NS + self.now_ns - 77, self.told.append, follows=follows,
                steady=self.read),
            update_subscribers=self.count, error=self.told.append)
        self.simulation.log_to(lambda entries: self._taken.extend(
            stamp_ns for _, stamps_ns, _ in entries for stamp_ns in stamps_ns.tolist()),
            [channel(self.simulation, 'pose')])
        self.loop.start()

    def count(self):
        self.counted += 1

    def read(self):
        self.now_ns += self.step_ns
        return self.now_ns

    @property
    def times(self):
        return [stamp_ns - self.simulation.epoch_ns for stamp_ns in self._taken
                if stamp_ns >= self.simulation.epoch_ns]

    @property
    def kinds(self):
        return [event.kind for event in self.told if not isinstance(event, str)]

    def tick(self, after_ns=TICK_NS):
        self.now_ns += after_ns
        self.loop.tick()

    def ticks(self, count):
        for _ in range(count):
            self.tick()
        return self

    def command(self, l3):
        self.loop.change('command', lambda: {'l3': l3, 'lz': 1.0})


def grid(until_ns, period_ns=POSE_NS):
    return list(range(0, until_ns + 1, period_ns))


def test_ticks_send_all_that_is_due_however_late_they_come_and_late_ones_are_counted():
    run = Run().ticks(20)
    loop = run.loop
    assert run.times == grid(20 * TICK_NS)
    run.tick(7_400_000)                             # not yet 1.5 periods
    assert (loop.late_ticks, loop.skipped_ticks) == (0, 0)
    run.tick(10_100_000)
    run.tick(50 * TICK_NS)
    assert (loop.late_ticks, loop.skipped_ticks) == (2, 1 + 49)
    assert run.simulation.now_ns == 20 * TICK_NS + 7_400_000 + 10_100_000 + 50 * TICK_NS
    assert run.times == grid(run.simulation.now_ns)


def test_a_pause_holds_a_step_is_exact_and_nothing_is_caught_up(monkeypatch):
    """While clocks go on; a step that takes too long says what is left."""
    run = Run(time_scale=50.0).ticks(7)
    with pytest.raises(RuntimeError, match='while paused'):
        run.loop.step(SECOND)
    run.now_ns += 3_000_001
    run.loop.pause()
    assert run.simulation.now_ns == 50 * (7 * TICK_NS + 3_000_001)
    run.step_ns = 1_333                             # any code takes time
    for length_ns in (210_000_000, 333_333_333, 1):
        run.tick(SECOND)
        before = run.simulation.now_ns
        run.loop.step(length_ns)
        assert run.simulation.now_ns - before == length_ns
    assert run.loop.state is LoopState.PAUSED
    monkeypatch.setattr(module, 'STEP_BUDGET_NS', 150_000)
    run.step_ns, before = 100_000, run.simulation.now_ns
    with pytest.raises(RuntimeError, match=r'takes too long, [\d.]+ s are left') as error:
        run.loop.step(1000 * SECOND)
    left, done_ns = float(str(error.value).split()[-4]), run.simulation.now_ns - before
    assert 0.0 < left == pytest.approx(1000.0 - done_ns / SECOND, abs=1e-6)
    run.step_ns, before = 0, run.simulation.now_ns
    run.loop.resume()
    run.loop.resume()
    assert run.ticks(3).simulation.now_ns == before + 50 * 3 * TICK_NS
    assert run.times == grid(run.simulation.now_ns)
    assert run.loop.late_ticks == run.loop.skipped_ticks == 0


def test_the_last_sample_is_that_of_the_duration_to_the_nanosecond():
    run = Run(duration=1.001, pose__rate=1000.0).ticks(202)      # 1.001e9 is no double
    assert run.times == grid(1_001_000_000, SECOND // 1000) and run.loop.state is LoopState.ENDED


def test_a_change_of_parameters_does_not_hide_a_jump_of_the_clock():
    run = Run(follows=True).ticks(4)
    run.now_ns += 3600 * SECOND
    run.loop.set_parameters(run.values, {'status_period': 0.5})
    assert (run.ticks(2).kinds, run.simulation.now_ns) == (['epoch', 'parameters'], 6 * TICK_NS)


def test_what_a_tick_has_no_time_or_room_for_comes_later_and_a_clock_too_far_ahead_slips(
        monkeypatch):
    """By a second of real time."""
    scale = 2.0
    monkeypatch.setattr(module, 'TICK_BUDGET_NS', 50_000)
    run = Run(time_scale=scale, pose__rate=1000.0).ticks(4)
    run.step_ns = 100_000
    run.tick(900_000_000)
    assert run.simulation.now_ns < scale * 900_000_000
    run.step_ns = 0
    assert run.ticks(10).simulation.now_ns > scale * 900_000_000 and run.loop.slipped_ns == 0
    run.room, stands_at = False, run.simulation.now_ns
    run.tick(900_000_000)
    run.tick(200_000_000)
    assert (run.simulation.now_ns, run.loop.slipped_ns) == (stands_at, scale * 1_100_000_000)
    run.room = True
    assert run.ticks(4).simulation.now_ns == stands_at + scale * 4 * TICK_NS
    assert run.times == grid(run.simulation.now_ns, SECOND // 1000)


def test_a_reset_begins_again_at_a_later_stamp_and_a_pause_remains():
    run = Run().ticks(6)
    with pytest.raises(ValueError, match=r'1e\+20'):        # and nothing changes
        run.loop.reset({**run.values, 'spin.l3': 1e20}, paused=True)
    assert run.simulation.epoch_ns == DATE_NS
    run.loop.reset(run.values)
    assert run.simulation.epoch_ns == DATE_NS + 40_000_000      # behind the sample at 30 ms
    assert run.ticks(2).simulation.now_ns == 0, 'its date comes first'
    assert run.ticks(2).simulation.now_ns == 2 * TICK_NS and run.times == grid(2 * TICK_NS)
    run.loop.pause()
    run.loop.reset(run.values)
    counted = run.ticks(30).counted
    assert (run.simulation.now_ns, run.times, run.kinds) == (0, [], ['reset', 'reset'])
    run.command(2.0)
    assert run.counted > counted and run.times == [0], 'a change sends it to those there'
    run.loop.reset(run.values, paused=False)
    assert run.ticks(4).loop.state is LoopState.RUNNING


FAILING = {
    'pole': {'solver__equations': 'euler', 'initial__theta': 0.5, 'initial__theta_dot': -3.0,
             'spin__l3': 0.2, 'spin__lz': -0.2},
    # At the edge of a piece of the path the pivot turns too fast for this top.
    'no motion from t = 0.05 s on': {
        'pivot__path': (0.05, 0.0, 0.0, 0.0, 0.001, 1e5, 0.0, 0.0), 'top__lambda1': 1e-9,
        'top__lambda3': 1e-9, 'spin__l3': 0.0, 'solver__method': 'exact'}}


@pytest.mark.parametrize('reason', FAILING)
def test_a_motion_that_cannot_go_on_stands_until_a_reset(reason):
    run = Run(**FAILING[reason]).ticks(400)
    stands_at = run.simulation.now_ns
    assert reason in run.loop.failure and run.loop.state is LoopState.FAILED
    assert run.times == grid(stands_at)
    assert sum('until ~/reset' in told for told in run.told) == 1
    for act in (lambda: run.command(1.0), lambda: run.loop.step(POSE_NS), run.loop.resume):
        with pytest.raises((ValueError, RuntimeError), match=f'stands still: .*{reason}'):
            act()
    with pytest.raises(ValueError, match='2038'):       # a reset that is refused leads nowhere
        run.loop.reset({**run.values, 'duration': 1e10})
    assert run.loop.state is LoopState.FAILED
    assert run.ticks(5).simulation.now_ns == stands_at
    run.loop.reset(simulate().values_at_start)
    assert run.loop.failure is None and run.ticks(404).simulation.now_ns > stands_at
    run.simulation.log_to(None)         # also where nobody takes messages
    run.loop.reset(run.values)
    assert reason in run.ticks(400).loop.failure and run.simulation.now_ns == stands_at
