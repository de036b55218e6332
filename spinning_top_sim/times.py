# SPDX-License-Identifier: Apache-2.0
"""
Times: whole nanoseconds, since the start of a motion or, for stamps, since 1970.

All subpackages import these from here.
"""

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]       # (n,) [ns]

NANOSECONDS = 1_000_000_000     # of a second
NEVER_NS = 2 ** 63 - 1          # later than every time
# The seconds of a stamp of ROS are an int32: the last stamp is in January 2038.
LAST_STAMP_NS = 2 ** 31 * NANOSECONDS - 1


def check_stamp(stamp_ns: int) -> None:
    """Raise ValueError for a stamp [ns] that ROS does not have."""
    if not 0 <= stamp_ns <= LAST_STAMP_NS:
        raise ValueError(f'the stamp {stamp_ns / NANOSECONDS:.12g} s: must be >= 0 and '
                         f'< {2 ** 31} s, in January 2038')


def stamp_text(time_ns: int) -> str:
    """Return a time in seconds, to the nanosecond."""
    return f'{time_ns // NANOSECONDS}.{time_ns % NANOSECONDS:09d}'


def period_ns(rate: float) -> int:
    """Return the time from one sample to the next at a rate [Hz], in whole nanoseconds."""
    return max(1, round(NANOSECONDS / rate))


def ns_array(times: Times | range) -> Times:
    """Return times as an array."""
    if isinstance(times, range):        # `numpy.arange` takes its length from doubles
        return times.start + times.step * np.arange(len(times), dtype=np.int64)
    return np.asarray(times)
