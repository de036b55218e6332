# SPDX-License-Identifier: Apache-2.0
"""What a tick does, on a clock of its own: late ticks, overload, pause, step, reset."""

from types import SimpleNamespace

import pytest
from spinning_top_sim.nodes.tick_loop import TickLoop

from spinning_top_sim.nodes import tick_loop
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation

TICK_NS = 5_000_000             # 200 Hz
POSE_NS = 10_000_000
SECOND = 1_000_000_000
BEGIN_NS = 77


class Clock:
    """A steady clock that stands still, or goes on a little whenever it is read."""

    def __init__(self):
        self.now_ns, self.step_ns = BEGIN_NS, 0

    def __call__(self):
        self.now_ns += self.step_ns
        return self.now_ns


class Run:
    """
    A loop, the steady clock it is on, and what came of it.

    stamps: of the poses recorded
    told: what the loop has said to its environment
    """

    def __init__(self, room=lambda: True, **values):
        given = {name.replace('__', '.'): value for name, value in values.items()}
        self.values = parameters.checked(given)
        self.clock, self.stamps, self.told = Clock(), [], []
        self.simulation = LiveSimulation(self.values)
        self.loop = TickLoop(
            self.simulation, self.values, SimpleNamespace(
                has_room=room, write_command=lambda *_: self.told.append('command'),
                write_event=lambda event, sent_ns=None, **_: self.told.append((event, sent_ns))),
            update_subscribers=lambda: self.told.append('subscribers'),
            warn=self.told.append, error=self.told.append, source=self.clock, steady=self.clock)

    @property
    def pose(self):
        return self.output('pose')

    def output(self, topic):
        return next(one for one in self.simulation.outputs if one.stream.topic == topic)

    def record(self):
        self.simulation.log_to(lambda entries: self.stamps.extend(
            stamp_ns for _, stamp_ns, _ in entries), [self.pose.stream])
        return self

    def tick(self, after_ns=TICK_NS, idle=True):
        """Tick once, so much later, and do the idle work that is asked for."""
        self.clock.now_ns += after_ns
        if self.loop.tick() and idle:
            self.loop.idle()

    def ticks(self, count, **options):
        for _ in range(count):
            self.tick(**options)
        return self


def started(**values):
    run = Run(**values).record()
    run.loop.start()
    return run


def grid(until_ns):
    return list(range(0, until_ns + 1, POSE_NS))


@pytest.mark.parametrize('idle', [False, True])
def test_ticks_send_all_that_is_due_however_late_they_come(idle):
    run = started()
    run.ticks(20, idle=idle)
    assert run.stamps == grid(20 * TICK_NS)
    run.tick(123_456_789, idle=idle)
    assert run.simulation.now_ns == 20 * TICK_NS + 123_456_789
    run.ticks(200, idle=idle)
    assert run.stamps == grid(run.simulation.now_ns)
    assert len(run.stamps) > 100


def test_late_and_skipped_ticks_are_counted():
    run = started()
    run.ticks(10)
    loop = run.loop
    assert (loop.late_ticks, loop.skipped_ticks) == (0, 0)
    run.tick(7_400_000)                             # not yet 1.5 periods
    assert (loop.late_ticks, loop.skipped_ticks) == (0, 0)
    run.tick(10_100_000)
    assert (loop.late_ticks, loop.skipped_ticks) == (1, 1)
    run.tick(50 * TICK_NS)
    assert (loop.late_ticks, loop.skipped_ticks) == (2, 1 + 49)


@pytest.mark.parametrize('ticks_meanwhile', [0, 3])
def test_a_pause_sends_what_is_due_holds_catches_nothing_up_and_makes_no_tick_late(
        ticks_meanwhile):
    run = started().ticks(4)
    run.clock.now_ns += 3_000_001
    run.loop.pause()
    at_ns = 4 * TICK_NS + 3_000_001
    assert run.loop.paused and run.loop.now_ns == at_ns
    run.ticks(ticks_meanwhile, after_ns=SECOND)
    run.clock.now_ns += 10 * SECOND
    run.loop.pause()
    assert run.loop.now_ns == at_ns
    run.loop.resume()
    run.loop.resume()
    run.ticks(5)
    assert run.loop.now_ns == at_ns + 5 * TICK_NS
    assert run.stamps == grid(at_ns + 5 * TICK_NS)
    assert run.loop.late_ticks == run.loop.skipped_ticks == 0


@pytest.mark.parametrize('time_scale', [1.0, 50.0])
def test_a_step_is_exact_also_after_a_pause_in_mid_run_while_clocks_go_on(time_scale):
    run = started(time_scale=time_scale)
    run.ticks(7)
    run.clock.step_ns = 1_333                       # any code takes time
    run.loop.pause()
    for length_ns in (210_000_000, 10_000_000, 333_333_333, 1):
        run.ticks(5)
        before = run.loop.now_ns
        run.loop.step(length_ns)
        run.ticks(5)
        assert run.loop.now_ns - before == length_ns
    run.loop.pause()
    run.loop.resume()
    run.ticks(3)
    assert run.stamps == grid(run.simulation.now_ns)


def test_a_step_that_takes_too_long_says_what_is_left(monkeypatch):
    monkeypatch.setattr(tick_loop, 'STEP_BUDGET_NS', 150_000)
    run = started(start_paused=True)
    run.clock.step_ns = 100_000
    with pytest.raises(RuntimeError, match=r'takes too long, \d\.\d+ s are left') as error:
        run.loop.step(10 * SECOND)
    now_ns = run.loop.now_ns
    assert 0 < now_ns < 10 * SECOND
    left = float(str(error.value).split()[-4])
    assert now_ns / SECOND + left == pytest.approx(10.0, abs=1e-8)
    run.ticks(3)
    assert run.loop.now_ns == now_ns
    assert run.stamps == grid(now_ns)
    run.loop.resume()
    with pytest.raises(RuntimeError, match='while paused'):
        run.loop.step(10 * SECOND)


LAST_S = 2 ** 31 - 1


def test_stamps_end_before_their_seconds_do_and_a_reset_says_why_not():
    run = started(solver__method='exact')
    run.simulation.epoch_ns = LAST_S * SECOND
    run.ticks(250)
    assert 'January 2038' in run.loop.failure
    assert max(run.stamps) == LAST_S * SECOND + 990_000_000
    failure = run.loop.failure
    with pytest.raises(ValueError, match='2038'):
        run.loop.reset(run.values, 0)
    assert run.loop.failure == failure


def test_the_duration_ends_with_its_last_sample_and_nothing_leads_on():
    run = started(duration=0.0723).ticks(100)
    assert run.loop.now_ns == 72_300_000
    for act in (run.loop.start, run.loop.pause, run.loop.resume, lambda: run.loop.fail('a test')):
        act()
        assert run.loop.state is tick_loop.LoopState.ENDED
    with pytest.raises(RuntimeError, match='`duration` are sent: nothing follows'):
        run.loop.reset(run.values, 0)
    assert run.loop.now_ns == 72_300_000 and not any(told[0] == 'reset' for told in run.told)
    assert run.ticks(5).stamps == grid(72_300_000)


@pytest.mark.parametrize('scale', [1, 2])
def test_a_clock_too_far_ahead_slips(scale):
    """By a second of real time; what the recording cannot take is computed later."""
    room = [True]
    run = Run(room=lambda: room[0], time_scale=float(scale)).record()
    run.loop.start()
    run.ticks(4)
    room[0] = False
    run.tick(900_000_000)
    assert run.loop.slipped_ns == 0
    assert run.loop.now_ns == scale * 4 * TICK_NS
    run.tick(200_000_000)
    assert run.loop.slipped_ns == scale * 1_100_000_000
    run.tick(1_200_000_000)
    assert run.loop.slipped_ns == scale * 2_300_000_000     # all together
    room[0] = True
    run.ticks(4)
    assert run.loop.now_ns == scale * 8 * TICK_NS
    assert run.stamps == grid(scale * 8 * TICK_NS)


def test_a_tick_gives_way_when_its_time_is_up(monkeypatch):
    monkeypatch.setattr(tick_loop, 'TICK_BUDGET_NS', 150_000)
    run = started(joint_states__rate=1000.0)
    run.output('joint_states').publish = len
    run.tick()
    run.clock.step_ns = 100_000
    run.tick(900_000_000)
    assert run.loop.now_ns < 900_000_000
    first = len(run.stamps)
    run.ticks(100)
    assert run.stamps == grid(run.simulation.now_ns)
    assert len(run.stamps) > first


def test_a_time_scale_holds_from_its_moment_on():
    run = started().ticks(4)
    assert run.loop.grid == (BEGIN_NS / 1e9, 0.005)
    run.loop.set_pace({**run.values, 'time_scale': 10.0})
    # Where t = 0 would have been at the new pace, so that ticks are aligned with samples.
    assert run.loop.grid == pytest.approx(((BEGIN_NS + 4 * TICK_NS - 2e6) / 1e9, 0.005), abs=0.0)
    run.tick()
    assert run.loop.now_ns == 4 * TICK_NS + 10 * TICK_NS


@pytest.mark.parametrize('time_scale', [1.0, 3.0])
def test_a_clock_that_steps_back_is_told_and_time_goes_on_from_where_it_is(time_scale):
    run = started(time_scale=time_scale).ticks(9)
    now_ns = run.loop.now_ns
    run.tick(after_ns=-30 * SECOND)
    assert run.loop.now_ns == now_ns
    run.ticks(6)
    assert run.loop.now_ns == now_ns + 6 * time_scale * TICK_NS
    assert sum('/clock stepped back by 30 s' in told for told in run.told) == 1
    assert run.stamps == grid(run.loop.now_ns)


def test_a_reset_begins_again_at_a_later_stamp_and_a_pause_remains():
    run = started().ticks(6)
    run.loop.reset(run.values, 0)
    assert run.simulation.epoch_ns == 40_000_000    # behind the sample of 6 ticks
    run = started().ticks(7)
    run.loop.reset(run.values, 0)
    assert run.simulation.epoch_ns == 40_000_000    # behind 7 ticks
    assert run.told[-1] == ('reset', 7 * TICK_NS)
    run.ticks(2)
    assert run.loop.now_ns == 2 * TICK_NS
    run.loop.pause()
    run.loop.reset(run.values, 7 * SECOND + 1)
    assert run.simulation.epoch_ns == 7 * SECOND + tick_loop.EPOCH_GRID_NS
    del run.stamps[:]
    run.loop.idle()                                 # idle work may come behind a reset
    run.ticks(3)
    assert run.loop.now_ns == 0 and run.loop.paused
    assert run.stamps == []


def test_equations_that_cannot_go_on_stop_the_motion_until_a_reset():
    euler = {'solver__equations': 'euler', 'initial__theta': 0.5, 'initial__theta_dot': -3.0,
             'spin__l3': 0.2, 'spin__lz': -0.2}
    run = started(**euler)
    run.ticks(400)
    stands_at = run.loop.now_ns
    assert 'pole' in run.loop.failure
    assert sum('until ~/reset' in told for told in run.told) == 1
    with pytest.raises(ValueError, match='stands still'):
        run.loop.command(1.0, 1.0)
    with pytest.raises(RuntimeError, match='stands still'):
        run.loop.step(POSE_NS)
    with pytest.raises(RuntimeError, match=r'stands still: .*pole'):
        run.loop.resume()
    run.ticks(5)
    assert run.loop.now_ns == stands_at
    run.loop.reset(parameters.checked({}), 0)
    assert run.loop.failure is None
    run.ticks(4)
    assert run.loop.now_ns == 4 * TICK_NS


def test_a_command_comes_after_what_is_due():
    run = started().ticks(4)
    run.clock.now_ns += 3_000_000
    run.loop.command(2.0, 1.0)
    assert run.simulation.history == [(23_000_000, 2.0, 1.0)]
    assert run.loop.commands == run.told.count('command') == 1
    with pytest.raises(ValueError, match='nan'):
        run.loop.command(float('nan'), 1.0)
    assert run.loop.commands == run.told.count('command') == 1


def test_of_the_velocities_in_twenty_milliseconds_the_last_one_counts():
    run = started()
    for number in range(1, 12):
        run.loop.drive((number, 0.0, 0.0))
        run.tick()
    assert [entry[:2] for entry in run.simulation.history] == [
        (5_000_000, 1.0), (25_000_000, 5.0), (45_000_000, 9.0)]
