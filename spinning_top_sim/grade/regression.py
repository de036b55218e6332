# SPDX-License-Identifier: Apache-2.0
"""Explains a discrepancy by as few causes as possible: small least-squares fits."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from spinning_top_sim.exam.measures import rms
from spinning_top_sim.grade.report import Fault
from spinning_top_sim.grade.scenes import Reals

MOST_CAUSES = 3
ENOUGH = 0.2            # of the discrepancy may remain: further causes are not looked for
WORTHWHILE = 0.8        # of what remains is left at most by another cause
TINY = 1e-6             # rms of an effect that cannot be seen
NEAR = 0.25             # of a coefficient to the value that it has for a fault
AS_GOOD = 2.0           # a cause with fewer columns may leave so many times more

# From the coefficients of a cause to the fault; None for what is no fault.
Judge = Callable[[Reals], Fault | None]


class Cause(NamedTuple):
    """
    A possible cause of a discrepancy.

    columns : (k, N, 3), the change of what is compared by each of k effects of size 1
    judge : names the fault
    """

    columns: Sequence[Reals]
    judge: Judge


def instead(name: str, evidence: str) -> Judge:
    """Return a judge of two columns: the second effect is there instead of the first."""
    def judge(found: Reals) -> Fault | None:
        return Fault(name, evidence) if np.allclose(found, (-1.0, 1.0), atol=NEAR) else None
    return judge


def explain(target: Reals, causes: Sequence[Cause],
            floor: float = 0.0) -> tuple[list[Fault], Reals]:
    """
    Explain a discrepancy (N, 3) by causes, the best one first.

    floor : rms of the noise in the target

    Returns the faults, and what they leave of the discrepancy.
    """
    chosen: list[Cause] = []
    residual, fitted = target, np.empty(0)
    enough = max(ENOUGH * beyond(target, floor), 0.1 * floor)
    others = [*causes]
    while len(chosen) < MOST_CAUSES and (before := beyond(residual, floor)) > enough:
        tried = [least_squares(target, [column for cause in (*chosen, one)
                                        for column in cause.columns]) for one in others]
        after = [beyond(left, floor) for _, left in tried]
        good = max(AS_GOOD * min(after), 0.02 * before)
        _, left, best = min((len(one.columns), left, k) for k, (one, left) in enumerate(
            zip(others, after, strict=True)) if left <= good)
        if left > WORTHWHILE * before:
            break
        fitted, residual = tried[best]
        chosen.append(others.pop(best))
    ends = np.cumsum([len(one.columns) for one in chosen], dtype=int)[:-1]
    judged = [one.judge(found) for one, found in zip(chosen, np.split(fitted, ends), strict=False)]
    return [fault for fault in judged if fault is not None], residual


def least_squares(target: Reals, columns: Sequence[Reals]) -> tuple[Reals, Reals]:
    """
    Return the coefficients (k,) of columns (N, 3) by least squares, and the residual.

    The coefficient of a column that is TINY is 0.
    """
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    size = np.sqrt(np.sum(matrix * matrix, axis=0))
    size[size <= TINY * np.sqrt(len(matrix))] = np.inf
    found = np.linalg.lstsq(matrix / size, target.ravel(), rcond=1e-9)[0] / size
    return found, target - (matrix @ found).reshape(target.shape)


def beyond(values: Reals, floor: float) -> float:
    """Return the rms beyond that of noise."""
    return float(np.sqrt(max(rms(values) ** 2 - floor ** 2, 0.0)))
