# SPDX-License-Identifier: Apache-2.0
"""
POSIX extended regular expressions, in a time that their length bounds.

`re` tries one way to match after the other, which are exponentially many for some expressions, and
holds the whole process meanwhile.  Here each part of an expression becomes a matrix that has all
of its matches in the text: element i, j is true where the part matches from i to j.
"""

import re

import numpy as np
from numpy.typing import NDArray

LONGEST = 255           # characters of an expression
# Character classes of POSIX, within brackets, in the syntax of `re`.
CLASSES = {'alnum': 'a-zA-Z0-9', 'alpha': 'a-zA-Z', 'blank': ' \\t', 'cntrl': '\\x00-\\x1f\\x7f',
           'digit': '0-9', 'graph': '!-~', 'lower': 'a-z', 'print': ' -~',
           'punct': '!-/:-@\\[-`{-~', 'space': '\\s', 'upper': 'A-Z', 'xdigit': '0-9A-Fa-f'}
# What matches one character, and how often something is there.
CHARACTER = re.compile(
    r'\[\^?\]?(?:\[:\w*:\]|[^]])*+\]|\\[dDsSwW]|\\[^0-9A-Za-z]|[^[\\(){*+?|]')
COUNT = re.compile(r'[*+?]|\{(\d+)(,?)(\d*)\}')
COUNTS = {'*': (0, None), '+': (1, None), '?': (0, 1)}

Matches = NDArray[np.bool_]


def is_found(expression: str, text: str) -> bool:
    """Return whether an expression matches some part of a text.  Raises ValueError."""
    try:
        if len(expression) > LONGEST:
            raise ValueError(f'it has {len(expression)} characters, at most {LONGEST} are allowed')
        return bool(_Matcher(expression, text).matches().any())
    except (ValueError, re.error, RecursionError) as error:
        raise ValueError(f'filter = {expression!r}: must be a POSIX extended regular '
                         f'expression: {error}') from error


class _Matcher:
    """Reads an expression from left to right; each method returns the matches of what it reads."""

    def __init__(self, expression: str, text: str) -> None:
        self._expression, self._text, self._at = expression, text, 0
        self._empty = np.eye(len(text) + 1, dtype=bool)

    def matches(self) -> Matches:
        found = self._alternatives()
        if self._at < len(self._expression):
            raise ValueError(f'there is no ( for the ) at position {self._at}')
        return found

    def _take(self, token: str) -> bool:
        taken = self._expression.startswith(token, self._at)
        self._at += len(token) * taken
        return taken

    def _alternatives(self) -> Matches:
        found = self._sequence()
        while self._take('|'):
            found = found | self._sequence()
        return found

    def _sequence(self) -> Matches:
        found = self._empty
        while self._expression[self._at:self._at + 1] not in ('', '|', ')'):
            found = found @ self._repeated(self._atom())
        return found

    def _atom(self) -> Matches:
        places = np.arange(len(self._empty))
        if self._take('('):
            found = self._alternatives()
            if not self._take(')'):
                raise ValueError('a ) is missing')
            return found
        if self._take('^'):
            return self._empty & (places == 0)
        if self._take('$'):
            return self._empty & (places == len(self._text))
        one = CHARACTER.match(self._expression, self._at)
        if one is None:
            raise ValueError(f'what {self._expression[self._at:]!r} begins with is no character')
        self._at = one.end()
        pattern = re.compile(_in_re(one[0]))
        found = np.zeros_like(self._empty)
        for place, character in enumerate(self._text):
            found[place, place + 1] = pattern.match(character) is not None
        return found

    def _repeated(self, once: Matches) -> Matches:
        while count := COUNT.match(self._expression, self._at):
            self._at = count.end()
            least, most = COUNTS.get(count[0]) or (
                int(count[1]), int(count[3]) if count[3] else None if count[2] else int(count[1]))
            if most is not None and most < least:
                raise ValueError(f'{count[0]}: the second number must not be smaller')
            # More repetitions than the text has places find nothing else.
            enough = len(self._empty)
            more = enough if most is None else min(most - least, enough)
            once = (np.linalg.matrix_power(once, min(least, enough))
                    @ np.linalg.matrix_power(once | self._empty, more))
        return once


def _in_re(character: str) -> str:
    """Return in the syntax of `re` what matches one character: a backslash in brackets is one."""
    if not character.startswith('['):
        return character
    if re.search(r'\[[.=]', character):
        raise ValueError(f'{character}: [. and [= are not known')
    start = 2 if character.startswith('[^') else 1

    def translated(found: re.Match[str]) -> str:
        if found[1] is None:
            return f'\\{found[0]}'
        if found[1] not in CLASSES:
            raise ValueError(f'there is no class {found[0]}')
        return CLASSES[found[1]]
    return character[:start] + re.sub(
        r'\[:(\w*):\]|[][\\&~|^]', translated, character[start:-1]) + ']'
