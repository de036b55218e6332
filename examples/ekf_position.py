#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Fuse IMU and GNSS of a log in an error-state Kalman filter; compare positions with the truth.

    python examples/ekf_position.py run.mcap --plot position.png

The errors of position, velocity and attitude (in the world) and of the two biases are estimated
(J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, sect. 7, with global
angular errors).  Measurements are taken in the order of their stamps, so that a delay does not
matter.  The filter starts at the true attitude, turned by 3 degrees.
"""

import argparse
from collections import defaultdict

import numpy as np
import pymap3d
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

GRAVITY = np.array((0.0, 0.0, -9.80665))
# Random walks of the biases: rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)
WALKS = 3 * (1e-5,) + 3 * (1e-4,)
START = np.repeat((10.0, 1.0, 0.05, 0.01, 0.1), 3)      # m, m/s, rad, rad/s, m/s^2


def main(argv=None):
    """Run the filter; return errors of the positions and their deviations (n, 3) [m]."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('log')
    parser.add_argument('--plot', metavar='FILE', help='write a picture (PNG)')
    arguments = parser.parse_args(argv)
    messages = read(arguments.log)
    times, estimates, deviations = fuse(messages)
    truth = dict(messages['ground_truth/gnss/fix'])
    first = messages['ground_truth/gnss/fix'][0][1]
    errors = estimates - np.array([enu(truth[stamp], first) for stamp in times])
    raw = np.array([enu(fix, first) - enu(truth[stamp], first)
                    for stamp, fix in messages['gnss/fix'] if fix.status.status >= 0])
    t = 1e-9 * (np.array(times) - times[0])
    settled = errors[t > 0.2 * t[-1]]
    print(f'{len(t)} fixes or gaps; RMS position error after {0.2 * t[-1]:.0f} s: '
          f'{rms(settled):.3f} m, of the fixes alone {rms(raw):.3f} m')
    if arguments.plot:
        plot(arguments.plot, t, errors, deviations)
    return errors, deviations


def read(path):
    """Return {topic: [(stamp [ns], message)]} in the order of the stamps."""
    store, messages = get_typestore(Stores.ROS2_JAZZY), defaultdict(list)
    wanted = ('imu/data_raw', 'ground_truth/imu', 'gnss/fix', 'gnss/velocity',
              'ground_truth/gnss/fix')
    with open(path, 'rb') as file:
        for schema, channel, message in make_reader(file).iter_messages(
                topics=[f'/{topic}' for topic in wanted]):
            data = store.deserialize_cdr(message.data, schema.name)
            stamp = data.header.stamp.sec * 10 ** 9 + data.header.stamp.nanosec
            messages[channel.topic[1:]].append((stamp, data))
    for topic in wanted:
        if not messages[topic]:
            raise SystemExit(f'{path}: there is no message on {topic}')
        messages[topic].sort(key=lambda entry: entry[0])
    return messages


def fuse(messages):
    """Return the stamps [ns] of the fixes, positions and their standard deviations (n, 3) [m]."""
    fixes, velocities = dict(messages['gnss/fix']), dict(messages['gnss/velocity'])
    first = messages['ground_truth/gnss/fix'][0][1]
    position, velocity, biases, P = np.zeros(3), np.zeros(3), np.zeros(6), np.diag(START ** 2)
    attitude = Rotation.from_rotvec((0.03, -0.03, 0.03)) * Rotation.from_quat(
        array(messages['ground_truth/imu'][0][1].orientation))
    found, before = [], None
    for stamp, imu in messages['imu/data_raw']:
        if before is not None:
            dt = 1e-9 * (stamp - before)
            rate = array(imu.angular_velocity) - biases[:3]
            force = array(imu.linear_acceleration) - biases[3:]
            half = attitude * Rotation.from_rotvec(0.5 * dt * rate)
            attitude = half * Rotation.from_rotvec(0.5 * dt * rate)
            R, acceleration = half.as_matrix(), half.apply(force) + GRAVITY
            position = position + dt * (velocity + 0.5 * dt * acceleration)
            velocity = velocity + dt * acceleration
            F = np.eye(15)
            F[0:3, 3:6] = dt * np.eye(3)
            F[3:6, 6:9] = -dt * cross(R @ force)
            F[6:9, 9:12] = F[3:6, 12:15] = -dt * R
            noise = np.r_[np.zeros(3), dt ** 2 * imu.linear_acceleration_covariance[::4],
                          dt ** 2 * imu.angular_velocity_covariance[::4],
                          dt * np.square(WALKS)]
            P = F @ P @ F.T + np.diag(noise)
        before = stamp
        for place, value, covariance in measured(fixes.get(stamp), velocities.get(stamp), first):
            H = np.eye(3, 15, place)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + covariance)
            change = K @ (value - (position, velocity)[place // 3])
            P = (np.eye(15) - K @ H) @ P @ (np.eye(15) - K @ H).T + K @ covariance @ K.T
            position, velocity = position + change[0:3], velocity + change[3:6]
            attitude = Rotation.from_rotvec(change[6:9]) * attitude
            biases = biases + change[9:]
        if stamp in fixes:
            found.append((stamp, position, np.sqrt(np.diag(P)[:3])))
    stamps, estimates, deviations = zip(*found, strict=True)
    return stamps, np.array(estimates), np.array(deviations)


def measured(fix, twist, first):
    """Yield place in the error state, value and covariance (3, 3) of each measurement."""
    if fix is not None and fix.status.status >= 0:
        yield 0, enu(fix, first), fix.position_covariance.reshape(3, 3)
    if twist is not None:
        yield (3, array(twist.twist.twist.linear),
               twist.twist.covariance.reshape(6, 6)[:3, :3])


def enu(fix, first):
    """Return a position east, north, up [m] of the first true one."""
    return np.array(pymap3d.geodetic2enu(fix.latitude, fix.longitude, fix.altitude, first.latitude,
                                         first.longitude, first.altitude))


def array(message):
    """Return x, y, z(, w) of a vector or a quaternion."""
    return np.array([getattr(message, axis) for axis in 'xyzw' if hasattr(message, axis)])


def cross(vector):
    """Return the matrix of the cross product with a vector."""
    x, y, z = vector
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def rms(errors):
    """Return the root mean square of the lengths."""
    return np.sqrt(np.mean(np.sum(errors ** 2, axis=1)))


def plot(path, t, errors, deviations):
    """Draw the errors of each axis within three standard deviations."""
    from matplotlib.figure import Figure
    figure = Figure(figsize=(8, 6), layout='constrained')
    for axes, name, error, deviation in zip(figure.subplots(3, sharex=True),
                                            ('east', 'north', 'up'), errors.T, deviations.T,
                                            strict=True):
        axes.fill_between(t, -3.0 * deviation, 3.0 * deviation, color='0.85', label='3 sigma')
        axes.plot(t, error, label='estimate - truth')
        axes.set(ylabel=f'{name} [m]')
    axes.set(xlabel='t [s]')
    axes.legend(loc='upper right')
    figure.savefig(path)


if __name__ == '__main__':
    main()
