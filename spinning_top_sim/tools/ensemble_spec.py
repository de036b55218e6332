# SPDX-License-Identifier: Apache-2.0
"""The specification of an ensemble; with the number of a run, it gives all parameters."""

import hashlib
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.physics.top import shown
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.tools.scene_file import parse_section, parse_yaml, read_scene

FORMATS = ('parquet', 'mcap')
# Streams that only a log can have, not a table.
WITHOUT_COLUMNS = ('clock', 'markers')
STREAMS = tuple(row[0] for row in parameters.STREAM_DEFAULTS)
# By default a part has at most this many rows, or one run, and a large ensemble at least this
# many parts.
ROWS_IN_A_PART, LEAST_PARTS = 200_000, 50
VALUES, PARAMS = 'values', 'params'


def _uniform(random: np.random.Generator, low: float, high: float) -> float:
    return min(low + (high - low) * random.random(), high)


def _normal(random: np.random.Generator, mean: float, deviation: float) -> float:
    return mean + deviation * random.standard_normal()


def _log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    return min(max(low * math.exp(math.log(high / low) * random.random()), low), high)


# By name: the function that draws from two numbers, what these must be, and the check of that.
DISTRIBUTIONS: Mapping[str, tuple[Callable[[np.random.Generator, float, float], float], str,
                                  Callable[[float, float], bool]]] = {
    'uniform': (_uniform, '[low, high] with low <= high and a finite difference',
                lambda low, high: 0.0 <= high - low < math.inf),
    'normal': (_normal, '[mean, deviation] with deviation >= 0',
               lambda mean, deviation: deviation >= 0.0),
    'log_uniform': (_log_uniform, '[low, high] with 0 < low <= high and a finite ratio',
                    lambda low, high: 0.0 < low <= high and high / low < math.inf)}


def generator(seed: int, run: int, name: str) -> np.random.Generator:
    """Return random numbers that depend on a seed, the number of a run and a name alone."""
    counter = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], 'little')
    return np.random.Generator(np.random.Philox(
        key=np.array([seed, run], np.uint64), counter=np.array([0, 0, 0, counter], np.uint64)))


def run_seed(seed: int, run: int) -> int:
    """Return the parameter `seed` of a run in an ensemble of this seed."""
    return int(generator(seed, run, 'seed').integers(2 ** 63))


@dataclass(frozen=True)
class Specification:
    """
    What the runs of an ensemble are; their numbers are 0 to runs - 1.

    runs, seed : number of runs, and the seed of all random numbers
    duration : of a run [s]
    params : mappings of parameters; a later one overrides those before it
    sample : name of a parameter to {distribution: [a, b]}, or to {values: [...]}
    streams : names of the streams to keep; empty: those that the parameters of a run enable
    format : 'parquet' or 'mcap'
    runs_per_part : runs that are computed by one task, and in Parquet share a file
    """

    runs: int
    duration: float
    seed: int = 0
    params: Sequence[Mapping[str, Any]] = ()
    sample: Mapping[str, Mapping[str, Sequence[Any]]] | None = None
    streams: Sequence[str] = ()
    format: str = 'parquet'
    runs_per_part: int = 0

    @property
    def parts(self) -> int:
        """Number of the parts."""
        return -(-self.runs // self.runs_per_part)

    def part(self, number: int) -> range:
        """Return the runs of a part."""
        first = number * self.runs_per_part
        return range(first, min(first + self.runs_per_part, self.runs))

    def drawn(self, run: int) -> dict[str, Any]:
        """
        Return the seed and the sampled parameters of a run by name, not checked.

        The number that is drawn for a name does not depend on the other names.  Lists of values
        span a grid, in which the first list changes fastest; run K takes point K modulo the size
        of the grid.  `params` is the index of the chosen set.
        """
        found: dict[str, Any] = {'seed': run_seed(self.seed, run)}
        point = run
        for name, rule in (self.sample or {}).items():
            (kind, items), = rule.items()
            if kind == VALUES:
                point, index = divmod(point, len(items))
                found[name] = index if name == PARAMS else items[index]
            else:
                found[name] = DISTRIBUTIONS[kind][0](generator(self.seed, run, name), *items)
        return found

    def values(self, run: int) -> dict[str, Any]:
        """Return the checked parameters of a run.  Raises ValueError as `parameters.checked`."""
        drawn = self.drawn(run)
        values = parameters.checked({**self._given(self._sets[drawn.pop(PARAMS, 0)]), **drawn})
        if not values['duration'] > 0.0:
            raise ValueError(f'duration = {values["duration"]!r} s: must be > 0')
        return values

    @property
    def _sets(self) -> Sequence[Mapping[str, Any]]:
        """The sets of parameters that a run chooses from."""
        rule = (self.sample or {}).get(PARAMS, {VALUES: [{}]})
        return rule[VALUES]

    def _given(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        """Return the given parameters of the runs with one of the sets."""
        given: dict[str, Any] = {}
        for some in (*self.params, chosen, {'duration': self.duration}):
            given.update(some)
        if self.streams:
            given['record.streams'] = self.streams
            given.update((f'{name}.enabled', True) for name in self.streams)
        return given

    @cached_property
    def alternatives(self) -> Sequence[Mapping[str, Any]]:
        """The parameters of the runs with each of the sets, without the sampled ones."""
        defaults = {parameter.name: parameter.default for parameter in parameters.TABLE}
        return [{**defaults, **self._given(one)} for one in self._sets]

    @cached_property
    def kept(self) -> Sequence[str]:
        """
        Names of the streams that any of the runs keeps.

        The table of each run has columns for all of them, so that the files form one table.
        """
        return [name for name in STREAMS
                if any(journal.is_recorded(name, values) for values in self.alternatives)]


def read(path: Path) -> Specification:
    """Return the specification in a YAML file.  Raises OSError, or ValueError, which names it."""
    return parse(parse_yaml(path.read_bytes(), str(path)), str(path), path.parent)


def parse(content: object, source: str, folder: Path = Path()) -> Specification:
    """
    Return a checked specification from a mapping with the fields of `Specification`.

    A set of parameters may be given as the path of a parameter file, in `folder` or else in the
    working directory.  `dataclasses.asdict` of a specification can be parsed again.
    Raises OSError, or ValueError, which names the source, the value and what is allowed.
    """
    try:
        return _parsed(content, folder)
    except ValueError as error:
        raise ValueError(f'{source}: {error}') from error


def _parsed(content: object, folder: Path) -> Specification:
    if not isinstance(content, Mapping):
        raise ValueError('must be a mapping with runs, duration and more')
    names = Specification.__dataclass_fields__
    for name in content:
        if name not in names:
            raise ValueError(f'{name if isinstance(name, str) else shown(name)}: there is no such '
                             f'entry; there are {", ".join(names)}')
    for name in ('runs', 'duration'):
        if name not in content:
            raise ValueError(f'{name} is missing')
    given = {'seed': 0, 'runs_per_part': 0, 'format': FORMATS[0], **content}
    _check_numbers(given)
    if given['format'] not in FORMATS:
        raise ValueError(f'format = {shown(given["format"])}: must be one of {", ".join(FORMATS)}')
    given['params'] = [_parameter_set(one, 'params', folder)
                       for one in _list(given.get('params', []), 'params')]
    given['streams'] = _streams(given.get('streams') or [], given['format'])
    sample = given.get('sample') or {}
    if not isinstance(sample, Mapping):
        raise ValueError(f'sample = {shown(sample)}: must be a mapping of parameters')
    given['sample'] = {name: _rule(name, rule, folder) for name, rule in sample.items()}
    specification = Specification(**given)
    return specification if specification.runs_per_part else replace(
        specification, runs_per_part=_runs_per_part(specification))


def _check_numbers(given: dict[str, Any]) -> None:
    for name, least in (('runs', 1), ('seed', 0), ('runs_per_part', 0)):
        value = given[name]
        if type(value) is not int or not least <= value < 2 ** 63:
            raise ValueError(f'{name} = {shown(value)}: must be an integer >= {least}')
    duration = given['duration'] = parameters.BY_NAME['duration'].check(given['duration'])
    if not duration > 0.0:
        raise ValueError(f'duration = {duration!r}: must be a number > 0')


def _list(value: object, what: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise ValueError(f'{what} = {shown(value)}: must be a list')
    return value


def _parameter_set(given: object, what: str, folder: Path) -> dict[str, Any]:
    """Return checked parameters from a file or a mapping."""
    if isinstance(given, str) and '\0' not in given:
        beside = folder / given
        found = read_scene(beside if beside.exists() else given)
    elif isinstance(given, Mapping):
        found = parse_section(given, what)
    else:
        raise ValueError(f'{what}: {shown(given)}: must be a parameter file, or parameters and '
                         'their values')
    return {name: parameters.BY_NAME[name].check(value) for name, value in found.items()}


def _streams(given: object, file_format: str) -> list[str]:
    names = list(_list(given, 'streams'))
    allowed = [name for name in STREAMS if file_format != 'parquet' or name not in WITHOUT_COLUMNS]
    for name in names:
        if name not in allowed:
            raise ValueError(f'streams: {shown(name)}: must be some of {", ".join(allowed)} with '
                             f'format: {file_format}')
    return names


def _rule(name: object, rule: object, folder: Path) -> dict[str, list[Any]]:
    """Return how a parameter is sampled, checked: {distribution: [a, b]}, or {values: [...]}."""
    what, kinds = f'sample: {name}', (*DISTRIBUTIONS, VALUES)
    if name != PARAMS:
        _check_sampled(name)
    if not isinstance(rule, Mapping) or len(rule) != 1:
        raise ValueError(f'{what} = {shown(rule)}: must be one of {", ".join(kinds)} with a list')
    (kind, given), = rule.items()
    if kind not in kinds:
        raise ValueError(f'{what}: there is no distribution {kind}; there are {", ".join(kinds)}')
    items = _list(given, f'{what}: {kind}')
    if kind != VALUES:
        return {kind: _bounds(str(name), kind, items)}
    if not items:
        raise ValueError(f'{what}: values = []: must have one value at least')
    return {kind: [_parameter_set(item, what, folder) if name == PARAMS else
                   parameters.BY_NAME[str(name)].check(item) for item in items]}


def _check_sampled(name: object) -> None:
    """Raise ValueError for a parameter that cannot be sampled."""
    if not parse_section({name: 0.0}, 'sample'):
        raise ValueError(f'sample: {name} is of ROS and has no effect')
    if str(name).endswith('.enabled') or name in ('record.streams', 'publish_clock'):
        raise ValueError(f'sample: {name} must not be sampled: `streams`, or a set of `params`, '
                         'says which streams there are')


def _bounds(name: str, kind: str, items: Sequence[Any]) -> list[float]:
    """Return the two numbers of a distribution, checked."""
    if name == PARAMS or not parameters.BY_NAME[name].is_double:
        raise ValueError(f'sample: {name}: {kind}: must be values, because the parameter is no '
                         'double')
    _, allowed, is_allowed = DISTRIBUTIONS[kind]
    if not (len(items) == 2 and all(
            isinstance(item, int | float) and not isinstance(item, bool)
            and abs(item) <= sys.float_info.max for item in items)
            and is_allowed(*map(float, items))):
        raise ValueError(f'sample: {name}: {kind} = {shown(items)}: must be {allowed}')
    for bound in items[:1] if kind == 'normal' else items:
        parameters.BY_NAME[name].check(bound)
    return [float(item) for item in items]


def _runs_per_part(specification: Specification) -> int:
    """Return how many runs are worth a task."""
    names = [name for name in specification.kept
             if specification.format != 'parquet' or name not in WITHOUT_COLUMNS]
    if not names:
        raise ValueError(f'no stream is enabled; streams: must name one of {", ".join(STREAMS)}')
    values = specification.alternatives[0]
    # A stream without a rate of its own has that of the IMU.
    rows = values['duration'] * max(
        values.get(f'{name}.rate', values['imu.rate']) for name in names)
    return max(1, min(int(ROWS_IN_A_PART / max(rows, 1.0)), specification.runs // LEAST_PARTS))
