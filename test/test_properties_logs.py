# SPDX-License-Identifier: Apache-2.0
"""Messages with any content: a log of them is examined, or refused in a line."""

import os

import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from spinning_top_sim.exam.log import LAYOUTS, examine_log
from spinning_top_sim.exam.report import Report
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.recorder import create_file
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.streams import messages


@pytest.fixture(autouse=True)
def no_sync(monkeypatch):
    monkeypatch.setattr(os, 'fsync', lambda descriptor: None)


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
