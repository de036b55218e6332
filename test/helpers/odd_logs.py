# SPDX-License-Identifier: Apache-2.0
"""
Logs of this package with odd metadata, journal entries, stamps and samples, at random.

`odd_log(path, rng)` writes one.  The files are whole MCAP: only what is in them is odd.
"""

import functools
import json
import math
import tempfile
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from spinning_top_sim.streams import messages
from spinning_top_sim.tools import simulate

METADATA = 'spinning_top_sim'
TEXTS = ('', ' ', '[]', '{}', 'null', 'true', 'NaN', '-Infinity', '"', '""', '"\\ud800"', '1e400',
         '-1', '0.5', '[' * 100_000, '{"a":' * 50_000, '[[' * 300 + ']]' * 300, '9' * 5000,
         '-' + '9' * 5000, str(2 ** 63), str(2 ** 64), str(-2 ** 63), '[[0, 1.5]]', '[[1, 2, 3]]',
         '[[-1, NaN, 1e308]]', '{"spin.l3": []}', '\x1b[2J\x07', 'tab\tnew\nline', '\x00')
VALUES = (None, True, False, 0, -1, 1, 1.5, -0.0, 1e-320, 1e-12, 1e9, 1e15, 1e18, 1e300, -1e308,
          math.nan, math.inf, -math.inf, 2 ** 31, 2 ** 63, 2 ** 64, -2 ** 63, 10 ** 400, '',
          'pose', '\ud800', '\x1b]0;title\x07', 'x' * 100_000, [], [[]], [0], [1.0, 2.0, 3.0],
          ['all'], {}, {'a': {'b': []}}, {'parameters': {}})
STAMPS = (0, 1, 2 ** 31, 2 ** 62, 2 ** 63 - 1, 2 ** 63, 2 ** 64 - 1)
MOST_SAME = 300             # copies of an entry


@functools.cache
def _recorded(method):
    """Return metadata, schemas, channels and messages of a log of this package."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'run.mcap'
        assert simulate.main([
            '-o', str(path), '--quiet', '--duration', '0.4', '-p', f'solver.method:={method}',
            '--command', '0.1:1.7:1.4', '--command', '0.3:1.5:1.4',
            '-p', 'imu.gyroscope_noise_density:=0.01', '-p', 'markers.enabled:=true']) == 0
        with open(path, 'rb') as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            metadata = next(record.metadata for record in reader.iter_metadata()
                            if record.name == METADATA)
            logged = [(channel.topic, message.log_time, message.data)
                      for _, channel, message in reader.iter_messages()]
    return metadata, summary.schemas, summary.channels, logged


def _odd_number(rng, number):
    """Return a number near, or of another size or sign, or something else."""
    return rng.choice((number + 1, number - 1, -number, number * 1000, number // 2, str(number),
                       float(number), *VALUES))


def _odd_parameters(rng, text):
    """Return the JSON text of parameters, some of them odd."""
    values = json.loads(text)
    for name in rng.sample(sorted(values), rng.randint(1, 3)):
        if rng.random() < 0.2:
            del values[name]
        else:
            values[name] = rng.choice(VALUES)
    if rng.random() < 0.1:
        values[rng.choice(('', 'no.such', '\ud800'))] = rng.choice(VALUES)
    return _dumps(values)


def _dumps(value):
    """Return JSON; integers of any length."""
    return json.dumps(value).replace('1' + 400 * '0', '1' + 5000 * '0')


def _odd_metadata(rng, metadata):
    """Return the metadata with an odd value or two."""
    odd = dict(metadata)
    for name in rng.sample(sorted(odd), rng.randint(1, 2)):
        kind = rng.random()
        if kind < 0.1:
            del odd[name]
        elif kind < 0.5 and name.startswith('parameters'):
            odd[name] = _odd_parameters(rng, odd[name])
        elif kind < 0.5 and name.endswith('_ns'):
            odd[name] = str(_odd_number(rng, int(odd[name])))
        else:
            odd[name] = rng.choice(TEXTS)
    return {name: value.encode(errors='replace').decode() for name, value in odd.items()}


def _odd_entry(rng, data):
    """Return an odd entry of the journal: most are well-formed JSON, as it would be written."""
    entry = json.loads(data[8:-1])
    kind = rng.random()
    if kind < 0.1:
        return data[:rng.randrange(max(len(data), 1))]
    if kind < 0.2:
        return messages.string(rng.choice(TEXTS))
    if kind < 0.45:
        entry['event'] = rng.choice(('start', 'command', 'state', 'parameters', 'reset', 'end',
                                     *VALUES))
    for name in ('t_ns', 'sent_ns'):
        if rng.random() < 0.3:
            entry[name] = _odd_number(rng, entry[name])
    if entry['event'] == 'parameters' and rng.random() < 0.8:
        entry.pop('l3', None), entry.pop('lz', None)
        entry[rng.choice(('pose.rate', 'imu.rate', 'clock.rate', 'status_period', 'x'))] = (
            rng.choice((1.0, 50.0, 1e-9, *VALUES)))
    if entry['event'] == 'reset' and rng.random() < 0.8:
        entry['epoch_ns'] = rng.choice((1_200_000_000, 1_400_000_000, *STAMPS, *VALUES))
        entry['parameters'] = rng.choice(({}, {'spin.l3': 2.0}, {'pose.rate': 1e-9}, *VALUES))
    if rng.random() < 0.3:
        entry[rng.choice(sorted(entry))] = rng.choice(VALUES)
    if rng.random() < 0.1:
        del entry[rng.choice(sorted(entry))]
    return messages.string(_dumps(entry))


def _odd_sample(rng, data):
    """Return a sample with another size, or with odd bytes at its end."""
    if rng.random() < 0.3:
        return data[:rng.randrange(max(len(data), 1))]
    count = rng.randint(1, 8) * 8
    return data[:-count] + rng.choice((b'\0' * count, b'\xff' * count, b'\xff\xef' * (count // 2),
                                       rng.randbytes(count)))


def _odd(rng, kinds, topic, stamp_ns, data):
    """Return a message that is odd in these ways, and how often it is there."""
    copies = 1
    if 'journal' in kinds:
        data, copies = _odd_entry(rng, data), rng.choice((0, 1, 1, 1, 1, 2, MOST_SAME))
    if 'samples' in kinds:
        data = _odd_sample(rng, data)
    if 'stamps' in kinds:
        stamp_ns = rng.choice(STAMPS)
    return (topic, stamp_ns, data), copies


def odd_log(path, rng):
    """Write a log that is odd as these random numbers have it; return the path."""
    metadata, schemas, channels, logged = _recorded(rng.choice(('rk45', 'exact')))
    kinds = rng.sample(('metadata', 'journal', 'stamps', 'samples', 'names'), rng.randint(1, 2))
    numbers = [number for number, (topic, _, _) in enumerate(logged)
               if topic.endswith('/events') == ('journal' in kinds)]
    chosen = set(rng.sample(numbers, min(rng.randint(1, 4), len(numbers))))
    names = {}
    if 'names' in kinds:
        names[rng.choice(sorted(channel.topic for channel in channels.values()))] = rng.choice(
            ('', '/', '/\x1b[31mred', '/pose', '/a\nb', '/' + 'x' * 10_000, '\u202e/desop'))
    compression = rng.choice((CompressionType.NONE, CompressionType.ZSTD))
    with open(path, 'wb') as file:
        writer = Writer(file, compression=compression, chunk_size=rng.choice((10_000, 1 << 20)))
        writer.start('ros2', library='spinning_top_sim')
        writer.add_metadata(METADATA, _odd_metadata(rng, metadata) if 'metadata' in kinds
                            else metadata)
        ids = {}
        for channel in channels.values():
            schema = schemas[channel.schema_id]
            ids[channel.topic] = writer.register_channel(
                names.get(channel.topic, channel.topic), channel.message_encoding,
                writer.register_schema(schema.name, schema.encoding, schema.data),
                channel.metadata)
        for number, entry in enumerate(logged):
            copies = 1
            if number in chosen:
                entry, copies = _odd(rng, kinds, *entry)        # noqa: PLW2901
            topic, stamp_ns, data = entry
            for _ in range(copies):
                writer.add_message(ids[topic], stamp_ns, data, stamp_ns)
        writer.finish()
    return path
