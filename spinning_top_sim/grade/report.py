# SPDX-License-Identifier: Apache-2.0
"""The result of grading a simulator, as text and JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

from spinning_top_sim.tools.verdict import Fault, Verdict, number


class Report(Verdict):
    """
    The result of grading a simulator; `str(report)` is readable.

    Parameters
    ----------
    subject : str
        Name of the simulator.
    found : sequence of Fault
        As `faults`.
    measures : mapping
        As `marks`.
    """

    @property
    def faults(self) -> Sequence[Fault]:
        """The faults with their evidence."""
        return self.found

    @property
    def marks(self) -> Mapping[str, float]:
        """Measures by name, as docs/grade.md defines them; NaN: could not be measured."""
        return self.measures

    def as_dict(self) -> dict[str, Any]:
        """Return subject, passed, faults (name, evidence, number) and marks; None: no number."""
        return {'subject': self.subject, 'passed': self.passed,
                'faults': [{**fault._asdict(), 'number': number(fault.number)}
                           for fault in self.faults],
                'marks': {name: number(value) for name, value in self.marks.items()}}
