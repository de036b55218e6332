# SPDX-License-Identifier: Apache-2.0
"""
Replay: what is due when, without ROS and with a clock of our own; and nodes over real DDS.

Logs are written by the recorder of this package and by rosbags, which nobody here wrote.  No test
is decided by how long something took, except that nothing may come before its time.
"""

import contextlib
import dataclasses
import importlib
import itertools
import signal
import struct
import threading
import time
from fractions import Fraction

import pytest
from helpers.node_harness import PATIENCE_S, Peer, SimNode, Topic
from mcap.opcode import Opcode
from mcap.writer import Writer as McapWriter
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from spinning_top_sim.nodes import pacing
from spinning_top_sim.nodes.pacing import ROUND_GAP_NS, Playback, ReadAhead, rounds
from spinning_top_sim.nodes.replayer import message_class
from spinning_top_sim.recording import writer
from spinning_top_sim.recording.rosbag2 import RecordedTopic, find_definition, offered_qos_yaml
from spinning_top_sim.recording.writer import McapRecorder, create_file
from spinning_top_sim.streams.messages import string

JAZZY = get_typestore(Stores.ROS2_JAZZY)
EPOCH_NS = 1_700_000_000_123_456_789
SECOND = 1_000_000_000

# ------------------------------------------------------------------- when a message is due


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
        patch.setattr(pacing, 'time', fake)
        player = Playback(EPOCH_NS, **options)
        player._changed = fake
        player.set_rate(rate)
        fake.at_rest = {77 + at: (lambda act=act: act(player))
                        for at, act in (plan or {}).items()}
        player.run((at_ns, send, data) for at_ns, _, data in messages)
    return sent, player, fake


def messages_at(*offsets, send=None):
    return [(EPOCH_NS + offset, send, str(index).encode())
            for index, offset in enumerate(offsets)]


@pytest.mark.parametrize('rate', [0.1, 1.0, 3.0, 10.0])
def test_every_message_has_its_own_deadline_from_the_start(rate):
    # Periods that no binary fraction is: rounding that added up would show at the end.
    offsets = [n * 3_333_333 for n in range(20_000)]
    sent, player, _ = play(messages_at(*offsets), rate)
    assert [index for index, _ in sent] == list(range(20_000))
    for (_, at), offset in zip(sent, offsets, strict=True):
        assert abs(at - Fraction(offset) / Fraction(rate)) <= 1
    assert player.late == 0


def test_what_is_due_together_is_sent_together():
    sent, _, fake = play(messages_at(5, 5, 5, 900, 900))
    assert [at for _, at in sent] == [5, 5, 5, 900, 900]
    assert fake.sleeps == 2


def test_what_is_late_is_sent_at_once_and_counted_and_later_deadlines_stay():
    cost = 30_000_000
    offsets = [0, 1_000_000, 2_000_000, 500_000_000]
    sent, player, _ = play(messages_at(*offsets), cost_ns=cost)
    assert sent == [(0, 0), (1, cost), (2, 2 * cost), (3, 500_000_000)]
    assert player.late == 2
    assert player.sent == 4


def test_a_pause_shifts_what_follows_and_catches_nothing_up():
    offsets = [0, 100, 200, 300]
    sent, player, _ = play(messages_at(*offsets), plan={
        150: lambda p: p.pause(True), 5_000: lambda p: p.pause(True),
        1_000_150: lambda p: p.pause(False), 1_000_160: lambda p: p.pause(False)})
    assert [at for _, at in sent] == [0, 100, 1_000_200, 1_000_300]
    assert player.late == 0


def test_started_paused_nothing_goes_out_before_the_resume():
    sent, player, _ = play(messages_at(10), paused=True, plan={
        10_000_000: lambda p: p.pause(False)})
    assert [at for _, at in sent] == [10_000_010]
    assert not player.paused


def test_a_new_rate_holds_from_its_moment_on():
    sent, _, _ = play(messages_at(0, 1_000, 3_000), plan={
        1_500: lambda p: p.set_rate(0.5)})
    assert [at for _, at in sent] == [0, 1_000, 1_500 + 3_000]


def test_told_to_stop_it_sends_nothing_more():
    sent, player, _ = play(messages_at(0, 1_000), plan={500: lambda p: p.stop()})
    assert sent == [(0, 0)]
    assert player.sent == 1


def test_a_pause_from_another_thread_waits_for_the_message_that_is_being_sent():
    """Nothing is sent after `pause` has returned, though the playback never rests here."""
    sending, go_on = threading.Event(), threading.Event()

    def send(data):
        if data == b'3':
            sending.set()
            assert go_on.wait(PATIENCE_S)

    player = Playback(EPOCH_NS)
    playing = threading.Thread(target=player.run, daemon=True, args=(
        messages_at(*range(10_000), send=send),))
    playing.start()
    assert sending.wait(PATIENCE_S)
    pausing = threading.Thread(target=player.pause, args=(True,), daemon=True)
    pausing.start()
    pausing.join(0.2)
    assert pausing.is_alive()
    go_on.set()
    pausing.join(PATIENCE_S)
    sent = player.sent
    time.sleep(0.1)
    assert player.sent == sent
    player.stop()
    playing.join(PATIENCE_S)
    assert not playing.is_alive()


def test_the_time_told_never_passes_a_message_that_is_still_to_be_sent():
    told = []

    def look(player):
        told.append(player.now() - EPOCH_NS)

    _, player, fake = play(messages_at(0, 1_000_000, 2_000_000),
                           plan={400_000: look, 1_500_000: look})
    fake.now_ns += SECOND
    look(player)
    assert told == [400_000, 1_500_000, 2_000_000]


def test_rounds_go_on_where_the_last_one_ended():
    log = [(EPOCH_NS, 0, b'a'), (EPOCH_NS + 500, 1, b'b')]
    endless = rounds(lambda: log, 700, loop=True)
    found = list(itertools.islice(endless, 5))
    turn = 700 + 10_000_000
    assert found == [*log, (EPOCH_NS + turn, 0, b'a'), (EPOCH_NS + turn + 500, 1, b'b'),
                     (EPOCH_NS + 2 * turn, 0, b'a')]
    assert list(rounds(lambda: log, 700, loop=False)) == log
    assert list(rounds(list, 700, loop=True)) == []


def test_reading_ahead_is_bounded_in_order_and_ends():
    taken = itertools.count()
    last = [0]

    def endless():
        for number in taken:
            last[0] = number
            yield number, 0, b'x' * 100

    ahead = ReadAhead(endless())
    first = list(itertools.islice(ahead, 1_000))
    assert [number for number, _, _ in first] == list(range(1_000))
    ahead.stop()
    assert not ahead._thread.is_alive()
    most = (pacing.BATCHES + 3) * pacing.BATCH_MESSAGES
    assert last[0] < 1_000 + most


@pytest.mark.parametrize('count', [1, pacing.BATCH_MESSAGES, 700])
def test_what_reading_raises_comes_after_what_was_read(count):
    def broken():
        for number in range(count):
            yield number, 0, b'a'
        raise OSError('gone')

    found = []
    with pytest.raises(OSError, match='gone'):
        for message in ReadAhead(broken()):
            found.append(message)
    assert found == [(number, 0, b'a') for number in range(count)]


def test_stopping_wakes_who_waits_for_a_reader():
    block = threading.Event()

    def slow():
        block.wait(60.0)
        yield 1, 0, b''

    ahead = ReadAhead(slow())
    consumer = threading.Thread(target=lambda: list(ahead), daemon=True)
    consumer.start()
    ahead.stop()
    consumer.join(20.0)
    assert not consumer.is_alive()
    block.set()


# --------------------------------------------------------------------------- logs to play

STRING, TWIST, THING = 'std_msgs/msg/String', 'geometry_msgs/msg/Twist', 'nowhere_msgs/msg/Thing'


def string_cdr(number, padding=0):
    text = f'message {number}' + padding * '.'
    data = JAZZY.serialize_cdr(JAZZY.types[STRING](text), STRING).tobytes()
    return data + bytes(-len(data) % 4)     # as it comes off the wire, and so into logs


def twist_cdr(number):
    vector = JAZZY.types['geometry_msgs/msg/Vector3']
    twist = JAZZY.types[TWIST](vector(1.0, 2.0, float(number)), vector(0.0, 0.5, -0.5))
    return JAZZY.serialize_cdr(twist, TWIST).tobytes()


def write_bag(folder, connections, messages):
    """Let rosbags write a log; messages: (index of the connection, time, CDR) as they come."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        opened = [bag.add_connection(name, kind, typestore=JAZZY, offered_qos_profiles=qos)
                  for name, kind, qos in connections]
        for index, at_ns, data in messages:
            bag.write(opened[index], at_ns, data)
    return next(folder.glob('*.mcap'))


@pytest.fixture(scope='module')
def strangers_log(tmp_path_factory):
    """Two topics of a stranger in one file, out of order; what should come is (log, in order)."""
    order = [*range(20, 40), *range(20), *range(40, 60)]
    messages = [(n % 2, EPOCH_NS + n * 20_000_000, (string_cdr, twist_cdr)[n % 2](n))
                for n in order]
    qos = [Qos(QosHistory.KEEP_LAST, 7, QosReliability.BEST_EFFORT, QosDurability.VOLATILE,
               QosTime(9223372036, 854775807), QosTime(9223372036, 854775807),
               QosLiveliness.AUTOMATIC, QosTime(9223372036, 854775807),
               avoid_ros_namespace_conventions=False)]
    path = write_bag(tmp_path_factory.mktemp('stranger') / 'bag',
                     [('/chatter', STRING, ()), ('/robot/cmd_vel', TWIST, qos)], messages)
    in_order = sorted(messages, key=lambda message: message[1])
    return path, [[data for index, _, data in in_order if index == topic] for topic in (0, 1)]


def write_log(path, count, step_ns=2_000_000, padding=0, **options):
    """Record strings and twists in turn with our recorder; return what is in, by topic."""
    messages = [(n % 2, EPOCH_NS + n * step_ns,
                 twist_cdr(n) if n % 2 else string_cdr(n, padding)) for n in range(count)]
    topics = [RecordedTopic('/ours/text', STRING),
              RecordedTopic('/ours/twist', TWIST, {'depth': 3, 'durability': 1})]
    with contextlib.closing(McapRecorder(
            path, topics, {}, **{'min_free_bytes': 0} | options)) as recorder:
        for message in messages:
            recorder.write(*message)
    return [[data for index, _, data in messages if index == topic] for topic in (0, 1)]


OURS = (('/ours/text', STRING), ('/ours/twist', TWIST))
BEST_EFFORT = '/robot/cmd_vel'
STRANGERS = (('/chatter', STRING), ('/robot/cmd_vel', TWIST))


def assert_same(found, wanted):
    """Compare lists of messages by topic; pytest takes minutes to show how long ones differ."""
    assert [len(messages) for messages in found] == [len(messages) for messages in wanted]
    for of_found, of_wanted in zip(found, wanted, strict=True):
        for number, pair in enumerate(zip(of_found, of_wanted, strict=True)):
            assert pair[0] == pair[1], f'message {number}'


# ------------------------------------------------------------------------------- nodes


class Replay(SimNode):
    """A replay_node in its own process group."""

    def __init__(self, folder, file, *options, arguments=()):
        super().__init__(folder, namespace='/', arguments=arguments, program=(
            '-m', 'spinning_top_sim.nodes.replay_node', str(file), *options))
        self.name = f'{self.namespace}/replay'


@pytest.fixture
def peer():
    """Return a new one for each test: subscriptions of before would count as subscribers."""
    with Peer() as peer:
        yield peer


class Listening:
    """Subscriptions that know whether they have found a publisher."""

    def __init__(self, peer, topics):
        self.topics, self._matched = [], {}
        for name, kind in topics:
            topic = Topic(message_class(kind))
            matched = self._matched[name] = threading.Event()
            peer.node.create_subscription(
                topic.kind, name, topic.receive,
                QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT
                           if name == BEST_EFFORT else ReliabilityPolicy.RELIABLE),
                raw=True, event_callbacks=SubscriptionEventCallbacks(
                    matched=lambda info, matched=matched: matched.set()))
            self.topics.append(topic)

    def wait_until_matched(self):
        for name, matched in self._matched.items():
            assert matched.wait(PATIENCE_S), f'no publisher of {name}'

    @property
    def raw(self):
        return [topic.raw for topic in self.topics]


@contextlib.contextmanager
def replaying(peer, folder, file, topics, *options, depth=5000, arguments=()):
    """
    Have a replay that stands before its first message; both sides know each other.

    depth: of reliable publishers; with no less than a topic has messages, a busy machine cannot
    decide what arrives, and with no more the last ones are acknowledged at once
    """
    kept = [argument for name, _ in topics if name not in (BEST_EFFORT, '/clock')
            for argument in ('-p', f'qos_overrides.{name}.publisher.depth:={depth}')]
    heard = Listening(peer, topics)
    with Replay(folder, file, '--start-paused', '--wait-for-subscribers', str(len(topics)),
                *options, arguments=(*kept, *arguments)) as node:
        heard.wait_until_matched()
        yield node, heard


def play_all(peer, folder, file, topics, *options, **given):
    """Play a log to its end; return what has arrived by topic, and the node."""
    with replaying(peer, folder, file, topics, *options, **given) as (node, heard):
        assert peer.switch(node, 'set_pause', False).success
        assert node.wait() == 0, node.err
        wait_until_still(heard)
        return heard.raw, node


def wait_until_still(heard):
    """Wait for what is on its way after the sender has ended: acknowledged, not yet taken."""
    counts = None
    while counts != (now := [len(raw) for raw in heard.raw]):
        counts = now
        time.sleep(0.2)


def test_all_bytes_arrive_to_the_last_message(peer, tmp_path):
    wanted = write_log(tmp_path / 'run.mcap', 1_000)
    begin = time.monotonic()
    raw, node = play_all(peer, tmp_path, tmp_path / 'run.mcap', OURS, '--rate', '2',
                         depth=500)
    assert_same(raw, wanted)
    assert time.monotonic() - begin >= 1.998 / 2.0      # nothing before its time
    assert 'played 1000 messages on 2 topics' in node.out
    assert node.err == ''


def test_a_strangers_log_is_played_in_order_with_its_qos(peer, tmp_path, strangers_log):
    path, wanted = strangers_log
    with replaying(peer, tmp_path, path, STRANGERS, depth=30) as (node, heard):
        offered = {}
        for name, _ in STRANGERS:
            (info,) = peer.node.get_publishers_info_by_topic(name)
            offered[name] = info.qos_profile.reliability
        assert offered == {'/chatter': ReliabilityPolicy.RELIABLE,
                           '/robot/cmd_vel': ReliabilityPolicy.BEST_EFFORT}
        assert peer.get(node, 'qos_overrides./robot/cmd_vel.publisher.depth') == [7]
        peer.switch(node, 'set_pause', False)
        assert node.wait() == 0, node.err
        wait_until_still(heard)
        text, velocity = heard.raw
        assert_same([text], wanted[:1])
        # What nobody acknowledges may get lost, but neither change nor change places.
        numbers = [wanted[1].index(data) for data in velocity]
        assert numbers
        assert numbers == sorted(set(numbers))


def test_names_and_qos_can_be_changed_as_usual(peer, tmp_path, strangers_log):
    path, wanted = strangers_log
    raw, _ = play_all(
        peer, tmp_path, path, (('/elsewhere/vel', TWIST), ('/chatter', STRING)), '--rate', '10',
        depth=30, arguments=('-p', 'rate:=0.001', '-r', '/robot/cmd_vel:=/elsewhere/vel',
                             '-p', 'qos_overrides./elsewhere/vel.publisher.reliability:=reliable'))
    assert_same(raw, wanted[::-1])


def test_start_and_topics_choose_what_is_played(peer, tmp_path, strangers_log):
    path, wanted = strangers_log
    raw, node = play_all(peer, tmp_path, path, STRANGERS[:1], '--topics', '/chatter', '/nobody',
                         'cmd_vel', '--start', '0.4', depth=20)
    assert_same(raw, [wanted[0][10:]])
    assert 'the log has no topic /nobody\n' in node.err
    assert 'the log has no topic cmd_vel; did you mean /robot/cmd_vel?' in node.err
    assert 'on 1 topics' in node.out


def test_only_message_classes_of_installed_ros_packages_are_found(monkeypatch):
    assert message_class(TWIST) is message_class('geometry_msgs/Twist')
    assert message_class(STRING).__name__ == 'String'
    imported = []
    monkeypatch.setattr(importlib, 'import_module', imported.append)
    for name in ('antigravity/msg/X', 'os/msg/System', '/msg/String', 'std_msgs', 'std_msgs/msg/',
                 'std_msgs/msg/string', 'std_msgs.msg/msg/String', '../std_msgs/msg/String',
                 'std_msgs/msg/String\n', 'json/decoder/JSONDecoder', 'nowhere_msgs/msg/Thing'):
        with pytest.raises(LookupError):
            message_class(name)
    assert imported == []
    monkeypatch.undo()
    for name in ('std_msgs/msg/Nothing', 'std_srvs/srv/Trigger', 'std_srvs/action/Trigger'):
        with pytest.raises(LookupError):
            message_class(name)


def test_an_unknown_type_is_named_once_and_the_rest_plays(peer, tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('int32 x', THING))
    path = tmp_path / 'bag'
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        thing = bag.add_connection('/thing', THING, typestore=store)
        text = bag.add_connection('/text', STRING, typestore=store)
        for n in range(10):
            at = EPOCH_NS + n * 1_000_000
            bag.write(thing, at, b'\0\1\0\0\0\0\0\0')
            bag.write(text, at, string_cdr(n))
    raw, node = play_all(peer, tmp_path, next(path.glob('*.mcap')), (('/text', STRING),),
                         depth=10)
    assert_same(raw, [[string_cdr(n) for n in range(10)]])
    assert node.err.count(THING) == 1
    assert '/thing is not played' in node.err


def test_one_odd_channel_does_not_stop_the_others(peer, tmp_path):
    qos = {'/plain': [{}], '/deadline': [{'deadline': {'sec': -1, 'nsec': 0}}],
           '/lease': [{'liveliness_lease_duration': {'sec': -7, 'nsec': 1}}],
           '/liveliness': [{'liveliness': 2}], '/depth': [{'depth': -5}],
           '/different': [{'depth': 3}, {'depth': 4}]}
    odd = {'/no_schema': (0, 'cdr'), '/no_type': (3, 'cdr'), '/no_package': (4, 'cdr'),
           '/no_cdr': (1, 'json'), 'no name!': (1, 'cdr'), '/plain': (2, 'cdr'),
           '/rosout': (1, 'cdr'), '//twice': (1, 'cdr'), '/' + 500 * 'x': (1, 'cdr'),
           '/red\x1b[31m': (1, 'cdr')}
    path = tmp_path / 'odd.mcap'
    with path.open('wb') as file:
        log = McapWriter(file)
        log.start('ros2')
        for name in (STRING, TWIST, 'no type; at all', '/msg/X'):
            log.register_schema(name, 'ros2msg', b'')
        channels = [log.register_channel(name, 'cdr', 1, {
            'offered_qos_profiles': '\n'.join(
                offered_qos_yaml(RecordedTopic(name, STRING, profile)) for profile in profiles)})
            for name, profiles in qos.items()]
        channels += [log.register_channel(name, encoding, schema)
                     for name, (schema, encoding) in odd.items()]
        for n, channel in enumerate(channels):
            log.add_message(channel, EPOCH_NS + n, string_cdr(n), EPOCH_NS + n)
        log.finish()
    raw, node = play_all(peer, tmp_path, path, [(name, STRING) for name in qos], depth=10)
    assert_same(raw, [[string_cdr(n)] for n in range(len(qos))])
    for name in odd:
        shown = name if len(name) < 300 else name[:300]
        assert node.err.count(shown.replace('\x1b', '\\x1b') + (
            ' is not played' if shown == name else ' ... ')) == 1
    assert '\x1b' not in node.err
    assert len(node.err.splitlines()) == len(odd) + len(qos) - 1
    for name in qos:
        warned = node.err.count(f'{name} is published with default QoS')
        assert warned == (name != '/plain')


def test_what_was_recorded_before_there_was_a_time_is_played_at_the_begin(peer, tmp_path):
    path = tmp_path / 'early.mcap'
    with path.open('wb') as file:
        log = McapWriter(file, chunk_size=1)        # a chunk for each message
        log.start('ros2')
        channel = log.register_channel('/text', 'cdr', log.register_schema(STRING, 'ros2msg', b''))
        for n, at_ns in enumerate((0, 0, EPOCH_NS, EPOCH_NS + 1_000_000)):
            log.add_message(channel, at_ns, string_cdr(n), at_ns)
        log.finish()
    raw, _ = play_all(peer, tmp_path, path, (('/text', STRING),), depth=10)
    assert_same(raw, [[string_cdr(n) for n in range(4)]])


@pytest.mark.parametrize('start_ns', [0, EPOCH_NS - SECOND, EPOCH_NS + SECOND])
def test_an_index_that_does_not_fit_the_messages_is_an_error(tmp_path, start_ns):
    path = tmp_path / 'run.mcap'
    write_log(path, 10)
    content = bytearray(path.read_bytes())
    summary, = struct.unpack_from('<Q', content, len(content) - 28)
    while content[summary] != Opcode.CHUNK_INDEX:
        summary += 9 + struct.unpack_from('<Q', content, summary + 1)[0]
    chunk, = struct.unpack_from('<Q', content, summary + 9 + 16)
    for record in (chunk, summary):
        struct.pack_into('<QQ', content, record + 9, start_ns, start_ns)
    struct.pack_into('<I', content, len(content) - 12, 0)       # no checksum of the summary
    path.write_bytes(content)
    with Replay(tmp_path, path) as node:
        assert node.wait() == 2
    assert 'recover' in node.err
    assert f'the index of {path} does not fit' in node.err


def test_a_type_that_has_changed_since_is_warned_about(peer, tmp_path, monkeypatch):
    def another(type_name):
        found = find_definition(type_name)
        changed = type_name == STRING
        return dataclasses.replace(found, type_hash='RIHS01_' + 64 * '0') if changed else found

    monkeypatch.setattr(writer, 'find_definition', another)
    wanted = write_log(tmp_path / 'run.mcap', 20)
    raw, node = play_all(peer, tmp_path, tmp_path / 'run.mcap', OURS, depth=10)
    assert_same(raw, wanted)
    assert node.err.count('was recorded with another') == 1
    assert f'/ours/text was recorded with another {STRING}' in node.err


def test_a_torn_log_is_refused_with_a_hint_and_played_in_part(peer, tmp_path):
    path = tmp_path / 'torn.mcap'
    wanted = write_log(path, 400, padding=20_000, compression='none')
    whole = path.read_bytes()
    path.write_bytes(whole[:len(whole) // 2])
    with Replay(tmp_path / 'refused', path) as node:
        assert node.wait() == 2
    (line,) = node.err.splitlines()
    assert 'torn' in line
    assert 'recover' in line
    assert '--partial' in line
    raw, node = play_all(peer, tmp_path, path, OURS, '--partial')
    assert 'torn' in node.err
    for found, all_of_it in zip(raw, wanted, strict=True):
        assert 40 < len(found) < 110
        assert_same([found], [all_of_it[:len(found)]])


def test_damage_inside_is_no_secret(peer, tmp_path):
    path = tmp_path / 'damaged.mcap'
    wanted = write_log(path, 400, padding=20_000, compression='none')
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with replaying(peer, tmp_path, path, OURS) as (node, heard):
        peer.switch(node, 'set_pause', False)
        assert node.wait() == 2
        wait_until_still(heard)
        assert 0 < len(heard.raw[0]) < len(wanted[0])
        assert heard.raw[0][-1] == wanted[0][-1]
    assert node.err.count('damaged inside') == 1
    assert 'recover' in node.err


def test_what_cannot_be_played_is_one_line_and_exit_code_2(tmp_path, strangers_log):
    text = tmp_path / 'text.mcap'
    text.write_text('no log')
    path, _ = strangers_log
    late = tmp_path / 'late.mcap'
    file = create_file(late, [RecordedTopic('/chatter', 'std_msgs/msg/String')], {},
                       compression='none')
    file.append(0, 2 ** 63, string('late'))
    file.write_chunk()
    file.finish()
    for options, says in (
            ((late, '--clock'), '--clock: the log has times after January 2038'),
            ((tmp_path / 'missing.mcap',), 'No such file'),
            ((tmp_path,), 'no regular file'),
            ((text,), 'no MCAP'),
            ((path, '--topics', '/nobody'), '/chatter'),
            ((path, '--start', '99'), '1.180 s'),
            ((path, '--rate', '0'), 'argument -r/--rate: 0: must be a number in [1e-06, 1e+09]; '
             '--start-paused begins with a pause')):
        with Replay(tmp_path / 'node', *options) as node:
            assert node.wait() == 2
        assert says in node.err.splitlines()[-1], node.err
        assert 'Traceback' not in node.err


def test_loops_go_on_with_a_clock_that_never_goes_back(peer, tmp_path):
    path = tmp_path / 'run.mcap'
    wanted = write_log(path, 20)
    with replaying(peer, tmp_path, path, (*OURS, ('/clock', 'rosgraph_msgs/msg/Clock')), '--loop',
                   '--clock', '200') as (node, heard):
        text, twist, clock = heard.topics
        clock.wait(2)               # there while nothing is played, too
        peer.switch(node, 'set_pause', False)
        twist.wait(3 * len(wanted[1]))
        clock.wait_more(20)
        code = node.end()
        assert code == 0, node.err
        for topic, once in ((text, wanted[0]), (twist, wanted[1])):
            arrived = list(topic.raw)
            turns = -(-len(arrived) // len(once))
            assert_same([arrived], [(once * turns)[:len(arrived)]])
        times = [message.clock.sec * SECOND + message.clock.nanosec for message
                 in clock.messages()]
        assert times[0] == EPOCH_NS
        assert times == sorted(times)
        assert times[-1] > EPOCH_NS + 2 * (19 * 2_000_000 + ROUND_GAP_NS)


def test_a_log_of_one_moment_is_repeated_a_gap_apart(peer, tmp_path):
    path = tmp_path / 'moment.mcap'
    write_log(path, 2, step_ns=0)
    with replaying(peer, tmp_path, path, (*OURS, ('/clock', 'rosgraph_msgs/msg/Clock')), '--loop',
                   '--clock', '200') as (node, heard):
        peer.switch(node, 'set_pause', False)
        heard.topics[0].wait(5)
        clock = heard.topics[2].wait_more(20).last().clock
        assert clock.sec * SECOND + clock.nanosec - EPOCH_NS >= 4 * ROUND_GAP_NS
        answer = peer.switch(node, 'set_pause', True).message
        assert int(answer.split('round ')[1]) >= 5
        assert node.end() == 0, node.err


def test_pause_stands_still_however_often_it_is_asked_for(peer, tmp_path):
    path = tmp_path / 'run.mcap'
    wanted = write_log(path, 500)
    with replaying(peer, tmp_path, path, OURS, depth=250) as (node, heard):
        peer.switch(node, 'set_pause', False)
        heard.topics[0].wait(5)
        first, second = (peer.switch(node, 'set_pause', True) for _ in range(2))
        assert first.success
        assert second.success
        assert first.message.startswith('paused at')
        # Time stood between the two answers, whatever went on elsewhere.
        assert first.message == second.message
        assert node.alive
        assert [len(raw) for raw in heard.raw] != [len(topic) for topic in wanted]
        peer.switch(node, 'set_pause', False)
        assert node.wait() == 0
        wait_until_still(heard)
        assert_same(heard.raw, wanted)


def test_the_rate_is_a_parameter(peer, tmp_path):
    path = tmp_path / 'slow.mcap'
    wanted = write_log(path, 20, step_ns=1000 * SECOND)
    with replaying(peer, tmp_path, path, OURS, depth=10,
                   arguments=('-p', 'rate:=2')) as (node, heard):
        assert peer.get(node, 'rate') == [2.0]
        (refused,) = peer.set_each(node, rate=0.0)
        assert not refused.successful
        (refused,) = peer.set_each(node, rate='fast')
        assert 'must be a number' in refused.reason
        peer.switch(node, 'set_pause', False)
        (accepted,) = peer.set_each(node, rate=50_000)
        assert accepted.successful, accepted.reason
        assert node.wait() == 0         # 19000 s of log
        wait_until_still(heard)
        assert_same(heard.raw, wanted)


@pytest.mark.parametrize(('number', 'times'), [
    (signal.SIGINT, 1), (signal.SIGTERM, 1), (signal.SIGINT, 2)])
def test_a_signal_ends_it_properly(peer, tmp_path, number, times):
    write_log(tmp_path / 'run.mcap', 100, step_ns=SECOND)
    heard = Listening(peer, OURS)
    with Replay(tmp_path, tmp_path / 'run.mcap', '--rate', '20', '--clock') as node:
        heard.topics[0].wait(2)
        assert node.end(number, times) == 0, node.err
        assert 'Traceback' not in node.err


def test_a_signal_ends_it_while_it_waits_or_stands(peer, tmp_path):
    write_log(tmp_path / 'run.mcap', 100)
    for options in (('--wait-for-subscribers', '99'), ('--delay', '1000'), ('--start-paused',)):
        with Replay(tmp_path, tmp_path / 'run.mcap', *options) as node:
            # It serves before it plays.
            assert peer.switch(node, 'set_pause', True).success
            assert node.end(signal.SIGTERM) == 0, node.err
        assert 'Traceback' not in node.err
