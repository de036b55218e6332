# SPDX-License-Identifier: Apache-2.0
"""
Random commands, damaged logs, simulators and bodies, and the tables of wrong filters.

STRESS=100 pytest test/test_stress.py -k logs tries so many seeds.
"""

import faulthandler
import functools
import gc
import json
import math
import os
import random
import re
import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import bodies
from helpers.bodies import FAULTS, NAMES, told
from helpers.faulty_simulators import DEFECTS, MOVED, NOISY, RIGHT, Imu, exact
from helpers.inspected import log_of
from helpers.logs import STRANGERS, run, seen_by_mcap, seen_by_us, write_stranger
from helpers.mutations import mutate
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, SECOND, simulate
from helpers.wrong_filters import TABLE

from spinning_top_sim.exam import examine
from spinning_top_sim.exam.feeding import feed
from spinning_top_sim.grade import Imu as Known
from spinning_top_sim.grade import grade, grade_readings
from spinning_top_sim.grade.scenes import SCENES, WHEEL
from spinning_top_sim.nodes import replay_node
from spinning_top_sim.physics.top import ContinuedState
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import inspect, recover

SEEDS = range(int(os.environ.get('STRESS', '0')))
TERMINAL_CODES = re.compile(r'[\x00-\x08\x0b-\x1f\x7f-\x9f]')
SHORT = tuple(replace(scene, duration=0.4 * scene.duration) for scene in SCENES)


@pytest.mark.parametrize('method', ['rk45', 'exact'])
@pytest.mark.parametrize('scene', ['planar_pendulum', 'waking_sleeper', 'cusp'])
def test_commands_at_random_times_leave_the_attitude_as_it_is(scene, method):
    """And what follows is the exact motion from there, on the same branch."""
    random = np.random.default_rng(len(scene))
    simulation = simulate({**scene_parameters(scene), 'solver.method': method})
    top, scale = simulation.trajectory.top, abs(simulation.values_at_start['spin.l3']) or 1.0
    later = np.array([1, 50, 200]) * MILLISECOND
    for _ in range(12):
        now = simulation.now_ns + int(random.integers(1, 700 * MILLISECOND))
        assert simulation.send(now)
        before = simulation.state()
        l3, lz = map(float, scale * random.uniform(-2.0, 2.0, 2))
        if abs(math.sin(before.theta[0])) < 0.1:    # else by 1/sin(theta) too fast for a test
            lz = math.copysign(l3, l3 * math.cos(before.theta[0]))
        simulation.apply('command', l3=l3, lz=lz)
        after = simulation.state()
        assert (*simulation.trajectory.momenta(now), after.lz[0]) == (l3, lz, lz)
        # Where a pole is crossed the angles are of the ideal line, and steps of 1e-11 beside it.
        assert math.dist(after.quaternion[0], before.quaternion[0]) < 1e-9
        angles = {name: float(getattr(after, name)[0])
                  for name in ('theta', 'theta_dot', 'phi', 'psi')}
        for name, angle in angles.items():
            assert angle == pytest.approx(float(getattr(before, name)[0]), abs=1e-9)
        truth = ExactSolution(top, ContinuedState(l3=l3, lz=lz, **angles))
        assert np.abs(simulation.trajectory.evaluate(now + later).quaternion
                      - truth.states(later, SECOND).quaternion).max() < 1e-7
        assert simulation.send(now + int(later[-1]))


@pytest.fixture
def limited():
    """Let this process die if it takes a gigabyte more, or ten minutes."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    mapped = resource.getpagesize() * int(Path('/proc/self/statm').read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (mapped + 10 ** 9, before[1]))
    faulthandler.dump_traceback_later(600.0, exit=True)    # whatever else runs
    yield
    faulthandler.cancel_dump_traceback_later()
    resource.setrlimit(resource.RLIMIT_AS, before)


@functools.cache
def original_logs():
    """Return the bytes of logs to damage."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [log_of(Path(folder, f'{number}.mcap'), '--duration', 0.3, *more)
                 for number, more in enumerate((
                    ('-p', 'solver.method:=rk45'), ('-p', 'record.compression:=none'),
                    ('--command', '0.1:1.7:1.4', '-p', 'markers.enabled:=true')))]
        for options in STRANGERS.values():
            paths.append(Path(folder, f'{len(paths)}.mcap'))
            write_stranger(paths[-1], options)
        return [path.read_bytes() for path in paths]


@pytest.mark.parametrize('seed', SEEDS or range(6))
def test_damaged_logs_are_read_in_part_or_refused(tmp_path, limited, seed):
    """By the reader, inspect, inspect --verify, recover and replay; of ours or a stranger's."""
    path, whole, again = (tmp_path / f'{name}.mcap' for name in ('run', 'whole', 'again'))
    originals = original_logs()
    content = mutate(originals[seed % len(originals)], random.Random(seed))
    path.write_bytes(content)
    try:
        for topic, stamp_ns, _ in seen_by_us(path):
            assert isinstance(topic, str) and stamp_ns >= 0
    except LogError as error:
        assert str(path) in str(error) and '\n' not in str(error)
    for options in ((), ('--json',), ('--verify',)):
        code, out = checked(inspect, path, *options)
        assert code in (0, 1)
        if options == ('--json',) and out:
            json.loads(out, parse_constant=pytest.fail)
    code, _ = checked(recover, path, '-o', whole)
    assert code in (0, 1, 3) and whole.exists() == (code != 1)
    if whole.exists():
        assert len(seen_by_mcap(whole)) == len(seen_by_us(whole))
        assert checked(recover, whole, '-o', again)[0] == 0, 'what was recovered is whole'
    # At this rate the latest log time comes after 18 s.
    pytest.importorskip('rclpy')
    code, out, err = run(path, '--rate', '1e9', '--partial', tool=replay_node)
    gc.unfreeze()           # as a process of its own needs no garbage collector
    played = re.search(r'played \d+ messages', out)
    assert (code == 0 and played) or (code == 2 and (played or err.count('\n') == 1)), out + err
    assert path.read_bytes() == content, 'the log was changed'


def checked(tool, *arguments):
    """Return the exit code and what a tool has printed."""
    code, out, err = run(*arguments, tool=tool)
    said = TERMINAL_CODES.search(out + err)
    assert said is None, f'{tool.__name__} {arguments[1:]} prints {said.group()!r}'
    assert out or err.count('\n') == 1, err
    return code, out


@pytest.mark.parametrize('name', TABLE if SEEDS else ())
@pytest.mark.parametrize('seed', SEEDS)
def test_filters_are_right_or_named_by_their_one_fault(name, seed):
    make, fault = TABLE[name]
    report = examine(make, seeds=[seed], feed=feed, subject=name)
    assert ', '.join(report.faults) == fault, str(report)


@pytest.mark.parametrize('seed', SEEDS)
def test_simulators_and_bodies_are_graded_right(seed):
    """Random ones, with each defect and without any: each defect is named, nobody is blamed."""
    random = np.random.default_rng(seed)
    wrong = []
    for name in (*DEFECTS, *RIGHT):
        scenes = [SHORT[k] for k in sorted(random.choice(len(SCENES), 3, replace=False))]
        simulator = Imu(RIGHT[name], seed=seed) if name in RIGHT else Imu(exact, name, seed)
        report = grade(simulator, body=_body(random, name in NOISY or bool(seed % 2)),
                       dt=random.choice((0.001, 0.002, 0.004)), scenes=scenes)
        # Differences are half a step late.
        found = {*report.faults} - ({'late'} if name == 'wrong dt' else set())
        wrong += [f'{name}: {report}'] * (
            found != ({DEFECTS[name][0]} if name in DEFECTS else set()))
    for name, (simulator, faults) in MOVED.items():
        # Smaller steps would be right within the tolerance.
        report = grade(Imu(simulator, seed=seed), body=_body(random, bool(seed % 2)),
                       dt=random.choice((0.002, 0.004)), scenes=SHORT)
        wrong += [f'{name}: {report}'] * (report.faults != list(faults))
    for fault in (None, *FAULTS):
        moving = bodies.body(seed, seconds=10.0)
        known = Known(lever_arm=tuple(moving.arm) if seed % 2 or fault == 'no lever arm' else None)
        report = grade_readings(told(moving, fault), known)
        # What the poses are too coarse to tell may be missing, or stay unexplained.
        allowed = {NAMES[fault], 'inaccurate'} if fault else set()
        wrong += [f'body, {fault}: {report}'] * (not set(report.faults) <= allowed)
    assert not wrong, '\n'.join(wrong)


def _body(random, noisy):
    """Return the wheel with an IMU somewhere else."""
    arm, turn = random.uniform(-0.2, 0.2, 3), random.standard_normal(4)
    arm[:2] += np.copysign(0.03, arm[:2])
    turn[1:] += np.copysign(0.3, turn[1:])
    noise = (1.7e-4, 1.2e-3) if noisy else (0.0, 0.0)
    return replace(WHEEL, lever_arm=tuple(arm), mounting=tuple(turn / np.linalg.norm(turn)),
                   gyroscope_noise_density=noise[0], accelerometer_noise_density=noise[1])
