# SPDX-License-Identifier: Apache-2.0
"""Feeds a filter in a fork of this process, so that hanging or crashing harms nothing else."""

import contextlib
import signal
import warnings
from multiprocessing import get_context
from multiprocessing.connection import Connection

from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.trial import InvalidOutputError, MakeFilter, Output, feed

# The longest time that a run may take, and that it may take in addition for each update.
LONGEST_S, UPDATE_S = 10.0, 0.05


def feed_apart(make_filter: MakeFilter, run: Run) -> Output:
    """Do as `feed`.  Also raise InvalidOutputError for a filter that crashes or never returns."""
    context = get_context('fork')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(make_filter, run, sender))
    with warnings.catch_warnings():
        # The fork runs the filter only, and needs no other thread.
        warnings.simplefilter('ignore', DeprecationWarning)
        process.start()
    sender.close()
    patience = LONGEST_S + UPDATE_S * len(run.dt)
    try:
        if not receiver.poll(patience):
            raise InvalidOutputError(f'{len(run.dt)} updates take more than {patience:g} s')
        with contextlib.suppress(EOFError):
            output: Output | InvalidOutputError = receiver.recv()
            if isinstance(output, InvalidOutputError):
                raise output
            return output
        process.join()
        code = process.exitcode or 0
        how = signal.strsignal(-code) if code < 0 else f'exit code {code}'
        raise InvalidOutputError(f'the filter ends the process: {how}')
    finally:
        process.kill()
        process.join()
        receiver.close()


def _serve(make_filter: MakeFilter, run: Run, sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)        # no traceback after Ctrl-C
    try:
        sender.send(feed(make_filter, run))
    except InvalidOutputError as error:
        sender.send(error)
