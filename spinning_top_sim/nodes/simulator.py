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
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from rclpy.timer import Timer
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes import reports, ros_parameters
from spinning_top_sim.nodes.pacing import DeadlineThread, FairLock, MonotonicClock
from spinning_top_sim.nodes.recording_session import RecordingSession
from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.nodes.stream_publishers import StreamPublishers
from spinning_top_sim.nodes.tick_loop import TickLoop, next_epoch
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation

# Threads let go of the interpreter this soon when a tick is due; Python's default is 5 ms.
SWITCH_INTERVAL_S = 1e-4
# How often the first message of a followed /clock is looked for.
CLOCK_PERIOD_S = 0.02
# At the end of `duration` all subscribers together are waited for at most this long.
ACKNOWLEDGED_S = 1.0


class Simulator(Node):
    """
    The node; docs/interface.md has its topics, services and parameters.

    One thread ticks, and the executor's thread does everything else.  Both hold the lock while
    they use the simulation.  `finished` completes when `duration` has passed.  Raises ValueError
    for a bad parameter.
    """

    def __init__(self) -> None:
        super().__init__('spinning_top', automatically_declare_parameters_from_overrides=True)
        self.finished: Future = Future()
        values = ros_parameters.declare(self)
        simulation = self._simulation = Simulation(values)
        # A reset goes back to this; an unset spin.lz is the cusp of the tilt that there is then.
        self._start_spin = {name: values[name] for name in SPIN}
        self._values = {**values, 'spin.lz': simulation.lz}
        self._resetting = False
        self.add_pre_set_parameters_callback(ros_parameters.with_doubles)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        # Another node's /clock is followed, but not one that this node publishes.
        self._follows = (self.get_parameter('use_sim_time').value
                         and not journal.is_enabled('clock', values))
        self._date = self.get_clock() if self._follows else Clock(clock_type=ClockType.SYSTEM_TIME)
        logger = self.get_logger()
        followed = MonotonicClock(self._date_ns, lambda back_ns: logger.warning(
            f'/clock stepped back by {back_ns / NANOSECONDS:g} s: the motion and its stamps go on '
            'from where they are'))
        self._lock = FairLock()
        self._outputs = StreamPublishers(self)
        self._session = RecordingSession(simulation, self._lock, self._outputs.topics_to_record)
        self._loop = TickLoop(
            simulation, values, self._session, align=self._align_ticks,
            update_subscribers=lambda: self._outputs.update_subscribers(simulation.streams),
            error=logger.error, source=followed if self._follows else time.monotonic_ns)
        self._pacer = DeadlineThread(self._guarded(self._tick), values['tick_rate'],
                                     self._guarded(self._idle))
        self._report = reports.MotionReport(simulation, self._loop, self._session)
        self._terminal = reports.Terminal()
        self._outputs.open(simulation.streams, values)
        self._make_interface()
        if not simulation.top.is_realizable:
            logger.warning(
                f'top.lambda3 = {simulation.top.lambda3!r} kg m^2: no rigid body has more than '
                f'2 (lambda1 - M R^2) = {2.0 * simulation.top.lambda1_at_com:g}; simulated all '
                'the same')

    def _make_interface(self) -> None:
        self._diagnostics = self._outputs.create(DiagnosticArray, '/diagnostics')
        self.create_subscription(Float64MultiArray, '~/commands', self._on_command, 10)
        for name, kind, act in (('set_pause', SetBool, self._set_pause),
                                ('step', Trigger, self._step), ('reset', Trigger, self._reset),
                                ('record', SetBool, self._record)):
            self.create_service(kind, f'~/{name}', functools.partial(self._serve, act))
        self._steady_timer(1.0, self._publish_diagnostics)
        self._status_timer: Timer | None = None
        self._set_status_period(self._values['status_period'])

    def _steady_timer(self, period: float, callback: Callable[[], object]) -> Timer:
        """Create a timer that neither a step of the date nor /clock can hold up."""
        return self.create_timer(period, self._guarded(callback),
                                 clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _set_status_period(self, period: float) -> None:
        if self._status_timer is not None:
            self.destroy_timer(self._status_timer)
        self._status_timer = self._steady_timer(period, self._show_status) if period else None

    def _date_ns(self) -> int:
        return self._date.now().nanoseconds

    # ---------------------------------------------------------------------- start and stop

    def start(self) -> None:
        """Let time run: simulated t = 0 is the next point of the stamps' grid."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self._begin_timer = self._steady_timer(CLOCK_PERIOD_S, self._begin)
        self._begin()

    def _begin(self) -> None:
        """Start the motion, unless the /clock that is followed says nothing yet."""
        if self._date_ns() == 0:
            return
        self.destroy_timer(self._begin_timer)
        if self._values['max_error'] > 0.0:
            self._simulation.segment.reference.prepare()    # its modules take a while to import
        now_ns = self._date_ns()
        epoch_ns = self._simulation.epoch_ns = next_epoch(now_ns)
        if not self._follows:
            time.sleep((epoch_ns - now_ns) / NANOSECONDS)
        self._loop.start()
        open_log = self._session.start(self._values) if self._values['record.enabled'] else None
        self._pacer.start()
        if open_log is not None:
            try:
                open_log()
            except RecordingError as error:
                self._session.error = str(error)
                self.get_logger().error(f'not recording: {error}')

    def _align_ticks(self, origin_ns: int | None) -> None:
        """Have ticks just after samples are due."""
        if origin_ns is not None and not self._follows:
            self._pacer.align(origin_ns / NANOSECONDS)

    def stop(self) -> None:
        """End the motion and close the recording; safe whatever state the context is in."""
        self._pacer.stop()
        self._terminal.end()
        summary = self._session.stop()
        if summary:
            self._terminal.tell(summary)

    # ------------------------------------------------------------------------------- ticks

    def _tick(self) -> bool:
        with self._lock:
            wants_idle = self._loop.tick()
        if self._loop.ended and not self.finished.done():
            self._outputs.wait_for_all_acked(ACKNOWLEDGED_S)
            self.finished.set_result(None)
        return wants_idle

    def _idle(self) -> None:
        with self._lock:
            self._loop.idle()

    def _guarded(self, callback: Callable) -> Callable:
        """Return a callback whose unexpected errors stop the motion, not the node or a thread."""
        def call(*arguments: object) -> object:
            try:
                return callback(*arguments)
            except Exception as error:
                self._fail(error)
                return None
        return call

    def _fail(self, error: Exception) -> None:
        """Stop the motion after an unexpected error, and close the log while it is whole."""
        if not self.context.ok():       # publishing fails once the context is down
            return
        self.get_logger().error(traceback.format_exc())
        reason = f'unexpected {type(error).__name__}: {error}'
        with self._lock:
            self._loop.fail(reason)
        self._session.stop(reason)

    # ---------------------------------------------------------------- commands, parameters

    def _outcome(self, act: Callable[[Any], str | None], asked: object) -> tuple[bool, str]:
        """Return whether `act` does it, and what it says; unexpected errors stop the motion."""
        try:
            return True, act(asked) or ''
        except (ValueError, RuntimeError, RecordingError) as error:
            return False, str(error)
        except Exception as error:
            self._fail(error)
            return False, f'{type(error).__name__}: {error}'

    def _on_command(self, message: Float64MultiArray) -> None:
        """Set both parameters of the spin, as a command is a change of these."""
        if len(message.data) == len(SPIN):
            reason = self.set_parameters_atomically([
                Parameter(name, value=message.data[k]) for k, name in enumerate(SPIN)]).reason
        else:
            self._loop.rejected_commands += 1
            reason = f'data has {len(message.data)} values: must be [L3, Lz]'
        if reason:
            self.get_logger().warning(f'~/commands: refused: {reason}')

    def _on_set_parameters(self, given: list[Parameter]) -> SetParametersResult:
        """Apply all changes together or none."""
        changes = {p.name: p.value for p in given if p.name in parameters.BY_NAME}
        if self._resetting or not changes:
            return SetParametersResult(successful=True)
        successful, reason = self._outcome(self._change, changes)
        if not (successful or changes.keys().isdisjoint(SPIN)):
            self._loop.rejected_commands += 1
        return SetParametersResult(successful=successful, reason=reason)

    def _change(self, changes: dict[str, Any]) -> None:
        values = ros_parameters.changed(self._values, changes, self._start_spin)
        rest = sorted(changes.keys() - SPIN)
        with self._lock:
            if len(rest) < len(changes):
                self._loop.command(values['spin.l3'], values['spin.lz'])
            if rest:
                self._session.write_event('parameters', **{name: values[name] for name in rest})
                self._put_into_effect(values, rest)
        self._values = values

    def _put_into_effect(self, values: dict[str, Any], changed: list[str]) -> None:
        self._simulation.apply(values)
        if any(name.endswith('.enabled') for name in changed):
            self._outputs.open(self._simulation.streams, values)
        if 'status_period' in changed:
            self._set_status_period(values['status_period'])
        if 'tick_rate' in changed:
            self._pacer.set_rate(values['tick_rate'])
        self._loop.set_pace(values)

    # ---------------------------------------------------------------------------- services

    def _serve(self, act: Callable[[Any], str], request: object, response: Any) -> object:
        response.success, response.message = self._outcome(act, request)
        return response

    def _check_started(self) -> None:
        if not self._loop.started:
            raise RuntimeError('waiting for the first /clock (use_sim_time is set)')

    def _set_pause(self, request: SetBool.Request) -> str:
        with self._lock:
            if request.data:
                self._loop.pause()
            else:
                self._loop.resume()
            return f'{"paused" if self._loop.paused else "running"} {self._loop.time_text}'

    def _step(self, _: Trigger.Request) -> str:
        with self._lock:
            self._check_started()
            self._loop.step(self._values['step.count'], self._values['step.dt'])
            return self._loop.time_text

    def _reset(self, _: Trigger.Request) -> str:
        with self._lock:
            self._check_started()
            # Back to the spin it was started with, whatever was commanded since.
            self._loop.reset({**self._values, **self._start_spin}, self._date_ns())
        self._values |= {'spin.l3': self._simulation.l3, 'spin.lz': self._simulation.lz}
        self._resetting = True
        try:
            self.set_parameters([Parameter(name, value=self._values[name]) for name in SPIN])
        finally:
            self._resetting = False
        return f'at t = 0, stamps go on from {self._simulation.epoch_ns} ns'

    def _record(self, request: SetBool.Request) -> str:
        if not request.data:
            return self._session.stop() or 'not recording'
        self._check_started()
        return self._session.start(self._values)()

    # ----------------------------------------------------------------------------- reports

    def _publish_diagnostics(self) -> None:
        """Look at the recording, and publish /diagnostics."""
        reason = self._session.check()
        if reason:
            self.get_logger().error(f'recording stopped: {reason}; the simulation goes on')
        if self._session.warning:
            self.get_logger().warning(
                f'recording: {self._session.warning}', throttle_duration_sec=10.0)
        if self._report.overloaded:
            self.get_logger().warning(
                'this machine cannot keep up with these rates: live topics skip samples, or the '
                'clock slips; a recording stays complete, and /diagnostics counts', once=True)
        if self._values['max_error'] > 0.0:
            # Without the lock: it takes milliseconds, and ticks would wait.
            self._simulation.segment.reference.prepare()
        with self._lock:
            message = self._report.diagnostics(
                self.get_clock().now().to_msg(), self.get_fully_qualified_name().lstrip('/'),
                self._values['max_error'])
        self._diagnostics.publish(message)

    def _show_status(self) -> None:
        self._simulation.segment.reference.prepare()
        with self._lock:
            motion, line = self._report.new_motion(), self._report.status_line()
        if motion:
            self._terminal.tell(motion)
        self._terminal.show(line)
