"""Relative motions and their composition, by hand and on KITTI's real trajectories."""

from cmath import exp
from itertools import pairwise
from math import atan2, cos, pi, sin, sqrt

import numpy as np
import pytest

from conftest import SHARED
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import (
    FORWARD_CAMERA,
    change_frame,
    compose,
    planar_to_poses,
    poses_to_planar,
    relative_motions,
    wrap_angle,
)
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


def random_rigid(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = rng.normal(size=3)
    return pose


@pytest.mark.parametrize(("apply", "fraction"), [("start", 0), ("middle", 0.5), ("end", 1)])
def test_compose_equals_slow_loop(apply, fraction):
    motions = random_motions(0)
    expected = composed_slowly(motions, fraction)
    poses = compose(motions, apply)
    assert poses.shape == (201, 4, 4)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=0)
    np.testing.assert_allclose(poses[:, :2, 3], expected[:, :2], atol=1e-10)
    np.testing.assert_allclose(poses[:, 2, 3], 0, atol=0)
    for pose, (_, _, heading) in zip(poses, expected, strict=True):
        turn = [[cos(heading), -sin(heading), 0], [sin(heading), cos(heading), 0], [0, 0, 1]]
        np.testing.assert_allclose(pose[:3, :3], turn, atol=1e-12)


@pytest.mark.parametrize(
    ("apply", "corners"),
    [
        ("start", [(0, 0), (2, 0), (2, 2), (0, 2), (0, 0)]),
        ("end", [(0, 0), (0, 2), (-2, 2), (-2, 0), (0, 0)]),
        ("middle", [(0, 0), (sqrt(2), sqrt(2)), (0, 2 * sqrt(2)), (-sqrt(2), sqrt(2)), (0, 0)]),
    ],
)
def test_four_left_turns_make_a_square(apply, corners):
    poses = compose([(2, pi / 2)] * 4, apply)
    np.testing.assert_allclose(poses[:, :2, 3], corners, atol=1e-12)
    np.testing.assert_allclose(poses[-1, :3, :3], np.eye(3), atol=1e-12)


def test_heading_is_accumulated_along_a_quarter_circle():
    # Three chords of 30 degrees each on a circle of radius 10 about (0, 10), driven from the origin.
    chord = 2 * 10 * sin(pi / 12)
    poses = compose([(chord, pi / 6)] * 3, "middle")
    on_circle = [(10 * sin(a), 10 - 10 * cos(a)) for a in (0, pi / 6, pi / 3, pi / 2)]
    np.testing.assert_allclose(poses[:, :2, 3], on_circle, atol=1e-12)
    np.testing.assert_allclose(poses_to_planar(poses)[:, 2], [0, pi / 6, pi / 3, pi / 2], atol=1e-12)


def test_end_is_the_default():
    motions = random_motions(1)
    np.testing.assert_array_equal(compose(motions), compose(motions, "end"))


def test_motions_survive_composition_from_the_start():
    motions = random_motions(2)
    motions[:, 1] = np.clip(motions[:, 1], -1.5, 1.5)
    np.testing.assert_allclose(relative_motions(compose(motions, "start")), motions, atol=1e-10)


@pytest.mark.parametrize("apply", APPLY)
def test_small_turns_survive_every_composition(apply):
    motions = random_motions(3) * [1, 0.1]
    np.testing.assert_allclose(relative_motions(compose(motions, apply)), motions, atol=1e-10)


@pytest.mark.parametrize("heading", [0.0, 1.0, pi / 2, 3.0, -2.5])
def test_reversing_is_negative(heading):
    step = np.array([cos(heading), sin(heading)])
    planar = [[3, 4, heading], [*(np.array([3, 4]) - 0.7 * step), heading + 0.02]]
    np.testing.assert_allclose(relative_motions(planar_to_poses(planar)), [(-0.7, 0.02)], atol=1e-12)


def test_sideways_part_counts_as_distance():
    poses = planar_to_poses([[0, 0, 0], [3, 4, 0], [0, 8, 0]])
    np.testing.assert_allclose(relative_motions(poses), [(5, 0), (-5, 0)], atol=1e-12)


def test_motion_does_not_depend_on_the_world():
    poses = compose(random_motions(4))
    moved = random_rigid(5) @ poses
    np.testing.assert_allclose(relative_motions(moved), relative_motions(poses), atol=1e-10)


def test_turn_across_the_seam_is_small():
    planar = [[0, 0, pi - 0.1], [0, 0, -pi + 0.1]]
    np.testing.assert_allclose(relative_motions(planar_to_poses(planar))[:, 1], [0.2], atol=1e-12)


def test_wrapped_angles_lie_in_one_turn():
    angles = np.linspace(-20, 20, 997)
    wrapped = wrap_angle(angles)
    assert ((wrapped >= -pi) & (wrapped < pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_planar_rows_survive_poses():
    rng = np.random.default_rng(6)
    planar = np.stack([*rng.normal(0, 50, (2, 40)), rng.uniform(-pi, pi, 40)], axis=1)
    np.testing.assert_allclose(poses_to_planar(planar_to_poses(planar)), planar, atol=1e-12)


def test_forward_camera_sees_ahead_as_z_and_left_as_minus_x():
    np.testing.assert_array_equal(FORWARD_CAMERA @ [1, 0, 0, 1], [0, 0, 1, 1])
    np.testing.assert_array_equal(FORWARD_CAMERA @ [0, 1, 0, 1], [-1, 0, 0, 1])
    np.testing.assert_array_equal(FORWARD_CAMERA @ [0, 0, 1, 1], [0, -1, 0, 1])


def test_changed_frame_sees_the_same_points():
    camera_from_laser, laser_pose, point = random_rigid(7), random_rigid(8), np.array([1.0, 2.0, 3.0, 1.0])
    [camera_pose] = change_frame(laser_pose[None], camera_from_laser)
    # A point in the laser's frame, taken into the first frame by either sensor.
    by_laser = camera_from_laser @ (laser_pose @ point)
    by_camera = camera_pose @ (camera_from_laser @ point)
    np.testing.assert_allclose(by_camera, by_laser, atol=1e-12)
    back = change_frame(camera_pose[None], np.linalg.inv(camera_from_laser))
    np.testing.assert_allclose(back[0], laser_pose, atol=1e-12)


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
    estimate = change_frame(compose(relative_motions(laser), apply), camera_from_laser)
    return 100 * drift(truth, estimate, planar=True).t_err


def kitti_floor_slowly(name, fraction):
    """The same pose by pose, with complex numbers in the camera's x-z plane and loops over segments."""
    truth, camera_from_laser = kitti_drive(name)
    laser = [np.linalg.solve(camera_from_laser, pose) @ camera_from_laser for pose in truth]
    motions = []
    for before, after in pairwise(laser):
        step = np.linalg.solve(before, after)
        sign = -1 if step[0, 3] < 0 else 1
        motions.append((sign * sqrt(step[0, 3] ** 2 + step[1, 3] ** 2), atan2(step[1, 0], step[0, 0])))
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
    ("apply", "floor_05", "floor_07"), [("start", 0.46, 0.75), ("middle", 0.37, 0.61), ("end", 0.29, 0.48)]
)
def test_floor_of_two_numbers_on_kitti(apply, floor_05, floor_07):
    assert kitti_floor("05", apply) == pytest.approx(floor_05, abs=0.005)
    assert kitti_floor("07", apply) == pytest.approx(floor_07, abs=0.005)


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
