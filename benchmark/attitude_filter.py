# SPDX-License-Identifier: Apache-2.0
"""
Compare published attitude filters with the truth, on the scene `wavy`:

    PYTHONPATH=. python benchmark/attitude_filter.py

The filters and the comparison are those of examples/attitude_filter.py.  The benchmark varies the
position of the IMU, its rate, its errors and the gain of the filter.  It also integrates the rates
alone, which bounds the accuracy of every filter.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import matplotlib as mpl
import numpy as np
import report
from ahrs.filters import AngularRate
from cases import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.scene_file import read_scene

DURATION, SETTLE, RATE = 120, 60, 200
SCENE = ROOT / 'config/wavy.yaml'
ARMS_CM = (0, 5, 10)
RATES = (100, 200, 1000)
PRESETS = ('perfect', 'adis16470', 'icm_42688_p', 'bmi088', 'icm_20948')
GAINS = (0.033, 0.1, 0.3, 1.0)


def example() -> ModuleType:
    """Return examples/attitude_filter.py."""
    name = 'attitude_filter_example'
    spec = importlib.util.spec_from_file_location(name, ROOT / 'examples/attitude_filter.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


FILTERS = example()
NAMES = tuple(name for name in FILTERS.FILTERS if name not in FILTERS.NINE_AXES)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        by_arm = {arm: compare(place, arm_cm=arm) for arm in ARMS_CM}
        by_rate = {rate: compare(place, rate=rate) for rate in RATES if rate != RATE}
        by_rate[RATE] = by_arm[0]
        by_preset = {(preset, arm): compare(place, arm_cm=arm, preset=preset)
                     for preset in PRESETS[1:] for arm in (0, ARMS_CM[-1])}
        by_preset.update({(PRESETS[0], arm): by_arm[arm] for arm in (0, ARMS_CM[-1])})
        headings = {(arm, rate): compare(place, arm_cm=arm, rate=rate, names=nine_axes(), mag=True)
                    for arm in (0, ARMS_CM[-1]) for rate in RATES}
        gains = {arm: compare(place, arm_cm=arm, names=[gain_name(gain) for gain in GAINS])
                 for arm in (0, ARMS_CM[-1])}
    draw(by_arm)
    turned = math.degrees(spin() / RATE)
    text = [report.preamble('Attitude filters', ('numpy', 'vqf', 'ahrs', 'matplotlib')),
            INTRODUCTION.format(scene=SCENE.stem, duration=DURATION, settle=SETTLE, rate=RATE,
                                spin=spin(), turned=turned)]
    text += ['## Where the IMU sits\n', ARM,
             table('lever arm', {f'{arm} cm': by_arm[arm] for arm in ARMS_CM})]
    text += ['## How often it is read\n', OFTEN.format(
        lag=math.degrees(lag()), rate=RATE),
        table('rate', {f'{rate} Hz': by_rate[rate] for rate in RATES})]
    text += ['## Integration alone\n', INTEGRATION, integration()]
    text += ['## Nine axes\n', NINE, report.table(
        ('lever arm, rate', *(f'{one.name} [deg]' for one in headings[0, RATE])),
        [(f'{arm} cm, {rate} Hz', *(f'{one.summary(SETTLE).heading_max:.2g}' for one in found))
         for (arm, rate), found in headings.items()])]
    text += ['## Gain\n', GAIN, table('lever arm', {f'{arm} cm': gains[arm] for arm in gains})]
    text += ['## Errors of the IMU\n', NOISE, table('preset, lever arm', {
        f'`{preset}`, {arm} cm': by_preset[preset, arm]
        for preset in PRESETS for arm in (0, ARMS_CM[-1])})]
    report.write('attitude_filter.md', '\n'.join(text))


INTRODUCTION = """\
The data are {duration} s of the scene `{scene}`, with a tilt near 30 degrees and {spin:.3g} rad/s
of spin. The rate of the IMU is {rate} Hz; the top turns by {turned:.2g} degrees from one sample
to the next. Every filter starts level. It gets the mean of two consecutive angular velocities for
the step between them. The tables have the rms error of the tilt from {settle} s on, which is the
angle between the estimated and the true vertical. In brackets is the drift of the heading, which
six axes cannot observe.

- `vqf`: VQF (Laidig and Seel 2023), package vqf. It integrates the rates in closed form, and
  corrects the tilt by the specific force averaged over 3 s in an inertial frame.
- `madgwick`, `ekf`: package ahrs. They take first-order steps, and treat every sample of the
  specific force as gravity.

![Tilt errors over time](attitude_filter.png)
"""
ARM = """\
The pivot does not move, so the accelerometer there measures gravity only. A lever arm across the
axis adds centripetal and tangential acceleration, which turn with the body. A filter that treats
each sample as gravity tilts towards them. In an inertial frame they cancel over a few turns, and
VQF averages there.
"""
OFTEN = """\
With a perfect IMU at the pivot, the remaining error is that of the filter. The error of VQF is
proportional to the square of the step, as that of the mean of two angular velocities. Madgwick's
filter compares the new sample of the specific force with the attitude before the step; in the
sensor frame, gravity turns by {lag:.3g} degrees in 1/{rate} s. The drift of the heading shows the
error of first-order steps.
"""
INTEGRATION = """\
`AngularRate` of ahrs integrates the rates of a perfect IMU from the true attitude. The table has
the angle to the true attitude after 60 s, divided by 60 s. With `last`, a sample counts for the
step that it ends, as in most drivers; with `mean`, the mean of both ends counts.
"""
NINE = """\
With a perfect magnetometer at 100 Hz VQF knows the heading. The table has its largest error from
the same time on. With the mean of two angular velocities, `vqf9 mean`, it is the drift of the
heading in the 9 s within which the magnetometer corrects it. `vqf9` gets rates whose rotation is
right to third order. On a lever arm the error is that of the filter, at every rate.
"""
GAIN = """\
The gain is the only setting of Madgwick's filter, in rad/s. With a low gain the filter needs
minutes to converge from 30 degrees on a lever arm; with a high gain it follows the acceleration.
"""
NOISE = """\
These are the presets of config/imu with seed 0. Turn-on bias, white noise and resolution are
those of the data sheets. A bias of the gyroscope acts against the correction of the tilt, and is
a drift of the heading. VQF estimates the bias, but limits it to 2 deg/s. Without calibration,
`icm_20948` has a bias of 5 deg/s and more.
"""


def compare(folder: Path, arm_cm: int = 0, rate: int = RATE, preset: str = PRESETS[0],
            names: tuple[str, ...] | list[str] = NAMES, mag: bool = False) -> list:
    """Simulate, filter, and return a Comparison for each filter."""
    log = folder / f'{arm_cm}_{rate}_{preset}{"_mag" * mag}.mcap'
    if not log.exists():
        code = simulate.main([
            '--quiet', '-o', str(log), '--duration', str(DURATION), '--params', str(SCENE),
            '--params', str(ROOT / f'config/imu/{preset}.yaml'), '-p', 'solver.method:=exact',
            '-p', f'imu.rate:={rate}', '-p', f'imu.lever_arm:=[{arm_cm / 100}, 0.0, 0.0]',
            '-p', f'mag.enabled:={str(mag).lower()}', '-p', 'record.streams:=[imu, pose, mag]'])
        assert code == 0
    found = FILTERS.compare(log, names)
    print(log.stem, *(str(one.summary(SETTLE)) for one in found), sep='\n  ', flush=True)
    return found


def gain_name(gain: float) -> str:
    """Return the name of Madgwick's filter with a gain, known to the example from then on."""
    name = f'gain {gain:g}'
    FILTERS.FILTERS[name] = functools.partial(FILTERS.madgwick, gain=gain)
    return name


def nine_axes() -> list[str]:
    """Return the names of VQF with nine axes, that with mean rates known from then on."""
    name = 'vqf9 mean'
    FILTERS.FILTERS[name] = functools.partial(FILTERS.vqf9, third_order=False)
    FILTERS.NINE_AXES.add(name)
    return [name, 'vqf9']


def table(head: str, rows: dict[str, list]) -> str:
    """Return rms of tilt and drift of heading, a row a case, a column a filter."""
    names = [one.name for one in next(iter(rows.values()))]
    lines = []
    for label, found in rows.items():
        summaries = [one.summary(SETTLE) for one in found]
        lines.append((label, *(f'{one.tilt_rms:.3g} ({one.heading_rate:+.2g}/s)'
                               for one in summaries)))
    return report.table((head, *(f'{name} [deg]' for name in names)), lines)


def motion(rate: int, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return exact rates (n, 3) [rad/s] and attitudes w, x, y, z (n, 4) at the pivot."""
    values = parameters.checked(read_scene(SCENE))
    imu = Imu(values)
    times = np.array([round(k * 1e9 / rate) for k in range(seconds * rate + 1)])
    states = ExactSolution(parameters.top_of(values), parameters.start_state(values)).states(times)
    rates = np.empty((len(times), 3))
    for k, column in enumerate(imu.true(states)[0]):
        rates[:, k] = column
    x, y, z, w = imu.orientation(states)
    return rates, np.stack((w, x, y, z), axis=1)


def spin() -> float:
    """Return the rate about the axis [rad/s]."""
    values = parameters.checked(read_scene(SCENE))
    return values['spin.l3'] / values['top.lambda3']


def lag() -> float:
    """Return how far gravity moves in the sensor from one sample to the next, rms [rad]."""
    _, attitudes = motion(RATE, 10)
    w, x, y, z = attitudes.T
    up = np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), axis=1)
    return float(np.sqrt(np.mean(np.sum(np.diff(up, axis=0) ** 2, axis=1))))


def integration() -> str:
    """Return the table of what the integration alone loses."""
    seconds, lines = 60, []
    for rate in RATES:
        rates, attitudes = motion(rate, seconds)
        row = [f'{rate} Hz']
        for method in ('series', 'closed'):
            for mean in (False, True):
                used = 0.5 * (rates[1:] + rates[:-1]) if mean else rates[1:]
                integrator, attitude = AngularRate(Dt=1 / rate), attitudes[0]
                for one in used:
                    attitude = integrator.update(attitude, one, method=method, order=1)
                reached, truth = (Rotation.from_quat(np.roll(quaternion, -1))
                                  for quaternion in (attitude, attitudes[-1]))
                angle = (reached * truth.inv()).magnitude()
                row.append(f'{math.degrees(angle) / seconds:.2g}')
        lines.append(row)
        print('integration', row, flush=True)
    return report.table(('rate', *(f'{method}, {which} [deg/s]' for method in
                                   ('first order', 'closed form') for which in ('last', 'mean'))),
                        lines)


def draw(by_arm: dict[int, list]) -> None:
    """Draw the tilt errors at the pivot and on the longest lever arm."""
    mpl.use('Agg')
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True)
    for panel, arm in zip(panels, (0, ARMS_CM[-1]), strict=True):
        for one in by_arm[arm]:
            FILTERS.draw([panel], one, SETTLE, linewidth=0.9)
        panel.set_title('IMU at the pivot' if arm == 0 else f'IMU {arm} cm off the axis',
                        fontsize=11)
        panel.grid(color='#DDDDDD', linewidth=0.6)
        panel.set_axisbelow(True)
    panels[1].set_ylabel('')
    panels[0].set_ylim(3e-3, 100.0)
    panels[0].legend(loc='upper right')
    figure.tight_layout()
    path = ROOT / 'docs/attitude_filter.png'
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f'wrote {path.relative_to(ROOT)}')


if __name__ == '__main__':
    main()
