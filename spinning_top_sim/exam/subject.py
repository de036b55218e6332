# SPDX-License-Identifier: Apache-2.0
"""The filter under examination: made anew for each run, or one that goes on."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.hypotheses import Hypothesis
from spinning_top_sim.exam.scenarios import Run, Scenario
from spinning_top_sim.exam.trial import Feed, Filter, MakeFilter, Outcome, feed, follow

FIELD_ASKED = 200, 3000     # updates after which a filter has shown whether it uses the field
SAME = np.radians(1.0)      # apart at most in two runs of a filter, which may be random
# A filter that goes on is first turned to the attitude at which a run begins [s].
TURN_S = 30.0
# A filter uses the field if its heading follows at least a tenth of this alternating turn of the
# field [rad].  A larger turn would disturb a filter that assumes low noise.
DECLINATION = np.radians(2.0)


class Subject:
    """
    A filter that is made anew for each run.

    feed : feeds a new filter with a run
    imu : parameters imu.* and mag.* of the sensor
    seed : of runs that need only one
    """

    restarts = True

    def __init__(self, make_filter: MakeFilter, feed: Feed, imu: Mapping[str, Any],
                 seed: int) -> None:
        self._make_filter, self._feed, self.imu, self._seed = make_filter, feed, imu, seed

    def record(self, scenario: Scenario, seed: int | None = None) -> Run:
        """Return what the sensor reads in a scenario."""
        return scenarios.record(scenario, self.imu, self._seed if seed is None else seed)

    def follow(self, run: Run, undone: Sequence[Hypothesis] = ()) -> Outcome:
        """Return the outcome of a run.  Raises InvalidOutputError."""
        return follow(self._make_filter, run, undone, self._feed)

    def uses_field(self) -> bool:
        """Return whether the field changes the attitudes: only then the heading can be judged."""
        slow = self.record(scenarios.SLOW)
        for updates in FIELD_ASKED:
            run = slow.part(slice(updates))
            other = replace(run, magnetometer=run.magnetometer[:, [1, 2, 0]])
            one, two = (self.follow(fed).estimates for fed in (run, other))
            if np.max(np.abs(one - two)) > 1e-9:
                return True
        return False

    def shares_state(self) -> bool:
        """Return whether attitudes depend on a filter that ran before in the same process."""
        run = self.record(scenarios.SLOW).part(slice(FIELD_ASKED[0]))

        def make_second() -> Filter:
            feed(self._make_filter, run)
            return self._make_filter()

        one, two = (Rotation.from_quat(follow(make, run, (), self._feed).estimates)
                    for make in (self._make_filter, make_second))
        return bool(np.max((one * two.inv()).magnitude()) > SAME)

    def convergence(self) -> Mapping[str, float]:
        """Return the convergence time; {} where the noisy runs show it."""
        return {}


class LastingSubject(Subject):
    """
    A filter that is made once, and turned to where each run begins.

    Its sensor has no turn-on bias, which would jump from run to run.
    """

    restarts = False

    def __init__(self, make_filter: MakeFilter, imu: Mapping[str, Any], seed: int) -> None:
        imu = {name: value for name, value in imu.items() if not name.endswith('_turn_on_bias')}
        super().__init__(cache(make_filter), feed, imu, seed)
        self._attitude = Rotation.identity()        # the true one

    def follow(self, run: Run, undone: Sequence[Hypothesis] = ()) -> Outcome:
        """Return the outcome of a run.  Raises InvalidOutputError."""
        lead = scenarios.turning(self.imu, self._attitude, run.start, TURN_S)
        outcome = super().follow(run.preceded_by(lead), undone)
        self._attitude = Rotation.from_quat(run.truth[-1])
        return outcome.part(slice(len(lead.t), None))

    def uses_field(self) -> bool:
        """Turn the field to and fro; return whether the attitude follows."""
        level = Rotation.identity()
        n = round(TURN_S * scenarios.SLOW.rate / 3.0)
        run = scenarios.turning(self.imu, level, level, TURN_S)
        turns = Rotation.from_quat(run.truth)
        west = Rotation.from_rotvec(0.5 * DECLINATION * np.repeat(
            ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)), n, axis=0))
        run = replace(run, name='field to and fro', magnetometer=(
            turns.inv() * west * turns).apply(run.magnetometer))
        # The sensor is level after each third, so the attitudes are equal for any misreading.
        one, two, three = Rotation.from_quat(self.follow(run).estimates[n - 1::n])
        # This sum is zero for a constant drift.
        moved = ((one.inv() * two).magnitude() + (two.inv() * three).magnitude()
                 - (one.inv() * three).magnitude())
        return bool(moved > 0.2 * DECLINATION)

    def convergence(self) -> Mapping[str, float]:
        """Return the convergence time after a jump of the true attitude by 90 degrees of tilt."""
        run = self.record(scenarios.SLOW)
        tilted = Rotation.from_euler('x', 90.0, degrees=True) * run.start
        tilt = self.follow(run.preceded_by(scenarios.turning(
            self.imu, tilted, tilted, TURN_S))).errors.tilt[-len(run.t):]
        return {'convergence_s': measures.convergence_time(run.t, tilt)}
