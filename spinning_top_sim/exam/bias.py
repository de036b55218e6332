# SPDX-License-Identifier: Apache-2.0
"""Judges whether a filter learns a bias of the gyroscope, and what it says of it."""

import math
from dataclasses import replace

import numpy as np

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.diagnosis import BIAS_LEFT_S
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.response import Response
from spinning_top_sim.tools.verdict import Fault

BIAS = np.array((0.01, -0.01, 0.02))    # of the gyroscope [rad/s]; its norm is 1.4 deg/s
# A bias counts as learned if at most LEARNED of its first effect is left in the same attitude
# later; LEARNING suffices if the estimate that the filter reports grows.
LEARNED, LEARNING = 0.5, 0.9
BIAS_FOUND = 0.05               # share of the bias in the estimate that is more than none
BIAS_OFF = 0.5                  # relative error of an estimate that is wrong


def judge_bias(response: Response) -> None:
    """Compare the excitation with and without BIAS, as docs/exam.md says."""
    given, findings, absolute = response.excitation, response.findings, response.absolute
    motion, size = given.motion, float(np.linalg.norm(BIAS))
    run, unbiased = given.run.part(slice(motion.stop)), response.outcome.part(slice(motion.stop))
    biased = response.respond(replace(run, gyroscope=run.gyroscope + BIAS))
    apart = measures.errors_of(biased.estimates, unbiased.estimates).judged(absolute)
    estimates = biased.biases - unbiased.biases
    estimates = estimates[np.isfinite(estimates[:, 0])]
    if not len(estimates):
        estimates = np.full((1, 3), math.nan)
    found, left_s = estimates[-1], rms(apart[motion]) / size
    share, before = (estimates[[-1, len(estimates) // 4]] @ BIAS / size ** 2).tolist()
    first, again = apart[given.rests[[0, -2]]].tolist()
    findings.measures |= {'bias_error_s': left_s, 'bias_found': share}
    left, shares = left_s > BIAS_LEFT_S, (found / BIAS).tolist()
    # A filter that has gone on for minutes is sure of its bias, and learns another one slowly.
    close = bool(np.median(np.linalg.norm(
        estimates[-len(estimates) // 8:] - BIAS, axis=1)) < BIAS_OFF * size)
    right = -BIAS_FOUND < share < 2.0 if left or not response.subject.restarts else close
    learns = again < LEARNED * first or (
        again < LEARNING * first and (close or share > max(BIAS_FOUND, 1.2 * before)))
    partly = absolute and min(shares) < BIAS_FOUND and max(shares) > LEARNED
    if left and (partly or not learns):
        findings.faults.append(Fault(
            'no_bias_estimate', 'with a gyroscope bias of 1 deg/s the '
            f'{"attitude" if absolute else "tilt"} is {left_s:.3g} deg off in the end: '
            f'the bias is not learned{" about each axis" * partly} in '
            f'{motion.stop / scenarios.SLOW.rate:.0f} s'))
    elif not right and not math.isnan(share):
        findings.faults.append(Fault(
            'bias_report', f'a gyroscope bias of {np.degrees(BIAS).round(2).tolist()} deg/s '
            f'is learned, but the estimate is {np.degrees(found).round(2).tolist()} deg/s'))
