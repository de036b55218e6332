# SPDX-License-Identifier: Apache-2.0
"""Dask: workers on this machine or on a cluster, and the tasks that they are given."""

import asyncio
import concurrent.futures
import contextlib
import logging
import os
import signal
import uuid
from collections.abc import Callable, Iterable, Iterator
from itertools import count, islice
from multiprocessing import resource_tracker
from typing import TypeVar

import dask
import distributed

from spinning_top_sim.tools.ensemble_part import EnsembleError

Result = TypeVar('Result')

LOOPBACK = '127.0.0.1'
# Tasks that are submitted at a time, for each thread of the workers: enough that none waits, and
# memory does not grow with the number of tasks.
TASKS_A_THREAD = 4
CONNECT_S, FIRST_WORKER_S = 10.0, 60.0


@contextlib.contextmanager
def connect(workers: int | None, scheduler: str | None) -> Iterator[distributed.Client]:
    """
    Yield a client of a cluster at `scheduler`, else of so many processes on this machine.

    workers : None for one process a core

    Raises EnsembleError if the cluster cannot be reached, or has no workers.
    """
    for handler in logging.getLogger('distributed').handlers:
        handler.setLevel(logging.CRITICAL)          # what matters becomes an error of ours
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # Dask's profile grows with time, and memory grew with the number of runs.
            stack.enter_context(dask.config.set({'distributed.worker.profile.enabled': False}))
            with _interrupts_blocked():
                # Neither a dashboard nor a port that other machines reach.
                address: object = stack.enter_context(distributed.LocalCluster(
                    n_workers=workers or len(os.sched_getaffinity(0)), threads_per_worker=1,
                    host=LOOPBACK, dashboard_address=f'{LOOPBACK}:0',
                    scheduler_kwargs={'dashboard': False}, silence_logs=logging.CRITICAL))
        else:
            address = scheduler
        try:
            client = stack.enter_context(distributed.Client(
                address, timeout=CONNECT_S, set_as_default=False))
            client.wait_for_workers(1, FIRST_WORKER_S)
        except (OSError, TimeoutError) as error:
            raise EnsembleError(f'no workers at {scheduler or "this machine"}: {error}') from error
        yield client


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """
    Block SIGINT in the threads and processes that are started meanwhile, for good.

    A terminal sends Ctrl-C to the workers too.  This process alone shall react.
    """
    resource_tracker.ensure_running()       # when it starts later, it ends the blocking
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def compute(client: distributed.Client, task: Callable[[int], Result],
            numbers: Iterable[int]) -> Iterator[Result]:
    """
    Yield the results of task(number) in the order in which they are ready.

    A task is computed again elsewhere if its worker is killed.  Raises what a task raises, and
    EnsembleError if the scheduler is lost or a task takes its workers with it.
    """
    batch = uuid.uuid4().hex        # the cluster may have tasks of other ensembles
    waiting, running = iter(numbers), distributed.as_completed(loop=client.loop)
    for done in count():
        if done % TASKS_A_THREAD == 0:              # a cluster may grow
            room = TASKS_A_THREAD * max(sum(client.nthreads().values()), 1)
        for number in islice(waiting, max(room - running.count(), 0)):
            running.add(client.submit(task, number, key=f'ensemble-{batch}-{number}', pure=False))
        if running.is_empty():
            return
        try:
            yield next(running).result()
        except distributed.KilledWorker as error:
            raise EnsembleError(f'several workers died, all of them with the same task: {error}'
                                ) from error
        except (concurrent.futures.CancelledError, asyncio.CancelledError,
                distributed.comm.CommClosedError) as error:
            raise EnsembleError('the scheduler is lost') from error
