# SPDX-License-Identifier: Apache-2.0
"""
Computes the runs of an ensemble: the samples of one, or a part of the dataset.

A part is complete when there is a record of it, which has the hashes of its files.  Files and
record are moved into place: none of them is ever there in part.
"""

import contextlib
import hashlib
import json
import platform
import tempfile
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.recording.provenance import version
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.streams.topics import INVARIANTS, JOINTS, TIMING
from spinning_top_sim.tools.ensemble_spec import WITHOUT_COLUMNS, Specification
from spinning_top_sim.tools.recorded_run import ODD, field_names, reason_of
from spinning_top_sim.tools.simulate import write_log

if TYPE_CHECKING:
    import pyarrow
    from pyarrow import parquet

EPOCH_NS = NANOSECONDS          # as `simulate` has it
# Folders of a dataset: its files, and what is only there while it is computed.
DATA, PROGRESS = 'data', 'progress'
# Runs of so many rows together make a row group: each costs time, and memory holds one.
ROWS_IN_A_GROUP = 8_000
# Names of the numbers in the fields of a topic, where they are not x, y, z and w.
LABELS = {'joint_states': JOINTS, '~/invariants': INVARIANTS, 'ground_truth/imu_timing': TIMING}

# Times of samples (n,) [ns], and fields of their messages (n, count) by name.
Samples = tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]


class EnsembleError(Exception):
    """An ensemble cannot go on; the text says why, and what to do."""


@cache
def versions() -> dict[str, str]:
    """Return what decides the last bit, and the bytes of the files."""
    return {'python': platform.python_version(), 'machine': platform.machine(),
            **{name: version(name) for name in (
                'spinning_top_sim', 'numpy', 'pyarrow', 'mcap', 'rclpy', 'zstandard', 'lz4')}}


def samples(values: Mapping[str, Any], names: Collection[str]) -> dict[str, Samples]:
    """
    Return the samples of a run by topic, of the streams with these names.

    values : checked parameters with a duration > 0; a stream that they do not enable, or that
        `record.streams` does not choose, has no samples

    Raises ValueError if no motion begins, IntegrationError if it ends early.
    """
    simulation = Simulation(values, EPOCH_NS)
    streams = [stream for stream in simulation.streams
               if stream.parameter in names and stream.parameter not in WITHOUT_COLUMNS]
    blocks: dict[str, list[tuple[NDArray[np.int64], tuple[NDArray[np.float64], ...]]]] = {
        stream.topic: [(np.empty(0, np.int64), stream.template.decode(b''))] for stream in streams}

    recorded = journal.recorded_streams(streams, values)
    for block in simulation.play(recorded, round(values['duration'] * NANOSECONDS)):
        for stream, t_ns, rows in block.parts:
            blocks[stream.topic].append((t_ns, stream.template.decode(rows.tobytes())))
    found = {}
    for stream in streams:
        times, fields = zip(*blocks[stream.topic], strict=True)
        arrays = map(np.concatenate, zip(*fields, strict=True))
        columns = dict(zip(field_names(stream) or (), arrays, strict=True))
        if not getattr(stream, 'has_orientation', True):        # REP-145: there is none in it
            columns.pop('orientation', None)
        found[stream.topic] = np.concatenate(times), columns
    return found


def table(specification: Specification, run: int) -> 'pyarrow.Table':
    """
    Return a run as a table: run, t [s], what is drawn for it, and its samples.

    A row has the samples of one time; where a stream has none, its columns are null.  All runs
    have the same columns.
    Raises ValueError or IntegrationError as `samples` does.
    """
    import pyarrow as pa  # noqa: PLC0415

    found = samples(specification.values(run), specification.kept)
    if not found:
        raise ValueError(f'the streams {", ".join(specification.kept)} have no columns: only a '
                         'log (.mcap) can have them')
    rows_ns = np.unique(np.concatenate([times_ns for times_ns, _ in found.values()]))
    columns = {'run': pa.repeat(pa.scalar(run), len(rows_ns)),
               't': pa.array(rows_ns / NANOSECONDS)}
    for name, value in specification.drawn(run).items():
        # An unset one (spin.lz) is a null of the type that the other runs have.
        one = pa.scalar(value, pa.float64() if value is None else None)
        columns[name] = pa.repeat(one, len(rows_ns))
    for topic, (times_ns, fields) in found.items():
        rows = np.searchsorted(rows_ns, times_ns)
        missing = np.ones(len(rows_ns), bool)
        missing[rows] = False
        for field, numbers in fields.items():
            count = numbers.shape[1]
            labels = LABELS.get(topic) or ('xyzw'[:count] if count <= 4 else range(count))
            for label, column in zip(labels, numbers.T, strict=True):
                spread = np.zeros(len(rows_ns))
                spread[rows] = column
                columns[f'{topic}.{field}.{label}'] = pa.array(
                    spread, mask=missing if missing.any() else None)
    return pa.table(columns)


def write_row(specification: Specification, run: int, path: Path) -> None:
    """
    Compute one run again into a new file, .mcap or .parquet.

    A log is to the byte that of the dataset.  Raises RecordingError for a file that exists, and
    ValueError or IntegrationError as `samples` does.
    """
    if path.exists() or not path.parent.is_dir():
        raise RecordingError(f'{path}: must not exist, and its folder must')
    with tempfile.TemporaryDirectory(dir=path.parent) as name:
        if path.suffix == '.mcap':
            written = _write_log(specification, run, Path(name))
        else:
            one, written = table(specification, run), Path(name, path.name)
            with _parquet_writer(specification, written, one.schema) as writer:
                writer.write_table(one)
        written.rename(path)


def _write_log(specification: Specification, run: int, folder: Path) -> Path:
    """Write the log of a run, under the name in the dataset: the log holds it."""
    values, path = specification.values(run), folder / f'run-{run:09d}.mcap'
    write_log(path, Simulation(values, EPOCH_NS),
              [(round(values['duration'] * NANOSECONDS), None)], lambda done: None, '/')
    return path


def _parquet_writer(specification: Specification, path: Path,
                    schema: 'pyarrow.Schema') -> 'parquet.ParquetWriter':
    """Return a writer of a new file; what is the same in a whole run is in a dictionary."""
    from pyarrow import parquet  # noqa: PLC0415

    same = ['run', *specification.drawn(0)]
    return parquet.ParquetWriter(
        str(path), schema, compression='zstd', use_dictionary=same,
        use_byte_stream_split=[name for name in schema.names if name not in same])


def compute_part(specification: Specification, part: int, folder: str,
                 wanted: Mapping[str, str]) -> dict[str, Any]:
    """
    Compute a part of the dataset in `folder`, unless it is there; return its record.

    The record has `files`, hash (SHA-256) by name, and `failed`, the reason by run.  The files
    depend on nothing but the specification and the versions.

    wanted : what `versions` must be

    Raises EnsembleError for other versions; RecordingError or OSError if a file cannot be written.
    """
    if versions() != wanted:
        raise EnsembleError(f'a worker has {versions()}, which gives other bytes than {wanted}')
    record_path = Path(folder, PROGRESS, f'part-{part:06d}.json')
    record: dict[str, Any]
    with contextlib.suppress(OSError, *ODD):
        record = json.loads(record_path.read_bytes())
        if record.keys() == {'files', 'failed'} and is_whole(Path(folder), record):
            return record
    record = {'files': {}, 'failed': {}}
    with tempfile.TemporaryDirectory(dir=Path(folder, PROGRESS)) as name:
        write = _write_parquet if specification.format == 'parquet' else _write_logs
        write(specification, part, Path(name), record['failed'])
        for path in sorted(Path(name).iterdir()):
            record['files'][f'{DATA}/{path.name}'] = sha256(path)
            path.replace(Path(folder, DATA, path.name))
        written = Path(name, 'record')
        written.write_text(json.dumps(record))
        written.replace(record_path)
    return record


def write_records(specification: Specification, folder: Path, whole: Mapping[str, Any]) -> None:
    """Write the record of each part, from `files` and `failed` of all.  Raises OSError."""
    (folder / PROGRESS).mkdir(exist_ok=True)
    for part in range(specification.parts):
        runs = specification.part(part)
        names = [f'part-{part:06d}.parquet', *(f'run-{run:09d}.mcap' for run in runs)]
        record = {what: {key: whole[what][key] for key in keys if key in whole[what]}
                  for what, keys in (('files', [f'{DATA}/{name}' for name in names]),
                                     ('failed', map(str, runs)))}
        (folder / PROGRESS / f'part-{part:06d}.json').write_text(json.dumps(record))


def is_whole(folder: Path, record: Mapping[str, Any]) -> bool:
    """Return whether each of `files` is there with its hash."""
    try:
        return all(sha256(folder / name) == digest for name, digest in record['files'].items())
    except OSError:
        return False


def sha256(path: Path) -> str:
    """Return the hash of a file.  Raises OSError."""
    with open(path, 'rb') as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()


def _write_parquet(specification: Specification, part: int, folder: Path,
                   failed: dict[str, str]) -> None:
    """Write the runs of a part into one file, some runs at a time: so many are in memory."""
    import pyarrow as pa  # noqa: PLC0415

    tables: list[pyarrow.Table] = []
    with contextlib.ExitStack() as stack:
        writer = None
        for run in specification.part(part):
            try:
                tables.append(table(specification, run))
            except Exception as error:
                failed[str(run)] = reason_of(error)
            if tables and (run == specification.part(part)[-1]
                           or sum(map(len, tables)) >= ROWS_IN_A_GROUP):
                group = pa.concat_tables(tables)
                tables.clear()
                if writer is None:
                    writer = stack.enter_context(_parquet_writer(
                        specification, folder / f'part-{part:06d}.parquet', group.schema))
                writer.write_table(group, row_group_size=max(len(group), 1))


def _write_logs(specification: Specification, part: int, folder: Path,
                failed: dict[str, str]) -> None:
    """Write a log for each run of a part."""
    for run in specification.part(part):
        try:
            _write_log(specification, run, folder)
        except (OSError, RecordingError):
            raise
        except Exception as error:
            failed[str(run)] = reason_of(error)
