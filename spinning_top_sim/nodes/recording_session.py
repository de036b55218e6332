# SPDX-License-Identifier: Apache-2.0
"""The recording of a running simulation: opens the log, feeds it, checks it, closes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spinning_top_sim.installation import needed
from spinning_top_sim.nodes.pacing import FairLock
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.live import Entry, LiveSimulation, Write
from spinning_top_sim.streams.stream import Stream

# Importing these takes long, so that is left to the opening of a log.
if TYPE_CHECKING:
    from spinning_top_sim.recording.recorder import Recorder

MOST_PENDING = 20_000       # stamps whose messages wait while a file is being opened
RECORDER, RECORDED_FILE = 'recorder', 'recorded file'        # keys in /diagnostics

Topic = tuple[str, str, dict[str, int]]     # full name, type, and offered QoS


class RecordingSession:
    """
    Records a simulation into one log at a time.

    While a log is being opened, its messages are kept in memory, so that nothing waits for the
    disk while it holds the lock of the simulation.

    topics : returns the topics of streams, and after them those of the journal
    """

    def __init__(self, simulation: LiveSimulation, lock: FairLock,
                 topics: Callable[[Sequence[Stream]], list[Topic]]) -> None:
        self.error: str | None = None       # why the last recording stopped early or did not start
        self._simulation, self._lock, self._topics = simulation, lock, topics
        self._recorder: Recorder | None = None
        self._pending: list[Sequence[Entry]] = []       # while a log is being opened
        self._write: Write | None = None        # writes into the recorder, or into `_pending`
        # Streams, their topics and the run, of a log that is to be opened
        self._begun: tuple[Sequence[Stream], Sequence[Topic], Mapping[str, Any]] = (), (), {}
        self._journal_index = 0                 # index of the journal's first topic in the log
        self._file_lock = threading.Lock()      # held while a log is opened or closed

    def start(self, values: Mapping[str, Any]) -> None:
        """Begin to record into memory, until `open`; does nothing while a log is open."""
        if self._recorder is not None:
            return
        with self._lock:
            simulation = self._simulation
            streams = journal.recorded_streams(simulation.streams, values)
            topics = self._topics(streams)
            run = {'values_at_start': simulation.values, 'epoch_ns': simulation.epoch_ns,
                   'begun_ns': simulation.now_ns, 'history': tuple(simulation.history),
                   'values_at_recording': values}
            self._journal_index = len(streams)
            self._feed(self._pending.append, streams)
            self.write_event('start')
            self._begun = streams, topics, run

    def open(self) -> str:
        """Open the log that `start` has begun; return a text, or raise RecordingError."""
        with self._file_lock:
            if self._recorder is not None:
                return f'recording already to {self._recorder.path}'
            streams, topics, run = self._begun
            try:
                recorder = _open_log(topics, run)
            except Exception as error:
                with self._lock:
                    self._feed(None)
                raise RecordingError(str(error)) from error
            with self._lock:
                for entries in self._pending:
                    _write_all(recorder, entries)
                self._recorder, self.error = recorder, None
                self._feed(partial(_write_all, recorder), streams)
        return f'recording to {recorder.path}'

    def _feed(self, write: Write | None, streams: Sequence[Stream] = ()) -> None:
        """Record these streams, commands and events with `write` from now on."""
        self._pending.clear()
        self._write = write
        self._simulation.log_to(write, streams)

    def stop(self, error: str | None = None) -> str | None:
        """Close the log and return a summary, or None if there is no log."""
        with self._file_lock:
            with self._lock:
                recorder, self._recorder = self._recorder, None
                if recorder is None:
                    return None
                self._feed(None)
                self.error = error
            summary = recorder.close()
            self.error = error or summary.error
        text = f'{summary.path}: {summary.messages} messages, {summary.bytes / 1e6:.1f} MB'
        return f'{text}; stopped early: {summary.error}' if summary.error else text

    def check(self) -> str | None:
        """Close a recording that has failed; return the reason."""
        recorder = self._recorder
        reason = recorder.error if recorder else None
        if reason:
            self.stop(reason)
        return reason

    def write_command(self, l3: float, lz: float) -> None:
        for topic, data in journal.command_entries(self._simulation.now_ns, l3, lz):
            self._write_now(topic, data)

    def write_event(self, event: str, sent_ns: int | None = None, **details: object) -> None:
        """Record what happens to the motion now; see `journal.event`."""
        now_ns = self._simulation.now_ns
        self._write_now(journal.EVENTS, journal.event(
            event, max(now_ns, 0), now_ns if sent_ns is None else sent_ns, **details))

    def _write_now(self, topic: str, data: bytes) -> None:
        if self._write is not None:
            index = self._journal_index + list(journal.TOPICS).index(topic)
            stamp_ns = self._simulation.epoch_ns + max(self._simulation.now_ns, 0)
            self._write([(index, stamp_ns, data)])

    def has_room(self) -> bool:
        """Return whether the recorder, or the queue before it opens, takes more messages."""
        if self._recorder is not None:
            return self._recorder.room
        return len(self._pending) < MOST_PENDING

    def wait_for_room(self) -> None:
        """Wait until the recorder takes more messages, a tenth of a second at most."""
        if self._recorder is not None:
            self._recorder.wait_for_room(0.1)

    @property
    def warning(self) -> str | None:
        """A text for the user while the disk is too slow for `record.max_loss`."""
        recorder = self._recorder
        return recorder.warning if recorder else None

    @property
    def path(self) -> Path | None:
        """The log that is open."""
        return self._recorder.path if self._recorder else None

    def numbers(self) -> dict[str, object]:
        """Return what /diagnostics say of the recorder, by their keys."""
        recorder = self._recorder
        if recorder is None:
            return {RECORDER: 'failed' if self.error else 'off'}
        counters = recorder.counters
        return {RECORDER: recorder.state, RECORDED_FILE: recorder.path,
                'recorded messages': counters.messages, 'recorded bytes': counters.bytes,
                'queued messages': counters.queued,
                'possible loss [s]': f'{recorder.possible_loss:.3f}'}


def _write_all(recorder: Recorder, entries: Sequence[Entry]) -> None:
    from spinning_top_sim.recording.recorder import single  # noqa: PLC0415

    recorder.write([single(*entry) for entry in entries])


def _open_log(topics: Sequence[Topic], run: Mapping[str, Any]) -> Recorder:
    """Open the log that `record.uri` names."""
    with needed('a recording'):
        from spinning_top_sim.recording.provenance import run_metadata  # noqa: PLC0415
        from spinning_top_sim.recording.recorder import Recorder  # noqa: PLC0415
        from spinning_top_sim.recording.rosbag2 import RecordedTopic  # noqa: PLC0415

    values, metadata = run['values_at_recording'], run_metadata(**run)
    recorded = [RecordedTopic(*topic) for topic in topics]
    recorder = Recorder(
        values['record.uri'], recorded, metadata, max_loss=values['record.max_loss'],
        compression=values['record.compression'], min_free_bytes=values['record.min_free_bytes'])
    while recorder.state == 'opening':
        time.sleep(0.01)
    if recorder.error:
        raise RecordingError(recorder.error)
    return recorder
