# SPDX-License-Identifier: Apache-2.0
"""What is found after a run of the simulated world: all is as `simulate` of its history gives."""

import contextlib
import functools
import hashlib
import json
import math
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from unittest import mock

import yaml

from helpers.machine import MILLISECOND, SECOND
from helpers.world import World
from helpers.world_plan import plan_of
from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recovery import recover
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.events import COMMANDS, EVENTS, Event
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.streams.topics import resolve_topic
from spinning_top_sim.tools.recorded_run import read_run_description
from spinning_top_sim.tools.verify import compare

SLACK_NS = 4 * MILLISECOND     # between a time that is noted here, and that of the recorder


class Findings:
    """
    Compares a run of the world with what `simulate` computes of its history.

    Raises AssertionError for whatever is not as promised.
    """

    def __init__(self, world):
        self._world = world
        self._sent = defaultdict(list)      # by topic: motion, t [ns], log time [ns], bytes
        self._heard = []                    # intervals: topic, begin and end of each count
        self._replay()
        self._compare_heard()
        self.outcome = ' '.join(sorted({self._look_into(log) for log in world.logs})) or 'no log'
        self._compare_counters()

    @property
    def digest(self):
        """Of all that was sent, and all that was left on the disk."""
        found = hashlib.sha256()
        for topic, messages in sorted(self._world.heard.items()):
            found.update(topic.encode() + b''.join(messages))
        for log in self._world.logs:
            found.update(log.path.read_bytes() if log.path.exists() else b'none')
        return found.hexdigest()

    def _replay(self):
        """Compute the history once more, and note where listening and recording begin and end."""
        world = self._world
        self._run, self._motion = Simulation(world.start[0], world.epoch_ns), 0
        self._listening, self._log, self._last_stamp_ns = {}, None, 0
        for at_ns, now_ns, kind, what in world.journal:
            self._play(now_ns)
            getattr(self, f'_{kind}')(at_ns, now_ns, what)
        self._play(world.simulation.now_ns)
        if self._log:
            self._log.ends = self._counts()
        for output in world.simulation.outputs:
            topic = output.channel.topic
            if topic in self._listening:
                self._leave(0, 0, (topic, *world.counts(output)), not world.was_killed)

    def _play(self, until_ns):
        run, values = self._run, self._world.values
        wanted = [one for one in run.channels if parameters.is_enabled(one.name, values)]
        for block in run.play(wanted, until_ns):
            for channel, times_ns, rows in block.messages:
                self._sent[channel.topic] += [
                    (self._motion, t_ns, run.epoch_ns + t_ns, row.tobytes())
                    for t_ns, row in zip(times_ns.tolist(), rows, strict=True)]

    def _counts(self):
        return {topic: len(sent) for topic, sent in self._sent.items()}

    def _event(self, at_ns, now_ns, event):
        self._last_stamp_ns = self._run.epoch_ns + now_ns
        applied = self._run.apply(event.kind, **event.details)
        assert applied.as_mapping() == event.as_mapping()
        assert event.sent_ns >= 0 or not event.begins_motion, 't = 0 is sent before'
        self._motion += event.kind == 'reset'
        if self._log:
            self._log.events.append((at_ns, event))

    def _log_begins(self, at_ns, now_ns, log):
        self._log, log.begins = log, self._counts()
        log.events.append((at_ns, Event('start', max(now_ns, 0), now_ns)))

    def _log_ends(self, at_ns, now_ns, _):
        log, self._log = self._log, None
        if log:
            log.ends = self._counts()
            if now_ns < 0 and self._run.epoch_ns < self._last_stamp_ns:
                log.events.pop()        # the reset by which stamps have gone back

    def _listen(self, at_ns, now_ns, what):
        self._listening[what[0]] = len(self._sent[what[0]]), what

    def _leave(self, at_ns, now_ns, what, is_complete=True):
        begin, first = self._listening.pop(what[0])
        self._heard.append((begin, len(self._sent[what[0]]), first, what, is_complete))

    def _compare_heard(self):
        """What was heard is what was sent, but for what is counted as not sent."""
        order = defaultdict(list)
        for begin, end, (topic, *before), (_, *after), is_complete in self._heard:
            heard = self._world.heard[topic][before[0]:after[0]]
            expected = iter(self._sent[topic][begin:end])
            for data in heard:
                found = next((one for one in expected if one[3] == data), None)
                assert found is not None, f'{topic}: what was heard is not what was sent'
                order[topic].append(found[:2])
            assert len(heard) == after[1] - before[1], f'{topic}: counted as sent'
            missing = end - begin - len(heard) - (after[2] - before[2])
            assert missing == 0 or (missing > 0 and not is_complete), (
                f'{topic}: {missing} messages are missing and were not counted')
        assert all(len(messages) == len(order[topic])
                   for topic, messages in self._world.heard.items())
        # Two messages without a stamp may be the same.
        times = [order[topic].pop(0) for topic in self._world.order if topic[0] != '~']
        assert times == sorted(times), 'messages are sent in the order of their times'

    def _compare_counters(self):
        world, loop = self._world, self._world.loop
        assert not world.disk.is_misused, 'a file is closed while it is being synced'
        assert world.simulation.now_ns <= (round(world.values['duration'] * SECOND) or math.inf)
        if world.plan.is_calm and not world.was_full:
            outputs = world.simulation.outputs
            assert (loop.late_ticks, loop.skipped_ticks, loop.slipped_ns) == (0, 0, 0)
            assert not any(one.skipped or one.failed for one in outputs), 'nothing was late'
        applied = Counter(what.kind for _, _, kind, what in world.journal if kind == 'event')
        counted = loop.commands
        acting = sum(applied[kind] for kind in ('command', 'state', 'drive'))
        assert counted == acting or (world.was_killed and counted == acting - 1)
        if not world.was_killed and all(log.recorder.state in ('closed', 'failed')
                                        for log in world.logs):
            assert len(world.answers) == world.asked, 'each request is answered once'

    # ------------------------------------------------------------------------------- the logs

    def _look_into(self, log):
        """Compare what is left of a log with what was handed over; return what it is."""
        world, recorder = self._world, log.recorder
        state = recorder.state
        if log.path in world.deleted:
            return 'deleted'
        if world.was_killed:
            content = (world.disk.content(log.path)
                       if world.plan.ends == 'kill' or state == 'failed'
                       else world.disk.after_a_power_cut(log.path))
            log.path.unlink(missing_ok=True)
            if content is not None and recorder.path is not None:
                log.path.write_bytes(content)
        elif log.path.exists():
            assert log.path.read_bytes() == world.disk.content(log.path)
        if state == 'failed':
            assert str(log.path) in recorder.error
        if state == 'failed' and recorder.path is None:
            assert not log.path.exists(), 'no log has begun, and there is a file'
            return 'not begun'
        is_whole, kept = self._read(log.path)
        expected = self._expected(log)
        for topic, messages in kept.items():
            self._compare_topic(topic, messages, expected[topic])
        self._check_promise(log, state, is_whole, kept, expected)
        return f'{state} {"whole" if is_whole else "torn"}'

    def _expected(self, log):
        """Return what was handed over: by topic of the log, log times [ns] and bytes."""
        expected = defaultdict(list)
        for topic in log.channels:
            sent = self._sent[topic][log.begins.get(topic, 0):log.ends.get(topic, 0)]
            expected[resolve_topic(topic, '/')] = [(at_ns, data) for *_, at_ns, data in sent]
        for _, event in log.events:
            for name, data in event.entries():
                expected[resolve_topic(name, '/')].append((None, data))
        return expected

    @staticmethod
    def _compare_topic(topic, messages, expected):
        if topic.endswith((EVENTS[1:], COMMANDS[1:])):
            messages = [(None, data) for _, data in messages]
        assert messages == expected[:len(messages)] or _is_part(messages, expected), (
            f'{topic}: what was recorded is not what was sent')

    def _check_promise(self, log, state, is_whole, kept, expected):
        world, recorder = self._world, log.recorder
        count = {topic: len(messages) for topic, messages in kept.items()}
        total = sum(count.values())
        handed = sum(map(len, expected.values()))
        is_cut = world.was_killed and world.plan.ends == 'cut'
        if state == 'closed' or (is_whole and state != 'failed'):
            assert is_whole and total == handed, 'a whole log holds all'
        if state == 'closed':
            counters = recorder.counters
            assert (counters.lost, counters.queued, counters.error) == (0, 0, None)
            assert not world.disk.failures or len(world.logs) > 1, 'a failure is told'
        elif state == 'failed' and log.path.exists():
            assert total == recorder.counters.messages
            # A failure in writing the summary costs that alone.
            if world.disk.failures == 1 and not world.was_killed:
                assert is_whole or not recorder.counters.lost, 'the log could have been finished'
        if not is_cut:
            self._check_boundary(log, count)
        if state == 'failed':
            return
        lost = [at_ns for at_ns, counts in log.handed if any(
            number > count.get(resolve_topic(topic, '/'), 0) for topic, number in counts.items())]
        lost += [at_ns for at_ns, _ in log.events][count.get(resolve_topic(EVENTS, '/'), 0):]
        allowed_ns = round(recorder.possible_loss * SECOND) + SLACK_NS
        if not world.disk.is_disturbed:
            assert recorder.possible_loss <= world.values['record.max_loss']
        if state == 'closed':
            allowed_ns = 0
        assert not lost or world.machine.now_ns - min(lost) <= allowed_ns, (
            f'lost: the last {(world.machine.now_ns - min(lost)) / SECOND} s, '
            f'allowed: {allowed_ns / SECOND} s')

    @staticmethod
    def _check_boundary(log, count):
        """Of no topic more is kept than of another."""
        kept = {topic: count.get(resolve_topic(topic, '/'), 0) for topic in log.channels}
        boundaries = [{}, *(counts for _, counts in log.handed)]
        assert any(all(counts.get(topic, 0) == number for topic, number in kept.items())
                   for counts in boundaries), 'a topic lags behind another'

    def _read(self, path):
        """Return whether a file is whole, and its messages by topic: none if it cannot be read."""
        if not path.exists():
            return False, {}
        with contextlib.suppress(LogError), LogReader(path) as reader:
            kept = _messages(reader)
            if not reader.whole and kept:
                whole = path.with_suffix('.recovered')
                assert recover(reader, whole) == sum(map(len, kept.values()))
                with LogReader(whole) as recovered:
                    assert recovered.whole and _messages(recovered) == kept
            if self._world.plan.seed % 2:       # it computes the run a third time
                self._verify(reader, kept)
            return reader.whole, kept
        return False, {}

    def _verify(self, reader, kept):
        run = read_run_description(reader)
        stamps = [messages[-1][0] for topic, messages in kept.items()
                  if topic in run.topics.values()]
        if stamps and not reader.damage.lost_bytes:
            comparison = compare(run, reader, max(stamps), lambda stamp_ns: None)
            assert comparison.identical, comparison.first or comparison.stopped


def _messages(reader):
    found = defaultdict(list)
    for message in reader.messages():
        found[message.topic].append((message.log_time, message.data))
    return found


def _is_part(messages, whole):
    rest = iter(whole)
    return all(message in rest for message in messages)


_load = functools.cache(yaml.safe_load)
_environment = functools.cache(provenance.environment)


@contextlib.contextmanager
def shortcuts():
    """Compute once what is the same in all worlds, and write YAML as JSON, which is YAML."""
    with (mock.patch.object(yaml, 'dump', lambda value, **_: json.dumps(value)),
          mock.patch.object(yaml, 'safe_load', _load),
          mock.patch.object(provenance, 'environment', _environment)):
        yield


def examine(plan):
    """Run a plan; return what came of it, or raise for what is not as promised."""
    with (tempfile.TemporaryDirectory(prefix='world_', dir=_memory()) as folder,
          contextlib.chdir(folder), shortcuts()):
        world = World(plan, Path(folder))
        world.run()
        found = Findings(world)
        return found.outcome, found.digest


def _memory():
    return '/dev/shm' if Path('/dev/shm').is_dir() else None


def failure_of(plan):
    """Return what is wrong with a run of a plan, '' for nothing."""
    try:
        examine(plan)
    except Exception as error:
        return f'{type(error).__name__}: {error}'
    return ''


def shrunk(seed):
    """Return the numbers of a few actions that suffice for a seed to fail."""
    plan = plan_of(seed)
    numbers, size = [*range(len(plan.actions))], len(plan.actions)
    while size:
        for begin in range(0, len(numbers), size):
            fewer = numbers[:begin] + numbers[begin + size:]
            if failure_of(plan.only(fewer)):
                numbers = fewer
                break
        else:
            size //= 2
    return numbers


def told(seed):
    """Return what is wrong with a seed and what suffices for that, with the command; or ''."""
    if not failure_of(plan_of(seed)):
        return ''
    numbers = shrunk(seed)
    plan = plan_of(seed).only(numbers)
    return '\n'.join((
        f'world: seed {seed}: {failure_of(plan)}', *(f'    {one}' for one in plan.actions),
        f'    {plan.ends_ms:5d} ms  {plan.ends}'
        + (f', or in call {plan.kill_at} of the disk' if plan.kill_at else ''),
        f'To repeat it:  python test/stress world --first {seed} --only '
        f'{",".join(map(str, numbers)) or "-"}'))
