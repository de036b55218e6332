# SPDX-License-Identifier: Apache-2.0
"""
Feeds a filter in a process of its own: one that never returns, or crashes, harms nothing else.

The process is a copy of this one, which needs neither to find nor to import the filter's class.
"""

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
    Readings,
    Said,
    feed,
    update_of,
)

# An update may take this long, and so may making the filter.
LONGEST_S = 10.0


def feed_apart(make_filter: MakeFilter, readings: Readings) -> Said:
    """Do as `feed`.  A filter that crashes, or never returns, raises InvalidOutputError too."""
    reached = memoryview(mmap.mmap(-1, 8)).cast('q')        # both processes see it
    receiver, sender = Pipe(duplex=False)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()          # else both write what is in the buffer
    with warnings.catch_warnings():
        # Of other threads, which the copy does not have: it runs nothing but the filter.
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
                    answer = (f'{update_of(before, readings)} takes more than {LONGEST_S:g} s: '
                              'killed')
                    break
            else:
                answer = receiver.recv()
    finally:
        os.kill(process, signal.SIGKILL)        # one that has ended keeps its code
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        receiver.close()
    if answer is None:
        how = signal.strsignal(-code) if code < 0 else f'exit code {code}'
        raise InvalidOutputError(f'{update_of(reached[0], readings)} ends the process: {how}')
    if isinstance(answer, str):
        raise InvalidOutputError(answer)
    said: Said = answer
    return said


def _serve(make_filter: MakeFilter, readings: Readings, reached: memoryview,
           sender: Connection) -> None:
    """Feed the filter, send what comes of it, and end the process, whatever happens."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)        # no traceback after Ctrl-C
        try:
            sender.send(feed(make_filter, readings, partial(reached.__setitem__, 0)))
        except InvalidOutputError as error:
            sender.send(str(error))
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    finally:
        os._exit(1)
