# SPDX-License-Identifier: Apache-2.0
"""Computes the run of a log again, from its description alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Rows, Simulation
from spinning_top_sim.streams.schedule import NEVER_NS, offline_block_ns, offline_targets
from spinning_top_sim.tools.run_description import Event, RunDescription


class DepartureError(Exception):
    """The computation cannot follow the journal; the text says where."""


class Rerun:
    """
    The run of a log, computed again.

    run : from the log
    send : takes the samples of the log's streams in blocks; without it only the motions are
        computed
    simulation : at the time that `advance` has reached, in the beginning that of the recording
    stamp_ns : log time up to which all samples have been sent [ns]

    Raises DepartureError where there is no motion with these parameters and commands.
    """

    def __init__(self, run: RunDescription, send: Rows | None = None) -> None:
        self.run, self._send = run, send
        self._stopped = False       # the equations could not go on
        try:
            self.simulation = simulation = Simulation(run.values, run.epoch_ns)
        except (ValueError, IntegrationError) as error:
            raise DepartureError(str(error)) from error
        for at_ns, l3, lz in run.history:
            self._reach(at_ns)
            self._command(at_ns, l3, lz)
        if send is not None:
            self._reach(run.begun_ns)
        # -1: commands before the first sample.
        simulation.now_ns = -1 if run.begun_ns < 0 else max(run.begun_ns, simulation.now_ns)
        self._set_rates({name: value for name, value in run.now.items()
                         if value != run.values[name]})
        if send is not None:
            simulation.record_blocks(
                [stream for stream in simulation.streams if stream.topic in run.topics])
        self.stamp_ns = run.epoch_ns + simulation.now_ns

    def advance(self, end_ns: int) -> Iterator[Event | None]:
        """
        Go on to a log time; yield each event when it has been applied, and None after a block.

        Raises DepartureError where an event cannot be applied.
        """
        simulation = self.simulation
        for event in (*self.run.events, None):
            if event is not None and event.name == 'start':
                continue
            stop_ns = end_ns - simulation.epoch_ns if event is None else event.sent_ns
            block_ns = NEVER_NS if self._send is None else offline_block_ns(
                [stream for stream in simulation.streams if stream.has_sinks])
            for target_ns, item in offline_targets(max(simulation.now_ns, 0), [(stop_ns, event)],
                                           block_ns):
                # Without samples states are only needed where a command finds them.
                if self._send is not None or (item is not None and item.name == 'command'):
                    self._reach(target_ns)
                self.stamp_ns = simulation.epoch_ns + target_ns
                if item is not None:
                    simulation.now_ns = target_ns
                    self._apply(item)
                yield item

    def _reach(self, target_ns: int) -> None:
        """Compute, and send, the samples up to a time, as far as the equations go."""
        if not self._stopped:
            try:
                self.simulation.advance_in_blocks(target_ns, self._send or (lambda *_: None))
            except IntegrationError:
                self._stopped = True

    def _apply(self, event: Event) -> None:
        details = event.details
        try:
            if event.name == 'command':
                self._command(event.t_ns, details['l3'], details['lz'])
            elif event.name == 'parameters':
                self._set_rates(details)
            else:
                self.simulation.restart(parameters.checked(details['parameters']))
                self.simulation.epoch_ns = int(details['epoch_ns'])
                self._stopped = False
        except (KeyError, TypeError, ValueError, IntegrationError) as error:
            raise DepartureError(f'{event.name} at t = {event.t_ns} ns: '
                                 f'{type(error).__name__}: {error}') from error

    def _command(self, at_ns: int, l3: float, lz: float) -> None:
        try:
            self.simulation.command(l3, lz)
        except ValueError as error:
            raise DepartureError(f'command at t = {at_ns} ns: {error}') from error
        applied_ns = self.simulation.history[-1][0]
        if applied_ns != at_ns:
            raise DepartureError(f'command at t = {at_ns} ns: applied at {applied_ns} ns')

    def _set_rates(self, changed: Mapping[str, Any]) -> None:
        for stream in self.simulation.streams:
            name = f'{stream.parameter}.rate'
            if name in changed:
                stream.set_rate(parameters.BY_NAME[name].check(changed[name]))
