"""Returns in angular order, against sorting by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rcnn_odom.matching.points import find_points


def expected(ranges, bearings, farthest):
    kept = (ranges > 0) & (ranges < farthest) & (np.abs(bearings) < 1e6)
    angle = (bearings[kept] + np.pi) % (2 * np.pi) - np.pi
    order = np.argsort(angle, kind="stable")
    return (ranges[kept] * np.exp(1j * bearings[kept]))[order], angle[order]


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 300),
    order=st.sampled_from(["rising", "falling", "shuffled", "interlaced", "begins elsewhere"]),
    turns=st.integers(-3, 3),
)
def test_any_order_is_sorted(seed, count, order, turns):
    rng = np.random.default_rng(seed)
    bearings = np.sort(rng.uniform(-np.pi, np.pi, count))
    ranges = rng.choice([np.nan, np.inf, -1.0, 0.0, 90.0, 3.0, 8.0], count) + rng.random(count) * 0.5
    places = np.arange(count)
    places = {
        "rising": places,
        "falling": places[::-1],
        "shuffled": rng.permutation(count),
        "interlaced": np.concatenate([places[::2], places[1::2]]),
        "begins elsewhere": np.roll(places, count // 3),
    }[order]
    ranges, bearings = ranges[places].copy(), bearings[places] + 2 * np.pi * turns
    found = find_points(ranges, bearings, 80.0)
    points, angles = expected(ranges, bearings, 80.0)
    assert len(found) == len(points)
    np.testing.assert_allclose(found[:, 2], angles, atol=1e-9)
    np.testing.assert_allclose(found[:, 0] + 1j * found[:, 1], points, atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_beams_without_an_angle_are_left_out(bad):
    found = find_points(np.full(3, 2.0), np.array([0.1, bad, 0.3]), 80.0)
    np.testing.assert_allclose(found[:, 2], [0.1, 0.3])
