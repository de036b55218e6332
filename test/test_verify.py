# SPDX-License-Identifier: Apache-2.0
"""`inspect --verify`: logs are computed again, and each difference is found and named."""

import json
import math
import re

import numpy as np
import pytest
from helpers.inspected import as_json, log_of, rewritten, told
from helpers.logs import flipped
from helpers.reference import ROOT

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.events import Event
from spinning_top_sim.tools import recorded_run


@pytest.fixture(scope='module')
def columns(tmp_path_factory):
    """The exact solution in columns, with a command between two stretches; several chunks."""
    return log_of(tmp_path_factory.mktemp('log') / 'columns.mcap', '--duration', 11, '--command',
                  '3.1:1.7:1.4', '-p', 'solver.method:=exact', '-p', 'markers.enabled:=true',
                  '-p', 'imu.accelerometer_random_walk:=0.01')


def verified(capsys, path):
    code, content = as_json(capsys, path, '--verify')
    assert code == (0 if content['verify']['identical'] else 1)
    return content['verify']


def test_a_log_whose_library_is_missing_is_read_and_only_not_computed_again(
        columns, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(parameters, 'find_spec', lambda name: None)
    exported = tmp_path / 'imu.csv'
    code, out, _ = told(capsys, columns, '--verify', '--export', f'euroc_imu:{exported}')
    assert code == 1 and exported.exists()
    assert 'cannot be computed again: ValueError: solver.method = exact: needs gmpy2' in out


@pytest.mark.parametrize('name', ['stepped', 'columns'])
def test_offline_logs_verify_and_a_changed_bit_is_found_wherever_it_is(
        name, tmp_path, capsys, monkeypatch, request):
    path = request.getfixturevalue(name)
    verdict = verified(capsys, path)
    assert verdict['identical'] and verdict['warnings'] == []
    counts, sizes = {}, {}
    with LogReader(path) as reader:
        for message in reader.messages():
            counts[message.topic] = counts.get(message.topic, 0) + 1
            sizes[message.topic] = len(message.data)
    counts.pop(next(name for name in counts if name.endswith('/events')))
    assert verdict['compared'] == counts
    rng = np.random.default_rng(5)
    places = {topic: (int(rng.integers(4, sizes[topic])), int(rng.integers(8)))
              for topic in counts}
    here = provenance.environment()
    monkeypatch.setattr(provenance, 'environment', lambda: {**here, 'platform': 'abacus'})
    verdict = verified(capsys, rewritten(
        path, tmp_path / 'changed.mcap', lambda topic, number, data: (
            flipped(data, *places[topic])
            if topic in places and number == min(1, counts[topic] - 1) else data)))
    assert verdict['warnings'] == [f'platform was {here["platform"]}, is abacus']
    assert verdict['different'] == len(counts)
    assert not (verdict['missing'] or verdict['unexpected'])
    topic, byte = re.match(r'(\S+) at \S+ s: byte (\d+),', verdict['first']).groups()
    assert int(byte) == places[topic][0]


@pytest.mark.parametrize(('change', 'count', 'says'), [
    (lambda data: None, 'missing', 'not in the log'),
    (lambda data: [data, data], 'unexpected', 'in the log, not computed'),
    (lambda data: data[:-8], 'different', r'\d+ bytes in the log, \d+ computed'),
    (lambda data: flipped(data, len(data) - 8), 'different',
     r'byte \d+, pose\.orientation\[3\]: in the log (0\.\d+), computed (0\.\d+)')])
def test_each_difference_is_counted_and_the_first_is_told_with_field_stamp_and_values(
        short, tmp_path, capsys, change, count, says):
    verdict = verified(capsys, rewritten(short, tmp_path / 'run.mcap', lambda topic, at, data: (
        change(data) if topic == '/pose' and at in (7, 20) else data)))
    assert {name: verdict[name] for name in ('missing', 'unexpected', 'different')} == {
        'missing': 0, 'unexpected': 0, 'different': 0, count: 2}
    said = re.fullmatch(f'/pose at 1.070000000 s: {says}', verdict['first'])
    assert said and (not said.groups() or 0.0 < abs(float(said[1]) - float(said[2])) < 3e-16)


def test_the_journal_is_obeyed(short, tmp_path, capsys):
    """A digit of a commanded momentum makes another motion; a rate may change before t = 0."""
    event = Event('parameters', 0, -1, {'pose.rate': 100.0})
    with LogReader(short) as reader:
        values = json.loads(reader.metadata['spinning_top_sim']['parameters'])
    before = {'history': f'[{event.text}]', 'parameters_now': json.dumps({**values, 'seed': 7}),
              'parameters': json.dumps({**values, 'pose.rate': 50.0})}
    for name, change, metadata in (('same', lambda topic, number, data: data, before),
                                   ('begun', lambda topic, number, data: (     # then killed
                                       None if '/events' not in topic or number else data), {})):
        assert verified(capsys, rewritten(short, tmp_path / name, change, metadata))['identical']
    # The seed waits for a reset.
    assert as_json(capsys, tmp_path / 'same')[1]['run']['values_in_effect'] == values
    verdict = verified(capsys, rewritten(short, tmp_path / 'run', lambda topic, number, data: (
        data.replace(b'"l3": 1.7', b'"l3": 1.8') if topic.endswith('/events') else data)))
    assert not verdict['identical'] and verdict['different'] > 100
    spaced = rewritten(short, tmp_path / 'spaced', lambda topic, number, data: (
        data.replace(b'"l3": 1.7', b'"l3":1.70') if topic.endswith('/events') else data))
    assert 'are not as it was written' in told(capsys, spaced, '--verify')[2]


def test_a_log_of_1_is_read_and_verified_by_1(capsys):
    """Its history has lists of numbers: a command, a rate, a velocity of the pivot, a state."""
    path = ROOT / 'test/data/log_of_1.mcap'
    code, content = as_json(capsys, path)
    assert code == 0 and content['whole'] and not content['notes']
    with LogReader(path) as reader:
        run = recorded_run.read_run_description(reader)
    assert [(event.kind, event.t_ns) for event in run.history] == [
        ('command', 0), ('parameters', 30_000_000), ('drive', 50_000_000), ('state', 80_000_000)]
    assert [motion['cause'] for motion in content['motions']] == ['start', 'command', 'reset']
    # The motion is the same, but for its last bits.
    assert 0.0 < content['motions'][-1]['orientation_error'] < 1e-11
    assert max(drift for motion in content['motions']
               for drift in motion['drifts'].values()) < 1e-14
    code, _, err = told(capsys, path, '--verify')
    assert code == 1 and err.endswith(
        'it was recorded by spinning_top_sim 1.0.0, which draws other noise and computes other '
        'last bits: verify it with that version\n')


def test_what_a_sensor_delays_or_drops_is_not_missing_and_a_message_that_is_lost_is(
        tmp_path, capsys):
    """A late receiver on a moving pivot, with an outage longer than a block; an IMU with drops."""
    pytest.importorskip('pymap3d')
    values = {'gnss.enabled': 'true', 'gnss.latency': 0.12, 'gnss.outages': '[2.8, 5.0]',
              'pivot.waypoints': '[0.0, 0.0, 0.0, 4.0, 2.0, 5.0]', 'imu.drop_rate': 0.05}
    receiver = log_of(tmp_path / 'gnss.mcap', '--duration', 5, *(
        part for name, value in values.items() for part in ('-p', f'{name}:={value}')))
    verdict = verified(capsys, receiver)
    assert verdict['identical'] and verdict['compared']['/imu/data_raw'] < 990
    assert verdict['compared']['/gnss/velocity'] == 49 - 21
    lossy = rewritten(receiver, tmp_path / 'lossy.mcap', lambda topic, number, data: (
        None if number == 10 else data))
    assert verified(capsys, lossy)['missing'] == sum(
        count > 10 for count in verdict['compared'].values())


@pytest.mark.parametrize('odd', [
    {'parameters': '[' * 100_000}, {'parameters': '{"top.lambda1": 1e-320}'},
    {'history': '[[5, 1.0, 1.0], [4, 1.0, 1.0]]'}, {'history': '[[0, 1, NaN]]'},
    {'epoch_ns': 'NaN'}, {'event': 'command', 'l3': math.nan, 'lz': 1.0},
    {'event': 'command', 'sent_ns': 2 ** 63, 'l3': 1.0, 'lz': 1.0},
    {'event': []}, {'event': 'state', 'l3': 1.0, 'lz': 1.0},
    {'event': 'reset', 'parameters': {}, 'epoch_ns': 10 ** 18}])
def test_odd_metadata_and_odd_entries_of_the_journal_end_in_words(short, tmp_path, capsys, odd):
    data = messages.string(json.dumps({'t_ns': 0, 'sent_ns': 300_000_000, **odd}))
    path = rewritten(short, tmp_path / 'odd.mcap', lambda topic, number, old: (
        [old, data] if 'event' in odd and topic.endswith('/events') and number == 1 else old),
        metadata={} if 'event' in odd else odd)
    code, out, err = told(capsys, path, '--verify')
    assert code == 1 and '\n' not in err[:-1]
    assert 'cannot be used' in err or ('cannot be followed' in out and '/pose' in out)


def test_a_run_that_no_log_of_its_size_holds_is_not_computed(
        short, columns, tmp_path, capsys, monkeypatch):
    """A stamp of the year 2096, or a late begin: neither 10^12 samples nor 10^12 steps."""
    monkeypatch.setattr(recorded_run, 'WORK_A_BYTE', 0)         # they would take a minute
    monkeypatch.setattr(recorded_run, 'LEAST_WORK', 5_000)
    path = rewritten(columns, tmp_path / 'late.mcap', stamp=lambda topic, number, stamp_ns: (
        4 * 10 ** 18 if (topic, number) == ('/pose', 50) else stamp_ns))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1 and 'verify: the run cannot be computed again: ValueError: over 5000' in out
    t_ns = 3_999_999_998_000_000_000
    far = Event('command', t_ns, t_ns, {'l3': 1.7, 'lz': 1.4}).entries()[0][1]
    path = rewritten(short, tmp_path / 'far.mcap', lambda topic, number, data: (
        far if topic.endswith('/events') and number == 1 else data),
        stamp=lambda topic, number, stamp_ns: (
            4 * 10 ** 18 if topic.endswith('/events') and number == 1 else stamp_ns))
    for odd in path, rewritten(short, tmp_path / 'odd', metadata={'begun_ns': str(10 ** 18)}):
        assert 'over 5000 samples or integration steps are too many' in told(capsys, odd)[1]
