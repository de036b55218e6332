# SPDX-License-Identifier: Apache-2.0
"""The result of grading a simulator, as text and JSON."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from spinning_top_sim.tools.verdict import Verdict, number

# docs/grade.md defines them.
FAULTS = (
    'invalid_output', 'not_deterministic', 'first_order', 'explicit_gyroscopic_term',
    'implicit_damping', 'coriolis_sign', 'no_gyroscopic_term', 'inertia_frame', 'inertia',
    'com_offset', 'gravity_sign', 'damping', 'inaccurate', 'rates_in_world', 'rates_scale',
    'imu_one_step_late', 'mounting', 'rotation_reversed', 'reading_sign', 'units',
    'reading_in_world', 'reading_scale', 'no_lever_arm', 'no_tangential_term',
    'no_centripetal_term', 'acceleration_scale', 'no_gravity', 'gravity_frame',
    'finite_differences', 'inconsistent_reading', 'energy', 'noise_scale', 'uniform_noise',
    'covariance_zero')


class Fault(NamedTuple):
    """A fault: its name, one of FAULTS, why it is reported, what was measured, such as a lag."""

    name: str
    evidence: str
    number: float = math.nan


class Report(Verdict):
    """
    The result of grading a simulator, the `subject`; `str(report)` is readable.

    passed, faults, names : whether none was found; with their evidence; their names, each once
    marks : measures by name, as docs/grade.md defines them; NaN: could not be measured
    """

    @property
    def faults(self) -> Sequence[Fault]:
        return self.found

    @property
    def marks(self) -> Mapping[str, float]:
        return self.measures

    def as_dict(self) -> dict[str, Any]:
        """Return subject, passed, faults (name, evidence, number) and marks; None: no number."""
        return {'subject': self.subject, 'passed': self.passed,
                'faults': [{**fault._asdict(), 'number': number(fault.number)}
                           for fault in self.faults],
                'marks': {name: number(value) for name, value in self.marks.items()}}
