# SPDX-License-Identifier: Apache-2.0
"""
Recording while the simulation runs: bounded loss, bounded memory, and no waiting for a disk.

The simulation's thread only appends to a queue.  One other thread builds chunks, compresses and
writes them, and brings them to the disk at least every half `max_loss`.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import RecordingError
from spinning_top_sim.recording.rosbag2 import RecordedTopic, offered_qos_yaml

if TYPE_CHECKING:
    from spinning_top_sim.recording.chunks import Messages
    from spinning_top_sim.recording.mcap_writer import McapWriter

COMPRESSIONS = ('zstd', 'lz4', 'none')
METADATA_NAME = 'spinning_top_sim'
OUR_LIBRARY = 'spinning_top_sim '      # what the header of our files begins with

_ENTRY_BYTES = 128  # what a queued message costs besides its data, about
_CLOSE_AT_EXIT_S = 10.0


@dataclass(frozen=True)
class RecorderCounters:
    """The progress of a recording."""

    messages: int           # in the file
    queued: int             # accepted, not yet in the file
    lost: int               # handed over after the recording stopped, or when it failed
    bytes: int              # size of the file
    flushes: int            # how often the file was brought to the disk
    longest_flush: float    # [s]


@dataclass(frozen=True)
class RecordingSummary:
    """The result of a recording."""

    path: Path
    bytes: int              # size of the file
    counts: dict[str, int]  # messages in it by topic name
    lost: int               # messages handed over that are not in it
    error: str | None       # why the recording stopped early
    indexed: bool           # whether the file has its summary; ordinary readers refuse it without


class McapRecorder:
    """
    A running recording.  `open` starts one, `close` ends it; also a context manager.

    Trouble with the disk never reaches the caller: the recording stops, `state` becomes 'failed'
    and `error` says why.  What was written up to then stays readable.
    """

    def __init__(
        self, path: Path, topics: Sequence[RecordedTopic], file: McapWriter, *,
        max_loss: float, min_free_bytes: int, queue_bytes: int,
    ) -> None:
        """For `open`, which checks the arguments."""
        self._path = path
        self._topics = topics
        self._file = file
        self._flush_interval = max_loss / 2.0
        self._min_free_bytes = min_free_bytes
        self._queue_bytes, self._half_full = queue_bytes, queue_bytes // 2

        # Appending to a deque and taking from its other end need no lock between threads.
        self._queue: deque[Messages] = deque()
        self._bytes_in = self._bytes_out = 0    # of the queue, ever
        self._offered = 0              # messages handed over, ever
        # Held for a few instructions, never during I/O; reentrant, because a signal handler may
        # close the recording while its thread is inside write().
        self._lock = threading.RLock()
        self._accepting = True
        self._state: Literal['recording', 'closed', 'failed'] = 'recording'
        self._error: str | None = None
        self._indexed = False
        self._next_flush = 0.0         # on the monotonic clock
        self._flushes = 0
        self._longest_flush = 0.0

        self._closing = False
        self._wake = threading.Event()
        self._taken = threading.Event()
        # A daemon, so that a forgotten recording cannot hold up the end of the interpreter; the
        # exit handler runs before daemons are stopped and closes the file properly.
        self._thread = threading.Thread(target=self._run, name='recorder', daemon=True)
        self._thread.start()
        atexit.register(self.close, _CLOSE_AT_EXIT_S)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        topics: Sequence[RecordedTopic],
        metadata: Mapping[str, str],
        *,
        max_loss: float = 0.5,
        compression: str = 'zstd',
        min_free_bytes: int = 100_000_000,
        queue_bytes: int = 32_000_000,
    ) -> McapRecorder:
        """
        Create a file and start recording into it.

        Parameters
        ----------
        path : path
            The file.  It must not exist.
        topics : sequence of RecordedTopic
            A message refers to them by index.
        metadata : mapping of str to str
            The `spinning_top_sim` record at the head of the file.
        max_loss : float
            Most wall time whose messages a SIGKILL or a power loss may take [s], > 0.
        compression : str
            One of COMPRESSIONS.
        min_free_bytes : int
            Recording stops if the disk has less left than this, >= 0.
        queue_bytes : int
            `room` is False from here on; about twice this is in memory at most, > 0.

        Raises
        ------
        ValueError
            If an argument is out of range.
        RecordingError
            If the file exists or cannot be made, or a definition is not installed.

        """
        path = Path(path)
        topics = tuple(topics)
        _check_arguments(
            topics, metadata, max_loss=max_loss, compression=compression,
            min_free_bytes=min_free_bytes, queue_bytes=queue_bytes)
        file = create_file(path, topics, metadata, compression=compression,
                           min_free_bytes=min_free_bytes)
        return cls(path, topics, file, max_loss=max_loss, min_free_bytes=min_free_bytes,
                   queue_bytes=queue_bytes)

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    @property
    def state(self) -> Literal['recording', 'closed', 'failed']:
        """'recording' until the file is finished or the recording stopped with an `error`."""
        return self._state

    @property
    def error(self) -> str | None:
        """Why the recording stopped before it was closed, naming the path; None if it did not."""
        return self._error

    @property
    def room(self) -> bool:
        """
        Whether the queue has room.

        Where it has none, hold the simulation's clock instead of dropping anything; a burst that
        began with room may be written to its end.  True also when the recording has stopped.
        """
        return self._bytes_in - self._bytes_out < self._queue_bytes

    @property
    def counters(self) -> RecorderCounters:
        """Where the recording stands now."""
        with self._lock:
            messages = sum(self._file.counts)
            missing = self._offered - messages
            running = self._state == 'recording'
            return RecorderCounters(
                messages=messages, queued=missing if running else 0,
                lost=0 if running else missing, bytes=self._file.size, flushes=self._flushes,
                longest_flush=self._longest_flush)

    def write(self, topic_index: int, log_time_ns: int, data: bytes) -> None:
        """Hand over one message; see `write_all`."""
        self.write_all((topic_index,), log_time_ns, (data,), len(data))

    def write_all(self, topic_indices: Sequence[int], log_time_ns: int,
                  messages: Sequence[bytes], size: int) -> None:
        """
        Hand over messages of one stamp, from one thread at a time; they keep their order.

        Never waits for the disk, never raises for its sake.  After the recording stopped the
        messages are only counted, as lost.

        Parameters
        ----------
        topic_indices : sequence of int
            The topic of each, an index of the `topics` of `open`.
        log_time_ns : int
            Log and publish time [ns], >= 0.
        messages : sequence of bytes
            CDR, each with its four bytes of header.
        size : int
            The size of all [bytes].

        """
        self._offered += len(messages)
        if self._accepting:
            self._queue.append((topic_indices, log_time_ns, messages, size))
            self._bytes_in += size + _ENTRY_BYTES * len(messages)
            if self._bytes_in - self._bytes_out >= self._half_full and not self._wake.is_set():
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

        May be called again, also after an interrupted call.  Where the disk does not finish
        within `timeout` [s], the summary's `error` says so and the file goes on being closed in
        the background.
        """
        with self._lock:
            self._accepting = False
            self._closing = True
        self._wake.set()
        self._thread.join(timeout)
        error = self._error
        if self._thread.is_alive():
            error = error or f'{self._path} could not be closed within {timeout:g} s'
        else:
            atexit.unregister(self.close)
        messages = dict(zip((topic.name for topic in self._topics), self._file.counts,
                            strict=True))
        return RecordingSummary(
            path=self._path, bytes=self._file.size, counts=messages,
            lost=self._offered - sum(messages.values()), error=error, indexed=self._indexed)

    def __enter__(self) -> McapRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _run(self) -> None:
        """Record until closed or something fails; in the recorder's own thread."""
        try:
            self._record()
        except Exception as error:  # whatever it is, the simulation goes on without a log
            self._fail(f'recording to {self._path} stopped: {_reason(error)}')

    def _record(self) -> None:
        """Write what is queued, flush in time, finish when asked to."""
        self._next_flush = time.monotonic() + self._flush_interval
        while self._state == 'recording':
            self._wake.clear()
            closing = self._closing  # read before the queue: once set, nothing more comes
            self._file.append_all(self._take())
            self._flush_if_due()
            if closing:
                self._finish()
                return
            self._wake.wait(max(0.0, self._next_flush - time.monotonic()))

    def _take(self) -> list[Messages]:
        """Return what is queued, and take it out of the queue."""
        take = self._queue.popleft
        taken = [take() for _ in range(len(self._queue))]
        self._bytes_out += sum(size + _ENTRY_BYTES * len(messages)
                               for _, _, messages, size in taken)
        self._taken.set()
        return taken

    def _flush_if_due(self) -> None:
        """Close the chunk and bring it to the disk when it is time; mind the space left."""
        start = time.monotonic()
        if start < self._next_flush:
            return
        self._next_flush = start + self._flush_interval
        self._file.write_chunk()
        if self._file.size == self._file.synced_size:
            return
        self._file.sync()
        self._flushes += 1
        self._longest_flush = max(self._longest_flush, time.monotonic() - start)
        free = self._file.free_bytes()
        if free < self._min_free_bytes:
            raise OSError(_too_little_space(free, self._min_free_bytes))

    def _finish(self) -> None:
        """End a recording that was asked to end."""
        self._file.write_chunk()
        self._file.finish()
        self._indexed = True
        self._state = 'closed'

    def _fail(self, error: str) -> None:
        """Stop accepting, say why, and leave behind the best file that the disk allows."""
        with self._lock:
            self._accepting = False
            self._error = error
            self._state = 'failed'
        self._take()
        # Cutting off the truncated chunk may have freed enough space for the summary.
        with contextlib.suppress(Exception):
            self._file.finish()
            self._indexed = True


def create_file(path: Path, topics: Sequence[RecordedTopic], metadata: Mapping[str, str], *,
                compression: str, min_free_bytes: int = 0) -> McapWriter:
    """
    Create a log and bring its head to the disk; the parameters are those of `McapRecorder.open`.

    All topics stand before the first chunk, so that a truncated file tells them in any case.

    Raises
    ------
    RecordingError
        Naming path or type and the reason.

    """
    definitions = {
        name: find_definition(name) for name in dict.fromkeys(topic.type_name for topic in topics)}
    try:
        from mcap.records import Channel, Metadata, Schema  # noqa: PLC0415

        from spinning_top_sim.recording.mcap_writer import (  # noqa: PLC0415
            McapWriter,
            sync_directory,
        )
    except ImportError as error:
        raise RecordingError(
            f'recording needs the Python package mcap with zstandard and lz4: {error}'
        ) from error
    try:
        disk = os.statvfs(path.parent)
        free = disk.f_bavail * disk.f_frsize
        if free < min_free_bytes:
            raise OSError(_too_little_space(free, min_free_bytes))
        file = McapWriter(path, profile='ros2', library=f'{OUR_LIBRARY}{_version()}',
                          compression=compression)
        with file.discarded_on_failure():
            file.write_metadata(Metadata(METADATA_NAME, dict(metadata)))
            schema_ids = {}
            for number, (name, definition) in enumerate(definitions.items(), start=1):
                schema_ids[name] = number
                file.write_schema(Schema(
                    id=number, name=name, encoding='ros2msg', data=definition.text.encode()))
            for number, topic in enumerate(topics, start=1):
                file.write_channel(Channel(
                    id=number, topic=topic.name, message_encoding='cdr',
                    schema_id=schema_ids[topic.type_name],
                    metadata={'offered_qos_profiles': offered_qos_yaml(topic),
                              'topic_type_hash': definitions[topic.type_name].type_hash}),
                    qos_profiles=(topic.qos,))
            file.sync()
            sync_directory(path.parent)
    except FileExistsError as error:
        raise RecordingError(
            f'cannot record to {path}: it exists, and a recording overwrites nothing'
        ) from error
    except FileNotFoundError as error:
        # A directory such as /proc is there, and takes no files.
        reason = 'no files can be made in' if path.parent.is_dir() else 'there is no directory'
        raise RecordingError(f'cannot record to {path}: {reason} {path.parent}') from error
    except (OSError, ValueError) as error:
        raise RecordingError(f'cannot record to {path}: {_reason(error)}') from error
    return file


def _check_arguments(
    topics: Sequence[RecordedTopic], metadata: Mapping[str, str], *, max_loss: float,
    compression: str, min_free_bytes: int, queue_bytes: int,
) -> None:
    """Raise ValueError for what no recording can be started with."""
    names = [topic.name for topic in topics]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'topic {name!r} is listed twice: once is allowed')
    for item in metadata.items():
        if not all(isinstance(text, str) for text in item):
            raise ValueError(f'metadata {item!r}: key and value must be str')
    if not 0.0 < max_loss <= threading.TIMEOUT_MAX:
        raise ValueError(f'max_loss = {max_loss!r} s: must be > 0 and finite')
    if compression not in COMPRESSIONS:
        raise ValueError(f'compression = {compression!r}: must be one of {COMPRESSIONS}')
    if min_free_bytes < 0:
        raise ValueError(f'min_free_bytes = {min_free_bytes!r}: must be >= 0')
    if queue_bytes <= 0:
        raise ValueError(f'queue_bytes = {queue_bytes!r}: must be > 0')


def _too_little_space(free: int, wanted: int) -> str:
    return f'{free} bytes are free on the disk, fewer than min_free_bytes = {wanted}'


def _reason(error: Exception) -> str:
    """Return what went wrong, without the path that OSError adds."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return f'{type(error).__name__}: {error}'


def _version() -> str:
    """Return the version of the installed package, or '0.0.0' where it was not installed."""
    import importlib.metadata  # noqa: PLC0415
    try:
        return importlib.metadata.version('spinning_top_sim')
    except importlib.metadata.PackageNotFoundError:
        return '0.0.0'
