# SPDX-License-Identifier: Apache-2.0
"""
The node `spinning_top`: connects a simulation to topics, services and parameters.

Everything happens in the thread of the executor; a steady timer ticks.
"""

import gc
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.task import Future
from rclpy.timer import Timer
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from spinning_top_sim.nodes import publishers, ros_parameters
from spinning_top_sim.nodes.clock import SimulatedClock
from spinning_top_sim.nodes.executable import tell
from spinning_top_sim.nodes.loop import Loop, LoopState
from spinning_top_sim.nodes.recording import Recording
from spinning_top_sim.nodes.ros_parameters import SPIN
from spinning_top_sim.nodes.status import NodeStatus
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.parameter import Effect
from spinning_top_sim.times import NANOSECONDS


class Simulator(Node):
    """
    The node.  Raises ValueError for a parameter that is not allowed.

    given : parameters of its command line, which those of ROS override
    values_next : what the next reset begins with; an unset spin.lz follows initial.theta
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        super().__init__('spinning_top', automatically_declare_parameters_from_overrides=True)
        self.finished: Future = Future()        # completes after `duration`
        log = self._log = self.get_logger()
        overrides = ros_parameters.take_overrides(self)
        values = self.values_next = ros_parameters.declare(self, given, overrides)
        self.set_descriptor('use_sim_time', ParameterDescriptor(
            read_only=True, dynamic_typing=True))
        simulation = self.simulation = LiveSimulation(values)
        self.add_pre_set_parameters_callback(ros_parameters.all_with_types)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._topics = publishers.ChannelPublishers(self, simulation)
        self._recording = Recording(simulation, self._topics.topics_to_record)
        # A node does not follow its own /clock.
        follows = self.get_parameter('use_sim_time').value and not (
            parameters.is_enabled('clock', values))
        self.clock = SimulatedClock(
            (lambda: int(self.get_clock().now().nanoseconds)) if follows else time.time_ns,
            log.warning, follows=follows, publishers=partial(
                self.count_publishers, self.resolve_topic_name('/clock')))
        self.loop = Loop(
            simulation, values, self._recording, self.clock,
            error=log.error, update_subscribers=self._topics.update_subscribers)
        self._timer_of: dict[str, Timer] = {}       # by what it does
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._topics.open(values)
        self._diagnostics = publishers.create_publisher(self, DiagnosticArray, '/diagnostics')
        self.create_subscription(Float64MultiArray, '~/commands', self._on_command, 10)
        self.create_subscription(Twist, '~/cmd_vel', self._on_velocity, 10)
        for name, kind, act in (('set_pause', SetBool, self._set_pause),
                                ('step', Trigger, self._step), ('reset', Trigger, self._reset)):
            self.create_service(kind, f'~/{name}', partial(self._serve, act))
        answers_later(self.create_service(SetBool, '~/record', self._record))
        ros_parameters.warn_of_disobeyed(self, overrides)
        if objection := simulation.trajectory.top.objection:
            log.warning(objection)

    def start(self) -> None:
        """Let time run: simulated t = 0 is the next point on the grid of the stamps."""
        # The recorder's thread releases the interpreter this soon when a tick is due.
        sys.setswitchinterval(1e-4)
        self._report = NodeStatus(self.simulation, self.loop, self._recording)
        self._every('diagnostics', 1.0, self._publish_diagnostics)
        self._every('collection', 60.0, partial(gc.collect, 2))     # else a full one is rare
        if period := self.values_next['status_period']:
            self._every('status', period, lambda: tell(self._report.status_line()))
        self._begin()
        self._align_ticks()

    def _begin(self) -> None:
        """Let time run if the clock that is followed has begun; ticks try it until then."""
        if self.clock.date() == 0:
            self._log.warning(self.loop.state.value, once=True)
            return
        self.loop.start()
        if self.values_next['record.enabled']:
            self._recording.start(self.values_next, lambda success, text: (
                self._log.info(text) if success else None))

    def _align_ticks(self) -> None:
        """Let ticks come just after samples are due."""
        period_ns = self.loop.tick_period_ns
        time.sleep(self.clock.until_grid(period_ns) / NANOSECONDS)
        self._every('tick', period_ns / NANOSECONDS, self._tick)
        self._tick()

    def _tick(self) -> None:
        state = self.loop.tick()
        if reason := self._recording.check():
            self._log.error(f'not recording: {reason}; the simulation goes on')
        if state is LoopState.WAITING:
            self._begin()
        elif state is LoopState.ENDED and 'end' not in self._timer_of:     # ticks go on
            publishers.wait_for_all_acked(self._topics.by_topic.values(), 1.0)
            self._every('end', 0.2, lambda: self.finished.set_result(None))     # after answers

    def _every(self, name: str, period: float, callback: Callable[[], object]) -> None:
        """Call back in steady time, each `period` [s], instead of what this timer did before."""
        if name in self._timer_of:
            self.destroy_timer(self._timer_of[name])
        self._timer_of[name] = self.create_timer(period, callback, clock=self._steady)

    def stop(self) -> None:
        """End the motion and close the recording, whether the context is valid or not."""
        if summary := self._recording.close():
            tell(summary)

    def _on_command(self, message: Float64MultiArray) -> None:
        """Take over L3 and Lz, which the parameters show then."""
        def command() -> None:
            if len(message.data) != len(SPIN):
                raise ValueError(f'data has {len(message.data)} values: must be [L3, Lz]')
            self._command(dict(zip(SPIN, message.data, strict=True)))
            self.show_spin()

        self._obey('~/commands', command)

    def _on_velocity(self, message: Twist) -> None:
        """Drive the pivot; the axes are those of the world."""
        linear, angular = ([part.x, part.y, part.z] for part in (message.linear, message.angular))

        def drive() -> None:
            if any(angular):
                raise ValueError(f'angular = {angular!r} rad/s: must be 0')
            self.loop.change('drive', partial(self.simulation.drive_details, linear))

        self._obey('~/cmd_vel', drive)

    def _obey(self, topic: str, act: Callable[[], None]) -> None:
        """Do what a message asks for, or count and name why not."""
        error, reason = self.outcome(act)
        if error is not None:
            self.loop.rejected_commands += 1
            self._log.warning(f'{topic}: refused: {reason}')

    def _on_set_parameters(self, given: list[Parameter]) -> SetParametersResult:
        """Apply all changes or none."""
        changes = {p.name: p.value for p in given if p.name in parameters.BY_NAME}
        if changes.items() <= self._spin().items():     # nothing changes
            return SetParametersResult(successful=True)
        # A spin beside `initial.*` is that of the next start; alone it is a command.
        command = {} if any(name.startswith('initial.') for name in changes) else {
            name: changes.pop(name) for name in SPIN if name in changes}
        error, reason = self.outcome(lambda: self._change(command, changes))
        if error is not None and command:
            self.loop.rejected_commands += 1
        return SetParametersResult(successful=error is None, reason=reason)

    def _change(self, command: Mapping[str, Any], others: Mapping[str, Any]) -> None:
        """Command a spin and take over other parameters, or none of them where one is refused."""
        for name, value in (*command.items(), *others.items()):
            if value is None:
                raise ValueError(f'{name}: cannot be unset while the node runs')
        values = parameters.checked({**self.values_next, **others})
        if self.clock.follows and parameters.is_enabled('clock', values):
            raise ValueError('clock.enabled = True: must be false while this node follows another '
                             '/clock (use_sim_time)')
        try:                # what may be refused comes first
            self._topics.open(values)
            if command:
                self._command(command)
            if others:
                self.loop.set_parameters(values, {name: values[name] for name in sorted(
                    others.keys() - SPIN)})
        except Exception:
            self._topics.open(self.values_next)
            raise
        self.values_next = values
        if others.keys() & {'tick_rate', 'time_scale'}:
            self._align_ticks()
        for name in sorted(others):
            if (effect := parameters.BY_NAME[name].effect) is not Effect.NOW:
                self._log.info(f'{name}: {effect.value}')

    def _command(self, given: Mapping[str, Any]) -> None:
        command = parameters.checked_changes(given)
        # The motion goes on with what is not commanded.
        self.loop.change('command', lambda: {
            name.removeprefix('spin.'): command.get(name, present)
            for name, present in self._spin().items()})

    def outcome(self, act: Callable[[], str | None]) -> tuple[Exception | None, str]:
        """Return the error of an action, and its text; raise one that is unexpected."""
        try:
            return None, act() or ''
        except (ValueError, RuntimeError, OSError) as error:
            return error, str(error)

    def _serve(self, act: Callable[[Any], str], request: object, response: Any) -> object:
        error, response.message = self.outcome(lambda: act(request))
        response.success = error is None
        return response

    def _set_pause(self, request: SetBool.Request) -> str:
        (self.loop.pause if request.data else self.resume)()
        return f'{self.loop.state.value} {self.loop.time_text}'

    def resume(self) -> None:
        """Let simulated time run on.  Raises RuntimeError if the motion has failed."""
        self.loop.resume()
        self._align_ticks()

    @property
    def step_ns(self) -> int:
        """The length of a step: whole nanoseconds, so that n steps are n times one step."""
        return round(self.values_next['step.dt'] * NANOSECONDS)

    def _step(self, _: Trigger.Request) -> str:
        self.loop.step(self.values_next['step.count'] * self.step_ns)
        return self.loop.time_text

    def _reset(self, _: Trigger.Request) -> str:
        self.start_again()
        return f'at t = 0, stamps go on from {self.simulation.epoch_ns} ns'

    def start_again(self, paused: bool | None = None) -> None:
        """Reset the motion, as `Loop.reset` does."""
        self.loop.reset(self.values_next, paused)
        self._align_ticks()
        self.show_spin()

    def _spin(self) -> dict[str, float]:
        """Return the present spin, by the names of its parameters."""
        simulation = self.simulation
        return dict(zip(SPIN, simulation.trajectory.momenta(simulation.now_ns), strict=True))

    def show_spin(self) -> None:
        """Let the parameters show the present spin."""
        self.set_parameters_atomically([
            Parameter(name, value=value) for name, value in self._spin().items()])

    def _record(self, request: SetBool.Request, response: SetBool.Response) -> Future:
        """Return the response, which is there when the log is open or closed."""
        future: Future = Future()

        def answer(success: bool, message: str) -> None:
            response.success, response.message = success, message
            future.set_result(response)

        try:
            if request.data:
                self.loop.refuse_in(LoopState.WAITING)
                self._recording.start(self.values_next, answer)
            else:
                self._recording.end(answer)
        except RuntimeError as error:       # also of a thread that cannot start
            answer(False, str(error))
        return future

    def _publish_diagnostics(self) -> None:
        self._diagnostics.publish(self._report.diagnostics(
            self.get_clock().now().to_msg(), self.get_fully_qualified_name().lstrip('/')))
        if self._report.overloaded:
            self._log.warning(
                'this machine cannot keep up with these rates: live topics skip samples, or the '
                'clock slips; a recording stays complete, and /diagnostics counts', once=True)


def answers_later(service: Service) -> None:
    """Let a callback return a Future of the response: EventsExecutor has no coroutines here."""
    send = service.send_response

    def send_when_done(future: Future, header: object) -> None:
        future.add_done_callback(lambda done: send(done.result(), header))

    vars(service)['send_response'] = send_when_done
