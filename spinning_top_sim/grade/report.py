# SPDX-License-Identifier: Apache-2.0
"""The result of grading a simulator, as text and JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

from spinning_top_sim.tools.verdict import Fault, Verdict, number

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


class Report(Verdict):
    """
    The result of grading a simulator; `str(report)` is readable.

    Attributes
    ----------
    subject : str
        Name of the simulator.
    faults : sequence of Fault
        The faults with their evidence.
    marks : mapping
        Measures by name, as docs/grade.md defines them; NaN: could not be measured.
    """

    @property
    def faults(self) -> Sequence[Fault]:
        """The faults with their evidence."""
        return self.found

    @property
    def marks(self) -> Mapping[str, float]:
        """Measures by name."""
        return self.measures

    def as_dict(self) -> dict[str, Any]:
        """Return subject, passed, faults (name, evidence, number) and marks; None: no number."""
        return {'subject': self.subject, 'passed': self.passed,
                'faults': [{**fault._asdict(), 'number': number(fault.number)}
                           for fault in self.faults],
                'marks': {name: number(value) for name, value in self.marks.items()}}
