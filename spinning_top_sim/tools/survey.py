# SPDX-License-Identifier: Apache-2.0
"""
Finds out what is in a log, how accurate that is, and what its samples measure.

The public attributes of `Survey` and `Motion` are the keys of `inspect --json`, but for the
`states`; docs/logs.md says what they are.
"""

from __future__ import annotations

import itertools
import math
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.states import States, relative_drift
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.reader import BLOCK, LogMessage, LogReader
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, Times
from spinning_top_sim.tools import recorded_run

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

MOST_MOTIONS = 1000         # that are compared with the exact one: 20 ms each
# Streams that a motion can be measured from, the most accurate first.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation; a higher rate adds no accuracy
# Degree of the splines through the samples, and the number of samples in one.  In its middle, with
# 10 samples in a period, the error is 1e-13 of the amplitude.
DEGREE, WINDOW = 15, 64
LEAST_SAMPLES = 9.0         # in a nutation, for a spline as good as the data
RESTS = 1e-9                # a tilt that changes less does not nutate: rounding decides [rad]
LARGEST_STEP = 2.5          # between two samples of an angle that can be unwrapped [rad]
# Of samples: q(world <- body) as x, y, z, w; angular velocity in the body frame [rad/s]; phi and
# psi, which count turns [rad].  NaN: not known.
QUATERNION, RATES, TURNS, WIDTH = slice(0, 4), slice(4, 7), slice(7, 9), 9


class SampledStates(States):
    """States by samples (WIDTH, n); what follows from a rate that is not known is NaN."""

    method = 'samples'

    def __init__(self, top: Top, t: Column, rows: NDArray[np.float64]) -> None:
        super().__init__(top, State(theta=0.0, l3=0.0, lz=0.0), len(t))
        (x, y, z, w), (w1, w2, w3), self.turns = rows[QUATERNION], rows[RATES], rows[TURNS]
        self.t, self.rows_quaternion, self.transverse_velocity = t, (x, y, z, w), (w1, w2)
        self._constant_l3 = self.l3 = top.lambda3 * w3
        up_1, up_2, height = self.rows_vertical
        across = w1 * up_1 + w2 * up_2
        self.lz = top.lambda1 * across + self.l3 * height
        with np.errstate(divide='ignore', invalid='ignore'):        # at a pole
            self.phi_dot = across / (up_1 ** 2 + up_2 ** 2)


def attitudes_of(name: str, imu: Imu, stamps_ns: Times, fields: tuple[NDArray[np.float64], ...],
                 ) -> tuple[Times, NDArray[np.float64]]:
    """Return stamps (n,) and samples (WIDTH, n) in the decoded fields of a stream."""
    parts = [field.T for field in fields]
    rows = np.full((WIDTH, len(stamps_ns)), np.nan)
    if name == 'ground_truth/imu':
        rows[QUATERNION], rates = imu.mounting.to_body(tuple(parts[0]), tuple(parts[1]))
        if not imu.takes_means:         # else the rates are not those at the stamps
            rows[RATES] = rates
    elif name == 'joint_states':
        (phi, theta, psi), (phi_dot, theta_dot, psi_dot) = parts
        rows[QUATERNION] = attitude.quaternion_of_angles(phi, theta, psi)
        rows[RATES] = (*attitude.transverse(theta_dot, phi_dot * np.sin(theta), np.cos(psi),
                                            np.sin(psi)), psi_dot + phi_dot * np.cos(theta))
        rows[TURNS] = phi, psi
    else:           # position, attitude, and of ground_truth/odom velocity, rates
        rows[QUATERNION] = parts[1]
        rows[RATES] = parts[3] if len(parts) > 2 else np.nan
    norm = np.linalg.norm(rows[QUATERNION], axis=0)
    valid = np.isfinite(norm) & (norm > 0.0)
    return stamps_ns[valid], rows[:, valid]


class Motion:
    """A motion of the top, from where a simulation is up to a log time."""

    def __init__(self, cause: str, simulation: Simulation, topics: Mapping[str, str],
                 end_ns: int) -> None:
        self.cause, self.begin_ns = cause, simulation.epoch_ns + simulation.sent_ns
        self.end_ns = max(self.begin_ns, end_ns)
        self._piece = piece = simulation.trajectory.after(simulation.now_ns)
        self._imu, self._epoch_ns = simulation.imu, simulation.epoch_ns
        self.l3, self.lz, self.energy = piece.l3, piece.lz, piece.energy
        self.exact = piece.describe()
        # The source has the most samples in a nutation, up to those that suffice.
        period_ns = ((self.exact and self.exact.nutation_period) or math.inf) * NANOSECONDS
        self._channel = max(
            (channel for name in SOURCES for channel in simulation.channels
             if channel.topic == name and name in topics), default=None,
            key=lambda channel: min(period_ns / channel.period_ns, ENOUGH_SAMPLES))
        self.source = topics[self._channel.topic] if self._channel else None
        self.measured: dict[str, Any] | None = None
        self.drifts: dict[str, float] = {}
        self.orientation_error: float | None = None
        self.states: SampledStates | None = None

    def measure(self, messages: Iterator[LogMessage], log_ns: int) -> None:
        """Compare its samples with the motion; `states` are all of them, since a log time."""
        assert self._channel is not None
        piece, template, parts = self._piece, self._channel.template, []
        while group := [*itertools.islice(messages, BLOCK)]:
            fitting = [one for one in group if len(one.data) == len(template)
                       and one.log_time > self.begin_ns]
            parts.append(attitudes_of(
                self._channel.topic, self._imu, np.array([one.log_time for one in fitting]),
                template.decode(b''.join(one.data for one in fitting))))
        if sum(len(stamps_ns) for stamps_ns, _ in parts) < 2:
            return
        stamps_ns, rows = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        if not piece.rests:
            rows[TURNS] = np.nan        # they jump by whole turns
        self.states = states = SampledStates(piece.top, 1e-9 * (stamps_ns - log_ns), rows)
        if piece.rests and not np.isnan(states.l3).all():   # else it has other constants
            self.drifts = {name: _largest(relative_drift(
                getattr(states, name), getattr(piece, name))) for name in ('energy', 'l3', 'lz')}
        if self.exact is not None and piece.exact:
            # Log times of the run; those of a log that was changed may lie anywhere.
            truth = piece.exact.states(np.minimum(stamps_ns - self._epoch_ns, LAST_STAMP_NS))
            self.orientation_error = _largest(attitude.angle_between(
                states.rows_quaternion, truth.rows_quaternion))
        if not np.ptp(np.diff(stamps_ns)):      # else it has gaps
            self.measured = measure(states, self.exact.nutation_period if self.exact else None)


class Survey:
    """The findings about a log, and about its run if it has one.  Raises LogError."""

    def __init__(self, reader: LogReader, run: recorded_run.RunDescription | None,
                 notes: list[str]) -> None:
        self.file, self.whole = str(reader.path), reader.whole
        self.damage: dict[str, Any] = {
            'torn': reader.torn, 'lost_bytes': reader.lost_bytes, 'changed': reader.changed,
            'report': reader.damage}
        self.begin_ns, self.end_ns = reader.span
        self.topics = _topics(reader)
        self.run, self.notes, self.motions = run, notes, list[Motion]()
        self.verify: recorded_run.Comparison | None = None
        if run is not None:
            with np.errstate(all='ignore'):         # a log may hold any numbers
                self._follow(run)
                self._measure(reader)

    def _follow(self, run: recorded_run.RunDescription) -> None:
        """Compute the motions of a run."""
        motions, epoch_ns = self.motions, run.epoch_ns
        try:
            for simulation, done in recorded_run.rerun(run):
                # The velocities of the pivot belong to one motion.
                if isinstance(done, Block) or done.event.kind == 'parameters' or (
                        done.event.kind == 'drive' and motions[-1].cause == 'drive'):
                    continue
                if motions:
                    motions[-1].end_ns = epoch_ns + done.event.sent_ns
                if len(motions) == MOST_MOTIONS:
                    raise ValueError(f'over {MOST_MOTIONS} motions')
                epoch_ns = simulation.epoch_ns
                motions.append(Motion(done.event.kind, simulation, run.topics, self.end_ns))
        except MALFORMED as error:
            self.notes.append(f'the run cannot be followed beyond here: {reason_of(error)}')

    def _measure(self, reader: LogReader) -> None:
        """Measure the motions; a source is read once for all of them."""
        ends_ns = [motion.end_ns for motion in self.motions]
        for source in dict.fromkeys(one.source for one in self.motions if one.source):
            for at, messages in itertools.groupby(reader.messages([source], 0, ends_ns[-1] + 1),
                                                  lambda one: bisect_left(ends_ns, one.log_time)):
                try:
                    if self.motions[at].source == source:
                        self.motions[at].measure(messages, self.begin_ns)
                except MALFORMED as error:
                    self.notes.append(f'{source} cannot be measured: {reason_of(error)}')


def _topics(reader: LogReader) -> dict[str, dict[str, Any]]:
    stamps_ns, found = {topic.name: array('Q') for topic in reader.topics}, {}
    for name, messages in reader.groups():
        stamps_ns[name].extend(one.log_time for one in messages)
    for topic in reader.topics:
        times_ns = stamps_ns[topic.name]
        steps = np.diff(times_ns)
        at = int(np.argmax(steps)) if len(steps) else 0
        found[topic.name] = {
            'type': topic.type_name, 'count': len(times_ns),
            'rate': len(steps) / steps.sum() * NANOSECONDS if steps.any() else None,
            'longest_gap_ns': list(times_ns[at:at + 2]) if len(steps) else None}
    return found


def measure(states: SampledStates, expected: float | None = None) -> dict[str, Any]:
    """
    Return what `inspect --json` has of a motion in two or more samples at one rate.

    expected : period of its nutation [s]: too few samples show a slower one

    A nutation lasts from one rise of the tip through its middle height to the next.  The tip is
    fastest there, and far from the poles, where phi may jump.
    """
    samples, step = len(states), float(states.t[-1] - states.t[0]) / (len(states) - 1)
    rises, edges, period, missing = 0, np.array([0.0, samples - 1.0]), None, ''
    if np.ptp(states.theta_folded) >= RESTS:
        rises, edges = _rises(*states.half_angle_squares)
        period = float(np.ptp(edges)) / rises * step if rises else None
        if not rises or min(period or math.inf, expected or math.inf) < LEAST_SAMPLES * step:
            period, missing = None, f'no nutation, or fewer than {LEAST_SAMPLES:g} samples in one'
    (x, y, _), (up_1, up_2, _) = states.rows_axis, states.rows_vertical
    rates = [None if missing else _mean_rate(turns, tip, edges, step) for turns, tip in zip(
        states.turns, (x + 1j * y, -up_1 + 1j * up_2), strict=True)]
    if not missing and None in rates:
        missing = 'phi or psi cannot be unwrapped: a pole, or too few samples in a turn'
    return {'samples': samples, 'nutations': rises, 'nutation_period': period,
            'mean_precession_rate': rates[0], 'mean_spin_rate': rates[1], 'missing': missing}


def _spline(values: NDArray[np.generic], index: float) -> BSpline:
    """Return a spline through the values (n,) around an index, as a function of the index."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415 - slow; --help needs none

    begin = max(0, min(int(index) - WINDOW // 2, len(values) - WINDOW))
    part = values[begin:begin + WINDOW]
    return make_interp_spline(np.arange(begin, begin + len(part)), part,
                              k=min(DEGREE, len(part) - 1))


def _rises(cos2: Column, sin2: Column) -> tuple[int, NDArray[np.float64]]:
    """Return the number of whole nutations, and the two indices between which they are."""
    from scipy.optimize import brentq  # noqa: PLC0415

    # Both rise with the axis; the smaller one has the digits of a small angle.
    values = -sin2 if np.mean(sin2) < 0.5 else cos2
    values = values - 0.5 * (float(np.min(values)) + float(np.max(values)))
    rising = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    edges = [brentq(_spline(values, index), index, index + 1.0, xtol=1e-15, rtol=1e-15)
             for index in rising[[0, -1]]] if len(rising) > 1 else [0.0, 1.0]
    return max(0, len(rising) - 1), np.array(edges)


def _mean_rate(turns: Column, tip: NDArray[np.complex128], edges: NDArray[np.float64],
               step: float) -> float | None:
    """Return the mean rate of phi or psi [rad/s] between two indices, None if unknown."""
    angle = turns
    if np.isnan(turns).any():
        angle = np.unwrap(np.angle(tip))
        if not tip.all() or np.max(np.abs(np.diff(angle))) > LARGEST_STEP:
            return None
    # The tip is smooth where the angle jumps at a pole, and slow without its mean rate.
    rate = (angle[-1] - angle[0]) / (len(angle) - 1)
    slow, here = tip * np.exp(-1j * rate * np.arange(len(angle))), np.rint(edges).astype(int)
    tips = np.array([_spline(slow, index)(index) for index in edges])
    turned = angle[here] + rate * (edges - here) + np.angle(tips * np.conj(slow[here]))
    return float((turned[1] - turned[0]) / (np.ptp(edges) * step))


def _largest(values: NDArray[np.float64]) -> float:
    """Return the largest absolute value of those that are finite, 0 without any."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
