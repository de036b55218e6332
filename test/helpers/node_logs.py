# SPDX-License-Identifier: Apache-2.0
"""Reading what a node has published and recorded, and what tests of it share."""

import contextlib
import io
import json
from pathlib import Path

from mcap.reader import make_reader

from spinning_top_sim.tools import inspect

SECOND = 1_000_000_000
TRACEBACK = 'Traceback (most recent call last)'


def stamp_of(data):
    """Return the stamp [ns] of a serialized message that begins with a header."""
    sec = int.from_bytes(data[4:8], 'little', signed=True)
    return sec * SECOND + int.from_bytes(data[8:12], 'little')


def xyzw(q):
    return q.x, q.y, q.z, q.w


def xyz(v):
    return v.x, v.y, v.z


def log_of(path):
    """Return {topic: [(log time, bytes)]} and the metadata of a log, by the mcap package."""
    with Path(path).open('rb') as file:
        reader = make_reader(file)
        log = {channel.topic: [] for channel in reader.get_summary().channels.values()}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            log[channel.topic].append((message.log_time, message.data))
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    return log, metadata


def the_log(folder):
    (path,) = Path(folder).glob('*.mcap')
    return path


def verified(path):
    """Return what `inspect --verify` says of a log: it computes the run from its journal."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        inspect.main([str(path), '--verify', '--json'])
    return json.loads(out.getvalue())['verify']


def events_in(log):
    """Return the journal of a log: one JSON object a std_msgs/String."""
    (rows,) = [rows for topic, rows in log.items() if topic.endswith('/events')]
    return [json.loads(data[8:].rstrip(b'\0')) for _, data in rows]
