# SPDX-License-Identifier: Apache-2.0
"""
Compare the Allan deviation of three simulated hours with the noise parameters.

    PYTHONPATH=. python benchmark/allan.py [--hours H] [--seeds N]

The messages are those that the node publishes, byte for byte, for a top that hangs at rest.  All
seeds from 0 on are shown.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import allantools
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import report
from cases import ROOT
from columns import simulated

from spinning_top_sim.tools.scene_file import read_scene

RATE = 200.0
PERIOD = 1.0 / RATE
HANGING = {'initial.theta': math.pi, 'spin.l3': 0.0, 'spin.lz': 0.0, 'imu.rate': RATE}
KINDS = (('gyroscope', 'rad/s'), ('accelerometer', 'm/s²'))
# White noise and random walk are equal at tau = sqrt(3) N/K, here 0.35 s and 0.87 s.  So both have
# thousands of independent averages in three hours, as an accuracy of 5 % requires.
COMMANDED = {'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_random_walk': 5e-3,
             'imu.accelerometer_noise_density': 2e-2, 'imu.accelerometer_random_walk': 4e-2}
PRESET = 'adis16470'
# A flicker bias whose band has thousands of independent averages in three hours.
BAND = (0.05, 5.0)
FLICKER = {'imu.gyroscope_bias_instability': 1e-3, 'imu.accelerometer_bias_instability': 2e-2,
           'imu.bias_instability_band': BAND}
FLAT = 0.10
# Longest averaging time [s]: longer ones have few independent averages.
LONGEST = 128.0
LIMIT = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--hours', type=float, default=3.0, help='simulated time')
    parser.add_argument('--seeds', type=int, default=5, help='how many: 0, 1, 2, ...')
    options = parser.parse_args()
    seeds = range(options.seeds)
    rows, curves, errors = [], None, []
    for seed in seeds:
        raw, _ = simulate(COMMANDED, seed, options.hours)
        deviations = [allan(axis) for axis in raw.T]
        curves = curves or deviations
        found = [fit(*deviation) for deviation in deviations]
        errors += [np.array(pair) / commanded_of(COMMANDED, KINDS[i // 3][0]) - 1.0
                   for i, pair in enumerate(found)]
        rows += compared(seed, COMMANDED, found)
    preset_rows = from_preset(seeds, options.hours)
    tau, flicker, ends = flicker_over_band(seeds, options.hours)
    assert curves is not None
    draw(curves, options.hours)
    worst = max(float(row[-1].rstrip(' %')) for row in (*rows, *preset_rows)) / 100.0
    spread = np.std(errors, axis=0)
    heads = ('seed', 'kind', 'density', 'commanded', 'x', 'y', 'z', 'worst error')
    report.write('allan.md', '\n'.join([
        report.preamble('Allan deviation', ('numpy', 'allantools', 'matplotlib')),
        INTRODUCTION.format(hours=options.hours, rate=RATE, seeds=len(seeds), limit=LIMIT,
                            longest=LONGEST, worst=worst, verdict='all within' if worst < LIMIT
                            else 'NOT all within'),
        '## Readings\n', FROM_READINGS.format(noise=spread[0], walk=spread[1]),
        report.table(heads, rows),
        f'## The preset {PRESET}\n', FROM_BIAS, report.table(heads, preset_rows),
        '## Bias instability\n', FROM_FLICKER.format(
            band=BAND, flat=FLAT, axes=6 * len(seeds),
            worst=np.abs(flicker - 1.0).max()),
        report.table(('tau [s]', 'Allan deviation over the parameter', 'smallest axis',
                      'largest axis'),
                     [[f'{t:.3g}', f'{f:.3f}', f'{low:.3f}', f'{high:.3f}']
                      for t, f, (low, high) in zip(tau, flicker, ends, strict=True)])]))
    if np.abs(flicker - 1.0).max() >= FLAT:
        raise SystemExit(f'the bias instability is not flat: {flicker}')
    if worst >= LIMIT:
        raise SystemExit(f'off by {worst:.1%}: more than {LIMIT:.0%}')


def from_preset(seeds: Sequence[int], hours: float) -> list[list[str]]:
    """Return the rows of the preset."""
    preset = {name: value for name, value in read_scene(
        ROOT / f'config/imu/{PRESET}.yaml').items() if name.endswith(('_density', '_instability'))}
    rows = []
    for seed in seeds:
        raw, bias = simulate(preset, seed, hours)
        noises = [fit(*allan(axis))[0] for axis in (raw - bias).T]
        flats = [flat_of(*allan(axis)) for axis in bias.T]
        rows += compared(seed, preset, list(zip(noises, flats, strict=True)), 'B')
    return rows


INTRODUCTION = """\
The data are {hours:g} h of a hanging top at {rate:g} Hz, for {seeds} seeds and six axes each. The
estimates are {verdict} {limit:.0%} of the parameters; the largest error is {worst:.1%}. The
overlapping Allan deviation is that of `allantools`, up to {longest:g} s. White noise N and random
walk K are fitted to sigma² = N²/tau + K² tau (2 m² + 1)/(6 m²) over averages of m samples.

![Allan deviation of the readings](allan.png)
"""
FROM_READINGS = """\
From `imu/data_raw` alone. The standard deviation of the relative error over seeds and axes is
{noise:.2%} for N and {walk:.1%} for K.
"""
FROM_BIAS = """\
N from `imu/data_raw` minus `ground_truth/imu_bias`; B, the flat of the Allan deviation, from
`ground_truth/imu_bias`, over averages of 1 s and more.
"""
FROM_FLICKER = """\
Over the band `imu.bias_instability_band`, here {band[0]:g} s to {band[1]:g} s, the Allan deviation
of `ground_truth/imu_bias` is within {flat:.0%} of the parameter; the largest difference is
{worst:.1%}. The table has the root mean square over {axes} curves and their extremes.
"""


def simulate(values: dict[str, float], seed: int, hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Return readings and biases of a run, (n, 6): rates [rad/s], specific force [m/s²]."""
    run = simulated([{**HANGING, **values}], ['imu'], 3600.0 * hours, seed)
    return tuple(np.hstack([run(f'{topic}.{field}') for field in (
        'angular_velocity', 'linear_acceleration')])
        for topic in ('imu/data_raw', 'ground_truth/imu_bias'))


def allan(samples: np.ndarray, longest: float = LONGEST) -> tuple[np.ndarray, np.ndarray, int]:
    """Return averaging times [s], overlapping Allan deviations and the number of samples."""
    longest = min(longest, len(samples) * PERIOD / 4.0)
    powers = 2.0 ** np.arange(int(math.log2(longest / PERIOD)) + 1)
    tau, deviation, _, _ = allantools.oadev(samples, rate=RATE, data_type='freq',
                                            taus=powers * PERIOD)
    return tau, deviation, len(samples)


def fit(tau: np.ndarray, deviation: np.ndarray, count: int) -> tuple[float, float]:
    """Return N and K, weighted least squares on the Allan variance."""
    m = np.round(tau / PERIOD)
    model = np.stack((1.0 / tau, tau * (2.0 * m ** 2 + 1.0) / (6.0 * m ** 2)), axis=1)
    variance = deviation ** 2
    expected = variance
    for _ in range(4):
        scale = np.sqrt(count / m) / expected
        squares = np.linalg.lstsq(model * scale[:, None], variance * scale, rcond=None)[0]
        expected = model @ squares
    noise, walk = np.sqrt(np.maximum(squares, 0.0))
    return float(noise), float(walk)


def flat_of(tau: np.ndarray, deviation: np.ndarray, count: int) -> float:
    """Return the mean Allan deviation from 1 s on, weighted by the independent averages."""
    late = tau >= 1.0
    return float(np.average(deviation[late], weights=1.0 / tau[late]))


def flicker_over_band(seeds: Sequence[int], hours: float) -> tuple[
        np.ndarray, np.ndarray, list[tuple[float, float]]]:
    """Return averaging times, Allan deviations over the parameter, and extremes of the axes."""
    tau = np.unique(np.round(np.geomspace(*BAND, 9) / PERIOD)) * PERIOD
    curves = []
    for seed in seeds:
        _, bias = simulate(FLICKER, seed, hours)
        for i, axis in enumerate(bias.T):
            _, deviation, _, _ = allantools.oadev(axis, rate=RATE, data_type='freq', taus=tau)
            curves.append(deviation / FLICKER[f'imu.{KINDS[i // 3][0]}_bias_instability'])
    found = np.array(curves)
    return (tau, np.sqrt(np.mean(found ** 2, axis=0)),
            list(zip(found.min(axis=0), found.max(axis=0), strict=True)))


def commanded_of(values: dict[str, float], kind: str, second: str = 'K') -> tuple[float, float]:
    """Return N, and K or B, of a kind of axes."""
    name = {'K': 'random_walk', 'B': 'bias_instability'}[second]
    return values[f'imu.{kind}_noise_density'], values[f'imu.{kind}_{name}']


def compared(seed: int, commanded: dict[str, float], found: Sequence[tuple[float, float]],
             second: str = 'K') -> list[list[str]]:
    """Return a row for each kind of axes and each figure: N, and K or B."""
    rows = []
    for i, (kind, unit) in enumerate(KINDS):
        for j, (symbol, per) in enumerate((('N', ' √s'), (second, ' /√s' * (second == 'K')))):
            right = commanded_of(commanded, kind, second)[j]
            axes = [one[j] for one in found[3 * i:3 * i + 3]]
            worst = max(abs(value / right - 1.0) for value in axes)
            rows.append([str(seed), kind, f'{symbol} [{unit}{per}]', f'{right:.4g}',
                         *(f'{value:.4g}' for value in axes), f'{100.0 * worst:.2f} %'])
            print(rows[-1], flush=True)
    return rows


def draw(curves: Sequence[tuple[np.ndarray, np.ndarray, int]], hours: float) -> None:
    """Draw the six curves of the first seed on those commanded."""
    mpl.use('Agg')
    figure, panels = plt.subplots(1, 2, figsize=(11.0, 4.4))
    for i, (panel, (kind, unit)) in enumerate(zip(panels, KINDS, strict=True)):
        noise, walk = commanded_of(COMMANDED, kind)
        for (tau, deviation, _), axis in zip(curves[3 * i:3 * i + 3], 'xyz', strict=True):
            panel.loglog(tau, deviation, 'o-', markersize=3, linewidth=1.0, label=axis)
        panel.loglog(tau, noise / np.sqrt(tau), 'k:', linewidth=1.0, label='N/√τ, K √(τ/3)')
        panel.loglog(tau, walk * np.sqrt(tau / 3.0), 'k:', linewidth=1.0)
        panel.set_ylim(0.5 * min(deviation), 2.0 * max(deviation))
        panel.set_title(kind, fontsize=11)
        panel.set_xlabel('averaging time τ [s]')
        panel.set_ylabel(f'Allan deviation [{unit}]')
        panel.grid(color='#DDDDDD', linewidth=0.6)
        panel.legend()
    figure.suptitle(f'{hours:g} h at {RATE:g} Hz, seed 0, and the parameters', fontsize=11)
    report.save(figure, 'allan.png')


if __name__ == '__main__':
    main()
