# SPDX-License-Identifier: Apache-2.0
"""examples/attitude_filter.py: against the truth from logs, and live beside a node."""

import functools
import importlib.util
import math
import re
import signal
import sys

import pytest
from helpers.node_harness import SimNode, wait_for
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools.inspect import main as inspect
from spinning_top_sim.tools.simulate import main as simulate

EXAMPLE = ROOT / 'examples/attitude_filter.py'
SETTLE = 15.0
MOUNTING = (0.3, -0.2, 1.0)
LOGS = {
    'pivot': ['-p', f'imu.rpy:={list(MOUNTING)}'],
    'pivot at 100 Hz': ['-p', 'imu.rate:=100.0'],
    'lever arm': ['-p', f'imu.rpy:={list(MOUNTING)}', '-p', 'imu.lever_arm:=[0.1, 0.0, 0.0]'],
    'nine axes': ['-p', f'imu.rpy:={list(MOUNTING)}', '-p', 'mag.enabled:=true'],
    'noise': ['--params', str(ROOT / 'config/imu/bmi088.yaml')],
}


@pytest.fixture(scope='module')
def example():
    for library in ('ahrs', 'vqf'):
        pytest.importorskip(library)
    spec = importlib.util.spec_from_file_location('attitude_filter_example', EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def logs(tmp_path_factory):
    """Return half a minute of waves for each of LOGS."""
    folder = tmp_path_factory.mktemp('logs')
    paths = {name: folder / f'{number}.mcap' for number, name in enumerate(LOGS)}
    for name, path in paths.items():
        assert simulate(['--quiet', '-o', str(path), '--duration', '30', '-p',
                         'solver.method:=exact', '--params', str(ROOT / 'config/wavy.yaml'),
                         *LOGS[name]]) == 0
    return paths


@pytest.fixture(scope='module')
def summaries(example, logs):
    """Return the function that returns the summaries of filters on one of LOGS, by filter."""
    @functools.cache
    def summaries(name, *filters, **options):
        return {one.name: one.summary(SETTLE)
                for one in example.compare(logs[name], filters, **options)}
    return summaries


# ------------------------------------------------------------------------- bounds: 3 x measured

def test_at_the_pivot_a_perfect_imu_leaves_the_filters_own_error(summaries):
    found = summaries('pivot', 'vqf', 'madgwick', 'ekf')
    assert found['vqf'].compared == 3000
    assert found['vqf'].tilt_rms < 0.03 and found['vqf'].converged < 1.0
    assert abs(found['vqf'].heading_rate) < 0.045
    assert found['ekf'].tilt_rms < 0.06
    # Madgwick compares a new force with an old attitude: one sample of lag, 1.4 degrees.
    assert found['madgwick'].tilt_rms == pytest.approx(1.39, abs=0.1)
    assert found['ekf'].heading_rate == pytest.approx(found['madgwick'].heading_rate, rel=0.1)


def test_the_error_of_vqf_falls_with_the_square_of_the_step(summaries):
    fine = summaries('pivot', 'vqf', 'madgwick', 'ekf')['vqf']
    coarse = summaries('pivot at 100 Hz', 'vqf')['vqf']
    assert coarse.tilt_rms / fine.tilt_rms == pytest.approx(4.0, abs=0.5)
    assert coarse.heading_rate / fine.heading_rate == pytest.approx(4.0, abs=0.5)


def test_nine_axes_know_the_heading(summaries):
    """The bound is 3 times what is measured 15 s after the start."""
    found = summaries('nine axes', 'vqf9', 'vqf')
    assert found['vqf9'].compared == 3000 and found['vqf9'].tilt_max < 0.01
    assert found['vqf9'].heading_max < 0.03
    assert math.isnan(found['vqf'].heading_max)


@pytest.mark.parametrize('mag_ms', [1, 10, 100])
def test_the_periods_of_imu_and_magnetometer_are_learned(example, monkeypatch, mag_ms):
    given = []
    monkeypatch.setitem(example.FILTERS, 'vqf9', lambda *periods: (
        given.append(periods), example.vqf9(*periods))[1])
    comparison = example.Comparison('vqf9')
    for ms in range(250):
        comparison.imu(ms * 1_000_000, (0.0, 0.0, 1.0), (0.0, 0.0, 9.8))
        if ms % mag_ms == 0:
            comparison.mag(ms * 1_000_000, (0.0, 2e-5, -4e-5))
    assert given == [(0.001, mag_ms * 1e-3)]


def test_a_wrong_declination_is_a_wrong_heading(summaries):
    found = summaries('nine axes', 'vqf9', declination=0.0)['vqf9']
    assert found.heading_max == pytest.approx(math.degrees(math.atan2(1.57, 21.02)), abs=0.03)


def test_a_lever_arm_misleads_what_takes_the_accelerometer_for_still(summaries):
    found = summaries('lever arm', 'vqf', 'madgwick')
    assert found['vqf'].tilt_rms < 0.3 and found['vqf'].converged < SETTLE
    assert found['madgwick'].tilt_rms > 1.0 and found['madgwick'].converged == math.inf


def test_a_filter_converges_with_the_noise_of_a_real_device(summaries):
    found = summaries('noise', 'vqf')['vqf']
    assert found.converged < SETTLE
    assert 0.03 < found.tilt_rms < 1.0


def test_a_wrong_mounting_is_seen(summaries):
    found = summaries('pivot', 'vqf', rpy=(0.3, -0.1, 1.0))['vqf']
    assert found.tilt_rms == pytest.approx(math.degrees(0.1), rel=0.5)


# ------------------------------------------------------------------------------ the comparison

def test_tilt_and_heading_of_an_error(example):
    truth = Rotation.from_euler('xyz', (0.4, 0.5, 0.6))
    for axis, tilt, heading in (('x', 0.2, 0.0), ('y', 0.2, 0.0), ('z', 0.0, 0.2)):
        estimate = Rotation.from_euler(axis, 0.2) * truth
        assert example.error_of(estimate, truth) == pytest.approx((tilt, heading), abs=1e-7)
        # In an order that tells world from sensor: the same turn about the sensor's axis.
        assert example.error_of(truth * Rotation.from_euler(axis, 0.2), truth)[0] > 0.05


def feed(example, samples):
    """Return a comparison of samples (stamp, rate about the vertical), turning about z."""
    comparison = example.Comparison('vqf')
    for stamp_ns in samples:
        comparison.imu(stamp_ns, (0.0, 0.0, 2.0), (0.0, 0.0, 9.81))
        half = stamp_ns * 1e-9
        comparison.pose(stamp_ns, (0.0, 0.0, math.sin(half), math.cos(half)))
    return comparison


def test_lost_samples_are_bridged(example):
    stamps = [k * 5_000_000 for k in range(2000) if k % 7 != 3]
    comparison = feed(example, stamps)
    assert comparison.lost == 2000 - len(stamps) and comparison.restarts == 0
    assert abs(comparison.summary(1.0).heading_rate) < 1e-3
    assert len(comparison.errors) == len(stamps) - 1


def test_after_a_long_gap_or_a_step_back_the_filter_starts_anew(example):
    stamps = [*range(0, 10 ** 9, 5_000_000), *range(3 * 10 ** 9, 4 * 10 ** 9, 5_000_000),
              *range(2 * 10 ** 9, 3 * 10 ** 9, 5_000_000)]
    comparison = feed(example, stamps)
    assert comparison.restarts == 2 and comparison.lost == 0
    assert len(comparison.errors) == len(stamps) - 3


def test_nothing_to_compare_is_said(example, logs, capsys):
    comparison = example.Comparison('vqf')
    with pytest.raises(ValueError, match='vqf: no message of imu/data_raw and pose has come'):
        comparison.summary(1.0)
    comparison.imu(0, (0.0, 0.0, 1.0), (0.0, 0.0, 9.8))
    with pytest.raises(ValueError, match='no message of pose has come'):
        comparison.summary(1.0)
    comparison.pose(1, (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match='no sample of imu/data_raw had the stamp of a pose'):
        comparison.summary(1.0)
    assert example.main(['it', str(logs['noise']), '--settle', '40']) == 1
    assert '--settle 40' in capsys.readouterr().err
    with pytest.raises(ValueError, match='has no topic /imu/mag'):
        example.compare(logs['pivot'], ['vqf9'])
    assert example.main(['it', str(logs['noise']), '--namespace', 'other']) == 1
    assert 'no topic /other/imu/data_raw; it has /pose' in capsys.readouterr().err
    assert example.main(['it', str(EXAMPLE)]) == 1
    assert str(EXAMPLE) in capsys.readouterr().err


def test_as_a_command_it_tells_and_draws(example, logs, tmp_path, capsys):
    picture = tmp_path / 'out.png'
    assert example.main(['it', str(logs['lever arm']), '--filter', 'vqf',
                         '--plot', str(picture)]) == 0
    assert capsys.readouterr().out.startswith('vqf: ')
    assert picture.read_bytes().startswith(b'\x89PNG')


# -------------------------------------------------------------------------------------------- live

def test_live_it_follows_a_node_with_a_preset_and_ends_by_itself_or_by_sigint(
        example, peer, tmp_path):
    files = [item for name in ('wavy', 'imu/bmi088')
             for item in ('--params-file', str(ROOT / f'config/{name}.yaml'))]
    program = [str(EXAMPLE), '--filter', 'vqf']
    with (SimNode(tmp_path / 'other', namespace='/waves',
                  program=[*program, '--settle', '0']) as other):
        wait_for('the start', lambda: 'waiting for /waves/imu/data_raw' in other.err)
        with (SimNode(tmp_path / 'top', {'record.enabled': True}, namespace='/waves',
                      arguments=files) as top,
              SimNode(tmp_path / 'filter', namespace='/waves', program=[
                  *program, '--duration', '4', '--settle', '2']) as node):
            assert node.wait() == 0, node.err
            wait_for('a report', lambda: len(re.findall(r'vqf at', other.err)) >= 2)
            assert other.end(signal.SIGINT) == 0
            noise, = peer.get(top, 'imu.gyroscope_noise_density')
            assert noise == pytest.approx(1.72779e-4)
            assert top.end() == 0
    found = re.search(r'tilt error (\S+) deg rms, .* heading drift \S+ deg/s \((\d+) poses',
                      node.out)
    assert found, node.out
    # Two degrees of bias of the force at most; a load that makes samples late costs poses.
    assert float(found[1]) < 3.0
    assert int(found[2]) > 100
    assert 'vqf at' in node.err
    assert 'heading drift' in other.out and 'Traceback' not in other.err
    # The noise too is what the same parameters give offline, byte for byte.
    assert inspect([str(next(top.folder.glob('*.mcap'))), '--verify']) == 0


def test_live_without_a_simulator_it_says_that_nothing_came(tmp_path):
    with SimNode(tmp_path, namespace='/alone', program=[str(EXAMPLE)]) as node:
        wait_for('the start', lambda: 'waiting for /alone/imu/data_raw' in node.err)
        assert node.end(signal.SIGINT) == 1
    assert 'vqf: no message of imu/data_raw and pose has come' in node.err
    assert 'Traceback' not in node.err


def test_its_help_fits_into_80_columns(example, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit, match='0'):
        example.main(['attitude_filter', '--help'])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize(('arguments', 'says'), [
    (['--duration', '10'], '--duration 10 must be more than --settle 15'),
    (['--duration', '3', '--settle', '3'], '--duration 3 must be more than --settle 3'),
    (['--settle', 'x'], 'x: must be a finite number >= 0')])
def test_what_would_compare_nothing_is_refused_before_it_runs(example, capsys, arguments, says):
    with pytest.raises(SystemExit, match='2'):
        example.main(['attitude_filter', *arguments])
    assert says in capsys.readouterr().err
