# SPDX-License-Identifier: Apache-2.0
"""The specification of an ensemble; with the number of a run, it gives all parameters."""

import hashlib
import math
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.physics.top import shown
from spinning_top_sim.streams import parameters, topics
from spinning_top_sim.streams.parameter import Parameter, Range
from spinning_top_sim.tools.scene_file import parse_section, parse_yaml, read_scene

DEFAULTS = {parameter.name: parameter.default for parameter in parameters.TABLE}
# Streams that a table can have; only a log has the others.
STREAMS = tuple(name for name in parameters.STREAMS if name not in ('clock', 'markers'))
# By default a part has at most this many rows, or one run, and a large ensemble at least this
# many parts.  Larger parts take more memory, and are no faster.
ROWS_IN_A_PART, LEAST_PARTS = 50_000, 50
VALUES, PARAMS = 'values', 'params'
_entry = partial(Parameter, text='')
_COUNT = Range(0, 2 ** 63 - 1)
ENTRIES = (
    _entry('runs', default=1, range=Range(1, 2 ** 63 - 1)),
    _entry('duration', default=1.0, range=Range(1e-9, parameters.LONGEST)),
    _entry('seed', default=0, range=_COUNT), _entry('streams', default=('imu',)),
    _entry('runs_per_part', default=0, range=_COUNT))


def _log_uniform(random: np.random.Generator, low: float, high: float) -> float:
    return min(max(low * math.exp(math.log(high / low) * random.random()), low), high)


# By name: the function that draws from two numbers, what these must be, and the check of that.
DISTRIBUTIONS: Mapping[str, tuple[Callable[[np.random.Generator, float, float], float], str,
                                  Callable[[float, float], bool]]] = {
    'uniform': (np.random.Generator.uniform,
                '[low, high] with low <= high and a finite difference',
                lambda low, high: 0.0 <= high - low < math.inf),
    'normal': (np.random.Generator.normal, '[mean, deviation] with deviation >= 0',
               lambda mean, deviation: 0.0 <= deviation < math.inf),
    'log_uniform': (_log_uniform, '[low, high] with 0 < low <= high and a finite ratio',
                    lambda low, high: 0.0 < low <= high and high / low < math.inf)}


def generator(seed: int, run: int, name: str) -> np.random.Generator:
    """Return random numbers that depend on a seed, the number of a run and a name alone."""
    counter = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], 'little')
    return np.random.Generator(np.random.Philox(
        key=np.array([seed, run], np.uint64), counter=np.array([0, 0, 0, counter], np.uint64)))


@dataclass(frozen=True)
class Specification:
    """
    What the runs of an ensemble are; their numbers are 0 to runs - 1.

    runs, seed : number of runs, and the seed of all random numbers
    duration : of a run [s]
    params : mappings of parameters; a later one overrides those before it
    sample : name of a parameter to {distribution: [a, b]}, or to {values: [...]}
    streams : names of the streams to keep; empty: those that the parameters of a run enable
    runs_per_part : runs that are computed by one task, and share a file
    """

    runs: int
    duration: float
    seed: int = 0
    params: Sequence[Mapping[str, Any]] = ()
    sample: Mapping[str, Mapping[str, Sequence[Any]]] | None = None
    streams: Sequence[str] = ()
    runs_per_part: int = 0

    @property
    def parts(self) -> int:
        return -(-self.runs // self.runs_per_part)

    def part(self, number: int) -> range:
        return range(self.runs)[number * self.runs_per_part:][:self.runs_per_part]

    def drawn(self, run: int) -> dict[str, Any]:
        """
        Return the seed and the sampled parameters of a run by name, not checked.

        The number that is drawn for a name does not depend on the other names.  Lists of values
        span a grid, in which the first list changes fastest; run K takes point K modulo the size
        of the grid.  `params` is the index of the chosen set.
        """
        found: dict[str, Any] = {
            'seed': int(generator(self.seed, run, 'seed').integers(2 ** 63))}
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
        return parameters.checked({**self.alternatives[drawn.pop(PARAMS, 0)], **drawn})

    @cached_property
    def alternatives(self) -> Sequence[Mapping[str, Any]]:
        """The parameters given for the runs with each set in `sample`, before it is applied."""
        last: dict[str, Any] = {'duration': self.duration}
        if self.streams:
            last['record.streams'] = self.streams
            last.update((f'{name}.enabled', True) for name in self.streams)
        sets = (self.sample or {}).get(PARAMS, {VALUES: [{}]})[VALUES]
        return [dict(ChainMap(last, chosen, *reversed(self.params))) for chosen in sets]

    @cached_property
    def kept(self) -> Sequence[str]:
        """Names of the streams that any of the runs keeps: the columns of the table of each."""
        return [name for name in STREAMS if any(
            topics.is_recorded(name, {**DEFAULTS, **values}) for values in self.alternatives)]


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
    known = [one.name for one in fields(Specification)]
    try:
        if not isinstance(content, Mapping) or not {'runs', 'duration'} <= content.keys():
            raise ValueError('must be a mapping with runs and duration')
        for name in content.keys() - known:
            raise ValueError(f'there is no entry {name!r}: must be one of {", ".join(known)}')
        return _checked(Specification(**content), folder)
    except (TypeError, ValueError) as error:
        raise ValueError(f'{source}: {error}') from error


def _checked(given: Specification, folder: Path) -> Specification:
    sample = given.sample or {}
    if not isinstance(sample, Mapping):
        raise ValueError(f'sample = {shown(sample)}: must be a mapping of parameters')
    checked = replace(
        given, **{entry.name: entry.check(getattr(given, entry.name)) for entry in ENTRIES},
        params=[_parameter_set(one, 'params', folder) for one in _list(given.params, 'params')],
        sample={name: _rule(name, rule, folder) for name, rule in sample.items()})
    for name in checked.streams:
        if name not in STREAMS:
            raise ValueError(f'streams: {shown(name)}: must be some of {", ".join(STREAMS)}')
    return checked if checked.runs_per_part else replace(
        checked, runs_per_part=_runs_per_part(checked))


def _list(value: object, what: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise ValueError(f'{what} = {shown(value)}: must be a list')
    return value


def _parameter_set(given: object, what: str, folder: Path) -> dict[str, Any]:
    if isinstance(given, str):
        beside = folder / given
        found = read_scene(beside if beside.exists() else given)
    elif isinstance(given, Mapping):
        found = parse_section(given, what)
    else:
        raise ValueError(f'{what}: {shown(given)}: must be a parameter file, or parameters and '
                         'their values')
    return {name: parameters.BY_NAME[name].check(value) for name, value in found.items()}


def _rule(name: object, rule: object, folder: Path) -> dict[str, list[Any]]:
    """Return how a parameter is sampled, checked: {distribution: [a, b]}, or {values: [...]}."""
    what, kinds = f'sample: {name}', (*DISTRIBUTIONS, VALUES)
    if name != PARAMS:
        ours = parse_section({name: 0.0}, 'sample')         # refuses an unknown name
        if not ours or str(name).endswith(('.enabled', 'record.streams')):
            raise ValueError(f'{what} must not be sampled: `streams`, or a set of `params`, says '
                             'which streams there are')
    if not isinstance(rule, Mapping) or len(rule) != 1 or not set(rule) <= set(kinds):
        raise ValueError(f'{what} = {shown(rule)}: must be one of {", ".join(kinds)} with a list')
    (kind, given), = rule.items()
    items = _list(given, f'{what}: {kind}')
    parameter = parameters.BY_NAME.get(str(name))
    if kind == VALUES:
        check = parameter.check if parameter else partial(_parameter_set, what=what, folder=folder)
        if not items:
            raise ValueError(f'{what}: values = []: must have one value at least')
        return {kind: [*map(check, items)]}
    if parameter is None or parameter.is_list or parameter.kind is not float:
        raise ValueError(f'{what}: {kind}: must be values, because the parameter is no double')
    _, allowed, is_allowed = DISTRIBUTIONS[kind]
    bounds = list(_entry(f'{what}: {kind}', default=(0.0, 0.0)).check(items))
    if not is_allowed(*bounds):
        raise ValueError(f'{what}: {kind} = {shown(items)}: must be {allowed}')
    for bound in bounds[:1] if kind == 'normal' else bounds:
        parameter.check(bound)
    return {kind: bounds}


def _runs_per_part(specification: Specification) -> int:
    """Return how many runs are worth a task."""
    if not specification.kept:
        raise ValueError('no stream is enabled')
    values = {**DEFAULTS, **specification.alternatives[0]}
    # A stream without a rate of its own has that of the IMU.
    rows = values['duration'] * max(
        values.get(f'{name}.rate', values['imu.rate']) for name in specification.kept)
    return max(1, min(int(ROWS_IN_A_PART / max(rows, 1.0)), specification.runs // LEAST_PARTS))
