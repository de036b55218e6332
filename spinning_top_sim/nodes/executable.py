# SPDX-License-Identifier: Apache-2.0
"""What the executables of nodes share: start, spin, and end properly on every signal."""

from __future__ import annotations

import gc
import re
import signal
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from types import FrameType

    from rclpy.executors import Executor
    from rclpy.node import Node
    from rclpy.task import Future

# Longest wait of the executor [s]: Python answers SIGHUP and SIGQUIT between two waits.
SPIN_S = 0.2


class RunnableNode(Protocol):
    """
    A node as `run` needs it.

    Attributes
    ----------
    finished : rclpy.task.Future
        Completes when the node ends by itself, with its exit code (None is 0).

    """

    finished: Future

    def start(self) -> None:
        """Begin to work: the node is about to be spun."""

    def stop(self) -> None:
        """End the work, whatever state the context is in."""

    def destroy_node(self) -> None: ...


class _Signals:
    """
    Raises KeyboardInterrupt at the first SIGINT only, and not once `told` is set.

    A launched node is told twice, by the terminal and by launch, and the second signal would
    interrupt the end of the node.  SIGHUP and SIGQUIT end a node as SIGTERM does.  A signal that
    is ignored, as by nohup, stays so.
    """

    def __init__(self) -> None:
        self.told = False
        self._lost = False
        sys.unraisablehook = self._keep_interrupt
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._interrupt)
        for number in (signal.SIGHUP, signal.SIGQUIT):
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, lambda *_: signal.raise_signal(signal.SIGTERM))

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if not self.told:
            self.told = True
            raise KeyboardInterrupt

    def _keep_interrupt(self, error: sys.UnraisableHookArgs) -> None:
        """Keep a KeyboardInterrupt that Python drops, as in a weak reference's callback."""
        if issubclass(error.exc_type, KeyboardInterrupt):
            self._lost = True
        else:
            sys.__unraisablehook__(error)

    def check(self) -> None:
        """Raise a KeyboardInterrupt that Python has dropped."""
        if self._lost:
            raise KeyboardInterrupt

    def off(self) -> None:
        """Ignore these signals from now on, also while the interpreter ends."""
        self.told = True
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, signal.SIG_IGN)


def run(name: str, argv: list[str],
        prepare: Callable[[list[str]], Callable[[], RunnableNode] | None]) -> int:
    """
    Run a node; return 0 after an ordinary end, 2 if it cannot be started.

    Parameters
    ----------
    name
        Of the executable, for messages.
    argv
        Arguments, with those for ROS.
    prepare
        Takes the arguments; returns a function that makes the node, or None if there is nothing to
        run.  Both may raise ValueError, RuntimeError or OSError, whose text is shown.

    """
    signals = _Signals()
    try:
        try:
            make_node = prepare(argv)
        except (ValueError, RuntimeError, OSError) as error:
            return _cannot_start(name, error)
        signals.check()
        return 0 if make_node is None else _run(name, argv, make_node, signals)
    except KeyboardInterrupt:           # before the node was there
        return 130
    except ImportError:                 # what rclpy makes of one in the midst of its own import
        if signals.told:
            return 130
        raise


def _cannot_start(name: str, error: Exception) -> int:
    """Say why in one line, without the places in the sources of rcl; return the exit code."""
    text = re.sub(r',\s*at \S+:\d+', '', str(error))
    print(f'{name}: cannot start: {" ".join(text.split())}', file=sys.stderr)
    return 2


def _executor() -> Executor:
    """Return the executor that takes least processor time of those that rclpy has here."""
    try:
        from rclpy.experimental import EventsExecutor  # noqa: PLC0415
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415
        return SingleThreadedExecutor()
    return EventsExecutor()


def _run(name: str, argv: list[str], make_node: Callable[[], RunnableNode],
         signals: _Signals) -> int:
    import rclpy  # noqa: PLC0415 - so that Ctrl-C while rclpy is imported ends quietly too
    from rclpy.exceptions import ParameterException  # noqa: PLC0415
    from rclpy.executors import ExternalShutdownException  # noqa: PLC0415

    try:
        rclpy.init(args=argv)
    except Exception as error:          # a params file that is missing or no YAML, a bad remapping
        return _cannot_start(name, error)
    node = None
    try:
        try:
            node = make_node()
        except (ValueError, RuntimeError, OSError, ParameterException) as error:
            return _cannot_start(name, error) if rclpy.ok() else 0
        executor = _executor()
        executor.add_node(cast('Node', node))
        node.finished.add_done_callback(lambda _: executor.wake())
        gc.collect()
        gc.freeze()             # no full collection goes through what is there from the start
        # A full collection waits until there is a quarter more than the one before has found.
        # This one finds nothing, so the cyclic garbage of service calls does not pile up.
        gc.collect()
        signals.check()
        node.start()
        # From here on rclpy ends the spin at a signal; KeyboardInterrupt would interrupt its code.
        signals.told = True
        # Without a timeout, the EventsExecutor of Jazzy hangs.
        while rclpy.ok() and not node.finished.done():
            executor.spin_once(SPIN_S)
        if node.finished.done():
            return node.finished.result() or 0
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A call that the end of the context interrupts may raise anything.
        if rclpy.ok():
            raise
    finally:
        signals.off()
        if node is not None:
            node.stop()
            node.destroy_node()
        rclpy.try_shutdown()
        signals.off()                 # rclpy has put back the handler that it had found
    return 0
