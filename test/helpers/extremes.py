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

LARGEST = sys.float_info.max
DOUBLES = (0.0, -0.0, 5e-324, 1e-310, 1e-300, 1e-170, 1e-100, 1e-46, 1e-20, 1e-9, 1e-3, 0.5, 1.0,
           3.141592653589793, 2.0, 14.0, 1e3, 1e5, 1e9, 1e10, 1e16, 1e17, 1e20, 1e30, 1e100, 1e154,
           1e200, 1e300, LARGEST)
NOT_FINITE = float('inf'), float('-inf'), float('nan')
INTEGERS = (0, 1, -1, 2, 14, 1000, 2 ** 31 - 1, 2 ** 31, 2 ** 53 + 1, 2 ** 63 - 1, -2 ** 63)
STRINGS = ('', 'x', 'world', '/', '~', 'a/b', 'a b', '\u00e9', '\x1b[31m', 'all', 'x' * 300, '..')


def parameter_set(random_: random.Random) -> dict[str, object]:
    """
    Return some parameters at extreme values, by name.

    Most are in the range of their parameter, at its ends as often as not.  Nothing is set that
    writes files or ends a node.
    """
    settable = [row for row in parameters.TABLE if row.name != 'duration'
                and not row.name.startswith('record.')]
    wild = random_.choice((0.0, 0.4))
    return {row.name: (_any_value if random_.random() < wild else _allowed_value)(random_, row)
            for row in random_.sample(settable, random_.choice((1, 1, 1, 2, 3, 5, 8)))}


def _number(random_: random.Random, row: Parameter) -> float | int:
    """Return an allowed number: an end of the range, the default, or of any magnitude."""
    low, high, default = row.range.lowest, row.range.highest, row.default
    if row.range.is_open:
        low = math.nextafter(low, math.inf)
    wanted = random_.choice((low, high, default, _double(random_), _double(random_),
                             random_.uniform(-10.0, 10.0)))
    wanted = float(wanted if isinstance(wanted, int | float) else 1.0)
    if low >= 0.0:
        wanted = abs(wanted)
    chosen = 0.0 if row.range.has_zero and wanted < low else min(max(wanted, low), high)
    return int(chosen) if isinstance(default, int) else chosen


def _allowed_value(random_: random.Random, row: Parameter) -> object:
    default = row.default
    if row.choices:
        return random_.choice(row.choices)
    if isinstance(default, bool):
        return random_.random() < 0.5
    if isinstance(default, tuple) and isinstance(default[0], float):
        return [_number(random_, row) for _ in default]
    return default if isinstance(default, str | tuple) else _number(random_, row)


def _any_value(random_: random.Random, row: Parameter) -> object:
    """Return a value of the right type as a rule, and of any size."""
    default = row.default
    if random_.random() < 0.1:
        return random_.choice((True, 'text', 1, 1.5, [1.0], ['a'], [], random_.choice(NOT_FINITE)))
    if isinstance(default, tuple):
        return ([random_.choice(STRINGS) for _ in range(random_.randint(0, 3))]
                if isinstance(default[0], str) else [_double(random_) for _ in default])
    if isinstance(default, str):
        return random_.choice(STRINGS)
    return random_.choice(INTEGERS) if isinstance(default, int) else _double(random_)


def _double(random_: random.Random) -> float:
    value = (random_.choice(DOUBLES) if random_.random() < 0.7
             else 10.0 ** random_.uniform(-320.0, 308.0))
    return value if random_.random() < 0.7 else -value
