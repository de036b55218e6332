# SPDX-License-Identifier: Apache-2.0
"""
Do the job named by each line of standard input, and answer with its processor time [s].

    echo exact | PYTHONPATH=. python benchmark/array_job.py

`regression.py` runs it with the package of each checkout.  It uses `solve` alone, whose interface
they share.
"""

import math
import signal
import sys
import time

import numpy as np

from spinning_top_sim import State, Top, solve

TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
TIMES = np.arange(5121) / 512.0
# The method, the instants and how often.
JOBS = {'set-up': ('exact', np.zeros(1), 20), 'exact': ('exact', TIMES, 10),
        'rk45': ('rk45', TIMES, 1)}


def cost(job, number):
    method, times, repeats = JOBS[job]
    begin = time.process_time()
    for k in range(repeats):        # of motions that nothing remembers
        l3 = 1.6 + 1e-6 * (number * repeats + k)
        start = State(theta=0.5, l3=l3, lz=l3 * math.cos(0.5))
        solve(TOP, start, times, method=method).quaternion.sum()
    return (time.process_time() - begin) / repeats


signal.signal(signal.SIGINT, signal.SIG_DFL)      # ends without a traceback
for number, line in enumerate(sys.stdin):
    print(cost(line.strip(), number), flush=True)
