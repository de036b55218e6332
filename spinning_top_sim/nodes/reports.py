# SPDX-License-Identifier: Apache-2.0
"""What the nodes say about themselves: /diagnostics, and the status line on the terminal."""

from __future__ import annotations

import math
import os
import sys
import time
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from spinning_top_sim.streams.cdr import NANOSECONDS

if TYPE_CHECKING:
    from spinning_top_sim.nodes.recording_session import RecordingSession
    from spinning_top_sim.nodes.tick_loop import TickLoop
    from spinning_top_sim.streams.pipeline import Simulation

OK, WARN, ERROR = 0, 1, 2


class Speedometer:
    """Measures the real-time factor, simulated over real time between two readings."""

    # Shortest time to measure [s]: reports that were held up follow each other at once.
    SHORTEST = 0.1

    def __init__(self) -> None:
        self.begin(0)

    def begin(self, simulated_ns: int) -> None:
        """Measure from here on, as after a reset."""
        self._real, self._simulated = time.monotonic(), simulated_ns
        self.factor = 0.0

    def read(self, simulated_ns: int) -> float:
        """Return the factor since the reading before."""
        elapsed, advanced = time.monotonic() - self._real, simulated_ns - self._simulated
        if elapsed >= self.SHORTEST:
            self.begin(simulated_ns)
            self.factor = max(0.0, advanced / 1e9 / elapsed)
        return self.factor


class MotionReport:
    """Describes a running simulation; the caller holds the simulation's lock."""

    def __init__(self, simulation: Simulation, loop: TickLoop, session: RecordingSession) -> None:
        self._simulation, self._loop, self._session = simulation, loop, session
        self.speed = Speedometer()
        self._described: object = None          # the motion that `_regime` names
        self._regime = ''

    def diagnostics(self, stamp: Time, name: str, max_error: float) -> DiagnosticArray:
        """
        Return the message for /diagnostics; its level is that of the worst problem.

        stamp, name : time of the message, and what it calls the node
        max_error : largest orientation error that is no problem; 0: it is not computed [rad]
        """
        simulation, loop = self._simulation, self._loop
        error = math.nan if max_error == 0.0 else simulation.orientation_error
        skipped = sum(stream.skipped for stream in simulation.streams)
        problems = [(OK, 'paused' if loop.paused else 'running')]
        if skipped or loop.counters.slipped_ns:
            problems.append((WARN, 'this machine cannot keep up'))
        if error > max_error > 0.0:
            problems.append((WARN, f'orientation error {error:.3g} rad: more than max_error = '
                                   f'{max_error:g} rad'))
        if self._session.error:
            problems.append((ERROR, f'recording: {self._session.error}'))
        if loop.failure:
            problems.append((ERROR, loop.failure))
        level, message = max(problems, key=lambda problem: problem[0])
        array = DiagnosticArray(status=[DiagnosticStatus(
            level=bytes([level]), name=name, hardware_id='none', message=message,
            values=[KeyValue(key=key, value=str(value))
                    for key, value in self._numbers(error, skipped).items()])])
        array.header.stamp = stamp
        return array

    def _numbers(self, error: float, skipped: int) -> dict[str, object]:
        simulation, counters, now_ns = self._simulation, self._loop.counters, self._loop.now_ns
        return {
            'simulated time [s]': f'{now_ns / NANOSECONDS:.6f}',
            'real-time factor': f'{self.speed.read(now_ns):.3f}',
            'late ticks': counters.late_ticks,
            'skipped ticks': counters.skipped_ticks,
            'published messages': self._sent(),
            'skipped samples': skipped,
            'clock slip [s]': f'{counters.slipped_ns / NANOSECONDS:.3f}',
            'orientation error [rad]': f'{error:.3g}',
            'commands': counters.commands,
            'rejected commands': counters.rejected_commands,
            'integration steps': simulation.steps,
            'evaluations': simulation.evaluations,
            **self._session.numbers(),
        }

    def _sent(self) -> int:
        return sum(stream.sent for stream in self._simulation.streams)

    def new_motion(self) -> str | None:
        """Return the present motion in numbers if that was not said yet."""
        simulation = self._simulation
        if simulation.segment is self._described:
            return None
        self._described = simulation.segment
        description = simulation.describe()
        self._regime = 'beyond doubles' if description is None else description.name
        return None if description is None else str(description)

    def status_line(self) -> str:
        """Return the line for the terminal, with the angle in degrees."""
        simulation, loop, size = self._simulation, self._loop, self._session.size
        theta = math.degrees(float(simulation.state().theta[0]))
        flag = ' FAILED' if loop.failure else ' paused' if loop.paused else ''
        log = f' | log {size}' if size else ''
        return (f't {loop.now_ns / NANOSECONDS:9.2f} s{flag} | {self._regime} | '
                f'theta {theta:6.2f} deg | L3 {simulation.l3:.4g} Lz {simulation.lz:.4g} | '
                f'x{self.speed.factor:.2f} | dE/E {simulation.energy_drift:+.0e} | '
                f'{self._sent()} msgs{log}')


class Terminal:
    """Shows a line that overwrites itself on a terminal, and lines one by one elsewhere."""

    def __init__(self) -> None:
        self._overwrites = sys.stdout.isatty()
        self._open = False

    def show(self, line: str) -> None:
        """Show the newest line."""
        if self._overwrites:
            self._write(f'\r\x1b[K{line}')
            self._open = True
        else:
            self._write(f'{line}\n')

    def tell(self, line: str) -> None:
        """Show a line that stays."""
        self.end()
        self._write(f'{line}\n')

    def end(self) -> None:
        """Leave the cursor on a fresh line."""
        if self._open:
            self._open = False
            self._write('\n')

    @staticmethod
    def _write(text: str) -> None:
        try:
            print(text, end='', flush=True)
        except OSError:
            # The reader has gone, as in `sim_node | head`: the motion goes on unread.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
