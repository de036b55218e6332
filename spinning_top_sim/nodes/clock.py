# SPDX-License-Identifier: Apache-2.0
"""Which simulated time is due: by the steady clock, or by the /clock of another node."""

import time
from collections import deque
from collections.abc import Callable

from spinning_top_sim.times import NANOSECONDS

# The stamp of t = 0 is a multiple of this, so that grids meet across streams and runs.
EPOCH_GRID_NS = 10_000_000
LATEST_NS = 500_000_000         # samples later than this are recorded, but not published any more
# Further behind than this, simulated time slips: the real-time factor falls below 1.
LONGEST_LAG_NS = 1_000_000_000
JUMP_NS = 5_000_000_000         # the motion does not run through a longer step of a /clock

Reading = Callable[[], int]     # of a clock [ns]


class SimulatedClock:
    """
    Simulated time that runs `scale` times as fast as a source.  Times are in ns.

    The source is the steady clock.  One that `follows` the /clock of another node has that as its
    date and source, and the steady clock decides only what is late.

    date, steady : return the date, 0 before the first message on a /clock, and steady time
    warn : takes a text about what /clock has done
    publishers : returns how many nodes publish on /clock
    """

    def __init__(self, date: Reading, warn: Callable[[str], object], *, follows: bool = False,
                 publishers: Callable[[], int] = lambda: 1,
                 steady: Reading = time.monotonic_ns) -> None:
        self.date, self.steady, self._warn, self._publishers = date, steady, warn, publishers
        self.follows, self._source = follows, date if follows else steady
        self._scale, self._told_of_several = 1.0, False
        self._source_ns = self._simulated_ns = 0    # the anchor: two times of one moment
        self._newest_ns = 0                         # of the source
        self._late_ns = 0                           # what was due LATEST_NS ago
        self._became_due: deque[tuple[int, int]] = deque()      # steady and simulated times

    def next_epoch(self, last_stamp_ns: int = 0) -> int:
        """
        Return the stamp of t = 0 of a motion that begins now.

        It is the date, rounded up, or the /clock that is followed, rounded down.  It is after the
        last stamp that was sent, unless /clock has gone back meanwhile.
        """
        date_ns = self._counting(self.date())
        epoch_ns = date_ns - date_ns % EPOCH_GRID_NS or EPOCH_GRID_NS   # 0 means "no time"
        if not self.follows and epoch_ns < date_ns:
            epoch_ns += EPOCH_GRID_NS
        if not self.follows or last_stamp_ns <= date_ns:
            epoch_ns = max(epoch_ns, last_stamp_ns + EPOCH_GRID_NS - last_stamp_ns % EPOCH_GRID_NS)
        return epoch_ns

    def begin(self, epoch_ns: int) -> None:
        """Let t = 0 be due when its stamp is the date."""
        lead_ns = max(self._counting(self.date()) - epoch_ns, -EPOCH_GRID_NS)
        self.run(int(lead_ns * self._scale))
        self._late_ns = -1                      # t = 0 is not sent yet

    def run(self, sent_ns: int) -> None:
        """Let simulated time run on from what is sent."""
        self._anchor(sent_ns, self._counting(self._source()))
        self._late_ns = sent_ns
        self._became_due.clear()

    def set_scale(self, scale: float) -> None:
        source_ns = self._counting(self._source())
        self._anchor(self._at(source_ns), source_ns)
        self._scale = scale

    def until_grid(self, period_ns: float) -> float:
        """Return how long it is to the next multiple of a period of real time from t = 0 [ns]."""
        return 0.0 if self.follows else -(
            self._source() - self._source_ns + self._simulated_ns / self._scale) % period_ns

    def _anchor(self, simulated_ns: int, source_ns: int) -> None:
        self._source_ns = self._newest_ns = source_ns
        self._simulated_ns = simulated_ns

    def _at(self, source_ns: int) -> int:
        """Return the simulated time at a time of the source."""
        return self._simulated_ns + int((source_ns - self._source_ns) * self._scale)

    def _counting(self, source_ns: int) -> int:
        """Return the time of the source that counts: of several /clock, the latest."""
        if self.follows and source_ns < self._newest_ns and self._publishers() != 1:
            return self._newest_ns
        return source_ns

    def due(self, epoch_ns: int) -> tuple[int, int, int]:
        """
        Return which samples are due, which are too late, and by how much the stamps move.

        Samples are due up to the first simulated time; those up to the second are too late to be
        published.  By the third, the stamp of t = 0, `epoch_ns`, moves to be at /clock again.
        """
        source_ns = self._source()
        if not self.follows:
            due_ns = self._at(source_ns)
            return due_ns, due_ns - int(LATEST_NS * self._scale), 0
        shift_ns = 0
        step_ns, counting_ns = source_ns - self._newest_ns, self._counting(source_ns)
        if counting_ns != source_ns:
            if self._publishers() > 1 and not self._told_of_several:
                self._warn(f'several nodes publish on /clock, {_seconds(-step_ns)} apart: the '
                           'latest time counts')
                self._told_of_several = True
        elif step_ns < 0:
            self._warn(f'/clock stepped back by {_seconds(-step_ns)}: the motion and its stamps '
                       'go on from where they are; ~/reset brings the stamps back to /clock')
            self._anchor(self._at(self._newest_ns), source_ns)
        elif step_ns > JUMP_NS:
            self._warn(f'/clock jumped forward by {_seconds(step_ns)}: so do the stamps')
            simulated_ns = self._at(self._newest_ns)
            behind_ns = max(source_ns - epoch_ns - simulated_ns, 0)
            shift_ns = behind_ns - behind_ns % EPOCH_GRID_NS
            self._anchor(simulated_ns, source_ns)
        self._newest_ns = counting_ns
        steady_ns, due_ns = self.steady(), self._at(counting_ns)
        self._became_due.append((steady_ns, due_ns))
        while self._became_due[0][0] <= steady_ns - LATEST_NS:
            self._late_ns = self._became_due.popleft()[1]
        return due_ns, self._late_ns, shift_ns

    def slip(self, sent_ns: int) -> int:
        """
        Let simulated time go on from what is sent if that is long due; return the lag then, or 0.

        With a /clock that is followed it never slips: what is too late is not published.
        """
        source_ns = self._source()
        lag_ns = self._at(source_ns) - sent_ns
        if self.follows or lag_ns <= LONGEST_LAG_NS * self._scale:
            return 0
        self._anchor(sent_ns, source_ns)
        return lag_ns


def _seconds(nanoseconds: int) -> str:
    return f'{nanoseconds / NANOSECONDS:.6g} s'
