# SPDX-License-Identifier: Apache-2.0
"""A top as published samples show it, from a running node or from a log."""

import contextlib
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.pivot import Kinematics
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.vertical import state_of
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.channel import period_ns
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import all_channels
from spinning_top_sim.tools.analysis import RATES, attitudes_of
from spinning_top_sim.view.source import Motion, Reals, Times, Track

# The topics that tell the attitude, the one that tells most first.
TOPICS = ('ground_truth/odom', 'joint_states', 'pose', 'ground_truth/imu')
# Columns of a sample: q(world <- body) as x, y, z, w, the angular velocity in the body, the place
# of the pivot.  NaN: not known.
QUATERNION, OMEGA, PLACE = slice(0, 4), slice(4, 7), slice(7, 10)
WIDTH = 10
SNAP = 1e-9                 # relative distance within which a motion is taken for a special one
SAME = 1e-6                 # relative difference between the constants of one motion
MOST_MOTIONS = 99           # that are kept


class SampledStates(States):
    """States by samples.  What follows from a rate or a force that is not known is NaN."""

    method = 'samples'

    def __init__(self, top: Top, t: Reals, rows: Reals, *, rests: bool) -> None:
        w1, w2, w3 = rows[:, OMEGA].T
        super().__init__(top, State(theta=0.0, l3=0.0, lz=0.0), len(t))
        x, y, z, w = rows[:, QUATERNION].T
        self.t, self.rows_quaternion, self.transverse_velocity = t, (x, y, z, w), (w1, w2)
        self._l3 = top.lambda3 * w3
        unknown = np.zeros_like(rows[:, PLACE].T) + (0.0 if rests else np.nan)
        self.pivot = Kinematics(np.nan_to_num(rows[:, PLACE].T), unknown, unknown)
        up_1, up_2, height = self.rows_vertical
        across = w1 * up_1 + w2 * up_2
        self.lz = top.lambda1 * across + self._l3 * height
        with np.errstate(divide='ignore', invalid='ignore'):        # at a pole
            self.phi_dot = across / (up_1 ** 2 + up_2 ** 2)
        if not rests:
            self._support = (unknown[0], unknown[1], unknown[2])


class SampledTrack(Track):
    """
    The samples of a top.

    begin_ns : of a log, the time from which on this is the top
    motions : times at which motions begin, and these
    note : what is missing in a log, '' if nothing is
    """

    def __init__(self, name: str, values: Mapping[str, Any], **about: Any) -> None:
        super().__init__(name, values, **about)
        self.stamps_ns, self.rows = np.empty(0, np.int64), np.empty((0, WIDTH))
        self.motions: list[tuple[int, Motion]] = []
        self.begin_ns, self.note = 0, ''
        self._constants: tuple[float, ...] | None = None        # of the newest motion
        self._imu = Imu(values, period_ns(values['imu.rate']))
        self.templates = {channel.topic: channel.template for channel in all_channels(
            values, self._imu) if channel.topic in TOPICS}

    def times(self, begin_ns: int, end_ns: int) -> Times:
        begin, end = np.searchsorted(self.stamps_ns, [begin_ns + self.epoch_ns,
                                                      end_ns + self.epoch_ns + 1])
        return self.stamps_ns[begin:end] - self.epoch_ns

    def newest(self, t_ns: int) -> int | None:
        index = int(np.searchsorted(self.stamps_ns, t_ns + self.epoch_ns, 'right')) - 1
        return None if index < 0 else int(self.stamps_ns[index]) - self.epoch_ns

    def at(self, times: Times) -> SampledStates:
        rows = self.rows[np.searchsorted(self.stamps_ns, times + self.epoch_ns)]
        motion = self.motion_at(int(times[-1])) if len(times) else None
        return SampledStates(self.top, times / NANOSECONDS, rows,
                             rests=motion is None or not motion.pivot_moves)

    def motion_at(self, t_ns: int) -> Motion | None:
        """Return the motion at a time, or the first motion if the time is earlier."""
        begun = bisect_right(self.motions, t_ns, key=lambda one: one[0])
        return self.motions[max(begun - 1, 0)][1] if self.motions else None

    @property
    def span(self) -> tuple[int, int]:
        """The times of the first and the last sample, if there are samples."""
        return int(self.stamps_ns[0]) - self.epoch_ns, int(self.stamps_ns[-1]) - self.epoch_ns

    def add(self, stamps_ns: NDArray[np.int64], rows: Reals) -> None:
        """Add samples with stamps (n,) [ns] in any order; of equal stamps the first is kept."""
        self.stamps_ns, order = np.unique(np.concatenate((self.stamps_ns, stamps_ns)),
                                          return_index=True)
        self.rows = np.concatenate((self.rows, rows))[order]

    def add_messages(self, topic: str, messages: Sequence[bytes],
                     stamps_ns: Sequence[int] | None = None) -> None:
        """
        Add serialized messages of one of TOPICS; by default with the stamps in them.

        Those whose quaternion is no attitude are left out.
        """
        template, data = self.templates[topic], b''.join(messages)
        stamps = template.stamps_ns(data) if stamps_ns is None else np.array(stamps_ns, np.int64)
        fields = template.decode(data)
        found = attitudes_of(topic, self._imu, stamps, fields)
        assert found is not None
        rows = np.full((len(found.stamps_ns), WIDTH), np.nan)
        rows[:, QUATERNION] = found.rows[:4].T
        if found.omega is not None:
            rows[:, OMEGA] = found.rows[RATES].T
        if topic in ('pose', 'ground_truth/odom'):
            rows[:, PLACE] = fields[0][np.isin(stamps, found.stamps_ns)]
        self.add(found.stamps_ns, rows)

    def drop_before(self, stamp_ns: int) -> None:
        """Drop the samples before a stamp [ns]."""
        kept = self.stamps_ns >= stamp_ns
        self.stamps_ns, self.rows = self.stamps_ns[kept], self.rows[kept]

    def detect_motion(self) -> None:
        """Begin a new motion if the newest sample has other constants than the last motion."""
        if np.isnan(self.rows[-1, OMEGA]).any():
            return
        constants, state = constants_and_state(self.top, self.rows[-1])
        moves = bool(np.diff(self.rows[-2:, PLACE], axis=0).any())
        if moves:           # L3 alone is constant
            constants = 0.0, constants[1], 0.0
        natural = natural_momentum(self.top)
        if self._constants is not None and all(
                abs(a - b) <= SAME * max(abs(a), abs(b), least) for a, b, least in zip(
                    constants, self._constants,
                    (abs(self.top.gravity_torque), natural, natural), strict=True)):
            return
        self._constants, description = constants, None
        with contextlib.suppress(ArithmeticError, ValueError):
            if not moves:
                description = ExactSolution(self.top, state).describe(SNAP)
        self.motions = [*self.motions[-MOST_MOTIONS:], (self.span[1], Motion.of(
            self.top, state, description, pivot_moves=moves))]


def constants_and_state(top: Top, row: Reals) -> tuple[tuple[float, float, float], State]:
    """
    Return energy, L3 and Lz of a sample, and its state.

    A state within rounding errors of a special motion becomes that motion.
    """
    states = SampledStates(top, np.zeros(1), row[np.newaxis], rests=True)
    state = state_of(top, row[QUATERNION], np.ravel(attitude.rotated(
        states.rows_quaternion, states.rows_angular_velocity)))
    dust = SNAP * max(abs(state.l3), abs(state.lz), natural_momentum(top))
    l3, lz = (0.0 if abs(value) < dust else value for value in (state.l3, state.lz))
    lz = next((pole for pole in (l3, -l3) if abs(lz - pole) < dust), lz)
    theta_dot = state.theta_dot if top.lambda1 * abs(state.theta_dot) > dust else 0.0
    return (float(states.energy[0]), state.l3, state.lz), State(
        theta=state.theta, theta_dot=theta_dot, l3=l3, lz=lz)
