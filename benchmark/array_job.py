# SPDX-License-Identifier: Apache-2.0
"""
Solve one motion whenever a line arrives, and answer with the processor time.

    echo exact | PYTHONPATH=. python benchmark/array_job.py

`regression.py` runs it with the package of two checkouts.  It uses the public interface only,
which both have.
"""

import contextlib
import math
import sys

import numpy as np
from timing import seconds_of

from spinning_top_sim import State, Top, solve

TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
THETA, L3 = math.radians(30.0), 1.6
START = State(theta=THETA, l3=L3, lz=L3 * math.cos(THETA))
# Method: the last instant [s], of 2000 instants a second.
LAST = {'exact': 100.0, 'rk45': 20.0}


def cost(method):
    t = np.linspace(0.0, LAST[method], round(2000 * LAST[method]))
    return seconds_of(lambda: solve(TOP, START, t, method=method).quaternion)[0]


def main():
    for line in sys.stdin:
        print(cost(line.strip()), flush=True)


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
