#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Run `sim_node` for a long time, and measure its memory, its logs and its errors.

    python benchmark/soak.py                    # ten minutes
    python benchmark/soak.py --minutes 60

The node publishes three streams at 1 kHz with one tick per sample.  A subscribing process starts
and ends repeatedly, and so does the recording.  A parameter changes every second (a command, an
enabled stream or a rate in turn).  The report has the resident memory, the missing samples in
each log and the errors that the node has printed.  The rate of growth is the slope of a straight
line through the memory of every second after the first minute.  Single seconds vary by some MB,
so that medians of minutes are compared.  The exit code is 1 if the median of a minute is more than
2 MB above that of the second minute, if the slope exceeds 4 MB an hour, if a sample is missing, or
if there is an error.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader
from processes import SIM_NODE, Process, load, median, ros_arguments, script
from report import preamble, table, write_section

RATE = 1000.0
STREAMS = ('pose', 'joint_states', 'imu')
GROWTH_BYTES = 2_000_000
GROWTH_BYTES_PER_HOUR = 4_000_000
SETTLED_S = 60.0
LOG_EVERY_S, LISTEN_EVERY_S = 60.0, 15.0        # between start and end of a subscriber
TROUBLE = ('Traceback', '[ERROR]', 'Error', 'not recording')


class Client:
    """Calls the node's services from this process."""

    def __init__(self, namespace: str) -> None:
        import rclpy
        from rcl_interfaces.srv import SetParameters
        from std_srvs.srv import SetBool

        rclpy.init()
        self._rclpy, self._set_bool, self._set_parameters = rclpy, SetBool, SetParameters
        self.node = rclpy.create_node('soak')
        name = f'{namespace}/spinning_top'
        self._record = self.node.create_client(SetBool, f'{name}/record')
        self._parameters = self.node.create_client(SetParameters, f'{name}/set_parameters')
        for client in (self._record, self._parameters):
            if not client.wait_for_service(30.0):
                raise SystemExit('the node is not there')

    def _call(self, client, request):
        future = client.call_async(request)
        self._rclpy.spin_until_future_complete(self.node, future, timeout_sec=30.0)
        if not future.done():
            raise SystemExit(f'no answer from {client.srv_name}')
        return future.result()

    def record(self, on: bool) -> str:
        """Start or stop a log; return the response.  Raises SystemExit on refusal."""
        answer = self._call(self._record, self._set_bool.Request(data=on))
        if not answer.success:
            raise SystemExit(answer.message)
        return answer.message

    def set(self, name: str, value: object) -> None:
        """Change a parameter.  Raises SystemExit on refusal."""
        from rclpy.parameter import Parameter

        result = self._call(self._parameters, self._set_parameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()])).results[0]
        if not result.successful:
            raise SystemExit(result.reason)

    def close(self) -> None:
        self.node.destroy_node()
        self._rclpy.try_shutdown()


CHANGES = itertools.cycle((
    ('spin.l3', 1.61), ('ground_truth_imu.rate', 50.0), ('invariants.rate', 50.0),
    ('ground_truth_odom.enabled', False), ('spin.l3', 1.6), ('ground_truth_imu.rate', 200.0),
    ('invariants.rate', 10.0), ('ground_truth_odom.enabled', True)))


def missing_in(path: Path) -> dict[str, tuple[int, int]]:
    """Return (messages, missing) of each 1 kHz topic of a log."""
    stamps: dict[str, list[int]] = {}
    with path.open('rb') as file:
        for _, channel, message in make_reader(file).iter_messages():
            stamps.setdefault(channel.topic, []).append(message.log_time)
    period = round(1e9 / RATE)
    return {topic: (len(times), (times[-1] - times[0]) // period + 1 - len(times))
            for topic, times in stamps.items()
            if topic.endswith(('/pose', '/joint_states', '/imu/data_raw'))}


def soak(minutes: float, folder: Path) -> dict:
    """Run the node; return the observations."""
    namespace = '/soak'
    parameters = {'tick_rate': RATE, 'status_period': 0.0,
                  'record.uri': f'{folder}/', 'imu.gyroscope_noise_density': 1e-3,
                  **{f'{name}.rate': RATE for name in STREAMS}}
    memory: list[tuple[float, int]] = []
    listener, arrived = None, 0
    errors = (folder / 'stderr').open('w')
    with Process((*SIM_NODE, *ros_arguments(namespace, parameters)), stderr=errors) as node:
        client = Client(namespace)
        begin = time.monotonic()
        next_log = next_listener = begin
        recording = False
        for second in itertools.count(1):
            now = time.monotonic()
            if now - begin > 60.0 * minutes or not node.alive:
                break
            if now >= next_log:
                if recording:
                    client.record(False)
                client.record(True)
                recording, next_log = True, now + LOG_EVERY_S
            if now >= next_listener:
                next_listener = now + LISTEN_EVERY_S
                if listener is None:
                    listener = Process((*script('listener.py'), namespace), talks=True)
                    listener.line()
                else:
                    listener.tell('report')
                    arrived += len(listener.line())
                    listener.end()
                    listener = None
            client.set(*next(CHANGES))
            memory.append((now - begin, node.memory()))
            time.sleep(max(0.0, begin + second - time.monotonic()))
        said = client.record(False) if node.alive else ''
        if listener is not None:
            listener.end()
        client.close()
        code = node.end()
    errors.close()
    return {'memory': memory, 'code': code, 'said': said, 'arrived': arrived,
            'stderr': (folder / 'stderr').read_text(),
            'logs': {path.name: missing_in(path) for path in sorted(folder.glob('*.mcap'))}}


def judge(seen: dict) -> tuple[list[tuple[str, str]], bool]:
    """Return the rows of the report, and whether the run passes."""
    times, settled = zip(*(one for one in seen['memory'] if one[0] >= SETTLED_S), strict=True)
    slope = 3600.0 * statistics.linear_regression(times, settled).slope
    minutes = [median(settled[k:k + 60]) for k in range(0, len(settled), 60)]
    growth = max(minutes) - minutes[0]
    topics = [found for log in seen['logs'].values() for found in log.values()]
    count, missing = (sum(found[k] for found in topics) for k in (0, 1))
    trouble = [line for line in seen['stderr'].splitlines() if any(t in line for t in TROUBLE)]
    rows = [('resident memory in the second minute (median) [MB]', f'{minutes[0] / 1e6:.1f}'),
            ('largest median of a minute, relative to that [MB]', f'{growth / 1e6:+.2f}'),
            ('largest second, relative to that [MB]', f'{(max(settled) - minutes[0]) / 1e6:+.2f}'),
            ('at the end, relative to that [MB]', f'{(settled[-1] - minutes[0]) / 1e6:+.2f}'),
            ('rate of growth after the first minute [MB/h]', f'{slope / 1e6:+.2f}'),
            ('logs', str(len(seen['logs']))), ('samples in them', str(count)),
            ('samples missing in them', str(missing)),
            ('lines of errors', str(len(trouble))), ('exit code', str(seen['code']))]
    fine = (growth <= GROWTH_BYTES and slope <= GROWTH_BYTES_PER_HOUR and missing == 0
            and count > 0 and not trouble and seen['code'] == 0)
    print('\n'.join(trouble))
    return rows, fine


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, default=10.0, help='more than 1')
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    if arguments.minutes <= 1.0:
        parser.error(f'--minutes {arguments.minutes:g}: must be more than 1')
    head = preamble('A long run')        # with the commit that is there now
    with tempfile.TemporaryDirectory() as name:
        seen = soak(arguments.minutes, Path(name))
    rows, fine = judge(seen)
    text = '\n'.join((f'{arguments.minutes:g} minutes; load average at the end {load():.1f}.\n',
                      table(('', ''), rows)))
    print(text)
    if not arguments.no_report:
        write_section('soak', head, __doc__, text)
    return 0 if fine else 1


if __name__ == '__main__':
    sys.exit(main())
