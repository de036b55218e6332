# SPDX-License-Identifier: Apache-2.0
"""Logs with any bytes in any place: nothing crashes, and what is whole is read and recovered."""

import functools
import os
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from helpers.examples import examples
from helpers.logs import (
    ALL_KEPT,
    FAILED,
    MESSAGES_PER_CHUNK,
    SOME_LOST,
    records_of,
    run,
    seen_by_mcap,
    seen_by_us,
    write_log,
)
from hypothesis import assume, given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.exam.log import LAYOUTS, examine_log
from spinning_top_sim.exam.report import Report
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import create_file
from spinning_top_sim.streams import messages

CHUNKS = 4


@pytest.fixture(autouse=True)
def no_sync(monkeypatch):
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


def check_reading_and_recovery(path, output):
    """Whatever a file holds; return what is read of it."""
    output.unlink(missing_ok=True)
    try:
        reader = LogReader(path)
    except LogError as refusal:
        assert str(path) in str(refusal) and run(path, '-o', output)[0] == FAILED
        return []
    with reader:
        read = [(message.topic, message.log_time, message.data) for message in reader.messages()]
        assert all(isinstance(line, str) for line in reader.damage.lines())
        assert isinstance(reader.metadata, dict) and isinstance(reader.topics, tuple)
    code, _, err = run(path, '-o', output)
    assert code in (ALL_KEPT, FAILED, SOME_LOST)
    assert (code == FAILED) == err.startswith('spinning-top recover: ') and err.count('\n') <= 1
    if code != FAILED:
        assert Counter(seen_by_us(output)) == Counter(read) == Counter(seen_by_mcap(output))
        with LogReader(output) as reader:
            assert reader.whole and reader.damage.lossless
    return read


@functools.cache
def of_ours():
    """Return bytes, messages, and the chunks of a log of ours as (begin, end)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'a.mcap')
        logged = write_log(path, chunks=CHUNKS)
        content = path.read_bytes()
    return content, logged, [(begin, end) for kind, begin, end in records_of(content)
                             if kind == Opcode.CHUNK]


@examples(60)
@given(st.data(), st.booleans(), st.binary(max_size=40))
def test_what_is_whole_stays_whatever_stands_beside_it(tmp_path, data, torn, inserted):
    """Any bytes are put in the place of any others, with a summary or without."""
    content, logged, chunks = of_ours()
    size = chunks[-1][1] if torn else len(content) - len(MCAP0_MAGIC)
    begin = data.draw(st.integers(chunks[0][0], size))
    end = min(size, begin + data.draw(st.sampled_from((0, 1, 8, len(inserted), 1000))))
    assume(inserted or begin < end)
    path = tmp_path / 'broken.mcap'
    path.write_bytes(content[:begin] + inserted + content[end:(size if torn else None)])
    read = check_reading_and_recovery(path, tmp_path / 'whole.mcap')
    touched = [begin < last and (first < end or first < begin) for first, last in chunks]
    kept = [message for number, message in enumerate(logged)
            if not touched[number // MESSAGES_PER_CHUNK]]
    # What is in touched chunks may be whole all the same: a message has no checksum of its own.
    assert Counter(kept) <= Counter(read)
    assert Counter(read) <= Counter(logged)


# ----------------------------------------------------------------------------- messages of others

TYPE = 'sensor_msgs/msg/Imu'
assert TYPE in LAYOUTS


@examples(20)
@given(st.lists(st.one_of(st.binary(max_size=400), st.tuples(
    st.integers(0, 2 ** 62), st.lists(st.floats(), min_size=10, max_size=10))), min_size=1,
    max_size=5), st.sampled_from(('ground_truth/imu', 'said')))
def test_messages_of_any_content_are_examined_or_refused(tmp_path, odd, topic):
    """100 right ones among them; of the truth, or of what is judged."""
    path = tmp_path / 'said.mcap'
    path.unlink(missing_ok=True)
    template = messages.imu('imu', *3 * (messages.EXACT,))
    topics = RecordedTopic('/ground_truth/imu', TYPE), RecordedTopic('/said', TYPE)
    file = create_file(path, topics, {}, compression='none')
    for number in range(120):
        stamp = 10 ** 18 + number * 10_000_000
        for index in (0, 1):
            file.append(index, stamp, template.encode_one(
                stamp, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    for one in odd:
        if isinstance(one, tuple):
            stamp, numbers = one
            one = template.encode_one(stamp % (2 ** 31 * 10 ** 9), numbers[:4],  # noqa: PLW2901
                                      numbers[4:7], numbers[7:])
        file.append(0 if topic.startswith('ground') else 1, 10 ** 18, one)
    file.write_chunk()
    file.finish()
    try:
        assert isinstance(examine_log(path, 'said'), Report)
    except (ValueError, LogError) as refusal:
        assert '\n' not in str(refusal)
