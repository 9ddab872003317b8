"""Trajectory files and flattening."""

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.recordings.trajectory import flatten, read_kitti, write_kitti, write_tum

ROW = "1 0 0 0 0 1 0 0 0 0 1 0"


def random_rotations(count, seed=0):
    rotations, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    return rotations * np.linalg.det(rotations)[:, None, None]


def random_poses(count, seed=0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = random_rotations(count, seed)
    poses[:, :3, 3] = np.random.default_rng(seed + 1).normal(scale=300, size=(count, 3))
    return poses


def rotation_of(quaternion):
    """The textbook formula, x y z w to a matrix."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def yawed(angle):
    """A pose that looks ``angle`` from z towards x."""
    pose = np.eye(4)
    pose[[0, 2], [0, 2]] = np.cos(angle)
    pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    return pose


def test_read_kitti_by_hand(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("0 -1 0 4 1 0 0 8 0 0 1 12\n" + ROW.replace(" ", "\t") + "  \n\n\n")
    poses = read_kitti(str(path))
    assert poses.shape == (2, 4, 4)
    assert poses.dtype == np.float64
    np.testing.assert_array_equal(poses[0], [[0, -1, 0, 4], [1, 0, 0, 8], [0, 0, 1, 12], [0, 0, 0, 1]])
    np.testing.assert_array_equal(poses[1], np.eye(4))


def test_kitti_round_trip(tmp_path):
    poses = random_poses(50)
    write_kitti(tmp_path / "poses.txt", poses)
    np.testing.assert_array_equal(read_kitti(tmp_path / "poses.txt"), poses)


def test_scoring_the_file_is_scoring_the_array(tmp_path):
    angles = 0.2 * np.sin(np.arange(400) / 40)
    truth = np.array([yawed(angle) for angle in angles])
    truth[1:, 0, 3], truth[1:, 2, 3] = np.cumsum(np.sin(angles[:-1])), np.cumsum(np.cos(angles[:-1]))
    estimate = truth @ yawed(0.001)
    estimate[:, :3, 3] *= 1.01
    write_kitti(tmp_path / "truth.txt", truth)
    write_kitti(tmp_path / "estimate.txt", estimate)
    direct = drift(truth, estimate, planar=True)
    # Steps of 1 m: a hundred of them are more or less than 100 m by the last digit alone.
    assert direct.segments > 0
    assert (
        drift(read_kitti(tmp_path / "truth.txt"), read_kitti(tmp_path / "estimate.txt"), planar=True)
        == direct
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"poses\.txt: is empty"),
        ("\n \n", r"poses\.txt: is empty"),
        (f"{ROW}\n{ROW} 1\n", r"poses\.txt:2: found 13 fields"),
        (f"{ROW}\n1 2 3\n", r"poses\.txt:2: found 3 fields"),
        (f"{ROW}\n\n{ROW}\n", r"poses\.txt:2: found 0 fields"),
        (f"{ROW}\n{ROW[:-1]}x\n", r"poses\.txt:2: .*'x', but a KITTI pose has 12 finite numbers"),
        (f"{ROW[:-1]}nan\n", r"poses\.txt:1: found nan or inf"),
        (f"{ROW}\n{ROW}\n{ROW[:-1]}-inf\n", r"poses\.txt:3: found nan or inf"),
    ],
)
def test_read_kitti_names_the_line(tmp_path, text, message):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_kitti(tmp_path / "poses.txt")


def test_read_kitti_names_what_is_no_text_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.txt: cannot be read: No such file"):
        read_kitti(tmp_path / "none.txt")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_kitti(tmp_path)
    (tmp_path / "scan.bin").write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputError, match=r"scan\.bin:1: found"):
        read_kitti(tmp_path / "scan.bin")


def test_write_tum_rotations_can_be_rebuilt(tmp_path):
    poses = random_poses(200)
    # Half turns, where the formula that divides by the trace fails, and nearly half turns.
    for index, axis in enumerate(np.eye(3)):
        poses[index, :3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
        poses[index + 3, :3, :3] = poses[index, :3, :3] @ yawed(1e-6)[:3, :3]
    poses[6, :3, :3] = np.eye(3)
    stamps = 1.3e9 + 0.1 * np.arange(200)
    write_tum(tmp_path / "tum.txt", stamps, poses)
    rows = np.loadtxt(tmp_path / "tum.txt")
    assert rows.shape == (200, 8)
    np.testing.assert_array_equal(rows[:, 0], stamps)
    np.testing.assert_allclose(rows[:, 1:4], poses[:, :3, 3], rtol=1e-9)
    np.testing.assert_allclose([rotation_of(row[4:]) for row in rows], poses[:, :3, :3], atol=1e-8)
    np.testing.assert_allclose(rows[6, 4:], [0, 0, 0, 1], atol=1e-12)


def test_write_tum_quarter_turn_by_hand(tmp_path):
    write_tum(tmp_path / "tum.txt", [0.25], [yawed(np.pi / 2)])
    half = np.sqrt(0.5)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "tum.txt"), [0.25, 0, 0, 0, 0, half, 0, half], atol=1e-9)


def test_writers_refuse_wrong_shapes(tmp_path):
    with pytest.raises(ValueError, match=r"must have shape \(N, 4, 4\)"):
        write_kitti(tmp_path / "poses.txt", np.zeros((5, 12)))
    with pytest.raises(ValueError, match="but there are 5 poses"):
        write_tum(tmp_path / "tum.txt", np.arange(4), random_poses(5))


def test_flatten_keeps_position_and_heading_in_the_plane():
    poses = random_poses(100)
    flat = flatten(poses)
    np.testing.assert_array_equal(flat[:, [0, 2], 3], poses[:, [0, 2], 3])
    np.testing.assert_array_equal(flat[:, 1], np.tile([0.0, 1, 0, 0], (100, 1)))
    forward = poses[:, [0, 2], 2] / np.linalg.norm(poses[:, [0, 2], 2], axis=1, keepdims=True)
    np.testing.assert_allclose(flat[:, [0, 2], 2], forward, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(flat[:, :3, :3]), 1)


def test_flatten_is_idempotent_and_keeps_planar_poses():
    flat = flatten(random_poses(50))
    np.testing.assert_allclose(flatten(flat), flat, atol=1e-15)
    np.testing.assert_allclose(flatten([yawed(2.5)]), [yawed(2.5)], atol=1e-15)


def test_flatten_ignores_roll_and_height_and_follows_a_turn_of_the_world():
    poses = random_poses(50)
    changed = poses.copy()
    changed[:, 1, 3] += 100
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    np.testing.assert_allclose(flatten(changed @ roll), flatten(poses), atol=1e-12)
    np.testing.assert_allclose(flatten(yawed(0.7) @ poses), yawed(0.7) @ flatten(poses), atol=1e-10)
