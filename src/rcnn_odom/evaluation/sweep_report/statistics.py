"""Statistics over seeds: means, ratios of two settings from runs paired by seed, and their significance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95
"""Confidence level of the intervals; a difference is shown if its adjusted p value is below 1 - LEVEL."""

NO_DIFFERENCE = "no difference shown"

NO_SCATTER = "all seeds have the same ratio: nothing can be tested"
SCATTER = 1e-9
"""Differences of logarithms that vary less than this are equal except for rounding errors."""


def mean_sd(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Mean and sample standard deviation (divisor n-1); None if there are too few values.

    Example:
        >>> mean_sd([1.0, 2.0, 3.0]), mean_sd([1.0])
        ((2.0, 1.0), (1.0, None))
    """
    mean = float(np.mean(values)) if len(values) else None
    return mean, float(np.std(values, ddof=1)) if len(values) > 1 else None


@dataclass(frozen=True)
class Ratio:
    """The drift of one setting divided by the drift of another, over the seeds that both have.

    Attributes:
        seeds: number of common seeds.
        ratio: geometric mean of the ratios of the seeds; below 1 the first setting has less drift. None if
            there is no common seed.
        low: lower end of the confidence interval of the ratio at ``LEVEL``. None if nothing can be tested:
            there are fewer than two seeds, or all seeds have the same ratio and it is not 1.
        high: upper end of the interval; None in the same cases.
        p: two-sided p value of the hypothesis that the ratio is 1; None in the same cases.

    Example:
        >>> Ratio(seeds=1, ratio=0.9)  # one seed: nothing can be tested
        Ratio(seeds=1, ratio=0.9, low=None, high=None, p=None)
    """

    seeds: int
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None


def paired_ratio(first: Mapping[int, float], second: Mapping[int, float]) -> Ratio:
    """Compares two settings by Student's paired t test on the logarithms of their drifts.

    The test is paired because a seed gives the same order of batches in both settings: the scatter that the
    two runs share cancels in the difference. It uses logarithms because drifts are positive and scatter in
    proportion to their size; the result is then a ratio. Seeds vary the initial weights and the order of
    batches. The training and test drives are the same in every run, so the interval is valid only for these
    drives.

    Args:
        first: drift of the first setting (ratio, above 0) by seed.
        second: drift of the second setting by seed. Seeds that only one of the two has are left out.

    Returns:
        The ratio of first to second. Identical drifts give the ratio 1, an interval from 1 to 1, and p = 1.

    Example:
        >>> first, second = {0: 0.10, 1: 0.11, 2: 0.09}, {0: 0.20, 1: 0.21, 2: 0.19}
        >>> found = paired_ratio(first, second)
        >>> found.seeds, round(found.ratio, 3), found.p < 0.01
        (3, 0.499, True)
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
    if np.ptp(difference) < SCATTER:  # t is not defined without scatter
        same = np.abs(difference).max() < SCATTER
        return Ratio(len(common), 1.0, 1.0, 1.0, 1.0) if same else Ratio(len(common), ratio)
    test = ttest_rel(logs[0], logs[1])
    low, high = np.exp(test.confidence_interval(LEVEL))
    return Ratio(len(common), ratio, float(low), float(high), float(test.pvalue))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Adjusts p values for the number of comparisons, which keeps any false finding rare (Holm 1979).

    Args:
        p_values: p values of all comparisons of one table; None if nothing could be tested, which does not
            count as a comparison.

    Returns:
        The adjusted p values in the same order. With n values, the smallest is multiplied by n, the next by
        n - 1, and so on; each is at least as large as its predecessor and at most 1.

    Example:
        >>> holm([0.01, None, 0.04])
        [0.02, None, 0.04]
    """
    tested = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(tested):
        largest = max(largest, min(1.0, p * (len(tested) - rank)))
        adjusted[index] = largest
    return adjusted


def verdict(ratio: Ratio, adjusted_p: float | None) -> str:
    """Describes in words what a comparison shows; the adjusted p value decides, not the interval.

    Example:
        >>> verdict(Ratio(seeds=3, ratio=0.5, low=0.4, high=0.6, p=0.01), adjusted_p=0.02)
        'lower drift'
        >>> verdict(Ratio(seeds=3, ratio=0.9, low=0.7, high=1.1, p=0.3), adjusted_p=0.6)
        'no difference shown'
    """
    if adjusted_p is None or ratio.ratio is None:
        few = ("no common seed: nothing can be tested", "one seed: nothing can be tested")
        return few[ratio.seeds] if ratio.seeds < 2 else NO_SCATTER
    if adjusted_p >= 1 - LEVEL:
        return NO_DIFFERENCE
    return "lower drift" if ratio.ratio < 1 else "higher drift"
