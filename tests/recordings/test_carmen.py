import codecs
import gzip
import math
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from conftest import SHARED
from data.make_carmen import MAX_READING, PACKINGS, behind, make_carmen, wheel_odometry, write_log
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import FORWARD_CAMERA, change_frame, compose, planar_to_poses, poses_to_planar
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.matcher import MatcherTracker
from rcnn_odom.models.tracking import Kind, Tracking
from rcnn_odom.recordings import carmen
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.recordings.carmen_log import params
from rcnn_odom.recordings.parts import cut
from rcnn_odom.recordings.recording import Drive, Recording
from rcnn_odom.recordings.scan import Scan
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


def load_lines(root: Path, *lines: str, **options: float | None) -> Recording:
    write_log(root / "log.log", list(lines))
    return carmen.load("log", root=root, **options)


def notes_of(sequence: Recording) -> str:
    return "; ".join(sequence.notes)


# What the reader gives


@pytest.mark.parametrize("compress", [None, *PACKINGS])
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
    (scan,) = carmen.stream(tmp_path / "log.log", field_of_view_deg=240.0).scans
    np.testing.assert_allclose(np.rad2deg(scan.bearings), [-120, 0, 120])


@pytest.mark.parametrize("degrees", [math.nan, math.inf, 0.0, -180.0, 360.5])
def test_an_option_that_is_no_field_of_view(tmp_path: Path, degrees: float) -> None:
    with pytest.raises(InputError, match=r"field of view is .* degrees; set it above 0 and at most 360"):
        load_lines(tmp_path, flaser("1 2 3"), field_of_view_deg=degrees)
    with pytest.raises(InputError, match=r"field of view is .* degrees; set it above 0 and at most 360"):
        carmen.stream(tmp_path / "log.log", field_of_view_deg=degrees)


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


# Angles of ROBOTLASER1 lines


def robotlaser(start: str, field_of_view: str, resolution: str, count: int, maximum: str = "81.9") -> str:
    """A line whose readings are 1, 2, 3 and so on centimetres."""
    readings = " ".join(f"{(number + 1) / 100:.2f}" for number in range(count))
    head = f"ROBOTLASER1 0 {start} {field_of_view} {resolution} {maximum} 0.01 0"
    return f"{head} {count} {readings} 0 1 2 0.5 1 2 0.5 0 0 0 0 0 7 host 0"


@pytest.mark.parametrize(
    ("start", "field_of_view", "resolution", "count", "degrees"),
    [
        ("-1.570796", "3.141593", "0.017453", 180, 1.0),
        ("-1.570796", "3.141593", "0.017453", 181, 1.0),
        ("-1.570796", "3.124139", "0.017453", 180, 1.0),
        ("-1.570796", "3.141593", "0.008727", 360, 0.5),
        ("-1.570796", "3.141593", "0.008727", 361, 0.5),
        ("-1.570796", "3.141593", "0.0087", 361, 0.5),
        ("-2.356194", "4.712389", "0.008727", 541, 0.5),
        ("-2.356194", "4.712389", "0.004363", 1081, 0.25),
        ("-3.141593", "6.283185", "0.017453", 360, 1.0),
        ("-3.141593", "6.283185", "0.017453", 361, 1.0),
        ("-1.570796", "3.141593", "0", 181, 1.0),
        ("-1.570796", "3.141593", "0", 180, 1.0),
        ("-1.570796", "0", "0.017453", 181, 1.0),
        ("1.570796", "3.141593", "-0.017453", 181, -1.0),
        ("1.570796", "-3.141593", "-0.017453", 180, -1.0),
        ("1.570796", "-3.141593", "0", 181, -1.0),
        # The sign of the resolution stands before that of the field of view.
        ("-1.570796", "-3.141593", "0.017453", 181, 1.0),
        ("-1.570796", "-3.141593", "0.017453", 180, 1.0),
        ("1.570796", "3.141593", "-0.017453", 180, -1.0),
        ("1.570796", "0", "-0.017453", 181, -1.0),
    ],
)
def test_angles_that_fit(
    tmp_path: Path, start: str, field_of_view: str, resolution: str, count: int, degrees: float
) -> None:
    sequence = load_lines(tmp_path, robotlaser(start, field_of_view, resolution, count))
    bearings = np.rad2deg(sequence.read_scan(0).bearings)
    right = np.rad2deg(float(start)) + degrees * np.arange(count)
    np.testing.assert_allclose(bearings, right, atol=0.03)
    (scan,) = carmen.stream(tmp_path / "log.log").scans
    np.testing.assert_array_equal(np.rad2deg(scan.bearings), bearings)
    np.testing.assert_allclose(scan.ranges, np.arange(1, count + 1) / 100)


IN_DEGREES = "are its angles in degrees, not radians"


@pytest.mark.parametrize(
    ("start", "field_of_view", "resolution", "count", "match"),
    [
        ("-90", "180", "1", 180, rf"view of 180 and a resolution of 1 do not fit 180 .*{IN_DEGREES}"),
        ("0", "180", "0", 181, rf"field of view is more than 2 pi; {IN_DEGREES}"),
        ("-135", "4.712389", "0.008727", 541, rf"start angle of -135 .*{IN_DEGREES}"),
        ("0", "0", "1", 181, rf"180 times the resolution is 180, .*{IN_DEGREES}"),
        ("-1.570796", "3.141593", "1", 180, "3.14159 .*resolution of 1 .*resolution in degrees, not radians"),
        (
            "-1.570796",
            "3.141593",
            "180",
            180,
            "resolution of 180 .*above the field of view; is it the number",
        ),
        ("-1.570796", "3.141593", "0.5", 361, "3.14159 .* 0.5 do .*resolution in degrees, not radians"),
        ("-1.570796", "3.141593", "-180", 180, "resolution of -180 .*above the field of view"),
        ("-1.570796", "3.141593", "0.008727", 180, "0.008727 do not fit 180 .*179 times .* 1.562"),
        ("-1.570796", "3.141593", "0.017453", 361, "0.017453 do not fit 361 .*360 times .* 6.283"),
        ("-1.570796", "3.141593", "0.017453", 183, "do not fit 183 .*182 times"),
        ("-1.570796", "3.141593", "0.017453", 178, "do not fit 178 .*177 times"),
        ("-1.570796", "0", "0", 180, "both are 0"),
        ("-1.570796", "nan", "0.017453", 180, "not a finite number"),
    ],
)
def test_angles_that_do_not_fit(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    start: str,
    field_of_view: str,
    resolution: str,
    count: int,
    match: str,
) -> None:
    wrong = robotlaser(start, field_of_view, resolution, count)
    good = robotlaser("-1.570796", "3.141593", "0", 5)
    with pytest.raises(InputError, match=rf"log\.log:2: broken ROBOTLASER1 line \(.*{match}.*\); correct"):
        load_lines(tmp_path, good, wrong, good)
    stream = carmen.stream(tmp_path / "log.log")
    assert len(list(stream.scans)) == 2
    assert stream.skipped == {"broken lines": 1}
    # A log whose every line is wrong is told once.
    write_log(tmp_path / "log.log", ["PARAM a b"] + [wrong] * 120)
    caplog.clear()
    with pytest.raises(
        InputError,
        match=rf"log\.log: none of its 120 ROBOTLASER1 lines .* first, line 2: .*{match}.*; correct",
    ):
        list(carmen.stream(tmp_path / "log.log").scans)
    assert not caplog.messages


def test_a_clockwise_laser_is_read_clockwise(tmp_path: Path) -> None:
    make_carmen(tmp_path, "robot", frames=3, beams=181, fmt="ROBOTLASER1")
    lines = (tmp_path / "robot.log").read_text().splitlines()
    for number, line in enumerate(lines):
        if line.startswith("ROBOTLASER1"):
            lines[number] = _from_the_other_end(line)
    write_log(tmp_path / "turned.log", lines)
    counter, clockwise = carmen.load("robot", root=tmp_path), carmen.load("turned", root=tmp_path)
    for frame in range(3):
        one, other = counter.read_scan(frame), clockwise.read_scan(frame)
        assert other.bearings[0] > other.bearings[-1]
        np.testing.assert_array_equal(other.ranges[::-1], one.ranges)
        np.testing.assert_allclose(other.bearings[::-1], one.bearings, atol=1e-6)


def _from_the_other_end(line: str) -> str:
    """A ROBOTLASER1 line of the same scan, its readings from the other end of the laser."""
    words = line.split()
    count, start, resolution = int(words[8]), float(words[2]), float(words[4])
    words[2], words[4] = f"{start + (count - 1) * resolution:.9f}", f"{-resolution:.9f}"
    words[9 : 9 + count] = words[9 : 9 + count][::-1]
    return " ".join(words)


@pytest.mark.parametrize("maximum", ["0", "-1", "nan", "inf"])
def test_an_absurd_maximum_is_unknown(tmp_path: Path, maximum: str) -> None:
    sequence = load_lines(tmp_path, robotlaser("-1.570796", "3.141593", "0", 9, maximum))
    np.testing.assert_allclose(sequence.read_scan(0).ranges, np.arange(1, 10) / 100)


def with_maximum(root: Path, maximum: str, unit: float = 1.0) -> Path:
    """A log of ROBOTLASER1 lines that say this maximum; their readings are in so many metres."""
    make_carmen(root, "robot", frames=30, fmt="ROBOTLASER1")
    lines = (root / "robot.log").read_text().splitlines()
    for number, line in enumerate(lines):
        words = line.split()
        if words[0] == "ROBOTLASER1":
            words[5] = maximum
            words[9:189] = [f"{float(word) / unit:.2f}" for word in words[9:189]]
            lines[number] = " ".join(words)
    return write_log(root / "said.log", lines)


@pytest.mark.parametrize("maximum", ["4", "0.5"])
def test_readings_stand_before_the_maximum_of_robotlaser_lines(tmp_path: Path, maximum: str) -> None:
    path = with_maximum(tmp_path, maximum)
    right, said = carmen.load("robot", root=tmp_path), carmen.load("said", root=tmp_path)
    for frame, streamed in enumerate(carmen.stream(path).scans):
        ranges = said.read_scan(frame).ranges
        # All but the constant of no return, which lies beyond what a sensor sees.
        np.testing.assert_array_equal(
            np.where(ranges == MAX_READING, np.inf, ranges), right.read_scan(frame).ranges
        )
        np.testing.assert_array_equal(streamed.ranges, ranges)
    assert "the maximum range of 30 lines is not used: most of their readings lie beyond it" in said.notes
    assert "is not used" not in notes_of(right)


def test_centimetres_are_told_whatever_the_maximum(tmp_path: Path) -> None:
    for scan in carmen.stream(with_maximum(tmp_path, "81.91", unit=0.01)).scans:
        assert re.search(
            r"half of its readings are .*cannot be metres", BeamCheck(Sensor(1.0, 180.0, 40.0))(scan)
        )
    assert "the maximum range of 30 lines is not used" in notes_of(carmen.load("said", root=tmp_path))


# PARAM lines about the laser of FLASER lines


def first_and_spacing(scan: Scan) -> tuple[float, float]:
    """Degrees of the first beam and between two beams."""
    degrees = np.rad2deg(scan.bearings)
    return degrees[0], np.diff(degrees).mean()


@pytest.mark.parametrize(
    ("params", "count", "first", "spacing"),
    [
        ([], 541, -90.0, 1 / 3),
        (["laser_front_laser_fov 4.712389"], 541, -135.0, 0.5),
        (["laser_front_laser_fov 4.712389 0", "laser_front_laser_resolution 0.5 0"], 541, -135.0, 0.5),
        (["laser_frontlaser_fov 4.712389"], 540, -135.0, 0.5),
        (["laser_frontlaser_fov 4.712389", "laser_front_laser_fov 4.7124"], 541, -135.0, 0.5),
        (["laser_front_laser_resolution 0.5"], 541, -135.0, 0.5),
        (["laser_frontlaser_resolution 0.25 0.0"], 1081, -135.0, 0.25),
        (["laser_front_laser_resolution 0.5"], 361, -90.0, 0.5),
        (["laser_front_laser_resolution 1"], 180, -90.0, 1.0),
        (["laser_front_laser_resolution 1"], 360, -180.0, 1.0),
        (["laser_front_laser_resolution 1"], 361, -180.0, 1.0),
        # A field of view of 239.77 degrees is closed by an even number of beams here.
        (["laser_front_laser_fov 4.178319", "laser_front_laser_resolution 0.352"], 682, -119.7, 0.35154),
        (["laser_front_laser_resolution 50"], 361, -90.0, 0.5),
        (["laser_front_laser_fov 0", "laser_front_laser_resolution -1"], 361, -90.0, 0.5),
        (["laser_front_laser_fov auto", "laser_front_laser_fov"], 361, -90.0, 0.5),
        (["laser_rear_laser_fov 4.712389", "laser_rear_laser_resolution 0.25"], 361, -90.0, 0.5),
        (["navigator_laser_fov 4.712389", "robot_frontlaser_fov_offset 3"], 361, -90.0, 0.5),
    ],
)
@pytest.mark.parametrize("after", [False, True])
def test_params_say_the_field_of_view(
    tmp_path: Path, params: list[str], count: int, first: float, spacing: float, after: bool
) -> None:
    lines = [f"PARAM {param} nohost 0" for param in params]
    lines.insert(0 if after else len(lines), flaser(" ".join(["1.5"] * count)))
    sequence = load_lines(tmp_path, "# PARAM laser_front_laser_fov 1", *lines)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((first, spacing), rel=1e-3)
    stream = carmen.stream(tmp_path / "log.log")
    (scan,) = stream.scans
    np.testing.assert_array_equal(scan.bearings, sequence.read_scan(0).bearings)
    assert set(stream.notes) <= set(sequence.notes)


def test_notes_say_where_the_field_of_view_is_from(tmp_path: Path) -> None:
    line = flaser(" ".join(["1.5"] * 541))
    assert "field of view" not in notes_of(load_lines(tmp_path, line))
    said = load_lines(tmp_path, f"{FOV} 4.712389 nohost 0", line)
    assert "field of view: 270 degrees by the log's PARAM laser_front_laser_fov 4.712389" in said.notes
    said = load_lines(tmp_path, f"{RESOLUTION} 0.5 nohost 0", line)
    assert "field of view: 270 degrees by the log's PARAM laser_front_laser_resolution 0.5" in said.notes
    assert "field of view: 240 degrees, as given" in load_lines(tmp_path, line, field_of_view_deg=240.0).notes
    said = load_lines(tmp_path, f"{RESOLUTION} 50 nohost 0", line)
    assert "does not fit 541 readings; field of view: 180 degrees, the default" in notes_of(said)


FOV, RESOLUTION = "PARAM laser_front_laser_fov", "PARAM laser_front_laser_resolution"


@pytest.mark.parametrize(
    ("params", "match"),
    [
        ([f"{FOV} 4.712389", f"{RESOLUTION} 0.25"], r"4\.712389 \(270 degrees\) and .*0\.25 .*not fit 541"),
        ([f"{FOV} 3.141593", f"{RESOLUTION} 0.5"], r"180 degrees\) and .*cover 270 degrees"),
        ([f"{FOV} 4.712389", f"{RESOLUTION} 0.008727"], "do not fit 541 readings"),
        ([f"{FOV} 270"], "270 is more than 2 pi: is it in degrees, not radians"),
        ([f"{FOV} 4.712389", f"{FOV} 3.141593"], r"says .*fov 3\.141593 and .*fov 4\.712389"),
    ],
)
def test_params_that_contradict_each_other(tmp_path: Path, params: list[str], match: str) -> None:
    line = flaser(" ".join(["1.5"] * 541))
    with pytest.raises(InputError, match=match) as raised:
        load_lines(tmp_path, *params, line)
    for part in ("; set", "data.field_of_view_deg=", "--field-of-view-deg"):
        assert part in str(raised.value)
    with pytest.raises(InputError, match=match):
        carmen.stream(tmp_path / "log.log")
    # An option settles it.
    sequence = load_lines(tmp_path, *params, line, field_of_view_deg=270.0)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-135, 0.5))


@pytest.mark.parametrize(
    ("params", "count"),
    [
        ([f"{RESOLUTION} 0.0174533"], 180),
        ([f"{RESOLUTION} 0.017"], 181),
        ([f"{RESOLUTION} 0.004363"], 1081),
        ([f"{RESOLUTION} 0.0174533"], 360),
        ([f"{FOV} 3.141593", f"{RESOLUTION} 0.0174533"], 180),
        ([f"{FOV} 4.712389", f"{RESOLUTION} 0.00873"], 541),
    ],
)
def test_a_resolution_in_radians_is_told(tmp_path: Path, params: list[str], count: int) -> None:
    line = flaser(" ".join(["1.5"] * count))
    with pytest.raises(InputError, match="is it in radians, not degrees") as raised:
        load_lines(tmp_path, *params, line)
    for part in (f"{params[-1]} (degrees)", "; set", "data.field_of_view_deg=", "--field-of-view-deg"):
        assert part in str(raised.value)
    with pytest.raises(InputError, match="is it in radians, not degrees"):
        carmen.stream(tmp_path / "log.log")
    sequence = load_lines(tmp_path, *params, line, field_of_view_deg=180.0)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-90, 180 / (count - count % 2)))


@pytest.mark.parametrize(
    ("resolution", "count", "covered"), [("1", 4, 4), ("0.1", 91, 9), ("0.0625", 641, 40)]
)
def test_narrow_and_fine_lasers_are_in_degrees(
    tmp_path: Path, resolution: str, count: int, covered: int
) -> None:
    sequence = load_lines(tmp_path, f"{RESOLUTION} {resolution}", flaser(" ".join(["1.5"] * count)))
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-covered / 2, float(resolution)))


@pytest.mark.parametrize(
    ("param", "fault"),
    [
        ("laser_front_laser_fov 3,1416", "laser_front_laser_fov 3,1416 is not a number"),
        ("laser_front_laser_fov = 4.712389", "laser_front_laser_fov = is not a number"),
        ("laser_frontlaser_resolution nan", "laser_frontlaser_resolution nan is not a number"),
        ("laser_front_laser_fov -4.712389", "laser_front_laser_fov -4.712389 is not above 0"),
        ("robot_front_laser_max none", "robot_front_laser_max none is not a number"),
        ("robot_front_laser_max " + "9" * 5000, f"robot_front_laser_max {'9' * 40} is not a number"),
        ("laser_front_laser_fov 0", ""),
        ("laser_rear_laser_fov 3,1416", ""),
    ],
)
def test_a_param_that_is_no_number_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, param: str, fault: str
) -> None:
    lines = [f"PARAM {param} nohost 0"] * 3 + [flaser(" ".join(["1.5"] * 361))]
    sequence = load_lines(tmp_path, *lines)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-90, 0.5))
    told = [f"the log's PARAM {fault}, so it is not used"] if fault else []
    assert [note for note in sequence.notes if "PARAM" in note] == told
    assert len(list(carmen.stream(tmp_path / "log.log").scans)) == 1
    assert caplog.messages == [f"{tmp_path / 'log.log'}: {note}" for note in told]


HALF_TURN, ONE_DEGREE = f"{FOV} 3.141593 nohost 0", f"{RESOLUTION} 1.0 nohost 0"


@pytest.mark.parametrize("params", [[HALF_TURN, ONE_DEGREE], [ONE_DEGREE]])
def test_another_number_of_beams_than_params_allow(tmp_path: Path, params: list[str]) -> None:
    full, half = flaser(" ".join(["1.5"] * 180)), flaser(" ".join(["1.5"] * 90))
    lines = [*params, *[full] * 40, *[half] * 20]
    match = (
        rf"log\.log:{len(params) + 41}: broken FLASER line \(90 readings, 1 degrees apart by the log's PARAM "
        r"lines, do not cover 180 degrees; if they do, set data\.field_of_view_deg"
    )
    with pytest.raises(InputError, match=match):
        load_lines(tmp_path, *lines)
    stream = carmen.stream(tmp_path / "log.log")
    assert [len(scan.ranges) for scan in stream.scans] == [180] * 40
    assert stream.skipped == {"broken lines": 20}
    # The user knows better.
    sequence = load_lines(tmp_path, *lines, field_of_view_deg=180.0)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-90, 1))
    assert first_and_spacing(sequence.read_scan(59)) == pytest.approx((-90, 2))


def test_other_numbers_of_beams_that_params_do_not_deny(tmp_path: Path) -> None:
    def spacings(*params: str, counts: tuple[int, ...]) -> list[float]:
        lines = [flaser(" ".join(["1.5"] * count)) for count in counts]
        sequence = load_lines(tmp_path, *params, *[lines[0]] * 3, *lines[1:])
        notes = notes_of(sequence)
        assert f"{len(counts) - 1} scans have another number of beams than {counts[0]}" in notes
        scans = [sequence.read_scan(frame) for frame in range(2, len(sequence))]
        return [first_and_spacing(scan)[1] for scan in scans]

    assert spacings(counts=(180, 361, 90)) == pytest.approx([1, 0.5, 2])
    assert spacings(HALF_TURN, counts=(180, 361, 90)) == pytest.approx([1, 0.5, 2])
    assert spacings(HALF_TURN, ONE_DEGREE, counts=(180, 181)) == pytest.approx([1, 1])
    # Two digits, of 0.352: 239.4 degrees are 682 or 683 times as much.
    hokuyo = f"{FOV} 4.178319", f"{RESOLUTION} 0.35"
    assert spacings(*hokuyo, counts=(682, 683)) == pytest.approx([239.4 / 682, 239.4 / 683], rel=1e-4)


@pytest.mark.parametrize("params", [[f"{FOV} 4.712389"], [f"{RESOLUTION} 0.5"]])
def test_an_option_stands_before_params_and_a_contradiction_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, params: list[str]
) -> None:
    lines = [*params, *[flaser(" ".join(["1.5"] * 541))] * 5]
    sequence = load_lines(tmp_path, *lines, field_of_view_deg=180.0)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-90, 1 / 3))
    assert "says 270 degrees, but 180 were given" in notes_of(sequence)
    assert len(list(carmen.stream(tmp_path / "log.log", field_of_view_deg=180.0).scans)) == 5
    [told] = caplog.messages
    assert "says 270 degrees, but 180 were given" in told
    # One beam more or less is none.
    assert "were given" not in notes_of(load_lines(tmp_path, *lines, field_of_view_deg=270.4))


def test_params_leave_robotlaser_lines_alone(tmp_path: Path) -> None:
    line = robotlaser("-1.570796", "3.141593", "0.017453", 181)
    sequence = load_lines(tmp_path, f"{FOV} 270", "PARAM robot_front_laser_max 0.5 nohost 0", line)
    assert first_and_spacing(sequence.read_scan(0)) == pytest.approx((-90, 1), rel=1e-3)
    assert np.isfinite(sequence.read_scan(0).ranges).all()


@pytest.mark.parametrize("name", ["robot_front_laser_max", "laser_front_laser_max"])
def test_a_params_maximum_is_no_return(tmp_path: Path, name: str) -> None:
    lines = [flaser("1 2 79.9 80 81.83 81.91 81.91 81.91"), flaser(" ".join(["1.5"] * 60))]
    sequence = load_lines(tmp_path, f"PARAM {name} 80 nohost 0", *lines)
    right = [1, 2, 79.9, *[np.inf] * 5]
    np.testing.assert_array_equal(sequence.read_scan(0).ranges, right)
    assert f"5 readings at the log's PARAM {name} 80 m or beyond are no returns" in sequence.notes
    assert "5 readings are no returns, 7.4% of all" in sequence.notes
    np.testing.assert_array_equal(next(carmen.stream(tmp_path / "log.log").scans).ranges, right)


def test_readings_stand_before_a_params_maximum(tmp_path: Path) -> None:
    line = flaser("1 2 9 11 12 13 51.15 51.15 51.15 51.15")
    sequence = load_lines(tmp_path, "PARAM robot_front_laser_max 10 nohost 0", line)
    assert np.isfinite(sequence.read_scan(0).ranges).all()
    assert "robot_front_laser_max 10 is not used: 30% of the readings lie beyond it" in notes_of(sequence)
    for value in ("0", "-1", "nan", "none"):
        sequence = load_lines(tmp_path, f"PARAM robot_front_laser_max {value} nohost 0", line)
        assert np.isfinite(sequence.read_scan(0).ranges).all()


def test_a_long_log_beyond_its_maximum_needs_no_more_memory(tmp_path: Path) -> None:
    """Readings that all differ are counted in a few hundred kinds."""
    rng = np.random.default_rng(0)
    beyond = rng.uniform(10, 80, (200, 180))
    path = write_log(tmp_path / "log.log", [flaser(" ".join(map(repr, row.tolist()))) for row in beyond])
    positive, kinds = params._count_beyond(path, 10.0)
    assert (positive, kinds.total()) == (beyond.size, beyond.size)
    assert len(kinds) <= np.log(80 / 10) / params.ONE_READING + 1


# Which file


@pytest.mark.parametrize("compress", PACKINGS)
@pytest.mark.parametrize("name", ["robot", "robot.log", "robot.log.{}"])
def test_names(tmp_path: Path, name: str, compress: str) -> None:
    make_carmen(tmp_path, "robot", frames=2, compress=compress)
    name = name.format(compress)
    assert carmen.load(name, root=tmp_path).name == name


@pytest.mark.parametrize("name", ["robot", "robot.log", "robot.log.gz", "robot.txt"])
@pytest.mark.parametrize("compress", [None, *PACKINGS])
def test_the_first_bytes_tell_the_packing(tmp_path: Path, name: str, compress: str | None) -> None:
    made = make_carmen(tmp_path / "made", "made", frames=3, compress=compress)
    (tmp_path / name).write_bytes(next((tmp_path / "made").iterdir()).read_bytes())
    sequence = carmen.load(name, root=tmp_path)
    np.testing.assert_allclose(sequence.poses, planar_to_poses(made), atol=1e-7)
    assert len(list(carmen.stream(tmp_path / name).scans)) == 3


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


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is empty; give"),
        (b"\n \n", "is empty; give"),
        (codecs.BOM_UTF8, "is empty; give"),
        (gzip.compress(b"", mtime=0), "is empty; give"),
        (b"\x00\x01\x02\xff" * 3000, "holds binary data, not text"),
        (bytes(100), "holds binary data, not text"),
        (flaser().encode("utf-16"), "is text in UTF-16; save it as UTF-8"),
        (flaser().encode("utf-16-le"), "is text in UTF-16; save it as UTF-8"),
        (flaser().encode("utf-16-be"), "is text in UTF-16; save it as UTF-8"),
        (flaser().encode("utf-32"), "is text in UTF-32; save it as UTF-8"),
        (gzip.compress(flaser().encode("utf-16"), mtime=0), "is text in UTF-16; save it as UTF-8"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n", "pointer of Git LFS"),
        (b"PK\x03\x04" + bytes(40), "is a zip archive; unpack it"),
    ],
)
def test_files_that_are_no_log(tmp_path: Path, content: bytes, match: str) -> None:
    (tmp_path / "log.log").write_bytes(content)
    assert carmen.recognises(tmp_path / "log.log")
    for read in (lambda: carmen.load("log", root=tmp_path), lambda: carmen.stream(tmp_path / "log.log")):
        with pytest.raises(InputError, match=match):
            read()


@pytest.mark.parametrize("first", ["", "PARAM a b\n"])
def test_a_byte_order_mark_is_skipped(tmp_path: Path, first: str) -> None:
    lines = [f"{first}{flaser('1 2 3')}", flaser("4 5 6")]
    # The second mark is what joining two files leaves.
    text = "".join(f"\ufeff{line}\n" for line in lines)
    (tmp_path / "log.log").write_text(text, encoding="utf-8")
    ranges = [[1, 2, 3], [4, 5, 6]]
    sequence = carmen.load("log", root=tmp_path)
    assert [sequence.read_scan(frame).ranges.tolist() for frame in range(len(sequence))] == ranges
    stream = carmen.stream(tmp_path / "log.log")
    assert [scan.ranges.tolist() for scan in stream.scans] == ranges
    assert not stream.skipped


def test_undecodable_bytes_elsewhere_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "log.log").write_bytes(b"PARAM \xff\xfe\n" + flaser().encode() + b"\n")
    assert len(carmen.load("log", root=tmp_path)) == 1


def test_no_laser_lines(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"log\.log: no FLASER or ROBOTLASER1 line in it, only RAWLASER1"):
        load_lines(tmp_path, "ODOM 0 0 0", "RAWLASER1 0 1 2")


def test_both_kinds_of_line(tmp_path: Path) -> None:
    make_carmen(tmp_path, "one", frames=2)
    make_carmen(tmp_path, "two", frames=2, fmt="ROBOTLASER1")
    lines = [
        *(tmp_path / "one.log").read_text().splitlines(),
        *(tmp_path / "two.log").read_text().splitlines(),
    ]
    with pytest.raises(InputError, match=r"log\.log:10: ROBOTLASER1 after FLASER lines"):
        load_lines(tmp_path, *lines)


def test_a_log_of_one_scan_is_refused_with_what_to_do(tmp_path: Path) -> None:
    log = load_lines(tmp_path, flaser())
    drive = Drive("log", "", np.zeros((1, 181)), log.poses, log.stamps, FORWARD_CAMERA)
    with pytest.raises(
        InputError, match=r"log has 1 frames .*two are needed; give a longer recording or part"
    ):
        cut({"log": drive}, "log")


@pytest.mark.parametrize("compress", PACKINGS)
@pytest.mark.parametrize("harm", ["cut off", "corrupt"])
def test_broken_packing(tmp_path: Path, compress: str, harm: str) -> None:
    make_carmen(tmp_path, "robot", frames=20, compress=compress)
    path = tmp_path / f"robot.log.{compress}"
    content = path.read_bytes()
    half = len(content) // 2
    harmed = {
        "cut off": content[:half],
        "corrupt": content[:half] + bytes(64) + content[half + 64 :],
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


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_reference_with_a_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    make_carmen(tmp_path, "robot", frames=2, compress="zst")
    rows = ["raw_scan_index,ref_x,ref_y,ref_theta", "0,1,2,0.5", "1,2,2,0.5"]
    (tmp_path / "robot_dense_ref.csv").write_text("\n".join(rows), encoding=encoding)
    if encoding == "utf-16":
        with pytest.raises(InputError, match=r"robot_dense_ref\.csv: is text in UTF-16; save it as UTF-8"):
            carmen.load("robot", root=tmp_path, reference=tmp_path)
        return
    for name in ("robot", "robot.log", "robot.log.zst"):
        sequence = carmen.load(name, root=tmp_path, reference=tmp_path)
        np.testing.assert_allclose(poses_to_planar(sequence.poses), [[1, 2, 0.5], [2, 2, 0.5]])


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        ((), r"robot_dense_ref\.csv: is empty; give a table with the columns raw_scan_index, ref_x"),
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


CASES = SHARED / "cases"


@pytest.fixture
def cases() -> Path:
    if not CASES.is_dir():
        pytest.skip(f"no small cases at {CASES}")
    return CASES


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("robotlaser_degrees", f"view of 180 and a resolution of 1 .*{IN_DEGREES}"),
        ("robotlaser_res_is_count", "view of 3.14159 and a resolution of 180 .*is it the number of readings"),
        ("robotlaser_fov_twice", "view of 3.14159 and a resolution of 0.008727 do not fit 180 readings"),
    ],
)
def test_cases_that_are_refused(cases: Path, name: str, match: str) -> None:
    with pytest.raises(InputError, match=rf"{name}\.log\.gz: none of its 120 .* line 1: .*{match}"):
        carmen.load(name, root=cases)
    with pytest.raises(InputError, match=f"none of its 120 ROBOTLASER1 lines can be used.*line 1: .*{match}"):
        list(carmen.stream(cases / f"{name}.log.gz").scans)


@pytest.mark.parametrize(
    ("name", "most"),
    [("robotlaser_neg_res", 0.11), ("flaser_541_param", 0.085)],
)
def test_cases_that_scan_matching_agrees_with(cases: Path, name: str, most: float) -> None:
    log = carmen.load(name, root=cases)
    drive = Drive.unencoded(log)
    tracking = Tracking(MatcherTracker())
    tracked = [tracking.step(scan) for scan in drive.raw_scans()][1:]
    assert {each.kind for each in tracked} == {Kind.ESTIMATED}
    found = change_frame(compose([each.step.array() for each in tracked]), FORWARD_CAMERA)
    score = drift(drive.camera_poses, found, planar=True, lengths=[1.0, 2.0, 5.0, 10.0])
    assert score.t_err < most
    for frame, scan in enumerate(carmen.stream(cases / f"{name}.log.gz").scans):
        np.testing.assert_array_equal(scan.bearings, log.read_scan(frame).bearings)


@pytest.mark.parametrize(
    ("name", "absent", "notes"),
    [
        ("edmonton", 0, "PARAM robot_front_laser_max 10 is not used: 29%"),
        ("fhw", 0, "180 degrees by the log's PARAM laser_frontlaser_resolution 1"),
        ("freiburg-101", 12555, "PARAM robot_front_laser_max 80.99 m or beyond are no returns"),
    ],
)
def test_params_of_real_logs(corrected: Path, name: str, absent: int, notes: str) -> None:
    log = carmen.load(f"{name}-corrected", root=corrected)
    assert notes in notes_of(log)
    scans = [log.read_scan(frame) for frame in range(len(log))]
    assert sum(np.isinf(scan.ranges).sum() for scan in scans) == absent
    first, spacing = first_and_spacing(scans[0])
    assert (first, spacing * len(scans[0].ranges)) == pytest.approx((-90, 180))
