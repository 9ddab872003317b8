"""The streets of a generated city and routes through them."""

import numpy as np
import pytest

from rcnn_odom.simulation.street.city import (
    BLOCKS,
    KERB,
    LANE_OFFSET,
    SHARES,
    random_plan,
    random_route,
    random_warp,
)

SEEDS = range(40)


def test_blocks_leave_the_streets_free() -> None:
    plan = random_plan(np.random.default_rng(1))
    blocks = list(plan.blocks())
    assert len(blocks) == BLOCKS**2
    for low, high in blocks:
        assert (high > low).all()
    (_, high), (low, _) = blocks[0], blocks[BLOCKS]
    np.testing.assert_allclose(low[0] - high[0], 2 * plan.half_widths[0, 1])


@pytest.mark.parametrize("seed", SEEDS)
def test_route_keeps_to_the_right_lane_and_is_long_enough(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = random_plan(rng)
    route = random_route(plan, 2000, rng)
    assert np.hypot(*np.diff(route.points, axis=0).T).sum() >= 2000
    straight = route.points[route.crossings[route.turn == 0]]
    offset = np.abs(straight[:, :, None] - plan.centres).min(axis=2)
    np.testing.assert_allclose(np.sort(offset, axis=1), [[0, LANE_OFFSET]] * len(straight), atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_turns_turn_the_way_they_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    route = random_route(random_plan(rng), 2000, rng)
    for at, turn in zip(route.crossings[:-1], route.turn[:-1], strict=True):
        before, after = np.diff(route.points[at - 1 : at + 2], axis=0)
        angle = np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after)
        assert abs(angle - turn * np.pi / 2) < 0.25


def test_a_longer_route_begins_like_a_shorter_one() -> None:
    plan = random_plan(np.random.default_rng(3))
    short, long = (random_route(plan, length, np.random.default_rng(4)) for length in (500, 5000))
    np.testing.assert_array_equal(long.points[: len(short.points)], short.points)


@pytest.mark.parametrize("seed", SEEDS)
def test_warp_folds_nothing_and_squeezes_no_street_much(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = random_plan(rng)
    warp = random_warp(plan, rng)
    points = rng.uniform(0, plan.centres[:, -1].min(), (2000, 2))
    step = 1e-4
    columns = [(warp(points + step * axis) - warp(points - step * axis)) / (2 * step) for axis in np.eye(2)]
    jacobian = np.stack(columns, axis=-1)
    area = np.linalg.det(jacobian)
    assert area.min() > 0.6
    # A street along an axis is as wide as the parallelogram of its unit square is high.
    widths = area[:, None] / np.linalg.norm(jacobian, axis=1)
    assert widths.min() > 0.55


def test_every_kind_of_roads_is_met() -> None:
    kinds = [random_plan(np.random.default_rng(seed)).roads for seed in range(300)]
    for roads, share in SHARES.items():
        assert abs(kinds.count(roads) / 300 - share) < 0.1
        assert roads.half_width[0] > KERB + LANE_OFFSET + 2
