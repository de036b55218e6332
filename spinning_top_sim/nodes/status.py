# SPDX-License-Identifier: Apache-2.0
"""What a running simulation says of itself: /diagnostics, and the status line."""

import math
import time
from operator import itemgetter

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from spinning_top_sim.nodes.loop import Loop, LoopState
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.live import LiveSimulation

# Keys in /diagnostics that the page of `view` reads, with those of `recording`.
STATE, TIME, EPOCH = 'state', 'simulated time [s]', 'stamp of t = 0 [ns]'
SPEED, DRIFT = 'real-time factor', 'energy drift'


class NodeStatus:
    """Describes a running simulation."""

    def __init__(self, simulation: LiveSimulation, loop: Loop, recording: Recording) -> None:
        self._simulation, self._loop, self._recording = simulation, loop, recording
        self._speed = math.nan                  # simulated time over real time
        self._described: object = None          # the piece of the motion that `_regime` names
        self._regime = ''
        self._read_at, self._read_ns = time.monotonic(), 0
        self.waits_for_clock = False            # whether /clock has not begun, or has stopped

    def diagnostics(self, stamp: Time, name: str) -> DiagnosticArray:
        """Return the message for /diagnostics."""
        simulation, loop, recording = self._simulation, self._loop, self._recording
        failed = self._total('failed')
        states = (      # whether it holds, its level, its message
            (True, DiagnosticStatus.OK, 'paused' if loop.paused else 'running'),
            (self.waits_for_clock, DiagnosticStatus.WARN, 'waiting for /clock'),
            (failed, DiagnosticStatus.WARN, f'{failed} messages could not be published'),
            (self.overloaded, DiagnosticStatus.WARN, 'this machine cannot keep up'),
            (recording.warning, DiagnosticStatus.WARN, f'recording: {recording.warning}'),
            (recording.error, DiagnosticStatus.ERROR, f'recording: {recording.error}'),
            (loop.failure, DiagnosticStatus.ERROR, loop.failure))
        _, level, message = max(filter(itemgetter(0), states), key=itemgetter(1))
        now_ns, motion = loop.now_ns, simulation.trajectory
        numbers = {
            STATE: loop.state.name.lower(),
            TIME: f'{now_ns / NANOSECONDS:.6f}',
            EPOCH: simulation.epoch_ns,
            SPEED: f'{self._measure_speed(now_ns):.3f}',
            'late ticks': loop.late_ticks,
            'skipped ticks': loop.skipped_ticks,
            'published messages': self._total('sent'),
            'skipped samples': self._total('skipped'),
            'failed messages': failed,
            'clock slip [s]': f'{loop.slipped_ns / NANOSECONDS:.3f}',
            DRIFT: f'{self._energy_drift():.3g}',
            'commands': loop.commands,
            'rejected commands': loop.rejected_commands,
            'integration steps': motion.steps,
            'evaluations': motion.evaluations,
            **recording.numbers()}
        return DiagnosticArray(header=Header(stamp=stamp), status=[DiagnosticStatus(
            level=level, name=name, hardware_id='none', message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in numbers.items()])])

    @property
    def overloaded(self) -> bool:
        """Whether samples were too late to be published, or the clock has slipped."""
        return self._loop.slipped_ns > 0 or self._total('skipped') > 0

    def _total(self, count: str) -> int:
        return sum(getattr(output, count) for output in self._simulation.outputs)

    def _energy_drift(self) -> float:
        """Return the relative drift since the motion began, absolute where its energy was 0."""
        piece = self._simulation.trajectory.after(self._loop.now_ns)
        return float(relative_drift(self._simulation.state().energy, piece.energy)[0])

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
        motion = simulation.trajectory
        piece = motion.after(loop.now_ns)
        if piece is not self._described:
            self._described, description = piece, piece.describe()
            self._regime = description.name if description else ''
        theta, sent = math.degrees(float(simulation.state().theta[0])), self._total('sent')
        flag = (' FAILED' if loop.failure else ' waiting for /clock' if self.waits_for_clock
                else ' paused' if loop.paused else '')
        is_running = loop.state is LoopState.RUNNING and not math.isnan(self._speed)
        # The most important parts come first: a terminal shows as much as fits.
        return ' | '.join(filter(None, (
            f't {loop.now_ns / NANOSECONDS:9.2f} s{flag}', self._regime, f'theta {theta:6.2f} deg',
            f'x{self._speed:.2f}' if is_running else '',
            f'{sent} messages' if sent else 'no subscribers yet',
            f'L3 {motion.l3:.4g} Lz {motion.lz:.4g}',
            f'energy drift {self._energy_drift():+.0e}')))
