# SPDX-License-Identifier: Apache-2.0
"""
A linear model: a discrepancy is a sum of effects of unknown sizes, and noise.

`Model.fit` finds the sizes and their uncertainty; `explain` explains the discrepancy by as few
causes as possible.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.tools.report import Finding

Reals = NDArray[np.float64]

AXES = 'xyz'
TARGET = 'discrepancy'  # the name of what is explained, among those of effects
MOST_CAUSES = 3
# Further causes are looked for while more than these shares of the discrepancy and of the noise
# remain.
ENOUGH, ENOUGH_OF_NOISE = 0.2, 0.1
WORTHWHILE = 0.8        # share of what remains that another cause leaves at most
TINY = 1e-6             # rms of an effect that cannot be seen
BLOCKS = 20             # of rows, which tell how noise is correlated
HIDDEN = 1e-3           # share of a size in what cannot be told, from which on it cannot
NEAR = 0.25             # distance of a size from the value that it has for a fault
SURE = 5.0              # standard deviations from which on a size is not chance
# Causes count as equally good if they leave at most AS_GOOD times what the best one leaves, or at
# most AS_GOOD_SHARE of what there was, but no more than the noise, or than rounding.
AS_GOOD, AS_GOOD_SHARE = 2.0, 0.02
# Noise may have this much more power than it seems to have, and that over the root of the rows.
SAME_POWER, OF_CHANCE = 1.05, 11.0

Judge = Callable[[Reals], Finding | None]   # of the sizes of effects; None: it is not this
NO_FAULT = Finding('', '')


class Cause(NamedTuple):
    """Names of the effects of a possible cause, and what names its fault."""

    effects: Sequence[str]
    judge: Judge = lambda found: NO_FAULT


class Fit(NamedTuple):
    """Sizes (k,), standard deviations (inf: cannot be told), rms that is left, that of noise."""

    found: Reals
    sigma: Reals
    rest: float
    noise: float

    @property
    def beyond(self) -> float:
        """The rms that is left beyond noise."""
        return math.sqrt(max(self.rest ** 2 - self.noise ** 2, 0.0))


def rms(values: Reals) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def instead(name: str, evidence: str) -> Judge:
    """Return a judge of the last two effects: the second is there instead of the first."""
    return lambda found: Finding(name, evidence) if np.allclose(
        found[-2:], (-1.0, 1.0), atol=NEAR) else None


class Model:
    """
    Effects and the discrepancy that they may explain, as sums of squares and products.

    parts : of each motion, values (N, 3) of effects by name, and of TARGET
    noisy : the same with as much noise again as there is in them, all of its correlations included
    always : names of effects that are there, of unknown sizes
    """

    def __init__(self, parts: Sequence[Mapping[str, Reals]],
                 noisy: Sequence[Mapping[str, Reals]] = (), always: Sequence[str] = ()) -> None:
        self.names, self.always = {name: k for k, name in enumerate(parts[0])}, always
        rows, more = (np.concatenate([np.stack([one.ravel() for one in part.values()], axis=1)
                                      for part in every]) for every in (parts, noisy or parts))
        self.count = len(rows)
        self.blocks = np.stack([part.T @ part for part in np.array_split(rows, BLOCKS)])
        self.products, self.noise = self.blocks.sum(axis=0), (more - rows).T @ (more - rows)

    def size(self, name: str) -> float:
        """Return the rms of an effect, or of TARGET."""
        return math.sqrt(self.products[2 * (self.names[name],)] / self.count)

    def clear(self, name: str, times: float) -> bool:
        """Return whether an effect can be seen, and is so many times its noise."""
        at = 2 * (self.names[name],)
        return self.size(name) > 1e-5 + times * math.sqrt(self.noise[at] / self.count)

    def fit(self, names: Sequence[str]) -> Fit:
        """Return the best sizes of `always` and of further effects."""
        at = [self.names[name] for name in (*self.always, *names, TARGET)]
        square = np.ix_(at, at)
        size = np.sqrt(np.maximum(np.diag(self.products)[at], TINY ** 2 * self.count))
        products, noise = (one[square] / np.outer(size, size)
                           for one in (self.products, self.noise))
        right = products - noise            # noise in an effect makes it larger than it is
        values, vectors = np.linalg.eigh(right[:-1, :-1])
        known = values > np.maximum(1e-10, np.sum(vectors * (noise[:-1, :-1] @ vectors), axis=0))
        inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
        found = inverse @ right[:-1, -1]
        left = np.append(-found, 1.0)
        rest, of_noise = (max(float(left @ one @ left), 0.0) for one in (products, noise))
        # The deviations are those of the rest in blocks, whose noise may be correlated in time.
        scores = (self.blocks[np.ix_(range(BLOCKS), at, at)] / np.outer(size, size) @ left)[:, :-1]
        scores = inverse @ (scores - scores.mean(axis=0)).T
        variance = np.maximum(np.sum(scores ** 2, axis=1), np.diag(inverse) * rest / self.count)
        hidden = np.any(np.abs(vectors[:, ~known]) > HIDDEN, axis=1)
        scale, target = size[-1] / size[:-1], float(size[-1])
        power = SAME_POWER + OF_CHANCE / math.sqrt(self.count)
        return Fit(found * scale, np.where(hidden, np.inf, np.sqrt(variance)) * scale,
                   target * math.sqrt(rest / self.count),
                   target * math.sqrt(power * of_noise / self.count))


def explain(model: Model, causes: Sequence[Cause],
            least: float = 0.0) -> tuple[list[Finding], Fit]:
    """
    Return the faults that explain a discrepancy, the best one first, and what is left.

    least : of the discrepancy, that needs no cause

    If a chosen cause is not what it seemed to be, nothing is explained.
    """
    def fit_of(causes: Sequence[Cause]) -> Fit:
        return model.fit([name for cause in causes for name in cause.effects])

    def judged(causes: Sequence[Cause], fit: Fit) -> list[Finding | None]:
        """Judge each by the sizes of `always` and by its own; None: they may be chance."""
        always = len(model.always)
        ends = np.cumsum([always, *(len(cause.effects) for cause in causes)]).tolist()
        return [cause.judge(np.append(fit.found[:always], fit.found[first:last]))
                if np.any(np.abs(fit.found[first:last]) > SURE * fit.sigma[first:last]) else None
                for cause, (first, last) in zip(causes, pairwise(ends), strict=True)]

    chosen, others, nothing = list[Cause](), [*causes], fit_of([])
    fit = nothing
    enough = max(ENOUGH * fit.beyond, ENOUGH_OF_NOISE * fit.noise, least)
    while others and len(chosen) < MOST_CAUSES and fit.beyond > enough:
        tried = [fit_of([*chosen, cause]) for cause in others]
        after = [np.inf if judged([*chosen, cause], one)[-1] is None else one.beyond
                 for cause, one in zip(others, tried, strict=True)]
        good = max(AS_GOOD * min(after), min(AS_GOOD_SHARE * fit.beyond, fit.noise or np.inf),
                   TINY * nothing.beyond)
        # Of equally good causes those with the fewest effects count, for more effects always fit
        # better, and of these the first that leaves, but for chance, no more than any other.
        equal = sorted((len(others[k].effects), k) for k, left in enumerate(after) if left <= good)
        rests = [tried[k].rest for size, k in equal if size == equal[0][0]]
        chance = SURE ** 2 / model.count * min(rests) + TINY * nothing.rest
        best = equal[next(k for k, rest in enumerate(rests) if rest <= min(rests) + chance)][1]
        if after[best] > WORTHWHILE * fit.beyond:
            break
        chosen.append(others.pop(best))
        fit = tried[best]
    found = judged(chosen, fit)
    return ([], nothing) if None in found else ([one for one in found if one and one.name], fit)
