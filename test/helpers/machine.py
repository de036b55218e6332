# SPDX-License-Identifier: Apache-2.0
"""
A machine that does not exist: one clock, threads that take turns, and a disk that may fail.

Everything happens in one thread of the real machine, in an order that a seed decides.  A thread
gives way where it waits, and at each operation of the disk.
"""

import errno
import heapq
import itertools
import os
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import greenlet

SECOND, MILLISECOND, MICROSECOND = 1_000_000_000, 1_000_000, 1_000
SECTOR = 512
CALLS = ('pwrite', 'fsync', 'ftruncate', 'fstatvfs')


class Killed(BaseException):
    """The process is gone, at once, wherever its threads were."""


class _Thread(greenlet.greenlet):
    turn = 0            # an older date to go on counts no more


class Machine:
    """
    Time, and threads; has what `threading` has, as far as the recorder uses it.

    random : decides who goes first, and how long an operation of the disk takes
    """

    def __init__(self, random):
        self.now_ns, self.random, self.is_dead = 1000 * SECOND, random, False
        self._hub = greenlet.getcurrent()
        self._dates, self._numbers, self._threads = [], itertools.count(), []

    def clock(self):
        """Return steady time [s]."""
        return self.now_ns / SECOND

    def run(self, target):
        """Run a process with this main thread to its end, or until it is killed."""
        main = self.begin(target)
        try:
            while not main.dead:
                at_ns, *_, thread, turn = heapq.heappop(self._dates)
                if turn == thread.turn and not thread.dead:
                    self.now_ns = max(self.now_ns, at_ns)
                    thread.turn += 1
                    thread.switch()
        except Killed:
            pass
        finally:
            self.is_dead = True
            for thread in self._threads:
                if thread and not thread.dead:
                    try:
                        thread.throw(Killed)
                    except Killed:
                        continue

    def begin(self, target):
        thread = _Thread(target, parent=self._hub)
        self._threads.append(thread)
        self.wake(thread)
        return thread

    def wake(self, thread, after_ns=0):
        heapq.heappush(self._dates, (self.now_ns + after_ns, self.random.random(),
                                     next(self._numbers), thread, thread.turn))

    def sleep(self, duration_ns=None):
        """Let other threads go on for a time, or until this one is woken."""
        if self.is_dead:
            raise Killed
        if duration_ns is not None:
            self.wake(greenlet.getcurrent(), duration_ns)
        self._hub.switch()

    def Event(self):  # noqa: N802, as in threading
        return _Event(self)

    def Thread(self, target, args=(), **_):  # noqa: N802
        return _Started(self, target, args)


class _Event:
    def __init__(self, machine):
        self._machine, self._set, self._waiting = machine, False, []

    def is_set(self):
        return self._set

    def clear(self):
        self._set = False

    def set(self):
        self._set = True
        while self._waiting:
            self._machine.wake(self._waiting.pop(), self._machine.random.randrange(MILLISECOND))

    def wait(self, timeout=None):
        thread = greenlet.getcurrent()
        if not self._set:
            self._waiting.append(thread)
            self._machine.sleep(None if timeout is None
                                else max(round(timeout * SECOND), MICROSECOND))
            if thread in self._waiting:
                self._waiting.remove(thread)
        return self._set


class _Started:
    def __init__(self, machine, target, args):
        self._machine, self._target, self._args = machine, target, args
        self._ended = machine.Event()

    def start(self):
        self._machine.begin(self._work)

    def _work(self):
        self._target(*self._args)
        self._ended.set()

    def is_alive(self):
        return not self._ended.is_set()

    def join(self, timeout=None):
        self._ended.wait(timeout)


class Fault(NamedTuple):
    """
    What goes wrong with the next call of a name, once.

    kind : 'error' with its number, 'short', 'slow' with the duration [ns], or 'stop': it never
        returns
    """

    call: str
    kind: str
    value: int = 0


@dataclass
class _File:
    """What was done to a file: data at an offset, or None and a size."""

    changes: list = field(default_factory=list)
    synced: int = 0             # so many of these are on the disk for sure,
    doubtful: set = field(default_factory=set)      # but for those whose sync has failed
    is_listed: bool = False     # so is its name


class Disk:
    """
    Files in a folder, through the calls of `os` that the recorder makes; used by `with`.

    kill_at : number of the call in which the process is killed
    is_slow : whether all calls take long
    faults : that are to come
    room : bytes that can still be written
    failures : how many calls for files have failed
    is_disturbed : whether a call has failed, or taken long
    is_misused : whether a file was closed while it was being synced
    """

    def __init__(self, machine, kill_at=None, *, is_slow=False):
        self.faults, self.room, self.failures = [], 1 << 60, 0
        self.is_disturbed, self.is_misused = is_slow, False
        self._machine, self._times = machine, 20 if is_slow else 1
        self._calls_left, self._files = kill_at, defaultdict(_File)
        self._real = {name: getattr(os, name) for name in CALLS}

    def __enter__(self):
        for name in CALLS:
            setattr(os, name, getattr(self, f'_{name}'))
        return self

    def __exit__(self, *_):
        for name, call in self._real.items():
            setattr(os, name, call)

    def cut_power(self, path):
        """Leave of a file what was synced, and any subset of the rest, or no file."""
        file, random = self._files[str(path)], self._machine.random
        path.unlink(missing_ok=True)
        if not file.is_listed and random.random() < 0.5:
            return
        kept = [change for number, change in enumerate(file.changes)
                if (number < file.synced and number not in file.doubtful)
                or random.random() < 0.6]
        content = bytearray()
        for data, where in kept:
            if data is None:
                del content[where:]
                continue
            content.extend(bytes(max(where - len(content), 0)))
            content[where:where + len(data)] = data
        if len(kept) > file.synced and random.random() < 0.3:       # half a write
            begin = min(kept[-1][1], len(content))
            begin += random.randrange(len(content) + 1 - begin) // SECTOR * SECTOR
            content[begin:] = bytes(len(content) - begin)
        path.write_bytes(content)

    # ----------------------------------------------------------------------- calls of `os`

    def _before(self, name, duration_ns):
        """Return the fault of a call that has begun."""
        machine, random = self._machine, self._machine.random
        if machine.is_dead:
            raise Killed
        # One in eight takes long, as it does where others use the disk.
        machine.sleep(random.randrange(
            self._times * (duration_ns if random.random() < 0.875 else 2 * MILLISECOND)))
        if self._calls_left is not None:
            self._calls_left -= 1
            if self._calls_left == 0:
                return Fault(name, 'kill')
        fault = next((one for one in self.faults if one.call == name), Fault(name, 'none'))
        if fault in self.faults:
            self.faults.remove(fault)
            self.is_disturbed = True
        if fault.kind == 'slow':
            machine.sleep(fault.value)
        return fault

    def _after(self, fault):
        if fault.kind == 'kill':
            raise Killed
        if fault.kind in ('stop', 'error'):
            self.failures += 1
        if fault.kind == 'stop':
            self._machine.sleep()
        if fault.kind == 'error':
            raise OSError(fault.value, os.strerror(fault.value))

    def _file(self, descriptor):
        return self._files[os.readlink(f'/proc/self/fd/{descriptor}')]

    def _pwrite(self, descriptor, data, offset):
        file, fault = self._file(descriptor), self._before('pwrite', 50 * MICROSECOND)
        if self.room <= 0:
            self.is_disturbed = True
            fault = Fault('pwrite', 'error', errno.ENOSPC)
        data = bytes(data[:max(self.room, 0)])
        if fault.kind in ('short', 'stop', 'kill', 'error'):
            part = int(self._machine.random.random() * len(data))
            data = data[:max(part, fault.kind == 'short')]
        if data:
            self.room -= len(data)
            file.changes.append((data, offset))
            self._real['pwrite'](descriptor, data, offset)
        self._after(fault)
        return len(data)

    def _ftruncate(self, descriptor, size):
        file, fault = self._file(descriptor), self._before('ftruncate', 20 * MICROSECOND)
        self._after(fault)
        self.room += os.fstat(descriptor).st_size - size
        file.changes.append((None, size))
        self._real['ftruncate'](descriptor, size)

    def _fsync(self, descriptor):
        path = os.readlink(f'/proc/self/fd/{descriptor}')
        is_file = not Path(path).is_dir()
        written = len(self._files[path].changes) if is_file else 0
        fault = self._before('fsync', 8 * MILLISECOND)
        self.is_misused |= not os.path.exists(f'/proc/self/fd/{descriptor}')
        if is_file and fault.kind == 'error':
            self._files[path].doubtful.update(range(self._files[path].synced, written))
        self._after(fault)
        for name, file in self._files.items():
            if name == path:
                file.synced = max(file.synced, written)
            file.is_listed |= Path(name).parent == Path(path)

    def _fstatvfs(self, descriptor):
        self._after(self._before('fstatvfs', 20 * MICROSECOND))
        return self._real['fstatvfs'](descriptor)
