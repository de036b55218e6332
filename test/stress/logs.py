# SPDX-License-Identifier: Apache-2.0
"""
Damaged logs: the reader, inspect, inspect --verify, recover, and what replay_node loads.

They are of ours or a stranger's, whole or torn.
"""

import argparse
import contextlib
import functools
import io
import json
import random
import re
import tempfile
import time
from pathlib import Path

from helpers.mutations import mutate
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools import inspect, recover, simulate

PATIENCE_S = 120.0
MEMORY_MB = 1000
PLAY_S = 10.0               # most are played in 0.3 s; times of one may lie anywhere
TERMINAL_CODES = re.compile(r'[\x00-\x08\x0b-\x1f\x7f-\x9f]')


def check(seed, folder):
    path = folder / 'run.mcap'
    rng = random.Random(seed)
    originals = original_logs()
    path.write_bytes(mutate(originals[seed % len(originals)], rng))
    content = path.read_bytes()
    came_of_it = [read(path), *inspected(path), recovered(path, folder), replayed(path)]
    assert path.read_bytes() == content, 'the log was changed'
    assert {entry.name for entry in folder.iterdir()} <= {'run.mcap', 'whole.mcap'}
    return ' '.join(came_of_it)


@functools.cache
def original_logs():
    """Return the bytes of logs to damage."""
    logs = []
    with tempfile.TemporaryDirectory() as folder:
        for number, more in enumerate((
                ['-p', 'solver.method:=rk45'], ['-p', 'record.compression:=none'],
                ['--command', '0.1:1.7:1.4', '-p', 'markers.enabled:=true'])):
            path = Path(folder, f'{number}.mcap')
            assert simulate.main(['-o', str(path), '--quiet', '--duration', '0.3', *more]) == 0
            logs.append(path.read_bytes())
    for compression in CompressionType:
        file = io.BytesIO()
        writer = Writer(file, chunk_size=2000, compression=compression)
        writer.start('ros2', 'stranger')
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
        channels = [writer.register_channel(f'/said_{number}', 'cdr', schema)
                    for number in range(3)]
        for number in range(300):
            writer.add_message(channels[number % 3], number * 1_000_000,
                               b'\0\1\0\0\5\0\0\0text\0', number)
        writer.add_attachment(0, 0, 'notes', 'text/plain', 500 * b'note ')
        writer.finish()
        logs.append(file.getvalue())
    return logs


def read(path):
    try:
        with LogReader(path) as reader:
            for message in reader.messages():
                assert isinstance(message.topic, str) and message.log_time >= 0
            reader.damage.lines()
    except LogError as error:
        assert str(path) in str(error) and '\n' not in str(error)
        return 'unreadable'
    return 'read'


def run(tool, *arguments):
    """Return the exit code and what a tool has printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = tool.main([str(argument) for argument in arguments])
    said = TERMINAL_CODES.search(out.getvalue() + err.getvalue())
    assert said is None, f'{tool.__name__} {arguments[1:]} prints {said.group()!r}'
    return code, out.getvalue(), err.getvalue()


def inspected(path):
    code, out, err = run(inspect, path)
    assert code in (0, 1) and (out or err.count('\n') == 1), err
    code, out, err = run(inspect, path, '--json')
    assert code in (0, 1)
    if out:
        json.loads(out, parse_constant=not_json)
    else:
        assert err.count('\n') == 1, err
    verified, out, err = run(inspect, path, '--verify')
    assert verified in (0, 1) and (out or err.count('\n') == 1), err
    return (f'inspect {code}', f'verify {verified}')


def not_json(name):
    raise AssertionError(f'{name} is not JSON')


def recovered(path, folder):
    output = folder / 'whole.mcap'
    code, _, err = run(recover, path, '-o', output)
    assert code in (0, 1, 3)
    assert output.exists() == (code != 1)
    assert err.count('\n') == (code == 1), err
    if output.exists():
        with output.open('rb') as file:
            messages = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
        with LogReader(output) as reader:
            assert reader.whole
            assert sum(1 for _ in reader.messages()) == messages
        again, _, _ = run(recover, output, '-o', folder / 'again.mcap')
        assert again == 0, 'what was recovered is whole'
        (folder / 'again.mcap').unlink()
    return f'recover {code}'


def replayed(path):
    """Play a log as replay_node does, in this process, to its end or for PLAY_S."""
    import helpers.own_domain  # noqa: F401
    import rclpy

    from spinning_top_sim.nodes import replay_node
    from spinning_top_sim.nodes.replayer import Replayer, open_log

    parser = argparse.ArgumentParser()
    replay_node.add_arguments(parser)
    options = parser.parse_args([str(path), '--rate', '1e9', '--partial'])
    rclpy.init()
    said = io.StringIO()
    try:
        with (contextlib.redirect_stdout(said), contextlib.redirect_stderr(said),
              open_log(path, True) as log):
            node = Replayer(log, options)
            node.start()
            end = time.monotonic() + PLAY_S
            while time.monotonic() < end and not node.finished.done():
                rclpy.spin_once(node, timeout_sec=0.01)
            node.stop()
            code = node.finished.result() if node.finished.done() else 'going on'
            node.destroy_node()
    except (LogError, ValueError) as error:
        assert '\n' not in str(error), error
        return 'replay refused'
    finally:
        rclpy.shutdown()
    played = re.search(r'played (\d+ messages)', said.getvalue())
    assert (played is not None) == (code == 0), said.getvalue()
    return f'replay {code}, {played[1]}' if played else f'replay {code}'
