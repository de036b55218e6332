# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own: started on this machine only, watched, and ended."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import resource
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parent.parent

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('ROS_DOMAIN_ID', '46')
os.environ.setdefault('ROS_LOG_DIR', tempfile.gettempdir())
# Modules stay compiled after their first import, as those of an installed package are.
os.environ.pop('PYTHONDONTWRITEBYTECODE', None)


def ros_arguments(namespace: str, parameters: Mapping[str, Any]) -> list[str]:
    """Return the arguments behind the program's."""
    return ['--ros-args', '--log-level', 'warn', '-r', f'__ns:={namespace}',
            *(item for name, value in parameters.items() for item in (
                '-p', f'{name}:={value if isinstance(value, str) else json.dumps(value)}'))]


# What `ros2 run` runs, of the checkout in PYTHONPATH.
SIM_NODE = ('-P', '-c', 'import os, runpy; runpy.run_path(os.environ["PYTHONPATH"].split('
            'os.pathsep)[0] + "/scripts/sim_node", run_name="__main__")')


def sim_node(namespace: str, parameters: Mapping[str, Any]) -> list[str]:
    """Return what python is given to run `sim_node`."""
    return [*SIM_NODE, *ros_arguments(namespace, parameters)]


def script(name: str) -> tuple[str]:
    """Return what python is given to run a file of this folder."""
    return (str(ROOT / 'benchmark' / name),)


def environment(checkout: Path = ROOT) -> dict[str, str]:
    """Return the environment of a process that runs the package of a checkout."""
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(
        filter(None, [str(checkout), os.environ.get('PYTHONPATH')]))}


class Process:
    """A python process in a group of its own; ends with the `with`."""

    def __init__(self, program: Sequence[str], arguments: Sequence[str] = (), *,
                 talks: bool = False, stderr: IO[str] | None = None,
                 checkout: Path = ROOT) -> None:
        self._process = subprocess.Popen(
            [sys.executable, *program, *arguments], env=environment(checkout),
            start_new_session=True,
            stdin=subprocess.PIPE if talks else subprocess.DEVNULL,
            stdout=subprocess.PIPE if talks else subprocess.DEVNULL, stderr=stderr, text=True)
        self.pid = self._process.pid

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def line(self) -> str:
        """Return the next line that it says."""
        assert self._process.stdout
        return self._process.stdout.readline()

    def tell(self, text: str) -> None:
        """Write a line to it."""
        assert self._process.stdin
        self._process.stdin.write(f'{text}\n')
        self._process.stdin.flush()

    def cpu_ns(self) -> int:
        """Return the processor time of all its threads, past and present [ns]."""
        # The clock id of another process, as clock_getcpuclockid(3) makes it on Linux.
        return time.clock_gettime_ns((~self.pid << 3) | 2)

    def memory(self) -> int:
        """Return its resident set [bytes]."""
        for line in Path(f'/proc/{self.pid}/status').read_text().splitlines():
            if line.startswith('VmRSS:'):
                return 1024 * int(line.split()[1])
        raise ProcessLookupError(self.pid)

    def wait(self, seconds: float) -> int:
        """Wait for its end; return its exit code.  Raises subprocess.TimeoutExpired."""
        if self.alive:
            ended = os.pidfd_open(self.pid)     # subprocess would look every 50 ms
            try:
                select.select([ended], [], [], seconds)
            finally:
                os.close(ended)
        return self._process.wait(0.0)

    def end(self) -> int:
        """Interrupt it, kill it if need be; return its exit code."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGINT)
        if self._process.stdin:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            return self._process.wait(15.0)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            return self._process.wait()


def children_cpu() -> float:
    """Return the processor time of all processes that have ended [s], with their own children."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_module(module: str, arguments: Sequence[str], checkout: Path = ROOT) -> float:
    """Run `main` of a module; return its processor time [s].  Raises SystemExit if it fails."""
    before = children_cpu()
    program = f'import sys; from {module} import main; sys.exit(main())'
    run = subprocess.run([sys.executable, '-P', '-c', program, *arguments], check=False,
                         env=environment(checkout), stdout=subprocess.DEVNULL, timeout=3600.0)
    if run.returncode:
        raise SystemExit(f'{module} of {checkout} ended with exit code {run.returncode}')
    return children_cpu() - before


namespaces = (f'/n{k}' for k in itertools.count(1))


def together(programs: Mapping[str, tuple[Callable[[str], Sequence[str]], Path]], rounds: int,
             seconds: float, subscribers: int = 0) -> dict[str, list[float]]:
    """
    Return the processor time over elapsed time of nodes that run at once, for each round.

    All nodes meet the same load of the machine; another one starts first each time.

    programs: by name, the arguments of python for a namespace, and the checkout
    """
    shares: dict[str, list[float]] = {name: [] for name in programs}
    for first in range(rounds):
        with contextlib.ExitStack() as running:
            nodes = {}
            for k in range(len(programs)):
                name = list(programs)[(first + k) % len(programs)]
                program, checkout = programs[name]
                namespace = next(namespaces)
                for _ in range(subscribers):
                    running.enter_context(
                        Process((*script('listener.py'), namespace), talks=True)).line()
                nodes[name] = running.enter_context(
                    Process(program(namespace), checkout=checkout))
            time.sleep(4.0)
            begin = {name: (node.cpu_ns(), time.monotonic_ns()) for name, node in nodes.items()}
            time.sleep(seconds)
            for name, node in nodes.items():
                cpu, at = begin[name]
                shares[name].append((node.cpu_ns() - cpu) / (time.monotonic_ns() - at))
    return shares


# Runs `simulate` and says what it has held at most.  The rusage of a child counts what its parent
# held when it was started, too.
_SIMULATE = """
import sys
from spinning_top_sim.tools.simulate import main
code = main(sys.argv[1:])
print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM:')).split()[1])
sys.exit(code)
"""


def simulate(arguments: Sequence[str], checkout: Path = ROOT) -> tuple[float, int]:
    """
    Run `simulate` in a process of its own.

    Return its time from start to exit [s] and its peak memory [bytes].  Raises SystemExit.
    """
    begin = time.monotonic()
    run = subprocess.run(
        [sys.executable, '-P', '-c', _SIMULATE, *arguments], stdout=subprocess.PIPE,
        text=True, env=environment(checkout), timeout=3600.0, check=False)
    taken = time.monotonic() - begin
    if run.returncode:
        raise SystemExit(f'simulate ended with exit code {run.returncode}')
    return taken, 1024 * int(run.stdout.split()[-1])


def load() -> float:
    """Return how many processes have wanted to run in the last minute, of late."""
    return os.getloadavg()[0]


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value below which this share of them is; NaN of none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float('nan')


def median(values: Sequence[float]) -> float:
    """Return the median; NaN of none."""
    return statistics.median(values) if values else float('nan')
