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
  0    done; failed.json has the runs that failed, with parameters and reasons
  1    every run failed, a file cannot be read or written, or the cluster is lost
  2    wrong arguments or specification
  130  interrupted
"""

import argparse
import asyncio
import concurrent.futures
import contextlib
import json
import logging
import platform
import signal
import sys
from collections.abc import Iterator
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from spinning_top_sim.installation import needed, version
from spinning_top_sim.tools import cli

CONNECT_S, FIRST_WORKER_S = 10.0, 60.0
CONFIGURATION = {
    'distributed.worker.profile.enabled': False,        # it grows with time
    # With Dask's threshold of 64 KiB, glibc returns each array to the system, which takes a third
    # of the time of a run.  Variables of the environment go first.
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 2 ** 26,
    'distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_': 2 ** 25}
# No dashboard, and no port that other machines can reach.
LOCAL = {'threads_per_worker': 1, 'host': '127.0.0.1', 'dashboard_address': '127.0.0.1:0',
         'scheduler_kwargs': {'dashboard': False}, 'silence_logs': logging.CRITICAL}


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
    add('--quiet', action='store_true', help='no progress, no summary')


def _run(arguments: argparse.Namespace) -> int:
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f'--workers {arguments.workers}: must be >= 1')
    with needed('an ensemble', 'ensemble'):     # before anything is written
        import distributed  # noqa: PLC0415

        from spinning_top_sim.tools import ensemble_runs  # noqa: PLC0415
    specification, parts = ensemble_runs.read(arguments.specification)
    folder, runs = arguments.output.absolute(), sum(map(len, parts))
    # The bytes of a dataset depend on these versions, too.
    manifest, text = folder / 'manifest.json', json.dumps({
        'specification': specification._asdict(), 'versions': {
            'python': platform.python_version(), 'machine': platform.machine(),
            **{name: version(name) for name in ('spinning_top_sim', 'numpy', 'pyarrow')}}},
        indent=1)
    if folder.exists() and any(folder.iterdir()) and not (
            manifest.is_file() and manifest.read_text('utf-8') == text):
        raise ValueError(f'{folder}: it has other files, another ensemble, or one of other '
                         'versions: choose a new folder')
    data, failed = folder / 'data', list[list[Any]]()
    with (cli.progress('computed', runs, 'runs', quiet=arguments.quiet) as show,
          connect(arguments.workers, arguments.scheduler) as client):
        data.mkdir(parents=True, exist_ok=True)
        manifest.write_text(text, 'utf-8')
        # If a worker is killed, another one computes its task again.
        tasks = client.map(partial(ensemble_runs.compute_part, specification, data),
                           parts, pure=False)
        try:
            for done, task in enumerate(tasks, 1):
                failed += task.result()
                show(runs * done / len(tasks))
        except (distributed.KilledWorker, distributed.comm.CommClosedError,
                concurrent.futures.CancelledError, asyncio.CancelledError) as error:
            raise RuntimeError('the scheduler is lost, or several workers died of one task: '
                               f'{error}') from error
    for path in data.glob('.*'):                # of a worker that was killed
        path.unlink()
    (folder / 'failed.json').write_text(json.dumps(dict(failed), indent=1), 'utf-8')
    for run, reason in failed[:1]:
        cli.print_line(f'spinning-top ensemble: {len(failed)} of {runs} runs failed, see '
                       f'failed.json; run {run}: {reason}', sys.stderr)
    if not arguments.quiet:
        cli.print_line(f'{arguments.output}: {runs - len(failed)} runs')
    return cli.FAILED if len(failed) == runs else cli.OK


@contextlib.contextmanager
def connect(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """
    Yield the client of a Dask cluster: at an address, or of workers on this machine.

    Raises OSError if it cannot be reached, or has no workers.
    """
    import dask  # noqa: PLC0415
    import distributed  # noqa: PLC0415

    for handler in logging.getLogger('distributed').handlers:
        handler.setLevel(logging.CRITICAL)          # errors are raised by the client
    local = {} if scheduler else {**LOCAL, 'n_workers': workers}
    resource_tracker.ensure_running()       # if it started later, it would unblock SIGINT
    with dask.config.set(CONFIGURATION):
        # A terminal sends Ctrl-C to the workers, too, but only this process reacts.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            client = distributed.Client(
                scheduler, timeout=CONNECT_S, set_as_default=False, **local)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with client:
            client.wait_for_workers(1, FIRST_WORKER_S)
            yield client


main = partial(cli.run, 'ensemble', __doc__, add_arguments, _run)
