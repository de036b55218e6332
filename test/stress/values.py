# SPDX-License-Identifier: Apache-2.0
"""
Extreme parameters and commands at a Simulation and its TickLoop, without ROS.

Whatever is taken makes samples of finite numbers, in the order of time, and never more than
a tick has time for; whatever is not is a ValueError in one line.
"""

import math
import random
from types import SimpleNamespace

from helpers.extremes import actions, commands, parameter_sets
from helpers.simulations import doubles

from spinning_top_sim.nodes.tick_loop import TickLoop
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Simulation

PATIENCE_S = 60.0
MEMORY_MB = 1000
EPOCH_NS = 1_700_000_000_000_000_000
TICKS = 40


class Clock:
    """A clock that goes on a little whenever it is read, so that budgets end."""

    def __init__(self):
        self.now_ns = 0

    def __call__(self):
        self.now_ns += 500_000
        return self.now_ns


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
        values = parameters.checked(parameter_sets(seed))
        simulation = Simulation(values, EPOCH_NS)
    except (ValueError, IntegrationError) as error:
        check_reason(error)
        return 'refused'
    clock, recorded = Clock(), Recorded(simulation)
    loop = TickLoop(
        simulation, values, SimpleNamespace(
            has_room=lambda: True, write_command=lambda *_: None,
            write_event=lambda *_, **__: None),
        update_subscribers=lambda: None, align=lambda at: None, error=check_reason,
        source=clock, steady=clock)
    loop.start()
    refused = 0
    for kind, given in [('wait', 0.1), *actions(seed), *(('command', one)
                                                         for one in commands(seed))]:
        before = {name: getattr(simulation.state(), name)[0] for name in ('theta', 'phi', 'psi')}
        now_ns = loop.now_ns
        try:
            values = act(simulation, loop, values, kind, given)
        except (ValueError, RuntimeError, IntegrationError) as error:
            check_reason(error)
            refused += 1
            if kind == 'set' and loop.now_ns == now_ns:
                after = {name: getattr(simulation.state(), name)[0] for name in before}
                assert after == before, 'a refusal changes nothing'
        for _ in range(TICKS):
            clock.now_ns += rng.choice((1_000_000, 5_000_000, 300_000_000))
            if loop.tick():
                loop.idle()
    assert recorded.count > 0 or loop.failure or not any(
        stream.enabled for stream in simulation.streams)
    return f'{"stood still" if loop.failure else "ran"}, {"some" if refused else "none"} refused'


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
