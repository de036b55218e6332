# SPDX-License-Identifier: Apache-2.0
"""
Recording while the simulation runs: bounded loss, bounded memory, and no waiting for a disk.

The simulation's thread only appends to a queue.  One other thread makes chunks, compresses and
writes them, at least every half `max_loss`, so that a SIGKILL takes no more.  A third brings them
to the disk meanwhile; `possible_loss` tells what a power loss would take.
"""

import atexit
import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mcap.records import Channel, Header, Metadata, Schema

from spinning_top_sim.installation import version
from spinning_top_sim.recording.chunks import CHUNK_BYTES
from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import RecordingError, why_not_written
from spinning_top_sim.recording.mcap_writer import McapWriter, sync_directory
from spinning_top_sim.recording.provenance import METADATA_NAME, OUR_LIBRARY
from spinning_top_sim.recording.rosbag2 import RecordedTopic, offered_qos_yaml

QUEUE_BYTES = 32_000_000            # of a full queue; a burst that began with room may go on

_ENTRY_BYTES = 128  # what a queued message costs besides its data, about

# A message: its topic, an index of the recorder's `topics`; log time [ns]; CDR.
Entry = tuple[int, int, bytes]


@dataclass(frozen=True)
class RecordingSummary:
    """What a recording has come to."""

    path: Path
    bytes: int              # size of the file
    counts: dict[str, int]  # messages in it by topic name
    queued: int             # messages accepted, not yet in the file
    lost: int               # handed over after the recording stopped, or when it failed
    error: str | None       # why the recording stopped early

    @property
    def messages(self) -> int:
        return sum(self.counts.values())


class McapRecorder:
    """
    A running recording into a new file, until `close`.

    Trouble with the disk never reaches the caller: the recording stops, `state` becomes 'failed'
    and `error` says why, naming the path.  What was written up to then stays readable.
    """

    def __init__(self, path: str | os.PathLike[str], topics: Sequence[RecordedTopic],
                 metadata: Mapping[str, str], *, max_loss: float = 0.5,
                 compression: str = 'zstd', min_free_bytes: int = 100_000_000) -> None:
        """
        Create the file and start recording; raises as `create_file`.

        max_loss : most wall time whose messages a SIGKILL or a power loss may take [s], > 0
        """
        self.path = Path(path)
        self._file = create_file(self.path, topics, metadata, compression=compression,
                                 min_free_bytes=min_free_bytes)
        self.state: Literal['recording', 'closed', 'failed'] = 'recording'
        self.error: str | None = None
        self._names = [topic.name for topic in topics]
        self._max_loss = max_loss
        self._min_free_bytes = min_free_bytes

        # Appending to a deque and taking from its other end need no lock between threads.
        self._queue: deque[tuple[Sequence[Entry], int]] = deque()     # entries, and their bytes
        self._bytes_in = self._bytes_out = 0    # of the queue, ever
        self._offered = 0              # messages handed over, ever
        self._accepting = True
        # (time, bytes): what had left the queue by that time is on the disk.
        self._on_disk = time.monotonic(), 0
        self._sync_error: Exception | None = None
        self._syncing: threading.Thread | None = None
        self._wake = threading.Event()
        self._taken = threading.Event()
        # A daemon, so that a forgotten recording cannot hold up the end of the interpreter; the
        # exit handler runs before daemons are stopped and closes the file properly.
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()
        atexit.register(self.close)

    @property
    def room(self) -> bool:
        """Whether the queue takes more, or the recording has stopped and takes nothing."""
        return self._bytes_in - self._bytes_out < QUEUE_BYTES

    @property
    def possible_loss(self) -> float:
        """Wall time whose messages a power loss would take now, but for one tick [s]."""
        since, bytes_on_disk = self._on_disk
        if self.state != 'recording' or self._bytes_in == bytes_on_disk:
            return 0.0
        return time.monotonic() - since

    @property
    def warning(self) -> str | None:
        """What to tell the user while the disk is too slow for `max_loss`."""
        loss = self.possible_loss
        return None if loss <= self._max_loss else (
            f'the disk of {self.path} is slow: a power loss would take the last {loss:.1f} s, '
            f'more than max_loss = {self._max_loss:g} s')

    @property
    def counters(self) -> RecordingSummary:
        running = self.state == 'recording'     # read first: nothing is written after it
        counts = dict(zip(self._names, self._file.message_counts.values(), strict=True))
        missing = self._offered - sum(counts.values())
        return RecordingSummary(
            path=self.path, bytes=self._file.size, counts=counts,
            queued=missing if running else 0, lost=0 if running else missing,
            error=self.error)

    def write_all(self, entries: Sequence[Entry]) -> None:
        """
        Hand over messages, from one thread at a time; they keep their order.

        Never waits for the disk, never raises for its sake.  After the recording stopped the
        messages are only counted, as lost.
        """
        self._offered += len(entries)
        if self._accepting:
            size = sum(_ENTRY_BYTES + len(data) for _, _, data in entries)
            self._queue.append((entries, size))
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

    def close(self, timeout: float = 10.0) -> RecordingSummary:
        """
        Bring everything to the disk, write the summary, and return what the file holds.

        May be called again.  Where the disk does not finish within `timeout` [s], the summary's
        `error` says so and the file goes on being closed in the background.
        """
        atexit.unregister(self.close)
        self._accepting = False
        self._wake.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            late = f'{self.path} could not be closed within {timeout:g} s'
            return replace(self.counters, error=self.error or late)
        return self.counters

    def _run(self) -> None:
        """Record until closed or something fails; in the recorder's own thread."""
        try:
            self._record()
            self.state = 'closed'
        except Exception as error:  # whatever it is, the simulation goes on without a log
            self._accepting = False
            self.error = f'recording to {self.path} stopped: {why_not_written(self.path, error)}'
            self._queue.clear()
            self._bytes_out = self._bytes_in
            self._taken.set()
            self.state = 'failed'
            # Cutting off the truncated chunk may have freed enough space for the summary.
            with contextlib.suppress(Exception):
                if self._syncing is not None:
                    self._syncing.join()
                self._file.finish()

    def _record(self) -> None:
        interval = self._max_loss / 2.0
        next_flush = time.monotonic() + interval
        while True:
            self._wake.clear()
            closing = not self._accepting  # read before the queue: once set, nothing more comes
            now = time.monotonic()
            self._write_queued()
            if closing or now >= next_flush:
                next_flush = now + interval
                self._file.flush()
                if closing and self._syncing is not None:
                    self._syncing.join()
                if self._sync_error is not None:
                    raise self._sync_error
                self._file.check_disk(self._min_free_bytes)
                if closing:
                    self._file.finish()
                    return
                self._begin_sync(now)
            self._wake.wait(max(0.0, next_flush - time.monotonic()))

    def _begin_sync(self, now: float) -> None:
        """Bring what is in the file to the disk, in a thread that may hang as the disk does."""
        if self._syncing is not None and self._syncing.is_alive():
            return
        written = now, self._bytes_out
        if self._bytes_out == self._on_disk[1]:
            self._on_disk = written
        else:
            self._syncing = threading.Thread(
                target=self._sync, args=(written,), name='recorder sync', daemon=True)
            self._syncing.start()

    def _sync(self, written: tuple[float, int]) -> None:
        try:
            self._file.sync()
        except Exception as error:
            self._sync_error = error
            self._wake.set()
        else:
            self._on_disk = written

    def _write_queued(self) -> None:
        batch: list[Entry] = []
        batch_bytes = 0
        for _ in range(len(self._queue)):
            entries, size = self._queue.popleft()
            if batch_bytes + size > CHUNK_BYTES:
                self._file.append_all(batch, batch_bytes)
                batch, batch_bytes = [], 0
            batch += entries
            batch_bytes += size
            self._bytes_out += size
        self._file.append_all(batch, batch_bytes)
        if self.room:
            self._taken.set()


def create_file(path: Path, topics: Sequence[RecordedTopic], metadata: Mapping[str, str], *,
                compression: str, min_free_bytes: int = 0) -> McapWriter:
    """
    Create a log, which must not exist, and bring its head to the disk.

    topics : all stand before the first chunk, so that a truncated file tells them in any case
    metadata : the `spinning_top_sim` record at the head of the file
    compression : 'zstd', 'lz4' or 'none'
    min_free_bytes : a recording stops if the disk has less left than this, >= 0

    Raises ValueError for a topic that is listed twice, RecordingError naming path or type.
    """
    names = [topic.name for topic in topics]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'topic {name!r} is listed twice: once is allowed')
    definitions = {     # text and type hash
        name: find_definition(name) for name in dict.fromkeys(topic.type_name for topic in topics)}
    try:
        header = Header(profile='ros2', library=OUR_LIBRARY + version())
        file = McapWriter(path, header=header, compression=compression)
        with file.discarded_on_failure():
            file.check_disk(min_free_bytes)
            file.write(Metadata(METADATA_NAME, dict(metadata)))
            for number, (name, (text, _)) in enumerate(definitions.items(), start=1):
                file.write(Schema(id=number, name=name, encoding='ros2msg', data=text.encode()))
            for number, topic in enumerate(topics, start=1):
                file.write(Channel(
                    id=number, topic=topic.name, message_encoding='cdr',
                    schema_id=1 + list(definitions).index(topic.type_name),
                    metadata={'offered_qos_profiles': offered_qos_yaml(topic),
                              'topic_type_hash': definitions[topic.type_name][1]}))
            file.sync()
            sync_directory(path.parent)
    except (OSError, ValueError) as error:
        raise RecordingError(f'cannot record to {path}: {why_not_written(path, error)}') from error
    return file
