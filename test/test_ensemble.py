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

SETS = [str(ROOT / f'config/imu/{name}.yaml') for name in ('bmi088', 'adis16470', 'perfect')]
SPEC = {
    'runs': 12, 'seed': 5, 'duration': 1.0,
    'params': ['wavy.yaml', {'imu.lever_arm': [0.1, 0.0, 0.0], 'imu.drop_rate': 0.2,
                             'imu.duplicate_rate': 0.2}],
    'sample': {'spin.l3': {'normal': [1.6, 0.1]}, 'initial.theta': {'uniform': [0.2, 1.2]},
               'imu.rate': {'values': [100.0, 200.0]}, 'params': {'values': SETS}},
    'streams': ['imu', 'ground_truth_imu']}


def written(folder, **content):
    """Return a specification beside a scene; what is empty in parameter files is unset."""
    (folder / 'wavy.yaml').write_bytes((ROOT / 'config/wavy.yaml').read_bytes())
    (folder / 'spec.yaml').write_text(
        yaml.safe_dump(content, sort_keys=False).replace('null', ''))
    return folder / 'spec.yaml'


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


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


def ensemble(cluster, *arguments):
    """Run the command on the workers; return its exit code."""
    return main([*map(str, arguments), '--quiet', '--scheduler',
                 cluster.scheduler_info()['address']])


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return the data of the ensemble, computed without Dask, and its specification."""
    path = written(tmp_path_factory.mktemp('ensemble'), **SPEC)
    return computed(*ensemble_runs.read(path), path.parent / 'data'), path


def test_a_run_has_the_samples_that_simulate_sends(whole):
    """Also where the IMU loses samples, and sends some twice."""
    (folder, path), run = whole, 7
    specification, parts = ensemble_runs.read(path)
    own = {name: value for name, value in parts[run][0].items() if '.' in name or name == 'seed'}
    values = parameters.checked({**specification.sets[run // 2 % 3], **own})
    every = parquet.read_table(folder)
    rows = every.filter(every['run'].to_numpy() == run)
    assert rows['params'].to_pylist() == len(rows) * [run // 2 % 3]
    for name in own:
        assert set(rows[name].to_pylist()) == {values[name]}
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
        whole, tmp_path, cluster, monkeypatch):
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
    assert [ensemble(cluster, path, '-o', folder) for _ in range(2)] == [130, 1]
    assert not (folder / 'failed.json').exists()
    cluster.gather([cluster.submit(os.getpid, workers=[one], pure=False)    # after running tasks
                    for one in cluster.scheduler_info()['workers']])
    *torn, kept = sorted((folder / 'data').iterdir())
    then = kept.stat().st_ino, kept.stat().st_mtime_ns
    for part in torn:
        part.write_bytes(part.read_bytes()[:-1])
    for _ in range(2):          # when it is complete, nothing is computed again
        assert ensemble(cluster, path, '-o', folder) == 0
        assert contents(folder / 'data') == contents(data)
        assert (kept.stat().st_ino, kept.stat().st_mtime_ns) == then
    assert json.loads((folder / 'failed.json').read_text()) == {}
    # No other ensemble goes there, nor where other files are.
    other = written(tmp_path, **{**SPEC, 'runs': 1})
    assert [ensemble(cluster, other, '-o', one) for one in (folder, tmp_path)] == [2, 2]
    assert contents(folder / 'data') == contents(data)


@pytest.mark.parametrize(('momenta', 'failed', 'code'), [
    ([1.42, 1e30], ['1'], 0), ([1e30, -1e30], ['0', '1'], 1)])
def test_failed_runs_are_told_with_their_reason(
        tmp_path, capsys, cluster, momenta, failed, code):
    path = written(tmp_path, runs=2, duration=0.05, sample={'spin.lz': {'values': momenta}})
    for _ in range(2):      # parts that are there are not computed again
        assert ensemble(cluster, path, '-o', tmp_path / 'other') == code
        said = capsys.readouterr().err
        assert said.startswith(f'spinning-top ensemble: {len(failed)} of 2 runs failed, see ')
        why = json.loads((tmp_path / 'other/failed.json').read_text())
        assert list(why) == failed
        assert 'ValueError: no motion from State(theta=' in why['1'] and "'spin.lz': " in why['1']


def test_what_is_drawn_has_the_distributions_and_does_not_depend_on_other_names(tmp_path):
    lists = {'initial.theta': {'values': [0.1, 0.2]}}
    _, few = ensemble_runs.read(written(tmp_path, runs=300, duration=1.0, seed=3, sample={
        'spin.l3': {'uniform': [1, 3]}, **lists}))
    _, parts = ensemble_runs.read(written(tmp_path, runs=2030, duration=1.0, seed=3, sample={
        'top.mass': {'log_uniform': [0.1, 10.0]}, 'spin.l3': {'uniform': [1.0, 3.0]},
        'spin.lz': {'normal': [2.0, 0.5]}, **lists, 'imu.rate': {'values': [10, 20, 30]}}))
    drawn = [row for part in parts for row in part]
    assert [row['run'] for row in drawn] == [*range(2030)] and len(parts) == 51
    for row in (row for part in few for row in part):
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
    assert abs(np.corrcoef(columns['spin.l3'], columns['top.mass'])[0, 1]) < 5.0 / np.sqrt(2030)


def test_every_stream_has_columns_also_with_outages_and_unset_values(tmp_path):
    whole = parquet.read_table(computed(*ensemble_runs.read(written(
        tmp_path, runs=4, duration=0.3, streams=[*ensemble_runs.STREAMS],
        params=[{'gnss.outages': [0.15, 0.25]}], sample={
            'params': {'values': [SETS[0], {'gnss.outages': [0.05, 0.15]}]},
            'spin.lz': {'values': [1.4, None]}, 'imu.lever_arm': {'values': [[0.1, 0.0, 0.0]]}})),
        tmp_path / 'data'))
    assert set(whole['spin.lz'].to_pylist()) == {1.4, None}
    first, *others = whole.to_pylist()
    assert first['joint_states.position.nutation_joint'] == pytest.approx(np.radians(30.0))
    assert (first['~/invariants.data.l3'], first['imu.lever_arm']) == (1.6, [0.1, 0.0, 0.0])
    assert set(first) >= {
        'imu/dq.quaternion.w', 'imu/dv.vector.z', 'ground_truth/imu_odom.pose.pose.position.x',
        'ground_truth/imu_timing.data.copies', 'joint_states.velocity.spin_joint',
        'gnss/fix.position.latitude', 'imu/mag.magnetic_field_covariance.8'}
    rows = [row for row in others if row['run'] == 3 and row['gnss/fix.status.status'] is not None]
    assert [row['gnss/fix.status.status'] for row in rows] == [0.0, -1.0, 0.0, 0.0]
    assert [row['gnss/velocity.twist.twist.linear.x'] is None for row in rows] == [
        False, True, False, False]


@pytest.mark.parametrize(('changes', 'said'), [
    ({'sample': {'spin.l4': {'uniform': [1, 2]}}},
     'there is no parameter spin.l4; did you mean spin.l'),
    ({'params': ['none.yaml']}, 'none.yaml: No such file'),
    ({'sample': {'spin.l3': {'gauss': [1, 2]}}}, "{'gauss': [1, 2]}: must be values with a list"),
    ({'sample': {'spin.l3': {'uniform': [2, 1]}}}, '[2, 1]}: must be values'),
    ({'sample': {'spin.l3': {'log_uniform': [0, 1]}}}, '[0, 1]}: must be values'),
    ({'sample': {'top.mass': {'uniform': [1, 1e31]}}}, 'top.mass = 1e+31: must be a number >= 0'),
    ({'sample': {'markers.trace_points': {'uniform': [1.5, 2]}}}, '1.5: must be an integer'),
    ({'streams': ['imu', 'markers']}, 'must be one of pose'),
    ({'duration': 0}, 'duration = 0: must be a number >= 1e-09'),
    ({'run': 3}, 'must be a mapping with runs')])
def test_a_bad_specification_is_refused_and_makes_nothing(tmp_path, capsys, changes, said):
    path = written(tmp_path, **{**SPEC, **changes})
    code = main([str(path), '-o', str(tmp_path / 'out')])
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith('spinning-top ensemble: ') and error.count('\n') == 1
    assert code == (1 if 'No such file' in said else 2)
    assert not (tmp_path / 'out').exists()
