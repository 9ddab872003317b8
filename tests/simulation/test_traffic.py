"""What moves: as things on wheels and feet do, on the right of the road, and never into our car."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import NO_WALLS, Scene
from rcnn_odom.simulation.street.city import LANE_OFFSET, Plan, Warp, random_plan, random_warp
from rcnn_odom.simulation.street.drive import Drive, random_drive
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.street.traffic import CAR_SPEED, WALKER_SPEED, build_traffic
from rcnn_odom.simulation.terrain import Ground, random_ground

FRAMES = 100
SEEDS = range(12)
STRAIGHT = Warp(np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2)))
Traffic = tuple[Plan, Ground, Drive, Scene]


def make(seed: int, frames: int = FRAMES, straight: bool = False) -> Traffic:
    rng = np.random.default_rng(seed)
    plan = random_plan(rng)
    warp = STRAIGHT if straight else random_warp(plan, rng)
    drive = random_drive(plan, warp, frames, rng)
    ground = random_ground(drive.path.min(0) - 100, drive.path.max(0) + 100, rng)
    walls, starts = build_traffic(plan, warp, ground, drive, rng)
    return plan, ground, drive, Scene(NO_WALLS, walls, starts, ground)


@pytest.fixture(scope="module")
def worlds() -> list[Traffic]:
    return [make(seed) for seed in SEEDS]


def of_frame(scene: Scene, frame: int):
    start, stop = scene.moving_starts[frame : frame + 2]
    return scene.moving[start:stop]


def distances(point: FloatArray, ends: FloatArray) -> FloatArray:
    along = ends[:, 2:] - ends[:, :2]
    share = np.clip(((point - ends[:, :2]) * along).sum(1) / (along**2).sum(1), 0, 1)
    return np.hypot(*(ends[:, :2] + share[:, None] * along - point).T)


def motions(scene: Scene, frame: int) -> tuple[FloatArray, FloatArray]:
    """Walls of a frame that are found in the next: which (W,), and how far (W, 2) their middles went.

    The same wall is the nearest one in the next frame that is as long and high and faces the same way.
    """

    def shapes(walls) -> FloatArray:
        middle = (walls.ends[:, :2] + walls.ends[:, 2:]) / 2
        along = walls.ends[:, 2:] - walls.ends[:, :2]
        length = np.hypot(*along.T)
        faces = 4 * along / length[:, None]
        return np.column_stack([middle, faces, 1000 * length, 1000 * np.ptp(walls.heights, axis=1)])

    earlier, later = shapes(of_frame(scene, frame)), shapes(of_frame(scene, frame + 1))
    if not len(earlier) or not len(later):
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    away, other = cKDTree(later).query(earlier)
    found = np.flatnonzero(away < 2.0)
    return found, (later[other] - earlier)[found, :2]


def test_frames_lie_one_after_the_other(worlds) -> None:
    for _, _, drive, scene in worlds:
        starts = scene.moving_starts
        assert starts.shape == (FRAMES + 1,)
        assert (starts[0], starts[-1]) == (0, len(scene.moving))
        assert (np.diff(starts) >= 0).all()
        assert np.isfinite(scene.moving.ends).all()
        for frame in range(0, FRAMES, 20):
            ends = of_frame(scene, frame).ends
            assert (np.hypot(*(ends[:, :2] - drive.planar[frame, :2]).T) < 95).all()


def test_there_is_traffic_in_sight_of_most_drives(worlds) -> None:
    counts = [np.diff(scene.moving_starts).mean() for *_, scene in worlds]
    assert np.median(counts) > 8
    assert min(counts) > 0


def test_nothing_moves_within_six_metres_of_the_laser(worlds) -> None:
    nearest = [
        distances(drive.planar[frame, :2], of_frame(scene, frame).ends).min(initial=np.inf)
        for _, _, drive, scene in [*worlds, *(make(seed, 400) for seed in (2, 26))]
        for frame in range(0, len(drive.planar), 2)
    ]
    assert min(nearest) > 6


def test_movers_move_steadily(worlds) -> None:
    speeds, changes, found_share = [], [], []
    for *_, scene in worlds:
        previous: dict[int, FloatArray] = {}
        for frame in range(30, 34):
            found, motion = motions(scene, frame)
            count = len(of_frame(scene, frame).ends)
            found_share.append(len(found) / max(count, 1))
            speeds.append(np.hypot(*motion.T) / FRAME_TIME)
            if len(previous) == count == len(found):  # the same movers: nobody came or left
                changes.append(np.hypot(*(motion - np.array(list(previous.values()))).T))
            previous = dict(zip(found.tolist(), motion, strict=True))
    speed = np.concatenate(speeds)
    assert np.mean(found_share) > 0.9
    assert np.mean(speed > WALKER_SPEED[0] * 0.6) > 0.9, "they move"
    assert np.percentile(speed, 99) < 1.5 * CAR_SPEED[1]
    assert np.mean((speed > WALKER_SPEED[0] * 0.6) & (speed < WALKER_SPEED[1] * 1.5)) > 0.05, "some walk"
    assert np.mean(speed > CAR_SPEED[0]) > 0.05, "some drive"
    assert np.percentile(np.concatenate(changes), 90) < 0.05, "from frame to frame the same way"


def test_long_walls_go_the_way_they_point(worlds) -> None:
    slips = []
    for *_, scene in worlds:
        for frame in range(0, FRAMES - 1, 9):
            found, motion = motions(scene, frame)
            ends = of_frame(scene, frame).ends[found]
            along = ends[:, 2:] - ends[:, :2]
            length = np.hypot(*along.T)
            side = (length > 3.5) & (np.hypot(*motion.T) > 0.3)
            slips.append(np.abs(along[:, 0] * motion[:, 1] - along[:, 1] * motion[:, 0])[side] / length[side])
    slip = np.concatenate(slips)
    assert len(slip) > 50
    assert np.percentile(slip, 90) < 0.1


def test_cars_keep_to_the_right() -> None:
    """On a plan that is not bent: those that go along +x are 1.2 m below a street's middle."""
    seen = 0
    for seed in range(4):
        plan, _, drive, scene = make(seed, 20, straight=True)
        found, motion = motions(scene, 10)
        ends = of_frame(scene, 10).ends[found]
        middle, length = (ends[:, :2] + ends[:, 2:]) / 2, np.hypot(*(ends[:, 2:] - ends[:, :2]).T)
        speed = np.hypot(*motion.T) / FRAME_TIME
        # Fronts and rears of cars: their middles are the car's. Those in our lane follow our line.
        ours = cKDTree(drive.path).query(middle)[0] < 1.5
        for at, way, wide in zip(middle[~ours], motion[~ours], length[~ours], strict=True):
            pace = np.hypot(*way) / FRAME_TIME
            if pace < CAR_SPEED[0] or not 1.4 < wide < 2.1:
                continue
            axis = int(abs(way[1]) < abs(way[0]))  # which coordinate stays
            right = np.sign(way[1]) if axis == 0 else -np.sign(way[0])
            offset = right * (at[axis] - plan.centres[axis])
            assert np.abs(offset - LANE_OFFSET).min() < 1e-6
            seen += 1
        assert (speed < CAR_SPEED[1] * 1.5).all()
    assert seen > 10


def test_movers_stand_on_the_ground(worlds) -> None:
    for _, ground, _, scene in worlds:
        walls = scene.moving
        under = ground.at((walls.ends[:, :2] + walls.ends[:, 2:]) / 2)
        assert (walls.heights[:, 0] < under - 1).all()
        assert ((walls.heights[:, 1] > under + 0.3) & (walls.heights[:, 1] < under + 4.5)).all()


def test_same_numbers_give_the_same_traffic() -> None:
    first, again, other = (make(seed, 30)[-1].moving for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.ends, again.ends)
    assert not np.array_equal(first.ends, other.ends)


@pytest.mark.parametrize("frames", [2, 3])
def test_short_drives_have_traffic_too(frames: int) -> None:
    for seed in range(5):
        *_, scene = make(seed, frames)
        assert scene.moving_starts.shape == (frames + 1,)


def test_boxes_are_closed(worlds) -> None:
    """Walls come in fours, each from where the one before ends."""
    for *_, scene in worlds[:4]:
        boxes = scene.moving.ends.reshape(-1, 4, 4)
        for one, following in pairwise([0, 1, 2, 3, 0]):
            np.testing.assert_allclose(boxes[:, one, 2:], boxes[:, following, :2], atol=1e-9)
