# SPDX-License-Identifier: Apache-2.0
"""The recording of a running simulation: opens the log, feeds it, watches it, closes it."""

from __future__ import annotations

import functools
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from spinning_top_sim.nodes.pacing import FairLock
from spinning_top_sim.nodes.reports import human_readable
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.streams.topics import Stream

# Opening a log imports and loads libraries, so that is done where a log is opened.
if TYPE_CHECKING:
    from spinning_top_sim.recording.writer import McapRecorder

# Stamps whose messages wait at most for the file that is being opened.
MOST_PENDING = 20_000

# Messages of one stamp: indices of their topics, stamp [ns], CDR of each, size of all [bytes].
Messages = tuple[Sequence[int], int, Sequence[bytes], int]
# What `provenance` takes; the present values come last.
Run = tuple[Mapping[str, Any], int, int, tuple[tuple[int, float, float], ...], Mapping[str, Any]]


class RecordingSession:
    """
    Records a simulation into one log at a time.

    Nothing waits for the disk while it holds the simulation's lock: while a log is being opened,
    its messages are kept in memory.

    Parameters
    ----------
    simulation, lock
        What is recorded, and the lock to hold while it is used.
    resolve
        Returns the full name of a topic.

    Attributes
    ----------
    error : str or None
        Why the newest recording stopped early or could not start.

    """

    def __init__(self, simulation: Simulation, lock: FairLock,
                 resolve: Callable[[str], str]) -> None:
        self.error: str | None = None
        self._simulation, self._lock, self._resolve = simulation, lock, resolve
        self._recorder: McapRecorder | None = None
        self._pending: list[Messages] | None = None     # while a log is being opened
        # What `attach` leaves to `open`.
        self._open_log: Callable[[], McapRecorder]
        self._streams: list[Stream] = []
        self._journal_topics: dict[str, int] = {}
        self._file_lock = threading.Lock()              # one opens or closes at a time

    # ------------------------------------------------------------------------ start and stop

    def start(self, values: Mapping[str, Any], publishers: Mapping[str, Publisher]) -> str:
        """Record from now on, as `attach` and `open` do; return what to tell the user."""
        if self._recorder is not None:
            return f'recording already to {self._recorder.path}'
        self.attach(values, publishers)
        return self.open()

    def attach(self, values: Mapping[str, Any], publishers: Mapping[str, Publisher]) -> None:
        """
        Keep in memory what is to be recorded from now on, until `open`.

        Parameters
        ----------
        values
            Checked parameters, as they are now.
        publishers
            By the topics of streams; their QoS is recorded too.

        """
        with self._lock:
            simulation = self._simulation
            streams = journal.recorded_streams(simulation.streams, values)
            topics = [(publishers[stream.topic].topic_name, stream.type_name,
                       _offered_qos(publishers[stream.topic].qos_profile)) for stream in streams]
            topics += [(self._resolve(name), type_name, {}) for name, type_name in journal.TOPICS]
            run = (simulation.values, simulation.epoch_ns, simulation.now_ns,
                   tuple(simulation.history), values)
            self._open_log = functools.partial(_open, topics, run)
            self._journal_topics = {name: len(streams) + i
                                    for i, (name, _) in enumerate(journal.TOPICS)}
            self._pending, self._streams = [], streams
            simulation.log_to(self._keep, streams)
            self.write_event('start', max(simulation.now_ns, 0), simulation.now_ns)

    def open(self) -> str:
        """
        Open the log for what `attach` keeps; return what to tell the user.

        Raises
        ------
        RecordingError
            If it cannot be opened, for whatever reason; then nothing is recorded.

        """
        with self._file_lock:
            try:
                recorder = self._open_log()
            except Exception as error:
                with self._lock:
                    self._pending = None
                    self._simulation.log_to(self._keep, ())
                raise RecordingError(str(error)) from error
            with self._lock:
                for messages in self._pending or ():
                    recorder.write_all(*messages)
                self._recorder, self._pending, self.error = recorder, None, None
                self._simulation.log_to(recorder.write_all, self._streams)
                self._streams = []
            return f'recording to {recorder.path}'

    def _keep(self, indices: Sequence[int], stamp_ns: int, messages: Sequence[bytes],
              size: int) -> None:
        if self._pending is not None:
            self._pending.append((indices, stamp_ns, messages, size))

    def stop(self, error: str | None = None) -> str | None:
        """
        Close the log; return what it holds, for the user, or None if there is no recording.

        Parameters
        ----------
        error
            Why the recording stops, if the user has not asked for it.

        """
        with self._file_lock:
            with self._lock:
                recorder, self._recorder = self._recorder, None
                if recorder is None:
                    return None
                self._simulation.log_to(self._keep, ())
                self.error = error
            summary = recorder.close()
        text = (f'{summary.path}: {sum(summary.counts.values())} messages, '
                f'{human_readable(summary.bytes)}')
        return f'{text}; stopped early: {summary.error}' if summary.error else text

    def check(self) -> str | None:
        """Close a recording that has failed; return the reason."""
        recorder = self._recorder
        if recorder is None or recorder.error is None:
            return None
        self.stop(recorder.error)
        return recorder.error

    # ------------------------------------------------------------------------------ messages

    def write_command(self, at_ns: int, l3: float, lz: float) -> None:
        """Record an applied command, both as a message and as an event."""
        self.write_event('command', at_ns, self._simulation.now_ns, l3=l3, lz=lz)
        self._write(journal.COMMANDS, at_ns, journal.command(l3, lz))

    def write_event(self, event: str, at_ns: int, sent_ns: int, **details: Any) -> None:
        """Record what happened to the motion; see `journal.event`."""
        self._write(journal.EVENTS, at_ns, journal.event(event, at_ns, sent_ns, **details))

    def _write(self, topic: str, at_ns: int, data: bytes) -> None:
        stamp_ns = self._simulation.epoch_ns + at_ns
        if self._recorder is not None:
            self._recorder.write(self._journal_topics[topic], stamp_ns, data)
        elif self._pending is not None:
            self._keep((self._journal_topics[topic],), stamp_ns, (data,), len(data))

    def has_room(self) -> bool:
        """Return whether more messages can be taken without losing any."""
        if self._recorder is not None:
            return self._recorder.room
        return self._pending is None or len(self._pending) < MOST_PENDING

    def wait_for_room(self) -> None:
        """Wait until there is room, at most 0.1 s."""
        if self._recorder is not None:
            self._recorder.wait_for_room(0.1)

    # -------------------------------------------------------------------------------- report

    @property
    def size(self) -> int | None:
        """Size of the log; None without one."""
        return None if self._recorder is None else self._recorder.counters.bytes

    def numbers(self) -> dict[str, object]:
        """Return what /diagnostics says about the recording."""
        recorder = self._recorder
        if recorder is None:
            return {'recorder': 'failed' if self.error else 'off'}
        counters = recorder.counters
        return {'recorder': recorder.state, 'recorded file': recorder.path,
                'recorded messages': counters.messages, 'recorded bytes': counters.bytes,
                'queued messages': counters.queued,
                'longest flush [s]': f'{counters.longest_flush:.3f}'}


def _open(topics: Sequence[tuple[str, str, dict[str, int]]], run: Run) -> McapRecorder:
    """Open the log that `record.uri` asks for, under the first name that is free in a folder."""
    from spinning_top_sim.recording.provenance import provenance  # noqa: PLC0415
    from spinning_top_sim.recording.rosbag2 import RecordedTopic  # noqa: PLC0415
    from spinning_top_sim.recording.writer import McapRecorder  # noqa: PLC0415

    values, metadata = run[-1], provenance(*run)
    recorded = [RecordedTopic(*topic) for topic in topics]
    path = Path(values['record.uri']).expanduser().absolute()
    names_itself = values['record.uri'] and not path.is_dir()
    for free in (path,) if names_itself else _dated(path):
        try:
            return McapRecorder.open(
                free, recorded, metadata, max_loss=values['record.max_loss'],
                compression=values['record.compression'],
                min_free_bytes=values['record.min_free_bytes'])
        except RecordingError as error:
            # Another node may take a name at any time: only opening shows whether it is free.
            if names_itself or not isinstance(error.__cause__, FileExistsError):
                raise
    raise AssertionError


def _dated(folder: Path) -> Iterator[Path]:
    """Yield names with the date, without end."""
    stem = time.strftime('spinning_top_%Y-%m-%d_%H-%M-%S')
    yield folder / f'{stem}.mcap'
    for number in itertools.count(2):
        yield folder / f'{stem}_{number}.mcap'


def _offered_qos(qos: QoSProfile) -> dict[str, int]:
    return {name: int(getattr(qos, name)) for name in ('history', 'depth', 'reliability',
                                                       'durability', 'liveliness')}
