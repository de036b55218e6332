# SPDX-License-Identifier: Apache-2.0
"""What is known about a parameter: its type, unit and range, and when a change takes effect."""

import contextlib
import enum
import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import Any

from spinning_top_sim.physics.top import shown


class Effect(enum.Enum):
    """When a changed value is used."""

    NOW = 'a change takes effect at once'
    RESET = 'a change takes effect at the next ~/reset'
    RECORDING = 'a change takes effect at the next start of a recording'
    START = 'cannot be changed while the node runs'


@dataclass(frozen=True)
class Parameter:
    """
    One parameter.  Its type is the type of the default; a default of None is an unset double.

    minimum, maximum : bounds of a number, or of each number in a list
    above : exclusive lower bound
    smallest : smallest number that is allowed besides 0
    choices : allowed strings
    is_repeated : whether a list may have several times as many numbers as the default
    """

    name: str
    default: Any
    text: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    smallest: float | None = None
    choices: tuple[str, ...] = ()
    is_repeated: bool = False
    effect: Effect = field(kw_only=True)

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
            self.allowed if range_too and (self.choices or self._bounds()) else '',
            self.effect.value)))

    def _bounds(self) -> str:
        bounds = (('0 or >=', self.smallest) if self.smallest else ('>=', self.minimum),
                  ('>', self.above), ('<=', self.maximum))
        return ' and '.join(f'{sign} {bound:g}' for sign, bound in bounds if bound is not None)

    @property
    def allowed(self) -> str:
        if self.choices:
            return f'must be one of {", ".join(self.choices)}'
        kind = {bool: 'true or false', int: 'an integer', str: 'a string'}.get(
            type(self.default), 'a number')
        if isinstance(self.default, tuple):
            kind = ('a list of strings' if isinstance(self.default[0], str)
                    else f'a list of {len(self.default)} numbers'
                    + (', or a multiple of that,' if self.is_repeated else ''))
        return f'must be {kind} {self._bounds()}'.rstrip()

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
            count = len(value) // len(default) if self.is_repeated else 1
            return len(value) == max(count, 1) * len(default) and all(
                map(self._is_in_range, value))
        if isinstance(default, bool | str):
            return isinstance(value, type(default)) and (not self.choices or value in self.choices)
        return (self.is_double or isinstance(value, int)) and self._is_in_range(value)

    def _is_in_range(self, number: Any) -> bool:
        return (isinstance(number, int | float) and not isinstance(number, bool)
                and math.isfinite(number) and (self.above is None or number > self.above)
                and (self.minimum is None or number >= self.minimum)
                and (self.maximum is None or number <= self.maximum)
                and not (self.smallest and 0 < number < self.smallest))
