#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure the time per state over the number of states, compared with other solvers.

    python benchmark/solvers.py                 # two minutes

Each method computes two, a hundred and a hundred thousand states of the scene `cusp` at 512 Hz
from the start, with the functions of `peers.py`.  Time is the processor time of the whole call
over the number of states, the median of interleaved rounds in one process and one thread.  It
contains the set-up of the exact solution except in rows with "prepared".  It does not contain
compilation and loading.  With "prepared, any times" the instants are in random order, which steps
cannot have.  The error is the largest rotation angle to the exact solution, whose own error is in
work_precision.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np
from cases import FINEST_NS, WORK_PRECISION, Case
from peers import FailedError, Peer, Runner, peer
from report import number, preamble, table, write_section
from timing import TimeUpError, interleaved, one_thread, time_limit
from truth import angles_between

from spinning_top_sim.solvers.exact import ExactSolution

COUNTS = (2, 100, 100_000)
CHOSEN = (('exact, any times', 0.0), ('exact, grid', 0.0),
          ('rk45 transport', 1e-9), ('rk45 transport', 1e-11), ('SciPy RK45', 1e-9),
          ('SciPy DOP853', 1e-12), ('heyoka quadratic', 1e-12), ('heyoka quadratic', 2.0 ** -52))
LONGEST_S = 20.0


class _Prepared(Runner):
    """The exact solution after its set-up; the times are in random order."""

    def __init__(self, case: Case, setting: float) -> None:
        super().__init__(case, setting)
        self.solution = ExactSolution(case.top, case.start)

    def attitudes(self, ns):
        shuffled = np.random.default_rng(1).permutation(len(ns))
        result = np.empty((len(ns), 4))
        result[shuffled] = self.solution.states(ns[shuffled]).quaternion
        return result


class _PreparedGrid(_Prepared):
    def attitudes(self, ns):
        return self.solution.states(range(0, int(ns[1]) * len(ns), int(ns[1]))).quaternion


PREPARED = (Peer('exact, prepared, any times', 'ours', _Prepared, (0.0,)),
            Peer('exact, prepared, grid', 'ours', _PreparedGrid, (0.0,)))


def measure(case: Case, count: int, rounds: int) -> dict[str, tuple[float, float] | str]:
    """Return (seconds per state, error) of each method, or what happened to it."""
    ns = np.arange(count, dtype=np.int64) * FINEST_NS
    truth = case.exact.states(ns).quaternion
    found: dict[str, tuple[float, float] | str] = {}
    runs: dict[object, Callable[[], object]] = {}
    errors = {}
    for one, setting in [*((p, 0.0) for p in PREPARED), *((peer(n), s) for n, s in CHOSEN)]:
        name = one.label(setting)
        if one.missing():
            found[name] = 'absent'
            continue
        try:
            with time_limit(LONGEST_S):
                runner = one.ready(case, setting)
                result = runner.attitudes(ns)
        except (FailedError, TimeUpError) as error:
            found[name] = str(error)
            continue
        errors[name] = float(angles_between(result, truth).max())
        runs[name] = lambda runner=runner: runner.attitudes(ns)
        found[name] = ''
    times = interleaved(runs, rounds)
    for name, seconds in times.items():
        found[name] = seconds / count, errors[name]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('Time per state')        # with the commit that is there now
    one_thread()
    case = WORK_PRECISION[0]
    found = {count: measure(case, count, arguments.rounds) for count in COUNTS}
    rows = []
    for name in found[COUNTS[0]]:
        cells = [name]
        for count in COUNTS:
            one = found[count][name]
            cells += [one, '–'] if isinstance(one, str) else [number(1e6 * one[0], 3),
                                                              number(one[1])]
        rows.append(cells)
    heads = ['method', *(head for count in COUNTS
                         for head in (f'{count} states: µs a state', 'error [rad]'))]
    text = f'{case.title}; {arguments.rounds} rounds.\n\n' + table(heads, rows)
    print(text)
    if not arguments.no_report:
        write_section('solvers', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
