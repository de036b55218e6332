# SPDX-License-Identifier: Apache-2.0
"""
Whether a filter learns a bias of the gyroscope, and what it says of it.

The bias comes in a rest with the x axis up, when the filter has settled.  Its effect on the
attitude grows, and falls again if it is learned.  Then the sensor is turned: x is level.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.motions import NEAR, X_UP, Motion, Reals, Run, euler

BIAS = np.array((0.012, -0.011, 0.018))     # of the gyroscope [rad/s]
SIZE = float(np.linalg.norm(BIAS))
RESTS_S = 20.0, 160.0           # slow filters get a longer time
LEFT = 0.3                      # of the largest effect, where a bias counts as learned
# An effect of 0.1 deg for 1 deg/s does not matter [rad].
NO_EFFECT = 0.1 * SIZE
# Share of the largest effect by which one rises or falls in the last quarter, if it does.
MOVES = 0.01
LEAST = 0.1                     # share of a bias in an estimate that learns it


class Effect(NamedTuple):
    """An effect about an axis of the sensor: what is left of the largest one, whether it moves."""

    axis: int
    left: float
    falls: bool
    rises: bool
    samples: int        # of the rest


def effects(feed: Callable[[Sequence[Run]], list[Outcome]], lead_s: float, heading: bool,
            ) -> tuple[Outcome, list[Effect]]:
    """Return the outcome with a bias, and its effects, in rests as long as the filter needs."""
    for seconds in RESTS_S:
        motion = Motion(euler(NEAR)).rest(lead_s).turn(euler(X_UP)).rest(seconds)
        motion.turn(euler(NEAR)).rest(seconds)
        (_, *rests), run = motion.of('rest'), motion.run('bias')
        rates = run.gyroscope.copy()
        rates[rests[0].begin:] += BIAS
        (outcome,) = feed([replace(run, gyroscope=rates)])
        sizes = []              # of the effects about axes, level or of a known heading
        for part, axes in zip(rests, (range(1 - heading, 3), (0, 1)), strict=True):
            rows = slice(part.begin, part.end)
            truth = Rotation.from_quat(run.truth[rows])
            error = (truth.inv() * Rotation.from_quat(outcome.estimates[rows])).as_rotvec()
            if not heading:
                up = truth[0].inv().apply((0.0, 0.0, 1.0))
                error = error - np.outer(error @ up, up)
            sizes += [(axis, np.abs(error[:, axis])) for axis in axes]
        largest = max(float(np.max(size)) for _, size in sizes)
        found = [_effect(axis, size, largest) for axis, size in sizes]
        if not any(one.left > LEFT for one in found):
            break
    return outcome, found


def _effect(axis: int, size: Reals, largest: float) -> Effect:
    if largest < NO_EFFECT:
        return Effect(axis, 0.0, False, False, len(size))
    last, before = float(size[-1]), float(size[-len(size) // 4])
    return Effect(axis, last / largest, last < before - MOVES * largest,
                  last > before + MOVES * largest, len(size))


def said_bias(outcome: Outcome) -> Reals:
    """Return the last bias that a filter has told (3,) [rad/s], NaN if none."""
    known = outcome.biases[np.isfinite(outcome.biases[:, 0])]
    last: Reals = known[-1] if len(known) else np.full(3, np.nan)
    return last


def still_learned(outcome: Outcome) -> NDArray[np.bool_]:
    """Return about which axes the bias that a filter tells still grows to the true one (3,)."""
    shares = said_bias(outcome) / BIAS
    before = said_bias(outcome.part(slice(len(outcome.run.dt) * 3 // 4))) / BIAS
    return (shares > 1.02 * before) & (shares > LEAST) & (shares < 1.3)
