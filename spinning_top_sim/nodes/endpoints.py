# SPDX-License-Identifier: Apache-2.0
"""What nodes need of message types, publishers and services beside rclpy."""

import importlib
import os
import re
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.task import Future
from rclpy.type_support import check_for_type_support


def message_class(type_name: str) -> type:
    """
    Return a message class of an installed ROS package, of which publishers can be made.

    Raises LookupError for any other name.
    """
    # REP-144 and the ROS 2 interface names.
    match = re.fullmatch(r'([a-z][a-z0-9_]*)/(?:msg/)?([A-Z][A-Za-z0-9_]*)', type_name)
    package, name = match.groups() if match else ('', '')
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    # Other Python packages must not be imported because a log names them.
    if not any(Path(prefix, 'share/ament_index/resource_index/packages', package).is_file()
               for prefix in prefixes):
        raise LookupError(f'{type_name} is not installed')
    try:
        kind: type = getattr(importlib.import_module(f'{package}.msg'), name)
        check_for_type_support(kind)
    except Exception as error:      # importing a broken package may raise anything
        raise LookupError(f'{type_name} cannot be used: {error}') from error
    return kind


def wait_for_all_acked(publishers: Iterable[Publisher], seconds: float) -> bool:
    """Wait at most so long; return whether all subscribers have acknowledged all messages."""
    end = time.monotonic() + seconds
    return all(not publisher.get_subscription_count() or publisher.wait_for_all_acked(
        Duration(seconds=max(end - time.monotonic(), 0.001))) for publisher in publishers)


def answers_later(service: Service) -> Service:
    """
    Let callbacks of a service return a Future of the response, which is sent when that is done.

    rclpy's EventsExecutor has no coroutines for services.
    """
    send = service.send_response

    def send_when_done(response: Any, header: object) -> None:
        if isinstance(response, Future):
            response.add_done_callback(lambda done: send(done.result(), header))
        else:
            send(response, header)

    vars(service)['send_response'] = send_when_done
    return service
