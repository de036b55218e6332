# SPDX-License-Identifier: Apache-2.0
"""What is known about a parameter: its type, unit and range, and when a change takes effect."""

import contextlib
import enum
import sys
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Any

from spinning_top_sim.physics.top import shown


class Effect(enum.Enum):
    """When a changed value is used."""

    NOW = 'a change takes effect at once'
    RESET = 'a change takes effect at the next ~/reset'
    RECORDING = 'a change takes effect at the next start of a recording'
    START = 'cannot be changed while the node runs'


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
    def is_list(self) -> bool:
        return isinstance(self.default, tuple)

    @property
    def kind(self) -> type:
        """Type of the value, or of each item of a list; integers are converted to doubles."""
        one = self.default[0] if self.is_list else self.default
        return float if one is None else type(one)

    def describe(self, range_too: bool = True) -> str:
        return '; '.join(filter(None, (
            self.text + (f' [{self.unit}]' if self.unit else ''),
            self.allowed if range_too and (self.choices or self.range is not ANY) else '',
            self.effect.value)))

    @property
    def allowed(self) -> str:
        if self.choices:
            return f'must be one of {", ".join(self.choices)}'
        if not self.is_list:
            what = {bool: 'true or false', int: 'an integer', str: 'a string'}.get(
                self.kind, 'a number')
        elif self.kind is str:
            what = 'a list of strings'
        else:
            what = f'a list of {len(self.default)} numbers' + (
                ', or a multiple of that,' if self.repeated else '')
        return f'must be {what}' + (f' {self.range}' if self.range is not ANY else '')

    def check(self, value: Any) -> Any:
        """Return the value in the type of the default.  Raises ValueError if it is not allowed."""
        if value is None and self.default is None:
            return None
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            if not self.is_list:
                return self._one(value)
            # These are iterable, but not lists.
            if not isinstance(value, str | bytes | Mapping | Set) and (
                    self.kind is str or len(value) == len(self.default)
                    or (self.repeated and len(value) and not len(value) % len(self.default))):
                return tuple(map(self._one, value))
        raise ValueError(f'{self.name} = {shown(value)}: {self.allowed}')

    def _one(self, item: Any) -> Any:
        """Return a value, or an item of a list, in its type.  Raises ValueError."""
        if self.kind is float and isinstance(item, str):
            item = float(item)      # YAML 1.1, as in `ros2 param set`, takes 1e-9 for a text
        if isinstance(item, (int, float) if self.kind is float else self.kind) and (
                item in self.choices if self.choices
                else self.kind in (bool, str) or item in self.range):
            return self.kind(item)
        raise ValueError
