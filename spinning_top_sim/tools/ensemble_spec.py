# SPDX-License-Identifier: Apache-2.0
"""The specification of an ensemble; with the number of a run, it gives all parameters."""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.physics.top import shown
from spinning_top_sim.streams import parameters, topics
from spinning_top_sim.streams.parameter import Parameter, Range
from spinning_top_sim.tools.scene_file import likely_name, parse_section, parse_yaml, read_scene

DEFAULTS = {parameter.name: parameter.default for parameter in parameters.TABLE}
# Streams that a table can have; only a log has the others.
STREAMS = tuple(name for name in parameters.STREAMS if name not in ('clock', 'markers'))
# A part has at most this many rows, or one run, and a large ensemble at least this many parts.
# Larger parts take more memory, and are no faster.
ROWS_IN_A_PART, LEAST_PARTS = 50_000, 50
VALUES, PARAMS = 'values', 'params'
_entry = partial(Parameter, text='')
ENTRIES = (
    _entry('runs', default=1, range=Range(1, 2 ** 63 - 1)),
    _entry('duration', default=1.0, range=Range(1e-9, parameters.LONGEST)),
    _entry('seed', default=0, range=Range(0, 2 ** 63 - 1)),
    _entry('streams', default=('imu',), choices=STREAMS))
# By name, the function that draws from two numbers.  Raises ValueError or OverflowError.
DISTRIBUTIONS: Mapping[str, Callable[[np.random.Generator, float, float], float]] = {
    'uniform': np.random.Generator.uniform, 'normal': np.random.Generator.normal,
    'log_uniform': lambda random, low, high: math.exp(
        random.uniform(math.log(low), math.log(high)))}


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
    streams : names of the streams to keep; empty: those that the parameters enable
    """

    runs: int
    duration: float
    seed: int = 0
    params: Sequence[Mapping[str, Any]] = ()
    sample: Mapping[str, Mapping[str, Sequence[Any]]] | None = None
    streams: Sequence[str] = ()

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
                found[name] = DISTRIBUTIONS[kind](generator(self.seed, run, name), *items)
        return found

    def values(self, drawn: Mapping[str, Any]) -> dict[str, Any]:
        """Return the checked parameters of a run with what is drawn for it.  Raises ValueError."""
        others = {name: value for name, value in drawn.items() if name != PARAMS}
        return parameters.checked({**self._given[drawn.get(PARAMS, 0)], **others})

    @cached_property
    def _given(self) -> Sequence[Mapping[str, Any]]:
        """What is given for the runs with each set in `sample`."""
        common = {name: value for one in self.params for name, value in one.items()}
        streams: dict[str, Any] = {f'{name}.enabled': True for name in self.streams}
        if self.streams:
            streams['record.streams'] = self.streams
        sets = (self.sample or {}).get(PARAMS, {VALUES: [{}]})[VALUES]
        return [{**common, **chosen, **streams, 'duration': self.duration} for chosen in sets]

    @cached_property
    def kept(self) -> Sequence[str]:
        """Names of the streams that any set of parameters keeps: the columns of every run."""
        return [name for name in STREAMS if any(
            topics.is_recorded(name, {**DEFAULTS, **values}) for values in self._given)]

    @property
    def parts(self) -> Sequence[range]:
        """The runs that one task computes each, and that share a file."""
        # Not cached: every task carries what is, and there may be 100 000 parts.
        values = {**DEFAULTS, **self._given[0]}
        # A stream without a rate of its own has that of the IMU.
        rows = self.duration * max(values.get(f'{name}.rate', values['imu.rate'])
                                   for name in self.kept)
        count = max(1, min(int(ROWS_IN_A_PART / max(rows, 1.0)), self.runs // LEAST_PARTS))
        return [range(first, min(first + count, self.runs))
                for first in range(0, self.runs, count)]


def read(path: Path) -> Specification:
    """Return the specification in a YAML file.  Raises OSError, or ValueError, which names it."""
    return parse(parse_yaml(path.read_bytes(), str(path)), str(path), path.parent)


def parse(content: object, source: str, folder: Path = Path()) -> Specification:
    """
    Return a checked specification from a mapping with the fields of `Specification`.

    A set of parameters may be given as the path of a parameter file, relative to `folder`.
    `dataclasses.asdict` of a specification can be parsed again.
    Raises OSError, or ValueError, which names the source, the value and what is allowed.
    """
    known = [one.name for one in fields(Specification)]
    try:
        if not isinstance(content, Mapping) or not {'runs', 'duration'} <= content.keys() <= {
                *known}:
            raise ValueError(f'{shown(content)}: must be a mapping with runs and duration, of '
                             f'{", ".join(known)}')
        given = Specification(**content)
        sample = given.sample or {}
        if not isinstance(sample, Mapping) or not isinstance(given.params, list | tuple):
            raise ValueError('sample must be a mapping of parameters, params a list of sets')
        found = replace(
            given, **{entry.name: entry.check(getattr(given, entry.name)) for entry in ENTRIES},
            params=[_parameter_set(one, 'params', folder) for one in given.params],
            sample={name: _rule(name, rule, folder) for name, rule in sample.items()})
        if not found.kept:
            raise ValueError('no stream is enabled')
    except (TypeError, ValueError) as error:
        raise ValueError(f'{source}: {error}') from error
    return found


def _parameter_set(given: object, what: str, folder: Path) -> dict[str, Any]:
    if isinstance(given, str):
        return read_scene(folder / given)
    if isinstance(given, Mapping):
        return parse_section(given, what)
    raise ValueError(f'{what}: {shown(given)}: must be a parameter file, or parameters and their '
                     'values')


def _rule(name: str, rule: object, folder: Path) -> dict[str, list[Any]]:
    """Return how a parameter is sampled, checked: {distribution: [a, b]}, or {values: [...]}."""
    what, kinds = f'sample: {name}', (*DISTRIBUTIONS, VALUES)
    kind, items = next(iter(rule.items())) if isinstance(rule, Mapping) and len(rule) == 1 else (
        None, None)
    if kind not in kinds or not isinstance(items, list | tuple) or not items:
        raise ValueError(f'{what} = {shown(rule)}: must be one of {", ".join(kinds)} with a list')
    if name == PARAMS and kind == VALUES:
        return {kind: [_parameter_set(one, what, folder) for one in items]}
    if name not in parameters.BY_NAME:
        raise ValueError(f'{what}: there is no such parameter{likely_name(name)}')
    parameter = parameters.BY_NAME[name]
    if kind == VALUES:
        return {kind: [*map(parameter.check, items)]}
    if parameter.is_list or parameter.kind is not float:
        raise ValueError(f'{what}: {kind}: must be values, because the parameter is no double')
    bounds = list(_entry(f'{what}: {kind}', default=(0.0, 0.0)).check(items))
    for bound in bounds[:1] if kind == 'normal' else bounds:
        parameter.check(bound)
    try:
        DISTRIBUTIONS[kind](np.random.default_rng(0), *bounds)
    except (ValueError, OverflowError):
        raise ValueError(f'{what}: {kind} = {shown(items)}: must be [low, high] with low <= high, '
                         'above 0 if log_uniform, or [mean, deviation >= 0]') from None
    return {kind: bounds}
