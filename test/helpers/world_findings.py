# SPDX-License-Identifier: Apache-2.0
"""What is found after a run of the simulated world: all is as `simulate` of its history gives."""

import contextlib
import functools
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
from spinning_top_sim.recording import recorder, rosbag2, writer
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader, recover
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.events import COMMANDS, EVENTS, MOTIONS, Event
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.streams.topics import resolve_topic
from spinning_top_sim.tools.recorded_run import compare, read_run_description

SLACK_NS = 4 * MILLISECOND     # between a time that is noted here, and that of the recorder


def check(world):
    """Compare a run of the world with what `simulate` computes of its history, and promises."""
    sent = simulated(world)
    check_readers(world, sent)
    check_counters(world)
    for log in world.logs:
        check_log(world, log, sent)


def simulated(world):
    """Return what was to be sent: by topic, (motion, t [ns]), log time [ns] and data."""
    run = Simulation(parameters.checked(world.plan.values), world.epoch_ns)
    motion, sent = 0, defaultdict(list)

    def play(until_ns):
        wanted = [one for one in run.channels if parameters.is_enabled(one.name, world.values)]
        for block in run.play(wanted, until_ns):
            for channel, times_ns, rows in block.messages:
                sent[resolve_topic(channel.topic, '/')] += [
                    ((motion, t_ns), run.epoch_ns + t_ns, row.tobytes())
                    for t_ns, row in zip(times_ns.tolist(), rows, strict=True)]

    for event in world.events:
        play(event.sent_ns)
        assert run.apply(event.kind, **event.details).text == event.text
        assert event.sent_ns >= 0 or event.kind not in MOTIONS, 't = 0 is sent before'
        motion += event.kind == 'reset'
    play(world.simulation.sent_ns)
    return sent


def between(messages, begins, ends):
    return [one for one in messages if begins[:2] < one[0] <= ends[:2]]


def check_readers(world, sent):
    """What was heard is what was sent, but for what is counted as not sent."""
    order, missing, heard = {}, Counter(), Counter()
    for reader in world.readers:
        topic = reader.output.channel.topic
        expected = between(sent[resolve_topic(topic, '/')], reader.begins, reader.ends)
        rest = iter(expected)
        for number, data in reader.heard:
            place = next((place for place, _, one in rest if one == data), None)
            assert place is not None, f'{topic}: what was heard is not what was sent'
            if topic[0] != '~':     # two messages without a stamp may be the same
                order[number] = (*place, world.simulation.outputs.index(reader.output))
        heard[topic] += len(reader.heard)
        missing[topic] += len(expected) - len(reader.heard)
    for output in world.simulation.outputs:
        topic = output.channel.topic
        assert output.sent == heard[topic], f'{topic}: counted as sent'
        uncounted = missing[topic] - output.skipped - output.failed
        assert uncounted == 0 or (uncounted > 0 and world.was_killed), (
            f'{topic}: {uncounted} messages are missing and were not counted')
    times = [place for _, place in sorted(order.items())]
    assert times == sorted(times), 'messages are sent in the order of their times'


def check_counters(world):
    loop, outputs = world.loop, world.simulation.outputs
    assert not world.disk.is_misused, 'a file is closed while it is being synced'
    assert world.simulation.sent_ns <= (round(world.values['duration'] * SECOND) or math.inf)
    if world.plan.is_calm and not world.was_full:
        assert (loop.late_ticks, loop.skipped_ticks, loop.slipped_ns) == (0, 0, 0)
        assert not any(one.skipped or one.failed for one in outputs), 'nothing was late'
    assert loop.commands == sum(event.kind in MOTIONS for event in world.events)


def check_log(world, log, sent):
    """Compare what was simulated, handed over, promised and left on the disk."""
    check_handed(world, log, sent)
    state, is_cut = log.state, world.was_killed and world.plan.ends == 'cut'
    if state == 'failed':
        assert str(log.file) in log.error
    if log.path is None:
        assert state != 'failed' or not log.file.exists(), 'no log has begun, and there is a file'
        log.file.unlink(missing_ok=True)        # of a process that was killed
    elif is_cut and state != 'failed':
        world.disk.cut_power(log.file)
    is_whole, kept = read(log.file, verified=world.plan.seed % 4 == 0)
    count = Counter({topic: len(messages) for topic, messages in kept.items()})
    handed = defaultdict(list)
    for _, topic, *message in log.handed:
        handed[topic].append(tuple(message))
    for topic, messages in kept.items():
        assert is_part(messages, handed[topic]), f'{topic}: recorded is not what was sent'
    if not is_cut:
        assert count.total() in log.boundaries and count == Counter(
            topic for _, topic, *_ in log.handed[:count.total()]), 'a topic lags behind another'
    check_promises(world, log, is_whole, count)


def check_handed(world, log, sent):
    """What a recorder was handed is all that was simulated meanwhile, and the events."""
    begins, ends = log.begins, log.ends
    handed = defaultdict(list)
    for _, topic, stamp_ns, data in log.handed:
        handed[topic].append((stamp_ns, data))
    *_, of_commands, of_events = log.names
    expected = {topic: [message[1:] for message in between(sent[topic], begins, ends)]
                for topic in log.names[:-2]}
    assert {topic: handed[topic] for topic in expected} == expected
    happened = [Event('start', max(begins.sent_ns, 0), begins.sent_ns),
                *world.events[begins.events:ends.events]]
    if ends.sent_ns < 0 and len(handed[of_events]) < len(happened) and (
            happened[-1].kind == 'reset'):
        happened.pop()      # stamps have gone back, which ended the log
    for topic, name in ((of_commands, COMMANDS), (of_events, EVENTS)):
        assert [data for _, data in handed[topic]] == [
            data for event in happened for one, data in event.entries() if one == name]


def check_promises(world, log, is_whole, count):
    state = log.state
    if state == 'closed' or (is_whole and state != 'failed'):
        assert is_whole and count.total() == len(log.handed), 'a whole log holds all'
    if state == 'failed':
        # A failure in writing the summary costs that alone.
        assert not log.path or count.total() == log.written[0]
        assert is_whole or not log.missing or world.disk.failures != 1 or world.was_killed or (
            not log.path), 'the log could have been finished'
        return
    allowed_ns = round(log.possible_loss * SECOND) + SLACK_NS
    if state == 'closed':
        assert (log.missing, log.error) == (0, None)
        assert not world.disk.failures or len(world.logs) > 1, 'a failure is told'
        allowed_ns = 0
    assert world.disk.is_disturbed or log.possible_loss <= world.values['record.max_loss']
    lost_ns = world.machine.now_ns - first_lost_ns(log, count, world.machine.now_ns)
    assert lost_ns <= allowed_ns, f'lost: the last {lost_ns} ns, allowed: {allowed_ns} ns'


def first_lost_ns(log, count, otherwise_ns):
    """Return when the first message was handed over that is not in the file."""
    left = count.copy()
    for at_ns, topic, *_ in log.handed:
        left[topic] -= 1
        if left[topic] < 0:
            return at_ns
    return otherwise_ns


def read(path, *, verified):
    """Return whether a file is whole, and its messages by topic: none if it cannot be read."""
    if not path.exists():
        return False, {}
    with contextlib.suppress(LogError), LogReader(path) as reader:
        kept = messages(reader)
        if not reader.whole and kept:
            whole = path.with_suffix('.recovered')
            assert recover(reader, whole) == sum(map(len, kept.values()))
            with LogReader(whole) as recovered:
                assert recovered.whole and messages(recovered) == kept
        if verified:            # that computes the run a third time
            verify(reader)
        return reader.whole, kept
    return False, {}


def verify(reader):
    run, texts = read_run_description(reader), reader.metadata['spinning_top_sim']
    assert texts['seed'] == str(json.loads(texts['parameters'])['seed'])
    if not reader.lost_bytes:
        comparison = compare(run, reader)
        assert comparison.identical, comparison.first or comparison.stopped


def messages(reader):
    found = defaultdict(list)
    for message in reader.messages():
        found[message.topic].append((message.log_time, message.data))
    return found


def is_part(some, whole):
    rest = iter(whole)
    return some == whole[:len(some)] or all(message in rest for message in some)


# What takes most of the time and is the same in all worlds; and JSON is YAML.
QUICK = ((rosbag2, 'as_yaml', json.dumps), *(
    (module, name, functools.cache(getattr(module, name))) for module, name in (
        (yaml, 'safe_load'), (recorder, 'environment'), (writer, 'version'))))


def examine(plan):
    """Run a plan; raise for whatever is not as promised."""
    memory = '/dev/shm' if Path('/dev/shm').is_dir() else None
    with (tempfile.TemporaryDirectory(prefix='world_', dir=memory) as folder,
          contextlib.chdir(folder), contextlib.ExitStack() as stack):
        for one in QUICK:
            stack.enter_context(mock.patch.object(*one))
        world = World(plan, Path(folder))
        world.run()
        check(world)


def failure_of(plan):
    """Return what is wrong with a run of a plan, '' for nothing."""
    try:
        examine(plan)
    except Exception as error:
        return f'{type(error).__name__}: {error}'
    return ''


def told(seed):
    """Return what is wrong with a seed that fails, and the few actions that suffice for that."""
    plan = plan_of(seed)
    numbers = [*range(len(plan.actions))]
    for number in reversed(numbers):
        fewer = [one for one in numbers if one != number]
        if failure_of(plan.only(fewer)):
            numbers = fewer
    plan = plan.only(numbers)
    ends = f', or in call {plan.kill_at} of the disk' if plan.kill_at else ''
    return '\n'.join((
        f'world: seed {seed}: {failure_of(plan)}', *(f'    {one}' for one in plan.actions),
        f'    {plan.ends_ms:5d} ms  {plan.ends}{ends}',
        'To repeat it:  PYTHONPATH=test python -c "from helpers.world_findings import *; '
        f'examine(plan_of({seed}).only({numbers}))"'))
