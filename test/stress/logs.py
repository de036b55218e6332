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

from helpers.inspected import log_of
from helpers.logs import STRANGERS, run, seen_by_mcap, seen_by_us, write_stranger
from helpers.mutations import mutate

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.tools import inspect, recover

PATIENCE_S = 120.0
MEMORY_MB = 1000
PLAY_S = 10.0               # most are played in 0.3 s; times of one may lie anywhere
TERMINAL_CODES = re.compile(r'[\x00-\x08\x0b-\x1f\x7f-\x9f]')


def check(seed, folder):
    path = folder / 'run.mcap'
    originals = original_logs()
    content = mutate(originals[seed % len(originals)], random.Random(seed))
    path.write_bytes(content)
    came_of_it = [read(path), *inspected(path), recovered(path, folder), replayed(path)]
    assert path.read_bytes() == content, 'the log was changed'
    assert {entry.name for entry in folder.iterdir()} <= {'run.mcap', 'whole.mcap'}
    return ' '.join(came_of_it)


@functools.cache
def original_logs():
    """Return the bytes of logs to damage."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [log_of(Path(folder, f'{number}.mcap'), '--duration', 0.3, *more)
                 for number, more in enumerate((
                    ('-p', 'solver.method:=rk45'), ('-p', 'record.compression:=none'),
                    ('--command', '0.1:1.7:1.4', '-p', 'markers.enabled:=true')))]
        for options in STRANGERS.values():
            paths.append(Path(folder, f'{len(paths)}.mcap'))
            write_stranger(paths[-1], options)
        return [path.read_bytes() for path in paths]


def read(path):
    try:
        for topic, stamp_ns, _ in seen_by_us(path):
            assert isinstance(topic, str) and stamp_ns >= 0
    except LogError as error:
        assert str(path) in str(error) and '\n' not in str(error)
        return 'unreadable'
    return 'read'


def checked(tool, *arguments):
    """Return the exit code and what a tool has printed."""
    code, out, err = run(*arguments, tool=tool)
    said = TERMINAL_CODES.search(out + err)
    assert said is None, f'{tool.__name__} {arguments[1:]} prints {said.group()!r}'
    assert out or err.count('\n') == 1, err
    return code, out


def inspected(path):
    code, _ = checked(inspect, path)
    as_json, out = checked(inspect, path, '--json')
    if out:
        json.loads(out, parse_constant=not_json)
    verified, _ = checked(inspect, path, '--verify')
    assert {code, as_json, verified} <= {0, 1}
    return (f'inspect {code}', f'verify {verified}')


def not_json(name):
    raise AssertionError(f'{name} is not JSON')


def recovered(path, folder):
    output = folder / 'whole.mcap'
    code, _ = checked(recover, path, '-o', output)
    assert code in (0, 1, 3) and output.exists() == (code != 1)
    if output.exists():
        assert len(seen_by_mcap(output)) == len(seen_by_us(output))
        again, _ = checked(recover, output, '-o', folder / 'again.mcap')
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
