# SPDX-License-Identifier: Apache-2.0
"""Logs of `simulate`, changed ones, and what `inspect` says of them."""

import json

from mcap.reader import make_reader
from mcap.writer import Writer

from spinning_top_sim.tools import inspect, simulate


def log_of(path, *arguments):
    assert simulate.main(['-o', str(path), '--quiet', *map(str, arguments)]) == 0
    return path


def told(capsys, *arguments):
    """Run inspect; return exit code, output and complaints."""
    code = inspect.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def as_json(capsys, *arguments):
    code, out, _ = told(capsys, *arguments, '--json')
    return code, json.loads(out)


def rewritten(source, target, change=lambda topic, number, data: data, metadata=None,
              stamp=lambda topic, number, stamp_ns: stamp_ns):
    """
    Copy a log with checksums that are right.

    change : takes topic, number in it and data of a message; returns other data, None to drop it,
        or a list of data
    metadata : what is another in the metadata of the run
    stamp : takes topic, number and log time [ns]; returns the log time
    """
    numbers = {}
    with open(source, 'rb') as old, open(target, 'wb') as new:
        reader, writer = make_reader(old), Writer(new)
        writer.start('ros2')
        for record in reader.iter_metadata():
            ours = metadata if record.name == 'spinning_top_sim' else None
            writer.add_metadata(record.name, {**record.metadata, **(ours or {})})
        summary = reader.get_summary()
        schemas = {number: writer.register_schema(schema.name, schema.encoding, schema.data)
                   for number, schema in summary.schemas.items()}
        channels = {number: writer.register_channel(
            channel.topic, channel.message_encoding, schemas[channel.schema_id],
            channel.metadata) for number, channel in summary.channels.items()}
        for _, channel, message in reader.iter_messages():
            topic = channel.topic
            number = numbers[topic] = numbers.get(topic, -1) + 1
            data, at_ns = (change(topic, number, message.data),
                           stamp(topic, number, message.log_time))
            for one in data if isinstance(data, list) else [data]:
                if one is not None:
                    writer.add_message(channels[channel.id], at_ns, one, at_ns)
        writer.finish()
    return target
