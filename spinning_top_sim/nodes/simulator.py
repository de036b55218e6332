# SPDX-License-Identifier: Apache-2.0
"""The node `spinning_top`: wires a `Simulation` to topics, services, parameters and a recorder."""

from __future__ import annotations

import math
import sys
import threading
import time
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes import reports
from spinning_top_sim.nodes.message_types import message_type
from spinning_top_sim.nodes.occasional import OccasionalGroup
from spinning_top_sim.nodes.pacing import DeadlineThread, Onward, SimulatedClock
from spinning_top_sim.nodes.prompt import PromptGroup
from spinning_top_sim.nodes.ros_parameters import SPIN, ParameterChanges, declare, start_values
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import NEVER_NS, Simulation

OK, WARN, ERROR = 0, 1, 2

# The stamp of t = 0 is a multiple of this, so that grids meet across streams and runs.
EPOCH_GRID_NS = 10_000_000
OPENING_NS = 60_000_000
# How often subscriptions are counted; a new subscriber waits at most this long.
LISTENERS_PERIOD_NS = 50_000_000
# Instants computed together, ahead of their time: many as columns, where they cost little more
# than one, and fewer one by one.
COLUMNS_AHEAD, ONES_AHEAD = 256, 16
# In pieces that fill this share of the time between two ticks, so that the next one finds the
# processor free; begun so many ticks, or so much time, before they are needed.
BUSY_SHARE = 0.35
TICKS_AHEAD, AHEAD_NS = 24, 50_000_000
SWITCH_INTERVAL_S = 1e-4
# One tick works at most this long before services and signals get their turn.
TICK_BUDGET_S = 0.05
# One ~/step works at most this long.
STEP_BUDGET_S = 2.0
# Samples later than this are not published any more.
LATEST_NS = 500_000_000
# A simulation further behind than this lets its clock slip: its real-time factor falls below 1.
LONGEST_LAG_NS = 1_000_000_000
# At the end of `duration` all subscribers together are waited for at most this long.
ACKNOWLEDGED_S = 1.0
NO_CLOCK = 'waiting for the first /clock (use_sim_time is set)'


class Simulator(Node):
    """
    See docs/interface.md for topics, services and parameters.

    finished: completes when `duration` has passed.  Construct, then `start`, spin, `stop`.
    Raises ValueError for a bad parameter.
    """

    def __init__(self) -> None:
        super().__init__('spinning_top')
        self.finished: Future = Future()
        values = start_values(self)
        self._lock = threading.RLock()          # the simulation, between ticks and callbacks
        self._simulation = Simulation(values)
        self._counters = reports.Counters()
        self._speed = reports.Speedometer()
        self._terminal = reports.Terminal()
        self._recorder: Any = None
        self._record_error: str | None = None
        self._failure: str | None = None
        self._warned_overload = False
        self._factor = 0.0
        self._described: object = None          # the motion that `_regime` names
        self._regime = ''
        # What a reset goes back to: an unset spin.lz is the cusp, wherever initial.theta is then.
        start_spin = {name: values[name] for name in SPIN}
        values = {**values, 'spin.lz': self._simulation.lz}
        declare(self, values)
        self._changes = ParameterChanges(self, values, start_spin, self._apply,
                                         self._count_refusal)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._publisher_events = OccasionalGroup()
        self._qos: dict[str, QoSProfile] = {}
        self._outputs: dict[str, Publisher] = {}
        self._open_publishers()
        self._make_interface()
        # Another node's /clock is followed; one that is our own cannot be.
        self._follows = (self.get_parameter('use_sim_time').value
                         and not journal.is_enabled('clock', self._values))
        self._date = self.get_clock() if self._follows else Clock(clock_type=ClockType.SYSTEM_TIME)
        self._followed = Onward(lambda: self._date.now().nanoseconds)
        self._told_stepped_back_ns = 0
        self._simulated_clock = SimulatedClock(
            self._followed if self._follows else time.monotonic_ns, values['time_scale'])
        self._take_pace(self._values)
        self._begun = self._ended = False
        self._paused = values['start_paused']
        self._listeners_due = 0
        self._stop_at = 0.0
        self._pacer: DeadlineThread | None = None
        self._tick_timer: Any = None
        if not self._simulation.top.is_realizable:
            top = self._simulation.top
            self.get_logger().warning(
                f'top.lambda3 = {top.lambda3!r} kg m^2: no rigid body has this with top.lambda1 '
                f'= {top.lambda1!r}, top.mass = {top.mass!r} and top.com_distance = '
                f'{top.com_distance!r} (lambda3 <= 2 (lambda1 - M R^2)); simulated all the same')

    # ------------------------------------------------------------------------ construction

    @property
    def _values(self) -> dict[str, Any]:
        return self._changes.values

    def _open_publishers(self) -> None:
        """Have a publisher for each enabled stream, and for no other."""
        for stream in self._simulation.streams:
            wanted = journal.is_enabled(stream.parameter, self._values)
            there = stream.topic in self._outputs
            if wanted and not there:
                self._outputs[stream.topic] = self._publisher(
                    message_type(stream.type_name), stream.topic)
            elif there and not wanted:
                stream.publish = None
                self.destroy_publisher(self._outputs.pop(stream.topic))
        self._listeners_due, self._plain_until_ns = 0, -1

    def _publisher(self, message_type: type, topic: str) -> Publisher:
        qos = QoSProfile(depth=10)
        publisher = self.create_publisher(
            message_type, topic, qos, callback_group=self._publisher_events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._qos[publisher.topic_name] = qos       # with the overrides put in
        return publisher

    def _make_interface(self) -> None:
        self._diagnostics = self._publisher(DiagnosticArray, '/diagnostics')
        self.create_subscription(Float64MultiArray, '~/commands', self._on_command, 10)
        for name, kind, callback in (
                ('set_pause', SetBool, self._on_pause), ('step', Trigger, self._on_step),
                ('reset', Trigger, self._on_reset), ('record', SetBool, self._on_record)):
            self.create_service(kind, f'~/{name}', callback)
        self.create_timer(1.0, self._report, clock=self._steady)
        self._status_timer: Any = None
        self._restart_status()

    def _restart_status(self) -> None:
        if self._status_timer is not None:
            self.destroy_timer(self._status_timer)
            self._status_timer = None
        period = self._values['status_period']
        if period > 0.0:
            self._status_timer = self.create_timer(period, self._show_status, clock=self._steady)

    # ---------------------------------------------------------------------- start and stop

    def start(self) -> None:
        """Let time run: simulated t = 0 is the next point of the stamps' grid."""
        with self._lock:
            self._begin()
        tick_rate = self._values['tick_rate']
        if self._values['pacing'] == 'thread':
            # What else runs in Python lets go of the interpreter this soon, and not after 5 ms.
            sys.setswitchinterval(SWITCH_INTERVAL_S)
            self._pacer = DeadlineThread(self._tick_in_thread, tick_rate, self._prepare)
            self._align_ticks()
            self._pacer.start()
        else:
            self._tick_timer = self.create_timer(1.0 / tick_rate, self._tick_by_timer,
                                                 clock=self._steady, callback_group=PromptGroup())

    def _begin(self) -> bool:
        """Fix the stamp of t = 0; False as long as the /clock that we follow says nothing."""
        if self._date.now().nanoseconds == 0:
            return False
        if self._values['max_error'] > 0.0:
            self._know_exact()          # within a report its import would keep ticks waiting
        now = self._date.now().nanoseconds
        records = self._values['record.enabled']
        # The log's head tells the epoch, and takes a while to reach the disk.
        epoch = _ceil_to(now + (OPENING_NS if records and not self._follows else 0), EPOCH_GRID_NS)
        self._simulation.epoch_ns = epoch
        if records:
            try:
                self._start_recording()
            except Exception as error:      # whatever the disk has against it, the motion goes on
                self._record_error = str(error)
                self.get_logger().error(f'not recording: {error}')
        if not self._follows:
            time.sleep(max(0.0, (epoch - self._date.now().nanoseconds) / NANOSECONDS))
        self._speed.read(0)
        if not self._paused:
            self._start_clock(0)
        self._begun = True
        return True

    def _start_clock(self, simulated_ns: int) -> None:
        self._simulated_clock.start(simulated_ns)
        self._align_ticks()

    def _align_ticks(self) -> None:
        """Have ticks just after samples are due, and not now before and now after."""
        origin_ns = self._simulated_clock.when(0)
        if self._pacer is not None and origin_ns is not None and not self._follows:
            self._pacer.align(origin_ns / NANOSECONDS)

    def stop(self) -> None:
        """End the motion and close the recording; safe whatever state the context is in."""
        if self._pacer is not None:
            self._pacer.stop()
        self._terminal.end()
        summary = self._stop_recording()
        if summary:
            self._terminal.tell(summary)

    def _finish(self) -> None:
        """The duration has passed: let the last messages arrive, then end the spin."""
        give_up = time.monotonic() + ACKNOWLEDGED_S
        for publisher in self._outputs.values():
            if publisher.get_subscription_count():
                left = max(0.0, give_up - time.monotonic())
                publisher.wait_for_all_acked(Duration(nanoseconds=int(left * NANOSECONDS)))
        self._ended = True
        if not self.finished.done():
            self.finished.set_result(None)

    # ------------------------------------------------------------------------------- ticks

    def _tick_in_thread(self) -> bool:
        try:
            return self._tick()
        except Exception:
            if self.context.ok():       # else: publishing fails once the context is down
                raise
            return False

    def _tick_by_timer(self) -> None:
        if self._tick():
            self._prepare()

    def _tick(self) -> bool:
        """Send what is due; return whether `_prepare` is wanted before the next tick."""
        with self._lock:
            now, late_from = time.monotonic_ns(), self._late_from
            self._late_from = now + self._late_after_ns
            due_ns = self._simulated_clock.now()
            # Most ticks have nothing more to do than this, and touch little.
            if (due_ns < self._plain_until_ns and now <= late_from
                    and self._simulation.send_ready(due_ns)):
                return self._computing
            if not (self._begun or self._begin()):
                return False
            if self._paused or self._failure or self._ended:
                return False
            if now > late_from:
                self._count_late_tick(now - late_from)
            return self._attend(now)

    def _attend(self, now: int) -> bool:
        """Send what is due, and look after all else; see `_tick`."""
        if now >= self._listeners_due:
            self._look_for_listeners()
            self._listeners_due = now + LISTENERS_PERIOD_NS
        simulation, due_ns = self._simulation, self._due()
        self._advance(due_ns)
        if self._duration_ns and simulation.now_ns >= self._duration_ns:
            self._finish()
            return False
        self._foresee()
        return simulation.now_ns >= due_ns and (
            self._computing or due_ns >= simulation.ready_ns - self._ahead_ns)

    def _prepare(self) -> None:
        """Compute some of what comes next, while nobody waits for anything."""
        with self._lock:
            simulation = self._simulation
            self._computing = not simulation.prepare(
                simulation.now_ns + self._ahead_ns,
                COLUMNS_AHEAD if simulation.in_columns else ONES_AHEAD, self._busy_ns)
            self._foresee()

    def _foresee(self) -> None:
        """Say until when ticks are plain."""
        simulation = self._simulation
        self._plain_until_ns = min(
            simulation.now_ns + self._listeners_period_ns, self._duration_ns or NEVER_NS,
            NEVER_NS if self._computing else simulation.ready_ns - self._ahead_ns)

    def _take_pace(self, values: dict[str, Any]) -> None:
        """Hold in nanoseconds what every tick asks for."""
        self._duration_ns = round(values['duration'] * NANOSECONDS)     # 0: for ever
        self._tick_period_ns = NANOSECONDS / values['tick_rate']
        self._late_after_ns = round(1.5 * self._tick_period_ns)
        self._late_from = NEVER_NS
        # Simulated time before which a tick in time has only to send what is ready.
        self._plain_until_ns = -1
        self._computing = False
        self._busy_ns = int(BUSY_SHARE * self._tick_period_ns)
        self._listeners_period_ns = round(LISTENERS_PERIOD_NS * values['time_scale'])
        # In simulated time.
        self._ahead_ns = round(values['time_scale'] * max(
            1.5 * self._tick_period_ns, min(TICKS_AHEAD * self._tick_period_ns, AHEAD_NS)))
        self._latest_ns = int(LATEST_NS * values['time_scale'])

    def _due(self) -> int:
        """Return the simulated time to go to: that of the clock, not beyond the duration."""
        now, duration = self._simulated_clock.now(), self._duration_ns
        return min(now, duration) if duration else now

    def _count_late_tick(self, late_ns: int) -> None:
        since_last = late_ns + self._late_after_ns
        self._counters.late_ticks += 1
        self._counters.skipped_ticks += round(since_last / self._tick_period_ns) - 1

    def _look_for_listeners(self) -> None:
        for stream in self._simulation.streams:
            publisher = self._outputs.get(stream.topic)
            heard = publisher is not None and publisher.get_subscription_count() > 0
            # The handle's own: rclpy's publish first finds out, for 3 us, that these are bytes.
            stream.publish = publisher.handle.publish_raw if publisher and heard else None

    def _advance(self, target_ns: int) -> None:
        simulation = self._simulation
        publish_from_ns = target_ns - self._latest_ns
        late = simulation.now_ns < publish_from_ns
        skipped = self._skipped() if late else 0
        self._stop_at = time.monotonic() + TICK_BUDGET_S
        try:
            arrived = self._has_room() and simulation.advance(target_ns, publish_from_ns,
                                                              self._gives_way)
        except IntegrationError as error:
            self._fail(str(error))
            return
        if not arrived:
            lag = target_ns - simulation.now_ns
            if lag > LONGEST_LAG_NS * self._values['time_scale']:
                self._counters.slipped_ns += lag
                self._start_clock(simulation.now_ns)
                self._warn_overload('the clock slips')
                return
        if late and self._skipped() > skipped:
            self._warn_overload('live topics skip samples')

    def _gives_way(self) -> bool:
        """Whether this tick shall end before it has sent all that is due."""
        return time.monotonic() > self._stop_at or not self._has_room()

    def _has_room(self) -> bool:
        """Whether the recorder, if there is one, takes more."""
        return self._recorder is None or self._recorder.room

    def _skipped(self) -> int:
        return sum(stream.skipped for stream in self._simulation.streams)

    def _warn_overload(self, consequence: str) -> None:
        if not self._warned_overload:
            self._warned_overload = True
            self.get_logger().warning(
                f'this machine cannot keep up with these rates: {consequence}; a recording '
                'stays complete, and /diagnostics counts')

    def _fail(self, reason: str) -> None:
        """The equations cannot go on: stand still, say so, and wait for ~/reset."""
        self._failure = reason
        self._simulated_clock.stop()
        self.get_logger().error(f'{reason}; the motion stands still: change the solver.* '
                                'parameters and call ~/reset')

    # ---------------------------------------------------------------- commands, parameters

    def _on_command(self, message: Float64MultiArray) -> None:
        try:
            if len(message.data) != 2:
                raise ValueError(f'data has {len(message.data)} values: must be [L3, Lz]')
            self._command(*message.data)
        except ValueError as error:
            self._counters.rejected_commands += 1
            self.get_logger().warning(f'~/commands: refused: {error}')
            return
        self._changes.follow(spin__l3=message.data[0], spin__lz=message.data[1])

    def _command(self, l3: float, lz: float) -> None:
        with self._lock:
            if not self._paused and not self._failure:
                self._advance(self._due())
            if self._failure:
                raise ValueError(f'l3 = {l3!r}, lz = {lz!r}: the motion stands still: '
                                 f'{self._failure}')
            simulation = self._simulation
            simulation.command(l3, lz)
            self._counters.commands += 1
            at_ns = simulation.history[-1][0]
            self._journal('command', at_ns, simulation.now_ns, l3=l3, lz=lz)
            self._record(journal.COMMANDS, at_ns, journal.command(l3, lz))

    def _apply(self, values: dict[str, Any], changed: set[str]) -> None:
        """Put a validated change of parameters into effect.  Raises ValueError to refuse."""
        with self._lock:
            if changed & {'spin.l3', 'spin.lz'}:
                self._command(values['spin.l3'], values['spin.lz'])
            rest = changed - {'spin.l3', 'spin.lz'}
            if rest:
                now_ns = self._simulation.now_ns
                self._journal('parameters', max(now_ns, 0), now_ns,
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
            self._counters.rejected_commands += 1

    def _put_into_effect(self, values: dict[str, Any], changed: set[str]) -> None:
        simulation = self._simulation
        for stream in simulation.streams:
            if f'{stream.parameter}.rate' in changed:
                stream.set_rate(values[f'{stream.parameter}.rate'])
                stream.resume(simulation.now_ns)
        if any(name.endswith('.enabled') for name in changed):
            self._open_publishers()
        if 'time_scale' in changed:
            self._simulated_clock.set_scale(values['time_scale'])
            self._align_ticks()
        if 'status_period' in changed:
            self._restart_status()
        if 'tick_rate' in changed:
            if self._pacer is not None:
                self._pacer.set_rate(values['tick_rate'])
            elif self._tick_timer is not None:
                self._tick_timer.timer_period_ns = round(NANOSECONDS / values['tick_rate'])
        self._take_pace(values)

    # ---------------------------------------------------------------------------- services

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        with self._lock:
            if request.data and not self._paused:
                self._simulated_clock.stop()
                self._advance(self._due())
                self._simulated_clock.stop()
                self._paused = True
            elif not request.data and self._paused:
                self._paused = False
                self._late_from = NEVER_NS
                if self._begun and not self._failure:
                    self._start_clock(max(self._simulation.now_ns, 0))
            response.success = True
            state = 'paused' if self._paused else 'running'
            response.message = f'{state} at t = {self._seconds():.9g} s'
        return response

    def _seconds(self) -> float:
        return max(self._simulation.now_ns, 0) / NANOSECONDS

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            if not self._paused:
                response.success = False
                response.message = 'running: ~/step works while paused (~/set_pause true)'
                return response
            if not self._begun:
                response.success, response.message = False, NO_CLOCK
                return response
            self._look_for_listeners()
            count, dt = self._values['step.count'], self._values['step.dt']
            target = max(self._simulation.now_ns, 0) + count * round(dt * NANOSECONDS)
            arrived = False
            stop_at = time.monotonic() + STEP_BUDGET_S
            recorder = self._recorder

            def give_way() -> bool:
                if recorder is not None and not recorder.room:
                    recorder.wait_for_room(0.1)
                return time.monotonic() > stop_at or not self.context.ok()

            try:
                arrived = self._simulation.advance(target, give_way=give_way)
            except IntegrationError as error:
                self._fail(str(error))
            self._start_clock(max(self._simulation.now_ns, 0))
            self._simulated_clock.stop()
            response.success = arrived
            response.message = self._failure or f'at t = {self._seconds():.9g} s'
            if not arrived and self._failure is None:
                response.message += (f': after {STEP_BUDGET_S:g} s of computing there are '
                                     f'{(target - self._simulation.now_ns) / NANOSECONDS:.9g} s '
                                     'left; others want to be served too')
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Any:
        with self._lock:
            if not self._begun:
                response.success, response.message = False, NO_CLOCK
                return response
            simulation = self._simulation
            # Back to the spin it was started with, whatever was commanded since.
            values = {**self._values, **self._changes.start_spin}
            sent_ns = simulation.now_ns
            last_stamp = simulation.epoch_ns + sent_ns
            try:
                simulation.restart(values)
            except (ValueError, RuntimeError) as error:
                response.success = False
                response.message = f'not reset: {error}'
                return response
            now = self._date.now().nanoseconds
            simulation.epoch_ns = _ceil_to(max(last_stamp + 1, now), EPOCH_GRID_NS)
            self._failure = None
            self._start_clock(0)
            if self._paused:
                self._simulated_clock.stop()
            self._speed.read(0)
            self._journal('reset', 0, sent_ns, epoch_ns=simulation.epoch_ns,
                          parameters=values)
            response.success = True
            response.message = f'at t = 0, stamps go on from {simulation.epoch_ns} ns'
            l3, lz = simulation.l3, simulation.lz
        self._changes.follow(spin__l3=l3, spin__lz=lz)
        return response

    def _on_record(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        try:
            if request.data:
                if not self._begun:
                    raise RuntimeError(NO_CLOCK)
                response.message = self._start_recording()
            else:
                response.message = self._stop_recording() or 'not recording'
            response.success = True
        except Exception as error:
            response.success = False
            response.message = f'not recording: {error}'
            self.get_logger().error(response.message)
        return response

    # --------------------------------------------------------------------------- recording

    def _start_recording(self) -> str:
        """Open a log and let the streams write to it; return what to tell the caller."""
        from spinning_top_sim.recording.rosbag2 import RecordedTopic  # noqa: PLC0415
        from spinning_top_sim.recording.writer import McapRecorder  # noqa: PLC0415

        with self._lock:
            if self._recorder is not None:
                return f'recording already to {self._recorder.path}'
            values, simulation = self._values, self._simulation
            streams = journal.recorded_streams(simulation.streams, values)
            topics = [RecordedTopic(self._outputs[stream.topic].topic_name, stream.type_name,
                                    _rosbag2_qos(self._qos[self._outputs[stream.topic]
                                                           .topic_name]))
                      for stream in streams]
            topics += [RecordedTopic(self.resolve_topic_name(name), type_name)
                       for name, type_name in journal.TOPICS]
            recorder = McapRecorder.open(
                _free_path(values['record.uri']), topics, self._log_metadata(),
                max_loss=values['record.max_loss'], compression=values['record.compression'],
                min_free_bytes=values['record.min_free_bytes'])
            simulation.log_to(recorder.write_all, streams)
            self._journal_topics = {name: len(streams) + i
                                    for i, (name, _) in enumerate(journal.TOPICS)}
            self._recorder, self._record_error = recorder, None
            self._journal('start', max(simulation.now_ns, 0), simulation.now_ns)
            return f'recording to {recorder.path}'

    def _log_metadata(self) -> dict[str, str]:
        """Return what makes the run computable again from its log."""
        from spinning_top_sim.recording.provenance import provenance  # noqa: PLC0415

        simulation = self._simulation
        return provenance(simulation.values, simulation.epoch_ns, simulation.now_ns,
                          simulation.history,
                          self._values)

    def _stop_recording(self) -> str | None:
        """Close the log; return what to tell, None if there was none."""
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is not None:
                self._simulation.log_to(recorder.write_all, ())
        if recorder is None:
            return None
        summary = recorder.close()
        messages_written = sum(summary.counts.values())
        text = (f'{summary.path}: {messages_written} messages, '
                f'{reports.bytes_for_people(summary.bytes)}')
        return f'{text}; stopped early: {summary.error}' if summary.error else text

    def _record(self, topic: str, at_ns: int, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder.write(self._journal_topics[topic],
                                 self._simulation.epoch_ns + at_ns, data)

    def _journal(self, event: str, at_ns: int, sent_ns: int, **details: Any) -> None:
        """Log what happened to the motion, so that it can be computed again."""
        self._record(journal.EVENTS, at_ns, journal.event(event, at_ns, sent_ns, **details))

    def _check_recorder(self) -> None:
        recorder = self._recorder
        if recorder is not None and recorder.error is not None:
            self._record_error = recorder.error
            self.get_logger().error(f'recording stopped: {recorder.error}; the simulation goes on')
            self._stop_recording()

    # ----------------------------------------------------------------------------- reports

    def _check_clock(self) -> None:
        """Tell of a followed /clock that has stepped back, as one does that is played anew."""
        back_ns = self._followed.stepped_back_ns
        if back_ns > self._told_stepped_back_ns:
            self.get_logger().warning(
                f'/clock stepped back by {(back_ns - self._told_stepped_back_ns) / NANOSECONDS:g} '
                's: the motion and its stamps go on from where they are')
            self._told_stepped_back_ns = back_ns

    def _report(self) -> None:
        """Publish /diagnostics, once a second."""
        self._publisher_events.open()
        self._check_clock()
        self._check_recorder()
        if self._values['max_error'] > 0.0:
            self._know_exact()
        with self._lock:
            simulation, counters = self._simulation, self._counters
            self._factor = self._speed.read(max(simulation.now_ns, 0))
            skipped = self._skipped()
            sent = sum(stream.sent for stream in simulation.streams)
            problems = []
            if self._paused:
                problems.append((OK, 'paused'))
            if skipped or counters.slipped_ns:
                problems.append((WARN, 'this machine cannot keep up'))
            error = self._orientation_error()
            limit = self._values['max_error']
            if error > limit > 0.0:
                problems.append((WARN, f'orientation error {error:.3g} rad: more than max_error '
                                       f'= {limit:g} rad'))
            if self._record_error:
                problems.append((ERROR, f'recording: {self._record_error}'))
            if self._failure:
                problems.append((ERROR, self._failure))
            numbers: dict[str, object] = {
                'simulated time [s]': f'{self._seconds():.6f}',
                'real-time factor': f'{self._factor:.3f}',
                'late ticks': counters.late_ticks,
                'skipped ticks': counters.skipped_ticks,
                'published messages': sent,
                'skipped samples': skipped,
                'clock slip [s]': f'{counters.slipped_ns / NANOSECONDS:.3f}',
                'orientation error [rad]': f'{error:.3g}',
                'commands': counters.commands,
                'rejected commands': counters.rejected_commands,
                'integration steps': simulation.steps,
                'evaluations': simulation.evaluations,
            }
        numbers.update(self._recorder_numbers())
        self._diagnostics.publish(reports.diagnostics(
            self.get_clock().now().to_msg(), self.get_fully_qualified_name().lstrip('/'),
            problems, numbers))

    def _know_exact(self) -> None:
        """Have the exact solution of the present motion, without keeping ticks waiting for it."""
        with self._lock:
            set_up = self._simulation.exact_in_advance()
        set_up()

    def _orientation_error(self) -> float:
        """Return the present error of rk45 [rad]; NaN where nobody wants to know."""
        simulation = self._simulation
        if self._values['max_error'] == 0.0:
            return math.nan
        return simulation.orientation_error(simulation.state(), max(simulation.now_ns, 0))

    def _recorder_numbers(self) -> dict[str, object]:
        recorder = self._recorder
        if recorder is None:
            return {'recorder': 'failed' if self._record_error else 'off'}
        counters = recorder.counters
        return {'recorder': recorder.state, 'recorded file': recorder.path,
                'recorded messages': counters.messages, 'recorded bytes': counters.bytes,
                'queued messages': counters.queued,
                'longest flush [s]': f'{counters.longest_flush:.3f}'}

    def _show_status(self) -> None:
        self._know_exact()
        with self._lock:
            simulation = self._simulation
            state = simulation.state()
            name = self._regime_name()
            drift = simulation.energy_drift(state)
            sent = sum(stream.sent for stream in simulation.streams)
            paused = ' FAILED' if self._failure else ' paused' if self._paused else ''
            line = (max(simulation.now_ns, 0), paused, name, state.theta, simulation.l3,
                    simulation.lz)
        log = None if self._recorder is None else self._recorder.counters.bytes
        self._terminal.show(reports.status_line(*line, self._factor, drift, sent, log))

    def _regime_name(self) -> str:
        """Return the motion's name; tell its numbers whenever it is a new motion."""
        simulation = self._simulation
        if simulation.begun is not self._described:
            self._described = simulation.begun
            description = simulation.describe()
            self._regime = 'beyond doubles' if description is None else description.name
            if description is not None:
                self._terminal.tell(str(description))
        return self._regime


def _rosbag2_qos(qos: QoSProfile) -> dict[str, Any]:
    return {name: int(getattr(qos, name)) for name in ('history', 'depth', 'reliability',
                                                       'durability', 'liveliness')}


def _ceil_to(value: int, grid: int) -> int:
    return -(-value // grid) * grid


def _free_path(uri: str) -> Path:
    """Return where to record to, absolute: `uri`, or a new file named by date in it or here."""
    path = Path(uri).expanduser().absolute()
    if uri and not path.is_dir():
        return path
    stem = time.strftime('spinning_top_%Y-%m-%d_%H-%M-%S')
    number, free = 1, path / f'{stem}.mcap'
    while free.exists():
        number += 1
        free = path / f'{stem}_{number}.mcap'
    return free
