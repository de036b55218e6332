# SPDX-License-Identifier: Apache-2.0
"""Writes what is whole of a damaged log into a new, indexed one."""

import contextlib
import itertools
import os
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Chunk, Header, Metadata, Schema

from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import LogError, no_place_in
from spinning_top_sim.recording.mcap_writer import McapWriter, record_bytes, sync_directory
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.records import ChunkContents
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.scanner import ScannedRecord, Scanner


@dataclass(frozen=True)
class Recovered:
    """What a recovery wrote."""

    path: Path
    bytes: int
    messages: int
    chunks: int
    damage: Damage  # of the old file


def recover(reader: LogReader, output: str | os.PathLike[str],
            progress: Callable[[int, int], None] = lambda done, total: None) -> Recovered:
    """
    Write everything that is whole in a log into a new file.

    output : appears when it is complete and on the disk, never before
    progress : told how many bytes of how many are done

    Right chunks and records of unknown kinds are copied as they are, other messages are put into
    new chunks; message indexes, statistics, summary and the `rosbag2` record are made anew.
    Raises LogError, also if a file that was not closed holds no whole message.
    """
    output = Path(output)
    draft = output.parent / f'.recover-{secrets.token_hex(8)}.tmp'
    try:
        if os.path.lexists(output):
            raise FileExistsError
        with contextlib.suppress(_FoundLateError):
            return _recover(reader, output, draft, progress)
        return _recover(reader, output, draft, progress)
    except FileExistsError:
        raise LogError(f'{output} exists, and nothing is overwritten') from None
    except FileNotFoundError as error:
        raise LogError(f'cannot write {output}: {no_place_in(output.parent)}') from error
    except OSError as error:
        raise LogError(f'cannot write {output}: {error.strerror or error}') from error


class _FoundLateError(Exception):
    """Channels were found behind their messages; another scan knows them from the beginning."""


def _recover(reader: LogReader, output: Path, draft: Path,
             progress: Callable[[int, int], None]) -> Recovered:
    scanner = reader.scan()
    records = iter(scanner)
    first = next(records, None)
    header = (first.raw if first is not None and isinstance(first.record, Header)
              else record_bytes(Header(reader.profile, reader.library)))
    writer = McapWriter(draft, header=header, compression='zstd')
    with writer.discarded_on_failure():
        copy = _Copy(scanner, writer)
        for scanned in filter(None, itertools.chain([first], records)):
            copy.put(scanned)
            progress(scanned.offset, reader.size)
        if scanner.found_late:
            raise _FoundLateError
        writer.write_chunk()
        # What only the summary tells
        for schema in scanner.schemas.values():
            copy.declare(schema)
        for channel in scanner.channels.values():
            copy.declare(channel)
        messages = sum(writer.message_counts.values())
        if not messages and not reader.whole:
            raise LogError(f'nothing to save in {reader.path}: there is no whole message in it')
        os.chmod(draft, reader.source.mode)
        writer.finish(bag=reader.profile == 'ros2' or bool(copy.former_bag),
                      file_name=output.name, former_bag=copy.former_bag)
        _publish(draft, output)
    progress(reader.size, reader.size)
    return Recovered(output, writer.size, messages, writer.chunk_count, scanner.damage())


class _Copy:
    """Writes scanned records into a new file, as they are or as they should be."""

    def __init__(self, scanner: Scanner, writer: McapWriter) -> None:
        self._scanner = scanner
        self._writer = writer
        self._declared: set[tuple[type, int]] = set()
        self.former_bag = ''  # the `rosbag2` record of the log

    def put(self, scanned: ScannedRecord) -> None:
        record = scanned.record
        if scanned.contents is not None:
            self._put_messages(scanned, scanned.contents)
        elif isinstance(record, Schema | Channel):
            self.declare(record, scanned.raw)
        elif isinstance(record, Metadata) and record.name == BAG_METADATA:
            self.former_bag = record.metadata.get('serialized_metadata', '')
        elif isinstance(record, Metadata):
            self._writer.write(record, scanned.raw)
        elif isinstance(record, AttachmentIndex) or scanned.opcode > Opcode.DATA_END:
            self._writer.copy_record(
                self._scanner.source.blocks(scanned.offset, scanned.end), record)

    def _put_messages(self, scanned: ScannedRecord, contents: ChunkContents) -> None:
        for channel_id in contents.entries:
            self.declare(self._scanner.channels[channel_id])
        if isinstance(scanned.record, Chunk) and contents.right:
            self._writer.write_chunk()  # what came before stays before
            self._writer.copy_chunk(scanned.record, contents.entries, scanned.raw)
            return
        for message in contents.messages():
            self._writer.add_message(message.channel_id, message.sequence, message.log_time,
                                     message.publish_time, message.data)

    def declare(self, record: Schema | Channel, raw: bytes = b'') -> None:
        """Write a schema or channel outside of chunks, once, a schema before its channels."""
        key = type(record), record.id
        if key in self._declared:
            return
        if isinstance(record, Channel) and record.schema_id:
            if record.schema_id not in self._scanner.schemas:
                return      # no reader takes a channel without its schema
            self.declare(self._scanner.schemas[record.schema_id])
        self._writer.write(record, raw)
        self._declared.add(key)


def _publish(draft: Path, output: Path) -> None:
    """Give a file its name without taking that of another (FileExistsError)."""
    try:
        os.link(draft, output)
    except OSError:
        # It exists, or a file system without links: then nothing protects until the renaming.
        if os.path.lexists(output):
            raise FileExistsError from None
        os.rename(draft, output)
    with contextlib.suppress(OSError):
        draft.unlink()
    sync_directory(output.parent)
