# SPDX-License-Identifier: Apache-2.0
"""Extreme parameters from the ranges of the table, and a short life of a simulation with them."""

import math
import random

import numpy as np

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Simulation

LARGEST, LEAST = 1e300, 1e-300          # where the table has no bound
# The last of the invariants is NaN where there is no exact solution to compare with.
COMPARABLE = {'~/invariants': 7}


def number(parameter, dice):
    """Return an allowed number: an end of the range, the default, or of any order of magnitude."""
    low = parameter.minimum if parameter.minimum is not None else (
        -LARGEST if parameter.above is None else math.nextafter(parameter.above, 1.0))
    high = LARGEST if parameter.maximum is None else parameter.maximum
    default = parameter.default if isinstance(parameter.default, int | float) else 1.0
    size = math.exp(dice.uniform(math.log(parameter.smallest or LEAST),
                                 math.log(max(abs(low), abs(high)))))
    chosen = dice.choice((low, high, default, size, size, dice.uniform(-10.0, 10.0)))
    chosen = min(max(dice.choice((1, -1) if low < 0 else (1,)) * chosen, low), high)
    return int(chosen) if isinstance(parameter.default, int) else chosen


def value(parameter, dice):
    default = parameter.default
    if parameter.choices:
        return dice.choice(parameter.choices)
    if isinstance(default, bool):
        return dice.random() < 0.5
    if isinstance(default, tuple) and isinstance(default[0], float):
        return tuple(number(parameter, dice) for _ in default)
    return default if isinstance(default, str | tuple) else number(parameter, dice)


def values(seed):
    """Return a few, or all, parameters as a seed has them."""
    dice = random.Random(seed)
    count = dice.choice((1, 2, 3, 5, 10, len(parameters.TABLE)))
    return {parameter.name: value(parameter, dice)
            for parameter in dice.sample(parameters.TABLE, count)}


def live(seed):
    """
    Simulate for a few steps of any length, with commands, changes of rates and resets in between.

    Return what came of it: 'refused', 'stopped', or 'ran'.  What may not be are other errors than
    ValueError, where something is refused, and IntegrationError, where a motion ends; and numbers
    that are not finite.
    """
    dice, spin = random.Random(-seed), parameters.BY_NAME['spin.l3']
    try:
        checked = parameters.checked(values(seed))
        simulation = Simulation(checked, dice.choice((0, 1_700_000_000_000_000_000)))
    except ValueError:
        return 'refused'
    simulation.log_to(lambda *call: None, simulation.streams)
    for _ in range(3):
        asked = iter(range(30))
        target_ns = max(simulation.now_ns, 0) + dice.choice(
            (0, 1, *(10 ** n for n in range(3, 18))))
        try:
            if dice.random() < 0.5:
                simulation.prepare(target_ns, 5_000_000)
            simulation.advance(target_ns, give_way=lambda asked=asked: next(asked, None) is None)
        except IntegrationError:
            return 'stopped'
        now = range(max(simulation.now_ns, 0), max(simulation.now_ns, 0) + 1)
        for stream in simulation.streams:
            data = stream.encode(simulation.segment.states(now), simulation.epoch_ns, now)
            for field in stream.template.decode(data.tobytes()):
                shown = field[:, :COMPARABLE.get(stream.topic)]
                assert np.isfinite(shown).all(), (seed, stream.topic, shown)
        assert math.isfinite(simulation.energy_drift) and str(simulation.describe())
        act = dice.choice((
            lambda: simulation.command(number(spin, dice), number(spin, dice)),
            lambda: simulation.apply({'imu.rate': number(parameters.BY_NAME['imu.rate'], dice)}),
            lambda: simulation.restart(parameters.checked(values(seed + 1)))))
        try:
            act()
        except ValueError as error:
            assert str(error), seed
    return 'ran'
