# SPDX-License-Identifier: Apache-2.0
"""
The runs of an ensemble: the samples of one run, and the file of a part of the dataset.

A file gets its name when it is whole.  One that is there already is not computed again.
"""

import contextlib
import itertools
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import version
from spinning_top_sim.recording.errors import reason_of
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.streams.topics import INVARIANTS, JOINTS, TIMING, recorded
from spinning_top_sim.times import NANOSECONDS, Times
from spinning_top_sim.tools.ensemble_spec import ROWS_IN_A_PART, Specification

if TYPE_CHECKING:
    import pyarrow

# By column, values (n,) and whether each is absent (n,).
Samples = dict[str, tuple[NDArray[np.float64], NDArray[np.bool_]]]

EPOCH_NS = NANOSECONDS          # stamp of t = 0, the default of `simulate`
DATA = 'data'                   # folder of the files of a dataset
# Key of the metadata of a Parquet file: the reasons of the runs that failed, by run.
FAILED_KEY = b'failed'
# Names of the numbers in fields of messages, where they are not x, y, z and w.
ARRAYS = {'~/invariants': INVARIANTS, 'ground_truth/imu_timing': TIMING}
LABELS = {('sensor_msgs/msg/JointState', 'position'): JOINTS,
          ('sensor_msgs/msg/JointState', 'velocity'): JOINTS,
          ('sensor_msgs/msg/NavSatFix', 'position'): ('latitude', 'longitude', 'altitude')}


@cache
def versions() -> dict[str, str]:
    """Return the versions on which the bytes of a dataset depend."""
    return {'python': platform.python_version(), 'machine': platform.machine(),
            **{name: version(name) for name in ('spinning_top_sim', 'numpy', 'pyarrow')}}


def _column_names(channel: Channel) -> list[str]:
    """Return the names of the numbers in the fields of a message."""
    names = []
    for name, count, _ in channel.template.fields:
        labels: Any = (
            ARRAYS.get(channel.topic) or LABELS.get((channel.type_name, name))
            or ([''] if count == 1 else 'xyzw'[:count] if count <= 4 else range(count)))
        names += [f'{name}.{label}'.rstrip('.') for label in labels]
    return names


def samples(specification: Specification, simulation: Simulation) -> Samples:
    """
    Play a run; return its columns: t [s], and the numbers of the streams that are kept.

    A row has the samples of one time; where a stream has none, its columns are absent.  All runs
    have the same columns.  Raises IntegrationError if the motion ends early.
    """
    values = simulation.values
    kept = [channel for channel in simulation.channels if channel.name in specification.kept]
    names = {channel.topic: _column_names(channel) for channel in kept}
    times: dict[str, list[Times]] = {topic: [] for topic in names}
    numbers: dict[str, list[NDArray[np.float64]]] = {topic: [] for topic in names}
    for block in simulation.play(recorded(kept, values),
                                 round(values['duration'] * NANOSECONDS)):
        for channel, times_ns, rows in block.messages:
            times[channel.topic].append(times_ns)
            numbers[channel.topic].append(np.hstack(channel.template.decode(rows)).T)
    every_ns = np.sort(_joined([*itertools.chain(*times.values())], 0, np.int64), kind='stable')
    rows_ns = every_ns[np.diff(every_ns, prepend=-1) > 0]
    columns = {'t': (rows_ns / NANOSECONDS, np.zeros(len(rows_ns), bool))}
    for topic, labels in names.items():
        times_ns = _joined(times[topic], 0, np.int64)
        cells = _joined(numbers[topic], (len(labels), 0))
        absent = np.zeros(len(rows_ns), bool)
        if not np.array_equal(times_ns, rows_ns):
            # A faulty sensor sends some samples twice; they share a row.
            present = np.searchsorted(rows_ns, times_ns)
            sent, cells = cells, np.zeros((len(labels), len(rows_ns)))
            cells[:, present] = sent
            absent[:] = True
            absent[present] = False
        columns.update((f'{topic}.{name}', (column, absent))
                       for name, column in zip(labels, cells, strict=True))
    return columns


def _joined(parts: Sequence[NDArray[Any]], none: int | tuple[int, int],
            kind: type = float) -> NDArray[Any]:
    """Return arrays one after the other in their last axis; of the shape `none` without any."""
    return parts[0] if len(parts) == 1 else np.concatenate([np.empty(none, kind), *parts], axis=-1)


def arrow_table(specification: Specification, found: Mapping[int, Samples]) -> 'pyarrow.Table':
    """Return the samples of runs as a table, beside the number of the run and what is drawn."""
    import pyarrow as pa  # noqa: PLC0415

    def repeated(values: Sequence[Any]) -> 'pyarrow.Array':
        # An unset value (spin.lz) is a null of the type that the other runs have.
        return pa.concat_arrays([
            pa.repeat(pa.scalar(value, pa.float64() if value is None else None), len(one['t'][0]))
            for value, one in zip(values, found.values(), strict=True)])

    def column(name: str) -> 'pyarrow.Array':
        values, absent = (np.concatenate(parts) for parts in zip(*(
            one[name] for one in found.values()), strict=True))
        return pa.array(values, mask=absent)

    drawn = [specification.drawn(run) for run in found]
    time, *others = next(iter(found.values()))
    return pa.table({'run': repeated([*found]), time: column(time),
                     **{name: repeated([one[name] for one in drawn]) for name in drawn[0]},
                     **{name: column(name) for name in others}})


def compute_part(specification: Specification, part: int, folder: str) -> dict[str, str]:
    """
    Compute the file of a part, unless it is in `folder`; return the runs that failed, and why.

    The file depends on the specification and the versions alone.  Raises OSError.
    """
    from pyarrow import parquet  # noqa: PLC0415

    path = Path(folder, DATA, f'part-{part:06d}.parquet')
    with contextlib.suppress(OSError, ValueError, KeyError):    # it is missing, or not whole
        return dict(json.loads(parquet.read_metadata(path).metadata[FAILED_KEY]))
    begun, found = {}, {}
    failed: dict[str, str] = {}
    # All runs begin before one is played: caches of the processor hold the code of one of both.
    for run in specification.part(part):
        with _noted(failed, run, specification):
            begun[run] = Simulation(specification.values(run), EPOCH_NS)
    for run in [*begun]:
        with _noted(failed, run, specification):
            found[run] = samples(specification, begun.pop(run))     # which holds much memory
    if found:
        rows = arrow_table(specification, found).replace_schema_metadata(
            {FAILED_KEY: json.dumps(failed)})
        constant = ['run', *specification.drawn(0)]
        written = path.with_name(f'.{path.name}.{uuid4()}')     # readers of Parquet skip it
        parquet.write_table(
            rows, written, compression='lz4', row_group_size=ROWS_IN_A_PART,
            use_dictionary=constant, write_statistics=constant, use_byte_stream_split=[
                name for name in rows.column_names if name not in constant])
        written.replace(path)
    return failed


@contextlib.contextmanager
def _noted(failed: dict[str, str], run: int, specification: Specification) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        drawn = specification.drawn(run).items()
        failed[str(run)] = (f'{reason_of(error)}; it has '
                            f'{", ".join(f"{name} = {value!r}" for name, value in drawn)}')
