# SPDX-License-Identifier: Apache-2.0
"""Explains a discrepancy by as few causes as possible: small least-squares fits."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spinning_top_sim.exam.measures import rms
from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.tools.verdict import Fault

MOST_CAUSES = 3
# Further causes are looked for while more than these shares of the discrepancy and of the noise
# remain.
ENOUGH, ENOUGH_OF_NOISE = 0.2, 0.1
WORTHWHILE = 0.8        # share of what remains that another cause leaves at most
TINY = 1e-6             # rms of an effect that cannot be seen
NEAR = 0.25             # distance of a coefficient from the value that it has for a fault
# Causes count as equally good if they leave at most AS_GOOD times what the best one leaves, or at
# most AS_GOOD_SHARE of what there was, but no more than the noise.
AS_GOOD, AS_GOOD_SHARE = 2.0, 0.02

Judge = Callable[[Reals], Fault | None]     # of the coefficients of a cause; None: no fault


class Cause(NamedTuple):
    """Names of the effects of a possible cause, and what names its fault; None: it is no fault."""

    effects: Sequence[str]
    judge: Judge | None = None


def instead(name: str, evidence: str) -> Judge:
    """Return a judge of two columns: the second effect is there instead of the first."""
    def judge(found: Reals) -> Fault | None:
        return Fault(name, evidence) if np.allclose(found, (-1.0, 1.0), atol=NEAR) else None
    return judge


def pooled(parts: Iterable[tuple[Reals, Mapping[str, Reals]]]) -> tuple[Reals, dict[str, Reals]]:
    """Return the discrepancy and the effects of all parts."""
    targets, effects = zip(*parts, strict=True)
    return np.concatenate(targets), {name: np.concatenate([part[name] for part in effects])
                                     for name in effects[0]}


def explain(target: Reals, effects: Mapping[str, Reals], causes: Sequence[Cause],
            floor: float = 0.0) -> tuple[list[Fault], Reals]:
    """
    Explain a discrepancy (N, 3) by causes, the best one first; return faults and what is left.

    effects : by name, change of what is compared by an effect of size 1 (N, 3)
    floor : rms of the noise in the target, 0 if it is not known
    """
    chosen: list[Cause] = []
    residual, found, others = target, np.empty(0), [*causes]
    enough = max(ENOUGH * beyond(target, floor), ENOUGH_OF_NOISE * floor)
    while len(chosen) < MOST_CAUSES and (before := beyond(residual, floor)) > enough:
        tried = [fitted(target, [effects[name] for known in (*chosen, cause)
                                 for name in known.effects]) for cause in others]
        # A cause with a judge that names no fault explains nothing.
        after = [np.inf if cause.judge and cause.judge(part[-len(cause.effects):]) is None else
                 beyond(left, floor) for cause, (part, left) in zip(others, tried, strict=True)]
        good = max(AS_GOOD * min(after), min(AS_GOOD_SHARE * before, floor or np.inf))
        # Of equally good causes the one with the fewest columns wins: more columns always fit
        # better.
        _, left, best = min((len(cause.effects), left, k) for k, (cause, left) in enumerate(
            zip(others, after, strict=True)) if left <= good)
        if left > WORTHWHILE * before:
            break
        found, residual = tried[best]
        chosen.append(others.pop(best))
    return _named(chosen, found), residual


def _named(causes: Sequence[Cause], found: Reals) -> list[Fault]:
    """Return the faults that causes with these coefficients are."""
    # Without causes `split` gives one part.
    ends = np.cumsum([len(cause.effects) for cause in causes], dtype=int)[:-1]
    return [fault for cause, part in zip(causes, np.split(found, ends), strict=False)
            if cause.judge and (fault := cause.judge(part))]


def fitted(target: Reals, columns: Sequence[Reals]) -> tuple[Reals, Reals]:
    """Return the coefficients (k,) of columns (N, 3), 0 for a TINY one, and the residual."""
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    size = np.sqrt(np.sum(matrix * matrix, axis=0))
    size[size <= TINY * np.sqrt(len(matrix))] = np.inf
    found = np.linalg.lstsq(matrix / size, target.ravel(), rcond=1e-9)[0] / size
    return found, target - (matrix @ found).reshape(target.shape)


def beyond(values: Reals, floor: float) -> float:
    """Return the rms beyond that of noise."""
    return float(np.sqrt(max(rms(values) ** 2 - floor ** 2, 0.0)))


def listed(values: Iterable[float]) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)
