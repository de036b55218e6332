# SPDX-License-Identifier: Apache-2.0
"""Filters in any language: programs that read a line for each update and answer with a line."""

import contextlib
import os
import re
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from spinning_top_sim.exam.feeding import ANSWER_S, InvalidOutputError
from spinning_top_sim.exam.motions import Reals
from spinning_top_sim.tools.cli import one_line

LONGEST_LINE = 4096             # bytes; an answer has less than a tenth of that
# Of the numbers of an answer.
SHAPES = {'attitude': 4, 'bias': 3, 'covariance': (3, 3)}


class Program:
    """
    A process that is a filter, as `feeding.Filter`.

    It reads lines `gx gy gz ax ay az mx my mz dt` (rad/s, m/s^2, T, s; `nan` for a magnetometer
    that is not there) and answers each with a line `x y z w`, which may go on with `bias` and
    three numbers, and with `covariance` and nine.
    """

    def __init__(self, command: Sequence[str]) -> None:
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
                start_new_session=True)
        except OSError as error:
            raise InvalidOutputError(f'cannot start {command[0]}: {error.strerror}') from error
        assert self._process.stdin and self._process.stdout
        self._to, self._from = self._process.stdin, self._process.stdout
        self._text = b''
        self.bias: Reals | None = None
        self.covariance: Reals | None = None

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Send the readings, and wait for the attitude."""
        if self._text or self._answers(0.0):
            text = (self._text or self._read())[:80].decode(errors='replace')
            raise InvalidOutputError(f'answers more than a line: {one_line(text)!r}')
        field = np.full(3, np.nan) if magnetometer is None else magnetometer
        numbers = (*gyroscope.tolist(), *accelerometer.tolist(), *field.tolist(), dt)
        try:
            self._to.write((' '.join(map(repr, numbers)) + '\n').encode())
        except OSError:
            self._fail()
        end = time.monotonic() + ANSWER_S
        while b'\n' not in self._text:
            if not self._answers(max(0.0, end - time.monotonic())):
                raise InvalidOutputError(f'no answer within {ANSWER_S:g} s')
            self._text += self._read()
            if len(self._text) > LONGEST_LINE:
                raise InvalidOutputError(f'answers more than {LONGEST_LINE} bytes')
        line, _, self._text = self._text.partition(b'\n')
        return self._parsed(line.decode(errors='replace'))

    def _answers(self, within_s: float) -> bool:
        return bool(select.select([self._from], [], [], within_s)[0])

    def _read(self) -> bytes:
        return os.read(self._from.fileno(), LONGEST_LINE) or self._fail()

    def _parsed(self, line: str) -> Reals:
        attitude, *others = re.split('(bias|covariance)', line)
        try:
            found = {name: np.array(text.split(), dtype=float).reshape(SHAPES[name])
                     for name, text in zip(['attitude', *others[::2]], [attitude, *others[1::2]],
                                           strict=True)}
        except ValueError:
            raise InvalidOutputError(
                f'answers {one_line(line)[:80]!r}: must be x y z w, and may go on with bias and 3 '
                'numbers, covariance and 9') from None
        self.bias, self.covariance = found.get('bias'), found.get('covariance')
        return found['attitude']

    def _fail(self) -> NoReturn:
        try:
            code = self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            raise InvalidOutputError('the program has closed its input or output') from None
        raise InvalidOutputError(f'the program has ended, {"signal" if code < 0 else "exit code"} '
                                 f'{abs(code)}')

    def close(self) -> None:
        """End the process, and what it has started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._from.close()
        with contextlib.suppress(BrokenPipeError):
            self._to.close()
