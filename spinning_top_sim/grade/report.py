# SPDX-License-Identifier: Apache-2.0
"""The result of grading a simulator, as text and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

# Of each fault: what is wrong.  docs/grade.md says how it is found.
FAULTS: Mapping[str, str] = {
    'invalid_output': 'the simulator raises, or returns no motion',
    'not_deterministic': 'the same run twice differs',
    'first_order': 'the error is proportional to the step',
    'explicit_gyroscopic_term': 'the gyroscopic term is that of the begin of a step',
    'implicit_damping': 'the gyroscopic term is that of the end of a step',
    'coriolis_sign': 'the gyroscopic term, or its derivative in a step, has a wrong sign',
    'no_gyroscopic_term': 'w x I w is missing',
    'inertia_frame': 'the inertia is used in axes of the world',
    'inertia': 'the motion is that of other moments of inertia',
    'com_offset': 'the motion is that of another centre of mass',
    'gravity_sign': 'gravity, or its reading, has a wrong sign',
    'damping': 'a torque is proportional to the rates',
    'inaccurate': 'an error that no cause explains',
    'rates_in_world': 'rates are in axes of the world',
    'rates_scale': 'the attitude does not turn at the rates',
    'imu_one_step_late': 'readings belong to another time',
    'mounting': 'readings are in axes of the body, not of the IMU',
    'rotation_reversed': 'readings turn against the IMU',
    'reading_sign': 'a reading has the opposite sign',
    'units': 'readings are in degrees, g, gauss or microtesla',
    'reading_in_world': 'readings of accelerometer or magnetometer are in axes of the world',
    'reading_scale': 'a reading is a factor off',
    'no_lever_arm': 'accelerations are those of another point',
    'no_tangential_term': 'a x r is missing',
    'no_centripetal_term': 'w x (w x r) is missing',
    'acceleration_scale': 'accelerations, without gravity, are a factor off',
    'no_gravity': 'the reading lacks gravity',
    'gravity_frame': 'gravity is added in axes of the IMU',
    'finite_differences': 'accelerations are differences of velocities over a step',
    'inconsistent_reading': 'a reading that no cause explains',
    'energy': 'the energy told is not that of the motion',
    'noise_scale': 'the noise is not as declared',
    'uniform_noise': 'the noise is not normal',
    'covariance_zero': 'the covariance is zero, the noise is not',
}


class Fault(NamedTuple):
    """
    A fault of a simulator.

    Parameters
    ----------
    name : str
        One of FAULTS.
    evidence : str
        Why it is reported.
    number : float
        What was measured, such as a lag or a coefficient; NaN where there is none.
    """

    name: str
    evidence: str
    number: float = math.nan


@dataclass(frozen=True)
class Report:
    """
    The result of grading a simulator; `str(report)` is readable.

    Parameters
    ----------
    subject : str
        Name of the simulator.
    faults : sequence of Fault
        The faults with their evidence.
    marks : mapping
        Measures by name, as docs/grade.md defines them; NaN: could not be measured.
    """

    subject: str
    faults: Sequence[Fault]
    marks: Mapping[str, float]

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.faults

    @property
    def names(self) -> list[str]:
        """Names of the faults, each once."""
        return list(dict.fromkeys(fault.name for fault in self.faults))

    def __str__(self) -> str:
        lines = [f'{self.subject}: {"passed" if self.passed else ", ".join(self.names)}']
        lines += [f'  {fault.name}: {fault.evidence}' for fault in self.faults]
        lines += [f'  {name:<40}{value:>12.4g}' for name, value in self.marks.items()
                  if not math.isnan(value)]
        return '\n'.join(lines)

    def as_json(self) -> str:
        """Return JSON with subject, passed, faults (name, evidence, number) and marks."""
        def number(value: float) -> float | None:
            return value if math.isfinite(value) else None
        return json.dumps({
            'subject': self.subject, 'passed': self.passed,
            'faults': [{**fault._asdict(), 'number': number(fault.number)}
                       for fault in self.faults],
            'marks': {name: number(value) for name, value in self.marks.items()}}, indent=2)
