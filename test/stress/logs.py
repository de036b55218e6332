# SPDX-License-Identifier: Apache-2.0
"""
Damaged logs: the reader, inspect, inspect --verify, recover, and what replay_node loads.

They are of ours or a stranger's, whole or torn.
"""

import functools
import gc
import json
import random
import re
import tempfile
from pathlib import Path

import pytest
from helpers.inspected import log_of
from helpers.logs import STRANGERS, run, seen_by_mcap, seen_by_us, write_stranger
from helpers.mutations import mutate

from spinning_top_sim.nodes import replay_node
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.tools import inspect, recover

PATIENCE_S = 120.0
MEMORY_MB = 1000
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
    """Play a log to its end; at this rate the latest log time comes after 18 s."""
    pytest.importorskip('rclpy')
    code, out, err = run(path, '--rate', '1e9', '--partial', tool=replay_node)
    gc.unfreeze()           # as a process of its own needs no garbage collector
    played = re.search(r'played (\d+ messages)', out)
    assert (code == 0 and played) or (code == 2 and (played or err.count('\n') == 1)), out + err
    return f'replay {code}, {played[1]}' if played else 'replay refused'
