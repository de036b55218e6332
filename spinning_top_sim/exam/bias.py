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
# A bias counts as learned if at most LEARNED of its first effect on tilt and on heading is left in
# the same attitude later; or LEARNING of both together, and the filter's estimate grows; or
# LEARNING of the largest effect at the end, and the estimate is right.
LEARNED, LEARNING = 0.5, 0.9
BIAS_FOUND = 0.05               # share of the bias in the estimate that is more than none
# Where less than VANISHED of the largest effect is left, the estimate must have this share.
VANISHED, SHARE = 0.3, 0.25
BIAS_OFF = 0.3                  # relative error of an estimate that is wrong
PART = 0.9                      # share that an estimate may have while it is so wrong


def judge_bias(response: Response) -> None:
    """Compare the excitation with and without BIAS, as docs/exam.md says."""
    excitation, findings, absolute = response.excitation, response.findings, response.absolute
    run = excitation.run.part(slice(excitation.motion.stop))
    unbiased = response.outcome.part(slice(excitation.motion.stop))
    biased = response.respond(replace(run, gyroscope=run.gyroscope + BIAS))
    errors = measures.errors_of(biased.estimates, unbiased.estimates)
    apart = errors.judged(absolute)
    left_s = rms(apart[excitation.motion]) / SIZE
    remaining = left_s * SIZE / max(float(np.max(apart)), 1e-12)
    effects = np.abs(errors)[:1 + absolute, excitation.rests[[0, -2]]]
    reported = _known(biased.biases - unbiased.biases)
    findings.measures |= {'bias_error_s': left_s, 'bias_found': _share(reported)}
    each_axis = not absolute or not _is_partial(reported)
    if left_s > BIAS_LEFT_S and not (each_axis and _is_learned(effects, reported, remaining)):
        seconds = (excitation.rests[-2] - excitation.rests[0]) / scenarios.SLOW.rate
        findings.faults.append(Fault(
            'no_bias_estimate', 'each deg/s of gyroscope bias leaves '
            f'{"an attitude" if absolute else "a tilt"} error of {left_s:.3g} deg: '
            f'its effect does not vanish {"" if each_axis else "about each axis "}in '
            f'{seconds:.0f} s' + ('' if math.isnan(_share(reported)) else
                                  f'; {_share(reported):.0%} of it are in the estimate')))
    elif _is_wrong(reported, left_s, remaining, response.subject.restarts):
        findings.faults.append(Fault(
            'bias_report', f'a gyroscope bias of {_degrees(BIAS)} deg/s is learned, but the '
            f'estimate is {_degrees(reported[-1])} deg/s'))
    # A filter that goes on keeps what it has learned in earlier runs.
    elif response.subject.restarts and _distance(none := _known(unbiased.biases), 0.0) > BIAS_OFF:
        findings.faults.append(Fault(
            'bias_report', 'the gyroscope has no bias, but the estimate is '
            f'{_degrees(none[-1])} deg/s'))


def _known(biases: Reals) -> Reals:
    """Return the rows (n, 3) of estimates that a filter has told, or one of NaN."""
    known = biases[np.isfinite(biases[:, 0])]
    return known if len(known) else np.full((1, 3), math.nan)


def _share(reported: Reals, at: int = -1) -> float:
    """Return the share of BIAS in an estimate."""
    return float(reported[at] @ BIAS) / SIZE ** 2


def _is_partial(reported: Reals) -> bool:
    """Return whether the estimate has the bias about one axis, but not about another."""
    shares = reported[-1] / BIAS
    return bool(min(shares) < BIAS_FOUND and max(shares) > LEARNED)


def _is_learned(effects: Reals, reported: Reals, remaining: float) -> bool:
    """
    Return whether the effects of BIAS disappear, or fall while the estimate grows or is right.

    effects : on the tilt and, unless it is not judged, the heading, each early and late [rad]
    reported : estimates (n, 3) [rad/s], or one of NaN
    remaining : share of the largest effect at the end
    """
    early, late = effects.T
    grows = _share(reported) > max(BIAS_FOUND, 1.2 * _share(reported, len(reported) // 4))
    return bool(np.all(late < np.maximum(LEARNED * early, BIAS_LEFT_S * SIZE)) or (
        grows and np.linalg.norm(late) < LEARNING * np.linalg.norm(early)) or (
        remaining < LEARNING and _distance(reported, BIAS) < BIAS_OFF))


def _is_wrong(reported: Reals, left_s: float, remaining: float, restarts: bool) -> bool:
    """Return whether the estimate is another bias than the one that is learned."""
    if not _distance(reported, BIAS) >= BIAS_OFF:
        return False
    # Where an error is left, or a filter goes on after minutes without a bias, it may be learned
    # in part.
    least = SHARE if remaining < VANISHED else -BIAS_FOUND
    return not ((left_s > BIAS_LEFT_S or not restarts) and least < _share(reported) < PART)


def _distance(reported: Reals, bias: Reals | float) -> float:
    """Return the median distance of the last eighth of the estimates from a bias, over SIZE."""
    last = reported[-len(reported) // 8:]
    return float(np.median(np.linalg.norm(last - bias, axis=1))) / SIZE


def _degrees(bias: Reals) -> list[float]:
    return np.degrees(bias).round(2).tolist()
