# SPDX-License-Identifier: Apache-2.0
"""
A simulated world: the node's loop, the recorder and its log, on a machine that does not exist.

A seed decides what happens, and in which order: late and lost ticks, dates and a /clock that jump,
commands, subscribers that come, go and stall, faults of the disk, a kill, a power cut.  Afterwards
`simulate` computes the history again, and all that was sent or promised is compared with it.
"""

import contextlib
import functools
import random
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from typing import Any
from unittest import mock

from helpers.machine import MILLISECOND, SECOND, Disk, Fault, Killed, Machine
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.loop import Loop, LoopState
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.physics.top import State
from spinning_top_sim.recording import recorder as recorder_module
from spinning_top_sim.recording.recorder import Recorder
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.topics import resolve_topic

DATE_NS, SOURCE_NS = 1_700_000_000 * SECOND, 500 * SECOND
QUIET_MS = 60               # at the end, in which nothing happens
QUEUE_BYTES = 20_000        # of the recorder, so that it is full sooner
MOST_QUEUED = 10_000        # messages: a chunk, the queue, and what one tick may add


@dataclass
class Log:
    """What was recorded, and what became of it."""

    path: Any
    recorder: Recorder
    channels: tuple
    handed: list = field(default_factory=list)      # times, and messages by topic until then
    begins: dict = field(default_factory=dict)      # by topic, the number of the first message
    ends: dict = field(default_factory=dict)
    events: list = field(default_factory=list)      # times, and events


class Observed(LiveSimulation):
    """A live simulation that tells a world what is done to it."""

    def __init__(self, world, values):
        super().__init__(values, clock=world.read_clock_s)
        self._world = world

    def apply(self, kind, **details):
        event = super().apply(kind, **details)
        self._world.note(event.sent_ns, 'event', event)
        return event

    def log_to(self, write, channels=()):
        world = self._world
        if write is None:
            world.note(self.now_ns, 'log_ends', world.logs[-1])
            super().log_to(None)
            return
        log = Log(world.path, write.__self__, tuple(one.topic for one in channels))
        world.logs.append(log)
        world.note(self.now_ns, 'log_begins', log)

        def written(entries):
            counts = Counter(log.handed[-1][1] if log.handed else ())
            for number, stamps_ns, _ in entries:
                counts[log.channels[number]] += len(stamps_ns)
            log.handed.append((world.machine.now_ns, counts))
            write(entries)

        super().log_to(written, channels)


class World:
    """One run of a plan.  `run` raises an AssertionError for whatever is not as promised."""

    def __init__(self, plan, folder):
        self.plan, self._folder = plan, folder
        self.machine = machine = Machine(random.Random(plan.seed))
        self._begin_ns = machine.now_ns
        self.values = parameters.checked(plan.values)
        self.journal, self.logs, self.heard, self.told = [], [], defaultdict(list), []
        self.answers, self.asked, self.order = [], 0, []
        self._listeners = {}                    # whether they stall, by topic
        self._lost_ticks = self._cost_ns = self._cost_until_ns = 0
        self._date_ns = self._jump_ns = self._stops_at_ns = 0
        self._lag_ns = None                     # of a second /clock
        self._is_second, self._steered, self.was_full = False, (), False
        self.path, self.is_over, self.deleted = None, False, set()
        self.disk = Disk(machine, plan.kill_at, is_slow=plan.is_slow)
        self.simulation = Observed(self, self.values)
        self.start = dict(self.values), parameters.start_state(self.values).lz
        self.recording = Recording(self.simulation, self._topics, threads=machine,
                                   clock=machine.clock)
        follows = plan.follows
        self.loop = Loop(
            self.simulation, self.values, self.recording,
            SimulatedClock(self._source if follows else self._date, self.told.append,
                           (lambda: 1 + (self._lag_ns is not None)) if follows else None,
                           self.read_clock_ns),
            error=self.told.append, update_subscribers=self._update_subscribers)

    def note(self, *what):
        self.journal.append((self.machine.now_ns, *what))

    # -------------------------------------------------------------------------- its clocks

    def read_clock_ns(self):
        """Return steady time; while the machine is slow, that takes time."""
        if self.machine.now_ns < self._cost_until_ns:
            self.machine.sleep(self._cost_ns)
        return self.machine.now_ns

    def read_clock_s(self):
        return self.read_clock_ns() / SECOND

    def _date(self):
        return DATE_NS + self.machine.now_ns - self._begin_ns + self._date_ns

    def _source(self):
        now_ns = self.machine.now_ns
        if now_ns < self._stops_at_ns:          # it stands until then
            now_ns = self._stands_since_ns
        at_ns = now_ns - self._begin_ns + self._jump_ns
        self._is_second = not self._is_second
        if self._lag_ns is not None and self._is_second:
            at_ns -= self._lag_ns
        return max(SOURCE_NS + at_ns - at_ns % (5 * MILLISECOND), 1)

    # -------------------------------------------------------------------- what may happen

    def busy(self, duration_ms):
        self.machine.sleep(duration_ms * MILLISECOND)

    def lose_ticks(self, count):
        self._lost_ticks = count

    def double_tick(self):
        self._tick()
        self._tick()

    def slow_clock(self, cost_us, duration_ms):
        self._cost_ns = cost_us * 1000
        self._cost_until_ns = self.machine.now_ns + duration_ms * MILLISECOND

    def step_date(self, by_ms):
        self._date_ns += by_ms * MILLISECOND

    def stop_source(self, duration_ms):
        now_ns = self.machine.now_ns
        if now_ns >= self._stops_at_ns:
            self._stands_since_ns, self._stops_at_ns = now_ns, now_ns + duration_ms * MILLISECOND

    def jump_source(self, by_ms):
        self._jump_ns += by_ms * MILLISECOND

    def second_source(self, lag_ms):
        self._lag_ns = None if self._lag_ns is not None else lag_ms * MILLISECOND

    def command(self, l3, lz):
        self.loop.change('command', lambda: {'l3': l3, 'lz': lz})

    def put(self, theta, l3, lz):
        self.loop.change('state', lambda: asdict(State(theta=theta, l3=l3, lz=lz)))

    def drive(self, *velocity):
        self.loop.change('drive', lambda: self.simulation.drive_details(velocity))

    def steer(self, *velocity):
        """Ask for a velocity at each tick from now on, or no more."""
        self._steered = velocity

    def pause(self):
        self.loop.pause()

    def resume(self):
        self.loop.resume()

    def step(self, length_ns):
        self.loop.step(length_ns)

    def reset(self, paused):
        self.loop.reset({**self.values, 'spin.l3': self.start[0]['spin.l3'],
                         'spin.lz': self.start[0]['spin.lz']}, paused)

    def change(self, changes):
        values = {**self.values, **changes}
        self.loop.set_parameters(values, changes)
        self.values = values

    def start_recording(self):
        self.path = self._folder / f'run_{self.asked}.mcap'
        self.asked += 1
        self.recording.start({**self.values, 'record.uri': self.path.name},
                             lambda *answer: self.answers.append(answer))

    def stop_recording(self):
        self.asked += 1
        self.recording.end(lambda *answer: self.answers.append(answer))

    def listen(self, topic):
        self._listeners[topic] = False

    def leave(self, topic):
        self._listeners.pop(topic, None)

    def stall(self, topic):
        self._listeners[topic] = True

    def fault(self, call, kind, value, part):
        self.disk.faults.append(Fault(call, kind, value, part))

    def fill_disk(self, room):
        self.disk.size = self.disk.largest + room

    def delete_log(self):
        if self.path is not None:
            self.disk.delete(self.path)
            self.deleted.add(self.path)

    # ------------------------------------------------------------------------ the executor

    def run(self):
        """Run the plan."""
        with self.disk, mock.patch.object(recorder_module, 'QUEUE_BYTES', QUEUE_BYTES):
            self.machine.run(self._live)
        self.was_killed = not self.is_over

    def _live(self):
        self.loop.start()
        self.epoch_ns = self.simulation.epoch_ns
        for action in self.plan.actions:
            self._tick_until(self._begin_ns + action.at_ms * MILLISECOND)
            with contextlib.suppress(ValueError, RuntimeError):
                getattr(self, action.name)(*action.arguments)
                if action.name in ('command', 'put'):
                    self._check_time()
        end_ns = max(self.machine.now_ns, self._begin_ns + self.plan.ends_ms * MILLISECOND)
        self._tick_until(end_ns)
        if self.plan.ends != 'close':
            raise Killed
        self._be_quiet()
        began_ns = self.machine.now_ns
        self.recording.close()
        assert self.machine.now_ns - began_ns <= 25 * SECOND, 'a disk hangs the end'
        for log in self.logs:
            is_closed = log.recorder.state in ('closed', 'failed')
            assert is_closed or self.disk.is_disturbed, 'a log is closed'
            said = log.recorder.close(0.0).error or ''
            assert is_closed or f'{log.path.name} could not be closed within' in said
        self.is_over = True

    def _tick_until(self, until_ns):
        """Tick as a timer of rclpy does: on a grid, and what is long past is left out."""
        machine = self.machine
        while True:
            period_ns = int(self.loop.tick_period_ns)
            next_ns = machine.now_ns - machine.now_ns % period_ns + period_ns
            if next_ns > until_ns:
                machine.sleep(max(until_ns - machine.now_ns, 0))
                return
            machine.sleep(next_ns - machine.now_ns)
            if self._lost_ticks:
                self._lost_ticks -= 1
            else:
                self._tick()

    def _tick(self):
        if self._steered and self.loop.state is LoopState.RUNNING:
            self.drive(*self._steered)
        self.loop.tick()
        self._check_time()
        self.recording.check()
        for log in self.logs:
            assert log.recorder.counters.queued <= MOST_QUEUED
        if self.recording.is_on:
            recorder = self.logs[-1].recorder
            is_slow = recorder.possible_loss > self.values['record.max_loss']
            warning = self.recording.warning or ''
            name = self.logs[-1].path.name
            assert is_slow == (f'{name} is slow: a power loss would' in warning)
            assert self.disk.is_disturbed or not is_slow, 'an undisturbed disk is not slow'

    def _check_time(self):
        """Where nothing holds the loop up, all is sent that is due, and no more."""
        loop = self.loop
        self.was_full |= not self.recording.has_room()
        assert (loop.state is LoopState.FAILED) == (loop.failure is not None)
        if (self.plan.is_calm and loop.state is LoopState.RUNNING
                and not self.was_full and self.recording.has_room()):
            date_ns = DATE_NS + self.machine.now_ns - self._begin_ns
            due_ns = int((date_ns - self.epoch_ns) * self.values['time_scale'])
            assert abs(loop.now_ns - max(due_ns, 0)) <= 2, 'what is due is sent'

    def _be_quiet(self):
        """What is due is sent, by the clock alone, once all is quiet again."""
        machine, loop = self.machine, self.loop
        self._listeners = dict.fromkeys(self._listeners, False)
        self._lost_ticks = 0
        settled_ns = max(machine.now_ns, self._cost_until_ns, self._stops_at_ns)
        self._tick_until(settled_ns + QUIET_MS * MILLISECOND)
        if loop.state is not LoopState.RUNNING or self.plan.follows:
            return
        before_ns, began_ns, held = loop.now_ns, machine.now_ns, not self.recording.has_room()
        self._tick_until(began_ns + QUIET_MS * MILLISECOND)
        if loop.state is LoopState.RUNNING and not held and self.recording.has_room():
            passed_ns = (machine.now_ns - began_ns) * self.values['time_scale']
            period_ns = 2 * loop.tick_period_ns * self.values['time_scale']
            assert abs(loop.now_ns - before_ns - passed_ns) <= period_ns, 'time goes on'

    def _update_subscribers(self):
        changed = False
        for output in self.simulation.outputs:
            topic = output.channel.topic
            wanted = topic in self._listeners
            if wanted != (output.publish is not None):
                self.note(self.simulation.now_ns, 'listen' if wanted else 'leave', (
                    topic, *self.counts(output)))
                output.publish = functools.partial(self._publish, topic) if wanted else None
                changed = True
        if changed:
            self.simulation.refresh()

    def counts(self, output):
        """Return how many messages were heard, sent, and not sent."""
        return (len(self.heard[output.channel.topic]), output.sent,
                output.skipped + output.failed)

    def _publish(self, topic, data):
        if self._listeners.get(topic):
            self.machine.sleep(100 * MILLISECOND)
            raise RuntimeError('a reader stalls')
        self.heard[topic].append(data)
        self.order.append(topic)

    def _topics(self, channels):
        return [(resolve_topic(name, '/'), type_name, {}) for name, type_name in (
            *((one.topic, one.type_name) for one in channels), *events.TOPICS.items())]
