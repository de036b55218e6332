# SPDX-License-Identifier: Apache-2.0
"""
Compare published attitude filters with the truth, on the scene `wavy`:

    PYTHONPATH=. python benchmark/attitude_filter.py

The filters and the comparison are those of examples/attitude_filter.py.  The benchmark varies the
position of the IMU, its rate, its errors and the gain of the filter.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import matplotlib as mpl
import report
from cases import ROOT

from spinning_top_sim.tools import simulate

DURATION, SETTLE, RATE = 120, 60, 200
SCENE = ROOT / 'config/wavy.yaml'
ARMS_CM, ENDS_CM = (0, 5, 10), (0, 10)
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
        arms = {f'{arm} cm': compare(place, arm) for arm in ARMS_CM}
        rates = {f'{rate} Hz': compare(place, rate=rate) for rate in RATES}
        presets = {f'`{preset}`, {arm} cm': compare(place, arm, preset=preset)
                   for preset in PRESETS for arm in ENDS_CM}
        headings = {f'{arm} cm, {rate} Hz': compare(place, arm, rate, names=nine_axes(), mag=True)
                    for arm in ENDS_CM for rate in RATES}
        gains = {f'{arm} cm': compare(place, arm, names=[gain_name(gain) for gain in GAINS])
                 for arm in ENDS_CM}
    draw(arms)
    report.write('attitude_filter.md', '\n'.join((
        report.preamble('Attitude filters', ('numpy', 'vqf', 'ahrs', 'matplotlib')),
        INTRODUCTION.format(scene=SCENE.stem, duration=DURATION, settle=SETTLE, rate=RATE),
        '## Lever arm\n', table('lever arm', arms),
        '## Rate\n', 'With a perfect IMU at the pivot.\n', table('rate', rates),
        '## Nine axes\n', NINE, report.table(
            ('lever arm, rate', *(f'{name} [deg]' for name in nine_axes())),
            [(label, *(f'{one.summary(SETTLE).heading_max:.2g}' for one in found))
             for label, found in headings.items()]),
        "## Gain of Madgwick's filter\n", table('lever arm', gains),
        '## Presets\n', 'With seed 0, not calibrated.\n', table('preset, lever arm', presets))))


INTRODUCTION = """\
The data are {duration} s of the scene `{scene}`, with a tilt near 30 degrees and 10.7 rad/s of
spin, at {rate} Hz unless a table says otherwise. Every filter starts level, and gets the mean of
two consecutive angular velocities for the step between them. The tables have the rms error of the
tilt from {settle} s on, and in brackets the drift of the heading, which six axes cannot observe.

- `vqf`: package vqf (Laidig and Seel 2023). It integrates in closed form, and corrects the tilt by
  the specific force averaged over 3 s in an inertial frame.
- `madgwick`, `ekf`: package ahrs. They take first-order steps, and treat every sample of the
  specific force as gravity.

![Tilt errors over time](attitude_filter.png)
"""
NINE = """\
With a perfect magnetometer at 100 Hz: largest error of the heading. `vqf9 mean` gets the mean of
two angular velocities, `vqf9` rates whose rotation is right to third order.
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


def draw(arms: dict[str, list]) -> None:
    """Draw the tilt errors at the pivot and on the longest lever arm."""
    mpl.use('Agg')
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.2), sharey=True)
    for panel, arm in zip(panels, ENDS_CM, strict=True):
        for one in arms[f'{arm} cm']:
            FILTERS.draw([panel], one, SETTLE, linewidth=0.9)
        panel.set_title('IMU at the pivot' if arm == 0 else f'IMU {arm} cm off the axis',
                        fontsize=11)
        panel.grid(color='#DDDDDD', linewidth=0.6)
        panel.set_axisbelow(True)
    panels[1].set_ylabel('')
    panels[0].set_ylim(3e-3, 100.0)
    panels[0].legend(loc='upper right')
    report.save(figure, 'attitude_filter.png')


if __name__ == '__main__':
    main()
