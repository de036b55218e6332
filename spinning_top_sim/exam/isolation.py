# SPDX-License-Identifier: Apache-2.0
"""Feeds a filter in a fork of this process, so that hanging or crashing harms nothing else."""

import contextlib
import mmap
import os
import signal
import sys
import time
import warnings
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from spinning_top_sim.exam.trial import (
    InvalidOutputError,
    MakeFilter,
    Output,
    Readings,
    feed,
    update_of,
)

# The longest time that an update, or making the filter, may take.
LONGEST_S = 10.0


def feed_apart(make_filter: MakeFilter, readings: Readings) -> Output:
    """Do as `feed`.  Also raise InvalidOutputError for a filter that crashes or never returns."""
    reached = memoryview(mmap.mmap(-1, 8)).cast('q')        # shared by both processes
    receiver, sender = Pipe(duplex=False)
    _flush()            # or both processes write what is buffered
    with warnings.catch_warnings():
        # A fork has no other threads; this one needs none, as it only runs the filter.
        warnings.simplefilter('ignore', DeprecationWarning)
        process = os.fork()
    if not process:
        _serve(make_filter, readings, reached, sender)
    sender.close()
    answer, before, since = None, 0, time.monotonic()
    try:
        with contextlib.suppress(EOFError):
            while not receiver.poll(0.1 * LONGEST_S):
                if reached[0] != before:
                    before, since = reached[0], time.monotonic()
                elif time.monotonic() - since > LONGEST_S:
                    raise InvalidOutputError(f'{update_of(before, readings)} takes more than '
                                             f'{LONGEST_S:g} s: killed')
            answer = receiver.recv()
    finally:
        os.kill(process, signal.SIGKILL)        # no effect on the exit code of an ended process
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        receiver.close()
    if answer is None:
        how = signal.strsignal(-code) if code < 0 else f'exit code {code}'
        raise InvalidOutputError(f'{update_of(reached[0], readings)} ends the process: {how}')
    if isinstance(answer, InvalidOutputError):
        raise answer
    output: Output = answer
    return output


def _serve(make_filter: MakeFilter, readings: Readings, reached: memoryview,
           sender: Connection) -> None:
    """Feed the filter, send the result and end the process, whatever happens."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)        # no traceback after Ctrl-C
        try:
            sender.send(feed(make_filter, readings, partial(reached.__setitem__, 0)))
        except InvalidOutputError as error:
            sender.send(error)
        _flush()
    finally:
        os._exit(1)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
