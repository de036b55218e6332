#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure size and time of compressed chunks of a live log: levels of zstd, and lz4.

    python benchmark/log_compression.py
    python benchmark/log_compression.py --no-report

The chunks are those of a node that records three streams (pose, joint_states, and imu/data_raw
with a noisy gyroscope) with the default max_loss, four per second.  Each compressor gets every
chunk twice: cold, with other data in the processor's caches, as in a node after a quarter of a
second; and again immediately, warm.  The compressors take turns.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy
import zstandard
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from processes import median
from report import preamble, table, write_section

from spinning_top_sim.recording.chunks import ZSTD_LEVEL
from spinning_top_sim.tools.simulate import main as simulate

STREAMS = ('pose', 'joint_states', 'imu')
RATES = (200, 1000, 2000)
LEVELS = (-3, -1, 1, 2, 3)
CHUNK_S = 0.25              # of the default max_loss


def chunks_at(rate: float, count: int) -> list[bytes]:
    """Return plain messages of a recording at this rate [Hz], in pieces of CHUNK_S."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'run.mcap'
        simulate(['-o', str(path), '--duration', str(CHUNK_S * count), '--quiet',
                  '-p', 'record.compression:=none', '-p', 'imu.gyroscope_noise_density:=1e-3',
                  '-p', f'record.streams:=[{", ".join(STREAMS)}]',
                  *(word for name in STREAMS for word in ('-p', f'{name}.rate:={rate:g}.0'))])
        with path.open('rb') as log:
            plain = b''.join(record.data for record in StreamReader(log, emit_chunks=True).records
                             if isinstance(record, Chunk))
    size = len(plain) // count
    return [plain[k * size:(k + 1) * size] for k in range(count)]


def compressors() -> dict[str, Callable[[bytes], bytes]]:
    return {**{f'zstd {level}': zstandard.ZstdCompressor(level=level).compress
               for level in LEVELS}, 'lz4': lz4.frame.compress}


def microseconds(compress: Callable[[bytes], bytes], chunk: bytes) -> float:
    """Return the processor time of this thread."""
    start = time.thread_time_ns()
    compress(chunk)
    return (time.thread_time_ns() - start) / 1e3


def rows_at(rate: float, count: int) -> list[tuple[str, ...]]:
    chunks = chunks_at(rate, count)
    used = compressors()
    cold: dict[str, list[float]] = {name: [] for name in used}
    warm: dict[str, list[float]] = {name: [] for name in used}
    elsewhere = numpy.zeros(8_000_000)
    for chunk in chunks:
        for name, compress in used.items():
            elsewhere += 1.0
            cold[name].append(microseconds(compress, chunk))
            warm[name].append(microseconds(compress, chunk))
    plain = sum(map(len, chunks))
    size = {name: sum(len(compress(chunk)) for chunk in chunks) for name, compress in used.items()}
    standard = f'zstd {LEVELS[-1]}'
    return [(f'{rate:g}', f'{plain / len(chunks) / 1e3:.0f}',
             name + (' (used)' if name == f'zstd {ZSTD_LEVEL}' else ''),
             f'{size[name] / plain:.3f}', f'{size[name] / size[standard]:.2f}',
             f'{median(cold[name]):.0f}', f'{median(warm[name]):.0f}',
             f'{compress.__self__.memory_size() / 1e6:.2f}' if name.startswith('zstd') else '–')
            for name, compress in used.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--chunks', type=int, default=60, help='at each rate')
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('Compression of the log', ('numpy', 'zstandard', 'lz4'))
    rows = [row for rate in RATES for row in rows_at(rate, arguments.chunks)]
    text = table(('Hz', 'chunk [kB]', 'compressor', 'of the plain size',
                  f'of that of zstd {LEVELS[-1]}', 'cold [us a chunk]', 'warm [us a chunk]',
                  'memory [MB]'), rows)
    print(text)
    if not arguments.no_report:
        write_section('compression', head, __doc__, text)


if __name__ == '__main__':
    sys.exit(main())
