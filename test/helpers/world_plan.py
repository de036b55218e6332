# SPDX-License-Identifier: Apache-2.0
"""What a seed of the simulated world decides: parameters, what happens when, and how it ends."""

import errno
import random
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from helpers.machine import MILLISECOND, SECOND
from helpers.reference import scene_parameters

STREAMS = {'pose': ('pose',), 'joint_states': ('joint_states',),
           'imu': ('imu/data_raw', 'ground_truth/imu_bias'), 'clock': ('/clock',),
           'invariants': ('~/invariants',), 'ground_truth_odom': ('ground_truth/odom',),
           'markers': ('markers',), 'mag': ('imu/mag', 'ground_truth/mag'),
           'increments': ('imu/dq', 'imu/dv'), 'gnss': ('gnss/fix',)}
ALWAYS_ON = ('ground_truth_imu',)       # by default: switched off here
SCENES = ('cusp', 'cusp', 'looping', 'sleeping', 'shuttle', 'near_separatrix')
CALM = frozenset(('command', 'put', 'drive', 'steer', 'start_recording', 'stop_recording',
                  'listen', 'leave', 'step_date'))
FALLS = {'solver.method': 'rk45', 'solver.equations': 'euler', 'initial.theta': 0.5,
         'initial.theta_dot': -3.0, 'spin.l3': 0.2, 'spin.lz': -0.2}    # through a pole
ERRORS = (errno.ENOSPC, errno.EIO, errno.EINTR)


class Action(NamedTuple):
    """What happens at a time [ms]: a method of the world, and its arguments."""

    at_ms: int
    name: str
    arguments: tuple[Any, ...] = ()

    def __str__(self):
        return f'{self.at_ms:5d} ms  {self.name}{self.arguments!r}'


@dataclass(frozen=True)
class Plan:
    """
    A run of the world.

    values : parameters that are given
    follows : whether the node follows a /clock
    actions : in the order of time
    ends : 'close', 'kill' or 'cut' (the power)
    ends_ms : when
    kill_at : or in which call of the disk
    is_slow : whether the disk is
    """

    seed: int
    values: dict[str, Any]
    follows: bool
    actions: tuple[Action, ...]
    ends: str
    ends_ms: int
    kill_at: int | None = None
    is_slow: bool = False

    @property
    def is_calm(self):
        """Whether no tick is late, and nothing holds the loop up."""
        return not self.follows and CALM.issuperset(one.name for one in self.actions)

    def only(self, numbers):
        """Return the plan with these of its actions."""
        return replace(self, actions=tuple(self.actions[k] for k in numbers))


def plan_of(seed):
    chance = random.Random(seed)
    values, topics = _values(chance)
    ends_ms = chance.choice((200, 400, 700))
    is_calm = chance.random() < 0.2
    follows = not is_calm and chance.random() < 0.25
    kinds = [*_kinds(chance, topics, values, follows)]
    if is_calm:
        kinds = [(weight, kind) for weight, kind in kinds if kind()[0] in CALM]
    names, weights = zip(*((kind, weight) for weight, kind in kinds), strict=True)
    actions = [Action(chance.randrange(ends_ms), *make())
               for make in chance.choices(names, weights, k=chance.choice((2, 4, 8, 12)))]
    for topic in topics:
        if chance.random() < 0.6:
            actions.append(Action(0, 'listen', (topic,)))
    if chance.random() < 0.7:
        actions.append(Action(chance.choice((0, 0, 50)), 'start_recording'))
    if 'solver.equations' in values:        # it falls, stands still, and begins again
        actions.append(Action(ends_ms - 50, 'reset', (None,)))
    ends = chance.choice(('close', 'close', 'kill', 'cut'))
    return Plan(seed, values, follows, tuple(sorted(actions, key=lambda one: one.at_ms)), ends,
                ends_ms, chance.randrange(4, 60) if chance.random() < 0.3 and ends != 'close'
                else None, is_slow=chance.random() < 0.15)


def _values(chance):
    streams = chance.sample([*STREAMS], chance.choice((1, 1, 1, 2)))
    values = {**scene_parameters(chance.choice(SCENES)),
              'solver.method': chance.choice(('rk45', 'exact', 'exact')),
              'tick_rate': chance.choice((50.0, 100.0, 200.0)),
              'time_scale': chance.choice((1.0, 1.0, 1.0, 0.5, 3.0)),
              'seed': chance.randrange(1000), 'start_paused': chance.random() < 0.1,
              'record.max_loss': chance.choice((0.05, 0.1, 0.3)), 'record.min_free_bytes': 0,
              'record.compression': chance.choice(('zstd', 'lz4', 'none')),
              'markers.trace_length': 0.2}
    for name in (*STREAMS, *ALWAYS_ON):
        values[f'{name}.enabled'] = name in streams
        if name in streams and name != 'increments':
            values[f'{name}.rate'] = chance.choice((33.0, 50.0, 100.0))
    if 'imu' in streams:
        values |= {'imu.lever_arm': [0.1, -0.2, 0.3], 'imu.gyroscope_noise_density': 0.01,
                   'imu.gyroscope_random_walk': 0.001}
        if chance.random() < 0.5:
            values |= {'imu.drop_rate': 0.2, 'imu.duplicate_rate': 0.1, 'imu.stamp_jitter': 0.001}
    if 'gnss' in streams:
        values |= {'gnss.rate': 50.0, 'gnss.latency': 0.03, 'gnss.outages': [0.05, 0.1]}
    if 'increments' in streams:
        values |= {'imu.sampling': 'mean', 'imu.rate': 200.0}
    if chance.random() < 0.07:
        values |= FALLS
    if chance.random() < 0.1:
        values['duration'] = chance.uniform(0.05, 0.5)
    return values, [topic for name in streams for topic in STREAMS[name]]


def _kinds(chance, topics, values, follows):
    """Yield weights, and makers of actions: each returns a name and its arguments."""
    def momentum():
        return chance.choice((chance.uniform(-3.0, 3.0), 1.0, 1.6, float('nan'), 1e20))

    def velocity():
        return chance.choice(((0.0, 0.0, 0.0), (chance.uniform(-1.0, 1.0), 0.5, 0.0),
                              (0.5, 0.0, 0.0), (0.5, 0.0, 0.0), (1e9, 0.0, 0.0)))

    def duration():
        return chance.choice((7, 30, 120, 700, 1500))

    def fault(call):
        kind = chance.choice(('error', 'error', 'short', 'short', 'slow', 'slow', 'stop'))
        value = {'error': chance.choice(ERRORS), 'slow': chance.choice((
            20 * MILLISECOND, 300 * MILLISECOND, SECOND))}.get(kind, 0)
        return 'fault', (call, kind, value)

    yield 2, lambda: ('busy', (duration(),))
    yield 1, lambda: ('lose_ticks', (chance.randrange(1, 30),))
    yield 1, lambda: ('double_tick', ())
    yield 1, lambda: ('slow_clock', (chance.choice((20, 300, 3000)), duration()))
    yield 1, lambda: ('step_date', (chance.choice((-3600_000, -5, 5, 40, 3600_000)),))
    if follows:
        yield 2, lambda: ('stop_source', (duration(),))
        yield 3, lambda: ('jump_source', (chance.choice((-9000, -300, 300, 4000, 9000)),))
        yield 1, lambda: ('second_source', (chance.choice((1, 20, 9000)),))
    yield 4, lambda: ('command', (momentum(), momentum()))
    yield 1, lambda: ('put', (chance.choice((0.0, 0.3, 2.0, 9.0)), momentum(), momentum()))
    yield 3, lambda: ('drive', velocity())
    yield 1, lambda: ('steer', chance.choice(((), (0.5, 0.0, 0.0), (0.0, 0.2, 0.1))))
    yield 1, lambda: ('pause', ())
    yield 2, lambda: ('resume', ())
    yield 1, lambda: ('step', (chance.choice((1, 10_000_000, 123_456_789)),))
    yield 2, lambda: ('reset', (chance.choice((None, None, True, False)),))
    yield 2, lambda: ('change', ({f'{name}.rate': chance.choice((20.0, 33.0, 100.0, 250.0))
                                  for name in STREAMS if f'{name}.rate' in values},))
    yield 1, lambda: ('change', ({'time_scale': chance.choice((0.3, 1.0, 2.0))},))
    yield 1, lambda: ('change', ({'tick_rate': chance.choice((20.0, 100.0, 300.0))},))
    yield 3, lambda: ('start_recording', ())
    yield 2, lambda: ('stop_recording', ())
    yield 2, lambda: ('listen', (chance.choice(topics),))
    yield 1, lambda: ('leave', (chance.choice(topics),))
    yield 1, lambda: ('stall', (chance.choice(topics),))
    yield 2, lambda: fault('pwrite')
    yield 1, lambda: fault('fsync')
    yield 0.5, lambda: fault(chance.choice(('ftruncate', 'fstatvfs')))
    yield 0.5, lambda: ('fill_disk', (chance.choice((100, 3000, 20_000)),))
    yield 0.3, lambda: ('delete_log', ())
