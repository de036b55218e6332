# SPDX-License-Identifier: Apache-2.0
"""What changes a live simulation: commands, rates, listeners, restarts, refusals."""


import pytest
from helpers.simulations import (
    MILLISECOND,
    SECOND,
    messages_of,
    output,
    play,
    publish,
    record,
    simulate,
    times,
)

from spinning_top_sim.streams import parameters

PERIOD_NS = 10 * MILLISECOND        # of most streams


def test_a_subscriber_gets_the_next_samples_of_the_grid_and_no_backlog():
    simulation = simulate()
    simulation.advance(SECOND + 3)
    taken = publish(simulation, 'pose')
    simulation.advance(2 * SECOND)
    assert len(taken) == 100
    output(simulation, 'pose').publish = None
    simulation.advance(5 * SECOND)
    again, recorded = publish(simulation, 'pose'), record(simulation, 'pose')
    simulation.advance(5 * SECOND + PERIOD_NS)
    assert again == [('pose', data) for _, _, data in recorded]
    assert times(recorded, 'pose') == [5 * SECOND + PERIOD_NS]
    assert len(taken) == 100


@pytest.mark.parametrize('ahead', [False, True])
def test_late_samples_are_recorded_and_counted_but_not_published(ahead):
    simulation = simulate()
    encoded = messages_of(simulation)
    published = publish(simulation, 'pose', 'joint_states')
    recorded = record(simulation, 'pose')
    simulation.advance(0)
    if ahead:
        simulation.prepare(SECOND)
    assert simulation.advance(10 * SECOND, publish_from_ns=9 * SECOND)
    assert times(recorded, 'pose') == list(range(0, 10 * SECOND + 1, PERIOD_NS))
    for topic in ('pose', 'joint_states'):
        assert [name for name, _ in published].count(topic) == 102
        assert (output(simulation, topic).sent, output(simulation, topic).skipped) == (102, 899)
    assert encoded['pose'].count == 1001
    if not ahead:       # nobody takes the samples that are left out
        assert encoded['joint_states'].count == 102


@pytest.mark.parametrize(('before', 'after'), [(100.0, 33.0), (10000.0, 10.0)])
def test_a_change_of_rate_goes_on_on_the_new_grid(before, after):
    simulation = simulate(pose__rate=before)
    taken = record(simulation, 'pose')
    changed_at = 123_456_789
    simulation.advance(changed_at)
    simulation.apply({'pose.rate': after})
    simulation.advance(SECOND)
    old, new = round(SECOND / before), round(SECOND / after)
    expected = [*range(0, changed_at + 1, old),
                *(t for t in range(0, SECOND + 1, new) if t > changed_at)]
    assert times(taken, 'pose') == expected


def test_a_change_of_rates_reaches_every_stream():
    """A run is computed again by the rates of its streams."""
    simulation = simulate()
    at_once = {stream.rate_parameter for stream in simulation.streams}
    assert at_once == {name for name in parameters.BY_NAME if name.endswith('.rate')
                       and not name.startswith('imu.vibration')}
    assert all(parameters.BY_NAME[name].effect is parameters.Effect.NOW for name in at_once)
    simulation.apply({'imu.rate': 100.0})
    simulation.advance(SECOND)
    simulation.apply({**dict.fromkeys(at_once, 50.0), 'tick_rate': 100.0})
    taken = record(simulation)
    simulation.advance(2 * SECOND)
    for one in simulation.streams:
        assert times(taken, one.topic) == list(range(SECOND + 20 * MILLISECOND, 2 * SECOND + 1,
                                                     20 * MILLISECOND)), one.topic
    assert simulation.history == [(0, 100.0), (SECOND, 50.0)], 'the rates of the IMU'


def test_segments_are_forgotten_when_nothing_reaches_back_to_them():
    """The trace of the markers has 3 s by default."""
    simulation = simulate(solver__method='exact')
    for tick in range(1, 101):
        simulation.advance(tick * SECOND // 10)
        simulation.command(1.6 + 0.001 * tick, 1.4)
    kept = [one.start_ns for one in simulation.path._segments]
    trace_ns = round(simulation.values['markers.trace_length'] * SECOND)
    assert kept == list(range(10 * SECOND - trace_ns - SECOND // 10, 10 * SECOND + 1,
                              SECOND // 10))


def test_a_restart_gives_the_same_bytes_again_and_keeps_sinks_and_counts():
    simulation = simulate()
    taken, published = record(simulation), publish(simulation, 'pose')
    simulation.advance(SECOND)
    first, steps = list(taken), simulation.steps
    simulation.command(0.5, 0.1)
    simulation.advance(2 * SECOND)
    simulation.prepare(3 * SECOND)
    between = simulation.steps
    simulation.restart(parameters.checked({}))
    del taken[:]
    simulation.advance(SECOND)
    assert taken == first
    assert simulation.history == []
    assert simulation.steps == between + steps > between > steps
    assert output(simulation, 'pose').sent == len(published) == 101 + 100 + 101
    simulation.restart(parameters.checked({}))
    again = record(simulation, 'pose')
    simulation.advance(SECOND)
    assert [entry for entry in first if entry[0] == 'pose'] == again


def test_a_restart_that_is_refused_leaves_the_motion_as_it_was():
    expected = play(simulate(), SECOND, 'pose')
    simulation = simulate()
    taken = record(simulation, 'pose')
    simulation.advance(SECOND // 2)
    with pytest.raises(ValueError, match='pole'):
        simulation.restart({**parameters.checked({}), 'initial.theta': 0.0, 'spin.lz': 0.5})
    with pytest.raises(ValueError, match=r'1e\+20'):
        simulation.restart({**parameters.checked({}), 'spin.l3': 1e20, 'spin.lz': 1e20})
    simulation.advance(SECOND)
    assert taken == expected
