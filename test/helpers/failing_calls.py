# SPDX-License-Identifier: Apache-2.0
"""Lets one system call fail: those of `os` that make, write and name files, and of open files."""

import builtins
import contextlib
import io
import os
from unittest import mock

CALLS = ('open', 'pwrite', 'fsync', 'ftruncate', 'fstatvfs', 'mkdir', 'unlink', 'rename',
         'replace')


class Calls:
    """
    Counts the calls within the `with`, and lets one fail.

    fails : number of that call, from 1 on; None: none
    error : the `errno` of the failure, or KeyboardInterrupt; None: a write writes but a part
    names : of the calls so far
    """

    def __init__(self, fails=None, error=None):
        self.names, self._fails, self._error = [], fails, error
        self._patches = contextlib.ExitStack()

    def __enter__(self):
        for name in CALLS:
            self._replace(os, name, self._checked(name, getattr(os, name)))
        opened = self._opened(io.open)
        self._replace(io, 'open', opened)
        self._replace(builtins, 'open', opened)
        return self

    def __exit__(self, *_):
        self._patches.close()

    def _replace(self, owner, name, call):
        self._patches.enter_context(mock.patch.object(owner, name, call))

    def check(self, name, path=None):
        """Count a call; return whether it is to be short, or raise, with its path if any."""
        self.names.append(name)
        if len(self.names) != self._fails:
            return False
        if self._error is KeyboardInterrupt:
            raise KeyboardInterrupt
        if self._error is not None:
            raise OSError(self._error, os.strerror(self._error), path)
        return True

    def _checked(self, name, call):
        def checked(*arguments, **options):
            first, *_ = arguments
            is_short = self.check(name, None if isinstance(first, int) else os.fspath(first))
            if is_short and name == 'pwrite':
                descriptor, data, offset = arguments
                arguments = descriptor, data[:len(data) // 2 or 1], offset
            return call(*arguments, **options)
        return checked

    def _opened(self, ordinary):
        def opened(path, mode='r', buffering=-1, encoding=None, errors=None, newline=None,
                   **options):
            if not set(mode) & set('wxa') or isinstance(path, int):
                return ordinary(path, mode, buffering, encoding, errors, newline, **options)
            self.check('open', os.fspath(path))
            raw = _File(self, path, mode.replace('b', '').replace('t', ''))
            if not buffering:
                return raw
            file = io.BufferedWriter(raw)
            return file if 'b' in mode else io.TextIOWrapper(file, encoding, errors, newline)
        return opened


class _File(io.FileIO):
    def __init__(self, calls, path, mode):
        super().__init__(path, mode)
        self._calls = calls

    def write(self, data):
        is_short = self._calls.check('write')
        return super().write(bytes(data)[:len(data) // 2 or 1] if is_short else data)

    def close(self):
        if not self.closed:
            super().close()
            self._calls.check('close')
