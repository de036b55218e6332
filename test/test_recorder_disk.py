# SPDX-License-Identifier: Apache-2.0
"""
Names of recordings, and how they end.

What a slow, full or failing disk does: test_world.py and test_failing_calls.py.
"""

import os
import re
import subprocess
import sys
import textwrap
import time

import pytest
from helpers import recordings
from helpers.recordings import METADATA, TOPICS, opened, write
from helpers.reference import ROOT
from rosbags.rosbag2 import Reader

from spinning_top_sim.recording.errors import MAX_BYTES
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import Recorder


def is_indexed(path):
    """Return whether a file has its summary; ordinary readers refuse it without."""
    with LogReader(path) as reader:
        return reader.whole


def test_too_little_space_leaves_no_file(tmp_path):
    recorder = opened(Recorder(
        f'{tmp_path}/run.mcap', TOPICS, METADATA.copy, min_free_bytes=10 ** 30))
    write(recorder, 0, 1, b'')
    assert recorder.state == 'failed' and recorder.path is None
    assert re.fullmatch(rf'cannot write {tmp_path}/run\.mcap: \d+ bytes are free .* 10{{30}}',
                        recorder.error)
    summary = recorder.close()
    assert (summary.path, summary.lost, summary.messages) == (None, 1, 0)
    assert summary.error == recorder.error and not list(tmp_path.iterdir())


def test_a_file_has_its_name_or_a_date_and_none_is_overwritten(tmp_path, monkeypatch):
    """In a folder, which a name with a slash makes, the first free name is taken."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'old').mkdir()
    monkeypatch.setattr(time, 'strftime', lambda _: 'spinning_top_now')
    for uri, path in (('run.mcap', 'run.mcap'), ('new/er/', 'new/er/spinning_top_now.mcap'),
                      ('old', 'old/spinning_top_now.mcap'), ('', 'spinning_top_now.mcap'),
                      ('', 'spinning_top_now_2.mcap'), ('', 'spinning_top_now_3.mcap')):
        summary = Recorder(uri, TOPICS, METADATA.copy, min_free_bytes=0).close()
        assert summary.path == tmp_path / path and is_indexed(summary.path)
    content = (tmp_path / 'run.mcap').read_bytes()
    for uri, reason in (('run.mcap', 'it exists, and nothing is overwritten'),
                        ('none/a.mcap', f'there is no directory {tmp_path}/none')):
        recorder = opened(Recorder(uri, TOPICS, METADATA.copy, min_free_bytes=0))
        assert recorder.error == f'cannot write {tmp_path}/{uri}: {reason}'
    assert 'run.mcap' in opened(Recorder('run.mcap/', TOPICS, METADATA.copy)).error
    recorder = opened(Recorder('twice.mcap', [TOPICS[0], TOPICS[0]], dict))
    assert recorder.error == "topic '/top/pose' is listed twice: once is allowed"
    recorder = opened(Recorder('long.mcap', TOPICS, lambda: {'history': MAX_BYTES * ' '}))
    assert 'too many events' in recorder.error and not (tmp_path / 'long.mcap').exists()
    assert (tmp_path / 'run.mcap').read_bytes() == content


def test_what_is_not_installed_is_named_in_a_line(tmp_path):
    """The simulation needs neither mcap nor rosbags until it records."""
    code = ("import sys; sys.modules.update(dict.fromkeys(('mcap', 'rosbags')))\n"
            'from spinning_top_sim.recording.recorder import Recorder\n'
            "recorder = Recorder(sys.argv[1], [], dict)\n"
            'print(recorder.close().error)')
    done = subprocess.run([sys.executable, '-c', code, tmp_path / 'run.mcap'], text=True,
                          env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True,
                          timeout=60, check=True)
    assert re.match(r'a recording needs mcap, which is not installed: \S+ -m pip install .*mcap',
                    done.stdout) and done.stdout.count('\n') == 1


@pytest.mark.parametrize('ending', ['pass', 'os.kill(os.getpid(), signal.SIGINT)'])
def test_an_interpreter_that_ends_without_closing_leaves_a_whole_file(tmp_path, ending):
    code = f"""
        import os, signal, sys
        from spinning_top_sim.recording.rosbag2 import RecordedTopic
        from spinning_top_sim.recording.recorder import Recorder, single
        topics = [RecordedTopic('/a', {recordings.ARRAY!r})]
        recorder = Recorder(sys.argv[1], topics, dict, min_free_bytes=0, max_loss=60.0)
        for number in range(100):
            recorder.write([single(0, number, bytes(8))])
        {ending}
        """
    subprocess.run([sys.executable, '-c', textwrap.dedent(code), tmp_path / 'run.mcap'],
                   env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=60,
                   check=False)
    with Reader(tmp_path / 'run.mcap') as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == list(range(100))


def test_a_message_that_cannot_be_packed_is_no_exception_for_the_simulation(tmp_path):
    recorder = Recorder(f'{tmp_path}/b.mcap', TOPICS, METADATA.copy, min_free_bytes=0)
    write(recorder, len(TOPICS), 0, b'')
    summary = recorder.close()
    assert recorder.state == 'failed' and 'stopped: IndexError:' in (summary.error or '')
    assert (is_indexed(summary.path), summary.lost) == (True, 1)
