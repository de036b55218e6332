# SPDX-License-Identifier: Apache-2.0
"""Ensembles: what a run is, and a dataset that is the same however it was computed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from helpers.reference import ROOT
from mcap.reader import make_reader

from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.tools import ensemble_part, ensemble_spec
from spinning_top_sim.tools.ensemble import _manifest, _write_manifest, main
from spinning_top_sim.tools.ensemble_part import (
    EnsembleError,
    compute_part,
    samples,
    table,
)

pytest.importorskip('distributed')
pa = pytest.importorskip('pyarrow')
parquet = pytest.importorskip('pyarrow.parquet')

SPEC = {
    'runs': 60, 'seed': 5, 'duration': 4.0, 'runs_per_part': 2,
    'params': [str(ROOT / 'config/wavy.yaml'), {'imu.lever_arm': [0.1, 0.0, 0.0]}],
    'sample': {'spin.l3': {'normal': [1.6, 0.1]}, 'initial.theta': {'uniform': [0.2, 1.2]},
               'imu.rate': {'values': [100.0, 200.0]},
               'params': {'values': [str(ROOT / f'config/imu/{name}.yaml')
                                     for name in ('bmi088', 'adis16470', 'perfect')]}},
    'streams': ['imu', 'ground_truth_imu']}
PATIENCE = 150.0            # s, with a machine that is busy otherwise
ENVIRONMENT = {**os.environ, 'PYTHONPATH': os.pathsep.join(
    filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))}


def written(folder, **changes):
    """Write a specification; return its path."""
    path = folder / 'spec.yaml'
    path.write_text(yaml.safe_dump({**SPEC, **changes}, sort_keys=False))
    return path


@contextlib.contextmanager
def process(*arguments):
    """Run Python in a session of its own, and kill what is left of it."""
    running = subprocess.Popen(
        [sys.executable, *map(str, arguments)], env=ENVIRONMENT, start_new_session=True,
        text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        yield running
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.communicate()


def ensemble(*arguments):
    return process('-P', ROOT / 'scripts/ensemble', *arguments, '--quiet')


def finish(running):
    """Return the exit code and what it said."""
    _, said = running.communicate(timeout=PATIENCE)
    return running.returncode, said


def wait_for(folder, parts, running):
    """Wait until so many parts are complete; return their records by path."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and running.poll() is None:
        found = list((folder / 'progress').glob('part-*.json'))
        if len(found) >= parts:
            return found
        time.sleep(0.002)
    raise AssertionError(f'{parts} parts are not there: {running.communicate(timeout=1)}')


def workers_of(pid):
    """Return the processes that compute for a command."""
    children = [child for task in Path(f'/proc/{pid}/task').iterdir()
                for child in (task / 'children').read_text().split()]
    return [int(child) for child in children
            if b'spawn_main' in Path(f'/proc/{child}/cmdline').read_bytes()]


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes()
            for path in folder.rglob('*') if path.is_file()}


# ------------------------------------------------------------------------------------- a dataset


def test_every_stream_has_columns_or_is_left_out():
    """Those without a rate of their own too; each number has a name."""
    names = [name for name in ensemble_spec.STREAMS if name not in ensemble_spec.WITHOUT_COLUMNS]
    for some in (names, *([name] for name in names)):
        specification = ensemble_spec.parse({'runs': 1, 'duration': 0.1, 'streams': some}, 'test')
        table = ensemble_part.table(specification, 0)
        assert table.num_rows > 1 and len(set(table.column_names)) == table.num_columns > 3
    columns = set(ensemble_part.table(ensemble_spec.parse(
        {'runs': 1, 'duration': 0.1, 'streams': names}, 'test'), 0).column_names)
    assert columns >= {
        'imu/dq.quaternion.w', 'imu/dv.vector.z', 'ground_truth/imu_odom.pose.pose.position.x',
        'ground_truth/imu_timing.data.copies', '~/invariants.data.energy',
        'joint_states.velocity.spin_joint', 'imu/mag.magnetic_field_covariance.8'}


@pytest.fixture(scope='module')
def dataset(tmp_path_factory):
    """Return an undisturbed dataset, and its specification."""
    folder = tmp_path_factory.mktemp('ensemble')
    path = written(folder)
    with ensemble(path, '-o', folder / 'whole', '--workers', 1) as running:
        assert finish(running) == (0, '')
    return folder / 'whole', path


def test_a_dataset_has_the_samples_of_every_run_as_simulate_has_them(dataset):
    folder, path = dataset
    whole = parquet.read_table(folder / 'data')
    runs = whole['run'].to_numpy()
    specification = ensemble_spec.read(path)
    assert sorted(set(runs.tolist())) == list(range(60))
    for run in (0, 7, 59):
        values = specification.values(run)
        rows = whole.filter(runs == run)
        rate = [100.0, 200.0][run % 2]
        assert values['imu.rate'] == rate
        assert rows['params'].to_pylist() == len(rows) * [run // 2 % 3]
        assert set(rows['spin.l3'].to_pylist()) == {values['spin.l3']}
        assert set(rows['seed'].to_pylist()) == {values['seed']}
        assert rows['t'].to_pylist() == [k / 200.0 for k in range(801)]
        streams = stream_by_stream(values)
        for topic, column in (('imu/data_raw', 'linear_acceleration.y'),
                              ('ground_truth/imu', 'orientation.w')):
            times, fields = streams[topic]
            name, component = column.split('.')
            field = ('orientation', 'angular_velocity', 'linear_acceleration').index(name)
            every = rows[f'{topic}.{column}'].to_pylist()
            kept = {t: value for t, value in zip(rows['t'].to_pylist(), every, strict=True)
                    if value is not None}
            expected = fields[field][:, 'xyzw'.index(component)].tolist()
            assert kept == dict(zip((times / 1e9).tolist(), expected, strict=True))
    assert not [name for name in whole.column_names if 'data_raw.orientation' in name]


def stream_by_stream(values):
    """Return times [ns] and fields of a run by topic, sample by sample as a node sends them."""
    simulation = Simulation(values)
    streams = journal.recorded_streams(simulation.streams, values)
    found = {stream.topic: [] for stream in streams}

    def write(numbers, stamp_ns, messages, size):
        for number, data in zip(numbers, messages, strict=True):
            stream = streams[number]
            found[stream.topic].append((stamp_ns, stream.template.decode(bytes(data))))

    simulation.log_to(write, streams)
    simulation.advance(round(values['duration'] * 1e9))
    return {topic: (np.array([stamp for stamp, _ in rows]),
                    [np.concatenate(parts) for parts in zip(*(f for _, f in rows), strict=True)])
            for topic, rows in found.items()}


def test_the_manifest_has_specification_versions_and_hashes(dataset):
    folder, path = dataset
    manifest = json.loads((folder / 'manifest.json').read_text())
    assert manifest['complete'] and manifest['failed'] == {}
    assert {'spinning_top_sim', 'numpy', 'pyarrow', 'python'} <= set(manifest['versions'])
    assert ensemble_spec.parse(manifest['specification'], 'manifest') == ensemble_spec.read(path)
    names = {str(file.relative_to(folder)) for file in (folder / 'data').iterdir()}
    assert set(manifest['files']) == names and len(names) == 30
    lines = ''.join(f'{digest}  {name}\n' for name, digest in manifest['files'].items())
    check = subprocess.run(['sha256sum', '--check', '--quiet'], cwd=folder, text=True, input=lines,
                           check=False, capture_output=True)
    assert check.returncode == 0, check.stdout


def test_two_workers_of_which_one_is_killed_make_the_same_dataset(dataset, tmp_path):
    whole, path = dataset
    with ensemble(path, '-o', tmp_path / 'other', '--workers', 2) as running:
        wait_for(tmp_path / 'other', 3, running)
        first, second = workers_of(running.pid)
        os.kill(first, signal.SIGKILL)
        assert finish(running) == (0, '')
    assert contents(tmp_path / 'other') == contents(whole)


def test_a_killed_and_an_interrupted_command_are_resumed(dataset, tmp_path):
    """What is complete and whole is not computed again; the dataset is that of one command."""
    whole, path = dataset
    folder = tmp_path / 'other'
    with ensemble(path, '-o', folder, '--workers', 1) as running:
        wait_for(folder, 3, running)
        os.kill(running.pid, signal.SIGKILL)
    before = len(list((folder / 'progress').glob('part-*.json')))
    assert before < 25
    with ensemble(path, '-o', folder, '--workers', 1, '--resume') as running:
        wait_for(folder, before + 3, running)
        os.killpg(running.pid, signal.SIGINT)           # as a terminal does
        code, said = finish(running)
    assert code == 130
    assert said.splitlines() == [
        f'ensemble: {folder} holds what was complete: the same command with --resume goes on',
        'ensemble: interrupted']
    assert not json.loads((folder / 'manifest.json').read_text())['complete']
    records = [json.loads(record.read_text())
               for record in (folder / 'progress').glob('part-*.json')]
    complete = {name: (folder / name).stat() for record in records for name in record['files']}
    assert before + 3 <= len(complete) < 30
    damaged = folder / complete.popitem()[0]
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with ensemble(path, '-o', folder, '--workers', 2, '--resume') as running:
        assert finish(running) == (0, '')
    assert contents(folder) == contents(whole)
    for name, then in complete.items():
        now = (folder / name).stat()
        assert (now.st_ino, now.st_mtime_ns) == (then.st_ino, then.st_mtime_ns)


@pytest.mark.parametrize('change', [
    {'versions': 1}, {'files': None}, {'complete': 1}, {'specification': []}, {'format': 2}])
def test_what_is_no_manifest_is_refused(dataset, tmp_path, capsys, change):
    manifest = json.loads((dataset[0] / 'manifest.json').read_text())
    place = tmp_path / 'manifest.json'
    for text in (json.dumps({**manifest, **change}), '[' * 100_000, '[]', '{"format": 1}'):
        place.write_text(text)
        for arguments in ([str(tmp_path), '--row', '0', '-o', str(tmp_path / 'one.mcap')],
                          [str(dataset[1]), '--resume', '-o', str(tmp_path)]):
            assert main(arguments) == 2
            error = capsys.readouterr().err
            assert error.startswith(f'ensemble: {place} is no manifest') and error.count('\n') == 1


def test_damaged_files_of_a_complete_dataset_are_computed_again(tmp_path):
    """And no others; runs that failed are as they were."""
    folder = tmp_path / 'logs'
    command = (written(tmp_path, runs=6, duration=0.1, format='mcap', sample={
        'spin.lz': {'values': [1.42, 1e30, 1.4, 1.41]}}), '-o', folder, '--workers', 1)
    with ensemble(*command) as running:
        assert finish(running)[0] == 0
    before = contents(folder)
    lost, damaged, _, *kept = sorted((folder / 'data').iterdir())       # runs 0, 2, 3, and 4
    then = [(path.stat().st_ino, path.stat().st_mtime_ns) for path in kept]
    lost.unlink()
    damaged.write_bytes(bytes(100))
    with ensemble(*command, '--resume') as running:
        code, said = finish(running)
    assert code == 0 and said.startswith('ensemble: 2 of 6 runs failed, see manifest.json; run 1:')
    assert contents(folder) == before
    assert [(path.stat().st_ino, path.stat().st_mtime_ns) for path in kept] == then


def test_a_cluster_whose_scheduler_is_killed(dataset, tmp_path):
    whole, path = dataset
    folder, place = tmp_path / 'other', tmp_path / 'scheduler.json'
    common = ('--scheduler-file', place, '--host', '127.0.0.1', '--no-dashboard')
    with process('-m', 'dask', 'scheduler', '--port', 0, *common) as scheduler, process(
            '-m', 'dask', 'worker', '--nthreads', 1, '--no-nanny', *common):
        end = time.monotonic() + PATIENCE
        while not (place.exists() and place.read_text()) and time.monotonic() < end:
            time.sleep(0.01)
        address = json.loads(place.read_text())['address']
        with ensemble(path, '-o', folder, '--scheduler', address) as running:
            wait_for(folder, 3, running)
            scheduler.kill()
            code, said = finish(running)
    assert code == 1
    assert said.splitlines()[-1] == 'ensemble: the scheduler is lost'
    with ensemble(path, '-o', folder, '--resume') as running:
        assert finish(running) == (0, '')
    assert contents(folder) == contents(whole)


def test_a_row_alone_is_that_of_the_dataset(dataset, tmp_path):
    """From the manifest alone."""
    whole, _ = dataset
    (tmp_path / 'alone').mkdir()
    (tmp_path / 'alone/manifest.json').write_bytes((whole / 'manifest.json').read_bytes())
    for name in ('one.parquet', 'one.mcap'):
        assert main([str(tmp_path / 'alone'), '--row', '41', '-o', str(tmp_path / name)]) == 0
    every = parquet.read_table(whole / 'data')
    assert parquet.read_table(tmp_path / 'one.parquet').equals(
        every.filter(every['run'].to_numpy() == 41).combine_chunks())
    with open(tmp_path / 'one.mcap', 'rb') as file:
        reader = make_reader(file)
        counts = reader.get_summary().statistics.message_count
        stated = {record.name: record.metadata for record in reader.iter_metadata()}
    # 200 Hz for four seconds, of the IMU, its bias and its truth; and the start
    assert counts == 3 * 801 + 1
    specification = ensemble_spec.parse(
        json.loads((whole / 'manifest.json').read_text())['specification'], 'manifest')
    assert parameters.checked(json.loads(
        stated['spinning_top_sim']['parameters'])) == specification.values(41)


def test_logs_and_failed_runs(tmp_path):
    """A run that no motion begins, or that ends early, is told with its reason."""
    path = written(tmp_path, runs=6, duration=1.0, format='mcap', streams=[], sample={
        'initial.theta': {'values': [0.5, 0.5, 3.0]}, 'spin.lz': {'values': [1.42, 1e30]}})
    with ensemble(path, '-o', tmp_path / 'logs', '--workers', 1) as running:
        code, said = finish(running)
    assert code == 0
    assert said.startswith('ensemble: 3 of 6 runs failed, see manifest.json; run 3: ValueError: ')
    assert said.count('\n') == 1
    manifest = json.loads((tmp_path / 'logs/manifest.json').read_text())
    assert list(manifest['failed']) == ['3', '4', '5']
    assert all('ValueError: no motion from theta' in why for why in manifest['failed'].values())
    assert list(manifest['files']) == [f'data/run-{run:09d}.mcap' for run in range(3)]
    assert main([str(tmp_path / 'logs'), '--row', '2', '-o', str(tmp_path / 'one.mcap')]) == 0
    assert (tmp_path / 'one.mcap').read_bytes() == (
        tmp_path / 'logs/data/run-000000002.mcap').read_bytes()


# --------------------------------------------------------------------------------- what is drawn


def test_what_is_drawn_has_the_distributions_and_does_not_depend_on_other_names():
    given = {'runs': 4000, 'duration': 1.0, 'seed': 3}
    one = ensemble_spec.parse({**given, 'sample': {
        'spin.l3': {'uniform': [1.0, 3.0]}, 'initial.theta': {'values': [0.1, 0.2]}}}, 'one')
    more = ensemble_spec.parse({**given, 'sample': {
        'top.mass': {'log_uniform': [0.1, 10.0]}, 'spin.l3': {'uniform': [1.0, 3.0]},
        'spin.lz': {'normal': [2.0, 0.5]}, 'initial.theta': {'values': [0.1, 0.2]},
        'imu.rate': {'values': [10, 20, 30]}}}, 'more')
    drawn = [more.drawn(run) for run in range(4000)]
    for run in (0, 1, 3999):
        assert one.drawn(run).items() <= drawn[run].items()
    columns = {name: np.array([row[name] for row in drawn]) for name in drawn[0]}
    # Five standard errors of the mean, and of the standard deviation.
    for values, mean, deviation in (
            (columns['spin.l3'], 2.0, 1.0 / np.sqrt(3.0)),
            (columns['spin.lz'], 2.0, 0.5),
            (np.log10(columns['top.mass']), 0.0, 1.0 / np.sqrt(3.0))):
        assert abs(values.mean() - mean) < 5.0 * deviation / np.sqrt(4000)
        assert abs(values.std() - deviation) < 5.0 * deviation / np.sqrt(2 * 4000)
    assert len(set(columns['seed'].tolist())) == 4000
    pairs = list(zip(columns['initial.theta'], columns['imu.rate'], strict=True))
    assert pairs[:6] == pairs[6:12] and len(set(pairs[:6])) == 6
    assert abs(np.corrcoef(columns['spin.l3'], columns['spin.lz'])[0, 1]) < 5.0 / np.sqrt(4000)


def test_a_worker_with_other_versions_computes_nothing(tmp_path):
    specification = ensemble_spec.parse({'runs': 1, 'duration': 0.1}, 'test')
    with pytest.raises(EnsembleError, match=r"gives other bytes than \{'numpy': '1.0'\}"):
        compute_part(specification, 0, str(tmp_path), {'numpy': '1.0'})
    assert list(tmp_path.iterdir()) == []


def test_samples_of_a_run_are_arrays():
    values = parameters.checked({'duration': 0.5, 'record.streams': ('imu', 'invariants')})
    found = samples(values, ('imu', 'invariants', 'mag'))
    assert set(found) == {'imu/data_raw', 'ground_truth/imu_bias', '~/invariants', 'imu/mag',
                          'ground_truth/mag'}
    assert len(found['imu/mag'][0]) == 0
    times, fields = found['imu/data_raw']
    assert times.tolist() == [5_000_000 * k for k in range(101)]
    assert {name: field.shape for name, field in fields.items()} == {
        'angular_velocity': (101, 3), 'linear_acceleration': (101, 3)}


def test_all_runs_have_the_same_columns_whatever_their_parameters_enable(tmp_path):
    """An IMU with a magnetometer beside one without; a value that is unset in some runs."""
    grades = [str(ROOT / f'config/imu/{name}.yaml') for name in ('bmi088', 'icm_20948')]
    specification = ensemble_spec.parse({
        'runs': 4, 'duration': 0.05, 'runs_per_part': 4, 'sample': {
            'params': {'values': [*grades]}, 'spin.lz': {'values': [None, 1.4]}}}, 'test')
    (tmp_path / 'progress').mkdir()
    (tmp_path / 'data').mkdir()
    record = compute_part(specification, 0, str(tmp_path), ensemble_part.versions())
    assert (len(record['files']), record['failed']) == (1, {})
    runs = [table(specification, run) for run in range(4)]
    assert parquet.read_table(tmp_path / 'data').equals(
        pa.concat_tables(runs).combine_chunks())
    for run, one in enumerate(runs):
        assert one.schema == runs[0].schema
        assert set(one['spin.lz'].to_pylist()) == {None if run < 2 else 1.4}
        samples_of_mag = len(one) - one['imu/mag.magnetic_field.x'].null_count
        assert samples_of_mag == [0, 6][run % 2]


def test_runs_without_a_sample_have_no_rows(tmp_path):
    grades = [str(ROOT / f'config/imu/{name}.yaml') for name in ('bmi088', 'icm_20948')]
    specification = ensemble_spec.parse({
        'runs': 2, 'runs_per_part': 1, 'duration': 0.05, 'params': [{'record.streams': ['mag']}],
        'sample': {'params': {'values': grades}}}, 'test')
    for name in ('progress', 'data'):
        (tmp_path / name).mkdir()
    for part in range(2):
        record = compute_part(specification, part, str(tmp_path), ensemble_part.versions())
        assert (len(record['files']), record['failed']) == (1, {})
    assert [len(table(specification, run)) for run in range(2)] == [0, 6]
    assert len(parquet.read_table(tmp_path / 'data')) == 6


def test_a_grid_in_another_order_is_another_one(tmp_path):
    sample = {'initial.theta': {'values': [0.3, 0.6]}, 'spin.l3': {'values': [1.5, 1.7]}}
    one, other = (ensemble_spec.parse({'runs': 4, 'duration': 1.0, 'sample': dict(order)}, 'test')
                  for order in (sample.items(), reversed(sample.items())))
    manifest = _manifest(tmp_path, one, resume=False)
    _write_manifest(tmp_path, manifest)
    assert _manifest(tmp_path, one, resume=True) == manifest
    with pytest.raises(ValueError, match='has another specification: sample'):
        _manifest(tmp_path, other, resume=True)


def test_an_ensemble_that_stopped_with_its_first_manifest_is_resumed(tmp_path):
    specification = ensemble_spec.parse({'runs': 4, 'duration': 1.0}, 'test')
    (tmp_path / 'manifest.json.new').write_text('{"for')
    for resume in (True, False):
        assert not _manifest(tmp_path, specification, resume=resume)['complete']


def test_the_versions_are_those_that_are_in_the_logs():
    assert {'rclpy', 'numpy', 'mcap', 'zstandard', 'lz4'} <= set(ensemble_part.versions())


def test_streams_that_are_named_have_the_same_columns_in_all_runs():
    specification = ensemble_spec.parse({
        'runs': 2, 'duration': 0.05, 'streams': ['imu', 'mag'], 'sample': {'params': {'values': [
            {'mag.enabled': False, 'increments.enabled': True}, {'imu.enabled': False}]}}}, 'test')
    assert table(specification, 0).schema == table(specification, 1).schema
    assert table(specification, 0)['imu/mag.magnetic_field.x'].null_count < 11


def test_a_row_of_logs_without_columns_is_refused(tmp_path, capsys):
    path = written(tmp_path, format='mcap', streams=['clock'])
    assert main([str(path), '--row', '0', '-o', str(tmp_path / 'one.parquet')]) == 2
    assert capsys.readouterr().err == (
        'ensemble: the streams clock have no columns: only a log (.mcap) can have them\n')


def test_columns_have_the_names_of_joints_and_invariants():
    specification = ensemble_spec.parse({
        'runs': 1, 'duration': 0.1, 'streams': ['pose', 'joint_states', 'invariants'],
        'sample': {'imu.lever_arm': {'values': [[0.1, 0.0, 0.0]]}}}, 'test')
    row = table(specification, 0).to_pylist()[0]
    assert row['joint_states.position.nutation_joint'] == pytest.approx(np.radians(30.0))
    assert row['~/invariants.data.l3'] == 1.6
    assert row['imu.lever_arm'] == [0.1, 0.0, 0.0]
    assert len(row) == 2 + 2 + 4 + 6 + 8


# -------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(('changes', 'said'), [
    ({'sample': {'spin.l4': {'uniform': [1, 2]}}},
     'there is no parameter spin.l4; did you mean spin.l'),
    ({'params': [{'spin.l4': 1.0}]}, 'no parameter spin.l4'),
    ({'params': ['none.yaml']}, 'none.yaml: No such file'),
    ({'sample': {'spin.l3': {'gauss': [1, 2]}}},
     'spin.l3: there is no distribution gauss; there are uniform, normal, log_uniform, values'),
    ({'sample': {'spin.l3': {'uniform': [2, 1]}}}, 'uniform = [2, 1]: must be [low, high] with'),
    ({'sample': {'spin.l3': {'uniform': [1, 10 ** 400]}}}, 'must be [low, high] with low <= high'),
    ({'sample': {'spin.l3': {'uniform': [-1e308, 1e308]}}}, 'and a finite difference'),
    ({'sample': {'spin.l3': {'log_uniform': [1e-300, 1e300]}}}, 'and a finite ratio'),
    ({'params': ['a\0b']}, "'a\\x00b': must be a parameter file"),
    ({'sample': {'spin.l3': {'uniform': [2]}}}, 'uniform = [2]: must be [low, high]'),
    ({'sample': {'spin.l3': {'normal': [2, -1]}}}, 'deviation >= 0'),
    ({'sample': {'top.mass': {'log_uniform': [0, 1]}}}, '0 < low <= high'),
    ({'sample': {'top.mass': {'uniform': [-1, 1]}}}, 'top.mass = -1: must be a number >= 0'),
    ({'sample': {'spin.l3': {'values': []}}}, 'must have one value at least'),
    ({'sample': {'spin.l3': [1, 2]}}, 'spin.l3 = [1, 2]: must be one of uniform'),
    ({'sample': {'solver.method': {'values': ['exact', 'euler']}}}, "'euler': must be one of"),
    ({'sample': {'markers.trace_points': {'uniform': [1, 2]}}}, 'must be values'),
    ({'sample': {'use_sim_time': {'values': [True]}}}, 'use_sim_time is of ROS'),
    ({'sample': {'imu.enabled': {'values': [True, False]}}}, 'imu.enabled must not be sampled'),
    ({'sample': {'record.streams': {'values': [['imu']]}}}, 'record.streams must not be sampled'),
    ({'streams': ['imu', 'lidar']}, "streams: 'lidar': must be some of pose"),
    ({'streams': ['markers']}, "'markers': must be some of"),
    ({'runs': 0}, 'runs = 0: must be an integer >= 1'),
    ({'runs': 1.5}, 'runs = 1.5: must be an integer'),
    ({'seed': -1}, 'seed = -1'),
    ({'duration': 0.0}, 'duration = 0.0: must be a number > 0'),
    ({'duration': 'long'}, "duration = 'long'"),
    ({'format': 'csv'}, "format = 'csv': must be one of parquet, mcap"),
    ({'run': 3}, 'run: there is no such entry; there are runs'),
])
def test_a_bad_specification_is_refused_and_makes_nothing(tmp_path, capsys, changes, said):
    path = written(tmp_path, **changes)
    code = main([str(path), '-o', str(tmp_path / 'out')])
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith('ensemble: ') and error.count('\n') == 1
    assert code == (1 if 'No such file' in said else 2)
    assert not (tmp_path / 'out').exists()


def test_folders_are_not_overwritten_and_only_their_own_ensemble_is_resumed(
        dataset, tmp_path, capsys):
    whole, path = dataset
    before = contents(whole)
    assert main([str(path), '-o', str(whole)]) == 2
    assert 'exists and is not overwritten: --resume goes on with it' in capsys.readouterr().err
    other = written(tmp_path, seed=6, streams=['pose'])
    assert main([str(other), '-o', str(whole), '--resume']) == 2
    error = capsys.readouterr().err
    assert 'another specification: seed = 5, not 6, streams = [' in error and 'pose' in error
    assert main([str(path), '-o', str(tmp_path), '--resume']) == 2
    assert 'has no manifest.json' in capsys.readouterr().err
    assert main([str(path), '-o', str(whole), '--resume', '--quiet']) == 0       # it is complete
    assert contents(whole) == before


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--row', '60', '-o', 'one.mcap'], '--row 60: must be from 0 to 59'),
    (['--row', '1', '-o', 'one.csv'], 'one.csv: the name must end in .mcap or .parquet'),
    (['-o', 'out', '--workers', '0'], '--workers 0: must be'),
    (['-o', 'out', '--workers', '1', '--scheduler', 'tcp://127.0.0.1:1'], 'must not be given'),
])
def test_bad_arguments_are_refused(tmp_path, monkeypatch, capsys, arguments, said):
    path = written(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main([str(path), *arguments]) == 2
    assert said in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ['spec.yaml']


@pytest.mark.parametrize('name', ['distributed', 'pyarrow'])
def test_what_is_not_installed_is_named(tmp_path, name):
    arguments = [str(written(tmp_path)), '-o', str(tmp_path / 'out')]
    with process('-c', f'import sys; sys.modules[{name!r}] = None\n'
                 f'from spinning_top_sim.tools.ensemble import main\nsys.exit(main({arguments}))',
                 ) as running:
        code, said = finish(running)
    assert code == 1 and "pip install 'spinning_top_sim[exam]'" in said and name in said
    assert not (tmp_path / 'out').exists()
