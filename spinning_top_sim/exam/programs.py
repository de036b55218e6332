# SPDX-License-Identifier: Apache-2.0
"""Filters in any language: programs that read a line for each update and answer with a line."""

import contextlib
import os
import selectors
import shlex
import subprocess
import time
from typing import NoReturn

import numpy as np

from spinning_top_sim.exam.feeding import InvalidOutputError
from spinning_top_sim.exam.motions import Reals
from spinning_top_sim.tools.cli import one_line

ANSWER_S = 5.0                  # within which a line must come
LONGEST_LINE = 4096             # bytes; an answer has less than a tenth of that
# Numbers behind a word of an answer.
WORDS = {'bias': 3, 'covariance': 9}


class Program:
    """
    A process that is a filter, as `feeding.Filter`.

    It reads lines `gx gy gz ax ay az mx my mz dt` (rad/s, m/s^2, T, s; `nan` for a magnetometer
    that is not there) and answers each with a line `x y z w`, which may go on with `bias` and
    three numbers, and with `covariance` and nine.
    """

    def __init__(self, command: str) -> None:
        try:
            self._process = subprocess.Popen(
                shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        except OSError as error:
            raise InvalidOutputError(f'cannot start {command}: {error.strerror}') from error
        assert self._process.stdin and self._process.stdout
        self._to, self._from = self._process.stdin, self._process.stdout
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._from, selectors.EVENT_READ)
        self._text = b''
        self.bias: Reals | None = None
        self.covariance: Reals | None = None

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        """Send the readings, and wait for the attitude."""
        if self._text or self._selector.select(0.0):
            self._text = self._text or self._read()
            raise InvalidOutputError('answers more than a line: '
                                     f'{one_line(self._text[:80].decode(errors="replace"))!r}')
        field = np.full(3, np.nan) if magnetometer is None else magnetometer
        numbers = (*gyroscope.tolist(), *accelerometer.tolist(), *field.tolist(), dt)
        try:
            self._to.write((' '.join(map(repr, numbers)) + '\n').encode())
        except BrokenPipeError:
            self._fail_ended()
        except OSError as error:
            raise InvalidOutputError(f'the program takes no line: {error.strerror}') from error
        return self._parsed(self._line())

    def _line(self) -> str:
        end = time.monotonic() + ANSWER_S
        while b'\n' not in self._text:
            if not self._selector.select(max(0.0, end - time.monotonic())):
                raise InvalidOutputError(f'no answer within {ANSWER_S:g} s')
            self._text += self._read()
            if len(self._text) > LONGEST_LINE:
                raise InvalidOutputError(f'answers more than {LONGEST_LINE} bytes')
        line, _, self._text = self._text.partition(b'\n')
        return line.decode(errors='replace')

    def _read(self) -> bytes:
        more = os.read(self._from.fileno(), LONGEST_LINE)
        if not more:
            self._fail_ended()
        return more

    def _parsed(self, line: str) -> Reals:
        said = line.split()
        try:
            attitude = np.array(said[:4], dtype=float)
            rest, found = said[4:], {}
            while rest:
                count = WORDS[rest[0]]
                found[rest[0]] = np.array(rest[1:1 + count], dtype=float)
                if len(found[rest[0]]) != count:
                    raise ValueError(rest[0])
                rest = rest[1 + count:]
        except (KeyError, ValueError):
            attitude = np.empty(0)
        if attitude.shape != (4,):
            raise InvalidOutputError(f'answers {one_line(line)[:80]!r}: must be x y z w, and may '
                                     'go on with bias and 3 numbers, covariance and 9')
        self.bias = found.get('bias')
        self.covariance = found['covariance'].reshape(3, 3) if 'covariance' in found else None
        return attitude

    def _fail_ended(self) -> NoReturn:
        try:
            code = self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            raise InvalidOutputError('the program has closed its output') from None
        raise InvalidOutputError(f'the program has ended, {"signal" if code < 0 else "exit code"} '
                           f'{abs(code)}')

    def close(self) -> None:
        """End the process."""
        self._selector.close()
        self._process.kill()
        self._process.wait()
        self._from.close()
        with contextlib.suppress(BrokenPipeError):
            self._to.close()
