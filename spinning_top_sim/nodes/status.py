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
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.times import NANOSECONDS

# Keys in /diagnostics that the page of `view` reads, with those of `recording`.
STATE, TIME, EPOCH = 'state', 'simulated time [s]', 'stamp of t = 0 [ns]'
SPEED, DRIFT = 'real-time factor', 'energy drift'
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class NodeStatus:
    """Describes a running simulation."""

    def __init__(self, simulation: LiveSimulation, loop: Loop, recording: Recording) -> None:
        self._simulation, self._loop, self._recording = simulation, loop, recording
        self._speed = math.nan                  # simulated time over real time
        self._read_at, self._read_ns = time.monotonic(), 0
        self._told = 0, 0, 0            # failed, skipped, slipped: at the message before
        self.overloaded = False         # whether samples were skipped, or the clock has slipped

    def diagnostics(self, stamp: Time, name: str) -> DiagnosticArray:
        """
        Return the message for /diagnostics.

        Counters are totals; level and message tell the present, and what has happened since the
        message before.
        """
        simulation, loop, recording = self._simulation, self._loop, self._recording
        totals = failed, skipped, _ = (
            self._total('failed'), self._total('skipped'), loop.slipped_ns)
        new_failed = failed - self._told[0]
        self.overloaded, self._told = totals[1:] != self._told[1:], totals
        states = (      # whether it holds, its level, its message
            (True, OK, loop.state.value),
            (loop.state is LoopState.WAITING, WARN, loop.state.value),
            (new_failed, WARN, f'{new_failed} messages could not be published'),
            (self.overloaded, WARN, 'this machine cannot keep up'),
            (recording.warning, WARN, f'recording: {recording.warning}'),
            (recording.error, ERROR, f'recording: {recording.error}'),
            (loop.failure, ERROR, loop.failure))
        _, level, message = max(filter(itemgetter(0), states), key=itemgetter(1))
        now_ns, motion = simulation.now_ns, simulation.trajectory
        numbers = {
            STATE: loop.state.name.lower(),
            TIME: f'{now_ns / NANOSECONDS:.6f}',
            EPOCH: simulation.epoch_ns,
            SPEED: f'{self._measure_speed(now_ns):.3f}',
            'late ticks': loop.late_ticks,
            'skipped ticks': loop.skipped_ticks,
            'published messages': self._total('sent'),
            'skipped samples': skipped,
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

    def _total(self, count: str) -> int:
        return sum(getattr(output, count) for output in self._simulation.outputs)

    def _energy_drift(self) -> float:
        """Return the relative drift since the motion began, absolute where its energy was 0."""
        piece = self._simulation.trajectory.after(self._simulation.now_ns)
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
        """Return the line for the terminal."""
        now_ns, theta = self._simulation.now_ns, float(self._simulation.state().theta[0])
        return (f't {now_ns / NANOSECONDS:9.2f} s {self._loop.state.name.lower()} | '
                f'theta {math.degrees(theta):6.2f} deg | x{self._measure_speed(now_ns):.2f} | '
                f'{self._total("sent")} messages to subscribers')
