# SPDX-License-Identifier: Apache-2.0
"""Ensembles: what a run is, and a dataset that is the same however it was computed."""

import json
import os
import signal
from importlib.util import find_spec

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from helpers import simulations
from helpers.reference import ROOT

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.ensemble import connect, main

pytestmark = pytest.mark.skipif(find_spec('distributed') is None, reason='Dask is not there')
pa = pytest.importorskip('pyarrow')
parquet = pytest.importorskip('pyarrow.parquet')
ensemble_runs = pytest.importorskip('spinning_top_sim.tools.ensemble_runs')

RUNS, DURATION = 12, 1.0
SPEC = {
    'runs': RUNS, 'seed': 5, 'duration': DURATION,
    'params': ['scenes/wavy.yaml', {'imu.lever_arm': [0.1, 0.0, 0.0],
                                                'imu.drop_rate': 0.2, 'imu.duplicate_rate': 0.2}],
    'sample': {'spin.l3': {'normal': [1.6, 0.1]}, 'initial.theta': {'uniform': [0.2, 1.2]},
               'imu.rate': {'values': [100.0, 200.0]},
               'params': {'values': [str(ROOT / f'config/imu/{name}.yaml')
                                     for name in ('bmi088', 'adis16470', 'perfect')]}},
    'streams': ['imu', 'ground_truth_imu']}


def written(folder, **changes):
    """Return a specification in a folder that has our scenes."""
    path = folder / 'spec.yaml'
    (folder / 'scenes').symlink_to(ROOT / 'config')
    path.write_text(yaml.safe_dump({**SPEC, **changes}, sort_keys=False))
    return path


def specified(folder, **content):
    """Return a specification; what is empty in the parameter files of rcl is unset."""
    path = folder / 'spec.yaml'
    path.write_text(yaml.safe_dump({'duration': 1.0, **content},
                                   sort_keys=False).replace('null', ''))
    return ensemble_runs.read(path)


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes()
            for path in folder.rglob('*') if path.is_file()}


def computed(specification, parts, folder):
    """Compute all parts without Dask; none of their runs fails."""
    folder.mkdir()
    for rows in parts:
        assert ensemble_runs.compute_part(specification, folder, rows) == []
    return folder


@pytest.fixture(scope='module')
def cluster():
    """Two workers for all ensembles."""
    with connect(2, None) as client:
        yield client


@pytest.fixture
def ensemble(cluster):
    """Return what runs the command on the workers and returns its exit code."""
    return lambda *arguments: main([
        *map(str, arguments), '--quiet', '--scheduler', cluster.scheduler_info()['address']])


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return the data of the ensemble, computed without Dask, and its specification."""
    folder = tmp_path_factory.mktemp('ensemble')
    path = written(folder)
    return computed(*ensemble_runs.read(path), folder / 'data'), path


def test_every_stream_has_columns(tmp_path):
    specification, ((run,),) = specified(
        tmp_path, runs=1, duration=0.1, streams=[*ensemble_runs.STREAMS],
        sample={'imu.lever_arm': {'values': [[0.1, 0.0, 0.0]]}})
    row = ensemble_runs.table_of_run(specification, run).to_pylist()[0]
    assert row['joint_states.position.nutation_joint'] == pytest.approx(np.radians(30.0))
    assert row['~/invariants.data.l3'] == 1.6
    assert row['imu.lever_arm'] == [0.1, 0.0, 0.0]
    assert set(row) >= {
        'imu/dq.quaternion.w', 'imu/dv.vector.z', 'ground_truth/imu_odom.pose.pose.position.x',
        'ground_truth/imu_timing.data.copies', 'joint_states.velocity.spin_joint',
        'gnss/fix.position.latitude', 'imu/mag.magnetic_field_covariance.8'}


def test_a_run_has_the_samples_that_simulate_sends(whole):
    """Also where the IMU loses samples, and sends some twice."""
    (folder, path), run = whole, 7
    specification, parts = ensemble_runs.read(path)
    own = {name: value for name, value in parts[run][0].items() if '.' in name or name == 'seed'}
    values = parameters.checked({**specification.sets[run // 2 % 3], **own})
    every = parquet.read_table(folder)
    rows = every.filter(every['run'].to_numpy() == run)
    assert values['imu.rate'] == [100.0, 200.0][run % 2]
    assert rows['params'].to_pylist() == len(rows) * [run // 2 % 3]
    assert set(rows['spin.l3'].to_pylist()) == {values['spin.l3']}
    assert set(rows['seed'].to_pylist()) == {values['seed']}
    assert rows['t'].to_pylist() == [k / 200.0 for k in range(201)]
    _, sent = simulations.run(values, simulations.SECOND, 'imu/data_raw', 'ground_truth/imu')
    for topic, column, field, lost in (('imu/data_raw', 'linear_acceleration.y', 1, 20),
                                       ('ground_truth/imu', 'orientation.w', 0, 0)):
        cells = rows[f'{topic}.{column}'].to_pylist()
        times_ns, _, *fields = sent[topic]
        assert {round(1e9 * t): cell for t, cell in zip(
            rows['t'].to_pylist(), cells, strict=True) if cell is not None} == dict(zip(
                times_ns.tolist(), fields[field][:, 'xyzw'.index(column[-1])], strict=True))
        assert cells.count(None) >= lost


def test_interrupted_killed_and_torn_it_makes_the_same_dataset(
        whole, tmp_path, cluster, ensemble, monkeypatch):
    """The same command goes on; a part that is there is not computed again, a torn one is."""
    from distributed import Future, comm

    (data, path), folder, ordinary, results = whole, tmp_path / 'other', Future.result, []
    first, _ = cluster.run(os.getpid).values()

    def result(future):
        results.append(future)
        if len(results) in (4, 8):
            raise (KeyboardInterrupt if len(results) == 4 else comm.CommClosedError)
        if len(results) == 9:
            os.kill(first, signal.SIGKILL)      # another worker takes its tasks
        return ordinary(future)

    monkeypatch.setattr(Future, 'result', result)
    assert [ensemble(path, '-o', folder) for _ in range(2)] == [130, 1]
    assert not (folder / 'failed.json').exists()
    cluster.gather([cluster.submit(os.getpid, workers=[one], pure=False)    # after running tasks
                    for one in cluster.scheduler_info()['workers']])
    *torn, kept = sorted((folder / 'data').iterdir())
    then = kept.stat().st_ino, kept.stat().st_mtime_ns
    for part in torn:
        part.write_bytes(part.read_bytes()[:-1])
    for _ in range(2):          # when it is complete, nothing is computed again
        assert ensemble(path, '-o', folder) == 0
        assert contents(folder / 'data') == contents(data)
        assert (kept.stat().st_ino, kept.stat().st_mtime_ns) == then
    assert json.loads((folder / 'failed.json').read_text()) == {}
    versions = json.loads((folder / 'manifest.json').read_text())['versions']
    assert {'spinning_top_sim', 'numpy', 'pyarrow', 'python'} <= set(versions)
    # No other ensemble goes there, nor where other files are.
    other = written(tmp_path, runs=1)
    assert ensemble(other, '-o', folder) == ensemble(other, '-o', tmp_path) == 2
    assert contents(folder / 'data') == contents(data)


@pytest.mark.parametrize(('momenta', 'failed', 'code'), [
    ([1.42, 1e30], ['1'], 0), ([1e30, -1e30], ['0', '1'], 1)])
def test_failed_runs_are_told_with_their_reason(
        tmp_path, capsys, ensemble, momenta, failed, code):
    path = written(tmp_path, runs=2, duration=0.05, sample={'spin.lz': {'values': momenta}})
    for _ in range(2):      # parts that are there are not computed again
        assert ensemble(path, '-o', tmp_path / 'other') == code
        said = capsys.readouterr().err
        assert said.startswith(f'spinning-top ensemble: {len(failed)} of 2 runs failed, see ')
        why = json.loads((tmp_path / 'other/failed.json').read_text())
        assert list(why) == failed
        assert 'ValueError: no motion from State(theta=' in why['1'] and "'spin.lz': " in why['1']


def test_what_is_drawn_has_the_distributions_and_does_not_depend_on_other_names(tmp_path):
    lists = {'initial.theta': {'values': [0.1, 0.2]}}
    _, one = specified(
        tmp_path, runs=300, seed=3, sample={'spin.l3': {'uniform': [1, 3]}, **lists})
    _, more = specified(tmp_path, runs=2030, seed=3, sample={
        'top.mass': {'log_uniform': [0.1, 10.0]}, 'spin.l3': {'uniform': [1.0, 3.0]},
        'spin.lz': {'normal': [2.0, 0.5]}, **lists, 'imu.rate': {'values': [10, 20, 30]}})
    drawn = [row for part in more for row in part]
    assert [row['run'] for row in drawn] == [*range(2030)] and len(more) == 51
    for part in one:
        for row in part:
            assert row.items() <= drawn[row['run']].items()
    columns = {name: np.array([row[name] for row in drawn]) for name in drawn[0]}
    # Five standard errors of the mean, and of the standard deviation.
    for values, mean, deviation in (
            (columns['spin.l3'], 2.0, 1.0 / np.sqrt(3.0)), (columns['spin.lz'], 2.0, 0.5),
            (np.log10(columns['top.mass']), 0.0, 1.0 / np.sqrt(3.0))):
        assert abs(values.mean() - mean) < 5.0 * deviation / np.sqrt(2030)
        assert abs(values.std() - deviation) < 5.0 * deviation / np.sqrt(2 * 2030)
    assert len(set(columns['seed'].tolist())) == 2030
    pairs = list(zip(columns['initial.theta'], columns['imu.rate'], strict=True))
    assert pairs[:6] == pairs[6:12] and len(set(pairs[:6])) == 6
    assert abs(np.corrcoef(columns['spin.l3'], columns['spin.lz'])[0, 1]) < 5.0 / np.sqrt(2030)


def test_all_runs_have_the_same_columns_whatever_their_parameters_enable(tmp_path):
    """A magnetometer in one IMU, an outage; a value unset in some runs."""
    sets = [str(ROOT / f'config/imu/{name}.yaml') for name in ('bmi088', 'icm_20948')]
    specification, parts = specified(
        tmp_path, runs=6, duration=0.3, streams=['imu', 'mag', 'gnss'], sample={
            'params': {'values': [*sets, {'gnss.outages': [0.05, 0.15]}]},
            'spin.lz': {'values': [None, 1.4]}})
    runs = [ensemble_runs.table_of_run(specification, *part) for part in parts]
    whole, joined = parquet.read_table(
        computed(specification, parts, tmp_path / 'data')), pa.concat_tables(runs)
    assert whole.schema.equals(joined.schema)
    assert repr(whole.to_pydict()) == repr(joined.to_pydict())      # with the same NaN
    mag = [one['imu/mag.magnetic_field.x'] for one in runs]
    assert [len(column) - column.null_count for column in mag] == [31, 31, 31] * 2
    assert [set(one['spin.lz'].to_pylist()) for one in runs] == 3 * [{None}] + 3 * [{1.4}]
    for topic, field, lost in (('fix', 'status.status', -1.0),
                               ('velocity', 'twist.twist.linear.x', None)):
        seen = runs[2].filter(pa.array(np.isin(runs[2]['t'], (0.0, 0.1, 0.2, 0.3))))
        cells = seen[f'gnss/{topic}.{field}'].to_pylist()
        assert [cell == lost for cell in cells] == [False, True, False, False]


@pytest.mark.parametrize(('changes', 'said'), [
    ({'sample': {'spin.l4': {'uniform': [1, 2]}}},
     'there is no parameter spin.l4; did you mean spin.l'),
    ({'params': ['none.yaml']}, 'none.yaml: No such file'),
    ({'sample': {'params': {'uniform': [1, 2]}}}, '1: must be a parameter file'),
    ({'sample': {'params': {'values': [{'spin.l4': 1.0}]}}}, 'there is no parameter spin.l4'),
    ({'sample': {'spin.l3': {'gauss': [1, 2]}}}, "{'gauss': [1, 2]}: must be values with a list"),
    ({'sample': {'spin.l3': {'uniform': [2, 1]}}}, '[2, 1]}: must be values'),
    ({'sample': {'spin.l3': {'normal': [1, -1]}}}, '[1, -1]}: must be values'),
    ({'sample': {'spin.l3': {'log_uniform': [0, 1]}}}, '[0, 1]}: must be values'),
    ({'sample': {'spin.l3': {'values': []}}}, '[]}: must be values'),
    ({'sample': {'top.mass': {'uniform': [1, 1e31]}}}, 'top.mass = 1e+31: must be a number >= 0'),
    ({'sample': {'imu.rate': {'values': [100, 'x']}}}, "imu.rate = 'x': must be a number"),
    ({'sample': {'markers.trace_points': {'uniform': [1.5, 2]}}}, '1.5: must be an integer'),
    ({'sample': {'use_sim_time': {'values': [True]}}}, 'there is no parameter use_sim_time'),
    ({'streams': ['imu', 'markers']}, 'must be one of pose'),
    ({'duration': 0}, 'duration = 0: must be a number >= 1e-09'),
    ({'run': 3}, 'must be a mapping with runs'), ({'--workers': '0'}, '--workers 0: must be')])
def test_a_bad_specification_is_refused_and_makes_nothing(tmp_path, capsys, changes, said):
    workers = changes.get('--workers', '1')
    path = written(tmp_path, **{name: value for name, value in changes.items() if '-' not in name})
    code = main([str(path), '-o', str(tmp_path / 'out'), '--workers', workers])
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith('spinning-top ensemble: ') and error.count('\n') == 1
    assert code == (1 if 'No such file' in said else 2)
    assert not (tmp_path / 'out').exists()
