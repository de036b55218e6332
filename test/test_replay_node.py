# SPDX-License-Identifier: Apache-2.0
"""
Replay nodes over real DDS.

No test is decided by how long something took, except that nothing may come before its time.
"""

import re
import signal
import time
from itertools import pairwise

import pytest

pytest.importorskip('rclpy')

import rclpy
import yaml
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, Topic, wait_for
from helpers.own_node import InThisProcess, run_main
from helpers.recordings import write_rows
from mcap.writer import Writer as McapWriter
from nav_msgs.msg import Path as PathMessage
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from spinning_top_sim.nodes import replay_node
from spinning_top_sim.nodes.endpoints import message_class
from spinning_top_sim.nodes.replayer import Replayer, open_log
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS, RecordedTopic

EPOCH_NS = 1_700_000_000_123_456_789
JAZZY = get_typestore(Stores.ROS2_JAZZY)
SECOND = 1_000_000_000
STRING, TWIST, THING = 'std_msgs/msg/String', 'geometry_msgs/msg/Twist', 'nowhere_msgs/msg/Thing'


def string_cdr(number, padding=0):
    text = f'message {number}' + padding * '.'
    data = JAZZY.serialize_cdr(JAZZY.types[STRING](text), STRING).tobytes()
    return data + bytes(-len(data) % 4)     # as it comes off the wire, and so into logs


def twist_cdr(number):
    vector = JAZZY.types['geometry_msgs/msg/Vector3']
    twist = JAZZY.types[TWIST](vector(1.0, 2.0, float(number)), vector(0.0, 0.5, -0.5))
    return JAZZY.serialize_cdr(twist, TWIST).tobytes()


OURS = (('/ours/text', STRING), ('/ours/twist', TWIST))


def write_log(path, count, step_ns=2_000_000, padding=0, topics=OURS):
    """Record strings and twists in turn; return what is in, by topic."""
    messages = [(n % 2, EPOCH_NS + n * step_ns,
                 twist_cdr(n) if n % 2 else string_cdr(n, padding)) for n in range(count)]
    (text, _), (twist, _) = topics
    write_rows(path, [RecordedTopic(text, STRING),
                      RecordedTopic(twist, TWIST, {'depth': 7, 'reliability': 2})], messages, 100)
    return [[data for index, _, data in messages if index == topic] for topic in (0, 1)]


@pytest.fixture(scope='module')
def second_log(tmp_path_factory):
    """Return a log of 1.18 s and what is in, by topic."""
    path = tmp_path_factory.mktemp('log') / 'run.mcap'
    return path, write_log(path, 60, 20_000_000, topics=(
        ('/chatter', STRING), ('/robot/cmd_vel', TWIST)))


def assert_same(found, wanted):
    """Compare lists of messages by topic; pytest takes minutes to show how long ones differ."""
    assert [len(messages) for messages in found] == [len(messages) for messages in wanted]
    for of_found, of_wanted in zip(found, wanted, strict=True):
        for number, pair in enumerate(zip(of_found, of_wanted, strict=True)):
            assert pair[0] == pair[1], f'message {number}'


class Sink:
    """Takes the messages of a publisher."""

    def __init__(self, publisher):
        self.topic_name, self.msg_type = publisher.topic_name, publisher.msg_type
        self.raw = []

    def publish(self, message):
        self.raw.append(message if isinstance(message, bytes) else serialize_message(message))

    def get_subscription_count(self):
        return 0


class OwnReplay(InThisProcess):
    """A replay in this process; `raw` are the messages by topic, in the order of `topics`."""

    def __init__(self, file, *options, topics=OURS, arguments=()):
        rclpy.init(args=['replay_node', '--ros-args', *arguments])
        given = replay_node._parser().parse_args([str(file), *options])
        self.node = Replayer(open_log(given.file, given.partial), given)
        sinks = {}
        for channel, publisher in self.node.outputs.items():
            self.node.outputs[channel] = sinks.setdefault(publisher.topic_name, Sink(publisher))
        self.sinks = [sinks[name] for name, _ in topics]

    @property
    def raw(self):
        return [list(sink.raw) for sink in self.sinks]

    def spin_until(self, what, condition):
        wait_for(what, lambda: rclpy.spin_once(self.node, timeout_sec=0.1) or condition())

    def wait(self):
        """Wait for the end; return the exit code."""
        self.spin_until('the end', self.node.finished.done)
        return self.node.finished.result()

    def set_rate(self, rate):
        return self.node.set_parameters([Parameter('rate', value=rate)])[0]


def play_all(file, *options, **given):
    """Play a log to its end; return what was sent by topic, and what the node has said."""
    with OwnReplay(file, *options, **given) as replay:
        code = replay.wait()
        return replay.raw, code


def test_all_bytes_are_sent_to_the_last_message_and_none_before_its_time(tmp_path, capfd):
    wanted = write_log(tmp_path / 'run.mcap', 1_000, step_ns=200_000)
    begin = time.monotonic()
    raw, code = play_all(tmp_path / 'run.mcap', '--rate', '2')
    assert time.monotonic() - begin >= 0.1998 / 2.0
    assert_same(raw, wanted)
    said = capfd.readouterr()
    assert code == 0 and 'played 1000 messages on 2 topics' in said.out
    assert said.err == ''


def test_start_and_topics_choose_what_is_played(second_log, capfd):
    path, wanted = second_log
    raw, _ = play_all(path, '--topics', '/chatter', '/nobody', 'cmd_vel', '--start', '0.4',
                      '--rate', '100', topics=[('/chatter', STRING)])
    assert_same(raw, [wanted[0][10:]])
    said = capfd.readouterr()
    assert 'the log has no topic /nobody\n' in said.err
    assert 'the log has no topic cmd_vel' in said.err
    assert 'on 1 topics' in said.out


def test_one_odd_channel_does_not_stop_the_others(tmp_path, capfd):
    qos = {'/plain': {}, '/liveliness': {'liveliness': 2}, '/depth': {'depth': -5}}
    odd = {'/no_schema': (0, 'cdr'), '/no_type': (3, 'cdr'), '/no_package': (4, 'cdr'),
           '/unknown': (5, 'cdr'), '/no_cdr': (1, 'json'), 'no name!': (1, 'cdr'),
           '/rosout': (1, 'cdr'), '//twice': (1, 'cdr'),
           '/' + 500 * 'x': (1, 'cdr'), '/red\x1b[31m': (1, 'cdr')}
    path = tmp_path / 'odd.mcap'
    with path.open('wb') as file:
        log = McapWriter(file)
        log.start('ros2')
        for name in (STRING, TWIST, 'no type; at all', '/msg/X', THING):
            log.register_schema(name, 'ros2msg', b'')
        channels = [log.register_channel(name, 'cdr', 1, {
            'offered_qos_profiles': yaml.dump([{**DEFAULT_QOS, **profile}])})
            for name, profile in qos.items()]
        channels += [log.register_channel(name, encoding, schema)
                     for name, (schema, encoding) in odd.items()]
        for n, channel in enumerate(channels):
            log.add_message(channel, EPOCH_NS + n, string_cdr(n), EPOCH_NS + n)
        log.finish()
    raw, _ = play_all(path, topics=[('/plain', STRING)])
    assert_same(raw, [[string_cdr(0)]])
    err = re.sub('>>> .*?<<<\n', '', capfd.readouterr().err, flags=re.DOTALL)     # of rcutils
    for name in (*odd, '/liveliness', '/depth'):
        shown = name if len(name) < 300 else name[:300]
        assert err.count(shown.replace('\x1b', '\\x1b') + (
            ' is not played' if shown == name else ' ... ')) == 1
    assert f'/unknown is not played: {THING} is not installed' in err
    assert '\x1b[31' not in err
    assert '/liveliness is not played: 2 is not a valid' in err


def test_a_torn_log_is_refused_with_a_hint_and_played_in_part(tmp_path, capfd):
    path = tmp_path / 'torn.mcap'
    wanted = write_log(path, 400, step_ns=100_000, padding=20_000)
    whole = path.read_bytes()
    path.write_bytes(whole[:len(whole) // 2])
    run = run_main(replay_node.main, capfd, path)
    (line,) = run.err.splitlines()
    assert run.code == 2 and 'damaged' in line and 'recover' in line and '--partial' in line
    raw, code = play_all(path, '--partial')
    assert code == 0 and 'damaged' in capfd.readouterr().err
    for found, all_of_it in zip(raw, wanted, strict=True):
        assert 40 < len(found) < 110
        assert_same([found], [all_of_it[:len(found)]])


def test_what_cannot_be_played_is_one_line_and_exit_code_2(tmp_path, second_log, capfd):
    text = tmp_path / 'text.mcap'
    text.write_text('no log')
    path, _ = second_log
    for options, says in (
            ((tmp_path / 'missing.mcap',), 'No such file'),
            ((text,), 'no MCAP'),
            ((path, '--topics', '/nobody'), '/chatter'),
            ((path, '--start', '99'), '1.180 s'),
            ((path, '--rate', '0'), 'argument -r/--rate: 0: must be a number >= 1e-06 and <= 1e+09')):
        run = run_main(replay_node.main, capfd, *options)
        assert run.code == 2
        assert says in run.err.splitlines()[-1], run.err
        assert 'Traceback' not in run.err


@pytest.mark.parametrize('step_ns', [2_000_000, 0])
def test_loops_begin_again(tmp_path, step_ns, capfd):
    path = tmp_path / 'run.mcap'
    wanted = write_log(path, 10, step_ns=step_ns)
    with OwnReplay(path, '--loop') as replay:
        replay.spin_until('three rounds', lambda: len(replay.raw[1]) >= 3 * len(wanted[1]))
        replay.spin_until('the status', lambda: 'of round ' in capfd.readouterr().out)
        for found, once in zip(replay.raw, wanted, strict=True):
            turns = -(-len(found) // len(once))
            assert_same([found], [(once * turns)[:len(found)]])


def test_the_rate_is_a_parameter(tmp_path):
    wanted = write_log(tmp_path / 'slow.mcap', 20, step_ns=1000 * SECOND)
    with OwnReplay(tmp_path / 'slow.mcap', arguments=('-p', 'rate:=2')) as replay:
        assert replay.node.get_parameter('rate').value == 2.0
        assert not replay.set_rate(0.0).successful
        assert 'must be a number' in replay.set_rate('fast').reason
        assert replay.set_rate(200_000).successful
        assert replay.wait() == 0         # 19000 s of log
        assert_same(replay.raw, wanted)


# As where rclpy has no EventsExecutor.
ON_ONE_THREAD = ('-c', "import sys; sys.modules['rclpy.experimental'] = None\n"
                 'from spinning_top_sim.__main__ import main; sys.exit(main())')
EXECUTORS = {'events': ('-m', 'spinning_top_sim'), 'single-threaded': ON_ONE_THREAD}


class Replay(SimNode):
    """A replay_node in its own process group."""

    def __init__(self, folder, file, *options, arguments=(), executor='events'):
        super().__init__(folder, namespace='/', arguments=arguments, program=(
            *EXECUTORS[executor], 'replay', str(file), *options))
        self.name = f'{self.namespace}/replay'


@pytest.mark.parametrize('executor', EXECUTORS)
def test_a_log_is_played_over_dds_with_its_qos_or_another(peer, tmp_path, second_log, executor):
    """It waits for two subscribers and the resume; /clock tells the time of the log meanwhile."""
    path, wanted = second_log
    names = ('/chatter', '/elsewhere/vel', '/clock')
    with Replay(tmp_path, path, '--start-paused', '--clock', '200', '--rate', '2', '-d', '0.1',
                '--wait-for-subscribers', '3', executor=executor, arguments=(
                    '-r', '/robot/cmd_vel:=/elsewhere/vel', '-p', 'rate:=0.001', '-p',
                    'qos_overrides./chatter.publisher.depth:=30', '-p',
                    'qos_overrides./elsewhere/vel.publisher.depth:=30')) as node:
        text = peer.listen(names[0], message_class(STRING))
        velocity = peer.listen(names[1], message_class(TWIST), ReliabilityPolicy.BEST_EFFORT)
        clock = peer.listen(names[2], message_class('rosgraph_msgs/msg/Clock')).wait(2)
        reliabilities = {}
        for name in names[:2]:
            # Nodes of earlier tests stay in the graph for a while.
            (info,) = wait_for(f'one publisher of {name}', lambda name=name: [
                found for found in [peer.node.get_publishers_info_by_topic(name)]
                if len(found) == 1])[0]
            reliabilities[name] = info.qos_profile.reliability.name
        assert reliabilities == {'/chatter': 'RELIABLE', '/elsewhere/vel': 'BEST_EFFORT'}
        assert peer.switch(node, 'set_pause', False).success
        assert node.wait() == 0, node.err
        wait_for('all', lambda: len(text.raw) == len(wanted[0]))
    assert_same([text.raw], wanted[:1])
    # What nobody acknowledges may get lost, but neither change nor change places.
    numbers = [wanted[1].index(data) for data in velocity.raw]
    assert numbers and numbers == sorted(set(numbers))
    times = [message.clock.sec * SECOND + message.clock.nanosec for message in clock.messages()]
    assert times[0] == EPOCH_NS and times == sorted(times) and times[-1] > EPOCH_NS + SECOND // 2


def write_bag(path, messages, channels):
    """Write a log: `messages` are channel, time and data; `channels` topic, type and profiles."""
    with path.open('wb') as file:
        log = McapWriter(file)
        log.start('ros2')
        numbers = [log.register_channel(
            topic, 'cdr', log.register_schema(kind, 'ros2msg', b''),
            {'offered_qos_profiles': yaml.dump([{**DEFAULT_QOS, **one} for one in profiles])})
            for topic, kind, profiles in channels]
        for channel, time_ns, data in messages:
            log.add_message(numbers[channel], time_ns, data, time_ns)
        log.finish()
    return path


LATCHED = {'durability': 1, 'depth': 1}


@pytest.mark.parametrize('channels', [
    [('/map', STRING, [LATCHED]), ('/map', STRING, [LATCHED])],
    [('/map', STRING, [LATCHED, LATCHED])], [('/map', STRING, [{'reliability': 2}, LATCHED, {}])]])
def test_who_comes_late_gets_what_all_latched_publishers_sent(peer, tmp_path, channels):
    write_bag(tmp_path / 'run.mcap', [(0, EPOCH_NS, string_cdr(0)),
              (len(channels) - 1, EPOCH_NS + 1, string_cdr(1)),
              (len(channels), EPOCH_NS + 2, string_cdr(2)),
              (len(channels), EPOCH_NS + 99 * SECOND, string_cdr(3))],
              [*channels, ('/chatter', STRING, [LATCHED])])
    late = QoSProfile(depth=9, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with Replay(tmp_path, tmp_path / 'run.mcap') as node:
        wait_for('messages', lambda: '| 3 messages' in node.out)
        found = Topic(message_class(STRING))
        subscription = peer.node.create_subscription(
            found.kind, '/map', found.receive, late, raw=True)
        found.wait(2)
        assert node.end() == 0
    peer.node.destroy_subscription(subscription)
    assert sorted(found.raw) == [string_cdr(0), string_cdr(1)]
    assert node.err.count('/map was recorded with several QoS profiles: it is played as '
                          'reliable and transient_local') == (
        len(channels[0][2]) == 3)


def test_messages_of_a_time_before_the_first_clock_do_not_make_it_wait(tmp_path, capfd):
    path = write_bag(tmp_path / 'run.mcap', [
        (0, 0, string_cdr(0)), (0, 600 * SECOND, string_cdr(1)),
        (0, 600 * SECOND + 1, string_cdr(2))], [('/ours/text', STRING, [])])
    raw, _ = play_all(path, topics=OURS[:1])
    assert_same(raw, [[string_cdr(n) for n in range(3)]])
    assert '0 of them late' in capfd.readouterr().out


def test_what_a_stalled_reader_does_not_take_is_counted(tmp_path, capfd):
    write_log(tmp_path / 'run.mcap', 10)
    with OwnReplay(tmp_path / 'run.mcap') as replay:
        replay.sinks[0].publish = None      # a call of it raises an error
        assert replay.wait() == 0
    assert ('played 5 messages on 2 topics, 0 of them late; 5 not published: a reader that keeps '
            'all has stalled') in capfd.readouterr().out


def stamped_log(path):
    """Record 21 joint states and paths in 0.2 s, whose last poses have no stamps."""
    messages = []
    for n in range(21):
        stamp = Time(nanoseconds=EPOCH_NS + n * SECOND // 100).to_msg()
        header = Header(stamp=stamp, frame_id='world')
        for channel, message in enumerate((
                JointState(header=header, name=['joint'], position=[1.0]),
                PathMessage(header=header, poses=[PoseStamped(header=header), PoseStamped()]))):
            messages.append((channel, EPOCH_NS + n * SECOND // 100, serialize_message(message)))
    return write_bag(path, messages, [('/joint_states', 'sensor_msgs/msg/JointState', []),
                                      ('/path', 'nav_msgs/msg/Path', [])])


def test_without_a_clock_the_stamps_of_later_rounds_go_on(tmp_path):
    with OwnReplay(stamped_log(tmp_path / 'run.mcap'), '--loop', topics=[
            ('/joint_states', None), ('/path', None)]) as replay:
        replay.spin_until('three rounds', lambda: len(replay.raw[1]) >= 60)
        joints, paths = ([deserialize_message(data, sink.msg_type) for data in sink.raw]
                              for sink in replay.sinks)
        first = replay.raw[0][:21]
    stamps = [Time.from_msg(message.header.stamp).nanoseconds for message in joints]
    assert stamps[:21] == [EPOCH_NS + n * SECOND // 100 for n in range(21)]
    assert {later - before for before, later in pairwise(stamps)} == {SECOND // 100}
    assert [Time.from_msg(message.poses[0].header.stamp).nanoseconds
            for message in paths][:60] == stamps[:60]
    assert all(one.poses[1].header.stamp.sec == 0 for one in paths), '0 is no time'
    with LogReader(tmp_path / 'run.mcap') as log:
        assert first == [one.data for one in log.messages(['/joint_states'])]


def test_with_a_clock_each_round_begins_with_the_clock_of_its_begin(peer, tmp_path):
    """What robot_state_publisher takes: stamps that go back after the time went back."""
    stamped_log(tmp_path / 'run.mcap')
    with Replay(tmp_path, tmp_path / 'run.mcap', '--loop', '--clock', '500') as node:
        heard = []
        for kind, topic in (('rosgraph_msgs/msg/Clock', '/clock'),
                            ('sensor_msgs/msg/JointState', '/joint_states')):
            peer.node.create_subscription(message_class(kind), topic, heard.append, 5000)
        wait_for('three rounds', lambda: len(heard) > 500)
        assert node.end() == 0
    now_ns, newest_ns, rounds = 0, 0, 0
    for message in heard:
        if hasattr(message, 'clock'):
            before, now_ns = now_ns, Time.from_msg(message.clock).nanoseconds
            if now_ns < before:
                newest_ns, rounds = 0, rounds + 1
            assert EPOCH_NS <= now_ns <= EPOCH_NS + SECOND // 5
        else:
            stamp_ns = Time.from_msg(message.header.stamp).nanoseconds
            assert stamp_ns >= newest_ns + SECOND // 100
            newest_ns = stamp_ns
    assert rounds >= 2


def test_a_signal_ends_it_while_it_waits_or_plays(peer, tmp_path):
    write_log(tmp_path / 'run.mcap', 100, step_ns=SECOND)
    for options, number, times in ((('--wait-for-subscribers', '99'), signal.SIGTERM, 1),
                                   (('--rate', '0.5', '--clock'), signal.SIGINT, 2)):
        with Replay(tmp_path, tmp_path / 'run.mcap', *options) as node:
            # It serves before it plays, and plays for longer than the switch is repeated.
            assert peer.switch(node, 'set_pause', False).success
            assert node.end(number, times) == 0, node.err
        assert 'Traceback' not in node.err
