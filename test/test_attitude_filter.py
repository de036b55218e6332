# SPDX-License-Identifier: Apache-2.0
"""examples/attitude_filter.py: against the truth from logs, and live beside a node."""

import importlib.util
import math
import re
import signal
import sys

import pytest
from helpers.node_harness import SimNode, wait_for
from helpers.reference import ROOT

from spinning_top_sim.tools.simulate import main as simulate

EXAMPLE = ROOT / 'examples/attitude_filter.py'
SETTLE = 15.0


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
def log(tmp_path_factory):
    """Return waves with nine axes."""
    path = tmp_path_factory.mktemp('logs') / 'wavy.mcap'
    assert simulate(['--quiet', '-o', str(path), '--scene', 'wavy', '--duration', '18',
                     '-p', 'imu.rpy:=[0.3, -0.2, 1.0]', '-p', 'mag.enabled:=true',
                     '-p', 'solver.method:=exact']) == 0
    return path


def test_nine_axes_know_the_heading(example, log):
    def summaries(*filters, **options):
        return {one.name: one.summary(SETTLE) for one in example.compare(log, filters, **options)}

    found = summaries('vqf9', 'vqf')
    assert found['vqf9'].compared == 1800 and found['vqf9'].tilt_max < 0.01
    assert found['vqf9'].heading_max < 0.03
    assert math.isnan(found['vqf'].heading_max)
    wrong = summaries('vqf9', declination=0.0)['vqf9']
    assert wrong.heading_max == pytest.approx(math.degrees(math.atan2(1.57, 21.02)), abs=0.03)


def feed(example, samples):
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

    # After a long gap or a step back the filter starts anew.
    stamps = [*range(0, 10 ** 9, 5_000_000), *range(3 * 10 ** 9, 4 * 10 ** 9, 5_000_000),
              *range(2 * 10 ** 9, 3 * 10 ** 9, 5_000_000)]
    comparison = feed(example, stamps)
    assert comparison.restarts == 2 and comparison.lost == 0
    assert len(comparison.errors) == len(stamps) - 3


def test_a_wrong_settling_time_or_namespace_is_told(example, log, capsys):
    assert example.main(['it', str(log), '--settle', '40']) == 1
    assert '--settle 40' in capsys.readouterr().err
    assert example.main(['it', str(log), '--namespace', 'other']) == 1
    assert 'no topic /other/imu/data_raw; it has /pose' in capsys.readouterr().err


def test_live_it_follows_a_node_and_ends_by_itself_or_by_sigint(example, tmp_path, capfd):
    files = [item for name in ('wavy', 'imu/bmi088')
             for item in ('--params-file', str(ROOT / f'config/{name}.yaml'))]
    with (SimNode(tmp_path / 'other', namespace='/waves', program=[
            str(EXAMPLE), '--filter', 'vqf', '--settle', '0']) as other):
        wait_for('the start', lambda: 'waiting for /waves/imu/data_raw' in other.err)
        with SimNode(tmp_path / 'top', namespace='/waves', arguments=files):
            assert example.main(['it', '--duration', '3', '--settle', '1.5',
                                 '--ros-args', '-r', '__ns:=/waves']) == 0
            wait_for('a report', lambda: len(re.findall(r'vqf at', other.err)) >= 2)
            assert other.end(signal.SIGINT) == 0
    found = re.search(r'tilt error (\S+) deg rms, .* heading drift \S+ deg/s \((\d+) poses',
                      capfd.readouterr().out)
    # Two degrees of bias of the force at most; a load that makes samples late costs poses.
    assert float(found[1]) < 3.0
    assert int(found[2]) > 80
    assert 'heading drift' in other.out and 'Traceback' not in other.err
