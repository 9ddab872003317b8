import os
import pickle
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from conftest import SHARED
from data.make_kitti import LEVEL_RING, TR, make_kitti
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import motions_of, poses_to_planar, relative_steps
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings import kitti
from rcnn_odom.recordings.velodyne import ring_starts
from scans import beams

DATA = SHARED / "data"


@pytest.fixture
def real() -> Path:
    if not (DATA / "kitti").is_dir():
        pytest.skip(f"no real KITTI recordings at {DATA / 'kitti'}")
    return DATA / "kitti"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    make_kitti(tmp_path, ["00"], frames=4)
    return tmp_path


def scan_file(root: Path, frame: int) -> Path:
    return root / "sequences" / "00" / "velodyne" / f"{frame:06d}.bin"


def replace_line(path: Path, number: int, line: str) -> None:
    lines = path.read_text().splitlines()
    lines[number - 1] = line
    path.write_text("\n".join(lines) + "\n")


# What the reader gives


def test_truth_is_that_of_the_laser(tmp_path: Path) -> None:
    planar = make_kitti(tmp_path, ["00"], frames=12)["00"]
    sequence = kitti.load("00", root=tmp_path)
    np.testing.assert_allclose(poses_to_planar(sequence.poses), planar, atol=1e-8)
    np.testing.assert_allclose(sequence.camera_from_laser, TR)
    np.testing.assert_allclose(sequence.stamps, 0.1036 * np.arange(12), atol=1e-6)


def test_scan_shows_the_level_ring_of_the_made_world(root: Path) -> None:
    sequence = kitti.load("00", root=root)
    angles, ranges = beams(sequence.read_scan(1))
    assert angles.shape == ranges.shape
    assert sequence.read_scan(1).stamp == sequence.stamps[1]
    assert not sequence.read_scan(1).has_all_beams
    assert f"ring {LEVEL_RING} " in sequence.notes[1]
    assert 650 < len(angles) <= 720
    other, _ = beams(kitti.load("00", root=root, ring=0).read_scan(1))
    assert len(other) != len(angles) or not np.array_equal(other, angles)


def test_range_is_horizontal(root: Path) -> None:
    points = np.fromfile(scan_file(root, 0), "<f4").reshape(-1, 4).astype(float)
    _, ranges = beams(kitti.load("00", root=root, ring=0).read_scan(0))
    np.testing.assert_allclose(ranges, np.sqrt(points[: len(ranges), 0] ** 2 + points[: len(ranges), 1] ** 2))


def test_scans_agree_with_the_truth(root: Path) -> None:
    """Points of two scans, moved by the truth, lie on each other."""
    sequence = kitti.load("00", root=root)
    clouds = []
    for frame in (0, 3):
        angles, ranges = beams(sequence.read_scan(frame))
        points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), 0 * angles, 1 + 0 * angles])
        clouds.append((sequence.poses[frame] @ points)[:2].T)
    nearest = np.linalg.norm(clouds[1][:, None] - clouds[0][None], axis=2).min(axis=1)
    assert np.median(nearest) < 0.12


def test_read_scan_can_be_pickled(root: Path) -> None:
    read_scan = kitti.load("00", root=root).read_scan
    for one, two in zip(beams(read_scan(2)), beams(pickle.loads(pickle.dumps(read_scan))(2)), strict=True):
        np.testing.assert_array_equal(one, two)


def test_fingerprint_changes_with_ring_and_files_only(root: Path) -> None:
    first = kitti.load("00", root=root)
    assert kitti.load("00", root=root).fingerprint == first.fingerprint
    assert kitti.load("00", root=root, ring=LEVEL_RING).fingerprint == first.fingerprint
    assert kitti.load("00", root=root, ring=0).fingerprint != first.fingerprint
    os.utime(scan_file(root, 3), ns=(1, 1))
    assert kitti.load("00", root=root).fingerprint != first.fingerprint


# Bad input


@pytest.mark.parametrize(
    ("path", "match"),
    [
        ("poses/00.txt", r"poses/00\.txt: no such file; the ground truth .*none for 11 to 21"),
        ("sequences/00/calib.txt", r"calib\.txt: cannot be read: No such file"),
        ("sequences/00/times.txt", r"times\.txt: cannot be read: No such file"),
    ],
)
def test_missing_text(root: Path, path: str, match: str) -> None:
    (root / path).unlink()
    with pytest.raises(InputError, match=match):
        kitti.load("00", root=root)


def test_missing_folders(root: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such folder; set data\.root"):
        kitti.load("00", root=root / "nowhere")
    with pytest.raises(InputError, match="sequences/17: no such folder"):
        kitti.load("17", root=root)
    (root / "sequences" / "01").mkdir()
    with pytest.raises(InputError, match="velodyne: no such folder"):
        kitti.load("01", root=root)


def test_no_scans(root: Path) -> None:
    for frame in range(4):
        scan_file(root, frame).unlink()
    with pytest.raises(InputError, match=r"velodyne: no \.bin file"):
        kitti.load("00", root=root)


@pytest.mark.parametrize("size", [0, 1000 * 16 + 4])
def test_empty_or_cut_off_scan_is_found_before_it_is_read(root: Path, size: int) -> None:
    os.truncate(scan_file(root, 2), size)
    with pytest.raises(InputError, match=rf"000002\.bin: {size} bytes .*download it again"):
        kitti.load("00", root=root)


def test_gap_in_the_numbers(root: Path) -> None:
    scan_file(root, 1).unlink()
    with pytest.raises(InputError, match="frame 1 is missing"):
        kitti.load("00", root=root)


@pytest.mark.parametrize("name", ["copy.bin", "0002.bin"])
def test_scan_with_no_or_a_taken_number(root: Path, name: str) -> None:
    scan_file(root, 2).with_name(name).write_bytes(bytes(16))
    with pytest.raises(InputError, match="must be numbered"):
        kitti.load("00", root=root)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("T: 1 0 0", "no line starts with 'Tr:'"),
        ("Tr: 1 0 0", r"calib\.txt:5: .*, but Tr has 12 finite numbers"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 one 0", r"calib\.txt:5: .*, but Tr has 12 finite numbers"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 0 0", r"calib\.txt:5: Tr holds no rotation"),
    ],
)
def test_bad_calibration(root: Path, line: str, match: str) -> None:
    replace_line(root / "sequences" / "00" / "calib.txt", 5, line)
    with pytest.raises(InputError, match=match):
        kitti.load("00", root=root)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("1 0 0", "12 finite numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 nan", "found nan or inf"),
        ("1 0 0 0 0 1 0 0 0 0 1 x", "12 finite numbers"),
        ("0 0 0 0 0 0 0 0 0 0 0 0", "must be a rotation"),
        ("", "12 finite numbers"),
    ],
)
def test_bad_pose(root: Path, line: str, match: str) -> None:
    replace_line(root / "poses" / "00.txt", 3, line)
    with pytest.raises(InputError, match=r"00\.txt:3: .*" + match):
        kitti.load("00", root=root)


@pytest.mark.parametrize("line", ["now", "nan", "1 2"])
def test_bad_time(root: Path, line: str) -> None:
    replace_line(root / "sequences" / "00" / "times.txt", 2, line)
    with pytest.raises(InputError, match=r"times\.txt:2: .*, but a time stamp is 1 finite number"):
        kitti.load("00", root=root)


@pytest.mark.parametrize("path", ["poses/00.txt", "sequences/00/times.txt"])
def test_numbers_that_disagree(root: Path, path: str) -> None:
    lines = (root / path).read_text().splitlines()
    (root / path).write_text("\n".join(lines[:3]))
    with pytest.raises(InputError, match=r"4 scans .* all three must agree"):
        kitti.load("00", root=root)


def test_frame_without_the_ring(root: Path) -> None:
    for ring in (-1, 4):
        with pytest.raises(InputError, match=r"data\.ring must be 0 to 3"):
            kitti.load("00", root=root, ring=ring)
    sequence = kitti.load("00", root=root, ring=3)
    points = np.fromfile(scan_file(root, 1), "<f4").reshape(-1, 4)
    points[: ring_starts(points)[2]].tofile(scan_file(root, 1))
    with pytest.raises(InputError, match=r"000001\.bin: frame 1 has 2 rings, so no ring 3"):
        sequence.read_scan(1)


def test_points_that_are_not_finite_are_missing_returns(root: Path) -> None:
    sequence = kitti.load("00", root=root)
    angles, _ = beams(sequence.read_scan(1))
    points = np.fromfile(scan_file(root, 1), "<f4").reshape(-1, 4)
    points[ring_starts(points)[LEVEL_RING] + 5] = np.nan
    points.tofile(scan_file(root, 1))
    again = kitti.load("00", root=root)
    assert again.notes == sequence.notes
    np.testing.assert_array_equal(again.read_scan(1).bearings, np.delete(angles, 5))


def test_frame_with_a_ring_too_many_gives_the_same_laser(root: Path) -> None:
    sequence = kitti.load("00", root=root)
    expected = beams(sequence.read_scan(1))
    points = np.fromfile(scan_file(root, 1), "<f4").reshape(-1, 4)
    first_ring = points[: ring_starts(points)[1]]
    np.concatenate([first_ring, points]).tofile(scan_file(root, 1))
    for found, wanted in zip(beams(sequence.read_scan(1)), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_scan_cut_off_after_loading(root: Path) -> None:
    sequence = kitti.load("00", root=root)
    os.truncate(scan_file(root, 2), 20)
    with pytest.raises(InputError, match=r"000002\.bin"):
        sequence.read_scan(2)
    scan_file(root, 3).unlink()
    with pytest.raises(InputError, match=r"000003\.bin: cannot be read"):
        sequence.read_scan(3)


def test_messages_are_one_line(root: Path) -> None:
    replace_line(root / "poses" / "00.txt", 3, "x")
    with pytest.raises(InputError) as raised:
        kitti.load("00", root=root)
    assert "\n" not in str(raised.value)


# Real recordings


@pytest.mark.parametrize(("name", "scans"), [("00", 6), ("90", 40)])
def test_real_ring(real: Path, name: str, scans: int) -> None:
    sequence = kitti.load(name, root=real)
    assert len(sequence) == scans
    assert "ring 7 " in sequence.notes[1]
    for frame in range(scans):
        points = np.fromfile(sequence.read_scan.paths[frame], "<f4").reshape(-1, 4)
        azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
        wraps = np.flatnonzero(np.diff(azimuth) < -np.pi) + 1
        assert len(wraps) == 63
        ring = points[wraps[6] : wraps[7]]
        elevation = np.rad2deg(np.arctan2(ring[:, 2], np.hypot(ring[:, 0], ring[:, 1])))
        assert abs(np.median(elevation)) < 0.3
        angles, ranges = beams(sequence.read_scan(frame))
        np.testing.assert_allclose(angles % (2 * np.pi), azimuth[wraps[6] : wraps[7]], atol=1e-5)
        assert 1700 <= np.count_nonzero(encode(angles, ranges, Sensor())) <= 2000


def test_real_motion_is_that_of_the_laser(real: Path) -> None:
    rows = np.loadtxt(real / "poses" / "90.txt").reshape(-1, 3, 4)
    last_row = np.array([[[0.0, 0.0, 0.0, 1.0]]])
    camera = np.concatenate([rows, np.tile(last_row, (40, 1, 1))], axis=1)
    text = (real / "sequences" / "90" / "calib.txt").read_text().split("Tr:")[1]
    tr = np.vstack([np.array(text.split(), dtype=float).reshape(3, 4), last_row[0]])
    laser = np.array([np.linalg.inv(tr) @ pose @ tr for pose in camera])
    steps = np.array([np.linalg.solve(one, two) for one, two in pairwise(laser)])
    motions = motions_of(relative_steps(kitti.load("90", root=real).poses))
    turn = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    in_mid_turn = np.cos(turn / 2) * steps[:, 0, 3] + np.sin(turn / 2) * steps[:, 1, 3]
    np.testing.assert_allclose(motions[:, 0], in_mid_turn, atol=1e-9)
    np.testing.assert_allclose(motions[:, 1], turn, atol=1e-9)
    assert motions[0, 0] == pytest.approx(1.44, abs=0.005)
    assert motions[-1, 0] == pytest.approx(1.12, abs=0.005)
    assert motions[:, 0].sum() == pytest.approx(48.1, abs=0.1)
