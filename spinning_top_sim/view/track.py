# SPDX-License-Identifier: Apache-2.0
"""The published samples of one top, of a running node or of a log, by their stamps."""

import contextlib
import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import vertical_in_body
from spinning_top_sim.physics.regimes import Description, regime
from spinning_top_sim.physics.top import Shape, State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import all_streams
from spinning_top_sim.tools.analysis import SNAP, attitudes_of

Rows = NDArray[np.float64]
Stamps = NDArray[np.int64]

# Columns of each topic: attitude x, y, z, w; angular velocity in the body; phi' or specific force.
WIDTHS = {'pose': 4, 'joint_states': 8, 'ground_truth/odom': 8, 'ground_truth/imu': 10,
          '~/invariants': 8}
ATTITUDES = ('pose', 'joint_states', 'ground_truth/odom', 'ground_truth/imu')     # best first
RATES = ('joint_states', 'ground_truth/odom')
PRECESSION = 7              # column of RATES
ENERGY_DRIFT, ORIENTATION_ERROR = 3, 7     # columns of ~/invariants
SAME = 1e-6                 # relative difference of constants of one motion
MOST_MOTIONS = 99           # that are kept
LATEST_NS = 1 << 62


class Columns:
    """Rows of numbers (n, width) with ascending stamps (n,) [ns]."""

    def __init__(self, width: int) -> None:
        self._stamps_ns, self._rows = np.empty(256, np.int64), np.empty((256, width))
        self._begin = self._end = 0

    @property
    def stamps_ns(self) -> Stamps:
        return self._stamps_ns[self._begin:self._end]

    @property
    def rows(self) -> Rows:
        return self._rows[self._begin:self._end]

    def append(self, stamps_ns: Stamps, rows: Rows) -> None:
        """
        Append samples in the order of their stamps, the first of each stamp.

        Those that are not later than the newest one are left out.
        """
        stamps_ns, order = np.unique(stamps_ns, return_index=True)
        rows = rows[order]
        if self._end > self._begin:
            later = stamps_ns > self._stamps_ns[self._end - 1]
            stamps_ns, rows = stamps_ns[later], rows[later]
        end = self._end + len(stamps_ns)
        if end > len(self._stamps_ns):          # twice the room
            room = end - self._begin
            self._stamps_ns = np.concatenate((self.stamps_ns, np.empty(room, np.int64)))
            self._rows = np.concatenate((self.rows, np.empty((room, rows.shape[1]))))
            self._begin, self._end, end = 0, self._end - self._begin, room
        self._stamps_ns[self._end:end], self._rows[self._end:end] = stamps_ns, rows
        self._end = end

    def forget(self, before_ns: int) -> None:
        """Forget the samples before a stamp."""
        self._begin += int(np.searchsorted(self.stamps_ns, before_ns))

    def part(self, begin_ns: int, end_ns: int) -> tuple[Stamps, Rows]:
        """Return the samples from one stamp to another, both included."""
        begin = int(np.searchsorted(self.stamps_ns, begin_ns))
        end = int(np.searchsorted(self.stamps_ns, end_ns, 'right'))
        return self.stamps_ns[begin:end], self.rows[begin:end]

    def at(self, stamp_ns: int) -> tuple[int, Rows] | None:
        """Return the newest sample that is not later than a stamp, None if there is none."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns, 'right')) - 1
        return None if index < 0 else (int(self.stamps_ns[index]), self.rows[index])


@dataclasses.dataclass(frozen=True)
class Motion:
    """A motion in words and in its constants, from a stamp [ns] on."""

    begin_ns: int
    l3: float
    lz: float
    words: tuple[str, ...]
    theta_range: tuple[float, float] | None = None      # between which theta swings [rad]

    @classmethod
    def of(cls, begin_ns: int, state: State, description: Description | None) -> 'Motion':
        """Return the motion that a description tells of."""
        if description is None:
            return cls(begin_ns, state.l3, state.lz, ('beyond the closed form',))
        return cls(begin_ns, state.l3, state.lz, tuple(re.split('[;:] ', str(description))),
                   (description.theta_min, description.theta_max))


class Track:
    """
    The samples of a top.

    values : checked parameters of its run
    name : shown where there are several
    motions : in the order of their begin
    """

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        self.name, self.values = name, values
        self.top = parameters.top_of(values)
        self.shape = Shape(self.top)
        self.columns = {topic: Columns(width) for topic, width in WIDTHS.items()}
        self.motions: list[Motion] = []
        self._constants: tuple[float, float, float] | None = None   # of the newest motion
        self._imu = Imu(values)
        self._templates = {stream.topic: stream.template for stream in all_streams(values)
                           if stream.topic in WIDTHS}

    def add(self, topic: str, stamps_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Append serialized messages of a topic; those of another size are left out."""
        template = self._templates[topic]
        fitting = [k for k, message in enumerate(messages) if len(message) == len(template)]
        stamps = np.array([stamps_ns[k] for k in fitting], np.int64)
        fields = template.decode(b''.join(messages[k] for k in fitting))
        if topic == '~/invariants':
            self.columns[topic].append(stamps, fields[0])
            return
        found = attitudes_of(topic, self._imu, stamps, fields)
        assert found is not None
        rows = found.rows.T
        if topic in RATES and found.phi_dot is not None:
            rows = np.column_stack((rows[:, :7], found.phi_dot))
        if topic == 'ground_truth/imu':
            if len(rows) < len(stamps):         # an attitude of zeros
                return
            # With imu.sampling = mean, rates and force are means: near enough to be drawn.
            (_, rates), (_, force) = (self._imu.in_body(tuple(fields[0].T), tuple(field.T))
                                      for field in fields[1:3])
            rows = np.column_stack((rows[:, :4], *rates, *force))
        self.columns[topic].append(found.stamps_ns, rows)

    def forget(self, before_ns: int) -> None:
        """Forget the samples before a stamp."""
        for columns in self.columns.values():
            columns.forget(before_ns)

    @property
    def attitudes(self) -> Columns:
        """The topic that shows the attitude: its first four columns."""
        return next((self.columns[topic] for topic in ATTITUDES
                     if len(self.columns[topic].stamps_ns)), self.columns['pose'])

    @property
    def rates(self) -> Columns:
        """The topic that shows angular velocity and phi', with the attitude before them."""
        return next((self.columns[topic] for topic in RATES
                     if len(self.columns[topic].stamps_ns)), self.columns[RATES[0]])

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last stamp of the attitude [ns]; None without samples."""
        stamps_ns = self.attitudes.stamps_ns
        return (int(stamps_ns[0]), int(stamps_ns[-1])) if len(stamps_ns) else None

    def motion_at(self, stamp_ns: int) -> Motion | None:
        """Return the motion at a stamp; the first one before its begin."""
        begun = [motion for motion in self.motions if motion.begin_ns <= stamp_ns]
        return begun[-1] if begun else next(iter(self.motions), None)

    def follow(self) -> None:
        """Begin a new motion where the newest rates are of another than the last."""
        newest = self.rates.at(LATEST_NS)
        if newest is None:
            return
        stamp_ns, row = newest
        constants, state = state_of(self.top, row)
        if self._constants is not None and _same(self.top, constants, self._constants):
            return
        self._constants = constants
        with contextlib.suppress(ValueError):
            start = parameters.start_state(self.values)
            first = ExactSolution(self.top, start).states(range(1))
            if _same(self.top, constants, (float(first.energy[0]), start.l3, start.lz)):
                state = start           # without the rounding of a sample
        self.motions = [*self.motions[-MOST_MOTIONS:], _described(self.top, state, stamp_ns)]


def state_of(top: Top, row: Rows) -> tuple[tuple[float, float, float], State]:
    """Return energy, L3 and Lz of a row of RATES, and its state but for phi and psi."""
    x, y, z, w, one, two, spin = row[:7].tolist()
    cos2, sin2 = w * w + z * z, x * x + y * y
    up_1, up_2, up_3 = map(float, vertical_in_body(tuple(row[:4])))
    l3 = top.lambda3 * spin
    lz = top.lambda1 * (one * up_1 + two * up_2) + l3 * up_3
    energy = (0.5 * top.lambda1 * (one * one + two * two) + 0.5 * l3 * spin
              + top.gravity_torque * up_3)
    # Next to a special motion: that motion.
    dust = SNAP * max(abs(l3), abs(lz), _natural_momentum(top))
    start_l3, start_lz = (0.0 if abs(value) < dust else value for value in (l3, lz))
    start_lz = next((pole for pole in (start_l3, -start_l3) if abs(start_lz - pole) < dust),
                    start_lz)
    sine, theta = math.hypot(up_1, up_2), 2.0 * math.atan2(math.sqrt(sin2), math.sqrt(cos2))
    if sine >= SNAP:
        theta_dot = (up_2 * one - up_1 * two) / sine
    else:       # there, whatever turns the axis is nutation
        across = math.hypot(one, two)
        theta_dot = across if top.lambda1 * across > dust else 0.0
        theta, start_lz = (0.0, start_l3) if theta < 1.0 else (math.pi, -start_l3)
    return (energy, l3, lz), State(theta=theta, theta_dot=theta_dot, l3=start_l3, lz=start_lz)


def _natural_momentum(top: Top) -> float:
    return math.sqrt(top.lambda1 * abs(top.gravity_torque))


def _same(top: Top, one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether energy, L3 and Lz are those of one motion, but for rounding."""
    natural = _natural_momentum(top)
    return all(abs(a - b) <= SAME * max(abs(a), abs(b), least) for a, b, least in zip(
        one, other, (abs(top.gravity_torque), natural, natural), strict=True))


def _described(top: Top, state: State, begin_ns: int) -> Motion:
    description = None
    with contextlib.suppress(ArithmeticError, ValueError):
        description = dataclasses.replace(
            ExactSolution(top, state).describe(), name=regime(top, state, SNAP))
    return Motion.of(begin_ns, state, description)
