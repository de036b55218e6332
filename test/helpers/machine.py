# SPDX-License-Identifier: Apache-2.0
"""
A machine that does not exist: one clock, threads that take turns, and a disk that may fail.

Everything happens in one thread of the real machine, in an order that a seed decides.  A thread
gives way where it waits, and at each operation of the disk.
"""

import errno
import heapq
import itertools
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

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
        """Let other threads go on for a time, or for ever."""
        if self.is_dead:
            raise Killed
        if duration_ns is not None:
            self.wake(greenlet.getcurrent(), duration_ns)
        self._hub.switch()

    def wait(self, waiting, timeout):
        """Sleep among those that wait, at most so long [s]."""
        thread = greenlet.getcurrent()
        waiting.append(thread)
        self.sleep(None if timeout is None else max(math.ceil(timeout * SECOND), MICROSECOND))
        if thread in waiting:
            waiting.remove(thread)

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
        if not self._set:
            self._machine.wait(self._waiting, timeout)
        return self._set


class _Started:
    def __init__(self, machine, target, args):
        self._machine, self._target, self._args = machine, target, args
        self._thread, self._waiting = None, []

    def start(self):
        self._thread = self._machine.begin(self._work)

    def _work(self):
        self._target(*self._args)
        while self._waiting:
            self._machine.wake(self._waiting.pop())

    def is_alive(self):
        return not self._thread.dead

    def join(self, timeout=None):
        if self.is_alive():
            self._machine.wait(self._waiting, timeout)


@dataclass
class _File:
    """What was done to a file: data at an offset, or None and a size."""

    changes: list = field(default_factory=list)
    synced: int = 0             # so many of these are on the disk for sure,
    doubtful: set = field(default_factory=set)      # but for those whose sync has failed
    is_listed: bool = False     # so is its name


@dataclass
class Fault:
    """
    What goes wrong with the next call of a name, once.

    kind : 'error' with its number, 'short', 'slow' with the duration [ns], or 'stop': it never
        returns
    """

    call: str
    kind: str
    value: int = 0
    part: float = 0.5           # of the data that is written nevertheless


class Disk:
    """
    Files in a folder, through the calls of `os` that the recorder makes; used by `with`.

    kill_at : number of the call in which the process is killed
    faults : of class Fault, that are to come
    size : bytes of a file that go onto the disk
    calls, failures : how many there were; failures of files, not of folders
    is_slow : whether all calls take long
    is_disturbed : whether one has failed, or taken long
    is_misused : whether a file was closed while it was being synced
    """

    def __init__(self, machine, kill_at=None, *, is_slow=False):
        self.faults, self.size, self.calls, self.failures = [], 1 << 60, 0, 0
        self.is_disturbed, self.is_misused = is_slow, False
        self._machine, self._kill_at, self._files = machine, kill_at, {}
        self._times = 20 if is_slow else 1
        self._real = {name: getattr(os, name) for name in CALLS}

    def __enter__(self):
        for name in CALLS:
            setattr(os, name, getattr(self, f'_{name}'))
        return self

    def __exit__(self, *_):
        for name, call in self._real.items():
            setattr(os, name, call)

    @property
    def largest(self):
        """Size of the largest file [bytes]."""
        return max((len(_image(one.changes)) for one in self._files.values()), default=0)

    def delete(self, path):
        """Remove a file while it may be open."""
        if path.exists():
            path.unlink()
            self.is_disturbed = True
            self._files.pop(str(path), None)

    def content(self, path):
        """Return what a file was when the process ended; None: there is none."""
        file = self._files.get(str(path))
        return None if file is None else _image(file.changes)

    def after_a_power_cut(self, path):
        """Return what may be left: what was synced, and any subset of the rest; None: nothing."""
        file, random = self._files.get(str(path)), self._machine.random
        if file is None or not (file.is_listed or random.random() < 0.5):
            return None
        kept = [change for number, change in enumerate(file.changes)
                if (number < file.synced and number not in file.doubtful)
                or random.random() < 0.6]
        left = bytearray(_image(kept))
        if kept and len(kept) > file.synced and random.random() < 0.3:      # half a write
            data, offset = kept[-1]
            if data is not None:
                begin = offset + random.randrange(len(data) + 1) // SECTOR * SECTOR
                left[begin:] = bytes(max(len(left) - begin, 0))
        return bytes(left)

    # ----------------------------------------------------------------------- calls of `os`

    def _before(self, name, duration_ns):
        """Return the fault of a call that has begun."""
        self.calls += 1
        machine = self._machine
        if machine.is_dead:
            raise Killed
        # One in eight takes long, as it does where others use the disk.
        machine.sleep(machine.random.randrange(
            self._times * (duration_ns if machine.random.random() < 0.875 else 2 * MILLISECOND)))
        if self.calls == self._kill_at:
            return Fault(name, 'kill', part=machine.random.random())
        for fault in self.faults:
            if fault.call == name:
                self.faults.remove(fault)
                self.is_disturbed = True
                if fault.kind == 'slow':
                    machine.sleep(fault.value)
                return fault
        return Fault(name, 'none')

    def _after(self, fault, *, is_file=True):
        if fault.kind == 'stop':
            self.failures += 1
            self._machine.sleep()
        if fault.kind == 'kill':
            raise Killed
        if fault.kind == 'error':
            self.failures += is_file
            raise OSError(fault.value, os.strerror(fault.value))

    def _file(self, descriptor):
        return self._files.setdefault(os.readlink(f'/proc/self/fd/{descriptor}'), _File())

    def _pwrite(self, descriptor, data, offset):
        file, fault = self._file(descriptor), self._before('pwrite', 50 * MICROSECOND)
        room = self.size - offset
        if room <= 0:
            self.is_disturbed = True
            self.failures += 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        data = bytes(data[:room])
        if fault.kind in ('short', 'stop', 'kill', 'error'):
            data = data[:max(int(fault.part * len(data)), fault.kind == 'short')]
        if data:
            file.changes.append((data, offset))
            self._real['pwrite'](descriptor, data, offset)
        self._after(fault)
        return len(data)

    def _ftruncate(self, descriptor, size):
        file, fault = self._file(descriptor), self._before('ftruncate', 20 * MICROSECOND)
        self._after(fault)
        file.changes.append((None, size))
        self._real['ftruncate'](descriptor, size)

    def _fsync(self, descriptor):
        path = os.readlink(f'/proc/self/fd/{descriptor}')
        file = None if Path(path).is_dir() else self._file(descriptor)
        written = file and len(file.changes)
        fault = self._before('fsync', 8 * MILLISECOND)
        self.is_misused |= not os.path.exists(f'/proc/self/fd/{descriptor}')
        if file is not None and fault.kind == 'error':
            file.doubtful.update(range(file.synced, written))
        self._after(fault, is_file=file is not None)
        if file is not None:
            file.synced = max(file.synced, written)
        else:
            for name, one in self._files.items():
                one.is_listed |= Path(name).parent == Path(path)

    def _fstatvfs(self, descriptor):
        fault = self._before('fstatvfs', 20 * MICROSECOND)
        self._after(fault)
        return self._real['fstatvfs'](descriptor)


def _image(changes):
    content = bytearray()
    for data, where in changes:
        if data is None:
            del content[where:]
            continue
        content.extend(bytes(max(where - len(content), 0)))
        content[where:where + len(data)] = data
    return bytes(content)
