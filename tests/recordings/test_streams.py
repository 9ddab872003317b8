"""Recordings read scan by scan: KITTI folders, CARMEN logs, ROS bags, JSON lines."""

import gzip
import json
import shutil
import sqlite3
from collections import deque
from contextlib import closing

import numpy as np
import pytest

from conftest import SHARED
from data.make_bag import FORMATS, START, make_bag
from data.make_carmen import make_carmen
from data.make_kitti import LEVEL_RING, make_kitti
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings import carmen, json_lines, kitti
from rcnn_odom.recordings.formats import need_fitting_scan, open_stream
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from scans import beams

RANGES = np.random.default_rng(0).uniform(1, 39, (12, 181))
REAL = SHARED / "data"


def read(path, **options):
    stream = open_stream(path, options)
    return stream, list(stream.scans)


def test_a_kitti_folder_needs_no_poses(tmp_path):
    make_kitti(tmp_path, ["05"], frames=8)
    sequence = kitti.load("05", root=tmp_path)
    shutil.rmtree(tmp_path / "poses")
    stream, scans = read(tmp_path / "sequences" / "05")
    assert (stream.name, stream.total, stream.has_clock) == ("05", 8, True)
    np.testing.assert_array_equal(stream.camera_from_laser, sequence.camera_from_laser)
    for frame, scan in enumerate(scans):
        assert scan.stamp == sequence.stamps[frame]
        angles, ranges = beams(sequence.read_scan(frame))
        np.testing.assert_array_equal(scan.ranges, ranges)
        np.testing.assert_array_equal(scan.bearings, angles)
        assert not scan.has_all_beams
    assert f"ring {LEVEL_RING}" in stream.notes[1]
    _, others = read(tmp_path / "sequences" / "05", ring=0)
    assert not np.array_equal(others[0].ranges, scans[0].ranges)


def test_a_kitti_folder_with_too_few_stamps(tmp_path):
    make_kitti(tmp_path, ["05"], frames=8)
    times = tmp_path / "sequences" / "05" / "times.txt"
    times.write_text("\n".join(times.read_text().splitlines()[:5]))
    with pytest.raises(InputError, match=r"8 scans in velodyne/, but 5 lines in times\.txt"):
        open_stream(tmp_path / "sequences" / "05")


@pytest.mark.parametrize("fmt", ["FLASER", "ROBOTLASER1"])
@pytest.mark.parametrize("compress", [None, "gz", "bz2"])
def test_a_carmen_log_gives_the_scans_of_its_sequence(tmp_path, fmt, compress):
    make_carmen(tmp_path, "robot", frames=10, fmt=fmt, compress=compress)
    sequence = carmen.load("robot", root=tmp_path)
    stream, scans = read(next(tmp_path.glob("robot*")))
    assert (len(scans), stream.has_clock, stream.total) == (10, False, None)
    for frame, scan in enumerate(scans):
        angles, ranges = beams(sequence.read_scan(frame))
        np.testing.assert_array_equal(scan.bearings, angles)
        np.testing.assert_array_equal(scan.ranges, ranges)
        assert scan.stamp == sequence.stamps[frame]


def test_broken_lines_of_a_log_are_skipped_and_counted(tmp_path, caplog):
    make_carmen(tmp_path, "robot", frames=10)
    log = tmp_path / "robot.log"
    lines = log.read_text().splitlines()
    flaser = [number for number, line in enumerate(lines) if line.startswith("FLASER")]
    lines[flaser[3]] = "FLASER 180 1.0 2.0"
    lines[flaser[5]] = lines[flaser[5]].replace(" ", " x", 3)
    lines += ["RLASER 1 2 3", "ROBOTLASER1 0 0"]
    lines.append(lines[flaser[-1]][:200])
    log.write_text("\n".join(lines))
    stream, scans = read(log)
    assert len(scans) == 8
    assert stream.skipped == {"broken lines": 3, "RLASER lines": 1, "ROBOTLASER1 lines": 1}
    assert f"{log}:{flaser[3] + 1}: broken FLASER line" in caplog.text


def test_a_log_that_is_cut_off_gives_what_is_there(tmp_path):
    make_carmen(tmp_path, "robot", frames=60, compress="gz")
    log = tmp_path / "robot.log.gz"
    log.write_bytes(log.read_bytes()[:-2000])
    scans: deque = deque()
    with pytest.raises(InputError, match=r"robot\.log\.gz: cannot be read to its end"):
        scans.extend(open_stream(log).scans)
    assert 0 < len(scans) < 60


def test_files_without_a_scan(tmp_path):
    (tmp_path / "notes.txt").write_text("hello\nRLASER 1 2\n")
    with pytest.raises(InputError, match="no FLASER or ROBOTLASER1 line in it, only RLASER lines"):
        read(tmp_path / "notes.txt")
    with gzip.open(tmp_path / "empty.gz", "wb"):
        pass
    with pytest.raises(InputError, match="no FLASER"):
        read(tmp_path / "empty.gz")
    with pytest.raises(InputError, match="neither a KITTI sequence"):
        open_stream(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        open_stream(tmp_path / "none")


@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_gives_its_scans(tmp_path, kind):
    ranges = RANGES.copy()
    ranges[3, :5] = [0.05, 40.0, 45.0, np.inf, np.nan]
    stream, scans = read(make_bag(tmp_path, kind, ranges))
    assert (len(scans), stream.total, stream.has_clock) == (12, 12, True)
    np.testing.assert_allclose([scan.stamp for scan in scans], START + 0.1 * np.arange(12), atol=1e-6)
    np.testing.assert_array_equal(scans[3].ranges[:5], 0)
    assert scans[2].times is None, "a time increment of 0 says nothing"
    np.testing.assert_allclose(scans[3].times, 1e-4 * np.arange(181), rtol=1e-6)
    assert {scan.frame_id for scan in scans} == {"laser"}
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings), np.arange(-90, 91), atol=1e-4)
    sensor = Sensor(1.0, 180.0, 40.0)
    np.testing.assert_allclose(sensor.encode(scans[1]), RANGES[1], rtol=1e-6)
    assert not stream.skipped


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_bag_by_the_file_in_its_folder(tmp_path, kind):
    folder = make_bag(tmp_path, kind, RANGES)
    inside = next(path for path in folder.iterdir() if path.suffix in (".db3", ".mcap"))
    assert len(read(inside)[1]) == 12


@pytest.mark.parametrize("kind", FORMATS)
def test_which_topic_of_a_bag(tmp_path, kind):
    several = make_bag(tmp_path, kind, RANGES, ("/front", "/back"))
    with pytest.raises(InputError, match="several LaserScan topics; choose one with --topic: /back, /front"):
        open_stream(several)
    with pytest.raises(InputError, match="no LaserScan topic /side; choose one with --topic: /back, /front"):
        open_stream(several, {"topic": "/side", "ring": None})
    assert len(read(several, topic="/back")[1]) == 12
    (tmp_path / "none").mkdir()
    with pytest.raises(
        InputError, match=r"no topic with .*LaserScan; its topics: /words \(std_msgs/msg/String\)"
    ):
        open_stream(make_bag(tmp_path / "none", kind, RANGES, ()))


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_a_bag_that_is_cut_off_is_refused_with_a_way_out(tmp_path, kind, part):
    bag = make_bag(tmp_path, kind, RANGES)
    inside = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
    content = inside.read_bytes()
    inside.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputError, match=r"cannot be opened as a ROS bag .*reindex|breaks off after"):
        read(bag)


def test_a_message_that_cannot_be_read_is_skipped_and_counted(tmp_path):
    bag = make_bag(tmp_path, "sqlite3", RANGES)
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database, database:
        number, content = database.execute(
            "SELECT id, data FROM messages ORDER BY id LIMIT 1 OFFSET 5"
        ).fetchone()
        database.execute("UPDATE messages SET data = ? WHERE id = ?", (content[:100], number))
    stream, scans = read(bag)
    assert len(scans) == 11
    assert stream.skipped == {"messages that cannot be read": 1}


def test_json_lines():
    lines = [
        json.dumps({"stamp": 1.5, "ranges": [1.0, None, 3.0]}),
        json.dumps({"ranges": [1, 2], "angle_min": -0.5, "angle_increment": 0.25, "more": "ignored"}),
        json.dumps({"stamp": 2, "points": [[1, 2], [3, 4, 5]]}),
    ]
    scans = list(json_lines.stream(lines).scans)
    np.testing.assert_array_equal(scans[0].ranges, [1, np.nan, 3])
    assert (scans[0].stamp, scans[0].bearings, scans[1].stamp) == (1.5, None, None)
    np.testing.assert_array_equal(scans[1].bearings, [-0.5, -0.25])
    np.testing.assert_allclose(scans[2].ranges, np.sqrt([5, 25]))
    np.testing.assert_allclose(np.tan(scans[2].bearings), [2, 4 / 3])
    assert [scan.has_all_beams for scan in scans] == [True, True, False]


@pytest.mark.parametrize(
    "line",
    [
        "hello",
        "{",
        "[1, 2]",
        "null",
        "{}",
        '{"ranges": 5}',
        '{"ranges": "12"}',
        '{"ranges": ["a"]}',
        '{"ranges": [[1]]}',
        '{"points": [1, 2]}',
        '{"points": [[1]]}',
        '{"points": 3}',
        '{"ranges": [1], "stamp": "noon"}',
        '{"ranges": [1], "stamp": [1]}',
        '{"ranges": [1], "angle_min": 0}',
        '{"ranges": [1], "angle_min": null, "angle_increment": 1}',
        "[" * 100_000,
        '{"ranges": [1' + "0" * 5000 + "]}",
        '{"ranges": [1' + "0" * 400 + "]}",
    ],
)
def test_lines_that_are_no_scan_are_skipped_and_counted(line, caplog):
    good = json.dumps({"ranges": [1.0]})
    stream = json_lines.stream([good, "", line, good])
    assert len(list(stream.scans)) == 2
    assert stream.skipped == {"lines that are no scan": 1}
    assert "standard input:3: no scan (" in caplog.text


def stream_of(**options):
    return ScanStream(name="log", scans=iter(()), **options)


def test_another_laser_than_the_models_is_refused(tmp_path):
    sick = Scan(np.ones(181), np.deg2rad(np.arange(-90.0, 91.0)))
    fits, other = Sensor(1.0, 180.0, 40.0), Sensor()
    need_fitting_scan(stream_of(), sick, fits)
    need_fitting_scan(stream_of(), Scan(np.ones(180)), fits)
    half_degrees = Scan(np.ones(361), np.deg2rad(np.arange(-90.0, 90.5, 0.5)))
    need_fitting_scan(stream_of(), half_degrees, fits)
    with pytest.raises(InputError, match="a laser of 181 degrees, a beam every 1, but the model is for 360"):
        need_fitting_scan(stream_of(), sick, other)
    sparse = Scan(np.ones(720), np.deg2rad(0.5 * np.arange(720)))
    for scan in (sparse, Scan(np.ones(720)), Scan(np.ones(1), np.zeros(1))):
        with pytest.raises(InputError, match="but the model is for 360"):
            need_fitting_scan(stream_of(), scan, other)
    with pytest.raises(InputError, match="but the model is for 180"):
        need_fitting_scan(stream_of(), Scan(np.ones(181), np.full(181, np.nan)), fits)
    make_kitti(tmp_path, ["05"], frames=2)
    velodyne, scans = read(tmp_path / "sequences" / "05")
    need_fitting_scan(velodyne, scans[0], other)
    with pytest.raises(
        InputError, match=r"a laser of 360 degrees, a beam every 0\.18, but the model is for 180"
    ):
        need_fitting_scan(velodyne, scans[0], fits)
    points = Scan.from_points(np.ones((5, 2)))  # which do not say what beams there are
    need_fitting_scan(stream_of(), points, fits)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("intel", marks=pytest.mark.slow),
        pytest.param("mit-killian", marks=pytest.mark.slow),
        "aces",
        "mit-csail",
    ],
)
def test_real_logs_give_the_scans_of_their_sequence(name):
    root = REAL / "carmen"
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root}")
    stream = open_stream(root / f"{name}.clf.bz2")
    sequence = carmen.load(name, root=root)
    count = 0
    for frame, scan in enumerate(stream.scans):
        count += 1
        if frame % 500 == 0:
            np.testing.assert_array_equal(scan.ranges, sequence.read_scan(frame).ranges)
    assert count == len(sequence)
    assert not stream.skipped
