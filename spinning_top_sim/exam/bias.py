# SPDX-License-Identifier: Apache-2.0
"""Judges whether a filter learns a bias of the gyroscope, and what it says of it."""

import math
from dataclasses import replace

import numpy as np

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.diagnosis import BIAS_LEFT_S
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.response import Response
from spinning_top_sim.exam.scenarios import Reals
from spinning_top_sim.tools.verdict import Fault

BIAS = np.array((0.01, -0.01, 0.02))    # of the gyroscope [rad/s]
SIZE = float(np.linalg.norm(BIAS))      # 1.4 deg/s
# A bias counts as learned if at most LEARNED of its first effect on tilt and heading is left in
# the same attitude later; LEARNING of the whole suffices if the filter's estimate grows.
LEARNED, LEARNING = 0.5, 0.9
BIAS_FOUND = 0.05               # share of the bias in the estimate that is more than none
# Where less than VANISHED of the largest effect is left, the estimate must have this share.
VANISHED, SHARE = 0.3, 0.25
BIAS_OFF, PART = 0.5, 0.8       # relative error of an estimate that is wrong; most of a part


def judge_bias(response: Response) -> None:
    """Compare the excitation with and without BIAS, as docs/exam.md says."""
    given, findings, absolute = response.excitation, response.findings, response.absolute
    run = given.run.part(slice(given.motion.stop))
    unbiased = response.outcome.part(slice(given.motion.stop))
    biased = response.respond(replace(run, gyroscope=run.gyroscope + BIAS))
    errors = measures.errors_of(biased.estimates, unbiased.estimates)
    apart = errors.judged(absolute)
    left_s = rms(apart[given.motion]) / SIZE
    effects = np.abs(errors)[:1 + absolute, given.rests[[0, -2]]]
    reported = biased.biases - unbiased.biases
    reported = reported[np.isfinite(reported[:, 0])]
    none = unbiased.biases[np.isfinite(unbiased.biases[:, 0])]
    if not len(reported):
        reported = np.full((1, 3), math.nan)
    found, shares = reported[-1], reported[-1] / BIAS
    share = float(found @ BIAS) / SIZE ** 2
    findings.measures |= {'bias_error_s': left_s, 'bias_found': share}
    left = left_s > BIAS_LEFT_S
    partly = absolute and min(shares) < BIAS_FOUND and max(shares) > LEARNED
    least = SHARE if left_s * SIZE < VANISHED * np.max(apart) else -BIAS_FOUND
    # Where an error is left, or minutes without a bias came before, it may be learned in part.
    right = _is_close(reported, BIAS) or (
        (left or not response.subject.restarts) and least < share < PART)
    if left and (partly or not _is_learned(effects, reported)):
        findings.faults.append(Fault(
            'no_bias_estimate', 'each deg/s of gyroscope bias leaves '
            f'{"an attitude" if absolute else "a tilt"} error of {left_s:.3g} deg: '
            f'the bias is not learned{" about each axis" if partly else ""} in '
            f'{(given.rests[-2] - given.rests[0]) / scenarios.SLOW.rate:.0f} s'))
    elif not right and not math.isnan(share):
        findings.faults.append(Fault(
            'bias_report', f'a gyroscope bias of {np.degrees(BIAS).round(2).tolist()} deg/s '
            f'is learned, but the estimate is {np.degrees(found).round(2).tolist()} deg/s'))
    elif response.subject.restarts and len(none) and not _is_close(none, 0.0):
        findings.faults.append(Fault(
            'bias_report', 'the gyroscope has no bias, but the estimate is '
            f'{np.degrees(none[-1]).round(2).tolist()} deg/s'))


def _is_learned(effects: Reals, reported: Reals) -> bool:
    """
    Return whether the effects of BIAS disappear, or fall while the estimate grows.

    effects : on the tilt and, unless it is not judged, the heading, each early and late [rad]
    reported : estimates (n, 3) [rad/s], or one of NaN
    """
    early, late = effects.T
    share, before = (reported[[-1, len(reported) // 4]] @ BIAS / SIZE ** 2).tolist()
    return bool(np.all(late < np.maximum(LEARNED * early, BIAS_LEFT_S * SIZE)) or (
        np.linalg.norm(late) < LEARNING * np.linalg.norm(early)
        and (_is_close(reported, BIAS) or share > max(BIAS_FOUND, 1.2 * before))))


def _is_close(reported: Reals, bias: Reals | float) -> bool:
    """Return whether the last eighth of the estimates is near a bias."""
    last = reported[-len(reported) // 8:]
    return bool(np.median(np.linalg.norm(last - bias, axis=1)) < BIAS_OFF * SIZE)
