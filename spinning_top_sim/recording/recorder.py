# SPDX-License-Identifier: Apache-2.0
"""
Recording while the simulation runs: bounded loss, bounded memory, and no waiting for a disk.

The caller only appends to a queue.  The recorder's thread opens the file, writes chunks at least
every half `max_loss`, so that a SIGKILL takes no more, and closes the file.  Another thread, which
may hang as a disk does, brings them to the disk; `possible_loss` tells what a power loss takes.
"""

from __future__ import annotations

import atexit
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import MAX_BYTES, LogError, reason_of, text_of
from spinning_top_sim.recording.provenance import environment
from spinning_top_sim.recording.rosbag2 import RecordedTopic

if TYPE_CHECKING:       # the recorder's thread imports it, which takes 0.1 s
    from spinning_top_sim.recording.writer import LogRows, McapWriter

QUEUE_BYTES = 32_000_000    # of a full queue; a burst that began with room may go on
ENTRY_BYTES = 300           # what queued rows cost besides their data, about


class Recorder:
    """
    A recording into a new file from now on until `close`.  Raises nothing for the disk's sake.

    Messages wait in memory while the file is being opened.  After trouble with the disk `state` is
    'failed', `error` says why, naming the path, and what was written stays readable.

    uri : the new file; or a folder, in which a name with the date is taken, and which is made if
        it ends with '/'; '' is the working directory
    metadata : returns those of `provenance.run_metadata`, in the recorder's thread
    max_loss : most wall time whose messages a SIGKILL or a power loss may take [s], > 0
    min_free_bytes : the recording stops if the disk has less left than this
    threads, clock : make threads and events as `threading` does, and return steady time [s]
    """

    def __init__(self, uri: str, topics: Sequence[RecordedTopic],
                 metadata: Callable[[], Mapping[str, str]], *, max_loss: float = 0.5,
                 compression: str = 'zstd', min_free_bytes: int = 100_000_000,
                 threads: Any = threading, clock: Callable[[], float] = time.monotonic) -> None:
        self.state: Literal['opening', 'recording', 'closed', 'failed'] = 'opening'
        self.error: str | None = None
        self.path: Path | None = None       # known once the file is open
        self._uri, self._topics, self._metadata = uri, topics, metadata
        self._max_loss, self._compression = max_loss, compression
        self._min_free_bytes = min_free_bytes
        self._threads, self._clock = threads, clock
        self._file: McapWriter | None = None
        # Appending to a deque and taking from its other end need no lock between threads.
        self._queue: deque[tuple[Sequence[LogRows], int]] = deque()     # rows, and their bytes
        self._bytes_in = self._bytes_out = self._offered = 0    # of the queue; messages, ever
        self._accepting = True
        # (time, bytes): what had left the queue by that time is on the disk.
        self._on_disk = clock(), 0
        self._sync_error: Exception | None = None
        self._syncing: threading.Thread | None = None
        self._wake, self._taken = threads.Event(), threads.Event()
        # A daemon, so that a disk that hangs cannot hold up the end of the interpreter; the exit
        # handler runs before daemons are stopped and closes the file properly.
        self._thread = threads.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()            # or raise: then there is nothing to close
        atexit.register(self.close)

    @property
    def room(self) -> bool:
        """Whether the queue takes more, or the recording has stopped and takes nothing."""
        return not self._accepting or self._bytes_in - self._bytes_out < QUEUE_BYTES

    @property
    def possible_loss(self) -> float:
        """Wall time whose messages a power loss would take now, but for one tick [s]."""
        since, bytes_on_disk = self._on_disk
        if self.state in ('closed', 'failed') or self._bytes_in == bytes_on_disk:
            return 0.0
        return self._clock() - since

    @property
    def warning(self) -> str | None:
        """What to tell the user while the disk is too slow for `max_loss`."""
        loss = self.possible_loss
        return None if loss <= self._max_loss else (
            f'the disk of {self.path or self._uri} is slow: a power loss would take the last '
            f'{loss:.1f} s, more than max_loss = {self._max_loss:g} s')

    @property
    def written(self) -> tuple[int, int]:
        """Number of messages and of bytes in the file."""
        return (self._file.message_counts.total(), self._file.size) if self._file else (0, 0)

    @property
    def missing(self) -> int:
        """Number of messages that wait for the file, or are lost if the recording has stopped."""
        return self._offered - self.written[0]

    def write(self, rows: Sequence[LogRows]) -> None:
        """Hand over messages, whose arrays must not change; one thread at a time, no waits."""
        self._offered += sum(len(times_ns) for _, times_ns, _ in rows)
        if self._accepting:
            size = sum(ENTRY_BYTES + messages.nbytes for _, _, messages in rows)
            self._queue.append((rows, size))
            self._bytes_in += size
            if self._bytes_in - self._bytes_out >= QUEUE_BYTES // 2 and not self._wake.is_set():
                self._wake.set()

    def wait_for_room(self, timeout: float) -> bool:
        """Wait until there is room, at most `timeout` [s]; return whether there is."""
        self._taken.clear()
        if not self.room:
            self._wake.set()
            self._taken.wait(timeout)
        return self.room

    def end(self) -> None:
        """Have the file closed, without waiting for it."""
        self._accepting = False
        self._wake.set()

    def close(self, timeout: float = 10.0) -> None:
        """
        Bring everything to the disk, and write the summary; `error` says what went wrong.

        A disk that does not finish within `timeout` [s] goes on in the background.
        """
        self.end()
        self._thread.join(timeout)
        if self._thread.is_alive():
            self.error = self.error or (
                f'{self.path or self._uri} could not be closed within {timeout:g} s')

    # ----------------------------------------------------------------- in the recorder's thread

    def _run(self) -> None:
        try:
            self._file = self._open()
            self.state = 'recording'
            self._record(self._file)
            self.state, self.error = 'closed', None
        except Exception as error:  # whatever it is, the simulation goes on without a log
            self._accepting = False
            self.error = text_of(error) if self.path is None else (
                f'recording to {self.path} stopped: {reason_of(error)}')
            self.state = 'failed'
            self._taken.set()
            # Cutting off the truncated chunk may have freed enough space for the summary.
            with contextlib.suppress(Exception):
                if self._syncing is not None:
                    self._syncing.join()
                if self._file is not None:
                    self._file.finish()
        atexit.unregister(self.close)

    def _open(self) -> McapWriter:
        """Return the file that `uri` names."""
        with needed('a recording', 'mcap'):
            from spinning_top_sim.recording.writer import McapWriter  # noqa: PLC0415

        metadata = {**self._metadata(), **environment()}
        if sum(map(len, metadata.values())) > MAX_BYTES // 2:   # it has keys and lengths, too
            raise LogError('too many events before the recording: a log could not be read; '
                           '~/reset begins a run without any')
        path = Path(self._uri).expanduser().absolute()
        if self._uri.endswith('/'):
            path.mkdir(parents=True, exist_ok=True)
        if path.is_dir():       # microseconds, since several nodes may begin at once
            path /= f'{datetime.now():spinning_top_%Y-%m-%d_%H-%M-%S_%f}.mcap'
        file = McapWriter(path, self._topics, metadata, compression=self._compression,
                          min_free_bytes=self._min_free_bytes)
        self.path = path
        return file

    def _record(self, file: McapWriter) -> None:
        next_flush = self._clock() + self._max_loss / 2.0
        while True:
            self._wake.clear()
            closing = not self._accepting  # read before the queue: once set, nothing more comes
            now = self._clock()
            for _ in range(len(self._queue)):
                rows, size = self._queue.popleft()
                for one in rows:
                    file.add(*one)
                file.flush(if_full=True)
                self._bytes_out += size
            if self.room:
                self._taken.set()
            if closing or now >= next_flush:
                next_flush = now + self._max_loss / 2.0
                file.flush()
                if closing and self._syncing is not None:
                    self._syncing.join()
                if self._sync_error is not None:
                    raise self._sync_error
                file.check_disk(self._min_free_bytes)
                if closing:
                    file.finish()
                    return
                if self._bytes_out == self._on_disk[1]:     # nothing new: no need to sync
                    self._on_disk = now, self._bytes_out
                elif self._syncing is None or not self._syncing.is_alive():
                    self._syncing = self._threads.Thread(
                        target=self._sync, args=(file, (now, self._bytes_out)),
                        name='recorder sync', daemon=True)
                    self._syncing.start()
            self._wake.wait(max(0.0, next_flush - self._clock()))

    def _sync(self, file: McapWriter, written: tuple[float, int]) -> None:
        try:
            file.sync()
        except Exception as error:
            self._sync_error = error
            self._wake.set()
        else:
            self._on_disk = written


def single(topic_index: int, log_time_ns: int, data: bytes) -> LogRows:
    """Return one message as rows."""
    return topic_index, np.array([log_time_ns]), np.frombuffer(data, np.uint8)[np.newaxis]
