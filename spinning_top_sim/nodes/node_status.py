# SPDX-License-Identifier: Apache-2.0
"""What a running simulation says of itself: /diagnostics, and the status line."""

import math
import time
from operator import itemgetter

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from spinning_top_sim.nodes.recording_session import RecordingSession
from spinning_top_sim.nodes.tick_loop import LoopState, TickLoop
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.live import LiveSimulation

# Keys in /diagnostics that the page of `view` reads, with those of `recording_session`.
STATE, TIME, EPOCH = 'state', 'simulated time [s]', 'stamp of t = 0 [ns]'
SPEED, DRIFT, ERROR = 'real-time factor', 'energy drift', 'orientation error [rad]'


class NodeStatus:
    """Describes a running simulation; the caller holds the simulation's lock."""

    def __init__(self, simulation: LiveSimulation, loop: TickLoop,
                 session: RecordingSession) -> None:
        self._simulation, self._loop, self._session = simulation, loop, session
        self._speed = math.nan                  # simulated time over real time
        self._described: object = None          # the segment that `_regime` names
        self._regime = ''
        self._read_at, self._read_ns = time.monotonic(), 0
        self.waits_for_clock = False            # whether /clock has not begun, or has stopped

    def diagnostics(self, stamp: Time, name: str, max_error: float) -> DiagnosticArray:
        """Return the message for /diagnostics; `max_error` = 0 leaves out the error."""
        simulation, loop, session = self._simulation, self._loop, self._session
        error = simulation.orientation_error if max_error else math.nan
        states = (      # whether it holds, its level, its message
            (True, DiagnosticStatus.OK, 'paused' if loop.paused else 'running'),
            (self.waits_for_clock, DiagnosticStatus.WARN, 'waiting for /clock'),
            (self.overloaded, DiagnosticStatus.WARN, 'this machine cannot keep up'),
            (error > max_error > 0.0, DiagnosticStatus.WARN,
             f'orientation error {error:.3g} rad: more than max_error = {max_error:g} rad'),
            (session.warning, DiagnosticStatus.WARN, f'recording: {session.warning}'),
            (session.error, DiagnosticStatus.ERROR, f'recording: {session.error}'),
            (loop.failure, DiagnosticStatus.ERROR, loop.failure))
        _, level, message = max(filter(itemgetter(0), states), key=itemgetter(1))
        now_ns = loop.now_ns
        numbers = {
            STATE: loop.state.name.lower(),
            TIME: f'{now_ns / NANOSECONDS:.6f}',
            EPOCH: simulation.epoch_ns,
            SPEED: f'{self._measure_speed(now_ns):.3f}',
            'late ticks': loop.late_ticks,
            'skipped ticks': loop.skipped_ticks,
            'published messages': self._total('sent'),
            'skipped samples': self._total('skipped'),
            'clock slip [s]': f'{loop.slipped_ns / NANOSECONDS:.3f}',
            DRIFT: f'{simulation.energy_drift:.3g}',
            ERROR: f'{error:.3g}',
            'commands': loop.commands,
            'rejected commands': loop.rejected_commands,
            'integration steps': simulation.steps,
            'evaluations': simulation.evaluations,
            **session.numbers()}
        return DiagnosticArray(header=Header(stamp=stamp), status=[DiagnosticStatus(
            level=level, name=name, hardware_id='none', message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in numbers.items()])])

    @property
    def overloaded(self) -> bool:
        """Whether samples were too late to be published, or the clock has slipped."""
        return self._loop.slipped_ns > 0 or self._total('skipped') > 0

    def _total(self, count: str) -> int:
        return sum(getattr(output, count) for output in self._simulation.outputs)

    def _measure_speed(self, now_ns: int) -> float:
        """Return simulated time over real time since the previous call, or since a reset."""
        elapsed = time.monotonic() - self._read_at
        if elapsed > 0.1:       # delayed calls follow each other at once
            since_ns = self._read_ns if self._read_ns <= now_ns else 0
            self._speed = (now_ns - since_ns) / NANOSECONDS / elapsed
            self._read_at, self._read_ns = self._read_at + elapsed, now_ns
        return self._speed

    def status_line(self) -> str:
        """Return the line for the terminal, with the angle in degrees."""
        simulation, loop = self._simulation, self._loop
        if simulation.segment is not self._described:
            self._described, motion = simulation.segment, simulation.describe()
            self._regime = motion.name if motion else ''
        theta, sent = math.degrees(float(simulation.state().theta[0])), self._total('sent')
        flag = (' FAILED' if loop.failure else ' waiting for /clock' if self.waits_for_clock
                else ' paused' if loop.paused else '')
        is_running = loop.state is LoopState.RUNNING and not math.isnan(self._speed)
        # The most important parts come first: a terminal shows as much as fits.
        return ' | '.join(filter(None, (
            f't {loop.now_ns / NANOSECONDS:9.2f} s{flag}', self._regime, f'theta {theta:6.2f} deg',
            f'x{self._speed:.2f}' if is_running else '',
            f'{sent} messages' if sent else 'no subscribers yet',
            f'L3 {simulation.l3:.4g} Lz {simulation.lz:.4g}',
            f'energy drift {simulation.energy_drift:+.0e}')))
