# SPDX-License-Identifier: Apache-2.0
"""
Simulate many runs from one specification into a dataset: the samples of all
runs in Parquet files. Dask shares the runs among the processes of this
machine, or of a cluster.

docs/howto.md describes the specification and the dataset, and
examples/ensemble.yaml is one. A run depends on the specification and its
number alone. The same command again computes the files that are missing, such
as after an interruption.

  ensemble DIR --row K -o one.mcap           # computes run K again, as a log

exit codes:
  0    done; the manifest has the reasons of runs that failed
  1    every run failed, a file cannot be read or written, or the cluster is lost
  2    wrong arguments or specification
  130  interrupted
"""

import argparse
import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.tools import cli, ensemble_spec
from spinning_top_sim.tools.ensemble_part import DATA, compute_part, versions, write_row

MANIFEST = 'manifest.json'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('specification', metavar='SPEC', type=Path,
        help='the specification, or with --row the folder of a dataset')
    add('-o', '--output', metavar='DIR', required=True, type=Path,
        help='folder of the dataset; with --row a new .mcap or .parquet file')
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument('--workers', metavar='N', type=int,
        help='processes on this machine; default: one a core')
    workers.add_argument('--scheduler', metavar='ADDRESS',
        help='of a Dask cluster, such as tcp://host:8786, whose machines all have the package and '
        'DIR')
    add('--overwrite', action='store_true', help='replace the dataset in DIR')
    add('--row', metavar='K', type=int, help='compute run K alone')
    add('--quiet', action='store_true', help='no progress, no summary')


def _run(arguments: argparse.Namespace) -> int:
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f'--workers {arguments.workers}: must be >= 1')
    with needed('an ensemble', 'ensemble'):
        return (_compute_dataset if arguments.row is None else _compute_row)(arguments)


def _compute_dataset(arguments: argparse.Namespace) -> int:
    import pyarrow  # noqa: F401, PLC0415 - before anything is written

    from spinning_top_sim.tools import ensemble_cluster  # noqa: PLC0415

    specification = ensemble_spec.read(arguments.specification)
    folder = arguments.output.absolute()
    manifest: dict[str, Any] = json.loads(json.dumps({
        'format': 3, 'complete': False, 'versions': versions(),
        'specification': asdict(specification), 'failed': {}}))
    if (folder / MANIFEST).exists():
        old, _ = _read_manifest(folder)
        # As text: the order in entries counts, as in a grid of samples.
        if not arguments.overwrite and any(json.dumps(old[key]) != json.dumps(manifest[key])
                                           for key in ('specification', 'versions')):
            raise ValueError(f'{folder} has another ensemble, or one of other versions: choose a '
                             'new folder, or --overwrite')
    elif folder.exists() and any(folder.iterdir()):
        raise ValueError(f'{folder} exists and has no {MANIFEST}: choose a new folder')
    failed: dict[str, str] = {}
    with (cli.progress('computed', specification.runs, 'runs', quiet=arguments.quiet) as show,
          ensemble_cluster.connect(arguments.workers, arguments.scheduler) as client):
        if arguments.overwrite:
            shutil.rmtree(folder / DATA, ignore_errors=True)
        (folder / DATA).mkdir(parents=True, exist_ok=True)
        _write_manifest(folder, manifest)
        task = partial(compute_part, specification, folder=str(folder))
        parts = ensemble_cluster.compute(client, task, range(specification.parts))
        for done, reasons in enumerate(parts, start=1):
            failed.update(reasons)
            show(min(done * specification.runs_per_part, specification.runs))
    failed = dict(sorted(failed.items(), key=lambda item: int(item[0])))
    _write_manifest(folder, {**manifest, 'complete': True, 'failed': failed})
    for path in (folder / DATA).glob('.*'):     # of a worker that was killed
        path.unlink()
    if failed:
        run, reason = next(iter(failed.items()))
        cli.print_line(f'spinning-top ensemble: {len(failed)} of {specification.runs} runs failed'
                       f', see {MANIFEST}; run {run}: {reason}', sys.stderr)
    if not arguments.quiet:
        cli.print_line(f'{arguments.output}: {specification.runs - len(failed)} runs')
    return cli.FAILED if len(failed) == specification.runs else cli.OK


def _compute_row(arguments: argparse.Namespace) -> int:
    path: Path = arguments.specification
    if path.is_dir():
        manifest, specification = _read_manifest(path)
        if manifest['versions'] != versions():
            cli.print_line('spinning-top ensemble: the last bits may differ: the dataset is of '
                           f'other versions, {manifest["versions"]}', sys.stderr)
    else:
        specification = ensemble_spec.read(path)
    if not 0 <= arguments.row < specification.runs:
        raise ValueError(f'--row {arguments.row}: must be from 0 to {specification.runs - 1}')
    if arguments.output.suffix not in ('.mcap', '.parquet'):
        raise ValueError(f'{arguments.output}: the name must end in .mcap or .parquet')
    write_row(specification, arguments.row, arguments.output)
    return cli.OK


def _read_manifest(folder: Path) -> tuple[dict[str, Any], ensemble_spec.Specification]:
    """Return the manifest of a dataset, and its specification.  Raises OSError or ValueError."""
    path = folder / MANIFEST
    try:
        manifest: dict[str, Any] = json.loads(path.read_bytes())
        specification = ensemble_spec.parse(manifest['specification'], 'specification')
        return {**manifest, 'versions': dict(manifest['versions'])}, specification
    except MALFORMED as error:
        raise ValueError(f'{path} is no manifest of an ensemble: {reason_of(error)}') from error


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    written = folder / f'{MANIFEST}.new'
    written.write_text(json.dumps(manifest, indent=1), encoding='utf-8')
    written.replace(folder / MANIFEST)


main = partial(cli.run, 'ensemble', __doc__, add_arguments, _run)
