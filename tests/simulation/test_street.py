"""What stands along the streets: out of the way of the car, on the ground, always the same."""

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import NO_WALLS, Scene, Walls, join
from rcnn_odom.simulation.street.city import LANE_OFFSET, Plan, Warp, random_plan, random_warp
from rcnn_odom.simulation.street.drive import Drive, random_drive
from rcnn_odom.simulation.street.street import LINED_WITH, SIGHT, Side, build_streets, car_outline, car_size
from rcnn_odom.simulation.terrain import Ground, flat_ground, random_ground

SEEDS = range(20)
CLEAR = 1.2
"""Metres: half a car is 0.9."""


def make(seed: int, frames: int = 60, hills: bool = True) -> tuple[Plan, Warp, Ground, Drive, Walls]:
    rng = np.random.default_rng(seed)
    plan = random_plan(rng)
    warp = random_warp(plan, rng)
    drive = random_drive(plan, warp, frames, rng)
    rim = drive.path.min(0) - 100, drive.path.max(0) + 100
    ground = random_ground(*rim, rng) if hills else flat_ground(*rim)
    return plan, warp, ground, drive, build_streets(plan, warp, ground, drive.path, rng)


@pytest.fixture(scope="module")
def streets() -> list[tuple[Plan, Warp, Ground, Drive, Walls]]:
    return [make(seed) for seed in SEEDS]


def distances(points: FloatArray, wall: FloatArray) -> FloatArray:
    """Metres (P,) from points (P, 2) to a wall (4,)."""
    along = wall[2:] - wall[:2]
    share = np.clip((points - wall[:2]) @ along / (along @ along), 0, 1)
    return np.hypot(*(wall[:2] + share[:, None] * along - points).T)


def clearance(line: FloatArray, walls: Walls) -> tuple[float, int]:
    """Metres from a line to the nearest wall, and which that is."""
    middle = (walls.ends[:, :2] + walls.ends[:, 2:]) / 2
    half = np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T) / 2
    near = np.flatnonzero(cKDTree(line).query(middle)[0] < half + 3)
    nearest = [distances(line, wall).min() for wall in walls.ends[near]]
    return (min(nearest), int(near[np.argmin(nearest)])) if nearest else (np.inf, -1)


def test_nothing_stands_in_the_way(streets) -> None:
    for seed, (plan, _, _, drive, walls) in zip(SEEDS, streets, strict=True):
        metres, wall = clearance(drive.path[::2], walls)
        assert metres > CLEAR, (seed, plan.roads.wave, walls.ends[wall])


@pytest.mark.parametrize("seed", [23, 30, 37, 45])
def test_long_walls_bend_with_their_street(seed: int) -> None:
    """Hedges and fences a hundred metres long along winding roads."""
    _, _, _, drive, walls = make(seed, 300)
    assert clearance(drive.path[::2], walls)[0] > CLEAR


def test_everything_stands_on_the_ground(streets) -> None:
    """Bottoms are well below it all along a wall, and tops above it; crowns and signs hang in the air."""
    for _, _, ground, _, walls in streets:
        bottom, top = walls.heights.T
        both = np.stack([ground.at(walls.ends[:, :2]), ground.at(walls.ends[:, 2:])])
        stands = bottom < both.mean(0) - 1
        assert (top > bottom).all()
        assert stands.mean() > 0.5
        assert (bottom[stands] < both.min(0)[stands]).all()
        assert (bottom[~stands] > both.max(0)[~stands]).all()
        assert np.mean(top > both.max(0)) > 0.999
        assert (top < both.min(0) + 17).all()


def test_surfaces_are_those_of_materials(streets) -> None:
    for *_, walls in streets:
        assert np.isfinite(walls.ends).all()
        assert ((walls.returned > 0) & (walls.returned <= 1)).all()
        assert ((walls.roughness >= 0) & (walls.roughness < 0.2)).all()
        assert (np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T) > 0).all()


def test_streets_are_built_as_far_as_one_sees(streets) -> None:
    for _, _, _, drive, walls in streets:
        line = cKDTree(drive.path)
        middle = (walls.ends[:, :2] + walls.ends[:, 2:]) / 2
        away = line.query(middle)[0]
        half = np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T) / 2
        assert (away < SIGHT + 2 * half + 3).all()
        assert np.mean(away > 60) > 0.05


def test_same_numbers_give_the_same_street() -> None:
    first, again, other = (make(seed)[-1] for seed in (1, 1, 2))
    for column in fields(Walls):
        np.testing.assert_array_equal(getattr(first, column.name), getattr(again, column.name))
    assert len(first) != len(other) or not np.array_equal(first.ends, other.ends)


@pytest.mark.parametrize("drawing", sorted({d for one in LINED_WITH.values() for d in one}, key=str))
def test_any_size_of_block_can_be_drawn(drawing) -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        side = Side(rng, rng.uniform(45, 260), rng.uniform(45, 260))
        drawing(side)
        side.parked_cars()
        side.posts()
        rows = np.concatenate(side.rows)
        assert rows.shape[1] == 8
        assert (rows[:, 5] > rows[:, 4]).all()
        assert rows[:, [1, 3]].min() > -3.2, "KERB: nothing stands further out"
        assert rows[:, [1, 3]].max() < side.depth, "nor on the far side of the block"
        assert rows[:, [0, 2]].min() > -3.2
        assert rows[:, [0, 2]].max() < side.length + 3.2


def test_shares_of_drawings_sum_to_one() -> None:
    for shares in LINED_WITH.values():
        np.testing.assert_allclose(sum(shares.values()), 1)


def test_cars_are_as_large_as_cars() -> None:
    rng = np.random.default_rng(0)
    sizes = np.array([car_size(rng) for _ in range(500)])
    assert 3.5 < sizes[:, 0].min() < sizes[:, 0].max() < 12.1
    assert 1.3 < sizes[:, 1].min() < sizes[:, 1].max() < 3.7
    assert 0.6 < np.mean(sizes[:, 1] < 1.6) < 0.85
    for length, height in sizes:
        outline = car_outline(length, height)
        rear, right, front, left = np.array([corners for corners, _ in outline]).T
        assert (rear.min(), front.max()) == (0, length)
        assert max(left) == -min(right) < LANE_OFFSET, "two cars that meet do not touch"
        assert max(top for _, top in outline) == height


def test_walls_of_a_frame_are_the_standing_and_its_moving_ones() -> None:
    def numbered(first: int, count: int) -> Walls:
        number = np.arange(first, first + count, dtype=np.float64)
        return Walls(np.tile(number[:, None], 4), np.tile(number[:, None], 2), number, number)

    standing, moving = numbered(0, 3), numbered(10, 5)
    scene = Scene(standing, moving, np.array([0, 2, 2, 5]))
    for frame, expected in enumerate([[0, 1, 2, 10, 11], [0, 1, 2], [0, 1, 2, 12, 13, 14]]):
        walls = scene.walls(frame)
        assert len(walls) == len(expected)
        for column in fields(Walls):
            values = getattr(walls, column.name)
            np.testing.assert_array_equal(values.reshape(len(walls), -1)[:, 0], expected)
    assert len(join([NO_WALLS, standing, NO_WALLS])) == 3
    np.testing.assert_array_equal(standing[np.array([False, True, True])].returned, [1, 2])
