#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Print a line for each message on a topic: its stamp, its fields, and the rate of the last ones.

    python examples/listen.py pose
    python examples/listen.py imu/data_raw --count 10

The type of the topic is that of its publisher.  Ctrl-C ends it.
"""

import argparse
import time
from collections import deque
from importlib import import_module

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_sensor_data

MOST_NUMBERS = 13       # of a line; covariances and long arrays are left out


def numbers(message, within=''):
    """Yield FIELD=VALUE for the numbers in a message, without its header."""
    for name in message.get_fields_and_field_types():
        value, field = getattr(message, name), within + name
        if isinstance(value, int | float):
            yield f'{field}={value:+.4f}'
        elif hasattr(value, 'get_fields_and_field_types'):
            if name != 'header':
                yield from numbers(value, f'{field}.')
        elif 'covariance' not in name and not isinstance(value, str) and len(value) <= 8:
            yield from (f'{field}[{k}]={x:+.4f}' for k, x in enumerate(value)
                        if isinstance(x, float))


def wait_for_type(node, topic):
    """Return the class of the messages on a topic, as soon as somebody publishes there."""
    begin, told = time.monotonic(), 0
    while True:
        topics = {name: types for name, types in node.get_topic_names_and_types()
                  if node.count_publishers(name)}
        if topic in topics:
            package, _, kind = topics[topic][0].partition('/msg/')
            return getattr(import_module(f'{package}.msg'), kind)
        if not told:
            print(f'waiting for a publisher on {topic}', flush=True)
            told = 1
        elif told == 1 and time.monotonic() - begin > 3.0:
            print(f'published are {", ".join(sorted(topics))}', flush=True)
            told = 2
        rclpy.spin_once(node, timeout_sec=0.2)


def main():
    """Listen until Ctrl-C, or to so many messages."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('topic', help='such as pose, imu/data_raw, spinning_top/invariants')
    parser.add_argument('--count', type=int, default=0, help='end after so many; 0 = never')
    arguments = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('listener')
    arrivals, heard = deque(maxlen=200), 0

    def show(message):
        nonlocal heard
        heard += 1
        arrivals.append(time.monotonic())
        since = arrivals[-1] - arrivals[0]
        rate = f'  {(len(arrivals) - 1) / since:.1f} Hz' if since else ''
        stamp = getattr(getattr(message, 'header', None), 'stamp', None)
        when = f'{stamp.sec}.{stamp.nanosec:09d}  ' if stamp else ''
        print(f'{when}{"  ".join([*numbers(message)][:MOST_NUMBERS])}{rate}', flush=True)

    try:
        topic = node.resolve_topic_name(arguments.topic)
        # Best effort takes what any publisher offers.
        node.create_subscription(wait_for_type(node, topic), topic, show, qos_profile_sensor_data)
        while not arguments.count or heard < arguments.count:
            rclpy.spin_once(node, timeout_sec=1.0)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == '__main__':
    main()
