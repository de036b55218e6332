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
# Streams that have no columns: a log has them, a table does not.
WITHOUT_COLUMNS = ('clock', 'markers')
STREAMS = tuple(row[0] for row in parameters.STREAM_DEFAULTS)
# A part of the dataset has so many rows at most, where its runs are shorter than that, and there
# are so many parts at least, where there are more runs.
ROWS_IN_A_PART, LEAST_PARTS = 200_000, 50
VALUES, PARAMS = 'values', 'params'


def _uniform(random: np.random.Generator, low: float, high: float) -> float:
    return min(low + (high - low) * random.random(), high)


def _normal(random: np.random.Generator, mean: float, deviation: float) -> float:
    return mean + deviation * random.standard_normal()


def _log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    return min(max(low * math.exp(math.log(high / low) * random.random()), low), high)


# The function that draws, its two numbers, and what these must be.
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
    Runs 0 to runs - 1 of one scene, each with parameters of its own.

    runs, seed : number of runs, and the seed of all that is drawn
    duration : of a run [s]
    params : sets of parameters by name, one on top of the other; see `parse`
    sample : name of a parameter to {distribution: [a, b]}, or to {values: [...]}
    streams : names of the streams that are kept; empty: those that the parameters of a run enable
    format : 'parquet' or 'mcap'
    runs_per_part : runs that are computed together, and in Parquet share a file
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
        Return what differs in a run, not checked: its seed and the sampled parameters by name.

        What is drawn for a name does not depend on the other names.  Lists of values make a grid,
        in which the first list changes fastest; run K is point K of it, again and again.  For
        `params` it is the number of the chosen set.
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
        """Return what is given for the runs with one of the sets."""
        given: dict[str, Any] = {}
        for some in (*self.params, chosen):
            given.update(some)
        given['duration'] = self.duration
        if self.streams:
            given['record.streams'] = self.streams
            given.update((f'{name}.enabled', True) for name in self.streams)
        return given

    @cached_property
    def kept(self) -> Sequence[str]:
        """
        The streams that some run keeps, by name.

        All tables of an ensemble have the columns of these: else its files are no one table.
        """
        defaults = {parameter.name: parameter.default for parameter in parameters.TABLE}
        alternatives = [{**defaults, **self._given(one)} for one in self._sets]
        return [name for name in STREAMS
                if any(journal.is_recorded(name, values) for values in alternatives)]


def read(path: Path) -> Specification:
    """Return the specification in a YAML file.  Raises OSError, or ValueError, which names it."""
    return parse(parse_yaml(path.read_bytes(), str(path)), str(path), path.parent)


def parse(content: object, source: str, folder: Path = Path()) -> Specification:
    """
    Return a checked specification; the fields are those of `Specification`.

    Each set of parameters is a mapping, or the path of a parameter file, in `folder` or else in
    the working directory.  A specification as a mapping, `dataclasses.asdict`, is one to parse.
    Raises OSError, or ValueError, which names the source, the value and what is allowed.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f'{source}: must be a mapping with runs, duration and more')
    names = Specification.__dataclass_fields__
    for name in content:
        if name not in names:
            raise ValueError(f'{source}: {name if isinstance(name, str) else shown(name)}: there '
                             'is no such entry; there are '
                             f'{", ".join(names)}')
    given = dict(content)
    for name in ('runs', 'duration'):
        if name not in given:
            raise ValueError(f'{source}: {name} is missing')
    whole = {'runs': 1, 'seed': 0, 'runs_per_part': 0}
    for name, least in whole.items():
        value = given.setdefault(name, least)
        if type(value) is not int or not least <= value < 2 ** 63:
            raise ValueError(f'{source}: {name} = {shown(value)}: must be an integer >= {least}')
    duration = given['duration'] = _check(source, 'duration', given['duration'])
    if not duration > 0.0:
        raise ValueError(f'{source}: duration = {duration!r}: must be a number > 0')
    if given.setdefault('format', FORMATS[0]) not in FORMATS:
        raise ValueError(f'{source}: format = {shown(given["format"])}: must be one of '
                         f'{", ".join(FORMATS)}')
    given['params'] = [_set_of(one, f'{source}: params', folder)
                       for one in _list(given.get('params', []), f'{source}: params')]
    given['streams'] = _streams(given.get('streams') or [], given['format'], source)
    sample = given.get('sample') or {}
    if not isinstance(sample, Mapping):
        raise ValueError(f'{source}: sample = {shown(sample)}: must be a mapping of parameters')
    given['sample'] = {name: _rule(name, rule, f'{source}: sample', folder)
                       for name, rule in sample.items()}
    specification = Specification(**given)
    return specification if specification.runs_per_part else replace(
        specification, runs_per_part=_runs_per_part(specification, source))


def _check(source: str, name: str, value: object) -> Any:
    try:
        return parameters.BY_NAME[name].check(value)
    except ValueError as error:
        raise ValueError(f'{source}: {error}') from error


def _list(value: object, what: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise ValueError(f'{what} = {shown(value)}: must be a list')
    return value


def _set_of(given: object, source: str, folder: Path) -> dict[str, Any]:
    """Return a set of parameters, of which each value is checked."""
    if isinstance(given, str) and '\0' not in given:
        beside = folder / given
        found = read_scene(beside if beside.exists() else given)
    elif isinstance(given, Mapping):
        found = parse_section(given, source)
    else:
        raise ValueError(f'{source}: {shown(given)}: must be a parameter file, or parameters and '
                         'their values')
    return {name: _check(source, name, value) for name, value in found.items()}


def _streams(given: object, file_format: str, source: str) -> list[str]:
    names = list(_list(given, f'{source}: streams'))
    allowed = [name for name in STREAMS if file_format != 'parquet' or name not in WITHOUT_COLUMNS]
    for name in names:
        if name not in allowed:
            raise ValueError(f'{source}: streams: {shown(name)}: must be some of '
                             f'{", ".join(allowed)} with format: {file_format}')
    return names


def _rule(name: object, rule: object, source: str, folder: Path) -> dict[str, list[Any]]:
    """Return how a parameter is sampled, checked: {distribution: [a, b]}, or {values: [...]}."""
    if name != PARAMS and not parse_section({name: 0.0}, source):
        raise ValueError(f'{source}: {name} is of ROS and has no effect')
    if str(name).endswith('.enabled') or name in ('record.streams', 'publish_clock'):
        raise ValueError(f'{source}: {name} must not be sampled: `streams`, or a set of `params`, '
                         'says which streams there are')
    what = f'{source}: {name}'
    if not isinstance(rule, Mapping) or len(rule) != 1:
        raise ValueError(f'{what} = {shown(rule)}: must be one of '
                         f'{", ".join((*DISTRIBUTIONS, VALUES))} with a list')
    (kind, given), = rule.items()
    if kind not in (*DISTRIBUTIONS, VALUES):
        raise ValueError(f'{what}: there is no distribution {kind}; there are '
                         f'{", ".join((*DISTRIBUTIONS, VALUES))}')
    items = _list(given, f'{what}: {kind}')
    if kind == VALUES:
        if not items:
            raise ValueError(f'{what}: values = []: must have one value at least')
        return {kind: [_set_of(item, what, folder) if name == PARAMS else
                       _check(source, str(name), item) for item in items]}
    if name == PARAMS or not parameters.BY_NAME[str(name)].is_double:
        raise ValueError(f'{what}: {kind}: must be values, because the parameter is no double')
    _, allowed, is_allowed = DISTRIBUTIONS[kind]
    if len(items) != 2 or not all(
            isinstance(item, int | float) and not isinstance(item, bool)
            and abs(item) <= sys.float_info.max for item in items) or not is_allowed(
                *map(float, items)):
        raise ValueError(f'{what}: {kind} = {shown(given)}: must be {allowed}')
    for bound in items[:1] if kind == 'normal' else items:
        _check(source, str(name), bound)
    return {kind: [float(item) for item in items]}


def _runs_per_part(specification: Specification, source: str) -> int:
    """Return how many runs are worth a task; a run that is refused fails alone, later."""
    try:
        values = specification.values(0)
    except ValueError:
        values = parameters.checked({'duration': specification.duration})
    names = [name for name in specification.kept
             if specification.format != 'parquet' or name not in WITHOUT_COLUMNS]
    if not names:
        raise ValueError(f'{source}: no stream is enabled; streams: must name one of '
                         f'{", ".join(STREAMS)}')
    # What has no rate of its own has that of the IMU.
    rows = values['duration'] * max(
        values.get(f'{name}.rate', values['imu.rate']) for name in names)
    return max(1, min(int(ROWS_IN_A_PART / max(rows, 1.0)), specification.runs // LEAST_PARTS))
