# SPDX-License-Identifier: Apache-2.0
"""
The runs of an ensemble: their specification, the table of one, and the file of a part of them.

A file gets its name when it is whole.  One that is there already is not computed again.
"""

import contextlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from spinning_top_sim.physics.top import shown
from spinning_top_sim.recording.errors import reason_of
from spinning_top_sim.streams import parameters, topics
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.parameter import Parameter, Range
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.tools.scene_file import likely_name, parse_section, parse_yaml, read_scene

# What a run has of its own: its number `run`, its `seed`, and the sampled parameters.
Row = Mapping[str, Any]
FAILED_KEY = b'failed'          # of the metadata of a file: runs that failed, and why
# Simulated time [s] that a part of several runs has at most; parts that many runs have at least.
PART_S, LEAST_PARTS = 250.0, 50
# Streams that a table can have; only a log has the others.
STREAMS = tuple(name for name in parameters.STREAMS if name not in ('clock', 'markers'))
ENTRIES = (
    Parameter('runs', '', 1, Range(1, 10 ** 8)), parameters.BY_NAME['seed'],
    replace(parameters.BY_NAME['duration'], range=Range(1e-9, parameters.LONGEST)),
    Parameter('streams', '', choices=STREAMS, default=tuple(
        name for name in STREAMS if parameters.BY_NAME[f'{name}.enabled'].default)))
Draws = Callable[..., Any]      # draws n numbers by two others
DISTRIBUTIONS: Mapping[str, Draws] = {
    'uniform': np.random.Generator.uniform, 'normal': np.random.Generator.normal,
    'log_uniform': lambda random, low, high, n: np.exp(
        random.uniform(math.log(low), math.log(high), n))}
# Names of the numbers in fields of messages, where they are not x, y, z and w.
LABELS: Mapping[str, Sequence[str]] = {
    '~/invariants.data': topics.INVARIANTS, 'ground_truth/imu_timing.data': topics.TIMING,
    **dict.fromkeys(('joint_states.position', 'joint_states.velocity'), topics.JOINTS),
    **dict.fromkeys(('gnss/fix.position', 'ground_truth/gnss/fix.position'),
                    ('latitude', 'longitude', 'altitude'))}


class Specification(NamedTuple):
    """
    What the runs of an ensemble share.

    content : of the file
    streams : names of those that the table has
    sets : parameters; the entry `params` of a run is the number of one
    """

    content: Mapping[str, Any]
    streams: Sequence[str]
    sets: Sequence[Mapping[str, Any]]


def read(path: Path) -> tuple[Specification, Sequence[Sequence[Row]]]:
    """
    Return the specification in a YAML file, and its runs, in parts that share a file.

    Paths of parameter files are relative to the folder of the specification.
    What is drawn for a name depends on neither the other names nor the number of runs.  Lists of
    values span a grid, again and again, in which the first list changes fastest.

    Raises OSError, or ValueError, which names the file, the value and what is allowed.
    """
    content = parse_yaml(path.read_bytes(), str(path))
    known = [*(entry.name for entry in ENTRIES), 'params', 'sample']
    try:
        if not isinstance(content, Mapping) or not {'runs', 'duration'} <= content.keys() <= {
                *known}:
            raise ValueError(f'{shown(content)}: must be a mapping with runs and duration, of '
                             f'{", ".join(known)}')
        params, sample = content.get('params', []), content.get('sample', {})
        if not isinstance(params, list) or not isinstance(sample, Mapping):
            raise ValueError('params must be a list, sample a mapping')
        runs, seed, duration, streams = (entry.check(content.get(entry.name, entry.default))
                                         for entry in ENTRIES)
        common = {name: value for one in params
                  for name, value in _parameter_set(path.parent, one).items()}
        rules: dict[str, tuple[Draws | None, Sequence[Any]]] = {
            'seed': (np.random.Generator.integers, (0, 2 ** 63)),
            **{name: _rule(name, rule, path.parent) for name, rule in sample.items()}}
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    columns: dict[str, Sequence[Any]] = {'run': range(runs)}
    sets, size = [common], 1
    for name, (draws, items) in rules.items():
        if draws:
            random = np.random.default_rng((seed, *name.encode()))
            columns[name] = draws(random, *items, runs).tolist()
            continue
        indices = [run // size % len(items) for run in range(runs)]
        columns[name] = [items[index] for index in indices]
        if name == 'params':
            sets, columns[name] = [{**common, **one} for one in items], indices
        size *= len(items)
    rows = [{name: column[run] for name, column in columns.items()} for run in range(runs)]
    count = max(1, min(int(PART_S / duration), runs // LEAST_PARTS))
    return Specification(content, streams, [{**one, 'duration': duration} for one in sets]), [
        rows[first:first + count] for first in range(0, runs, count)]


def _parameter_set(folder: Path, given: object) -> dict[str, Any]:
    if isinstance(given, Mapping):
        return parse_section(given, 'params')
    if isinstance(given, str):
        return read_scene(folder / given)
    raise ValueError(f'params: {shown(given)}: must be a parameter file, or parameters and their '
                     'values')


def _rule(name: str, rule: Any, folder: Path) -> tuple[Draws | None, Sequence[Any]]:
    """Return how a parameter is sampled, checked: a distribution of two numbers, or a list."""
    if name not in ('params', *parameters.BY_NAME):
        raise ValueError(f'sample: there is no parameter {name}{likely_name(name)}')
    check = partial(_parameter_set, folder) if name == 'params' else parameters.BY_NAME[name].check
    try:
        (kind, items), = rule.items()
        if not isinstance(items, list) or not items:
            raise TypeError
        if kind != 'values':
            low, high = map(float, items)
            DISTRIBUTIONS[kind](np.random.default_rng(0), low, high, 1)
    except (AttributeError, LookupError, OverflowError, TypeError, ValueError):
        raise ValueError(
            f'sample: {name} = {shown(rule)}: must be values with a list, uniform with [low, high]'
            ', log_uniform with such above 0, or normal with [mean, deviation]') from None
    checked = [*map(check, items[:1] if kind == 'normal' else items)]
    return (None, checked) if kind == 'values' else (DISTRIBUTIONS[kind], (low, high))


def _column_names(channel: Channel) -> list[str]:
    """Return the names of the numbers in the fields of a message."""
    names = []
    for field, count, _ in channel.template.fields:
        name = f'{channel.topic}.{field}'
        labels = LABELS.get(name, 'xyzw'[:count] if count <= 4 else range(count))
        names += [name] if count == 1 else [f'{name}.{label}' for label in labels]
    return names


def table_of_run(specification: Specification, row: Row) -> pa.Table:
    """
    Play a run; return what it has of its own, t [s], and the numbers of its streams.

    A line has the samples of one time; where a stream has none, its columns are null.  All runs
    have the same columns.  Raises ValueError for parameters that are not allowed, and
    IntegrationError if the motion ends early.
    """
    own = {name: value for name, value in row.items() if name not in ('run', 'params')}
    values = parameters.checked({**specification.sets[row.get('params', 0)], **own})
    simulation = Simulation(values, NANOSECONDS)        # the default epoch of `simulate`
    # Times and messages of each channel, block by block.
    sent = {channel: ([np.empty(0, np.int64)], [np.empty((0, len(channel.template)), np.uint8)])
            for channel in simulation.channels if channel.name in specification.streams}
    for block in simulation.play([*sent], round(values['duration'] * NANOSECONDS)):
        for channel, times_ns, messages in block.messages:
            sent[channel][0].append(times_ns)
            sent[channel][1].append(messages)
    known_ns = {channel: np.concatenate(times) for channel, (times, _) in sent.items()}
    t_ns = np.unique(np.concatenate([*known_ns.values()]))
    # An unset value (spin.lz) is a null of the type that the other runs have.
    columns = {name: pa.repeat(pa.scalar(value, pa.float64() if value is None else None),
                               len(t_ns)) for name, value in row.items()}
    columns['t'] = pa.array(t_ns / NANOSECONDS)
    for channel, (_, blocks) in sent.items():
        cells = np.hstack(channel.template.decode(np.concatenate(blocks))).T.astype(np.float64)
        absent = None
        if not np.array_equal(known_ns[channel], t_ns):
            # A faulty sensor sends some samples twice; they share a line.
            known, cells = cells, np.zeros((len(cells), len(t_ns)))
            cells[:, np.searchsorted(t_ns, known_ns[channel])] = known
            absent = ~np.isin(t_ns, known_ns[channel])
        columns.update((name, pa.array(column, mask=absent)) for name, column in zip(
            _column_names(channel), cells, strict=True))
    return pa.table(columns)


def compute_part(specification: Specification, folder: Path, rows: Sequence[Row],
                 ) -> list[list[Any]]:
    """Compute a missing file of runs; return the runs that fail, and why.  Raises OSError."""
    path = folder / f'part-{rows[0]["run"]:08d}.parquet'
    with contextlib.suppress(OSError, ValueError, KeyError):    # it is missing, or not whole
        return list(json.loads(parquet.read_metadata(path).metadata[FAILED_KEY]))
    tables, failed = [], []
    for row in rows:
        try:
            tables.append(table_of_run(specification, row))
        except Exception as error:
            failed.append([row['run'], f'{reason_of(error)}; it has {row}'])
    if tables:
        table = pa.concat_tables(tables).combine_chunks().replace_schema_metadata(
            {FAILED_KEY: json.dumps(failed)})
        written = path.with_name(f'.{path.name}.{uuid4()}')     # readers of Parquet skip it
        parquet.write_table(
            table, written, compression='lz4', use_dictionary=[*rows[0]], use_byte_stream_split=[
                name for name in table.column_names if name not in rows[0]])
        written.replace(path)
    return failed
