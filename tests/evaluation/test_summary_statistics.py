"""Means, paired ratios and their adjustment, against scipy and numbers worked out by hand."""

import math

import numpy as np
import pytest
from scipy.stats import t, ttest_rel

from rcnn_odom.evaluation.sweep_report.comparisons import compare_settings
from rcnn_odom.evaluation.sweep_report.statistics import Ratio, holm, mean_sd, paired_ratio, verdict


def test_mean_and_sample_deviation():
    assert mean_sd([2.0, 4.0, 9.0]) == pytest.approx((5.0, math.sqrt((9 + 1 + 16) / 2)))
    assert mean_sd([2.0]) == (2.0, None)
    assert mean_sd([]) == (None, None)


def test_the_ratio_is_a_paired_t_test_on_logarithms():
    first = {0: 0.11, 1: 0.12, 2: 0.15, 3: 0.13, 9: 0.5}
    second = {3: 0.14, 1: 0.15, 2: 0.16, 0: 0.13, 8: 0.01}
    ratio = paired_ratio(first, second)
    logs = [math.log(first[seed] / second[seed]) for seed in range(4)]
    half = t.ppf(0.975, 3) * np.std(logs, ddof=1) / 2
    assert ratio.seeds == 4
    assert ratio.ratio == pytest.approx(math.exp(np.mean(logs)))
    assert ratio.low == pytest.approx(math.exp(np.mean(logs) - half))
    assert ratio.high == pytest.approx(math.exp(np.mean(logs) + half))
    pairs = np.log([[first[seed], second[seed]] for seed in range(4)]).T
    assert ratio.p == pytest.approx(ttest_rel(*pairs).pvalue)


def test_too_few_seeds_say_nothing():
    assert paired_ratio({0: 0.1}, {1: 0.1}) == Ratio(0)
    one = paired_ratio({0: 0.1, 1: 0.3}, {0: 0.2})
    assert (one.seeds, one.ratio, one.p) == (1, pytest.approx(0.5), None)
    assert verdict(one, None) == "one seed: nothing can be tested"
    assert verdict(Ratio(0), None) == "no common seed: nothing can be tested"


def test_identical_drifts_show_no_difference():
    same = {0: 0.1, 1: 0.2, 2: 0.15}
    ratio = paired_ratio(same, dict(same))
    assert ratio == Ratio(3, 1.0, 1.0, 1.0, 1.0)
    assert verdict(ratio, ratio.p) == "no difference shown"


@pytest.mark.parametrize("seeds", [2, 3])
def test_equal_ratios_cannot_be_tested(seeds):
    """A t test of differences without any scatter would call any of them certain."""
    second = {seed: 0.1 * (seed + 1) for seed in range(seeds)}
    ratio = paired_ratio({seed: 0.7 * drift for seed, drift in second.items()}, second)
    assert ratio == Ratio(seeds, pytest.approx(0.7))
    assert holm([ratio.p, 0.03]) == [None, 0.03]
    assert verdict(ratio, None) == "all seeds have the same ratio: nothing can be tested"


def test_holm_by_hand():
    # The smallest times 4, the next times 3, then 2: 0.06 does not fall below its predecessor.
    assert holm([0.01, None, 0.04, 0.03, 0.005]) == pytest.approx([0.03, None, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([None]) == [None]


def test_the_adjusted_p_decides():
    lower, higher = Ratio(3, 0.8, 0.7, 0.9, 0.02), Ratio(3, 1.2, 1.1, 1.3, 0.02)
    assert verdict(lower, 0.04) == "lower drift"
    assert verdict(higher, 0.04) == "higher drift"
    assert verdict(lower, 0.06) == "no difference shown"


def test_settings_are_compared_with_the_reference():
    drifts = {
        ("a",): {0: 0.30, 1: 0.31, 2: 0.29},
        ("b",): {0: 0.10, 1: 0.11, 2: 0.10},
        ("c",): {0: 0.20, 1: 0.23, 2: 0.19},
        ("d",): {},
    }
    found = compare_settings(drifts, ("a",))
    assert [one.setting[0] for one in found] == ["b", "c", "d"]
    assert [one.verdict for one in found] == [
        "lower drift",
        "lower drift",
        "no common seed: nothing can be tested",
    ]
    p_values = [ttest_rel(*np.log([list(drifts[(x,)].values()), [0.30, 0.31, 0.29]])).pvalue for x in "bc"]
    smaller, larger = sorted(p_values)
    expected = {smaller: 2 * smaller, larger: max(2 * smaller, larger)}
    assert [one.adjusted_p for one in found[:2]] == pytest.approx([expected[p] for p in p_values])
    assert found[2].adjusted_p is None
