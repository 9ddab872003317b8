"""KITTI raw's layout: its truth through the GPS/IMU, its clock, its numbers, and what users get wrong."""

import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from conftest import SHARED
from data.make_kitti import RECTIFICATION, TR, VELO_FROM_IMU, make_kitti, make_kitti_raw, oxts_line
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import METRICS
from rcnn_odom.geometry import FORWARD_CAMERA, poses_to_planar
from rcnn_odom.recordings import kitti, kitti_raw
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.formats import open_recording, open_stream
from rcnn_odom.training.scoring import evaluate
from rcnn_odom.training.settings import plain
from scans import beams

NAME = "2011_09_26_drive_0001_sync"
REAL = SHARED / "data" / "kitti"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    make_kitti_raw(tmp_path)
    return tmp_path


def drive_in(root: Path) -> Path:
    return root / "2011_09_26" / NAME


def scan_file(root: Path, frame: int) -> Path:
    return drive_in(root) / "velodyne_points" / "data" / f"{frame:010d}.bin"


def oxts_file(root: Path, frame: int) -> Path:
    return drive_in(root) / "oxts" / "data" / f"{frame:010d}.txt"


def stamps_file(root: Path) -> Path:
    return drive_in(root) / "velodyne_points" / "timestamps.txt"


def load(root: Path, **options) -> kitti_raw.Recording:
    return kitti_raw.load(NAME, root=root, **options)


def from_first(poses: np.ndarray) -> np.ndarray:
    return np.linalg.inv(poses[0]) @ poses


def refusal(call) -> str:
    with pytest.raises(InputError) as raised:
        call()
    text = str(raised.value)
    assert "\n" not in text
    assert ";" in text
    return text


# What the reader gives


def test_truth_is_that_of_the_laser(tmp_path: Path) -> None:
    planar = make_kitti_raw(tmp_path, frames=12)
    recording = load(tmp_path)
    np.testing.assert_allclose(poses_to_planar(from_first(recording.poses)), planar, atol=1e-4)
    assert not np.allclose(recording.poses[0], np.eye(4))
    rectified = np.eye(4)
    rectified[:3, :3] = RECTIFICATION
    np.testing.assert_allclose(recording.camera_from_laser, rectified @ TR, atol=1e-9)


def test_scans_are_those_of_the_odometry_layout(root: Path, tmp_path: Path) -> None:
    make_kitti(tmp_path, ["00"], frames=6)
    recording, wanted = load(root), kitti.load("00", root=tmp_path)
    assert recording.notes == wanted.notes
    assert len(recording) == 6
    for frame in range(6):
        for values, expected in zip(
            beams(recording.read_scan(frame)), beams(wanted.read_scan(frame)), strict=True
        ):
            np.testing.assert_array_equal(values, expected)
    assert load(root, ring=0).fingerprint != recording.fingerprint
    os.utime(scan_file(root, 3), ns=(1, 1))
    assert load(root).fingerprint != recording.fingerprint


def test_a_pose_by_hand(root: Path) -> None:
    """One metre north is 1 / (er cos(lat0)) of Mercator's height; angles are applied as Rz Ry Rx."""
    roll, pitch, yaw = 0.1, -0.2, 2.0
    for frame, latitude in ((0, 49.0), (1, 49.00001)):
        words = [latitude, 8.4, 100.0 + frame, roll, pitch, yaw, *np.zeros(24)]
        oxts_file(root, frame).write_text(" ".join(map(repr, map(float, words))))
    for frame in range(2, 6):
        scan_file(root, frame).unlink()
    poses = load(root).poses @ VELO_FROM_IMU
    sin, cos = np.sin, np.cos
    about_x = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    about_y = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    about_z = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(poses[1][:3, :3], about_z @ about_y @ about_x, atol=1e-6)
    north = 6378137 * np.deg2rad(0.00001)  # 1.113 m: cos(lat0) and Mercator's stretching cancel
    np.testing.assert_allclose(poses[1][:3, 3] - poses[0][:3, 3], [0, north, 1], atol=1e-6)


def test_the_clock_keeps_its_microseconds(root: Path) -> None:
    first = datetime(2011, 9, 26, 13, 2, 25, 951199, tzinfo=UTC).timestamp()
    stamps = load(root).stamps
    np.testing.assert_allclose(stamps, first + 3.37e-7 + 0.1036 * np.arange(6), atol=3e-7, rtol=0)
    assert load(root).read_scan(2).stamp == stamps[2]


def test_the_laser_turns_clockwise_about_the_moment_when_it_looks_ahead(root: Path) -> None:
    """A turn begins and ends behind the car; on its left the laser looks before it looks ahead."""
    scan = load(root).read_scan(0)
    ahead, left = np.argmin(np.abs(scan.bearings)), np.argmin(np.abs(scan.bearings - np.pi / 2))
    assert scan.times[ahead] == pytest.approx(0, abs=1e-3)
    assert scan.times[left] == pytest.approx(-0.025, abs=1e-3)
    np.testing.assert_allclose(scan.times, -0.1 * scan.bearings / (2 * np.pi))
    assert not load(root).is_compensated
    assert not kitti_raw.stream(drive_in(root)).is_compensated


def test_the_time_of_a_turn_is_that_of_its_ends(root: Path) -> None:
    turns = [0.1036, 0.0998, 0.1, 60.0, 0.0, -0.1]
    ends = {"start": [20 + frame for frame in range(6)]}
    ends["end"] = [start + turn for start, turn in zip(ends["start"], turns, strict=True)]
    for end, seconds in ends.items():
        lines = "".join(f"2011-09-26 13:{int(s // 60):02d}:{s % 60:012.9f}\n" for s in seconds)
        (drive_in(root) / "velodyne_points" / f"timestamps_{end}.txt").write_text(lines)
    recording, stream = load(root), kitti_raw.stream(drive_in(root))
    for scan, turn in zip(stream.scans, [*turns[:3], 0.1, 0.1, 0.1], strict=True):
        np.testing.assert_allclose(scan.times, -turn * scan.bearings / (2 * np.pi), atol=1e-6)
    np.testing.assert_array_equal(
        recording.read_scan(0).times, next(iter(kitti_raw.stream(drive_in(root)).scans)).times
    )


def test_text_gives_the_same_scans(root: Path) -> None:
    wanted = [beams(load(root).read_scan(frame)) for frame in range(6)]
    for frame in range(6):
        points = np.fromfile(scan_file(root, frame), "<f4").reshape(-1, 4)
        np.savetxt(scan_file(root, frame).with_suffix(".txt"), points, fmt="%.9g")
    notes = load(root).notes
    assert "6 .txt files beside the .bin files are not read" in notes
    for frame in range(6):
        scan_file(root, frame).unlink()
    for frame in range(6):
        for values, expected in zip(beams(load(root).read_scan(frame)), wanted[frame], strict=True):
            np.testing.assert_array_equal(values, expected)


def test_other_texts_beside_the_scans(root: Path) -> None:
    readme = scan_file(root, 0).with_name("readme.txt")
    readme.write_text("about")
    assert len(load(root)) == 6
    assert not any(".txt" in note for note in load(root).notes)
    for frame in range(6):
        scan_file(root, frame).unlink()
        scan_file(root, frame).with_suffix(".txt").touch()
    readme.unlink()
    assert "0.txt: 0 bytes in it, so the file is empty; " in refusal(lambda: load(root))


@pytest.mark.parametrize("below", ["", "velodyne_points", "velodyne_points/data"])
def test_a_stream_needs_neither_truth_nor_camera(root: Path, below: str, monkeypatch) -> None:
    for path in (drive_in(root) / "oxts").rglob("*.txt"):
        path.unlink()
    for path in drive_in(root).parent.glob("calib*"):
        path.unlink()
    stream = open_stream(drive_in(root) / below, {"ring": 1})
    assert (stream.name, stream.total, stream.beams) == (NAME, 6, Beams(-180.0, 360.0, 0.18))
    np.testing.assert_array_equal(stream.camera_from_laser, FORWARD_CAMERA)
    assert any("calib_velo_to_cam.txt" in note for note in stream.notes)
    assert "ring 1 of" in stream.notes[-1]
    assert len(list(stream.scans)) == 6
    monkeypatch.chdir(drive_in(root) / below)
    assert open_stream(Path(".")).total == 6


def test_calibration_beside_the_drive_or_in_it_without_rectification(root: Path) -> None:
    for path in drive_in(root).parent.glob("calib*"):
        path.rename(drive_in(root) / path.name)
    assert not any("rectified" in note for note in load(root).notes)
    (drive_in(root) / "calib_cam_to_cam.txt").unlink()
    recording = load(root)
    np.testing.assert_allclose(recording.camera_from_laser, TR, atol=1e-9)
    assert "no calib_cam_to_cam.txt: the camera's frame is not rectified" in recording.notes


# Numbers of frames


@pytest.mark.parametrize("first", [0, 7])
def test_frames_that_are_missing(tmp_path: Path, first: int) -> None:
    planar = make_kitti_raw(tmp_path, frames=9, first=first)
    whole = load(tmp_path)
    for frame in (3, 4, 6):
        scan_file(tmp_path, first + frame).unlink()
    recording = load(tmp_path)
    kept = [0, 1, 2, 5, 7, 8]
    assert "3 frame numbers between the first and the last have no scan" in recording.notes
    np.testing.assert_array_equal(recording.stamps, whole.stamps[kept])
    np.testing.assert_allclose(poses_to_planar(from_first(recording.poses)), planar[kept], atol=1e-4)
    assert recording.read_scan(3).stamp == whole.stamps[5]
    assert [scan.stamp for scan in kitti_raw.stream(drive_in(tmp_path)).scans] == whole.stamps[kept].tolist()


def test_by_position_where_the_counts_agree(tmp_path: Path) -> None:
    make_kitti_raw(tmp_path, frames=6)
    wanted = load(tmp_path)
    for frame in reversed(range(6)):
        scan_file(tmp_path, frame).rename(scan_file(tmp_path, frame + 20))
    (drive_in(tmp_path) / "oxts" / "timestamps.txt").unlink()
    recording = load(tmp_path)
    np.testing.assert_array_equal(recording.stamps, wanted.stamps)
    np.testing.assert_array_equal(recording.poses, wanted.poses)


def test_blank_stamps_are_those_of_missing_frames(root: Path) -> None:
    wanted = load(root).stamps
    lines = stamps_file(root).read_text().splitlines()
    lines[2] = ""
    stamps_file(root).write_text("\n".join(lines))
    assert "timestamps.txt: 5 time stamps for 6 scans numbered 0 to 5; " in refusal(lambda: load(root))
    scan_file(root, 2).unlink()
    np.testing.assert_array_equal(load(root).stamps, np.delete(wanted, 2))


def test_counts_that_disagree(root: Path) -> None:
    oxts_file(root, 2).unlink()
    assert "oxts/data: 5 files for 6 scans numbered 0 to 5; " in refusal(lambda: load(root))
    lines = stamps_file(root).read_text().splitlines()
    stamps_file(root).write_text("\n".join(lines[:4]))
    assert "4 time stamps for 6 scans" in refusal(lambda: kitti_raw.stream(drive_in(root)))


def test_poses_of_a_drive_that_is_not_synchronised(root: Path) -> None:
    times = drive_in(root) / "oxts" / "timestamps.txt"
    times.write_text("".join(f"2011-09-26 13:02:{20 + 0.01 * n:012.9f}\n" for n in range(60)))
    for frame in range(60):
        oxts_file(root, frame).write_text(oxts_line(np.eye(4)))
    text = refusal(lambda: load(root))
    assert "oxts/timestamps.txt: the poses were measured up to 6.4 s from their scans; " in text


def test_numbers_that_differ_by_more_than_an_offset(root: Path) -> None:
    make_kitti_raw(root, "2011_09_27_drive_0001_sync", frames=8)
    drive = root / "2011_09_27" / "2011_09_27_drive_0001_sync"
    (drive / "oxts" / "data" / "0000000005.txt").unlink()
    (drive / "velodyne_points" / "data" / "0000000003.bin").unlink()
    text = refusal(lambda: kitti_raw.load(drive.name, root=root))
    assert "oxts/data: as many files as scans, but their numbers differ: there is none for scan 5; " in text


def test_a_pose_of_another_moment_is_found(root: Path) -> None:
    times = drive_in(root) / "oxts" / "timestamps.txt"
    lines = times.read_text().splitlines()
    lines[5] = "2011-09-26 13:02:27.000000000"
    times.write_text("\n".join(lines))
    assert "the poses were measured up to 0." in refusal(lambda: load(root))


# Truth that cannot be


def change_oxts(root: Path, change, frames=range(6)) -> None:
    for frame in frames:
        values = np.array(oxts_file(root, frame).read_text().split(), dtype=float)
        oxts_file(root, frame).write_text(" ".join(map(repr, change(values).tolist())))


def in_place(index, value):
    def change(values):
        values[index] = value(values[index]) if callable(value) else value
        return values

    return change


@pytest.mark.parametrize(
    ("change", "frames", "says"),
    [
        (
            in_place(0, lambda latitude: latitude + 0.001),
            [3],
            r"3\.txt:1: frame 3 is 11[012] m from the one bef",
        ),
        (in_place(0, 0.0), [2], r"2\.txt:1: frame 2 is \d+ m from the one before, 0\.10 s earlier; correct"),
        (in_place(5, 90.0), range(6), r"0\.txt:1: an angle is above 2 pi, but it begins with .*radians"),
        (
            in_place([0, 1], lambda two: two[::-1]),
            range(6),
            "the car moves [5-9][0-9] degrees off its yaw angle",
        ),
    ],
    ids=["jump", "latitude 0", "degrees", "swapped"],
)
def test_absurd_truth_is_refused(root: Path, change, frames, says: str) -> None:
    load(root)
    change_oxts(root, change, frames)
    with pytest.raises(InputError, match=says) as raised:
        load(root)
    assert "\n" not in str(raised.value)
    assert kitti_raw.stream(drive_in(root)).total == 6


def test_stamps_of_whole_seconds_are_refused(root: Path) -> None:
    lines = [line[:19] for line in stamps_file(root).read_text().splitlines()]
    assert lines[0] != lines[-1]
    stamps_file(root).write_text("\n".join(lines))
    text = refusal(lambda: load(root))
    assert (
        "velodyne_points/timestamps.txt:3: the stamps are whole seconds, several frames in one; take" in text
    )


# Bad input


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("calib_velo_to_cam.txt", "no calib_velo_to_cam.txt in it or in the folder above; unpack the date's"),
        ("calib_imu_to_velo.txt", "no calib_imu_to_velo.txt in it or in the folder above; unpack the date's"),
        (f"{NAME}/velodyne_points/timestamps.txt", "timestamps.txt: cannot be read: No such file"),
        (f"{NAME}/velodyne_points/data", "velodyne_points/data: no such folder; unpack the drive's Velodyne"),
        (f"{NAME}/oxts/data", "oxts/data: no such folder; the truth is needed, so unpack"),
    ],
)
def test_missing_pieces(root: Path, path: str, says: str) -> None:
    where = root / "2011_09_26" / path
    where.rename(where.with_name("away"))
    assert says in refusal(lambda: load(root))


def test_no_scans(root: Path) -> None:
    for frame in range(6):
        scan_file(root, frame).unlink()
    assert "no .bin and no .txt file in it; unpack" in refusal(lambda: load(root))


def test_the_folder_of_a_date_or_of_dates_lists_its_drives(root: Path) -> None:
    make_kitti_raw(root, "2011_09_26_drive_0009_sync", frames=2)
    text = refusal(lambda: open_stream(root / "2011_09_26"))
    assert "holds KITTI raw drives but is not one itself; give one of" in text
    assert text.endswith(f"{NAME}, 2011_09_26_drive_0009_sync")
    assert f"give one of 2011_09_26/{NAME}, 2011_09_26/2011" in refusal(lambda: open_stream(root))


def test_a_drive_that_is_not_there(root: Path) -> None:
    text = refusal(lambda: kitti_raw.load("00", root=root))
    assert "no drive 00 in it or in a date's folder; set data.train, data.val and data.test to" in text
    assert text.endswith(f"to some of 2011_09_26/{NAME}")
    assert "to some of 2011_09_26/" in refusal(lambda: kitti_raw.load("2011_09_26", root=root))
    assert "it is a drive itself: set data.root to the folder above" in refusal(
        lambda: kitti_raw.load(NAME, root=drive_in(root))
    )
    assert "no such folder; set data.root" in refusal(lambda: load(root / "nowhere"))
    assert len(kitti_raw.load(NAME, root=root / "2011_09_26")) == 6
    assert len(kitti_raw.load(f"2011_09_26/{NAME}", root=root)) == 6


@pytest.mark.parametrize(
    ("file", "line", "text", "says"),
    [
        (
            "velodyne_points/timestamps.txt",
            3,
            "yesterday",
            "timestamps.txt:3: found 'yesterday', but a time st",
        ),
        (
            "velodyne_points/timestamps.txt",
            3,
            "2011-09-31 13:02:25.9",
            "timestamps.txt:3: day is out of range",
        ),
        (
            "velodyne_points/timestamps.txt",
            3,
            "2011-09-26 13:02",
            "timestamps.txt:3: found '2011-09-26 13:02'",
        ),
        (
            "oxts/data/0000000002.txt",
            1,
            "49.0 8.4 x 0 0 0",
            "2.txt:1: could not convert string to float: 'x'",
        ),
        ("oxts/data/0000000002.txt", 1, "49.0 8.4 100 0 nan 0", "2.txt:1: found nan or inf, but it begins"),
        ("oxts/data/0000000002.txt", 1, "49.0 8.4", "2.txt:1: found 2 fields, but it begins with latitude"),
        ("oxts/data/0000000002.txt", 1, "490.0 8.4 1 0 0 0", "2.txt:1: not a place on earth, but it begins"),
        ("../calib_velo_to_cam.txt", 2, "R: 1 0 0", "velo_to_cam.txt:2: found 3 fields, but R has 9 finite"),
        ("../calib_velo_to_cam.txt", 2, "R: 1 0 0 0 1 0 0 0 5", "velo_to_cam.txt:2: R holds no rotation; "),
        ("../calib_imu_to_velo.txt", 3, "T 1 0 0", "imu_to_velo.txt: no line starts with 'T:'; "),
        (
            "../calib_cam_to_cam.txt",
            2,
            "R_rect_00: 1",
            "cam_to_cam.txt:2: found 1 fields, but R_rect_00 has 9",
        ),
    ],
)
def test_damaged_lines(root: Path, file: str, line: int, text: str, says: str) -> None:
    path = drive_in(root) / file
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines) + "\n")
    assert says in refusal(lambda: load(root))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1 2 x 0", "0000000001.txt:5: '1 2 x 0' is not a point, x y z reflectance; correct the line"),
        ("1 2", "0000000001.txt:5: '1 2' is not a point"),
    ],
)
def test_damaged_text_points(root: Path, line: str, says: str) -> None:
    for frame in range(6):
        points = np.fromfile(scan_file(root, frame), "<f4").reshape(-1, 4)
        scan_file(root, frame).unlink()
        np.savetxt(scan_file(root, frame).with_suffix(".txt"), points)
    recording = load(root)
    path = scan_file(root, 1).with_suffix(".txt")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:4], line, *lines[5:]]))
    assert says in refusal(lambda: recording.read_scan(1))
    path.write_text("\n".join([*lines[:4], "nan nan nan 0", *lines[5:]]))
    assert len(recording.read_scan(1).ranges) > 600


# As experiments use it


def test_configuration(root: Path, configure) -> None:
    drives = [f"data.train=[{NAME}]", f"data.test=[{NAME}]", "data.workers=1"]
    where = ["data=kitti_raw", f"data.root={root}"]
    for options, says in (
        (where, "data.test=None: must be a list of sequences"),
        (["data=kitti_raw", *drives[:2]], "data.root is missing"),
        ([*where, *drives, "data.ring=-1"], "data.ring=-1: must be null or a whole"),
    ):
        with pytest.raises(InputError, match=says):
            plain(configure(*options))
    settings = plain(configure(*where, *drives, "data.ring=1"))
    assert "ring 1 of" in open_recording(settings["data"]["reader"])(NAME).notes[-1]
    metrics = evaluate(configure("model=matcher", *where, *drives, "data.lengths=[2,4]", name="evaluate"))
    assert metrics["data"] == "kitti_raw"
    assert metrics["test"]["drift"] < 0.03
    assert any(root.rglob(METRICS))


@pytest.mark.skipif(not REAL.is_dir(), reason=f"no real KITTI recordings at {REAL}")
def test_a_real_drive_in_both_layouts(tmp_path: Path) -> None:
    wanted = kitti.load("90", root=REAL)
    make_kitti_raw(tmp_path, frames=40)
    imu = wanted.poses @ VELO_FROM_IMU
    (drive_in(tmp_path).parent / "calib_cam_to_cam.txt").unlink()
    words = [
        " ".join(map(repr, part.ravel().tolist())) for part in np.split(wanted.camera_from_laser[:3], [3], 1)
    ]
    velo_to_cam = drive_in(tmp_path).parent / "calib_velo_to_cam.txt"
    velo_to_cam.write_text(f"calib_time: 15-Mar-2012 11:37:16\nR: {words[0]}\nT: {words[1]}\n")
    for frame, pose in enumerate(imu):
        oxts_file(tmp_path, frame).write_text(oxts_line(pose))
        scan_file(tmp_path, frame).unlink()
        scan_file(tmp_path, frame).symlink_to(wanted.read_scan.paths[frame])
    recording = load(tmp_path)
    np.testing.assert_allclose(from_first(recording.poses), from_first(wanted.poses), atol=0.01)
    np.testing.assert_allclose(recording.camera_from_laser, wanted.camera_from_laser, atol=1e-12)
    np.testing.assert_array_equal(recording.read_scan(20).ranges, wanted.read_scan(20).ranges)
