# SPDX-License-Identifier: Apache-2.0
"""The node `spinning_top`: wires a `Simulation` to topics, services and parameters."""

import functools
import importlib
import importlib.util
import itertools
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes import reports, ros_parameters
from spinning_top_sim.nodes.executable import wait_for_all_acked
from spinning_top_sim.nodes.pacing import DeadlineThread, FairLock
from spinning_top_sim.nodes.recording_session import RecordingSession, Topic
from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.nodes.throttle import TOPICS, Throttle
from spinning_top_sim.nodes.tick_loop import (
    EPOCH_GRID_NS,
    TOO_LATE,
    LoopState,
    TickLoop,
    next_epoch,
)
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.streams.live import LiveSimulation, Output
from spinning_top_sim.streams.simulation import PoleError
from spinning_top_sim.streams.stream import Stream

LAST_ANSWERS_S = 0.2            # what answers still take when the node ends


class StreamPublishers:
    """Has a publisher for each enabled stream, and for some one that throttles."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.by_topic: dict[str, Publisher] = {}
        self._throttles: dict[str, Throttle] = {}       # by the topic that each throttles

    def create(self, message_class: type, topic: str) -> Publisher:
        return self._node.create_publisher(
            message_class, topic, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def open(self, outputs: Sequence[Output], values: Mapping[str, Any]) -> None:
        """Create the publishers of enabled streams; destroy those of others."""
        for output in outputs:
            stream = output.stream
            enabled = journal.is_enabled(stream.parameter, values)
            there = stream.topic in self.by_topic
            if enabled and not there:
                package, _, name = stream.type_name.split('/')
                message_class = getattr(importlib.import_module(f'{package}.msg'), name)
                self.by_topic[stream.topic] = self.create(message_class, stream.topic)
                if stream.topic in TOPICS:
                    self._throttles[stream.topic] = Throttle(
                        self.create(message_class, TOPICS[stream.topic]))
            elif there and not enabled:
                output.publish = None
                self._node.destroy_publisher(self.by_topic.pop(stream.topic))
                if stream.topic in TOPICS:
                    self._node.destroy_publisher(self._throttles.pop(stream.topic).publisher)

    def update_subscribers(self, outputs: Sequence[Output]) -> None:
        """Let an output publish if anybody subscribes to its topic; else it computes nothing."""
        for output in outputs:
            publisher = self.by_topic.get(output.stream.topic)
            if publisher is not None:
                sink = publisher.publish if publisher.get_subscription_count() else None
                throttle = self._throttles.get(output.stream.topic)
                output.publish = throttle.sink(output, sink) if throttle else sink

    def flush(self, at_once: bool) -> None:
        """Publish what is withheld, as soon as its rate allows or at once."""
        for throttle in self._throttles.values():
            throttle.flush(at_once)

    def topics_to_record(self, streams: Sequence[Stream]) -> list[Topic]:
        """Return the topics of these streams, and behind them those of the journal."""
        topics: list[Topic] = []
        for stream in streams:
            publisher = self.by_topic[stream.topic]
            topics.append((publisher.topic_name, stream.type_name, {
                name: int(getattr(publisher.qos_profile, name)) for name in (
                    'history', 'depth', 'reliability', 'durability', 'liveliness')}))
        return topics + [(self._node.resolve_topic_name(name), type_name, {})
                         for name, type_name in journal.TOPICS]


def _with_dates(take: Callable[[ClockMessage], object]) -> Callable[[ClockMessage], None]:
    """Return what takes /clock but for times before 0, for which rclpy raises an error."""
    def take_dates(message: ClockMessage) -> None:
        if message.clock.sec >= 0:
            take(message)
    return take_dates


class Simulator(Node):
    """
    The node.  Raises ValueError for a bad parameter.

    One thread ticks, the executor's does all else; both hold the lock to use the simulation.
    """

    def __init__(self, argv: Sequence[str] = ()) -> None:
        super().__init__('spinning_top', automatically_declare_parameters_from_overrides=True)
        self.finished: Future = Future()        # completes after `duration`
        self._terminal = reports.Terminal()
        values = ros_parameters.declare(self, argv)
        simulation = self._simulation = LiveSimulation(values)
        # For `~/reset`.  An unset spin.lz stays unset: a reset computes it from initial.theta.
        self._start_spin = {name: values[name] for name in SPIN}
        self._values = {**values, 'spin.lz': simulation.lz}
        self.add_pre_set_parameters_callback(ros_parameters.with_doubles)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        for subscription in self.subscriptions:
            if subscription.msg_type is ClockMessage:
                subscription.callback = _with_dates(subscription.callback)
        # Another node's /clock is followed, but not one that this node publishes.
        self._follows = (self.get_parameter('use_sim_time').value
                         and not journal.is_enabled('clock', values))
        self._date = self.get_clock() if self._follows else Clock(clock_type=ClockType.SYSTEM_TIME)
        self._clock_seen = 0, time.monotonic()      # newest date [ns], and when it was new [s]
        self._lock = FairLock()
        self._outputs = StreamPublishers(self)
        self._session = RecordingSession(simulation, self._lock, self._outputs.topics_to_record)
        self._loop = TickLoop(
            simulation, values, self._session,
            tell=lambda text, bad: self._log.error(text) if bad else self._log.warning(text),
            update_subscribers=lambda: self._outputs.update_subscribers(simulation.outputs),
            source=self._date_ns if self._follows else time.monotonic_ns)
        self._pacer = DeadlineThread(self._tick, self._idle, lambda: self._loop.grid, self.fail)
        self._report = reports.MotionReport(simulation, self._loop, self._session)
        self._outputs.open(simulation.outputs, values)
        self._diagnostics = self._outputs.create(DiagnosticArray, '/diagnostics')
        self.create_subscription(Float64MultiArray, '~/commands', self._on_command, 10)
        for name, kind, act in (('set_pause', SetBool, self._set_pause),
                                ('step', Trigger, self._step), ('reset', Trigger, self._reset),
                                ('record', SetBool, self._record)):
            self.create_service(kind, f'~/{name}', functools.partial(self._serve, act))
        self._steps_action: object = None
        if values['simulation_interfaces'] and importlib.util.find_spec('simulation_interfaces'):
            from spinning_top_sim.nodes import simulation_services  # noqa: PLC0415
            self._steps_action = simulation_services.offer(
                self, self, self._loop, simulation, self._lock, values['world_frame'])
        self._diagnostics_count = itertools.count()
        self._steady_timer(1.0, self._publish_diagnostics)
        self._status_timer: Timer | None = None
        self._set_status_period(values['status_period'])
        if not simulation.top.is_realizable:
            self._log.warning(
                f'top.lambda3 = {simulation.top.lambda3!r} kg m^2: no rigid body has more than '
                f'2 (lambda1 - M R^2) = {2.0 * simulation.top.lambda1_at_com:g}; simulated all '
                'the same')

    @property
    def _log(self) -> Any:
        """The logger; ends the status line first."""
        self._terminal.end()
        return self.get_logger()

    def _steady_timer(self, period: float, callback: Callable[[], object]) -> Timer:
        """Create a timer that no clock can hold up; unexpected errors stop the motion."""
        def call() -> None:
            try:
                callback()
            except Exception as error:
                self.fail(error)
        return self.create_timer(period, call, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _set_status_period(self, period: float) -> None:
        if self._status_timer is not None:
            self.destroy_timer(self._status_timer)
        self._status_timer = self._steady_timer(period, self._show_status) if period else None

    def _date_ns(self) -> int:
        return self._date.now().nanoseconds

    def start(self) -> None:
        """Let time run: simulated t = 0 is the next point of the stamps' grid."""
        # Threads let go of the interpreter this soon when a tick is due; the default is 5 ms.
        sys.setswitchinterval(1e-4)
        self._begin_timer = self._steady_timer(0.02, self._begin)
        self._begin()

    def _begin(self) -> None:
        """Start the motion, unless the /clock that is followed says nothing yet."""
        if self._date_ns() == 0:
            return
        if self._follows and self._date_ns() > LAST_STAMP_NS - EPOCH_GRID_NS:
            self._log.warning(f'/clock: {TOO_LATE}', once=True)
            return
        self.destroy_timer(self._begin_timer)
        if self._values['max_error'] > 0.0:
            _ = self._simulation.segment.exact    # its modules take a while to import
        now_ns = self._first_date_ns()
        self._simulation.epoch_ns = next_epoch(now_ns)
        if not self._follows:
            time.sleep((self._simulation.epoch_ns - now_ns) / NANOSECONDS)
        self._loop.start()
        open_log = (self._session.start(self.start_values) if self._values['record.enabled']
                    else None)
        self._pacer.start()
        if open_log is not None:
            try:
                self._log.info(open_log())
            except RecordingError as error:     # no service call waits for an answer
                self._session.error = str(error)
                self._log.error(f'not recording: {error}')

    def _first_date_ns(self) -> int:
        """
        Return the date of a t = 0 that begins now [ns].

        No stamp is later than the /clock that is followed; a stamp of 0 is "no time".
        """
        date_ns = self._date_ns()
        return max(date_ns // EPOCH_GRID_NS, 1) * EPOCH_GRID_NS if self._follows else date_ns

    def _watch_clock(self) -> None:
        """Warn when the followed /clock stands for 2 s or has not begun; say when it goes on."""
        date_ns, now = self._date_ns(), time.monotonic()
        if date_ns != self._clock_seen[0]:
            self._clock_seen = date_ns, now
        waits = self._follows and (date_ns == 0 or now > self._clock_seen[1] + 2.0)
        if waits and not self._report.waits_for_clock:
            self._log.warning('waiting for /clock (use_sim_time is set)')
        elif self._report.waits_for_clock and not waits:
            self._log.info('/clock goes on')
        self._report.waits_for_clock = waits

    def stop(self) -> None:
        """End the motion and close the recording; safe whatever state the context is in."""
        self._pacer.stop()
        self._terminal.end()
        summary = self._session.stop()
        if summary:
            self._terminal.tell(summary)
            if self._session.path.exists():
                self._terminal.tell(f'next: {reports.inspect_command(self._session.path)}')

    def _tick(self) -> bool:
        with self._lock:
            wants_idle = self._loop.tick()
            if self._loop.state is not LoopState.RUNNING:
                self._outputs.flush(at_once=self._loop.state is LoopState.ENDED)
        if self._loop.state is LoopState.ENDED and not self.finished.done():
            wait_for_all_acked(self._outputs.by_topic.values(), 1.0)
            if self._steps_action is not None:      # a goal ends with the motion, and is told
                time.sleep(LAST_ANSWERS_S)
            self.finished.set_result(None)
        return wants_idle

    def _idle(self) -> None:
        with self._lock:
            self._loop.idle()

    def fail(self, error: Exception) -> None:
        """Stop the motion after an unexpected error, and close the log while it is whole."""
        if not self.context.ok():       # publishing fails once the context is down
            return
        self._log.error(traceback.format_exc())
        reason = f'unexpected {type(error).__name__}: {error}'
        with self._lock:
            self._loop.fail(reason)
        self._session.stop(reason)

    def _outcome(self, act: Callable[[Any], str | None], asked: object) -> tuple[bool, str]:
        """Return whether `act` does it, and what it says; unexpected errors stop the motion."""
        try:
            return True, act(asked) or ''
        except (ValueError, RuntimeError, RecordingError) as error:
            return False, str(error)
        except Exception as error:
            self.fail(error)
            return False, f'{type(error).__name__}: {error}'

    def _on_command(self, message: Float64MultiArray) -> None:
        """Treat a command as a change of the parameters spin.l3 and spin.lz."""
        if len(message.data) == len(SPIN):
            reason = self.set_parameters_atomically([
                Parameter(name, value=message.data[k]) for k, name in enumerate(SPIN)]).reason
        else:
            self._loop.rejected_commands += 1
            reason = f'data has {len(message.data)} values: must be [L3, Lz]'
        if reason:
            self._log.warning(f'~/commands: refused: {reason}')

    def _on_set_parameters(self, given: list[Parameter]) -> SetParametersResult:
        """Apply all changes together or none."""
        for p in given:
            if p.name == 'use_sim_time' and p.value != self.get_parameter(p.name).value:
                return SetParametersResult(successful=False, reason=(
                    f'{p.name} = {p.value!r}: cannot be changed while the node runs'))
        changes = {p.name: p.value for p in given if p.name in parameters.BY_NAME}
        if not changes:
            return SetParametersResult(successful=True)
        successful, reason = self._outcome(self._change, changes)
        if ros_parameters.is_command(changes) and not successful:
            self._loop.rejected_commands += 1
        return SetParametersResult(successful=successful, reason=reason)

    def _change(self, changes: dict[str, Any]) -> None:
        values, start_spin = ros_parameters.changed(self._values, changes, self._start_spin)
        self._check_surroundings(values, restarted=False)
        rest = sorted(changes.keys() - SPIN)
        with self._lock:
            if ros_parameters.is_command(changes):
                self.check_started()
                self._command(values['spin.l3'], values['spin.lz'])
            if rest:
                changed = {name: values[name] for name in rest}
                self._session.write_event('parameters', **changed)
                self._simulation.apply(changed)
                self._open_outputs(values)
                self._loop.set_pace(values)
        for effect in (parameters.Effect.RESET, parameters.Effect.RECORDING):
            names = [name for name in rest if parameters.BY_NAME[name].effect is effect
                     and values[name] != self._values[name]]
            if names:
                self._log.info(f'{", ".join(names)}: {effect.value}')
        self._values, self._start_spin = values, start_spin

    def _check_surroundings(self, values: Mapping[str, Any], *, restarted: bool) -> None:
        """Raise ValueError for parameters that do not go with what is in use already."""
        if self._follows and journal.is_enabled('clock', values):
            raise ValueError('clock.enabled, publish_clock: must be false while this node follows '
                             'another /clock (use_sim_time)')
        lowest = self._simulation.lowest_imu_rate(restarted=restarted)
        if values['imu.rate'] < lowest:
            raise ValueError(f'imu.rate = {values["imu.rate"]!r}: must be >= {lowest:g} while '
                             'means or increments are taken, published or recorded')

    def _command(self, l3: float, lz: float) -> None:
        try:
            self._loop.command(l3, lz)
        except PoleError as error:
            raise ValueError(
                f'{error}, as by: ros2 topic pub --once {self.resolve_topic_name("~/commands")} '
                "std_msgs/msg/Float64MultiArray '{data: [L3, Lz]}', or by the service "
                f'{self.get_fully_qualified_name()}/set_parameters_atomically') from error

    def _open_outputs(self, values: Mapping[str, Any]) -> None:
        """Have the publishers and the status line that these parameters ask for."""
        self._outputs.open(self._simulation.outputs, values)
        if values['status_period'] != self._values['status_period']:
            self._set_status_period(values['status_period'])

    def _serve(self, act: Callable[[Any], str], request: object, response: Any) -> object:
        response.success, response.message = self._outcome(act, request)
        return response

    def check_started(self) -> None:
        """Raise RuntimeError before the motion begins."""
        if not self._pacer.is_alive():
            raise RuntimeError(self._loop.failure or 'waiting for /clock (use_sim_time is set)')

    def _set_pause(self, request: SetBool.Request) -> str:
        with self._lock:
            if request.data:
                self._loop.pause()
            else:
                self._loop.resume()
            return f'{"paused" if self._loop.paused else "running"} {self._loop.time_text}'

    def _step(self, _: Trigger.Request) -> str:
        with self._lock:
            self.check_started()
            self._loop.step(self._values['step.count'], self._values['step.dt'])
            return self._loop.time_text

    def _reset(self, _: Trigger.Request) -> str:
        self.start_again()
        return f'at t = 0, stamps go on from {self._simulation.epoch_ns} ns'

    @property
    def values(self) -> Mapping[str, Any]:
        """The parameters, with the spin as last commanded."""
        return self._values

    @property
    def start_values(self) -> dict[str, Any]:
        """The parameters that a reset starts with."""
        return {**self._values, **self._start_spin}

    def start_again(self, values: Mapping[str, Any] | None = None,
                    paused: bool | None = None) -> None:
        """
        Reset the motion, with all these parameters instead of the present ones if they are given.

        paused : whether it is paused then; None: as before

        Raises RuntimeError before the motion begins, and ValueError where none does; then nothing
        changes.
        """
        with self._lock:
            self.check_started()
            start = self.start_values if values is None else values
            self._check_surroundings(start, restarted=True)
            self._loop.reset(start, self._first_date_ns(), paused)
            if values is not None:
                self._open_outputs(values)
                self._start_spin = {name: values[name] for name in SPIN}
        if values is not None:
            changed = [name for name in values if values[name] != self._values[name]]
            self._values = dict(values)
            self._show(name for name in changed if name not in SPIN)
        self.show_spin()

    def show_spin(self) -> None:
        """Let the parameters spin.l3 and spin.lz show the present ones."""
        self._values |= {'spin.l3': self._simulation.l3, 'spin.lz': self._simulation.lz}
        self._show(SPIN)

    def _show(self, names: Iterable[str]) -> None:
        """Let parameters show values that are in effect already."""
        self.remove_on_set_parameters_callback(self._on_set_parameters)
        try:
            self.set_parameters([
                Parameter(name, value=list(value) if isinstance(value, tuple) else value)
                for name, value in ((name, self._values[name]) for name in names)])
        finally:
            self.add_on_set_parameters_callback(self._on_set_parameters)

    def can_send(self) -> bool:
        """Return False when a signal has ended the context."""
        return bool(self.context.ok())

    def finish(self) -> None:
        """End the process, once the response that is under way has been sent."""
        self._finish_timer = self._steady_timer(
            LAST_ANSWERS_S, lambda: self.finished.done() or self.finished.set_result(None))

    def _record(self, request: SetBool.Request) -> str:
        if not request.data:
            summary = self._session.stop()
            if summary and self._session.error:
                raise RecordingError(summary)
            return summary or 'not recording'
        self.check_started()
        self._check_recording()
        return self._session.start(self.start_values)()

    def _check_recording(self) -> None:
        reason = self._session.check()
        if reason:
            self._log.error(f'recording stopped: {reason}; the simulation goes on')

    def _publish_diagnostics(self) -> None:
        """Look at /clock, the recording and other nodes, and publish /diagnostics."""
        self._watch_clock()
        self._check_recording()
        if self._session.warning:
            self._log.warning(f'recording: {self._session.warning}', throttle_duration_sec=10.0)
        if next(self._diagnostics_count) % 10 == 1:       # a look every 10 s
            names = self.get_node_names_and_namespaces()
            if names.count((self.get_name(), self.get_namespace())) > 1:
                self._log.warning(
                    f'there is another node {self.get_fully_qualified_name()}: give one of them a '
                    'namespace, with --ros-args -r __ns:=/NAME', once=True)
        if self._report.overloaded:
            self._log.warning(
                'this machine cannot keep up with these rates: live topics skip samples, or the '
                'clock slips; a recording stays complete, and /diagnostics counts', once=True)
        if self._values['max_error'] > 0.0:
            # Without the lock: it takes milliseconds, and ticks would wait.
            _ = self._simulation.segment.exact
        with self._lock:
            message = self._report.diagnostics(
                self.get_clock().now().to_msg(), self.get_fully_qualified_name().lstrip('/'),
                self._values['max_error'])
        self._diagnostics.publish(message)

    def _show_status(self) -> None:
        _ = self._simulation.segment.exact
        with self._lock:
            motion, line = self._report.new_motion(), self._report.status_line()
        if motion and self.context.ok():        # a signal may have ended it
            self._log.info(motion)
        self._terminal.show(line)
