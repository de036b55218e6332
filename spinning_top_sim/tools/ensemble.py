# SPDX-License-Identifier: Apache-2.0
"""
Simulate many runs from one specification into a dataset: the samples of all
runs in Parquet files. Dask shares the runs among the processes of this
machine, or of a cluster.

docs/howto.md describes the specification and the dataset, and
examples/ensemble.yaml is one. A run depends on the specification and its
number alone. The same command again computes the files that are missing, such
as after an interruption.

exit codes:
  0    done; the manifest has the runs that failed, with parameters and reasons
  1    every run failed, a file cannot be read or written, or the cluster is lost
  2    wrong arguments or specification
  130  interrupted
"""

import argparse
import contextlib
import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.installation import needed
from spinning_top_sim.tools import cli, ensemble_spec
from spinning_top_sim.tools.ensemble_part import DATA, compute_part, versions

MANIFEST = 'manifest.json'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('specification', metavar='SPEC', type=Path, help='the specification')
    add('-o', '--output', metavar='DIR', required=True, type=Path, help='folder of the dataset')
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument('--workers', metavar='N', type=int,
        help='processes on this machine; default: one a core')
    workers.add_argument('--scheduler', metavar='ADDRESS',
        help='of a Dask cluster, such as tcp://host:8786, whose machines all have the package and '
        'DIR')
    add('--overwrite', action='store_true', help='replace the dataset in DIR')
    add('--quiet', action='store_true', help='no progress, no summary')


def _run(arguments: argparse.Namespace) -> int:
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f'--workers {arguments.workers}: must be >= 1')
    with needed('an ensemble', 'ensemble'):     # before anything is written
        import pyarrow  # noqa: F401, PLC0415

        from spinning_top_sim.tools import ensemble_cluster  # noqa: PLC0415

    specification = ensemble_spec.read(arguments.specification)
    folder = arguments.output.absolute()
    manifest: dict[str, Any] = json.loads(json.dumps({
        'format': 3, 'complete': False, 'versions': versions(),
        'specification': asdict(specification), 'failed': {}}))
    if (folder / MANIFEST).exists():
        if not arguments.overwrite and not _is_of(folder / MANIFEST, manifest):
            raise ValueError(f'{folder} has another ensemble, or one of other versions: choose a '
                             'new folder, or --overwrite')
    elif folder.exists() and any(folder.iterdir()):
        raise ValueError(f'{folder} exists and has no {MANIFEST}: choose a new folder')
    failed: dict[str, str] = {}
    with (cli.progress('computed', specification.runs, 'runs', quiet=arguments.quiet) as show,
          ensemble_cluster.connect(arguments.workers, arguments.scheduler) as client):
        if arguments.overwrite and (folder / DATA).exists():
            shutil.rmtree(folder / DATA)
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


def _is_of(path: Path, manifest: Mapping[str, Any]) -> bool:
    """Return whether a file is a manifest of the same runs."""
    with contextlib.suppress(ValueError, LookupError, TypeError):
        old = json.loads(path.read_bytes())
        # As text: the order in entries counts, as in a grid of samples.
        return all(json.dumps(old[key]) == json.dumps(manifest[key])
                   for key in ('specification', 'versions'))
    return False


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    written = folder / f'{MANIFEST}.new'
    written.write_text(json.dumps(manifest, indent=1), encoding='utf-8')
    written.replace(folder / MANIFEST)


main = partial(cli.run, 'ensemble', __doc__, add_arguments, _run)
