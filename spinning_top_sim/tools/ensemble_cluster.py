# SPDX-License-Identifier: Apache-2.0
"""Workers of Dask, on this machine or a cluster, and the tasks for them."""

import asyncio
import concurrent.futures
import contextlib
import logging
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import resource_tracker
from typing import TypeVar

import dask
import distributed

Result = TypeVar('Result')

LOOPBACK = '127.0.0.1'
CONNECT_S, FIRST_WORKER_S = 10.0, 60.0
CONFIGURATION = {
    'distributed.worker.profile.enabled': False,        # it grows with time
    # With Dask's threshold of 64 KiB, glibc returns each array to the system, which takes a third
    # of the time of a run.  Variables of the environment go first.
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 2 ** 26,
    'distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_': 2 ** 25}


@contextlib.contextmanager
def connect(workers: int | None, scheduler: str | None) -> Iterator[distributed.Client]:
    """
    Yield a client of the cluster at the address `scheduler`, else of processes on this machine.

    workers : number of processes on this machine, None for one a core

    Raises RuntimeError if the cluster cannot be reached, or has no workers.
    """
    for handler in logging.getLogger('distributed').handlers:
        handler.setLevel(logging.CRITICAL)          # errors are raised by the client
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(dask.config.set(CONFIGURATION))
            resource_tracker.ensure_running()   # if it started later, it would unblock SIGINT
            # A terminal sends Ctrl-C to the workers, too, but only this process reacts.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                # No dashboard, and no port that other machines can reach.
                address: object = stack.enter_context(distributed.LocalCluster(
                    n_workers=workers or len(os.sched_getaffinity(0)), threads_per_worker=1,
                    host=LOOPBACK, dashboard_address=f'{LOOPBACK}:0',
                    scheduler_kwargs={'dashboard': False}, silence_logs=logging.CRITICAL))
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        else:
            address = scheduler
        try:
            client = stack.enter_context(distributed.Client(
                address, timeout=CONNECT_S, set_as_default=False))
            client.wait_for_workers(1, FIRST_WORKER_S)
        except OSError as error:
            raise RuntimeError(f'no workers at {scheduler or "this machine"}: {error}') from error
        yield client


def compute(client: distributed.Client, task: Callable[[int], Result],
            numbers: Iterable[int]) -> Iterator[Result]:
    """
    Yield the results of task(number) in the order of completion.

    If a worker is killed, another one computes its task again.  Raises what a task raises, and
    RuntimeError if the scheduler is lost, or if a task kills several workers.
    """
    results = distributed.as_completed(client.map(task, list(numbers), pure=False),
                                       loop=client.loop)
    try:
        for future in results:
            yield future.result()
    except distributed.KilledWorker as error:
        raise RuntimeError(f'several workers died, all of them with the same task: {error}'
                           ) from error
    except (concurrent.futures.CancelledError, asyncio.CancelledError,
            distributed.comm.CommClosedError) as error:
        raise RuntimeError('the scheduler is lost') from error
