# SPDX-License-Identifier: Apache-2.0
"""What the executables of nodes share: start, spin, end properly on every signal."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from spinning_top_sim.installation import needed, remedy
from spinning_top_sim.recording.errors import text_of
from spinning_top_sim.times import NANOSECONDS, check_stamp
from spinning_top_sim.tools import cli

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node


def run_node(name: str, argv: Sequence[str] | None,
             prepare: Callable[[list[str]], tuple[list[str], Callable[[], Any]]]) -> int:
    """
    Run the node of `spinning-top NAME`; return its exit code.

    argv : arguments, None for those of the program
    prepare : takes the arguments; returns those for ROS, and what makes the node: with `start`,
        `stop`, and a Future `finished`, which completes with the exit code, None for 0
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    name = f'spinning-top {name}'
    # Nothing is open yet, and a KeyboardInterrupt is easily lost during imports.
    _handle(lambda *_: os._exit(cli.INTERRUPTED), signal.SIGINT)
    # Open the streams that the shell has closed (2>&-); otherwise a log gets their number.
    while os.open(os.devnull, os.O_RDWR) <= 2:
        pass
    sys.stderr = sys.stderr or open(2, 'w')     # noqa: SIM115 - rclpy needs it to the end
    try:
        with needed('it'):
            argv, make_node = prepare(argv)
        import rclpy  # noqa: PLC0415
        # From `init` on, rclpy shuts the context down at SIGINT and SIGTERM.  A launched node gets
        # SIGINT twice, from the terminal and from launch.
        interrupts: list[int] = []
        _handle(lambda number, _: interrupts.append(number), signal.SIGINT, signal.SIGTERM)
        _handle(lambda *_: signal.raise_signal(signal.SIGTERM), signal.SIGHUP, signal.SIGQUIT)
        rclpy.init(args=[name, *argv])
    except Exception as error:
        return _cannot_start(name, error)
    node, started = None, False
    try:
        node = make_node()
        guard_clock(node)
        executor = _executor(node)
        node.start()
        started = True
        # Python handles signals between waits; without a timeout, Jazzy's EventsExecutor hangs.
        while rclpy.ok() and not interrupts and not node.finished.done():
            executor.spin_until_future_complete(node.finished, 0.5)
        return (node.finished.done() and node.finished.result()) or cli.OK
    except Exception as error:
        # A call may raise anything when the context ends.
        if rclpy.ok() and started:
            raise
        return _cannot_start(name, error) if rclpy.ok() else cli.OK
    finally:
        signals = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT
        _handle(lambda *_: None, *signals)      # if ignored, one that waits prints a traceback
        if node is not None:
            node.stop()
            node.destroy_node()
        rclpy.try_shutdown()
        _handle(signal.SIG_IGN, *signals)       # the end of Python restores the handlers


def guard_clock(node: Node) -> None:
    """Let a node that has use_sim_time leave out what on /clock is no time: rclpy would raise."""
    from rosgraph_msgs.msg import Clock  # noqa: PLC0415

    def guarded(take: Callable[[Clock], object]) -> Callable[[Clock], None]:
        def receive(message: Clock) -> None:
            try:
                check_stamp(message.clock.sec * NANOSECONDS + message.clock.nanosec)
            except ValueError as error:
                node.get_logger().warning(f'/clock is left out: {error}', once=True)
            else:
                take(message)
        return receive

    for subscription in node.subscriptions:
        if subscription.msg_type is Clock:
            subscription.callback = guarded(subscription.callback)


def _handle(handler: Any, *signals: signal.Signals) -> None:
    """Handle these signals unless they are ignored, as nohup ignores SIGHUP."""
    for number in signals:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def split_ros_arguments(argv: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the own arguments, and those of ROS: between `--ros-args` and `--` or the end."""
    own: list[str] = []
    for_ros: list[str] = []
    words = own
    for word in argv:
        if word == '--ros-args':
            words = for_ros
        elif words is for_ros and word == '--':
            words = own
        else:
            words.append(word)
    return own, for_ros


def node_name(for_ros: Sequence[str]) -> str:
    """Return the full name that arguments of ROS give to a node: the first rule holds."""
    found: dict[str, str] = {}
    for option, rule in pairwise(for_ros):
        left, _, right = rule.partition(':=')
        if option in ('-r', '--remap'):
            found.setdefault(left.removeprefix('spinning_top:').replace('__name', '__node'), right)
    namespace, name = found.get('__ns', ''), found.get('__node', 'spinning_top')
    return f'/{namespace.strip("/")}/{name}'.replace('//', '/')


def _cannot_start(name: str, error: Exception) -> int:
    if isinstance(error, ImportError) and not find_spec('rclpy'):
        error = RuntimeError('it needs ROS 2: source the setup.bash of an installation, or '
                             f'{remedy("ros")}')
    print(f'{name}: cannot start: {cli.one_line(text_of(error))}', file=sys.stderr)
    return cli.WRONG_USAGE


def _executor(node: Any) -> Executor:
    """Return an executor with the node; keep the memory of the process small."""
    try:                    # this executor takes the least processor time
        from rclpy.experimental import EventsExecutor as Executor  # noqa: PLC0415
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor as Executor  # noqa: PLC0415
    executor = Executor()
    executor.add_node(node)
    # A task ends `spin_once` at once; `wake` does not.
    node.finished.add_done_callback(lambda _: executor.create_task(lambda: None))
    gc.collect()
    gc.freeze()             # a full collection then skips all objects of the start
    # glibc gives freed blocks of this size back, and by itself would raise it (solvers.evaluate).
    with contextlib.suppress(AttributeError):       # where another libc has no such function
        ctypes.CDLL(None).mallopt(-3, 128 * 1024)   # M_MMAP_THRESHOLD of malloc.h
    return executor


def tell(line: str) -> None:
    """Print a line without waiting; a reader that stalls or has gone, or a full disk, loses it."""
    with contextlib.suppress(OSError):
        os.set_blocking(1, False)       # only for this line: others may share the terminal
        os.write(1, os.fsencode(f'{line}\n'))
    os.set_blocking(1, True)
