# SPDX-License-Identifier: Apache-2.0
"""The published samples of one top, from a running node or from a log."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import Description, natural_momentum
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.shape import Shape
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import INVARIANTS, all_channels
from spinning_top_sim.times import period_ns
from spinning_top_sim.tools.analysis import attitudes_of

# The topics that tell the attitude, the best first; those that tell its rates, and the pivot.
ATTITUDE_TOPICS = ('pose', 'joint_states', 'ground_truth/odom', 'ground_truth/imu')
RATE_TOPICS = ('joint_states', 'ground_truth/odom')
PLACE_TOPICS = ('pose', 'ground_truth/odom')
# Which field of a message is a quaternion.
QUATERNION_FIELDS = {'pose': 1, 'ground_truth/odom': 1, 'ground_truth/imu': 0}
# Their columns, NaN where a topic has none: x, y, z, w; the angular velocity and the specific
# force in the body; phi'; the place of the pivot.
QUATERNION, RATES, FORCE, PRECESSION, PLACE = (
    slice(0, 4), slice(4, 7), slice(7, 10), 10, slice(11, 14))
WIDTHS = {**dict.fromkeys(ATTITUDE_TOPICS, 14), '~/invariants': len(INVARIANTS)}
SNAP = 1e-9                 # relative distance within which a motion is taken for a special one
SAME = 1e-6                 # relative difference between the constants of one motion
MOST_MOTIONS = 99           # that are kept
Rows = NDArray[np.float64]


class Series(NamedTuple):
    """Ascending stamps (n,) [ns] and one row of numbers for each (n, width)."""

    stamps_ns: NDArray[np.int64]
    rows: Rows

    def part(self, begin_ns: int, end_ns: int) -> 'Series':
        """Return the samples from one stamp to another, both included."""
        begin = int(np.searchsorted(self.stamps_ns, begin_ns))
        end = int(np.searchsorted(self.stamps_ns, end_ns, 'right'))
        return Series(self.stamps_ns[begin:end], self.rows[begin:end])

    def at(self, stamp_ns: int) -> tuple[int, Rows] | None:
        """Return stamp and row of the newest sample up to a stamp, None if there is none."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns, 'right')) - 1
        return None if index < 0 else (int(self.stamps_ns[index]), self.rows[index])

    def thinned(self, most: int) -> 'Series':
        """Return at most so many evenly chosen samples, with the last one."""
        stride = max(1, -(-len(self.rows) // most))
        first = (len(self.rows) - 1) % stride
        return Series(self.stamps_ns[first::stride], self.rows[first::stride])


def joined(parts: Sequence[Series]) -> Series:
    """Return all samples in the order of their stamps, the first of each stamp."""
    stamps_ns, order = np.unique(np.concatenate([part.stamps_ns for part in parts]),
                                 return_index=True)
    return Series(stamps_ns, np.concatenate([part.rows for part in parts])[order])


def empty(topic: str) -> Series:
    """Return no samples of a topic."""
    return Series(np.empty(0, np.int64), np.empty((0, WIDTHS[topic])))


def attitude_rows(quaternion: Rows, rates: Rows | float = np.nan,
                  precession: Rows | float = np.nan, place: Rows | float = np.nan) -> Rows:
    """Return rows with these columns, each (n, k)."""
    rows = np.full((len(quaternion), WIDTHS['pose']), np.nan)
    rows[:, QUATERNION], rows[:, RATES] = quaternion, rates
    rows[:, PRECESSION], rows[:, PLACE] = precession, place
    return rows


@dataclasses.dataclass(frozen=True)
class DescribedMotion:
    """
    A motion from a stamp [ns] on.

    l3, lz, energy : constants [kg m^2/s], and the energy lambda1 theta'^2/2 + V(theta) [J]
    description : None if it has no closed form
    pivot_moves : whether the pivot moves: then Lz and the energy are not constant
    """

    begin_ns: int
    l3: float
    lz: float
    energy: float
    description: Description | None
    pivot_moves: bool = False

    @classmethod
    def of(cls, begin_ns: int, top: Top, state: State,
           description: Description | None, *, pivot_moves: bool = False) -> 'DescribedMotion':
        """Return the motion that begins in a state."""
        height = effective_potential(top, state.l3, state.lz, np.array([state.theta]))
        energy = 0.5 * top.lambda1 * state.theta_dot ** 2 + float(height[0])
        return cls(begin_ns, state.l3, state.lz, energy, description, pivot_moves)


class Track:
    """
    The samples of a top.

    name : shown if there are several tracks
    values : checked parameters of the run
    has_body : whether they are those of the body; in the logs of other programs they are not
    templates, samples : of the messages, by topic
    motions : in the order of their begin
    begin_ns : of a log, the stamp from which on this is the top [ns]
    epoch_ns, commands_ns : of a log, stamps of t = 0 and of its commands [ns]
    note : what is missing in a log, '' if nothing is

    One thread changes it and draws it.
    """

    def __init__(self, name: str, values: Mapping[str, Any], has_body: bool = True) -> None:
        self.name, self.values, self.has_body = name, values, has_body
        self.top = parameters.top_of(values)
        self.shape = Shape(self.top)
        self.samples = {topic: empty(topic) for topic in WIDTHS}
        self.motions: list[DescribedMotion] = []
        self.begin_ns, self.epoch_ns, self.commands_ns = 0, 0, list[int]()
        self.note = ''
        self._constants: tuple[float, float, float] | None = None   # of the newest motion
        self._imu = Imu(values, period_ns(values['imu.rate']))
        self.templates = {channel.topic: channel.template for channel in all_channels(
            values, self._imu) if channel.topic in WIDTHS}

    def decode(self, topic: str, messages: Sequence[bytes],
               stamps_ns: Sequence[int] | None = None) -> Series:
        """
        Return serialized messages of a topic as samples; by default with the stamps in them.

        Those whose quaternion is no attitude are left out.
        """
        template, data = self.templates[topic], b''.join(messages)
        stamps = template.stamps_ns(data) if stamps_ns is None else np.array(stamps_ns, np.int64)
        fields = template.decode(data)
        if topic == '~/invariants':
            return Series(stamps, fields[0])
        if topic in QUATERNION_FIELDS:
            norm = np.linalg.norm(fields[QUATERNION_FIELDS[topic]], axis=1)
            valid = np.isfinite(norm) & (norm > 0.0)
            stamps, fields = stamps[valid], tuple(field[valid] for field in fields)
        found = attitudes_of(topic, self._imu, stamps, fields)
        assert found is not None
        rows = attitude_rows(found.rows[:4].T)
        if topic in RATE_TOPICS:
            assert found.omega is not None and found.phi_dot is not None
            rows[:, RATES], rows[:, PRECESSION] = np.transpose(found.omega), found.phi_dot
        if topic == 'ground_truth/imu':
            # With imu.sampling = mean these are means, which are near enough for a picture.
            for columns, field in ((RATES, fields[1]), (FORCE, fields[2])):
                _, in_body = self._imu.mounting.to_body(tuple(fields[0].T), tuple(field.T))
                rows[:, columns] = np.vstack(in_body).T
        if topic in PLACE_TOPICS:
            rows[:, PLACE] = np.nan_to_num(fields[0])
        return Series(found.stamps_ns, rows)

    def add(self, topic: str, samples: Series) -> None:
        """Add samples of a topic."""
        self.samples[topic] = joined([self.samples[topic], samples])

    def drop_before(self, before_ns: int) -> None:
        """Drop the samples before a stamp."""
        self.samples = {topic: samples.part(before_ns, np.iinfo(np.int64).max)
                        for topic, samples in self.samples.items()}

    @property
    def attitudes(self) -> Series:
        """The samples that show the attitude."""
        return self.first_of(ATTITUDE_TOPICS)

    @property
    def rates(self) -> Series:
        """The samples that show attitude, angular velocity and phi'."""
        return self.first_of(RATE_TOPICS)

    def places(self, stamps_ns: NDArray[np.int64]) -> Rows:
        """Return where the pivot is at stamps (n,), (n, 3) [m]; the origin where not known."""
        known_ns, rows = self.first_of(PLACE_TOPICS)
        if not len(rows):
            return np.zeros((len(stamps_ns), 3))
        return np.stack([np.interp(stamps_ns - known_ns[0], known_ns - known_ns[0], column)
                         for column in rows[:, PLACE].T], axis=-1)

    @property
    def pivot_moves(self) -> bool:
        """Whether the pivot has moved between the last two samples."""
        return bool(np.diff(self.first_of(PLACE_TOPICS).rows[-2:, PLACE], axis=0).any())

    def first_of(self, topics: Sequence[str]) -> Series:
        """Return the samples of the first of these topics that has some."""
        return next((self.samples[topic] for topic in topics
                     if len(self.samples[topic].stamps_ns)), self.samples[topics[0]])

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last stamp of the attitude [ns], if there are samples."""
        stamps_ns = self.attitudes.stamps_ns
        return int(stamps_ns[0]), int(stamps_ns[-1])

    def motion_at(self, stamp_ns: int) -> DescribedMotion | None:
        """Return the motion at a stamp, or the first motion if the stamp is earlier."""
        begun = [motion for motion in self.motions if motion.begin_ns <= stamp_ns]
        return begun[-1] if begun else next(iter(self.motions), None)

    def detect_motion(self) -> None:
        """Begin a new motion if the newest sample has other constants than the last motion."""
        stamps_ns, rows = self.rates
        if not len(rows):
            return
        constants, state = constants_and_state(self.top, rows[-1])
        if pivot_moves := self.pivot_moves:     # L3 alone is constant
            constants = 0.0, constants[1], 0.0
        if self._constants is not None and _same(self.top, constants, self._constants):
            return
        self._constants = constants
        description = None
        with contextlib.suppress(ArithmeticError, ValueError):
            if not pivot_moves:
                description = ExactSolution(self.top, state).describe(SNAP)
        self.motions = [*self.motions[-MOST_MOTIONS:], DescribedMotion.of(
            int(stamps_ns[-1]), self.top, state, description, pivot_moves=pivot_moves)]


def constants_and_state(top: Top, row: Rows) -> tuple[tuple[float, float, float], State]:
    """
    Return energy, L3 and Lz of a row of `Track.rates`, and its state.

    A state within rounding errors of a special motion becomes that motion.
    """
    quaternion, omega = row[QUATERNION], row[RATES]
    state = state_of(top, quaternion, np.array(
        attitude.rotated(tuple(quaternion), tuple(omega))))
    energy = float(np.sum(energies(top, row[np.newaxis])))
    dust = SNAP * max(abs(state.l3), abs(state.lz), natural_momentum(top))
    l3, lz = (0.0 if abs(value) < dust else value for value in (state.l3, state.lz))
    lz = next((pole for pole in (l3, -l3) if abs(lz - pole) < dust), lz)
    theta_dot = state.theta_dot if top.lambda1 * abs(state.theta_dot) > dust else 0.0
    return (energy, state.l3, state.lz), State(theta=state.theta, theta_dot=theta_dot, l3=l3,
                                               lz=lz)


def effective_potential(top: Top, l3: float, lz: float, theta: Rows) -> Rows:
    """
    Return V(theta) [J] of lambda1 theta'^2/2 + V(theta) = E - L3^2/(2 lambda3); theta: (n,).

    It is (Lz - L3 cos theta)^2/(2 lambda1 sin^2 theta) + P cos(theta).
    """
    phi_dot = attitude.precession_rate(top, l3, lz, np.cos(0.5 * theta) ** 2,
                                       np.sin(0.5 * theta) ** 2)
    return (0.5 * top.lambda1 * (phi_dot * np.sin(theta)) ** 2
            + top.gravity_torque * np.cos(theta))


def energies(top: Top, rows: Rows) -> tuple[Rows, Rows]:
    """Return kinetic and potential energy (n,) [J] of rows with attitude and angular velocity."""
    moments = np.array((top.lambda1, top.lambda1, top.lambda3))
    x, y, z, w = rows[:, QUATERNION].T
    return (0.5 * rows[:, RATES] ** 2 @ moments,
            top.gravity_torque * attitude.axis_in_world((x, y, z, w))[2])


def _same(top: Top, one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether two sets of energy, L3 and Lz are equal but for rounding."""
    natural = natural_momentum(top)
    return all(abs(a - b) <= SAME * max(abs(a), abs(b), least) for a, b, least in zip(
        one, other, (abs(top.gravity_torque), natural, natural), strict=True))
