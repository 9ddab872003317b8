"""Whether two settings differ: means over seeds, and their ratio from runs paired by seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95
"""Of the intervals; a difference is shown where the adjusted p value is below 1 - LEVEL."""

NO_DIFFERENCE = "no difference shown"

NO_SCATTER = "seeds do not scatter: nothing can be tested"
SCATTER = 1e-9
"""Differences of logarithms that are closer than this are equal but for rounding."""


def mean_sd(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Mean and sample standard deviation (divisor n-1); None if there are too few values."""
    mean = float(np.mean(values)) if len(values) else None
    return mean, float(np.std(values, ddof=1)) if len(values) > 1 else None


@dataclass(frozen=True)
class Ratio:
    """The drift of one setting over that of another, over the seeds that both have.

    Attributes:
        seeds: how many these are.
        ratio: geometric mean of the seeds' ratios; below 1 the first setting drifts less. None without a
            seed in common.
        low: lower end of its interval at ``LEVEL``; None where nothing can be tested: with fewer than two
            seeds, or where all seeds have the same ratio, other than 1.
        high: its upper end.
        p: of the hypothesis that the ratio is 1, two-sided; None as there.
    """

    seeds: int
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None


def paired_ratio(first: Mapping[int, float], second: Mapping[int, float]) -> Ratio:
    """Compare two settings by Student's paired t test on the logarithms of their drifts.

    Paired, because a seed decides the order of the batches in both settings alike, so that a part of the
    scatter is common and leaves the difference. On logarithms, because drifts are positive and scatter in
    proportion to their size; the answer is then a ratio. Seeds vary initial weights and the order of
    batches; training and test drives are the same in every run, so the interval says nothing about others.

    Args:
        first: drift (ratio, above 0) by seed.
        second: the same of the setting to compare with; seeds that only one of them has are left out.

    Returns:
        The ratio, first over second. Identical drifts give a ratio of 1 without any width, and a p of 1.
    """
    from scipy.stats import ttest_rel

    common = sorted(first.keys() & second.keys())
    if not common:
        return Ratio(0)
    logs = np.log([[first[seed] for seed in common], [second[seed] for seed in common]])
    difference = logs[0] - logs[1]
    ratio = float(np.exp(difference.mean()))
    if len(common) < 2:
        return Ratio(1, ratio)
    if np.ptp(difference) < SCATTER:  # for which t is not defined
        same = np.abs(difference).max() < SCATTER
        return Ratio(len(common), 1.0, 1.0, 1.0, 1.0) if same else Ratio(len(common), ratio)
    test = ttest_rel(logs[0], logs[1])
    low, high = np.exp(test.confidence_interval(LEVEL))
    return Ratio(len(common), ratio, float(low), float(high), float(test.pvalue))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Adjust p values for their number, so that *any* false finding among them stays rare (Holm 1979).

    Args:
        p_values: of all comparisons of one table; None where nothing could be tested, which does not count.

    Returns:
        The adjusted ones in the same order: the smallest times their number, the next times one less, and
        so on, never falling and at most 1.
    """
    tested = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(tested):
        largest = max(largest, min(1.0, p * (len(tested) - rank)))
        adjusted[index] = largest
    return adjusted


def verdict(ratio: Ratio, adjusted_p: float | None) -> str:
    """What a comparison shows, in words: decided by the adjusted p value, not by the interval."""
    if adjusted_p is None or ratio.ratio is None:
        few = ("no seed in common: nothing can be said", "one seed: nothing can be said")
        return few[ratio.seeds] if ratio.seeds < 2 else NO_SCATTER
    if adjusted_p >= 1 - LEVEL:
        return NO_DIFFERENCE
    return "lower drift" if ratio.ratio < 1 else "higher drift"
