# SPDX-License-Identifier: Apache-2.0
"""
Simulate many runs from one specification into a dataset: the samples of all
runs in Parquet files, or a log (MCAP) a run. Dask shares the runs among the
processes of this machine, or of a cluster.

A specification is YAML:

  runs: 10000                                # numbers 0 to 9999
  seed: 7                                    # of all that is drawn
  duration: 10.0                             # of a run [s]
  params: [config/wavy.yaml, {solver.method: exact}]
  sample:                                    # what differs from run to run
    initial.theta: {uniform: [0.2, 1.2]}     # [low, high]
    spin.l3: {normal: [1.6, 0.1]}            # [mean, deviation]
    imu.gyroscope_noise_density: {log_uniform: [1.0e-4, 1.0e-2]}
    params: {values: [config/imu/bmi088.yaml, config/imu/adis16470.yaml]}
  streams: [imu, ground_truth_imu]           # default: those that are enabled
  format: parquet                            # or mcap

Lists of values make a grid, which the runs go through in turn. Files are
sought beside the specification, else here. The dataset is DIR/data, and
DIR/manifest.json has the specification, versions, hashes, and the runs that
failed. A run depends on the specification and its number alone:

  ensemble DIR --row K -o one.mcap           # computes run K again

exit codes:
  0    done; runs that failed are told, and the manifest has the reasons
  1    a file cannot be read or written, or the cluster is lost: see --resume
  2    wrong arguments or specification
  130  interrupted: see --resume
"""

import argparse
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.tools import cli, ensemble_spec
from spinning_top_sim.tools.ensemble_part import (
    DATA,
    PROGRESS,
    EnsembleError,
    compute_part,
    is_whole,
    versions,
    write_records,
    write_row,
)
from spinning_top_sim.tools.ensemble_spec import Specification
from spinning_top_sim.tools.recorded_run import ODD, reason_of

MANIFEST = 'manifest.json'
NEW_MANIFEST = f'{MANIFEST}.new'        # while it is written
# What a manifest has besides its format.
ENTRIES = {'complete': bool, 'versions': dict, 'specification': dict, 'files': dict,
           'failed': dict}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return cli.run('ensemble', __doc__, argv, _add_arguments, _run,
                   (ValueError, ArithmeticError, RecordingError, IntegrationError, EnsembleError,
                    OSError))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('specification', metavar='SPEC', type=Path,
        help='the specification, or with --row the folder of a dataset')
    add('-o', '--output', metavar='DIR', required=True, type=Path,
        help='folder of the dataset, which must not exist; with --row a new .mcap or .parquet '
        'file')
    add('--workers', metavar='N', type=int,
        help='processes on this machine; default: one a core')
    add('--scheduler', metavar='ADDRESS',
        help='of a Dask cluster, such as tcp://host:8786, whose machines all have the package and '
        'DIR')
    add('--resume', action='store_true',
        help='go on with the dataset in DIR; files that are complete are not computed again')
    add('--row', metavar='K', type=int, help='compute run K alone')
    add('--quiet', action='store_true', help='no progress, no summary')


def _run(arguments: argparse.Namespace) -> int:
    if arguments.workers is not None and not 1 <= arguments.workers <= 1024:
        raise ValueError(f'--workers {arguments.workers}: must be from 1 to 1024')
    if arguments.workers is not None and arguments.scheduler is not None:
        raise ValueError('--workers: must not be given with --scheduler, which has its own')
    if arguments.scheduler is not None and not re.fullmatch(
            r'\w+://.+:\d+', arguments.scheduler):
        raise ValueError(f'--scheduler {arguments.scheduler}: must be such as tcp://host:8786')
    try:
        return (_compute_dataset if arguments.row is None else _compute_row)(arguments)
    except ImportError as error:
        raise EnsembleError("ensembles need Dask and pyarrow: pip install 'spinning_top_sim[exam]'"
                            f' ({error})') from error


def _compute_dataset(arguments: argparse.Namespace) -> int:
    import pyarrow  # noqa: F401, PLC0415 - before anything is written

    from spinning_top_sim.tools import ensemble_cluster  # noqa: PLC0415

    specification = ensemble_spec.read(arguments.specification)
    folder = arguments.output.absolute()
    manifest = _manifest(folder, specification, resume=arguments.resume)
    if manifest['complete'] and not is_whole(folder, manifest):
        write_records(specification, folder, manifest)
        manifest['complete'] = False
    if not manifest['complete']:
        try:
            with (cli.progress('computed', specification.runs, 'runs',
                               quiet=arguments.quiet) as show,
                  ensemble_cluster.connect(arguments.workers, arguments.scheduler) as client):
                folder.mkdir(parents=True, exist_ok=True)
                _write_manifest(folder, manifest)
                for name in (DATA, PROGRESS):
                    (folder / name).mkdir(exist_ok=True)
                records = ensemble_cluster.compute(
                    client, partial(compute_part, specification, folder=str(folder),
                                    wanted=versions()), range(specification.parts))
                manifest.update(_collect(records, specification, show))
            _complete(folder, manifest)
        except (KeyboardInterrupt, EnsembleError, RecordingError, OSError):
            if folder.exists():
                cli.print_line(f'ensemble: {arguments.output} holds what was complete: the same '
                               'command with --resume goes on', sys.stderr)
            raise
    failed = manifest['failed']
    if failed:
        run, reason = next(iter(failed.items()))
        cli.print_line(f'ensemble: {len(failed)} of {specification.runs} runs failed, see '
                       f'{MANIFEST}; run {run}: {reason}', sys.stderr)
    if not arguments.quiet:
        cli.print_line(f'{arguments.output}: {specification.runs - len(failed)} runs in '
                       f'{len(manifest["files"])} files')
    return cli.OK


def _collect(records: Iterable[Mapping[str, Any]], specification: Specification,
             show: Callable[[float], None]) -> dict[str, Any]:
    """Return what the manifest says of all parts."""
    files: dict[str, str] = {}
    failed: dict[str, str] = {}
    for done, record in enumerate(records, start=1):
        files.update(record['files'])
        failed.update(record['failed'])
        show(min(done * specification.runs_per_part, specification.runs))
    return {'files': dict(sorted(files.items())),
            'failed': dict(sorted(failed.items(), key=lambda item: int(item[0])))}


def _complete(folder: Path, manifest: dict[str, Any]) -> None:
    """Complete the manifest, and remove what is there for --resume.  Raises EnsembleError."""
    for name in manifest['files']:
        if not (folder / name).exists():
            raise EnsembleError(f'{folder / name} is missing: do all workers write to the same '
                                'file system?')
    manifest['complete'] = True
    _write_manifest(folder, manifest)
    shutil.rmtree(folder / PROGRESS, ignore_errors=True)     # a killed command's worker may write


def _compute_row(arguments: argparse.Namespace) -> int:
    path: Path = arguments.specification
    if path.is_dir():
        manifest = _read_manifest(path)
        specification = ensemble_spec.parse(manifest['specification'], str(path / MANIFEST))
        if manifest['versions'] != versions():
            cli.print_line('ensemble: the last bits may differ: the dataset is of '
                           f'{_difference(manifest["versions"], versions())}', sys.stderr)
    else:
        specification = ensemble_spec.read(path)
    if not 0 <= arguments.row < specification.runs:
        raise ValueError(f'--row {arguments.row}: must be from 0 to {specification.runs - 1}')
    if arguments.output.suffix not in ('.mcap', '.parquet'):
        raise ValueError(f'{arguments.output}: the name must end in .mcap or .parquet')
    write_row(specification, arguments.row, arguments.output)
    return cli.OK


def _read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a dataset.  Raises OSError or ValueError."""
    path = folder / MANIFEST
    try:
        manifest: dict[str, Any] = json.loads(path.read_bytes())
        is_one = manifest['format'] == 1 and all(
            isinstance(manifest[name], kind) for name, kind in ENTRIES.items())
    except ODD as error:
        raise ValueError(f'{path} is no manifest of an ensemble: {reason_of(error)}') from error
    if not is_one:
        raise ValueError(f'{path} is no manifest of format 1 of an ensemble')
    return manifest


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return in words which entries differ."""
    return ', '.join(f'{name} = {old.get(name)!r}, not {new.get(name)!r}'
                     for name in {**old, **new} if not _same(old.get(name), new.get(name)))


def _same(one: object, other: object) -> bool:
    """Whether two entries are the same, in the same order: that of the samples is of the grid."""
    return json.dumps(one) == json.dumps(other)


def _manifest(folder: Path, specification: Specification, *, resume: bool) -> dict[str, Any]:
    """
    Return the manifest for a new folder, or that of a folder with the same ensemble.

    Raises ValueError or OSError.
    """
    manifest: dict[str, Any] = json.loads(json.dumps({
        'format': 1, 'complete': False, 'versions': versions(),
        'specification': asdict(specification), 'files': {}, 'failed': {}}))
    if resume and (folder / MANIFEST).exists():
        old = _read_manifest(folder)
        for what in ('specification', 'versions'):
            if not _same(old[what], manifest[what]):
                raise ValueError(f'--resume: {folder} has another {what}: '
                                 f'{_difference(old[what], manifest[what])}')
        manifest = old
    elif folder.exists() and (not folder.is_dir() or any(
            entry.name != NEW_MANIFEST for entry in folder.iterdir())):
        raise ValueError(f'{folder} exists and ' + (
            f'has no {MANIFEST}: it is no ensemble to resume' if resume else
            'is not overwritten: --resume goes on with it'))
    return manifest


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest at once, so that it is never there in part."""
    written = folder / NEW_MANIFEST
    with open(written, 'w', encoding='utf-8') as file:
        json.dump(manifest, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    written.replace(folder / MANIFEST)


if __name__ == '__main__':
    sys.exit(main())
