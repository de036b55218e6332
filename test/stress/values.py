# SPDX-License-Identifier: Apache-2.0
"""
Extreme parameters and commands at a Simulation and its TickLoop, without ROS.

Whatever is taken makes samples of finite numbers, in the order of time, and never more than
a tick has time for; whatever is not is a ValueError in one line.
"""

import math
import random

from helpers.extremes import actions, commands, parameter_sets
from helpers.simulations import doubles
from test_tick_loop import Run

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters

PATIENCE_S = 60.0
MEMORY_MB = 1000
EPOCH_NS = 1_700_000_000_000_000_000
TICKS = 40
CLOCK_STEP_NS = 5_000_000   # by which time goes on whenever it is read, so that budgets end


class Recorded:
    """Takes what is recorded, and looks at the stamps and at the attitudes."""

    def __init__(self, simulation):
        self.count, self._last = 0, {}
        self._topics = [stream.topic for stream in simulation.streams]
        simulation.log_to(self._write, simulation.streams)

    def _write(self, numbers, stamp_ns, messages, size):
        assert size == sum(map(len, messages))
        for number, message in zip(numbers, messages, strict=True):
            assert stamp_ns > self._last.get(number, -1), (self._topics[number], stamp_ns)
            self._last[number] = stamp_ns
            self.count += 1
            if self._topics[number] == 'pose':
                numbers = doubles(message, 7)
                assert all(map(math.isfinite, numbers)), numbers
                assert abs(math.hypot(*numbers[3:]) - 1.0) < 1e-15, numbers


def check(seed, folder):
    rng = random.Random(seed)
    try:
        run = Run(**parameter_sets(seed))
    except (ValueError, IntegrationError) as error:
        check_reason(error)
        return 'refused'
    recorded, simulation, loop, values = (
        Recorded(run.simulation), run.simulation, run.loop, run.values)
    run.clock.step_ns = CLOCK_STEP_NS
    loop.start()
    refused = 0
    for kind, given in [('wait', 0.1), *actions(seed), *(('command', one)
                                                         for one in commands(seed))]:
        before, now_ns = angles(simulation), loop.now_ns
        try:
            values = act(simulation, loop, values, kind, given)
        except (ValueError, RuntimeError, IntegrationError) as error:
            check_reason(error)
            refused += 1
            if kind == 'set' and loop.now_ns == now_ns:
                assert angles(simulation) == before, 'a refusal changes nothing'
        for _ in range(TICKS):
            run.tick(rng.choice((1_000_000, 5_000_000, 300_000_000)))
    assert recorded.count > 0 or loop.failure or not simulation.streams
    return f'{"stood still" if loop.failure else "ran"}, {"some" if refused else "none"} refused'


def angles(simulation):
    state = simulation.state()
    return [getattr(state, name)[0] for name in ('theta', 'theta_dot', 'phi', 'psi')]


def act(simulation, loop, values, kind, given):
    """Do as the node does; return the parameters from then on."""
    if kind == 'set':
        changed = parameters.checked({**values, **given})
        simulation.apply(changed)
        loop.set_pace(changed)
        return changed
    if kind == 'command' and len(given) == 2:
        loop.command(*given)
    elif kind == 'pause':
        (loop.pause if given else loop.resume)()
    elif kind == 'step':
        loop.step(values['step.count'], values['step.dt'])
    elif kind == 'reset':
        loop.reset(values, EPOCH_NS)
    return values


def check_reason(error):
    """Whether a refusal is one line that people can read."""
    assert str(error) and '\n' not in str(error), error
