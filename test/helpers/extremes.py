# SPDX-License-Identifier: Apache-2.0
"""
Extreme values that look legal: numbers, and sets of parameters.

They depend on the random numbers that they are given alone.  Whatever they are, a node must live
on with them, or refuse them in one clear line.
"""

from __future__ import annotations

import math
import random
import sys

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import Parameter

DOUBLES = (0.0, -0.0, 5e-324, 1e-310, 1e-300, 1e-170, 1e-100, 1e-46, 1e-20, 1e-9, 1e-3, 0.5, 1.0,
           3.141592653589793, 2.0, 14.0, 1e3, 1e5, 1e9, 1e10, 1e16, 1e17, 1e20, 1e30, 1e100, 1e154,
           1e200, 1e300, sys.float_info.max)
WRONG = (True, 'text', 1, 1.5, [1.0], ['a'], [], math.inf, -math.inf, math.nan, 2 ** 53 + 1,
         2 ** 63 - 1, -2 ** 63)
STRINGS = ('', 'x', 'world', '/', '~', 'a/b', 'a b', '\u00e9', '\x1b[31m', 'all', 'x' * 300, '..')


def parameter_set(random_: random.Random) -> dict[str, object]:
    """
    Return some parameters at extreme values, by name.

    Most are in the range of their parameter, at its ends as often as not.  Nothing is set that
    writes files or ends a node.
    """
    settable = [row for row in parameters.TABLE if row.name != 'duration'
                and not row.name.startswith('record.')]
    wild = random_.choice((0.0, 0.2))
    return {row.name: random_.choice(WRONG) if random_.random() < wild else _value(random_, row)
            for row in random_.sample(settable, random_.choice((1, 1, 1, 2, 3, 5, 8)))}


def _value(random_: random.Random, row: Parameter) -> object:
    default = row.default
    if isinstance(default, bool):
        return random_.random() < 0.5
    if isinstance(default, tuple):
        return [_number(random_, row) if isinstance(one, float) else random_.choice(STRINGS)
                for one in default]
    if isinstance(default, str):
        return random_.choice(row.choices or STRINGS)
    return _number(random_, row)


def _number(random_: random.Random, row: Parameter) -> float | int:
    """Return an allowed number: an end of the range, or of any magnitude."""
    low, high = row.range.lowest, row.range.highest
    if row.range.is_open:
        low = math.nextafter(low, math.inf)
    number = random_.choice((low, high, random_.choice(DOUBLES), random_.uniform(-10.0, 10.0),
                             -(10.0 ** random_.uniform(-320.0, 308.0))))
    chosen = 0.0 if row.range.has_zero and number < low else min(max(number, low), high)
    return int(chosen) if isinstance(row.default, int) else chosen
