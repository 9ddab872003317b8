import bz2
import gzip
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from conftest import SHARED
from data.make_carmen import MAX_READING, behind, make_carmen, wheel_odometry, write_log
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses, poses_to_planar
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings import carmen
from rcnn_odom.recordings.recording import Recording
from scans import beams

DATA = SHARED / "data"


@pytest.fixture
def real() -> Path:
    if not (DATA / "carmen").is_dir():
        pytest.skip(f"no real CARMEN logs at {DATA / 'carmen'}")
    return DATA / "carmen"


@pytest.fixture
def corrected() -> Path:
    if not (DATA / "carmen_corrected").is_dir():
        pytest.skip(f"no corrected CARMEN logs at {DATA / 'carmen_corrected'}")
    return DATA / "carmen_corrected"


def flaser(
    readings: str = "1 2 3 4", pose: str = "0 0 0", odom: str = "1 0 0", time: str = "5 host 0"
) -> str:
    return f"FLASER {len(readings.split())} {readings} {pose} {odom} {time}"


def load_lines(root: Path, *lines: str, **options: float) -> Recording:
    write_log(root / "log.log", list(lines))
    return carmen.load("log", root=root, **options)


def notes_of(sequence: Recording) -> str:
    return "; ".join(sequence.notes)


# What the reader gives


@pytest.mark.parametrize("compress", [None, "gz", "bz2"])
@pytest.mark.parametrize("fmt", ["FLASER", "ROBOTLASER1"])
def test_made_log(tmp_path: Path, fmt: str, compress: str | None) -> None:
    planar = make_carmen(tmp_path, "robot", frames=20, fmt=fmt, compress=compress)
    sequence = carmen.load("robot", root=tmp_path)
    assert len(sequence) == 20
    np.testing.assert_allclose(sequence.poses, planar_to_poses(planar), atol=1e-7)
    np.testing.assert_allclose(sequence.stamps, 1000 + 0.2 * np.arange(20), atol=1e-5)
    assert sequence.wheel_odometry is not None
    np.testing.assert_allclose(sequence.wheel_odometry, planar_to_poses(wheel_odometry(planar)), atol=1e-7)
    scan = sequence.read_scan(19)
    assert (scan.stamp, scan.has_all_beams) == (sequence.stamps[19], True)
    angles, _ = beams(sequence.read_scan(0))
    np.testing.assert_allclose(np.rad2deg(angles), np.arange(-90, 90), atol=1e-4)
    assert f"20 scans of 180 beams ({fmt})" in sequence.notes


def test_scans_agree_with_the_truth(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=6)
    sequence = carmen.load("robot", root=tmp_path)
    clouds = []
    for frame in (0, 5):
        angles, ranges = beams(sequence.read_scan(frame))
        points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), 0 * angles, 1 + 0 * angles])
        clouds.append((sequence.poses[frame] @ points[:, ranges < 80])[:2].T)
    nearest = np.linalg.norm(clouds[1][:, None] - clouds[0][None], axis=2).min(axis=1)
    assert np.median(nearest) < 0.08


@pytest.mark.parametrize(
    ("count", "degrees"),
    [
        (180, np.arange(-90, 90)),
        (181, np.arange(-90, 91)),
        (360, np.arange(-90, 90, 0.5)),
        (361, np.arange(-90, 90.5, 0.5)),
    ],
)
def test_beam_spacing(tmp_path: Path, count: int, degrees: np.ndarray) -> None:
    sequence = load_lines(tmp_path, flaser(" ".join(["1.5"] * count)))
    angles, ranges = beams(sequence.read_scan(0))
    np.testing.assert_allclose(np.rad2deg(angles), degrees, atol=1e-9)
    assert (ranges == 1.5).all()
    assert Sensor(1.0, 180.0, 40.0).encode(sequence.read_scan(0)).shape == (181,)


def test_field_of_view_is_an_option(tmp_path: Path) -> None:
    sequence = load_lines(tmp_path, flaser("1 2 3"), field_of_view_deg=240.0)
    np.testing.assert_allclose(np.rad2deg(sequence.read_scan(0).bearings), [-120, 0, 120])
    with pytest.raises(InputError, match="field_of_view_deg"):
        load_lines(tmp_path, flaser("1 2 3"), field_of_view_deg=400.0)


def test_robotlaser_says_its_angles_and_maximum_itself(tmp_path: Path) -> None:
    line = "ROBOTLASER1 0 -1.0 2.0 0.5 30.0 0.01 0 4 1 29.9 30 31 2 7 7 3 4 0 2.8 4 0 0 0 0 0 0 9.5 host 0"
    sequence = load_lines(tmp_path, line)
    angles, ranges = beams(sequence.read_scan(0))
    np.testing.assert_allclose(angles, [-1.0, -0.5, 0.0, 0.5])
    np.testing.assert_array_equal(ranges, [1, 29.9, np.inf, np.inf])
    assert sequence.stamps.tolist() == [9.5]
    assert "2 readings are no returns, 50.0% of all" in sequence.notes


def test_robotlaser_odometry_is_moved_to_the_laser(tmp_path: Path) -> None:
    planar = make_carmen(tmp_path, "robot", frames=30, fmt="ROBOTLASER1")
    wheels = carmen.load("robot", root=tmp_path).wheel_odometry
    robot = planar_to_poses(behind(wheel_odometry(planar)))
    ahead = np.eye(4)
    ahead[0, 3] = 0.2
    np.testing.assert_allclose(wheels, robot @ ahead, atol=1e-7)


def test_order_of_the_file_and_beam_counts(tmp_path: Path) -> None:
    sequence = load_lines(
        tmp_path,
        "# FLASER a comment",
        "PARAM a b",
        flaser("1 2 3 4", time="7 host 0"),
        "ODOM 0 0 0 0 0 0 1 host 1",
        flaser("5 6", time="6 host 0"),
        "RLASER 1 2 0 0 0 0 0 0 1 host 1",
        "",
        flaser("7 8 9 10", time="8 host 0"),
    )
    assert [sequence.read_scan(frame).ranges.tolist() for frame in range(3)] == [
        [1, 2, 3, 4],
        [5, 6],
        [7, 8, 9, 10],
    ]
    assert sequence.stamps.tolist() == [7, 6, 8]
    notes = notes_of(sequence)
    assert "3 scans of 4 beams (FLASER)" in notes
    assert "1 scans have another number of beams than 4" in notes
    assert "1 RLASER" in notes
    assert "1 timestamps go backwards" in notes


def test_notes_on_timestamps_and_truth(tmp_path: Path) -> None:
    notes = notes_of(load_lines(tmp_path, flaser(), flaser()))
    assert "all timestamps are equal" in notes
    assert "just the wheel odometry" not in notes
    notes = notes_of(load_lines(tmp_path, flaser(pose="1 2 3.0"), flaser(pose="1 2 3.0", odom="1 2 3.0")))
    assert "just the wheel odometry" not in notes
    turned = f"1 2 {3.0 - 2 * np.pi:.9f}"
    notes = notes_of(load_lines(tmp_path, flaser(pose="1 2 3.0", odom=turned)))
    assert "just the wheel odometry" in notes


def test_no_returns_are_counted_and_left_to_encode(tmp_path: Path) -> None:
    sequence = load_lines(tmp_path, flaser("1 -1 0 nan inf 39.9 40 81.9"), max_range=40.0)
    assert "6 readings are no returns (not positive, or 40 m and more), 75.0% of all" in sequence.notes
    angles, ranges = beams(sequence.read_scan(0))
    assert len(ranges) == 8
    assert np.count_nonzero(encode(angles, ranges, Sensor(1.0, 180.0, 40.0))) == 2
    assert (
        "4 readings are no returns, 50.0% of all"
        in load_lines(tmp_path, flaser("1 0 0 nan inf 2 3 81.9")).notes
    )


def test_made_log_has_no_returns(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=20)
    ranges = np.concatenate([carmen.load("robot", root=tmp_path).read_scan(i).ranges for i in range(20)])
    assert 0.002 < np.mean(ranges == MAX_READING) < 0.03


def test_read_scan_can_be_pickled(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=3)
    read_scan = carmen.load("robot", root=tmp_path).read_scan
    for one, two in zip(beams(read_scan(2)), beams(pickle.loads(pickle.dumps(read_scan))(2)), strict=True):
        np.testing.assert_array_equal(one, two)


def test_fingerprint(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=3)
    first = carmen.load("robot", root=tmp_path).fingerprint
    assert carmen.load("robot", root=tmp_path, max_range=40.0).fingerprint == first
    assert carmen.load("robot", root=tmp_path, field_of_view_deg=170.0).fingerprint != first
    os.utime(tmp_path / "robot.log", ns=(1, 1))
    assert carmen.load("robot", root=tmp_path).fingerprint != first


# Which file


@pytest.mark.parametrize("name", ["robot", "robot.log", "robot.log.gz"])
def test_names(tmp_path: Path, name: str) -> None:
    make_carmen(tmp_path, "robot", frames=2, compress="gz")
    assert carmen.load(name, root=tmp_path).name == name


def test_no_or_several_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such folder; set data\.root"):
        carmen.load("robot", root=tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"robot: no such file, nor with \.log or \.clf"):
        carmen.load("robot", root=tmp_path)
    make_carmen(tmp_path, "robot", frames=2)
    make_carmen(tmp_path, "robot", frames=2, compress="bz2")
    with pytest.raises(InputError, match=r"several files match \(robot\.log, robot\.log\.bz2\)"):
        carmen.load("robot", root=tmp_path)


# Bad input


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("FLASER", "ends before the number of readings"),
        ("FLASER four 1 2", "four"),
        ("FLASER 0 0 0 0 0 0 0 1 host 1", "announces 0 readings"),
        ("FLASER 5 1 2 3 4 0 0 0 0 0 0 1 host 1", "announces 5 readings, so 16 fields, but has 15"),
        ("FLASER 3 1 2 3 4 0 0 0 0 0 0 1 host 1", "announces 3 readings, so 14 fields, but has 15"),
        (flaser("1 2 x 4"), "'x'"),
        (flaser("1 2 \udcff3 4"), "could not convert"),
        (flaser(pose="0 nan 0"), "not a finite number"),
        (flaser(odom="0 0 inf"), "not a finite number"),
        (flaser(time="nan host 0"), "not a finite number"),
        ("ROBOTLASER1 0 -1 2 0.5 30 0.01 0 4 1 2 3", "announces 4 readings"),
        ("ROBOTLASER1 0 -1 2 0.5 30 0.01 0 2 1 2 1 3 0 0 0 0 0 0", "announces 2 readings"),
    ],
)
def test_broken_line(tmp_path: Path, line: str, match: str) -> None:
    good = flaser() if line.startswith("FLASER") else "PARAM x"
    (tmp_path / "log.log").write_bytes(f"{good}\nODOM\n{line}\n".encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=rf"log\.log:3: broken .*{match}") as raised:
        carmen.load("log", root=tmp_path)
    assert "\n" not in str(raised.value)


def test_undecodable_bytes_elsewhere_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "log.log").write_bytes(b"PARAM \xff\xfe\n" + flaser().encode() + b"\n")
    assert len(carmen.load("log", root=tmp_path)) == 1


def test_no_laser_lines(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"log\.log: no FLASER or ROBOTLASER1 line in it, only RAWLASER1"):
        load_lines(tmp_path, "ODOM 0 0 0", "RAWLASER1 0 1 2")
    (tmp_path / "log.log").write_bytes(b"")
    with pytest.raises(InputError, match="no FLASER or ROBOTLASER1 line"):
        carmen.load("log", root=tmp_path)


def test_both_kinds_of_line(tmp_path: Path) -> None:
    make_carmen(tmp_path, "one", frames=2)
    make_carmen(tmp_path, "two", frames=2, fmt="ROBOTLASER1")
    lines = [
        *(tmp_path / "one.log").read_text().splitlines(),
        *(tmp_path / "two.log").read_text().splitlines(),
    ]
    with pytest.raises(InputError, match=r"log\.log:10: ROBOTLASER1 after FLASER lines"):
        load_lines(tmp_path, *lines)


@pytest.mark.parametrize("compress", ["gz", "bz2"])
@pytest.mark.parametrize("harm", ["cut off", "corrupt", "not packed"])
def test_broken_packing(tmp_path: Path, compress: str, harm: str) -> None:
    make_carmen(tmp_path, "robot", frames=20, compress=compress)
    path = tmp_path / f"robot.log.{compress}"
    content = path.read_bytes()
    half = len(content) // 2
    harmed = {
        "cut off": content[:half],
        "corrupt": content[:half] + bytes(64) + content[half + 64 :],
        "not packed": {"gz": gzip, "bz2": bz2}[compress].decompress(content),
    }
    path.write_bytes(harmed[harm])
    with pytest.raises(InputError, match=rf"robot\.log\.{compress}[:]"):
        carmen.load("robot", root=tmp_path)


# References


HEADER = "# raw_scan_index(in x),ipc_time,ref_x,ref_y,ref_theta,odom_x"


def load_with_reference(root: Path, *rows: str) -> Recording:
    make_carmen(root, "robot", frames=3)
    (root / "robot_dense_ref.csv").write_text("\n".join(rows) + "\n")
    return carmen.load("robot.log", root=root, reference=root)


def test_reference(tmp_path: Path) -> None:
    sequence = load_with_reference(tmp_path, HEADER, "0,1,nan,nan,nan,0", "1,1,2,3,0.5,0", "2,1,4,nan,1,0")
    np.testing.assert_allclose(poses_to_planar(sequence.poses[1:2]), [[2, 3, 0.5]])
    assert np.isnan(sequence.poses[[0, 2]]).all()
    assert sequence.notes[-2:] == ("truth: robot_dense_ref.csv", "2 scans without truth")
    by_file = carmen.load("robot", root=tmp_path, reference=tmp_path / "robot_dense_ref.csv")
    np.testing.assert_array_equal(by_file.poses, sequence.poses)
    assert by_file.fingerprint == carmen.load("robot", root=tmp_path).fingerprint


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        ((), r"robot_dense_ref\.csv:1: the header has no column raw_scan_index"),
        (("a,ref_x,ref_y", "0,0,0"), r"csv:1: the header has no column raw_scan_index, ref_theta"),
        ((HEADER, "0,1,2,3,0,0", "1,1,2,3,0,0"), "2 rows, but the log has 3 scans"),
        ((HEADER, "0,1,2,3,0,0", "2,1,2,3,0,0", "1,1,2,3,0,0"), r"csv:3: expected raw_scan_index 1"),
        ((HEADER, "0,1,2,3,0,0", "1,1,2"), r"csv:3: not a row of numbers"),
        ((HEADER, "0,1,2,3,x,0"), r"csv:2: not a row of numbers"),
        ((HEADER, "0,1,2,3,inf,0"), r"csv:2: .* finite or nan"),
    ],
)
def test_bad_reference(tmp_path: Path, rows: tuple[str, ...], match: str) -> None:
    with pytest.raises(InputError, match=match):
        load_with_reference(tmp_path, *rows)


def test_missing_reference(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=3)
    with pytest.raises(InputError, match=r"robot_dense_ref\.csv: no such file; set data\.reference"):
        carmen.load("robot", root=tmp_path, reference=tmp_path)


# Real recordings


def path_length(poses: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum())


def test_real_intel(real: Path) -> None:
    sequence = carmen.load("intel", root=real, max_range=40.0)
    assert len(sequence) == 13631
    assert path_length(sequence.poses) == pytest.approx(508, abs=1)
    assert path_length(sequence.wheel_odometry) == pytest.approx(508, abs=1)
    notes = notes_of(sequence)
    assert "631 timestamps go backwards" in notes
    assert "just the wheel odometry" in notes
    assert Sensor(1.0, 180.0, 40.0).encode(sequence.read_scan(0)).shape == (181,)


@pytest.mark.parametrize(
    ("name", "scans", "beams"),
    [("aces", 7374, 180), ("mit-csail", 1988, 361), ("mit-killian", 17480, 180)],
)
def test_real_logs_with_reference(real: Path, name: str, scans: int, beams: int) -> None:
    sequence = carmen.load(name, root=real, reference=real / "reference", max_range=40.0)
    assert len(sequence) == scans
    assert f"{scans} scans of {beams} beams (FLASER)" in sequence.notes
    unknown = np.isnan(sequence.poses).all(axis=(1, 2))
    assert np.isfinite(sequence.poses[~unknown]).all()
    assert f"{unknown.sum()} scans without truth" in sequence.notes
    if name == "aces":
        known = np.flatnonzero(~unknown)
        assert (known[0], scans - 1 - known[-1], len(known)) == (136, 188, scans - 136 - 188)
    vector = Sensor(1.0, 180.0, 40.0).encode(sequence.read_scan(200))
    assert vector.shape == (181,)
    assert np.count_nonzero(vector) > 100


@pytest.mark.parametrize(
    ("name", "scans"),
    [
        ("acapulco", 861),
        ("edmonton", 340),
        ("fhw", 488),
        ("freiburg-101", 292),
        ("orebro", 237),
    ],
)
def test_real_corrected_logs(corrected: Path, name: str, scans: int) -> None:
    sequence = carmen.load(f"{name}-corrected", root=corrected)
    assert len(sequence) == scans
    assert np.isfinite(sequence.poses).all()
    assert ("all timestamps are equal" in notes_of(sequence)) == (name == "orebro")
