#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write docs/interface.md from the tables of the code: `python docs/interface.py`."""

from collections.abc import Iterable
from pathlib import Path

from spinning_top_sim.nodes.clock import JUMP_NS
from spinning_top_sim.nodes.loop import LoopState
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import Effect
from spinning_top_sim.streams.topics import INVARIANTS, JOINTS, TIMING
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.tools import scene_file
from spinning_top_sim.tools.recorded_run import channels_of

HEAD = """<!-- Written by docs/interface.py from the code. -->
# Interface and commands

The name of the node is `spinning_top`. All names are relative unless they begin with `/`; `~` is the
name of the node.

## Published topics

Publishers are RELIABLE and KEEP_LAST with depth 10. The parameters
`qos_overrides.<resolved topic>.publisher.<policy>` override their QoS.

| topic | type | rate [Hz] | enabled | parameters |
|---|---|---|---|---|
"""

AFTER_TOPICS = """| `/diagnostics` | diagnostic_msgs/msg/DiagnosticArray | 1 | yes | |

- `pose`: attitude q(world ← body) in `world_frame`; the position is that of the pivot,
  (0, 0, 0) while it rests in the origin.
- `joint_states`: {joints}: φ, θ, ψ [rad] and their rates [rad/s]. The angles are
  unwrapped while the pivot rests; once it has moved, θ is in [0, π] and φ and ψ may jump by whole turns.
- `imu/data_raw` (REP-145): angular velocity [rad/s] and specific force [m/s²] in `imu.frame_id`, +g
  upwards at rest; `orientation_covariance[0]` = −1, because it has no orientation.
- `imu/data`: the same with the orientation of the IMU in the world. There is one IMU, which takes a
  sample every 1/`imu.rate`: at other rates a reading has the white noise of the newest sample.
  [sensor.md](sensor.md) has the errors of all sensors.
- `imu/mag`, `ground_truth/mag`: the magnetic field [T] in `imu.frame_id`.
- `gnss/fix`, `gnss/velocity`: the pivot as a satellite receiver measures it, and exact in `ground_truth/gnss`.
  Their stamps are the times of the measurements, `gnss.latency` before they are sent.
- `ground_truth/imu_bias`: the bias that the readings contain. It depends on time and `seed` alone, and
  changes every millisecond.
- `ground_truth/imu_timing`: one labelled dimension, {timing}. It has
  the stamp and the true time of each sample of `imu/data_raw`, and how often it was sent.
- `ground_truth/imu`, `ground_truth/odom`: noise-free. The twist of the odometry is in the body frame.
- What is exact has the variance 1e-18 in SI units: in sensor_msgs a covariance of zeros means unknown.
- `~/invariants`: one labelled dimension, {invariants}. Drifts are relative to the value at the start of
  the motion. `lz_drift` is 0 by construction, and so is `l3_drift` but with `rk45` and `transport`: solvers
  take them as constants. The orientation error [rad] is the angle to the exact solution.
- `markers`: in `world_frame`, so that no TF is needed. A cylinder with the mass and the moments of inertia
  of the top, lines on it that show the spin, and the trace of the tip over the last
  `markers.trace_length`. Every message has the whole trace. The trace is that of the exact solution; its
  last point is the tip according to the solver.
- `/diagnostics`: level and message are those of the worst problem, now or since the message before;
  counters are totals. Among the values, `state` is one of
  {states}. `failed messages` counts what `publish` refused, as it
  does while a reader with KEEP_ALL has stalled; motion and recording go on.
- A stamp is the time of its sample, on the grid k × period. A paused node publishes no samples.
- With `use_sim_time` the node follows the `/clock` of another node. Every sample that becomes due is
  published, and no stamp is ahead of that `/clock`. If it jumps forward by more than {jump:g} s, so do the
  stamps, with a warning and an event `epoch`. If it goes back, the node warns, and the stamps go on;
  `~/reset` brings them back. Of several publishers on `/clock` the latest time counts.

## Subscribed topics and services

| kind | name | type | effect |
|---|---|---|---|
| topic | `~/commands` | std_msgs/Float64MultiArray | sets [L3, Lz] in kg m²/s, as an impulsive torque does; the angles and θ' stay |
| topic | `~/cmd_vel` | geometry_msgs/Twist | drives the pivot: `linear` is its velocity in the world in m/s, each within 10000, `angular` must be 0 |
| service | `~/set_pause` | std_srvs/SetBool | pauses, resumes; the simulated time stands still meanwhile |
| service | `~/step` | std_srvs/Trigger | advances by `step.count` × `step.dt`; only while paused |
| service | `~/reset` | std_srvs/Trigger | starts again with the start state, spin and seed; the next stamp is the date |
| service | `~/record` | std_srvs/SetBool | starts, stops a log; answers when it is open or closed, with path and counts |
| parameters | `spin.l3`, `spin.lz` | double | the same as a command, with a result; set both atomically |
| services | `get_entity_state`, `step_simulation`, … | simulation_interfaces | where that package is installed: [below](#simulation_interfaces) |

The node refuses a command of wrong length, with NaN or infinity, or with Lz ≠ ±L3 while the axis is at a
pole. It logs the reason and counts the command in `/diagnostics`. The motion continues unchanged.

A command, a state set, a velocity of the pivot, a parameter that acts at once and a reset are *events*.
A recording has them, with their times ([Logs](logs.md#events)).

`spin.l3` and `spin.lz` in one request with a parameter of `initial.*` are no command: they are the spin of the
next start, and take effect with `~/reset` as the others do.

## Parameters

An integer is accepted as a double, and so is a number in quotes. A change
takes effect at once, at the next `~/reset`, with the next recording, or only at the start of the node
(read-only).

| parameter | default | unit | allowed values | takes effect | description |
|---|---|---|---|---|---|
"""

COMMANDS = ('sim_node', 'replay_node', 'simulate', 'inspect', 'recover', 'export', 'ensemble',
            'examine', 'grade', 'view')
AFTER_PARAMETERS = """
## simulation_interfaces

[simulation_interfaces](https://github.com/ros-simulation/simulation_interfaces) is the ROS 2 standard for simulators, which Gazebo,
Isaac Sim, O3DE and an RViz plugin share. If that package is installed (`sudo apt install ros-$ROS_DISTRO-simulation-interfaces`),
`sim_node` offers its services; the parameter `simulation_interfaces` set to false turns them off. This is version 2.1.

Names are those of the types, relative to the namespace of the node: `/get_entities`, or `/left/get_entities` with `-r __ns:=/left`.

| service | effect |
|---|---|
| `get_simulator_features` | lists the features offered |
| `get_simulation_state`, `set_simulation_state` | STOPPED, PLAYING, PAUSED, QUITTING |
| `step_simulation` | n steps of the parameter `step.dt`, only in PAUSED |
| `reset_simulation` | time and state (scope 0, 3 or 255), or the state only (2) |
| `get_entities`, `get_entities_states` | the top; filters must be empty |
| `get_entity_state`, `set_entity_state` | pose, twist and acceleration |
| `get_entity_info` | category, description, tags |

Nothing spawns, deletes or renames entities. A refusal has the result code of the standard and an `error_message`, and changes nothing.

<!-- not run: needs the command line tools of a ROS installation -->
```bash
ros2 service call /set_simulation_state simulation_interfaces/srv/SetSimulationState '{state: {state: 2}}'
ros2 service call /step_simulation simulation_interfaces/srv/StepSimulation '{steps: 10}'
ros2 service call /get_entity_state simulation_interfaces/srv/GetEntityState '{entity: spinning_top}'
```

### States, steps and resets

- **STOPPED** is paused, before the first sample. A node with `start_paused`, or one that waits for `/clock`, begins so.
  `set_simulation_state` STOPPED pauses and resets; stamps do not go back.
- **PAUSED** from STOPPED sends the sample of t = 0. A motion that has failed is PAUSED; `error_message` of `get_simulation_state` says why,
  and only STOPPED leads on.
- **QUITTING** closes the recording and ends the process with exit code 0. A node whose `duration` is over is QUITTING.
- `step_simulation` answers after at most two seconds, and says how much is left. The action `SimulateSteps` is not offered.
- Scope 2 of `reset_simulation` resets the top, while time, noise and bias go on. Scopes 1 and 4 are RESULT_FEATURE_UNSUPPORTED.

### The entity

Its name is that of the node, `spinning_top`, its category CATEGORY_ROBOT. Its origin is the pivot.

**`get_entity_state`** answers in `world_frame`, with the stamp up to which all samples have been sent. Linear velocity and
acceleration are those of the pivot, 0 while it rests. The quaternion is that of `ground_truth/odom`, to the last bit.

**`set_entity_state`** sets pose and twist; simulated time goes on. The position must be the pivot, the quaternion a unit one
within 0.001 (else INVALID_POSE), the linear velocity that of the pivot. What is not set stays. The acceleration follows from pose
and twist and is ignored. φ and ψ begin again in [−2π, 2π]; a tilt below 1.5·10⁻⁸ rad is set to 0. `imu/dq` omits the jump, and the `imu/dv` that
contains it has no physical meaning.

## Commands

The site has the help of each command here; `spinning-top NAME --help` prints it. `ros2 run spinning_top_sim NAME` runs the same.
"""

EFFECTS = {Effect.NOW: 'at once', Effect.RESET: 'reset',
           Effect.RECORDING: 'next recording', Effect.START: 'start'}


def page() -> str:
    """Return the page."""
    values = parameters.checked({})
    lines = [HEAD]
    for channel in channels_of(values):
        own = f'{channel.name}.rate'
        rate = own if own in values else 'imu.rate'
        on = 'yes' if parameters.is_enabled(channel.name, values) else 'no'
        lines.append(f'| `{channel.topic}` | {channel.type_name} | {values[rate]:g} | {on} | '
                     f'`{channel.name}.enabled`, `{rate.removeprefix(channel.name)}` |\n')

    def listed(names: Iterable[str]) -> str:
        return ', '.join(f'`{name}`' for name in names)

    lines.append(AFTER_TOPICS.format(
        jump=JUMP_NS / NANOSECONDS, states=listed(state.name.lower() for state in LoopState), joints=listed(JOINTS),
        invariants=listed(INVARIANTS), timing=listed(TIMING)))
    for parameter in parameters.TABLE:
        default = parameter.default
        shown = (str(default).lower() if isinstance(default, bool)
                 else scene_file.default_text(parameter.name))
        allowed = parameter.allowed.removeprefix('must be ')
        lines.append(f'| `{parameter.name}` | {shown} | {parameter.unit} | {allowed} | '
                     f'{EFFECTS[parameter.effect]} | {parameter.text} |\n')
    lines.append(AFTER_PARAMETERS)
    lines += (f'\n### {name}\n\n```{{help-of}} {name}\n```\n' for name in COMMANDS)
    return ''.join(lines)


if __name__ == '__main__':
    Path(__file__).with_suffix('.md').write_text(page())
