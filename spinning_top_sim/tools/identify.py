# SPDX-License-Identifier: Apache-2.0
"""
Identifies a sensor by least squares: what it reads beside what it should read.

`explain` explains a discrepancy by as few columns of physical effects as possible, `fit` finds the
coefficients of columns and their uncertainty.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

AXES = 'xyz'
MOST_CAUSES = 3
# Further causes are looked for while more than these shares of the discrepancy and of the noise
# remain.
ENOUGH, ENOUGH_OF_NOISE = 0.2, 0.1
WORTHWHILE = 0.8        # share of what remains that another cause leaves at most
TINY = 1e-6             # rms of an effect that cannot be seen
BLOCKS = 20             # into which residuals are split, to know their correlation
HIDDEN = 1e-3           # share of a coefficient in what cannot be told, from which on it cannot
NEAR = 0.25             # distance of a coefficient from the value that it has for a fault
# Causes count as equally good if they leave at most AS_GOOD times what the best one leaves, or at
# most AS_GOOD_SHARE of what there was, but no more than the noise.
AS_GOOD, AS_GOOD_SHARE = 2.0, 0.02


class Verdict(NamedTuple):
    """
    What the coefficients of a cause mean.

    name : of the fault; '': none, it explains as a known property does
    evidence, number : as of a `Finding`
    undo : the matrix (3, 3) by which a reading was multiplied, if it can be undone
    """

    name: str
    evidence: str
    number: float = math.nan
    undo: Reals | None = None


Judge = Callable[[Reals], Verdict | None]   # of the coefficients of a cause; None: it is not this


class Cause(NamedTuple):
    """Names of the effects of a possible cause, and what names its fault; None: it is no fault."""

    effects: Sequence[str]
    judge: Judge | None = None


def rms(values: Reals) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def instead(name: str, evidence: str) -> Judge:
    """Return a judge of the last two columns: the second effect is there instead of the first."""
    def judge(found: Reals) -> Verdict | None:
        return Verdict(name, evidence) if np.allclose(found[-2:], (-1.0, 1.0), atol=NEAR) else None
    return judge


def pooled(parts: Iterable[tuple[Reals, Mapping[str, Reals]]]) -> tuple[Reals, dict[str, Reals]]:
    """Return the discrepancy and the effects of all parts."""
    targets, effects = zip(*parts, strict=True)
    return np.concatenate(targets), {name: np.concatenate([part[name] for part in effects])
                                     for name in effects[0]}


def explain(target: Reals, effects: Mapping[str, Reals], causes: Sequence[Cause],
            floor: float = 0.0, always: Sequence[str] = ()) -> list[Cause]:
    """
    Return the causes that explain a discrepancy (N, 3), the best one first.

    effects : by name, change of what is compared by an effect of size 1 (N, 3)
    floor : rms of the noise in the target, 0 if it is not known
    always : names of effects of a size that is not known
    """
    def fit_of(causes: Sequence[Cause]) -> tuple[Reals, Reals]:
        names = [*always, *(name for cause in causes for name in cause.effects)]
        return fitted(target, [effects[name] for name in names]) if names else (
            np.empty(0), target)

    chosen, others, residual = list[Cause](), [*causes], fit_of([])[1]
    enough = max(ENOUGH * beyond(residual, floor), ENOUGH_OF_NOISE * floor)
    while len(chosen) < MOST_CAUSES and (before := beyond(residual, floor)) > enough:
        tried = [fit_of([*chosen, cause]) for cause in others]
        # A cause with a judge that names no fault explains nothing.
        after = [np.inf if verdicts([*chosen, cause], found, len(always))[-1] is None else
                 beyond(left, floor) for cause, (found, left) in zip(others, tried, strict=True)]
        good = max(AS_GOOD * min(after), min(AS_GOOD_SHARE * before, floor or np.inf))
        # Of equally good causes the one with the fewest columns wins, for more columns always fit
        # better, then the one that is named first.
        _, _, best = min((len(cause.effects), max(left, good / AS_GOOD), k) for k, (
            cause, left) in enumerate(zip(others, after, strict=True)) if left <= good)
        if after[best] > WORTHWHILE * before:
            break
        chosen.append(others.pop(best))
        residual = tried[best][1]
    return chosen


def parts(causes: Sequence[Cause], first: int = 0) -> list[tuple[Cause, slice]]:
    """Return causes with the places of their coefficients, from the first one on."""
    ends = np.cumsum([first, *(len(cause.effects) for cause in causes)]).tolist()
    return [(cause, slice(*pair)) for cause, pair in zip(causes, pairwise(ends), strict=True)]


def verdicts(causes: Sequence[Cause], found: Reals, always: int = 0) -> list[Verdict | None]:
    """
    Return what the coefficients of causes mean, each; None: it is not this.

    found : coefficients, of `always` effects of unknown size and then of causes
    """
    return [cause.judge(np.append(found[:always], found[of])) if cause.judge else
            Verdict('', 'no fault') for cause, of in parts(causes, always)]


def fitted(target: Reals, columns: Sequence[Reals]) -> tuple[Reals, Reals]:
    """Return the coefficients (k,) of columns (N, 3), 0 for a TINY one, and the residual."""
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    size = np.sqrt(np.sum(matrix * matrix, axis=0))
    size[size <= TINY * np.sqrt(len(matrix))] = np.inf
    found = np.linalg.lstsq(matrix / size, target.ravel(), rcond=1e-9)[0] / size
    return found, target - (matrix @ found).reshape(target.shape)


class Fit(NamedTuple):
    """Coefficients (k,), their standard deviations, inf: cannot be told, and what is left."""

    found: Reals
    sigma: Reals
    residual: Reals


def fit(target: Reals, columns: Sequence[Reals], noise: Sequence[float],
        own: Sequence[bool]) -> Fit:
    """
    Fit columns (N, 3) that have noise of their own.

    noise : rms of the noise in each column, which makes it larger than it is
    own : whether the target is what is measured less this column, and so has its noise

    The deviations are those of the residual in blocks: its noise may be correlated in time.
    """
    matrix = np.stack([column.ravel() for column in columns], axis=1)
    size = np.maximum(np.linalg.norm(matrix, axis=0), TINY * math.sqrt(len(matrix)))
    matrix = matrix / size
    excess = np.square(noise) * len(matrix) / size ** 2
    values, vectors = np.linalg.eigh(matrix.T @ matrix - np.diag(excess))
    known = values > np.maximum(1e-9, vectors.T ** 2 @ excess)
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    found = inverse @ (matrix.T @ target.ravel() + excess * size * own)
    residual = target - (matrix @ found).reshape(target.shape)
    scores = np.array([part.T @ left for part, left in zip(
        np.array_split(matrix, BLOCKS), np.array_split(residual.ravel(), BLOCKS), strict=True)])
    variance = np.maximum(np.diag(inverse @ scores.T @ scores @ inverse),
                          np.diag(inverse) * rms(residual) ** 2)
    hidden = np.any(np.abs(vectors[:, ~known]) > HIDDEN, axis=1)
    return Fit(found / size, np.where(hidden, np.inf, np.sqrt(variance)) / size, residual)


def compressed(target: Reals, effects: Mapping[str, Reals]) -> tuple[Reals, dict[str, Reals]]:
    """Return a target and effects with few rows, whose least squares and rms are the same."""
    columns = [*(effect.ravel() for effect in effects.values()), target.ravel()]
    rows = np.asarray(np.linalg.qr(np.stack(columns, axis=1), mode='r'), dtype=np.float64)
    rows = rows * math.sqrt(len(rows) / target.size)
    return rows[:, -1, np.newaxis], {name: rows[:, k, np.newaxis]
                                     for k, name in enumerate(effects)}


def beyond(values: Reals, floor: float) -> float:
    """Return the rms beyond that of noise."""
    return float(np.sqrt(max(rms(values) ** 2 - floor ** 2, 0.0)))
