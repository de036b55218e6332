# SPDX-License-Identifier: Apache-2.0
"""
The runs of an ensemble: the table of one run, and the file of a part of the dataset.

A file gets its name when it is whole.  One that is there already is not computed again.
"""

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import reason_of
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.streams.topics import INVARIANTS, JOINTS, TIMING, recorded
from spinning_top_sim.times import NANOSECONDS, Times
from spinning_top_sim.tools.ensemble_spec import ROWS_IN_A_PART, Specification

if TYPE_CHECKING:
    import pyarrow

EPOCH_NS = NANOSECONDS          # stamp of t = 0, the default of `simulate`
DATA = 'data'                   # folder of the files of a dataset
# Key of the metadata of a Parquet file: the reasons of the runs that failed, by run.
FAILED_KEY = b'failed'
# Names of the numbers in fields of messages, where they are not x, y, z and w.
LABELS: Mapping[tuple[str, str], Sequence[str]] = {
    ('~/invariants', 'data'): INVARIANTS, ('ground_truth/imu_timing', 'data'): TIMING,
    ('joint_states', 'position'): JOINTS, ('joint_states', 'velocity'): JOINTS,
    **dict.fromkeys([('gnss/fix', 'position'), ('ground_truth/gnss/fix', 'position')],
                    ('latitude', 'longitude', 'altitude'))}


def _column_names(channel: Channel) -> list[str]:
    """Return the names of the numbers in the fields of a message."""
    names = []
    for name, count, _ in channel.template.fields:
        labels = LABELS.get((channel.topic, name)) or (
            [''] if count == 1 else 'xyzw'[:count] if count <= 4 else range(count))
        names += [f'{channel.topic}.{name}.{label}'.rstrip('.') for label in labels]
    return names


def table_of_run(specification: Specification, run: int) -> 'pyarrow.Table':
    """
    Play a run; return its number, t [s], what is drawn, and the numbers of kept streams.

    A row has the samples of one time; where a stream has none, its columns are null.  All runs
    have the same columns.  Raises ValueError for parameters that are not allowed, and
    IntegrationError if the motion ends early.
    """
    import pyarrow as pa  # noqa: PLC0415

    drawn = specification.drawn(run)
    values = specification.values(drawn)
    simulation = Simulation(values, EPOCH_NS)
    kept = [channel for channel in simulation.channels if channel.name in specification.kept]
    names = {channel.topic: _column_names(channel) for channel in kept}
    times: dict[str, list[Times]] = {topic: [np.empty(0, np.int64)] for topic in names}
    sent: dict[str, list[NDArray[np.float64]]] = {
        topic: [np.empty((len(labels), 0))] for topic, labels in names.items()}
    for block in simulation.play(recorded(kept, values),
                                 round(values['duration'] * NANOSECONDS)):
        for channel, times_ns, rows in block.messages:
            times[channel.topic].append(times_ns)
            sent[channel.topic].append(np.hstack(channel.template.decode(rows)).T)
    known_ns = {topic: np.concatenate(parts) for topic, parts in times.items()}
    # Faster than np.unique, for they are sorted in parts.
    every_ns = np.sort(np.concatenate([*known_ns.values()]), kind='stable')
    rows_ns = every_ns[np.diff(every_ns, prepend=-1) > 0]

    def repeated(value: Any) -> 'pyarrow.Array':
        # An unset value (spin.lz) is a null of the type that the other runs have.
        return pa.repeat(pa.scalar(value, pa.float64() if value is None else None), len(rows_ns))

    columns = {'run': repeated(run), 't': pa.array(rows_ns / NANOSECONDS),
               **{name: repeated(value) for name, value in drawn.items()}}
    for topic, labels in names.items():
        cells, absent = np.concatenate(sent[topic], axis=1), None
        if not np.array_equal(known_ns[topic], rows_ns):
            # A faulty sensor sends some samples twice; they share a row.
            present, known = np.searchsorted(rows_ns, known_ns[topic]), cells
            cells, absent = np.zeros((len(labels), len(rows_ns))), np.ones(len(rows_ns), bool)
            cells[:, present], absent[present] = known, False
        columns.update((label, pa.array(column, mask=absent))
                       for label, column in zip(labels, cells, strict=True))
    return pa.table(columns)


def compute_part(specification: Specification, part: int, folder: str) -> dict[str, str]:
    """
    Compute the file of a part if it is missing; return why runs of it failed, by run.

    Raises OSError.
    """
    import pyarrow as pa  # noqa: PLC0415
    from pyarrow import parquet  # noqa: PLC0415

    path = Path(folder, DATA, f'part-{part:06d}.parquet')
    with contextlib.suppress(OSError, ValueError, KeyError):    # it is missing, or not whole
        return dict(json.loads(parquet.read_metadata(path).metadata[FAILED_KEY]))
    tables, failed = [], {}
    for run in specification.parts[part]:
        try:
            tables.append(table_of_run(specification, run))
        except Exception as error:
            drawn = specification.drawn(run).items()
            failed[str(run)] = (f'{reason_of(error)}; it has '
                                f'{", ".join(f"{name} = {value!r}" for name, value in drawn)}')
    if tables:
        rows = pa.concat_tables(tables).combine_chunks().replace_schema_metadata(
            {FAILED_KEY: json.dumps(failed)})
        constant = ['run', *specification.drawn(0)]
        written = path.with_name(f'.{path.name}.{uuid4()}')     # readers of Parquet skip it
        parquet.write_table(
            rows, written, compression='lz4', row_group_size=ROWS_IN_A_PART,
            use_dictionary=constant, write_statistics=constant, use_byte_stream_split=[
                name for name in rows.column_names if name not in constant])
        written.replace(path)
    return failed
