# SPDX-License-Identifier: Apache-2.0
"""Writing what is whole of a damaged log into a new, indexed one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import AttachmentIndex, Channel, Chunk, Metadata, Schema

from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import NothingToSaveError, OutputError
from spinning_top_sim.recording.mcap_file import IndexedFile, sync_directory
from spinning_top_sim.recording.reader import LogReader, qos_profiles
from spinning_top_sim.recording.rosbag2 import BagTopic, bag_metadata_yaml
from spinning_top_sim.recording.walk import BAG_METADATA, Piece, Walk

_COMPRESSION = 'zstd'  # of messages that were in no chunk


@dataclass(frozen=True)
class Recovered:
    """
    What a recovery wrote.

    path: of the new file;  bytes: its size;  messages, chunks: in it
    damage: of the old file
    """

    path: Path
    bytes: int
    messages: int
    chunks: int
    damage: Damage


def recover(
    reader: LogReader, output: str | os.PathLike[str],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Recovered:
    """
    Write everything that is whole in a log into a new file.

    Chunks are copied as they are, messages outside of chunks are put into some, and message
    indexes, statistics, summary and the `rosbag2` record are made anew.

    output: it appears when it is complete and on the disk, never before
    progress: told how many bytes of how many are through

    Raises OutputError when the output exists or cannot be written, NothingToSaveError when a file
    that was not closed holds no whole message, and LogAccessError.
    """
    output = Path(output)
    if os.path.lexists(output):
        raise OutputError(_exists(output))
    draft = output.with_name(f'.recover-{os.getpid()}.tmp')
    try:
        return _recover(reader, output, draft, progress)
    except FileNotFoundError as error:
        raise OutputError(
            f'cannot write {output}: there is no directory {output.parent}') from error
    except OSError as error:
        raise OutputError(f'cannot write {output}: {error.strerror or error}') from error


def _recover(
    reader: LogReader, output: Path, draft: Path, progress: Callable[[int, int], None],
) -> Recovered:
    walk = reader.walk()
    file = IndexedFile(
        draft, profile=reader.profile, library=reader.library,
        compression=_COMPRESSION)
    with file.discarded_on_failure():
        copy = _Copy(reader, walk, file)
        for piece in walk:
            copy.put(piece)
            progress(piece.offset, reader.size)
        copy.finish()
        messages = sum(file.message_counts.values())
        damage = walk.damage()
        if not messages and not reader.whole:
            raise NothingToSaveError(
                f'nothing to save in {reader.path}: there is no whole message in it')
        bag = _bag_metadata(walk, file, output, copy.former_bag)
        is_bag = reader.profile == 'ros2' or copy.former_bag
        file.close(bag if is_bag else None)
        _publish(draft, output)
    progress(reader.size, reader.size)
    return Recovered(output, file.size, messages, file.chunk_count, damage)


class _Copy:
    """Puts the pieces of a log into a new file."""

    def __init__(self, reader: LogReader, walk: Walk, file: IndexedFile) -> None:
        self._reader = reader
        self._walk = walk
        self._file = file
        self._declared: set[tuple[type, int]] = set()
        self.former_bag = ''  # what the `rosbag2` record of the log said

    def put(self, piece: Piece) -> None:
        """Write a record, as it is or as it should be."""
        record = piece.record
        contents = piece.contents
        if contents is not None:
            for channel_id in {message.channel_id for message in contents.messages}:
                self._declare(self._walk.channels[channel_id])
            if isinstance(record, Chunk) and not piece.foreign:
                self._file.write_chunk()  # what came before stays before
                self._file.put_chunk(record, contents.entries)
                return
            for message in contents.messages:
                full = self._file.add_message(
                    message.channel_id, message.sequence, message.log_time,
                    message.publish_time, contents.plain[message.start:message.end])
                if full:
                    self._file.write_chunk()
        elif isinstance(record, Schema | Channel):
            self._declare(record)
        elif isinstance(record, Metadata):
            if record.name == BAG_METADATA:
                self.former_bag = record.metadata.get('serialized_metadata', '')
            else:
                self._file.put_metadata(record)
        elif isinstance(record, AttachmentIndex):
            self._file.put_attachment(
                record, self._reader.blocks(piece.offset, piece.length))

    def finish(self) -> None:
        """Write what is left: messages, and channels that only the summary told."""
        self._file.write_chunk()
        for schema in self._walk.schemas.values():
            self._declare(schema)
        for channel in self._walk.channels.values():
            self._declare(channel)

    def _declare(self, record: Schema | Channel) -> None:
        """Write a schema or channel outside of chunks, once, a schema before its channels."""
        key = type(record), record.id
        if key in self._declared:
            return
        self._declared.add(key)
        if isinstance(record, Schema):
            self._file.put_schema(record)
            return
        schema = self._walk.schemas.get(record.schema_id)
        if schema is not None:
            self._declare(schema)
        self._file.put_channel(record)


def _bag_metadata(walk: Walk, file: IndexedFile, output: Path, former: str) -> Metadata:
    """Return the `rosbag2` record of the new file."""
    topics = []
    for number, channel in walk.channels.items():
        schema = walk.schemas.get(channel.schema_id)
        topics.append(BagTopic(
            channel.topic, schema.name if schema else '',
            channel.metadata.get('topic_type_hash', ''), qos_profiles(channel),
            file.message_counts[number], channel.message_encoding))
    return Metadata(name=BAG_METADATA, metadata={'serialized_metadata': bag_metadata_yaml(
        topics, file_name=output.name, start_ns=file.start_ns, end_ns=file.end_ns,
        former=former)})


def _publish(draft: Path, output: Path) -> None:
    """Give a file its name without taking that of another."""
    try:
        os.link(draft, output)
    except FileExistsError:
        raise OutputError(_exists(output)) from None
    except OSError:
        # A file system without links: between the look and the renaming nothing protects.
        if os.path.lexists(output):
            raise OutputError(_exists(output)) from None
        os.rename(draft, output)
    else:
        with contextlib.suppress(OSError):
            draft.unlink()
    sync_directory(output.parent)


def _exists(output: Path) -> str:
    return f'{output} exists, and nothing is overwritten'
