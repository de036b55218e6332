# SPDX-License-Identifier: Apache-2.0
"""What exam and grade share: a report of faults with evidence, and a fixture for pytest."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar


class Fault(NamedTuple):
    """
    A fault that was found.

    Parameters
    ----------
    name : str
        As in docs/exam.md or docs/grade.md.
    evidence : str
        Why it is reported.
    number : float
        What was measured, such as a lag or a coefficient; NaN where there is none.
    """

    name: str
    evidence: str
    number: float = math.nan


@dataclass(frozen=True)
class Verdict:
    """
    A judgement; `str(verdict)` is readable.

    Parameters
    ----------
    subject : str
        Name of what was judged.
    found : sequence of Fault
        The faults with their evidence.
    measures : mapping
        Measures by name; NaN: could not be measured.
    """

    subject: str
    found: Sequence[Fault]
    measures: Mapping[str, float]
    # Of each measure that needs a word: what it is, and from where on it is a fault.
    meanings: ClassVar[Mapping[str, str]] = {}

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.found

    @property
    def names(self) -> list[str]:
        """Names of the faults, each once."""
        return list(dict.fromkeys(fault.name for fault in self.found))

    def __str__(self) -> str:
        lines = [f'{self.subject}: {"passed" if self.passed else ", ".join(self.names)}']
        lines += [f'  {fault.name}: {fault.evidence}' for fault in self.found]
        lines += [f'  {line}' for line in self.measure_lines()]
        return '\n'.join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON can hold."""
        raise NotImplementedError

    def as_json(self) -> str:
        """Return `as_dict` as JSON."""
        return json.dumps(self.as_dict(), indent=2)

    def measure_lines(self) -> list[str]:
        """Return the measures, with what they mean, except those that could not be measured."""
        width = max(map(len, self.measures), default=0)
        return [f'{name:<{width}}{value:>12.4g}  {self.meanings.get(name, "")}'.rstrip()
                for name, value in self.measures.items() if not math.isnan(value)]


def number(value: float) -> float | None:
    """Return what JSON can hold: None for NaN and infinity."""
    return value if math.isfinite(value) else None


Report = TypeVar('Report', bound=Verdict)


def passing(judge: Callable[..., Report]) -> Callable[..., Report]:
    """Return `judge` as a function that fails a test in pytest, but for faults `known`."""
    import pytest  # noqa: PLC0415 - for tests only

    def judged(*arguments: Any, known: Iterable[str] = (), **options: Any) -> Report:
        __tracebackhide__ = True
        report = judge(*arguments, **options)
        if not set(report.names) <= set(known):
            pytest.fail(str(report), pytrace=False)
        return report
    return judged
