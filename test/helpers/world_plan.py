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
SCENES = ('cusp', 'cusp', 'looping', 'sleeping', 'shuttle', 'near_separatrix')
FALLS = {'solver.method': 'rk45', 'solver.equations': 'euler', 'initial.theta': 0.5,
         'initial.theta_dot': -3.0, 'spin.l3': 0.2, 'spin.lz': -0.2}    # through a pole
FAULTS = (*(('error', number) for number in (errno.ENOSPC, errno.EIO, errno.EINTR)),
          ('short',), ('short',), ('slow', 20 * MILLISECOND), ('slow', 300 * MILLISECOND),
          ('slow', SECOND), ('stop',))
CALLS = (*(2 * ('pwrite', 'pwrite', 'fsync')), 'ftruncate', 'fstatvfs')
# Actions after which no tick is late, and those after which simulated time is another one.
CALM = frozenset(('command', 'put', 'drive', 'start_recording', 'stop_recording', 'listen',
                  'leave', 'step_date'))
TURNS = frozenset(('pause', 'resume', 'step', 'reset', 'change'))


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
    kill_at: int | None
    is_slow: bool

    @property
    def is_calm(self):
        """Whether no tick is late, and nothing holds the loop up."""
        return not self.follows and CALM.issuperset(one.name for one in self.actions)

    @property
    def keeps_time(self):
        """Whether simulated time is that since the start, but for what has slipped."""
        return not self.follows and TURNS.isdisjoint(one.name for one in self.actions)

    def only(self, numbers):
        """Return the plan with these of its actions."""
        return replace(self, actions=tuple(self.actions[k] for k in numbers))


def plan_of(seed):
    chance = random.Random(seed)
    streams = chance.sample([*STREAMS], chance.choice((1, 1, 1, 2)))
    values, topics = _values(chance, streams), [one for name in streams for one in STREAMS[name]]
    ends = chance.choice(('close', 'close', 'kill', 'cut'))
    ends_ms = chance.choice((200, 400, 600))
    is_calm = chance.random() < 0.2
    follows = not is_calm and chance.random() < 0.25
    kinds = [kind for kind in _kinds(chance, topics, values)
             if (kind[1] in CALM or not is_calm) and (follows or not kind[1].endswith('source'))]
    weights, happens = [weight for weight, *_ in kinds], chance.choice((2, 4, 8, 12))
    actions = [Action(chance.randrange(ends_ms), name, make())
               for _, name, make in chance.choices(kinds, weights, k=happens)]
    actions += [Action(0, 'listen', (topic,)) for topic in topics if chance.random() < 0.6]
    if chance.random() < 0.8:
        actions.append(Action(chance.choice((0, 0, 50)), 'start_recording'))
    if 'solver.equations' in values:        # it falls, stands still, and begins again
        actions.append(Action(ends_ms - 50, 'reset', (None,)))
    kill_at = chance.randrange(4, 60) if ends != 'close' and chance.random() < 0.3 else None
    return Plan(seed, values, follows, tuple(sorted(actions, key=lambda one: one.at_ms)), ends,
                ends_ms, kill_at, is_slow=chance.random() < 0.15)


def _values(chance, streams):
    values = {**scene_parameters(chance.choice(SCENES)),
              'solver.method': chance.choice(('rk45', 'exact', 'exact')),
              'tick_rate': chance.choice((50.0, 100.0, 200.0)),
              'time_scale': chance.choice((1.0, 1.0, 1.0, 0.5, 3.0)),
              'seed': chance.randrange(1000), 'start_paused': chance.random() < 0.1,
              # To open a file, to write and to sync takes up to 40 ms.
              'record.max_loss': chance.choice((0.1, 0.3, 60.0)), 'record.min_free_bytes': 0,
              'record.compression': chance.choice(('zstd', 'lz4', 'none')),
              'imu.lever_arm': [0.1, -0.2, 0.3], 'imu.gyroscope_noise_density': 0.01,
              'imu.gyroscope_random_walk': 0.001, 'markers.trace_length': 0.2,
              'gnss.latency': 0.03, 'gnss.outages': [0.05, 0.1]}
    for name in (*STREAMS, 'ground_truth_imu'):     # which is on by default
        values[f'{name}.enabled'] = name in streams
        if name in streams and name != 'increments':
            values[f'{name}.rate'] = chance.choice((33.0, 50.0, 100.0))
    if chance.random() < 0.5:
        values |= {'imu.drop_rate': 0.2, 'imu.duplicate_rate': 0.1, 'imu.stamp_jitter': 0.001}
    if 'increments' in streams:
        values |= {'imu.sampling': 'mean', 'imu.rate': 200.0}
    if chance.random() < 0.07:
        values |= FALLS
    if chance.random() < 0.1:
        values['duration'] = chance.uniform(0.05, 0.5)
    return values


def _kinds(chance, topics, values):
    """Return what may happen: weights, names of actions, and makers of arguments."""
    pick = chance.choice
    rates = [name for name in values if name.endswith('.rate')]

    def momentum():
        return pick((chance.uniform(-3.0, 3.0), 1.0, 1.6, float('nan'), 1e20))

    def duration():
        return pick((7, 30, 120, 700, 1500))

    def topic():
        return (pick(topics),)

    return [
        (3, 'busy', lambda: (duration(), pick((0, 0, 20, 300, 3000, 30_000)))),
        (1, 'lose_ticks', lambda: (chance.randrange(1, 30),)),
        (1, 'tick', tuple),
        (1, 'step_date', lambda: (pick((-3600_000, -5, 5, 40, 3600_000)),)),
        (2, 'stop_source', lambda: (duration(),)),
        (3, 'jump_source', lambda: (pick((-9000, -300, 300, 4000, 9000)),)),
        (5, 'command', lambda: (momentum(), momentum())),
        (1, 'put', lambda: (pick((0.0, 0.3, 2.0, 9.0)), momentum(), momentum())),
        (4, 'drive', lambda: (pick((0, 0, 3, 20)), *pick((
            (0.0, 0.0, 0.0), (chance.uniform(-1.0, 1.0), 0.5, 0.0), (0.5, 0.0, 0.0),
            (0.5, 0.0, 0.0), (1e9, 0.0, 0.0))))),
        (1, 'pause', tuple),
        (2, 'resume', tuple),
        (1, 'step', lambda: (pick((1, 10_000_000, 123_456_789)),)),
        (3, 'reset', lambda: (pick((None, None, True, False)),)),
        (2, 'change', lambda: (dict.fromkeys(rates, pick((20.0, 33.0, 100.0, 250.0))),)),
        (1, 'change', lambda: ({'time_scale': pick((0.3, 1.0, 2.0))},)),
        (1, 'change', lambda: ({'tick_rate': pick((20.0, 100.0, 300.0)), 'seed': 1000},)),
        (3, 'start_recording', tuple),
        (2, 'stop_recording', tuple),
        (2, 'listen', topic),
        (1, 'leave', topic),
        (1, 'stall', topic),
        (5, 'fault', lambda: (pick(CALLS), *pick(FAULTS))),
        (0.5, 'fill_disk', lambda: (pick((100, 3000, 20_000)),))]
