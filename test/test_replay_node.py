# SPDX-License-Identifier: Apache-2.0
"""
Replays of logs, in this process and over real DDS.

No test is decided by how long something took, except that nothing may come before its time.
"""

import math
import sys
import time
from argparse import ArgumentParser
from fractions import Fraction
from functools import partial
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

import rclpy
import yaml
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.own_node import InThisProcess, run_main
from mcap.writer import Writer as McapWriter
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header, String

from spinning_top_sim.nodes import replay_node, replayer
from spinning_top_sim.nodes.replayer import Replayer, open_log
from spinning_top_sim.recording.rosbag2 import DEFAULT_QOS

EPOCH_NS, SECOND = 1_700_000_000_123_456_789, 1_000_000_000
STRING = 'std_msgs/msg/String'
TWO = (('/ours/chatter', STRING), ('/ours/names', STRING))


def text(number, padding=0):
    """Return a message as it comes off the wire, and so into logs: of a multiple of 4 bytes."""
    data = serialize_message(String(data=f'message {number}' + padding * '.'))
    return data + bytes(-len(data) % 4)


def write_log(path, messages, channels=TWO, **given):
    """Write a log: `messages` are channel, time and data; `channels` topic, type and profiles."""
    with path.open('wb') as file:
        log = McapWriter(file, **given)
        log.start('ros2')
        numbers = []
        for topic, kind, *profiles in channels:
            schema = log.register_schema(kind, 'ros2msg', b'') if kind else 0
            encoding = 'json' if topic == '/no_cdr' else 'cdr'
            numbers.append(log.register_channel(topic, encoding, schema, {
                'offered_qos_profiles': yaml.dump([{**DEFAULT_QOS, **one} for one in profiles])}))
        for channel, time_ns, data in messages:
            log.add_message(numbers[channel], time_ns, data, time_ns)
        log.finish()
    return path


def texts(count, step_ns=2_000_000, padding=0):
    """Return messages of two channels in turn."""
    return [(n % 2, EPOCH_NS + n * step_ns, text(n, padding)) for n in range(count)]


def of_each(messages):
    return [[data for channel, _, data in messages if channel == wanted] for wanted in (0, 1)]


class OwnReplay(InThisProcess):
    """A replay in this process; `heard` is topic and message of all that it publishes."""

    def __init__(self, file, *options):
        rclpy.init()
        parser = ArgumentParser()
        replay_node.add_arguments(parser)
        given = parser.parse_args([str(file), *options])
        self.node, self.heard = Replayer(open_log(given.file, given.partial), given), []
        for publisher in self.node.publishers:
            publisher.publish = partial(self.take, publisher.topic_name)

    def take(self, topic, message):
        self.heard.append((topic, message))

    def of(self, topic):
        return [data for name, data in self.heard if name == topic]


def play_all(file, *options):
    """Play a log to its end; return what was sent by channel, and the exit code."""
    with OwnReplay(file, *options) as replay:
        replay.spin_until('the end', replay.node.finished.done)
        return [replay.of(publisher.topic_name) for publisher in replay.node.outputs.values()], (
            replay.node.finished.result())


def schedule(replay, monkeypatch, cost_ns=0, plan=None):
    """
    Play with a clock that stands except for the waits of the timer and `cost_ns` of a message.

    plan: by time from the first message, what is done then
    Returns when each message was sent, from the first deadline on [ns].
    """
    begin_ns = 77 + replayer.ROUND_GAP_NS
    now, times, plan = [77], [], {begin_ns + at: act for at, act in (plan or {}).items()}
    timer = next(iter(replay.node.timers))

    def take(*_):
        times.append(now[0] - begin_ns)
        now[0] += cost_ns

    with monkeypatch.context() as patch:
        patch.setattr(replayer, 'time', SimpleNamespace(
            monotonic_ns=lambda: now[0], monotonic=time.monotonic))
        for publisher in replay.node.publishers:
            publisher.publish = take
        timer.callback()
        while not replay.node.finished.done():
            until, planned = now[0] + timer.timer_period_ns, min(plan, default=math.inf)
            now[0] = min(until, planned)
            if planned <= until:
                plan.pop(planned)()
            else:
                timer.callback()
    return times


def test_messages_keep_their_deadlines_late_ones_follow_at_once_and_a_pause_catches_nothing_up(
        tmp_path, monkeypatch):
    # Periods that no binary fraction is: rounding that added up would show at the end.
    path = write_log(tmp_path / 'run.mcap', texts(2_000, step_ns=33_333_333))
    with OwnReplay(path, '--rate', '3') as replay:
        for n, at in enumerate(schedule(replay, monkeypatch)):
            assert 0 <= at - Fraction(n * 33_333_333, 3) <= 8, 'not before its time'
        assert n == 1_999
    cost, path = 30_000_000, write_log(tmp_path / 'dense.mcap', texts(4, step_ns=1_000_000))
    with OwnReplay(path) as replay:
        assert schedule(replay, monkeypatch, cost) == [
            n * (cost + replayer.SHORTEST_WAIT_NS) for n in range(4)]
    begin, most = 1_000_000, replayer.SHORTEST_WAIT_NS
    with OwnReplay(path, '--start-paused') as replay:
        pause, resume = (partial(replay.switch, 'set_pause', on) for on in (True, False))
        times = schedule(replay, monkeypatch, plan={
            begin: resume, begin + 1_500_000: pause, begin + 9_500_000: resume})
    for at, due in zip(times, (0, 1_000_000, 10_000_000, 11_000_000), strict=True):
        assert 0 <= at - begin - due <= most


def test_start_and_topics_choose_what_is_played_and_what_is_not_taken_is_counted(
        tmp_path, capfd):
    path = write_log(tmp_path / 'run.mcap', texts(60, 20_000_000))
    raw, _ = play_all(path, '--topics', '/ours/chatter', '/nobody', '--start', '0.4', '--rate',
                      '100')
    assert raw == [[text(n) for n in range(20, 60, 2)]]
    said = capfd.readouterr()
    assert said.out == f'playing {path}\nplayed 20 messages\n'
    assert 'the log has no topic /nobody\n' in said.err
    with OwnReplay(path, '--rate', '100') as replay:
        replay.node.outputs[1].publish = None       # it raises, as with a reader that stalls
        replay.spin_until('the end', replay.node.finished.done)
    assert 'played 30 messages; 30 not published: a reader that' in capfd.readouterr().out


def test_odd_channels_and_times_do_not_stop_the_others(tmp_path, capfd):
    odd = [('/no_schema', ''), ('/no_package', '/msg/X'), ('/no_ros', 'antigravity/msg/X'),
           ('/unknown', 'nowhere_msgs/msg/Thing'),
           ('/no_cdr', STRING), ('no name!', STRING), ('/red\x1b[31m', STRING),
           ('/depth', STRING, {'depth': -5}), ('/plain', 'nowhere_msgs/msg/Thing')]
    # What was recorded before the first /clock has the time 0.
    path = write_log(tmp_path / 'odd.mcap', [
        (0, 0, text(0)), *((n, EPOCH_NS + n, text(n)) for n in range(1 + len(odd)))], [
            ('/plain', STRING), *odd])
    assert play_all(path)[0] == [[text(0), text(0)]]
    assert 'antigravity' not in sys.modules, 'only packages of ROS are imported'
    err = capfd.readouterr().err
    for name, *_ in odd:
        assert err.count(name.replace('\x1b', '\\x1b') + ' is not played') == 1, name
    assert '/unknown is not played: nowhere_msgs/msg/Thing: must be an installed type' in err
    assert '\x1b[31' not in err


def test_what_cannot_be_played_is_one_line_and_exit_code_2(tmp_path, capfd):
    """A torn log is played in part where that is asked for."""
    path = write_log(tmp_path / 'run.mcap', texts(60, 20_000_000))
    messages = texts(400, step_ns=100_000, padding=20_000)
    torn = write_log(tmp_path / 'torn.mcap', messages, chunk_size=100_000)
    with torn.open('r+b') as file:
        file.truncate(torn.stat().st_size // 2)
    for options, says in (
            ((tmp_path / 'missing.mcap',), 'No such file'), ((__file__,), 'no MCAP'),
            ((torn,), 'damaged: `recover` makes a whole log of it, --partial plays'),
            ((path, '--topics', '/nobody'), '/ours/chatter'),
            ((path, '--start', '99'), '--start 99: must be >= 0 and <= 1.18'),
            ((path, '--clock', '0'), '--clock 0: must be >= 1e-06 and <= 10000'),
            ((path, '--rate', '0'), '--rate 0: must be >= 1e-06 and <= 1e+09')):
        run = run_main(replay_node.main, capfd, *options)
        assert run.code == 2
        assert says in run.err.splitlines()[-1], run.err
        assert 'Traceback' not in run.err
    raw, code = play_all(torn, '--partial')
    assert code == 0
    for found, whole in zip(raw, of_each(messages), strict=True):
        assert 40 < len(found) < 160 and found == whole[:len(found)]


def test_each_round_begins_with_the_clock_of_its_begin(tmp_path):
    """What robot_state_publisher takes: stamps that go back after the time went back."""
    path = write_log(tmp_path / 'run.mcap', texts(21, 10_000_000))
    with OwnReplay(path, '--loop', '--clock', '40') as replay:
        replay.spin_until('three rounds', lambda: len(replay.of('/ours/chatter')) > 30)
    first, now_ns, rounds = text(0), 0, 0
    for topic, message in replay.heard:
        if topic == '/clock':
            before, now_ns = now_ns, message.clock.sec * SECOND + message.clock.nanosec
            assert EPOCH_NS <= now_ns <= EPOCH_NS + SECOND // 5
            rounds += now_ns < before
        elif message == first:
            assert now_ns == EPOCH_NS
    assert rounds >= 2


@pytest.mark.parametrize('has_clock', [False, True])
def test_only_without_a_clock_the_stamps_of_later_rounds_go_on(tmp_path, has_clock):
    messages = []
    for time_ns in range(EPOCH_NS, EPOCH_NS + SECOND // 5 + 1, SECOND // 100):
        header = Header(stamp=Time(nanoseconds=time_ns).to_msg(), frame_id='world')
        messages += [(0, time_ns, serialize_message(PathMessage(
            header=header, poses=[PoseStamped(header=header), PoseStamped()]))),
            (1, time_ns, text(7)),
            *has_clock * [(2, time_ns, serialize_message(Clock(clock=header.stamp)))]]
    path = write_log(tmp_path / 'run.mcap', messages, [
        ('/path', 'nav_msgs/msg/Path'), ('/chatter', STRING),
        *has_clock * [('/clock', 'rosgraph_msgs/msg/Clock')]])
    with OwnReplay(path, '--loop') as replay:
        replay.spin_until('three rounds', lambda: len(replay.of('/path')) >= 60)
    assert set(replay.of('/chatter')) == {text(7)}, 'what has no stamps keeps its bytes'
    paths = [one if isinstance(one, PathMessage) else deserialize_message(one, PathMessage)
             for one in replay.of('/path')]
    stamps = [Time.from_msg(one.header.stamp).nanoseconds for one in paths]
    assert stamps == [EPOCH_NS + (n % 21 if has_clock else n) * SECOND // 100
                      for n in range(len(stamps))]
    assert all(one.poses[0].header.stamp == one.header.stamp for one in paths)
    assert all(one.poses[1].header.stamp.nanosec == 0 for one in paths), '0 is no time'


def test_one_publisher_serves_all_whom_those_of_a_topic_have_served(tmp_path, capfd):
    latched = {'durability': 1, 'depth': 1}
    path = write_log(tmp_path / 'run.mcap', texts(2), (
        ('/names', STRING, {'reliability': 2, 'depth': 7}), ('/plain', STRING),
        ('/map', STRING, {'reliability': 2}, latched), ('/map', STRING, latched)))
    with OwnReplay(path) as replay:
        found = {one.topic_name: one.qos_profile for one in replay.node.publishers}
    reliable, best_effort = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
    assert [(found[name].reliability, found[name].depth) for name in ('/names', '/plain')] == [
        (best_effort, 7), (reliable, 10)]
    assert found['/map'].durability is DurabilityPolicy.TRANSIENT_LOCAL
    assert capfd.readouterr().err.count('/map was recorded with several QoS profiles: it is '
                                        'played as reliable and transient_local') == 1


def test_a_log_is_played_over_dds_until_a_signal(peer, tmp_path):
    path = write_log(tmp_path / 'run.mcap', [
        *texts(60, 20_000_000), (1, EPOCH_NS + 99 * SECOND, text('late'))])
    with SimNode(tmp_path, namespace='/', program=(
            '-m', 'spinning_top_sim', 'replay', str(path), '--start-paused'), arguments=(
                '-r', '/ours/names:=/names', '-p',
                'qos_overrides./names.publisher.depth:=30')) as node:
        node.name = '/replay'
        names = peer.listen('/names', String)
        # Once it answers, it has discovered the subscription, too.
        assert peer.switch(node, 'set_pause', True).success
        assert peer.switch(node, 'set_pause', False).success
        wait_for('all', lambda: len(names) >= 30)
        assert node.end() == 0 and 'Traceback' not in node.err
    assert names == of_each(texts(60))[1]
