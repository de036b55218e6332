# SPDX-License-Identifier: Apache-2.0
"""The executable `sim_node`: start, spin, and end properly whichever way it is asked to."""

from __future__ import annotations

import re
import signal
import sys

USAGE = """usage: sim_node [--help] [--ros-args -p NAME:=VALUE --params-file FILE ...]

Simulate the heavy symmetric top in real time, in namespace and with parameters as usual:

  ros2 run spinning_top_sim sim_node
  ros2 run spinning_top_sim sim_node --ros-args --params-file config/looping.yaml
  ros2 run spinning_top_sim sim_node --ros-args -p spin.l3:=2.0 -p record.enabled:=true

Parameters (a change by `ros2 param set` takes effect as said there):
"""


def main(argv: list[str] | None = None) -> int:
    """Run the node; return 0 after an ordinary end, 2 for what could not be started."""
    argv = sys.argv if argv is None else argv
    try:
        if '--help' in argv[1:] or '-h' in argv[1:]:
            _show_help()
            return 0
        return _run(argv)
    except KeyboardInterrupt:           # before the node was there
        return 130


def _show_help() -> None:
    from spinning_top_sim.streams import parameters  # noqa: PLC0415

    print(USAGE)
    for parameter in parameters.TABLE:
        default = parameter.default
        shown = list(default) if isinstance(default, tuple) else default
        print(f'  {parameter.name}  (default {"unset" if shown is None else shown})\n'
              f'      {parameter.description}')


def _run(argv: list[str]) -> int:
    import rclpy  # noqa: PLC0415 - so that Ctrl-C while rclpy is imported ends quietly too
    from rclpy.exceptions import ParameterException  # noqa: PLC0415
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor  # noqa: PLC0415

    try:
        rclpy.init(args=argv)
    except Exception as error:          # a params file that is missing or no YAML, a bad remapping
        return _cannot_start(error)
    node = None
    try:
        from spinning_top_sim.nodes.simulator import Simulator  # noqa: PLC0415

        try:
            node = Simulator()
        except (ValueError, RuntimeError, ParameterException) as error:
            return _cannot_start(error) if rclpy.ok() else 0
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.start()
        executor.spin_until_future_complete(node.finished)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # What was in the middle of a call when the context went down raises whatever it likes.
        if rclpy.ok():
            raise
    finally:
        # A launched node is told twice, by the terminal and by launch.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.stop()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _cannot_start(error: Exception) -> int:
    """Say why in one line, without the places in the sources of rcl; return the exit code."""
    text = re.sub(r',\s*at \S+:\d+', '', str(error))
    print(f'sim_node: cannot start: {" ".join(text.split())}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
