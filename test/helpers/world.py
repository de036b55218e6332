# SPDX-License-Identifier: Apache-2.0
"""
A simulated world: the node's loop, the recorder and its log, on a machine that does not exist.

A plan, which a seed decides, says what happens: late and lost ticks, dates and a /clock that jump,
commands, subscribers that come, go and stall, faults of the disk, a kill, a power cut.
"""

import contextlib
import itertools
import random
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

from helpers.machine import MILLISECOND, SECOND, Disk, Fault, Killed, Machine
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.loop import Loop, LoopState
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.physics.top import State
from spinning_top_sim.recording import recorder, writer
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.live import LiveSimulation, Output
from spinning_top_sim.streams.topics import resolve_topic

DATE_NS, SOURCE_NS = 1_700_000_000 * SECOND, 500 * SECOND
FASTEST = 3e4               # [rad/s]; the steps and the increments of faster motions take minutes
QUIET_NS = 63 * MILLISECOND     # at the end, in which nothing happens; it ends between ticks
QUEUE_BYTES = 20_000        # of the recorder, so that it is full sooner
MOST_QUEUED = 10_000        # messages: a chunk, the queue, and what one tick may add
NO_EXIT = SimpleNamespace(register=lambda act: None, unregister=lambda act: None)


class Place(NamedTuple):
    """How far a run has come: how many resets, up to which time messages are sent, and events."""

    motion: int
    sent_ns: int
    events: int


class Log(recorder.Recorder):
    """A recorder that keeps what it is handed, and from where to where in the run."""

    def __init__(self, uri, topics, metadata, *, world, **options):
        self.names, self._world = [topic.name for topic in topics], world
        self.file = Path(uri).absolute()
        self.handed = []            # steady time [ns], topic, log time [ns] and data of each,
        self.boundaries = {0}       # and how many there were after a call of `write`
        self.begins, self.ends = world.place, None
        world.logs.append(self)
        super().__init__(uri, topics, lambda: world.machine.sleep(5 * MILLISECOND) or metadata(),
                         **options)

    def write(self, rows):
        for number, stamps_ns, messages in rows:
            self.handed += [
                (self._world.machine.now_ns, self.names[number], stamp_ns, data.tobytes())
                for stamp_ns, data in zip(stamps_ns.tolist(), messages, strict=True)]
        self.boundaries.add(len(self.handed))
        super().write(rows)

    def end(self):
        self.ends = self.ends or self._world.place
        super().end()


@dataclass
class Reader:
    """A subscriber while it listens."""

    world: Any
    output: Output
    begins: Place
    ends: Place | None = None
    heard: list = field(default_factory=list)       # numbers in the order of all, and data

    def __call__(self, data):
        if self.world.wanted.get(self.output.channel.topic) == 'stalled':
            self.world.machine.sleep(100 * MILLISECOND)
            raise RuntimeError('a reader stalls')
        self.heard.append((next(self.world.numbers), data))


class World:
    """One run of a plan.  `run` raises an AssertionError for whatever is not as promised."""

    def __init__(self, plan, folder):
        self.plan, self._folder = plan, folder
        self.machine = machine = Machine(random.Random(plan.seed))
        self._begin_ns = machine.now_ns
        self.values = self._start = parameters.checked(plan.values)
        self.events, self.logs, self.readers, self.numbers = [], [], [], itertools.count()
        self.answers, self.asked = [], 0
        self.wanted = {}                        # by topic of a subscriber: 'heard' or 'stalled'
        self._is_too_fast = False
        self._lost_ticks = self._cost_ns = self._cost_until_ns = 0
        self._date_ns = self._jump_ns = self._stops_at_ns = 0
        self._drives, self.was_full, self.was_killed = [], False, True
        self.disk = Disk(machine, plan.kill_at, is_slow=plan.is_slow)
        self.simulation = LiveSimulation(self.values, clock=self._seconds)
        self.simulation.apply = self._apply
        self.recording = Recording(self.simulation, self._topics, threads=machine,
                                   clock=machine.clock, world=self)
        follows = plan.follows
        self.loop = Loop(
            self.simulation, self.values, self.recording,
            SimulatedClock(self._source if follows else self._date, str,
                           follows=follows, steady=self._steady),
            error=str, update_subscribers=self._update_subscribers)

    @property
    def place(self):
        return Place(sum(event.kind == 'reset' for event in self.events),
                     self.simulation.sent_ns, len(self.events))

    def _apply(self, kind, **details):
        event = LiveSimulation.apply(self.simulation, kind, **details)
        self.events.append(event)
        self._is_too_fast = self.simulation.trajectory.after(event.t_ns).fastest_rate > FASTEST
        return event

    # -------------------------------------------------------------------------- its clocks

    def _steady(self):
        """Return steady time [ns]; while the machine is slow, that takes time."""
        if self.machine.now_ns < self._cost_until_ns:
            self.machine.sleep(self._cost_ns)
        return self.machine.now_ns

    def _seconds(self):
        return self._steady() / SECOND

    def _date(self):
        return DATE_NS + self.machine.now_ns - self._begin_ns + self._date_ns

    def _source(self):
        now_ns = self.machine.now_ns
        if now_ns < self._stops_at_ns:          # it stands until then
            now_ns = self._stands_since_ns
        at_ns = now_ns - self._begin_ns + self._jump_ns
        return max(SOURCE_NS + at_ns - at_ns % (5 * MILLISECOND), 1)

    # -------------------------------------------------------------------- what may happen

    def busy(self, duration_ms, cost_us):
        """Do nothing for a time; as long again, each reading of the clock takes so long."""
        self.machine.sleep(duration_ms * MILLISECOND)
        self._cost_ns = cost_us * 1000
        self._cost_until_ns = self.machine.now_ns + duration_ms * MILLISECOND

    def lose_ticks(self, count):
        self._lost_ticks = count

    def step_date(self, by_ms):
        self._date_ns += by_ms * MILLISECOND

    def stop_source(self, duration_ms):
        now_ns = self.machine.now_ns
        if now_ns >= self._stops_at_ns:
            self._stands_since_ns, self._stops_at_ns = now_ns, now_ns + duration_ms * MILLISECOND

    def jump_source(self, by_ms):
        self._jump_ns += by_ms * MILLISECOND

    def command(self, l3, lz):
        self.loop.change('command', lambda: {'l3': l3, 'lz': lz})
        self._check_time()

    def put(self, theta, l3, lz):
        self.loop.change('state', lambda: asdict(State(theta=theta, l3=l3, lz=lz)))
        self._check_time()

    def drive(self, count, *velocity):
        """Ask for a velocity, and so often again at each tick."""
        self.loop.change('drive', lambda: self.simulation.drive_details(velocity))
        self._drives = count * [velocity]

    def reset(self, paused):
        momenta = {name: self._start[name] for name in ('spin.l3', 'spin.lz')}
        was_on = self.recording.is_on
        self.loop.reset({**self.values, **momenta}, paused)
        assert was_on == self.recording.is_on or 'gone back' in self.recording.error

    def change(self, changes):
        values = {**self.values, **changes}
        self.loop.set_parameters(values, changes)
        self.values = values

    def start_recording(self):
        path = self._folder / f'run_{self.asked}.mcap'
        self.asked += 1
        self.recording.start({**self.values, 'record.uri': path.name}, self._answer)

    def stop_recording(self):
        self.asked += 1
        ended = self.logs[-1:] if self.recording.is_on else []

        def answer(*said):
            assert all(log.state in ('closed', 'failed') for log in ended), 'too early'
            self._answer(*said)

        self.recording.end(answer)

    def _answer(self, *answer):
        self.answers.append(answer)

    def listen(self, topic):
        self.wanted[topic] = 'heard'

    def leave(self, topic):
        self.wanted.pop(topic, None)

    def stall(self, topic):
        self.wanted[topic] = 'stalled'

    def fault(self, *what):
        self.disk.faults.append(Fault(*what))

    def fill_disk(self, room):
        self.disk.room = room

    # ------------------------------------------------------------------------ the executor

    def run(self):
        """Run the plan."""
        chunk = mock.patch.object(writer, 'CHUNK_BYTES', 10 ** (3 + self.plan.seed % 3))
        with (chunk, self.disk, mock.patch.multiple(
                recorder, atexit=NO_EXIT, QUEUE_BYTES=QUEUE_BYTES, Recorder=Log)):
            self.machine.run(self._live)
        for one in (*self.readers, *self.logs):
            one.ends = one.ends or self.place

    def _live(self):
        self.loop.start()
        self.epoch_ns = self.simulation.epoch_ns
        for action in self.plan.actions:
            self._tick_until(self._begin_ns + action.at_ms * MILLISECOND)
            with contextlib.suppress(ValueError, RuntimeError):
                act = getattr(self, action.name, None) or getattr(self.loop, action.name)
                act(*action.arguments)
        ends_ns = self._begin_ns + self.plan.ends_ms * MILLISECOND
        self._tick_until(max(self.machine.now_ns, ends_ns))
        if self.plan.ends != 'close':
            raise Killed
        self._be_quiet()
        began_ns = self.machine.now_ns
        self.recording.close()
        assert self.machine.now_ns - began_ns <= 25 * SECOND, 'a disk hangs the end'
        for log in self.logs:
            log.close()         # as the end of the interpreter waits for it
            said = log.error or ''
            is_closed = log.state in ('closed', 'failed')
            assert is_closed or self.disk.is_disturbed, 'a log is closed'
            assert is_closed or f'{log.file.name} could not be closed within' in said
        if all(log.state in ('closed', 'failed') for log in self.logs):
            assert len(self.answers) == self.asked, 'each request is answered once'
        self.was_killed = False

    def _tick_until(self, until_ns):
        """Tick as a timer of rclpy does: on a grid, and what is long past is left out."""
        machine = self.machine
        while True:
            if self._is_too_fast:       # also before an action, which may send what is due
                raise Killed
            period_ns = int(self.loop.tick_period_ns)
            next_ns = machine.now_ns - machine.now_ns % period_ns + period_ns
            machine.sleep(max(min(next_ns, until_ns) - machine.now_ns, 0))
            if next_ns > until_ns:
                return
            if self._lost_ticks:
                self._lost_ticks -= 1
            else:
                self._tick()

    def _tick(self):
        if self._drives and self.loop.state is LoopState.RUNNING:
            with contextlib.suppress(ValueError, RuntimeError):     # the motion may end here
                self.drive(len(self._drives) - 1, *self._drives[0])
        self.loop.tick()
        self._check_time()
        if failed := self.recording.check():
            assert (self.recording.error, self.recording.numbers()) == (
                failed, {'recorder': 'failed'}), 'a failure is told until the next recording'
        assert all(log.missing <= MOST_QUEUED for log in self.logs if log.state != 'failed')
        if self.recording.is_on:
            log, warning = self.logs[-1], self.recording.warning or ''
            is_slow = log.possible_loss > self.values['record.max_loss']
            assert is_slow == (f'{log.file.name} is slow: a power loss would' in warning)
            assert self.disk.is_disturbed or not is_slow, 'an undisturbed disk is not slow'

    def _check_time(self, *, is_quiet=False):
        """No more is sent than is due; and all of it, where nothing holds the loop up."""
        loop, plan = self.loop, self.plan
        self.was_full |= not self.recording.has_room()
        assert (loop.state is LoopState.FAILED) == (loop.failure is not None)
        if plan.keeps_time and loop.state is LoopState.RUNNING:
            date_ns = DATE_NS + self.machine.now_ns - self._begin_ns
            due_ns = max(int((date_ns - self.epoch_ns) * self.values['time_scale']), 0)
            behind_ns = due_ns - self.simulation.now_ns - loop.slipped_ns
            is_free = (plan.is_calm or is_quiet) and not self.was_full
            assert behind_ns >= -3 and (behind_ns <= 3 or not is_free), 'what is due is sent'

    def _be_quiet(self):
        """What is due is sent, by the clock alone, once all is quiet again."""
        machine, loop = self.machine, self.loop
        self.wanted = dict.fromkeys(self.wanted, 'heard')
        self._lost_ticks = 0
        self._tick_until(max(machine.now_ns, self._cost_until_ns, self._stops_at_ns) + QUIET_NS)
        if not self.recording.has_room():
            machine.sleep(QUIET_NS)     # a tick that catches up has just filled the queue
        assert self.recording.has_room() or self.disk.is_disturbed, 'a full queue is emptied'
        self._tick()
        self._check_time(is_quiet=True)
        before_ns, was_full, self.was_full = self.simulation.sent_ns, self.was_full, False
        self._tick_until(machine.now_ns + QUIET_NS)
        held, self.was_full = self.was_full, self.was_full or was_full
        # Simulated time may be held before the stamp of t = 0, and while the disk is too slow.
        if loop.state is LoopState.RUNNING and before_ns > 0 and not (self.plan.follows or held):
            late_ns = QUIET_NS * self.values['time_scale'] - (self.simulation.now_ns - before_ns)
            assert abs(late_ns) <= 2 * loop.tick_period_ns * self.values['time_scale'], (
                'time goes on')

    def _update_subscribers(self):
        changed = False
        for output in self.simulation.outputs:
            reader, is_wanted = output.publish, output.channel.topic in self.wanted
            if is_wanted == (reader is not None):
                continue
            changed = True
            if is_wanted:
                output.publish = Reader(self, output, self.place)
                self.readers.append(output.publish)
            else:
                reader.ends, output.publish = self.place, None
        if changed:
            self.simulation.refresh()

    def _topics(self, channels):
        return [(resolve_topic(name, '/'), type_name, {}) for name, type_name in (
            *((one.topic, one.type_name) for one in channels), *events.TOPICS.items())]
