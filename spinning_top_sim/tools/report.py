# SPDX-License-Identifier: Apache-2.0
"""The report of `examine` and of `grade`: faults with evidence, marks with limits, notes."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
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
        What was read.
    outcomes : sequence
        What the marks are computed from, for figures.
    absolute : bool
        Whether the headings of the outcomes are judged against north, or about their mean.
    unjudged : sequence of str
        What was not judged, and why: `passed` says nothing of it.
    """

    subject: str
    found: Sequence[Finding] = ()
    marks: Mapping[str, Mark] = field(default_factory=dict)
    notes: Sequence[str] = ()
    outcomes: Sequence[Any] = field(default=(), repr=False, compare=False)
    absolute: bool = field(default=True, repr=False, compare=False)
    unjudged: Sequence[str] = ()

    @property
    def passed(self) -> bool:
        """Whether something was judged, and no fault found in it; see `unjudged`."""
        return bool(self.marks) and not self.found

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
                       notes=[one for report in every for one in report.notes],
                       unjudged=[one for report in every for one in report.unjudged])

    def __str__(self) -> str:
        right = 'passed, in what was judged' if self.unjudged else 'passed'
        verdict = ', '.join(self.faults) or (right if self.passed else 'nothing was judged')
        lines = [f'{self.subject}: {verdict}',
                 *(f'  not judged: {one}' for one in self.unjudged),
                 *(f'  {finding.name}: {finding.evidence}' for finding in self.found),
                 *(f'  {note}' for note in self.notes)]
        return '\n'.join([*lines, *self.mark_lines()])

    def mark_lines(self) -> Iterator[str]:
        """Yield the marks that were measured: 'MARK: SCENE' as a table, scene by mark."""
        known = {name: mark for name, mark in self.marks.items() if not math.isnan(mark.value)}
        of_scenes = {tuple(name.split(': ', 1)): known[name] for name in known if ': ' in name}
        limits = {what: _number(mark.limit) for (what, _), mark in of_scenes.items()}
        if of_scenes:
            rows = [(scene, *(_number(of_scenes.get((what, scene), Mark(math.nan)).value)
                              for what in limits))
                    for scene in dict.fromkeys(scene for _, scene in of_scenes)]
            yield from cli.table_lines('Scenes', ('scene', *limits),
                                       [*rows, ('limit', *limits.values())])
        others = {name: mark for name, mark in known.items() if ': ' not in name}
        if others:
            width = max(len(mark.meaning) for mark in others.values())
            last = '+- (95 %)' if any('+-' in mark.meaning for mark in others.values()) else ''
            head = 'measure', 'value', 'limit', last.ljust(width)
            yield from cli.table_lines('Measures', head, [
                (name, _number(mark.value), _number(mark.limit), mark.meaning.ljust(width))
                for name, mark in others.items()])

    def as_json(self) -> str:
        """Return the report as JSON; null: NaN or infinity."""
        def told(one: Finding | Mark) -> dict[str, Any]:
            return {name: None if isinstance(value, float) and not math.isfinite(value) else value
                    for name, value in one._asdict().items()}

        return json.dumps({
            'subject': self.subject, 'passed': self.passed, 'unjudged': list(self.unjudged),
            'faults': self.faults, 'found': [*map(told, self.found)], 'notes': list(self.notes),
            'marks': {name: told(mark) for name, mark in self.marks.items()}}, indent=2)


def _number(value: float) -> str:
    return '' if math.isnan(value) else f'{value:.4g}'


def printed(report: Report, as_json: bool) -> int:
    """Print a report; return the exit code of its command."""
    if as_json:
        with cli.reader_may_end():
            print(report.as_json())
    else:
        for line in str(report).splitlines():
            cli.print_line(line)
    return cli.OK if report.passed else cli.FAILED
