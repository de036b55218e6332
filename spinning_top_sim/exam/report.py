# SPDX-License-Identifier: Apache-2.0
"""The result of an exam as text, JSON and JUnit XML."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from spinning_top_sim.exam import diagnosis
from spinning_top_sim.exam.diagnosis import FAULTS, Fault
from spinning_top_sim.exam.measures import CONVERGED_DEG
from spinning_top_sim.exam.trial import Outcome

# Of each measure that needs a word: what it is, and from where on it is a fault.
MEANINGS = {
    'tilt_rms_deg': 'settled', 'tilt_max_deg': 'settled', 'heading_rms_deg': 'settled',
    'tilt_clean_deg': 'without noise, at rest and in motion', 'heading_clean_deg': 'the same',
    'convergence_s': f'until the tilt error stays below {CONVERGED_DEG:g} deg',
    'heading_drift_deg_per_s': 'slope of the heading error',
    'stamp_offset_s': f'> 0: late; right from {diagnosis.AHEAD:g} to {diagnosis.DELAYED:g} steps',
    'tilt_to_bound': 'of the least that white noise allows; mean over seeds',
    'tilt_to_bound_spread': 'standard deviation over seeds',
    'tilt_to_gyroscope': 'of the error of the gyroscope alone',
    'heading_to_bound': 'the same of the heading', 'heading_to_bound_spread': '',
    'heading_to_gyroscope': '',
    'order': 'p of error ~ rate^-p on the fast motion',
    'integration_error_deg': 'on the fast motion, without noise',
    'lever_arm_deg': f'tilt by motion 10 cm off the axis; fault from '
                     f'{math.degrees(diagnosis.LEVER_ARM):g}',
    'bias_error_s': f'deg left by 1 deg/s; fault from {diagnosis.BIAS_LEFT_S:g} unless learned',
    'bias_found': 'share of the bias in the estimate',
    'nees': 'error^2 of the tilt over its covariance; right from nees_low to nees_high',
    'nees_attitude': 'the same of the whole attitude',
    'field_rms_deg': 'in scenes of the field, in motion: mean over the scenes',
    'field_heading_rms_deg': 'heading alone', 'field_tilt_rms_deg': 'tilt alone',
    'data_rms_deg': 'of real readings in motion, mean over the trials',
    'data_heading_rms_deg': 'heading alone', 'data_tilt_rms_deg': 'tilt alone'}


@dataclass(frozen=True)
class Report:
    """
    The result of an exam; `str(report)` is readable.

    subject : name of the filter
    found : the faults with their evidence
    measures : by name, as docs/exam.md defines them; NaN: could not be measured
    outcomes : output of the filter in the runs, for pictures
    """

    subject: str
    found: Sequence[Fault]
    measures: Mapping[str, float]
    outcomes: Sequence[Outcome] = field(default=(), repr=False)

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return not self.found

    @property
    def faults(self) -> list[str]:
        """Names of the faults found, from `diagnosis.FAULTS`."""
        return [fault.name for fault in self.found]

    def __str__(self) -> str:
        lines = [f'{self.subject}: {"passed" if self.passed else ", ".join(self.faults)}']
        lines += [f'  {fault.name}: {fault.evidence}' for fault in self.found]
        lines += [f'  {line}' for line in self.measure_lines()]
        return '\n'.join(lines)

    def measure_lines(self) -> list[str]:
        """Return the measures, with what they mean, except those that could not be measured."""
        width = max(map(len, self.measures), default=0)
        return [f'{name:<{width}}{value:>12.4g}  {MEANINGS.get(name, "")}'.rstrip()
                for name, value in self.measures.items() if not math.isnan(value)]

    def as_json(self) -> str:
        """Return JSON with subject, passed, faults, evidence and measures, null for NaN."""
        return json.dumps({
            'subject': self.subject, 'passed': self.passed, 'faults': self.faults,
            'evidence': dict(self.found),
            'measures': {name: value if math.isfinite(value) else None
                         for name, value in self.measures.items()}}, indent=2)

    def as_junit(self) -> str:
        """Return a test suite in JUnit XML with a test case for each fault of FAULTS."""
        from xml.etree import ElementTree  # noqa: PLC0415 - slow

        suite = ElementTree.Element('testsuite', name=f'examine {self.subject}',
                                    tests=str(len(FAULTS)), failures=str(len(self.found)),
                                    errors='0', skipped='0')
        evidence = dict(self.found)
        for name in FAULTS:
            case = ElementTree.SubElement(suite, 'testcase', classname='examine', name=name)
            if name in evidence:
                ElementTree.SubElement(case, 'failure', message=evidence[name])
        ElementTree.indent(suite)
        return ElementTree.tostring(suite, encoding='unicode', xml_declaration=True) + '\n'
