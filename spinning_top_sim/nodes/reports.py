# SPDX-License-Identifier: Apache-2.0
"""What the node says about itself: /diagnostics, and the status line on the terminal."""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue


@dataclass
class Counters:
    """Counts since the start."""

    late_ticks: int = 0
    skipped_ticks: int = 0
    commands: int = 0
    rejected_commands: int = 0
    slipped_ns: int = 0


class Speedometer:
    """Simulated over real time since it was last read."""

    def __init__(self) -> None:
        self._real, self._simulated = time.monotonic(), 0

    def read(self, simulated_ns: int) -> float:
        """Return the factor, and begin anew from here (also after a reset)."""
        real = time.monotonic()
        elapsed, advanced = real - self._real, simulated_ns - self._simulated
        self._real, self._simulated = real, simulated_ns
        return max(0.0, advanced / 1e9 / elapsed) if elapsed > 0.0 else 0.0


def diagnostics(stamp: object, name: str, problems: list[tuple[int, str]],
                values: dict[str, object]) -> DiagnosticArray:
    """
    Return the array with one status: its level and message are those of the worst problem.

    problems: (DiagnosticStatus level as an int, text);  values: the numbers, as text
    """
    level, message = max(problems, key=lambda p: p[0], default=(0, 'running'))
    status = DiagnosticStatus(
        level=bytes([level]), name=name, hardware_id='none', message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array


def bytes_for_people(count: float) -> str:
    """Return a size such as 1.2 MB."""
    for unit in ('B', 'kB', 'MB', 'GB'):
        if count < 1000.0 or unit == 'GB':
            return f'{count:.0f} {unit}' if unit == 'B' else f'{count:.1f} {unit}'
        count /= 1000.0
    raise AssertionError


def status_line(t_ns: int, state: str, regime: str, theta: float, l3: float, lz: float,
                factor: float, drift: float, sent: int, log_bytes: int | None) -> str:
    """Return the line for the terminal; angles in degrees, as people think."""
    log = '' if log_bytes is None else f' | log {bytes_for_people(log_bytes)}'
    return (f't {t_ns / 1e9:9.2f} s{state} | {regime} | theta {math.degrees(theta):6.2f} deg | '
            f'L3 {l3:.4g} Lz {lz:.4g} | x{factor:.2f} | dE/E {drift:+.0e} | '
            f'{sent} msgs{log}')


class Terminal:
    """Shows a line that overwrites itself on a terminal, and lines one by one elsewhere."""

    def __init__(self) -> None:
        self._overwrites = sys.stdout.isatty()
        self._open = False

    def show(self, line: str) -> None:
        """Show the newest line."""
        if self._overwrites:
            self._write(f'\r\x1b[K{line}')
            self._open = True
        else:
            self._write(f'{line}\n')

    def tell(self, line: str) -> None:
        """Show a line that stays."""
        self.end()
        self._write(f'{line}\n')

    def end(self) -> None:
        """Leave the cursor on a fresh line."""
        if self._open:
            self._open = False
            self._write('\n')

    @staticmethod
    def _write(text: str) -> None:
        try:
            print(text, end='', flush=True)
        except OSError:
            # Whoever read this has gone, as in `sim_node | head`: the motion goes on unread.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
