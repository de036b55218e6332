# SPDX-License-Identifier: Apache-2.0
"""
A value does not depend on which other values are computed with it.

Samples are computed in blocks, whose sizes follow from ticks, commands, rates and listeners.  The
same parameters and commands must give the same bytes for every division into blocks, and `solve`
the same bits for every division of its times.
"""

import random

import numpy as np
import pytest
from reference import scene_parameters

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Simulation

SECOND = 1_000_000_000
EPOCH_NS = 1_700_000_000 * SECOND


class Recording:
    """
    What a simulation sends, live or offline, of these topics or of all.

    rows: of each topic the stamps [ns] and messages, in order
    """

    def __init__(self, simulation, topics=None):
        self.simulation = simulation
        self.streams = [stream for stream in simulation.streams
                        if topics is None or stream.topic in topics]
        self.rows = {stream.topic: [] for stream in self.streams}
        simulation.log_to(self._write, self.streams)

    def advance(self, target_ns):
        """Send what is due up to a time, as a node does."""
        assert self.simulation.advance(target_ns)

    def compute_ahead(self, instants):
        """Compute samples that are not due yet, as a node does after a tick."""
        self.simulation.prepare(self.simulation.now_ns + instants * 1_000_000, 100_000)

    def advance_offline(self, target_ns):
        """Send what is due up to a time, a block of a stream at a time."""
        self.simulation.advance_in_blocks(target_ns, self._send)

    def _write(self, numbers, stamp_ns, messages, size):
        assert size == sum(map(len, messages))
        for number, message in zip(numbers, messages, strict=True):
            self.rows[self.streams[number].topic].append((stamp_ns, bytes(message)))

    def _send(self, stream, stamps_ns, rows):
        self.rows[stream.topic] += [(int(stamp_ns), row.tobytes())
                                    for stamp_ns, row in zip(stamps_ns, rows, strict=True)]


# ---------------------------------------------------------------------------------- scenarios

COMMON = {
    'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 2e-4,
    'imu.gyroscope_turn_on_bias': 0.01, 'imu.accelerometer_noise_density': 2e-2,
    'imu.accelerometer_random_walk': 3e-3, 'imu.accelerometer_turn_on_bias': 0.05,
    'markers.trace_length': 0.3, 'markers.trace_points': 12,
    'pose.rate': 333.0, 'imu.rate': 500.0, 'imu_data.rate': 77.7, 'ground_truth_imu.rate': 500.0}
MOUNTED = {'imu.lever_arm': (0.1, -0.2, 0.3), 'imu.rpy': (0.1, 0.2, 0.3),
           'imu.accelerometer_range': 40.0, 'imu.gyroscope_resolution': 1e-3}
SCENES = {
    'cusps': {},
    'a sensor elsewhere': {**scene_parameters('looping'), **MOUNTED},
    'near the separatrix': scene_parameters('near_separatrix'),
    'through a pole': {'initial.theta': 0.5, 'spin.l3': 0.2, 'spin.lz': 0.2},
    'beside a pole': {'initial.theta': 1e-7, 'spin.l3': 0.5, 'spin.lz': 0.5},
    'no torque': {'top.gravity': 0.0, 'spin.lz': 0.2, **MOUNTED},
    'sleeping': {'initial.theta': 0.0, 'spin.l3': 3.0},
    'steady precession': scene_parameters('steady_slow'),
    'spherical pendulum': scene_parameters('spherical_pendulum'),
    'planar rotation': scene_parameters('planar_pendulum'),
    'centre of mass below': {'top.com_distance': -0.15, 'initial.theta': 2.5,
                             'initial.theta_dot': 3.0, 'spin.l3': 0.3, 'spin.lz': -0.1},
    'fast': {'spin.l3': 40.0},
}
METHODS = ('rk45', 'exact')
scenes = pytest.mark.parametrize('scene', SCENES)
methods = pytest.mark.parametrize('method', METHODS)
DURATION_NS = 2_000_000_000
# Two commands and two changes of rates: time [ns], what, its arguments.
EVENTS = ((500_000_000, 'command', 1.1, 1.1), (900_000_001, 'rate', 'pose', 250.0),
          (900_000_001, 'rate', 'imu', 320.0), (1_400_000_003, 'command', 0.9, 0.85))


def events_of(scene):
    """Return the events; at the pole where it sleeps Lz must stay L3."""
    if scene == 'sleeping':
        return (*EVENTS[:3], (1_400_000_003, 'command', 0.9, 0.9))
    return EVENTS


def apply(simulation, what, first, second):
    if what == 'command':
        simulation.command(first * simulation.l3, second * simulation.lz)
    else:
        for stream in simulation.streams:
            if stream.parameter == first:
                stream.set_rate(second)


def record(scene, method, splits=(), topics=None, *, offline=False,
           between=lambda recording: None):
    """
    Return the recording of a run that is divided at its events and at `splits` [ns].

    between: called with the recording after each part
    """
    values = {**COMMON, **SCENES[scene], 'solver.method': method}
    simulation = Simulation(parameters.checked(values), EPOCH_NS)
    recording = Recording(simulation, topics)
    advance = recording.advance_offline if offline else recording.advance
    stops = [(t_ns, None) for t_ns in (*splits, DURATION_NS)]
    stops += [(event[0], event[1:]) for event in events_of(scene)]
    for t_ns, event in sorted(stops, key=lambda stop: stop[0]):
        if t_ns > simulation.now_ns:
            advance(t_ns)
        if event is not None:
            apply(simulation, *event)
        between(recording)
    assert len(simulation.history) == 2
    return recording


def random_splits(seed, count):
    """Return so many times, anywhere, on samples, and one nanosecond beside them."""
    dice = random.Random(seed)
    splits = []
    for _ in range(count):
        sample = dice.randrange(DURATION_NS // 2_000_000) * 2_000_000
        splits.append(dice.choice((dice.randrange(DURATION_NS), sample, sample + 1, sample - 1)))
    return sorted({split for split in splits if split > 0})


def assert_same_bytes(found, expected):
    """Name the first message that differs, and its numbers."""
    assert found.rows.keys() == expected.rows.keys()
    for stream in expected.streams:
        mine, other = found.rows[stream.topic], expected.rows[stream.topic]
        assert [stamp for stamp, _ in mine] == [stamp for stamp, _ in other], stream.topic
        for k, (one, two) in enumerate(zip(mine, other, strict=True)):
            assert one == two, (stream.topic, k, one[0] - EPOCH_NS, *(
                [run.tolist() for run in stream.template.decode(data)]
                for _, data in (one, two)))


# ---------------------------------------------------------------------------------------- live

@methods
@scenes
def test_any_division_of_a_run_gives_the_same_bytes(scene, method):
    whole = record(scene, method)
    counts = {topic: len(rows) for topic, rows in whole.rows.items()}
    assert counts['pose'] > 500 and counts['imu/data_raw'] > 700 and min(counts.values()) > 20
    for seed, count in enumerate((5, 300)):
        assert_same_bytes(record(scene, method, random_splits(seed, count)), whole)


@methods
@scenes
def test_what_is_computed_ahead_changes_no_byte(scene, method):
    """Blocks of any size, which commands and changes of rate make useless."""
    dice = random.Random(3)

    def compute_ahead(recording):
        for _ in range(dice.randrange(3)):
            recording.compute_ahead(dice.choice((1, 16, 200)))

    assert_same_bytes(record(scene, method, random_splits(3, 200), between=compute_ahead),
                      record(scene, method))


@methods
@scenes
def test_listeners_who_come_and_go_change_no_byte(scene, method):
    """What is recorded is the same, and what is published is that."""
    whole = record(scene, method)
    recorded = {topic: {data for _, data in rows} for topic, rows in whole.rows.items()}
    dice, published = random.Random(4), []

    def toggle(recording):
        for stream in recording.streams:
            if dice.random() < 0.2:
                stream.publish = None if stream.publish else (
                    lambda data, topic=stream.topic: published.append((topic, bytes(data))))

    assert_same_bytes(record(scene, method, random_splits(4, 100), between=toggle), whole)
    assert len(published) > 100
    assert all(data in recorded[topic] for topic, data in published)


@methods
@scenes
def test_a_run_is_the_same_whatever_else_is_recorded(scene, method):
    """Alone, a stream has its own blocks: those of several are cut where one of them is due."""
    whole = record(scene, method)
    for topic in ('pose', 'imu/data_raw', '~/invariants', 'markers'):
        alone = record(scene, method, topics=(topic,))
        assert alone.rows[topic] == whole.rows[topic], topic


# ------------------------------------------------------------------------------------- offline

@methods
@scenes
def test_a_run_offline_is_the_live_one(scene, method):
    live = record(scene, method)
    assert_same_bytes(record(scene, method, offline=True), live)
    assert_same_bytes(record(scene, method, random_splits(5, 40), offline=True), live)


# --------------------------------------------------------------------------------------- solve

TOP = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': 9.80665}


def motion(theta, theta_dot=0.0, *, l3, lz, phi=0.3, psi=-0.7, **top):
    return (Top(**{**TOP, **top}),
            State(theta=theta, theta_dot=theta_dot, phi=phi, psi=psi, l3=l3, lz=lz))


MOTIONS = {
    'loops': motion(0.6, 0.2, l3=1.6, lz=1.2),
    'cusps': motion(0.5, l3=1.6, lz=1.6 * np.cos(0.5)),
    'near the separatrix': motion(0.001, l3=0.5, lz=0.5),
    'through the top': motion(0.8, -9.0, l3=0.4, lz=0.4),
    'through the bottom': motion(2.6, 3.0, l3=0.4, lz=-0.4),
    'past a pole': motion(0.8, -9.0, l3=0.4, lz=0.4 + 1e-7),
    'no torque': motion(0.6, 1.5, l3=0.3, lz=0.1, gravity=0.0),
    'sleeping': motion(0.0, l3=1.6, lz=1.6),
    'spherical pendulum': motion(2.0, 0.4, l3=0.0, lz=0.3),
    'planar rotation': motion(1.0, -15.0, l3=0.0, lz=0.0),
    'centre of mass below': motion(2.0, 1.0, l3=0.3, lz=-0.1, com_distance=-0.15),
}
motions = pytest.mark.parametrize('name', MOTIONS)
OF_ANGLES = ('theta', 'theta_dot', 'phi', 'psi', 'angular_velocity', 'l3', 'lz')
OF_ATTITUDE = ('quaternion', 'theta_folded', 'phi_dot', 'psi_dot', 'angular_acceleration',
               'energy')
INSTANTS = 20_000


def some_times(seed, earliest):
    """Return a uniform grid, and times anywhere, some of them twice: sorted."""
    rng = np.random.default_rng(seed)
    t = np.concatenate((np.linspace(0.0, 20.0, INSTANTS // 2),
                        rng.uniform(earliest, 40.0, INSTANTS - INSTANTS // 2 - 100)))
    return np.sort(np.concatenate((t, rng.choice(t, 100))))


def column(solved, name):
    return np.ascontiguousarray(getattr(solved, name))


def assert_same_bits(found, expected, name):
    differs = found.view(np.int64) != expected.view(np.int64)
    assert not differs.any(), (
        f'{name}: {np.count_nonzero(differs.reshape(len(differs), -1).any(axis=1))} rows')


def divided(name, columns, seed):
    """Compare columns of blocks of 1 to 300 times, and of shuffled times, with those of all."""
    top, start = MOTIONS[name]
    rng = np.random.default_rng(seed)
    t = some_times(seed, -20.0)
    whole = solve(top, start, t)
    # Many of them so small that no vector instruction is used.
    sizes = rng.permutation(np.concatenate((rng.integers(1, 4, 150), rng.integers(1, 301, 131))))
    edges = np.cumsum(sizes)
    edges = edges[edges < INSTANTS]
    parts = [solve(top, start, part) for part in np.split(t, edges)]
    order = rng.permutation(INSTANTS)
    shuffled = solve(top, start, t[order])
    for each in columns:
        expected = column(whole, each)
        assert_same_bits(np.concatenate([column(part, each) for part in parts]), expected, each)
        assert_same_bits(column(shuffled, each), expected[order], each)


@motions
def test_exact_angles_and_rates_are_the_same_bits_in_any_blocks(name):
    divided(name, OF_ANGLES, seed=1)


@motions
def test_exact_attitudes_are_the_same_bits_in_any_blocks(name):
    divided(name, OF_ATTITUDE, seed=2)


def test_the_motion_near_the_separatrix_is_that():
    top, start = MOTIONS['near the separatrix']
    assert 0.0 < ExactSolution(top, start).m1 < 2e-4


@motions
def test_stepped_states_are_the_same_bits_however_many_follow(name):
    """A stepped motion begins at its start: its times are divided into those up to an instant."""
    top, start = MOTIONS[name]
    t = some_times(3, 0.0)
    whole = solve(top, start, t, method='rk45', rtol=1e-9)
    rng = np.random.default_rng(4)
    for count in (1, int(rng.integers(2, INSTANTS)), INSTANTS - 1):
        part = solve(top, start, t[:count], method='rk45', rtol=1e-9)
        for each in (*OF_ANGLES, *OF_ATTITUDE):
            assert_same_bits(column(part, each), column(whole, each)[:count], each)


@motions
def test_stepped_states_are_the_same_bits_whichever_are_left_out(name):
    """Also where few are asked for in a step, or none."""
    top, start = MOTIONS[name]
    t = some_times(5, 0.0)
    whole = solve(top, start, t, method='rk45', rtol=1e-9)
    for seed, share in ((6, 0.5), (7, 0.01)):
        kept = np.flatnonzero(np.random.default_rng(seed).random(INSTANTS) < share)
        part = solve(top, start, t[kept], method='rk45', rtol=1e-9)
        for each in (*OF_ANGLES, *OF_ATTITUDE):
            assert_same_bits(column(part, each), column(whole, each)[kept], each)
