# SPDX-License-Identifier: Apache-2.0
"""The node `spinning_top`: wires a `Simulation` to topics, services and parameters."""

from __future__ import annotations

import functools
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from rclpy.timer import Timer
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes import reports
from spinning_top_sim.nodes.pacing import DeadlineThread, FairLock, MonotonicClock
from spinning_top_sim.nodes.recording_session import RecordingSession
from spinning_top_sim.nodes.ros_parameters import SPIN, ParameterChanges, declare, start_values
from spinning_top_sim.nodes.stream_publishers import StreamPublishers
from spinning_top_sim.nodes.tick_loop import Hooks, TickLoop
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation

# The stamp of t = 0 is a multiple of this, so that grids meet across streams and runs.
EPOCH_GRID_NS = 10_000_000
# Threads let go of the interpreter this soon when a tick is due; Python's default is 5 ms.
SWITCH_INTERVAL_S = 1e-4
# How often the first message of a followed /clock is looked for.
CLOCK_PERIOD_S = 0.02
# At the end of `duration` all subscribers together are waited for at most this long.
ACKNOWLEDGED_S = 1.0
NO_CLOCK = 'waiting for the first /clock (use_sim_time is set)'


def guarded(callback: Callable) -> Callable:
    """Make a callback whose unexpected exceptions stop the motion, not the node or a thread."""
    @functools.wraps(callback)
    def call(self: Simulator, *arguments: Any) -> Any:
        try:
            return callback(self, *arguments)
        except Exception as error:
            self.fail(error)
            if len(arguments) != 2:
                return None
            _, response = arguments         # of a service
            response.success, response.message = False, f'{type(error).__name__}: {error}'
            return response
    return call


class Simulator(Node):
    """
    The node; docs/interface.md has its topics, services and parameters.

    One thread ticks, and the executor's thread does everything else.  Both hold the lock while
    they use the simulation.

    Attributes
    ----------
    finished : rclpy.task.Future
        Completes when `duration` has passed.

    Raises
    ------
    ValueError
        For a bad parameter.

    """

    def __init__(self) -> None:
        super().__init__('spinning_top', automatically_declare_parameters_from_overrides=True)
        self.finished: Future = Future()
        values = start_values(self)
        self._simulation = Simulation(values)
        # A reset goes back to this; an unset spin.lz is the cusp of the tilt that there is then.
        start_spin = {name: values[name] for name in SPIN}
        values = {**values, 'spin.lz': self._simulation.lz}
        declare(self, values)
        self._changes = ParameterChanges(self, values, start_spin, apply=self._apply,
                                         refused=self._count_refusal, failed=self.fail)
        # Another node's /clock is followed, but not one that this node publishes.
        self._follows = (self.get_parameter('use_sim_time').value
                         and not journal.is_enabled('clock', values))
        self._date = self.get_clock() if self._follows else Clock(clock_type=ClockType.SYSTEM_TIME)
        self._followed = MonotonicClock(lambda: self._date.now().nanoseconds)
        self._lock = FairLock()
        self._session = RecordingSession(self._simulation, self._lock, self.resolve_topic_name)
        self._outputs = StreamPublishers(self)
        hooks = Hooks(
            update_subscribers=lambda: self._outputs.update_subscribers(self._simulation.streams),
            has_room=self._session.has_room, wait_for_room=self._session.wait_for_room,
            stopping=lambda: not self.context.ok(), clock_started=self._align_ticks,
            duration_passed=self._finish,
            warn=self.get_logger().warning, error=self.get_logger().error)
        self._loop = TickLoop(self._simulation, values, hooks, source=(
            self._followed if self._follows else time.monotonic_ns))
        self._pacer = DeadlineThread(self._tick, values['tick_rate'], self._idle)
        self._report = reports.MotionReport(self._simulation, self._loop, self._session)
        self._terminal = reports.Terminal()
        self._open_publishers()
        self._make_interface()
        if not self._simulation.top.is_realizable:
            self.get_logger().warning(reports.impossible_body(values))

    # ------------------------------------------------------------------------ construction

    @property
    def _values(self) -> dict[str, Any]:
        return self._changes.values

    def _open_publishers(self) -> None:
        self._outputs.open(self._simulation.streams, self._values)
        self._loop.look_for_subscribers()

    def _make_interface(self) -> None:
        self._diagnostics = self._outputs.create(DiagnosticArray, '/diagnostics')
        self.create_subscription(Float64MultiArray, '~/commands', self._on_command, 10)
        for name, kind, callback in (
                ('set_pause', SetBool, self._on_pause), ('step', Trigger, self._on_step),
                ('reset', Trigger, self._on_reset), ('record', SetBool, self._on_record)):
            self.create_service(kind, f'~/{name}', callback)
        self._steady_timer(1.0, self._publish_diagnostics)
        self._status_timer: Timer | None = None
        self._restart_status()

    def _steady_timer(self, period: float, callback: Callable[[], object]) -> Timer:
        """Create a timer that neither a step of the date nor /clock can hold up."""
        return self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _restart_status(self) -> None:
        if self._status_timer is not None:
            self.destroy_timer(self._status_timer)
            self._status_timer = None
        if self._values['status_period'] > 0.0:
            self._status_timer = self._steady_timer(self._values['status_period'],
                                                    self._show_status)

    # ---------------------------------------------------------------------- start and stop

    def start(self) -> None:
        """Let time run: simulated t = 0 is the next point of the stamps' grid."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self._begin_timer: Timer | None = None
        if not self._begin():
            self._begin_timer = self._steady_timer(CLOCK_PERIOD_S, self._begin)

    def _begin(self) -> bool:
        """Start the motion; return False as long as the /clock that is followed says nothing."""
        if self._date.now().nanoseconds == 0:
            return False
        if self._begin_timer is not None:
            self.destroy_timer(self._begin_timer)
        if self._values['max_error'] > 0.0:
            self._prepare_reference()       # its modules take a while to import
        now_ns = self._date.now().nanoseconds
        epoch_ns = self._simulation.epoch_ns = _ceil_to(now_ns, EPOCH_GRID_NS)
        if not self._follows:
            time.sleep((epoch_ns - now_ns) / NANOSECONDS)
        self._report.speed.begin(0)
        with self._lock:
            self._loop.start()
        if self._values['record.enabled']:
            self._session.attach(self._values, self._outputs.by_topic)
        self._pacer.start()
        if self._values['record.enabled']:
            try:
                self._session.open()
            except RecordingError as error:
                self._session.error = str(error)
                self.get_logger().error(f'not recording: {error}')
        return True

    def _align_ticks(self, origin_ns: int) -> None:
        """Have ticks just after samples are due."""
        if not self._follows:
            self._pacer.align(origin_ns / NANOSECONDS)

    def stop(self) -> None:
        """End the motion and close the recording; safe whatever state the context is in."""
        self._pacer.stop()
        self._terminal.end()
        summary = self._session.stop()
        if summary:
            self._terminal.tell(summary)

    def _finish(self) -> None:
        """Let the last messages arrive, then end the spin."""
        self._outputs.wait_for_all_acked(ACKNOWLEDGED_S)
        if not self.finished.done():
            self.finished.set_result(None)

    # ------------------------------------------------------------------------------- ticks

    def _tick(self) -> bool:
        try:
            with self._lock:
                return self._loop.tick()
        except Exception as error:
            self.fail(error)
            return False

    @guarded
    def _idle(self) -> None:
        with self._lock:
            self._loop.idle()

    def fail(self, error: Exception) -> None:
        """Stop the motion after an unexpected error, and close the log while it is whole."""
        if not self.context.ok():       # publishing fails once the context is down
            return
        self.get_logger().error(traceback.format_exc())
        reason = f'unexpected {type(error).__name__}: {error}'
        with self._lock:
            self._loop.fail(reason)
        self._session.stop(reason)

    # ---------------------------------------------------------------- commands, parameters

    @guarded
    def _on_command(self, message: Float64MultiArray) -> None:
        try:
            if len(message.data) != 2:
                raise ValueError(f'data has {len(message.data)} values: must be [L3, Lz]')
            self._command(*message.data)
        except ValueError as error:
            self._loop.counters.rejected_commands += 1
            self.get_logger().warning(f'~/commands: refused: {error}')
            return
        self._changes.show_spin(*message.data)

    def _command(self, l3: float, lz: float) -> None:
        with self._lock:
            self._session.write_command(self._loop.command(l3, lz), l3, lz)

    def _apply(self, values: dict[str, Any], changed: set[str]) -> None:
        """Put a validated change into effect.  Raises ValueError to refuse it."""
        with self._lock:
            if changed & set(SPIN):
                self._command(values['spin.l3'], values['spin.lz'])
            rest = changed - set(SPIN)
            if rest:
                self._session.write_event('parameters', self._loop.now_ns, self._simulation.now_ns,
                                          **{name: values[name] for name in sorted(rest)})
            # `self._changes` takes the values over only after this.
            before, self._changes.values = self._changes.values, values
            try:
                self._put_into_effect(values, rest)
            except Exception:
                self._changes.values = before
                raise

    def _count_refusal(self, names: set[str]) -> None:
        if names & set(SPIN):
            self._loop.counters.rejected_commands += 1

    def _put_into_effect(self, values: dict[str, Any], changed: set[str]) -> None:
        for stream in self._simulation.streams:
            if f'{stream.parameter}.rate' in changed:
                stream.set_rate(values[f'{stream.parameter}.rate'])
        if any(name.endswith('.enabled') for name in changed):
            self._open_publishers()
        if 'status_period' in changed:
            self._restart_status()
        if 'tick_rate' in changed:
            self._pacer.set_rate(values['tick_rate'])
        self._loop.set_pace(values)

    # ---------------------------------------------------------------------------- services

    @guarded
    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            if request.data:
                self._loop.pause()
            else:
                self._loop.resume()
            response.success = True
            state = 'paused' if self._loop.paused else 'running'
            response.message = f'{state} {self._loop.time_text}'
        return response

    @guarded
    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            if not self._loop.paused:
                response.message = 'running: ~/step works while paused (~/set_pause true)'
            elif not self._loop.started:
                response.message = NO_CLOCK
            else:
                left_ns = self._loop.step(self._values['step.count'], self._values['step.dt'])
                response.success = left_ns == 0
                response.message = self._loop.failure or self._loop.time_text
                if left_ns and not self._loop.failure:
                    response.message += (f': this takes too long, {left_ns / NANOSECONDS:.9g} s '
                                         'are left')
        return response

    @guarded
    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._lock:
            if not self._loop.started:
                response.message = NO_CLOCK
                return response
            simulation = self._simulation
            # Back to the spin it was started with, whatever was commanded since.
            values = {**self._values, **self._changes.start_spin}
            sent_ns = simulation.now_ns
            try:
                self._loop.reset(values, lambda last_ns: _ceil_to(
                    max(last_ns + 1, self._date.now().nanoseconds), EPOCH_GRID_NS))
            except (ValueError, IntegrationError) as error:
                response.message = f'not reset: {error}'
                return response
            self._report.speed.begin(0)
            self._session.write_event('reset', 0, sent_ns, epoch_ns=simulation.epoch_ns,
                                      parameters=values)
            response.success = True
            response.message = f'at t = 0, stamps go on from {simulation.epoch_ns} ns'
            l3, lz = simulation.l3, simulation.lz
        self._changes.show_spin(l3, lz)
        return response

    @guarded
    def _on_record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not request.data:
            response.success, response.message = True, self._session.stop() or 'not recording'
        elif not self._loop.started:
            response.message = f'not recording: {NO_CLOCK}'
        else:
            try:
                response.message = self._session.start(self._values, self._outputs.by_topic)
                response.success = True
            except RecordingError as error:
                response.message = f'not recording: {error}'
                self.get_logger().error(response.message)
        return response

    # ----------------------------------------------------------------------------- reports

    @guarded
    def _publish_diagnostics(self) -> None:
        """Look at the followed clock and the recording, and publish /diagnostics."""
        self._check_clock()
        reason = self._session.check()
        if reason:
            self.get_logger().error(f'recording stopped: {reason}; the simulation goes on')
        if self._values['max_error'] > 0.0:
            self._prepare_reference()
        with self._lock:
            message = self._report.diagnostics(
                self.get_clock().now().to_msg(), self.get_fully_qualified_name().lstrip('/'),
                self._values['max_error'])
        self._diagnostics.publish(message)

    def _check_clock(self) -> None:
        """Warn of a followed /clock that has stepped back, as in a log played in a loop."""
        back_ns = self._followed.take_step_back()
        if back_ns:
            self.get_logger().warning(
                f'/clock stepped back by {back_ns / NANOSECONDS:g} s: the motion and its stamps '
                'go on from where they are')

    def _prepare_reference(self) -> None:
        """Set up the exact solution of the present motion without keeping ticks waiting."""
        with self._lock:
            reference = self._simulation.segment.reference
        reference.prepare()

    @guarded
    def _show_status(self) -> None:
        self._prepare_reference()
        with self._lock:
            motion, line = self._report.new_motion(), self._report.status_line()
        if motion:
            self._terminal.tell(motion)
        self._terminal.show(line)


def _ceil_to(value: int, grid: int) -> int:
    return -(-value // grid) * grid
