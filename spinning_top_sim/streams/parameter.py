# SPDX-License-Identifier: Apache-2.0
"""What is known about a parameter: its type, unit and range, and when a change takes effect."""

import contextlib
import enum
import math
import re
import sys
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Any, Self

from spinning_top_sim.physics.top import shown


class Effect(enum.Enum):
    """When a changed value is used."""

    NOW = 'a change takes effect at once'
    RESET = 'a change takes effect at the next ~/reset'
    RECORDING = 'a change takes effect at the next start of a recording'
    START = 'cannot be changed while the node runs'


_RANGE = re.compile(r'(0 or )?([\[(])(\S+), (\S+)\]')


@dataclass(frozen=True)
class Range:
    """
    The numbers from `lowest` to `highest`, which belongs to them.

    is_open : whether `lowest` does not belong to them
    has_zero : whether 0 does, too
    """

    lowest: float
    highest: float
    is_open: bool = False
    has_zero: bool = False

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return a range from [a, b], (a, b] or '0 or [a, b]'; a bound may be pi."""
        match = _RANGE.fullmatch(text)
        assert match is not None, text
        zero, bracket, *bounds = match.groups()
        lowest, highest = (math.pi if bound == 'pi' else int(bound) if bound.isdigit()
                           else float(bound) for bound in bounds)
        return cls(lowest, highest, bracket == '(', bool(zero))

    def __contains__(self, number: object) -> bool:
        return isinstance(number, int | float) and not isinstance(number, bool) and (
            (self.has_zero and number == 0)
            or (self.lowest <= number <= self.highest and not (
                self.is_open and number == self.lowest)))

    def __str__(self) -> str:
        sign = '>' if self.is_open else '0 or >=' if self.has_zero else '>='
        return f'{sign} {self.lowest:g} and <= {self.highest:g}'


ANY = Range(-sys.float_info.max, sys.float_info.max)


@dataclass(frozen=True)
class Parameter:
    """
    One parameter.  Its type is the type of the default; a default of None is an unset double.

    range : of a number, or of each number in a list
    choices : allowed strings
    repeated : whether a list may have several times as many numbers as the default
    effect : when a changed value is used
    """

    name: str
    text: str
    default: Any = None
    range: Range = ANY
    choices: tuple[str, ...] = ()
    repeated: bool = False
    unit: str = ''
    effect: Effect = Effect.RESET

    @property
    def is_double(self) -> bool:
        """Whether the value is a double; an integer is converted."""
        return self.default is None or isinstance(self.default, float)

    @property
    def has_doubles(self) -> bool:
        """Whether the value is a double or a list of doubles."""
        return self.is_double or (
            isinstance(self.default, tuple) and isinstance(self.default[0], float))

    def describe(self, range_too: bool = True) -> str:
        return '; '.join(filter(None, (
            self.text + (f' [{self.unit}]' if self.unit else ''),
            self.allowed if range_too and (self.choices or self.range is not ANY) else '',
            self.effect.value)))

    @property
    def allowed(self) -> str:
        if self.choices:
            return f'must be one of {", ".join(self.choices)}'
        kind = {bool: 'true or false', int: 'an integer', str: 'a string'}.get(
            type(self.default), 'a number')
        if isinstance(self.default, tuple):
            kind = ('a list of strings' if isinstance(self.default[0], str)
                    else f'a list of {len(self.default)} numbers'
                    + (', or a multiple of that,' if self.repeated else ''))
        return f'must be {kind}' + (f' {self.range}' if self.range is not ANY else '')

    def check(self, value: Any) -> Any:
        """Return the value in the type of the default.  Raises ValueError if it is not allowed."""
        if value is None and self.default is None:
            return None
        with contextlib.suppress(TypeError, OverflowError):
            if self._is_allowed(value):
                if isinstance(self.default, tuple):
                    kind = type(self.default[0])
                    return tuple(map(kind, value))
                return float(value) if self.is_double else value
        raise ValueError(f'{self.name} = {shown(value)}: {self.allowed}')

    def _is_allowed(self, value: Any) -> bool:
        default = self.default
        if isinstance(default, tuple):
            if isinstance(value, str | bytes | Mapping | Set):       # iterable, but not lists
                return False
            if isinstance(default[0], str):
                return all(isinstance(item, str) for item in value)
            count = len(value) // len(default) if self.repeated else 1
            return len(value) == max(count, 1) * len(default) and all(
                item in self.range for item in value)
        if isinstance(default, bool | str):
            return isinstance(value, type(default)) and (not self.choices or value in self.choices)
        return (self.is_double or isinstance(value, int)) and value in self.range
