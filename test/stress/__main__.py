# SPDX-License-Identifier: Apache-2.0
"""
Stress tests: random inputs and faults, for so long or so many.

    python test/stress world --count 100000     loop, recorder and log in a simulated world
    python test/stress logs --seconds 600       damaged logs, and what reads them
    python test/stress grade --count 100        simulators with a defect, and right ones
    python test/stress wrong --count 94         the exam of filters that are wrong, or right

A failure is told with its seed and the command that repeats it; the exit code says whether.
"""

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
sys.path.remove(str(Path(__file__).parent))     # its modules are those of a package

from stress import runner, world  # noqa: E402


def main():
    parser = argparse.ArgumentParser(
        prog='python test/stress', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('part', choices=runner.PARTS)
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--count', type=int, help='how many seeds')
    parser.add_argument('--seconds', type=float, help='how long')
    parser.add_argument('--processes', type=int, default=None)
    parser.add_argument('--only', help='of a world: the numbers of the actions that happen')
    options = parser.parse_args()
    if options.only:
        return world.repeat(options.first, options.only)
    if options.count is None and options.seconds is None:
        options.seconds = 60.0
    return stress(options)


def stress(options):
    def tell(result, failure):
        if failure is not None:
            print(f'\r{result.failures[-1]}\n', flush=True)
        print(f'\r{options.part}: {result.seeds} seeds, {len(result.failures)} failures ',
              end='', flush=True)

    result = runner.run(options.part, options.first, options.count, options.seconds,
                        options.processes or 1, tell)
    outcomes = ', '.join(f'{name} {count}' for name, count in result.outcomes.most_common())
    print(f'\r{options.part}: seeds {options.first} to {options.first + result.seeds - 1}: '
          f'{outcomes}; {len(result.failures)} failures')
    return 1 if result.failures else 0


if __name__ == '__main__':
    sys.exit(main())
