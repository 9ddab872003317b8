"""Buildings, and robots and people in them."""

import numpy as np
import pytest

from conftest import SHARED
from rcnn_odom.geometry import motions_of, planar_to_poses, relative_steps
from rcnn_odom.simulation.indoor.building import plan_building
from rcnn_odom.simulation.indoor.people import populate
from rcnn_odom.simulation.indoor.robot import random_robot, random_walk
from rcnn_odom.simulation.scene import NO_WALLS

CARMEN = SHARED / "data" / "carmen"
FRAMES = 400
SEEDS = range(100)


def world(seed, frames=FRAMES, people=True):
    rng = np.random.default_rng(seed)
    building = plan_building(rng)
    planar, _ = random_walk(building, frames, rng)
    return planar, populate(building, planar, rng, people)


@pytest.fixture(scope="module")
def worlds():
    return [world(seed) for seed in SEEDS]


def distance_to_walls(point, ends):
    """Metres from a point to the nearest of some lines, from the definition."""
    begin, along = ends[:, :2], ends[:, 2:] - ends[:, :2]
    share = ((point - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)
    foot = begin + np.clip(share, 0, 1)[:, None] * along
    return np.linalg.norm(point - foot, axis=1).min(initial=np.inf)


def steps_cross_walls(begin, end, ends):
    """Whether each of some steps crosses any line, by the signs of four triangles."""

    def side(a, b, c):
        return np.sign(
            (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
            - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
        )

    p, q, a, b = begin[:, None], end[:, None], ends[:, :2], ends[:, 2:]
    return ((side(p, q, a) * side(p, q, b) < 0) & (side(a, b, p) * side(a, b, q) < 0)).any(axis=1)


def motion_statistics(motions):
    """What is compared with the logs, of motions (N, 2)."""
    distance, turn = motions[:, 0], np.abs(np.rad2deg(motions[:, 1]))
    return {
        "mean step": distance.mean(),
        "degrees a metre": turn.sum() / np.abs(distance).sum(),
        "standing": np.mean((np.abs(distance) < 0.01) & (turn < 0.3)),
        "turning on the spot": np.mean((np.abs(distance) < 0.02) & (turn > 1)),
        "reversing": np.mean(distance < -0.01),
        "median turn": np.median(turn),
        "99 % turn": np.quantile(turn, 0.99),
    }


def test_same_seed_gives_the_same_world():
    (planar, scene), (again, scene_again) = world(5), world(5)
    np.testing.assert_array_equal(planar, again)
    np.testing.assert_array_equal(scene.standing.ends, scene_again.standing.ends)
    np.testing.assert_array_equal(scene.moving.ends, scene_again.moving.ends)
    assert not np.array_equal(planar, world(6)[0])


@pytest.mark.parametrize("frames", [1, 2, 4600])
def test_any_number_of_frames(frames):
    planar, scene = world(3, frames)
    assert planar.shape == (frames, 3)
    assert np.isfinite(planar).all()
    assert scene.moving_starts.shape == (frames + 1,)
    assert scene.moving_starts[0] == 0
    assert scene.moving_starts[-1] == len(scene.moving)


def test_robot_keeps_clear_of_everything_that_stands(worlds):
    for planar, scene in worlds:
        nearest = min(distance_to_walls(point, scene.standing.ends) for point in planar[::20, :2])
        assert nearest >= 0.3


def test_robot_never_passes_through_a_wall(worlds):
    for planar, scene in worlds[::2]:
        begin, end = planar[:-1:4, :2], planar[1::4, :2]
        assert not steps_cross_walls(begin, end, scene.standing.ends).any()


def test_walls_contain_the_plane_of_the_laser(worlds):
    for _, scene in worlds:
        assert scene.ground is None
        for walls in (scene.standing, scene.moving):
            assert np.isfinite(walls.ends).all()
            assert (walls.heights == [-1, 3]).all()


def test_people_keep_their_distance(worlds):
    near = []
    for planar, scene in worlds:
        for frame in range(0, FRAMES, 8):
            people = scene.walls(frame)[len(scene.standing) :].ends
            near.append(distance_to_walls(planar[frame, :2], people))
    assert min(near) >= 0.5
    assert np.mean(np.array(near) < 5) > 0.05


def test_without_people_nothing_moves():
    _, scene = world(0, people=False)
    assert scene.moving is NO_WALLS
    assert not scene.moving_starts.any()


@pytest.mark.skipif(not CARMEN.is_dir(), reason="the robots' logs are not in ../shared/data/carmen")
def test_robots_drive_as_real_ones_do(worlds):
    """Over many robots, every figure is within a quarter of the range of the three real ones."""
    real = []
    for name in ("mit-killian", "intel", "mit-csail"):
        table = np.genfromtxt(CARMEN / "reference" / f"{name}_dense_ref.csv", delimiter=",", names=True)
        planar = np.stack([table["ref_x"], table["ref_y"], table["ref_theta"]], axis=1)
        motions = motions_of(relative_steps(planar_to_poses(planar)))
        real.append(motion_statistics(motions[~np.isnan(motions).any(axis=1)]))
    generated = motion_statistics(
        np.concatenate([motions_of(relative_steps(planar_to_poses(planar))) for planar, _ in worlds])
    )
    for what, value in generated.items():
        figures = [statistics[what] for statistics in real]
        assert 0.75 * min(figures) <= value <= 1.25 * max(figures), (what, value, figures)


def test_stamps_are_those_of_the_robots_laser():
    """Twice to 12 times a second: as far apart as half a metre a second says, with lost scans between."""
    periods = []
    for seed in range(20):
        building, robot = (
            plan_building(np.random.default_rng(seed)),
            random_robot(np.random.default_rng(seed)),
        )
        planar, stamps = random_walk(building, FRAMES, np.random.default_rng(seed))  # draws the robot first
        interval = np.diff(stamps)
        assert (stamps.shape, stamps[0]) == ((FRAMES,), 0)
        assert interval.min() > 0
        assert np.median(interval) == pytest.approx(robot.step / 0.5, rel=0.05)
        speed = np.hypot(*np.diff(planar[:, :2], axis=0).T) / interval
        assert np.percentile(speed, 95) < 0.9
        assert 1 < interval.max() / np.median(interval) < 3.2
        periods.append(np.median(interval))
    assert 1 / 12.5 < min(periods) < 1 / 6
    assert 1 / 4 < max(periods) < 1 / 1.8


def test_people_walk_as_fast_whatever_the_laser_scans() -> None:
    """Metres that legs move in a frame: half as many at twice the rate, the same at the usual one."""
    building = plan_building(np.random.default_rng(3))
    planar, _ = random_walk(building, 100, np.random.default_rng(3))
    planar = planar[:1].repeat(100, axis=0)
    moved = {}
    for rate in (None, 4.0, 8.0):
        scene = populate(building, planar, np.random.default_rng(5), True, rate)
        legs = scene.moving.ends[:, :2].reshape(100, -1, 12, 2).mean(axis=2)
        moved[rate] = np.median(np.hypot(*np.moveaxis(np.diff(legs, axis=0), -1, 0)))
    assert moved[None] == moved[4.0] > 0
    assert moved[8.0] == pytest.approx(moved[4.0] / 2, rel=0.2)
