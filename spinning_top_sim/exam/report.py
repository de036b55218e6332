# SPDX-License-Identifier: Apache-2.0
"""The result of an exam as text, JSON and JUnit XML."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from spinning_top_sim.exam import diagnosis
from spinning_top_sim.exam.diagnosis import FAULTS
from spinning_top_sim.exam.measures import CONVERGED_DEG
from spinning_top_sim.exam.trial import Outcome
from spinning_top_sim.tools.verdict import Fault, Verdict, number

MEANINGS = {
    'tilt_rms_deg': 'settled', 'tilt_max_deg': 'settled', 'heading_rms_deg': 'settled',
    'tilt_clean_deg': 'without noise, at rest and in motion', 'heading_clean_deg': 'the same',
    'convergence_s': f'until the tilt error stays below {CONVERGED_DEG:g} deg',
    'heading_drift_deg_per_s': 'slope of the heading error',
    'stamp_offset_s': f'> 0: late; right from {diagnosis.AHEAD:g} to {diagnosis.DELAYED:g} steps',
    'tilt_to_bound': 'of the least that white noise allows; mean over seeds',
    'tilt_to_bound_spread': 'standard deviation over seeds',
    'tilt_to_gyroscope': 'of the error of the gyroscope alone',
    'heading_to_bound': 'the same of the heading',
    'heading_to_bound_spread': 'the same of the heading',
    'heading_to_gyroscope': 'the same of the heading',
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

# What is no cause of an error with noise.
NO_CAUSE = {'inaccurate', 'diverges', 'lever_arm', 'no_bias_estimate', 'bias_report',
            'invalid_output'}
# A fault of the first set hides those of the second, which are its effects.
HIDES = (({*FAULTS} - NO_CAUSE, {'inaccurate', 'diverges'}), ({'diverges'}, {'inaccurate'}),
         ({'frame_ned'}, {'bias_report'}))


@dataclass(frozen=True)
class Report(Verdict):
    """
    The result of an exam; `str(report)` is readable.

    Parameters
    ----------
    subject : str
        Name of the filter.
    found : sequence of Fault
        The faults with their evidence.
    measures : mapping
        Measures by name, as docs/exam.md defines them; NaN: could not be measured.
    outcomes : sequence of Outcome
        Output of the filter in the runs, for pictures.
    """

    outcomes: Sequence[Outcome] = field(default=(), repr=False)
    meanings: ClassVar[Mapping[str, str]] = MEANINGS

    @property
    def faults(self) -> list[str]:
        """Names of the faults found, from `diagnosis.FAULTS`."""
        return self.names

    def as_dict(self) -> dict[str, Any]:
        """Return subject, passed, faults, evidence and measures; None: NaN."""
        return {'subject': self.subject, 'passed': self.passed, 'faults': self.faults,
                'evidence': {fault.name: fault.evidence for fault in self.found},
                'measures': {name: number(value) for name, value in self.measures.items()}}

    def as_junit(self) -> str:
        """Return a test suite in JUnit XML with a test case for each fault of FAULTS."""
        from xml.etree import ElementTree  # noqa: PLC0415 - slow

        suite = ElementTree.Element('testsuite', name=f'examine {self.subject}',
                                    tests=str(len(FAULTS)), failures=str(len(self.found)),
                                    errors='0', skipped='0')
        evidence = {fault.name: fault.evidence for fault in self.found}
        for name in FAULTS:
            case = ElementTree.SubElement(suite, 'testcase', classname='examine', name=name)
            if name in evidence:
                ElementTree.SubElement(case, 'failure', message=evidence[name])
        ElementTree.indent(suite)
        return ElementTree.tostring(suite, encoding='unicode', xml_declaration=True) + '\n'


@dataclass
class Findings:
    """Faults and measures that an exam has found so far."""

    faults: list[Fault] = field(default_factory=list)
    measures: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> set[str]:
        """Names of the faults."""
        return {fault.name for fault in self.faults}

    def drop(self, name: str) -> None:
        """Remove the faults of this name."""
        self.faults = [fault for fault in self.faults if fault.name != name]

    def report(self, subject: str, outcomes: Sequence[Outcome]) -> Report:
        """Return the report, with the first fault of each name: later ones are its effects."""
        hidden = set().union(*(effects for causes, effects in HIDES if causes & self.names))
        first: dict[str, Fault] = {}
        for fault in self.faults:
            if fault.name not in hidden:
                first.setdefault(fault.name, fault)
        return Report(subject, [*first.values()], self.measures, outcomes)
