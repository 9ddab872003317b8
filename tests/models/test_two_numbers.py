"""Steps out of distance and heading change, by hand and on KITTI's real trajectories."""

from cmath import exp
from itertools import pairwise
from math import atan2, cos, pi, sin, sqrt

import numpy as np
import pytest

from conftest import SHARED
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import change_frame, compose, motions_of, poses_to_planar, relative_steps
from rcnn_odom.models.two_numbers import restate, steps_of
from rcnn_odom.recordings.trajectory import read_kitti

APPLY = ["start", "middle", "end"]
TRUTHS = SHARED / "data" / "kitti_gt_poses"
needs_kitti = pytest.mark.skipif(
    not TRUTHS.is_dir(), reason="KITTI's trajectories are not in ../shared/data/kitti_gt_poses"
)


def random_motions(seed, frames=200):
    rng = np.random.default_rng(seed)
    return np.stack([rng.normal(0.5, 1.0, frames), rng.normal(0, 0.5, frames)], axis=1)


def composed_slowly(motions, fraction):
    """Eq. 2 one frame at a time, with the accumulated heading."""
    x = y = heading = 0.0
    rows = [(x, y, heading)]
    for distance, turn in motions:
        x += distance * cos(heading + fraction * turn)
        y += distance * sin(heading + fraction * turn)
        heading += turn
        rows.append((x, y, heading))
    return np.array(rows)


@pytest.mark.parametrize(("apply", "fraction"), [("start", 0), ("middle", 0.5), ("end", 1)])
def test_poses_equal_slow_loop(apply, fraction):
    motions = random_motions(0)
    expected = composed_slowly(motions, fraction)
    poses = compose(steps_of(motions, apply))
    np.testing.assert_allclose(poses[:, :2, 3], expected[:, :2], atol=1e-10)
    for pose, (_, _, heading) in zip(poses, expected, strict=True):
        np.testing.assert_allclose(
            pose[:2, :2], [[cos(heading), -sin(heading)], [sin(heading), cos(heading)]], atol=1e-12
        )


@pytest.mark.parametrize(
    ("apply", "corners"),
    [
        ("start", [(0, 0), (2, 0), (2, 2), (0, 2), (0, 0)]),
        ("end", [(0, 0), (0, 2), (-2, 2), (-2, 0), (0, 0)]),
        ("middle", [(0, 0), (sqrt(2), sqrt(2)), (0, 2 * sqrt(2)), (-sqrt(2), sqrt(2)), (0, 0)]),
    ],
)
def test_four_left_turns_make_a_square(apply, corners):
    poses = compose(steps_of([(2, pi / 2)] * 4, apply))
    np.testing.assert_allclose(poses[:, :2, 3], corners, atol=1e-12)
    np.testing.assert_allclose(poses[-1, :3, :3], np.eye(3), atol=1e-12)


def test_heading_is_accumulated_along_a_quarter_circle():
    # Three chords of 30 degrees each on a circle of radius 10 about (0, 10), driven from the origin.
    chord = 2 * 10 * sin(pi / 12)
    poses = compose(steps_of([(chord, pi / 6)] * 3, "middle"))
    on_circle = [(10 * sin(a), 10 - 10 * cos(a)) for a in (0, pi / 6, pi / 3, pi / 2)]
    np.testing.assert_allclose(poses[:, :2, 3], on_circle, atol=1e-12)
    np.testing.assert_allclose(poses_to_planar(poses)[:, 2], [0, pi / 6, pi / 3, pi / 2], atol=1e-12)


def test_motions_survive_in_mid_turn():
    motions = random_motions(2)
    np.testing.assert_allclose(motions_of(steps_of(motions, "middle")), motions, atol=1e-12)
    np.testing.assert_allclose(
        restate(steps_of(motions, "middle"), "middle"), steps_of(motions, "middle"), atol=1e-12
    )


@pytest.mark.parametrize("apply", ["start", "end"])
def test_what_is_driven_beside_mid_turn_shrinks_by_the_cosine_of_half_the_turn(apply):
    motions = random_motions(3)
    expected = motions * np.stack([np.cos(motions[:, 1] / 2), np.ones(len(motions))], axis=1)
    np.testing.assert_allclose(motions_of(steps_of(motions, apply)), expected, atol=1e-12)


def kitti_drive(name):
    """Camera poses and the matrix from laser to camera."""
    lines = (TRUTHS / "calib_00-02.txt").read_text().splitlines()
    [numbers] = [line.split()[1:] for line in lines if line.startswith("Tr:")]
    camera_from_laser = np.vstack([np.array(numbers, dtype=float).reshape(3, 4), [0, 0, 0, 1]])
    return read_kitti(TRUTHS / f"{name}.txt"), camera_from_laser


def kitti_floor(name, apply):
    """Drift in percent of KITTI's exact motions, composed again."""
    truth, camera_from_laser = kitti_drive(name)
    laser = change_frame(truth, np.linalg.inv(camera_from_laser))
    estimate = change_frame(compose(restate(relative_steps(laser), apply)), camera_from_laser)
    return 100 * drift(truth, estimate, planar=True).t_err


def kitti_floor_slowly(name, fraction):
    """The same pose by pose, with complex numbers in the camera's x-z plane and loops over segments."""
    truth, camera_from_laser = kitti_drive(name)
    laser = [np.linalg.solve(camera_from_laser, pose) @ camera_from_laser for pose in truth]
    motions = []
    for before, after in pairwise(laser):
        step = np.linalg.solve(before, after)
        turn = atan2(step[1, 0], step[0, 0])
        motions.append(((complex(*step[:2, 3]) * exp(-0.5j * turn)).real, turn))
    estimate = []
    for x, y, heading in composed_slowly(motions, fraction):
        pose = np.eye(4)
        pose[:2, :2] = [[cos(heading), -sin(heading)], [sin(heading), cos(heading)]]
        pose[:2, 3] = x, y
        estimate.append(camera_from_laser @ pose @ np.linalg.inv(camera_from_laser))
    (true_place, true_way), (place, way) = (
        ([complex(p[2, 3], p[0, 3]) for p in poses], [atan2(p[0, 2], p[2, 2]) for p in poses])
        for poses in (truth, estimate)
    )
    gone = [0.0]
    for here, there in pairwise(true_place):
        gone.append(gone[-1] + abs(there - here))
    errors = []
    for start in range(0, len(truth), 10):
        for length in range(100, 801, 100):
            end = next((frame for frame, far in enumerate(gone) if far > gone[start] + length), None)
            if end is not None:
                seen = (place[end] - place[start]) * exp(-1j * way[start])
                true = (true_place[end] - true_place[start]) * exp(-1j * true_way[start])
                errors.append(abs(seen - true) / length)
    return 100 * sum(errors) / len(errors)


@needs_kitti
@pytest.mark.parametrize(
    ("apply", "floor_05", "floor_07"),
    [("start", 0.457, 0.733), ("middle", 0.369, 0.597), ("end", 0.291, 0.471)],
)
def test_floor_of_two_numbers_on_kitti(apply, floor_05, floor_07):
    assert kitti_floor("05", apply) == pytest.approx(floor_05, abs=0.001)
    assert kitti_floor("07", apply) == pytest.approx(floor_07, abs=0.001)


@needs_kitti
@pytest.mark.parametrize(("apply", "fraction"), [("start", 0), ("middle", 0.5), ("end", 1)])
def test_floor_equals_slow_loop(apply, fraction):
    assert kitti_floor("07", apply) == pytest.approx(kitti_floor_slowly("07", fraction), rel=1e-6)


@needs_kitti
def test_end_has_the_lowest_floor_in_training():
    names = ("00", "02", "03", "04", "06", "08", "09")
    floors = {apply: np.mean([kitti_floor(name, apply) for name in names]) for apply in APPLY}
    print({apply: f"{floor:.3f} %" for apply, floor in floors.items()})
    assert min(floors, key=floors.get) == "end"
