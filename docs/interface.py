#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write docs/interface.md from the tables in the code: `python docs/interface.py`."""

from pathlib import Path

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.all_streams import all_streams
from spinning_top_sim.streams.topics import INVARIANTS, JOINTS

HEAD = """<!-- Written by docs/interface.py from the code. -->
# Interface of sim_node

The node is `spinning_top` in the namespace it is given. All names are relative unless they begin
with `/`; `~` is the node's own name.

## Topics it publishes

Publishers are reliable and keep the last 10; QoS can be overridden as usual, by parameters
`qos_overrides.<resolved topic>.publisher.<policy>`.

| topic | type | rate [Hz] | on | switched by |
|---|---|---|---|---|
"""

AFTER_TOPICS = """| `/diagnostics` | diagnostic_msgs/msg/DiagnosticArray | 1 | yes | |

- `pose`: frame `world_frame`, q(world ← body), position at the pivot (0, 0, 0).
- `joint_states`: {joints}: φ, θ, ψ [rad], unwrapped, and their rates [rad/s].
- `imu/data_raw` (REP-145): angular velocity [rad/s] and specific force [m/s²] in `imu.frame_id`,
  +g upwards at rest; `orientation_covariance[0]` = −1: it carries no orientation.
- `imu/data`: the same with the orientation of the IMU in the world.
- `ground_truth/imu`, `ground_truth/odom`: exact and noise-free; covariances are 0 because they are.
  The odometry's twist is in the body frame.
- `~/invariants`: one labelled dimension, {invariants}. Drifts are relative to the value the motion
  began with; the orientation error [rad] is against the exact solution.
- `markers`: in `world_frame`, so no TF is needed: a cylinder with the top's mass and moments of inertia,
  lines on it that show the spin, and the trace of the tip over the last `markers.trace_length`. Every
  message has the whole trace; it is the exact solution's, and ends at the tip as the solver has it.
- While paused nothing is sent. Stamps are the time of each sample on the grid k × period.

## Topics, services, parameters it listens to

| kind | name | type | what it does |
|---|---|---|---|
| topic | `~/commands` | std_msgs/Float64MultiArray | [L3, Lz] in kg m²/s: an impulsive torque. Angles and θ' stay |
| service | `~/set_pause` | std_srvs/SetBool | pause, resume; no catch-up |
| service | `~/step` | std_srvs/Trigger | while paused: `step.count` × `step.dt` |
| service | `~/reset` | std_srvs/Trigger | start state, spin and seed again; stamps go on |
| service | `~/record` | std_srvs/SetBool | start, stop; the reply has path and counts |
| parameters | `spin.l3`, `spin.lz` | double | a command with an answer: set both atomically |

A command that is refused (wrong length, NaN, infinite, Lz ≠ ±L3 with the axis at a pole) is logged
with the reason and counted in `/diagnostics`; the motion goes on unchanged.

## Parameters

An integer is taken for a double. Those marked *reset* wait for `~/reset`, those marked *start*
cannot be changed while the node runs.

| parameter | default | unit | allowed | takes effect | what it is |
|---|---|---|---|---|---|
"""

EFFECTS = {parameters.Effect.NOW: 'at once', parameters.Effect.RESET: 'reset',
           parameters.Effect.RECORDING: 'next recording', parameters.Effect.START: 'start'}


def page() -> str:
    """Return the page."""
    values = parameters.checked({})
    lines = [HEAD]
    for stream in all_streams(values):
        rate, on = values[f'{stream.parameter}.rate'], values[f'{stream.parameter}.enabled']
        lines.append(f'| `{stream.topic}` | {stream.type_name} | {rate:g} | '
                     f'{"yes" if on else "no"} | `{stream.parameter}.enabled`, `.rate` |\n')
    lines.append(AFTER_TOPICS.format(joints=', '.join(f'`{name}`' for name in JOINTS),
                                     invariants=', '.join(f'`{name}`' for name in INVARIANTS)))
    for parameter in parameters.TABLE:
        default = parameter.default
        shown = 'unset' if default is None else list(default) if isinstance(
            default, tuple) else str(default).lower() if isinstance(default, bool) else default
        allowed = parameter.allowed.removeprefix('must be ')
        lines.append(f'| `{parameter.name}` | {shown} | {parameter.unit} | {allowed} | '
                     f'{EFFECTS[parameter.effect]} | {parameter.text} |\n')
    return ''.join(lines)


if __name__ == '__main__':
    Path(__file__).with_suffix('.md').write_text(page())
