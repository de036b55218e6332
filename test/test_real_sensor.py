# SPDX-License-Identifier: Apache-2.0
"""Bandwidth and vibration, measured in what a run sends."""

import math

import numpy as np
import pytest
from helpers.simulations import MILLISECOND, SECOND, run

STANDING = {'initial.theta': 0.0, 'spin.l3': 0.0, 'spin.lz': 0.0, 'solver.method': 'exact'}


@pytest.mark.parametrize('order', [1, 2])
def test_jumps_give_the_step_response_of_the_filter(order):
    """Of the rate about the axis by a command, of the force where the acceleration changes."""
    from scipy import signal

    path = {'pivot.path': (1.001, 0.0, 0.0, 2.0, 0.1500001, 0.0, 0.0, -9.80665)}
    values = {**STANDING, **path, 'spin.l3': 1.0, 'spin.lz': 1.0, 'imu.rate': 1000.0,
              'imu.bandwidth': 10.0, 'imu.bandwidth_order': order}
    _, found = run(values, 2 * SECOND, 'imu/data_raw', events=[
        (300 * MILLISECOND + 123, 'command', {'l3': 2.0, 'lz': 2.0})])
    times_ns, _, rates, force = found['imu/data_raw']
    b, a = signal.butter(order, math.tau * 10.0, analog=True)
    residues, poles, _ = signal.residue(b, (*a, 0.0))

    def step(at_ns):
        late = np.maximum((times_ns - at_ns) * 1e-9, 0.0)
        return np.real(np.exp(np.outer(late, poles)) @ residues)

    assert rates[:, 2] * 0.15 == pytest.approx(1.0 + step(300_000_123), abs=1e-8)
    assert force[:, 2] - 9.80665 == pytest.approx(
        2.0 - 11.80665 * step(1_001 * MILLISECOND) + 9.80665 * step(1_151_000_100), abs=1e-7)


PROFILE = (20.0, 0.1, 80.0, 0.4, 350.0, 0.4, 800.0, 0.07)


def test_noise_has_the_power_of_the_profile_and_the_filter_acts_on_it():
    from scipy import integrate, signal

    values = {**STANDING, 'imu.vibration.force_psd': PROFILE, 'imu.rate': 2000.0}
    frequencies = np.linspace(20.0, 800.0, 200_001)
    density = np.exp(np.interp(np.log(frequencies), np.log(PROFILE[::2]), np.log(PROFILE[1::2])))
    for corner in (0.0, 100.0):
        gain = 1.0 if corner == 0.0 else 1.0 / (1.0 + (frequencies / corner) ** 4)
        _, found = run({**values, 'imu.bandwidth': corner, 'imu.bandwidth_order': 2},
                       6 * SECOND, 'imu/data_raw')
        *_, rates, force = found['imu/data_raw']
        assert not rates.any()
        assert np.var(force, axis=0) == pytest.approx(
            3 * [integrate.simpson(density * gain, x=frequencies)], rel=0.01)
        if corner == 0.0:
            at, spectra = signal.welch(force, 2000.0, nperseg=1024, axis=0)
            assert spectra[(at > 100.0) & (at < 330.0)].mean() == pytest.approx(0.4, rel=0.01)
            assert spectra[at > 830.0].max() < 1e-4
            assert np.abs(np.corrcoef(force.T) - np.eye(3)).max() < 0.05


def test_a_sine_has_its_amplitude_phase_and_gain():
    values = {**STANDING, 'imu.vibration.frequency': 60.0, 'imu.vibration.force': (1.0, 2.0, 0.0),
              'imu.vibration.rate': (0.0, 0.0, 0.5), 'increments.enabled': True}
    gain = 1.0 / (1.0 + 1j)
    for more, factor in (({}, 1.0), ({'imu.bandwidth': 60.0}, gain),
                         ({'imu.sampling': 'mean'}, np.sinc(0.3) * np.exp(-0.3j * math.pi))):
        _, found = run({**values, **more}, SECOND, 'imu/data_raw', 'ground_truth/imu', 'imu/dq')
        times_ns, _, rates, force = (part[1:] for part in found['imu/data_raw'])
        sine = np.imag(factor * np.exp(1j * math.tau * 60.0 * times_ns * 1e-9))
        assert force[:, :2] == pytest.approx(np.outer(sine, (1.0, 2.0)), abs=1e-9)
        assert force[:, 2] == pytest.approx(9.80665, rel=1e-11)
        assert rates == pytest.approx(np.outer(sine, (0.0, 0.0, 0.5)), abs=1e-9)
        assert not found['ground_truth/imu'][3].any()
        if more.get('imu.sampling') == 'mean':
            angle = 2.0 * np.arcsin(found['imu/dq'][2][1:, 2])
            assert angle == pytest.approx(0.005 * rates[:, 2], abs=1e-12)
