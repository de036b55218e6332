# SPDX-License-Identifier: Apache-2.0
"""The report of `examine` and of `grade`: faults with evidence, marks with limits, notes."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from spinning_top_sim.tools import cli


class Finding(NamedTuple):
    """
    A fault that was found.

    Parameters
    ----------
    name : str
        As in docs/exam.md or docs/grade.md.
    evidence : str
        What was measured, in one line.
    number : float
        The measured value, such as a lag or a coefficient; NaN where there is none.
    """

    name: str
    evidence: str
    number: float = math.nan


class Mark(NamedTuple):
    """
    A measure.

    Parameters
    ----------
    value : float
        NaN: could not be measured.
    limit : float
        From which on it is a fault; NaN: none.
    meaning : str
        What it is, in a few words.
    """

    value: float
    limit: float = math.nan
    meaning: str = ''


@dataclass(frozen=True)
class Report:
    """
    A judgement; `str(report)` is a table.

    Parameters
    ----------
    subject : str
        Name of what was judged.
    found : sequence of Finding
        Faults with their evidence, the most important first.
    marks : mapping of Mark
        By name.
    notes : sequence of str
        What was read, and what was not judged, and why.
    outcomes : sequence
        What the marks are computed from, for figures.
    absolute : bool
        Whether the headings of the outcomes are judged against north, or about their mean.
    """

    subject: str
    found: Sequence[Finding] = ()
    marks: Mapping[str, Mark] = field(default_factory=dict)
    notes: Sequence[str] = ()
    outcomes: Sequence[Any] = field(default=(), repr=False, compare=False)
    absolute: bool = field(default=True, repr=False, compare=False)

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.found

    @property
    def faults(self) -> list[str]:
        """Names of the faults, each once."""
        return list(dict.fromkeys(finding.name for finding in self.found))

    @property
    def measures(self) -> dict[str, float]:
        """Values of the marks by name; NaN: could not be measured."""
        return {name: mark.value for name, mark in self.marks.items()}

    def plus(self, *others: 'Report') -> 'Report':
        """Return this report with what others have found, measured and noted."""
        every = self, *others
        return replace(self, found=[one for report in every for one in report.found],
                       marks={name: one for report in every for name, one in report.marks.items()},
                       notes=[one for report in every for one in report.notes])

    def __str__(self) -> str:
        lines = [f'{self.subject}: {"passed" if self.passed else ", ".join(self.faults)}',
                 *(f'  {finding.name}: {finding.evidence}' for finding in self.found),
                 *(f'  {note}' for note in self.notes)]
        return '\n'.join([*lines, *(f'  {line}' for line in self.mark_lines())])

    def mark_lines(self) -> list[str]:
        """
        Return the marks as a table, without those that could not be measured.

        Those that are called 'MARK: SCENE' are a table of their own, scene by mark.
        """
        known = {name: mark for name, mark in self.marks.items() if not math.isnan(mark.value)}
        scenes: dict[str, dict[str, Mark]] = {}
        for name, mark in known.items():
            if ': ' in name:
                what, _, scene = name.partition(': ')
                scenes.setdefault(scene, {})[what] = mark
        limits = {what: mark.limit for marks in scenes.values() for what, mark in marks.items()}
        by_scene = [('scene', *limits), *((scene, *(
            f'{marks[what].value:.4g}' if what in marks else '' for what in limits))
            for scene, marks in scenes.items()), ('limit', *map(_limit, limits.values()))]
        others = [('measure', 'value', 'limit', ''), *(
            (name, f'{mark.value:.4g}', _limit(mark.limit), f'  {mark.meaning}')
            for name, mark in known.items() if ': ' not in name)]
        return [*(_aligned(by_scene) if scenes else ()),
                *(_aligned(others) if len(others) > 1 else ())]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON can hold it; None: NaN or infinity."""
        return {'subject': self.subject, 'passed': self.passed, 'faults': self.faults,
                'found': [{'name': finding.name, 'evidence': finding.evidence,
                           'number': number(finding.number)} for finding in self.found],
                'marks': {name: {'value': number(mark.value), 'limit': number(mark.limit)}
                          for name, mark in self.marks.items()},
                'notes': list(self.notes)}

    def as_json(self) -> str:
        """Return `as_dict` as JSON."""
        return json.dumps(self.as_dict(), indent=2)


def _limit(value: float) -> str:
    return '' if math.isnan(value) else f'{value:.4g}'


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines: names to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [''.join(cell if cell.startswith(' ') else f'{cell:<{width}}' if k == 0 else
                    f'  {cell:>{max(width, 9)}}' for k, (cell, width) in enumerate(
                        zip(row, widths, strict=True))).rstrip() for row in rows]


def number(value: float) -> float | None:
    """Return what JSON can hold: None for NaN and infinity."""
    return value if math.isfinite(value) else None


def printed(report: Report, as_json: bool) -> int:
    """Print a report; return the exit code of its command."""
    if as_json:
        with cli.reader_may_end():
            print(report.as_json())
    else:
        for line in str(report).splitlines():
            cli.print_line(line)
    return cli.OK if report.passed else cli.FAILED


def passing(judge: Callable[..., Report]) -> Callable[..., Report]:
    """Return `judge` as a function that fails a test in pytest, but for faults `known`."""
    import pytest  # noqa: PLC0415 - for tests only

    def judged(*arguments: Any, known: Iterable[str] = (), **options: Any) -> Report:
        __tracebackhide__ = True
        report = judge(*arguments, **options)
        if not set(report.faults) <= set(known):
            pytest.fail(str(report), pytrace=False)
        return report
    return judged
