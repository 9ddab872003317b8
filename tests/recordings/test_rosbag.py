"""Bags with LaserScan messages: which topic is read, and what can be wrong in one."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Reader1
from rosbags.typesys import Stores, get_typestore

from conftest import SHARED
from data.make_bag import (
    CLOUD,
    FORMATS,
    SCAN,
    START,
    TEXT,
    arrival_of,
    laser_scan,
    make_bag,
    make_cloud_bag,
    point_cloud,
    scan_bytes,
    store_of,
    write_bag,
    write_mcap,
    write_ros1,
)
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings import rosbag
from rcnn_odom.recordings.formats import open_stream

RANGES = np.random.default_rng(0).uniform(1, 39, (12, 181))
CASES = SHARED / "cases"
GARBAGE = b"\xff\xfe not text\n=== Header header\nnowhere/Missing x"
SCAN_DEFINITIONS = {"garbage": GARBAGE, "empty": b""}


def read(path, **options):
    stream = open_stream(path, options)
    return stream, list(stream.scans)


def check_scans(scans, ranges):
    np.testing.assert_allclose([scan.ranges for scan in scans], ranges, rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings), np.linspace(-90, 90, len(ranges[0])), atol=1e-4)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_bag_gives_its_scans(tmp_path, kind):
    ranges = RANGES.copy()
    ranges[3, :5] = [0.05, 40.0, 45.0, np.inf, np.nan]
    stream, scans = read(make_bag(tmp_path, kind, ranges))
    assert (len(scans), stream.total, stream.has_clock) == (12, 12, True)
    np.testing.assert_allclose([scan.stamp for scan in scans], START + 0.1 * np.arange(12), atol=1e-6)
    np.testing.assert_array_equal(scans[3].ranges[:5], [0, np.inf, np.inf, np.inf, 0])
    assert (scans[2].times, scans[2].turn_time) == (None, pytest.approx(0.1))
    np.testing.assert_allclose(scans[3].times, 1e-4 * np.arange(181), rtol=1e-6)
    assert {scan.frame_id for scan in scans} == {"laser"}
    np.testing.assert_allclose(np.rad2deg(scans[0].bearings), np.arange(-90, 91), atol=1e-4)
    np.testing.assert_allclose(Sensor(1.0, 180.0, 40.0).encode(scans[1]), RANGES[1], rtol=1e-6)
    assert stream.notes == ("12 scans of /scan",)
    assert not stream.skipped


@pytest.mark.parametrize("kind", FORMATS)
def test_which_topic_of_a_bag(tmp_path, kind):
    several = make_bag(tmp_path, kind, RANGES, ("/front", "/back"))
    choice = r"choose one with --topic: /back, /front \(LaserScan\)"
    with pytest.raises(InputError, match=f"several LaserScan topics; {choice}"):
        open_stream(several)
    with pytest.raises(InputError, match=f"no topic /side; {choice}"):
        open_stream(several, {"topic": "/side", "ring": None})
    with pytest.raises(InputError, match=f"/words holds std_msgs/msg/String, which is not a scan; {choice}"):
        open_stream(several, {"topic": "/words"})
    for name in ("/back", "back"):
        assert len(read(several, topic=name)[1]) == 12
    with pytest.raises(
        InputError, match=r"/back holds LaserScan messages, .* no ring to choose; leave --ring out"
    ):
        open_stream(several, {"topic": "/back", "ring": 3})
    (tmp_path / "none").mkdir()
    others = r"no topic with sensor_msgs/msg/LaserScan or .*; its topics: /words \(std_msgs/msg/String\)"
    with pytest.raises(InputError, match=others):
        open_stream(make_bag(tmp_path / "none", kind, RANGES, ()))


@pytest.mark.parametrize("kind", FORMATS)
def test_a_topic_that_was_never_written_is_no_choice(tmp_path, kind):
    store = store_of(kind)
    scan = laser_scan(store, RANGES[0], START, 180.0, kind == "ros1")
    bag = write_bag(tmp_path, kind, {"/scan": SCAN, "/silent": SCAN}, [("/scan", arrival_of(0), scan)])
    check_scans(read(bag)[1], RANGES[:1])
    (tmp_path / "clouds").mkdir()
    field = dict.fromkeys("xyz", np.ones(5, "f4"))
    cloud = point_cloud(store, field, START, kind == "ros1")
    kinds = {"/points": CLOUD, "/silent": SCAN}
    assert len(read(write_bag(tmp_path / "clouds", kind, kinds, [("/points", arrival_of(0), cloud)]))[1]) == 1
    with pytest.raises(InputError, match="no message of /silent in it; "):
        read(bag, topic="/silent")


def test_clouds_are_read_where_there_is_no_laser_scan(tmp_path):
    cloud = {"x": np.ones(4, "f4"), "y": np.arange(4, dtype="f4"), "z": np.zeros(4, "f4")}
    stream, [scan] = read(make_cloud_bag(tmp_path, "mcap", [cloud]))
    assert "1 point clouds of /points" in stream.notes
    np.testing.assert_allclose(scan.ranges, np.hypot(1, np.arange(4)))
    kinds = {"/a": SCAN, "/b": SCAN, "/points": "sensor_msgs/msg/PointCloud2"}
    (tmp_path / "more").mkdir()
    bag = write_bag(tmp_path / "more", "sqlite3", kinds, [])
    with pytest.raises(
        InputError, match=r"choose one with --topic: /a, /b \(LaserScan\) and /points \(PointCl"
    ):
        open_stream(bag)


@pytest.mark.parametrize("definition", SCAN_DEFINITIONS)
@pytest.mark.parametrize("index", [True, False])
def test_definitions_do_not_matter_in_ros1(tmp_path, definition, index):
    text = SCAN_DEFINITIONS[definition]
    connections = [
        (b"/camera\xff", b"nowhere/\xfe", GARBAGE),
        (b"/scan", b"sensor_msgs/LaserScan", text),
        (b"/odd", b"", b""),
    ]
    messages = [(0, arrival_of(0), b"anything")]
    messages += [(1, arrival_of(n), scan_bytes(row, ros1=True)) for n, row in enumerate(RANGES)]
    bag = write_ros1(tmp_path / "log.bag", connections, messages, index=index, latching=b"\xff")
    stream = open_stream(bag)
    scans = []
    if index:
        scans.extend(stream.scans)
    else:
        with pytest.raises(
            InputError, match=r"breaks off after 12 scans \(its recording was not closed\); these"
        ):
            scans.extend(stream.scans)
    check_scans(scans, RANGES)
    assert stream.total == 12


@pytest.mark.parametrize("entry_bytes", [12, 16, 24])
def test_an_index_of_2010_that_says_a_wrong_length(tmp_path, entry_bytes):
    messages = [(0, arrival_of(n), scan_bytes(row, ros1=True)) for n, row in enumerate(RANGES)]
    connections = [(b"/scan", b"sensor_msgs/LaserScan", b""), (b"/b", b"std_msgs/String", b"string data")]
    bag = write_ros1(tmp_path / "log.bag", connections, messages, entry_bytes)
    check_scans(read(bag)[1], RANGES)
    if entry_bytes == 12:  # what is written by hand is what others write
        with Reader1(bag) as reader:
            assert reader.topics["/scan"].msgcount == 12


@pytest.mark.parametrize("definition", SCAN_DEFINITIONS)
@pytest.mark.parametrize("chunks", [True, False])
def test_definitions_do_not_matter_in_mcap(tmp_path, definition, chunks):
    channels = {
        "/scan": (SCAN, "ros2msg", SCAN_DEFINITIONS[definition], "cdr"),
        "/camera": ("nowhere/msg/Missing", "unheard of", GARBAGE, "protobuf"),
        "/words": ("AAAA.words", "jsonschema", b"{", "json"),
    }
    messages = [(topic, arrival_of(0), b"\0anything") for topic in ("/camera", "/words")]
    messages += [("/scan", arrival_of(n), scan_bytes(row)) for n, row in enumerate(RANGES)]
    path = write_mcap(tmp_path / "log.mcap", channels, messages, use_chunking=chunks, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"AAAA", b"\xff\xfe\xfd\xfc").replace(b"qos", b"q\xffs"))
    check_scans(read(path)[1], RANGES)
    with pytest.raises(InputError, match="no topic /other; choose one with --topic: /scan"):
        read(path, topic="/other")


@pytest.mark.parametrize("definition", SCAN_DEFINITIONS)
def test_definitions_do_not_matter_in_sqlite3(tmp_path, definition):
    bag = make_bag(tmp_path, "sqlite3", RANGES)
    (bag / "metadata.yaml").write_bytes(b"\xff: [\n" + GARBAGE)
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database, database:
        database.execute("UPDATE topics SET offered_qos_profiles = ?", (GARBAGE,))
        odd = "UPDATE topics SET type = ?, serialization_format = 'protobuf' WHERE name = '/words'"
        database.execute(odd, (GARBAGE,))
        database.execute(
            "UPDATE message_definitions SET encoded_message_definition = ?", (SCAN_DEFINITIONS[definition],)
        )
    check_scans(read(bag)[1], RANGES)


def test_a_topic_of_two_types(tmp_path):
    channels = {"/scan": (SCAN, "", b"", "cdr"), "/scam": (TEXT, "", b"", "cdr")}
    messages = [("/scam", arrival_of(0), b"\0\1\0\0\2\0\0\0a\0")]
    messages += [("/scan", arrival_of(n), scan_bytes(row)) for n, row in enumerate(RANGES)]
    path = write_mcap(tmp_path / "log.mcap", channels, messages, use_chunking=False)
    path.write_bytes(path.read_bytes().replace(b"/scam", b"/scan"))
    stream, scans = read(path)
    check_scans(scans, RANGES)
    assert (stream.total, stream.skipped.total()) == (12, 0)


def test_mcap_of_ros1_and_of_no_profile(tmp_path):
    ros1 = {"/scan": ("sensor_msgs/LaserScan", "ros1msg", b"", "ros1")}
    messages = [("/scan", arrival_of(n), scan_bytes(row, ros1=True)) for n, row in enumerate(RANGES)]
    check_scans(read(write_mcap(tmp_path / "a.mcap", ros1, messages, profile="ros1"))[1], RANGES)
    ros2 = {"/scan": (SCAN, "ros2msg", b"", "cdr")}
    messages = [("/scan", arrival_of(n), scan_bytes(row)) for n, row in enumerate(RANGES)]
    check_scans(read(write_mcap(tmp_path / "b.mcap", ros2, messages, profile=""))[1], RANGES)
    packed = {"/scan": (SCAN, "protobuf", b"", "protobuf")}
    with pytest.raises(
        InputError, match=r"messages of /scan are in protobuf, not in ROS's own cdr or ros1; "
    ):
        read(write_mcap(tmp_path / "c.mcap", packed, messages))


@pytest.mark.parametrize("kind", FORMATS)
def test_messages_that_cannot_be_read_are_skipped_and_counted(tmp_path, kind):
    good, bad = scan_bytes(RANGES[0], ros1=kind == "ros1"), b"\0\1\0\0too short"
    for contents, name in (([good, bad, bad, good], "some"), ([bad] * 40, "all")):
        messages = [(arrival_of(n), content) for n, content in enumerate(contents)]
        if kind == "ros1":
            about = [(b"/scan", b"sensor_msgs/LaserScan", b"")]
            path = write_ros1(tmp_path / name, about, [(0, *message) for message in messages])
        elif kind == "mcap":
            channels = {"/scan": (SCAN, "", b"", "cdr")}
            path = write_mcap(tmp_path / name, channels, [("/scan", *message) for message in messages])
        else:
            (tmp_path / name).mkdir()
            path = make_bag(tmp_path / name, kind, RANGES[:1])
            with closing(sqlite3.connect(next(path.glob("*.db3")))) as database, database:
                database.execute("DELETE FROM messages WHERE topic_id = 1")
                insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)"
                database.executemany(insert, messages)
        if name == "some":
            stream, scans = read(path)
            check_scans(scans, RANGES[[0, 0]])
            assert stream.skipped == {"messages that cannot be read": 2}
            continue
        why = r"none of its 40 messages of /scan can be read \(its 13 bytes are not a LaserScan\); "
        with pytest.raises(InputError, match=why):
            read(path)


@pytest.mark.parametrize("increment", [0.0, float("nan")])
def test_angles_of_which_a_part_is_left_out(increment):
    store = get_typestore(Stores.LATEST)

    def converted(beams=181, **changes):
        return rosbag.convert(laser_scan(store, np.ones(beams), START, 180.0, False, **changes))

    spread = converted(angle_increment=increment)
    np.testing.assert_allclose(np.rad2deg(spread.bearings), np.linspace(-90, 90, 181), atol=1e-6)
    assert len(converted(beams=1, angle_increment=increment).bearings) == 1
    assert len(converted(beams=0, angle_increment=increment).bearings) == 0
    for maximum in (float("nan"), float("inf"), -np.pi / 2):
        with pytest.raises(ValueError, match=r"its angle_increment is .* and its angle_max"):
            converted(angle_increment=increment, angle_max=maximum)
    with pytest.raises(ValueError, match="its angle_min is nan"):
        converted(angle_min=float("nan"))
    # Which of the two is wrong is told by most drivers' code: the increment is what they work with.
    contradiction = converted(angle_max=7.0)
    np.testing.assert_allclose(np.rad2deg(contradiction.bearings), np.linspace(-90, 90, 181), atol=1e-6)


def test_a_stamp_of_0_is_the_time_of_arrival():
    store = get_typestore(Stores.LATEST)
    scan = laser_scan(store, np.ones(3), 0, 180.0, False)
    assert rosbag.convert(scan, 12_500_000_000).stamp == 12.5
    scan = laser_scan(store, np.ones(3), 7.25, 180.0, False)
    assert rosbag.convert(scan, 12_500_000_000).stamp == 7.25


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize(
    ("headers", "stamps"),
    [
        ([0, 0, 0], [START + 1e-6, START + 0.100001, START + 0.200001]),
        ([0, 5, 6], [START + 1e-6, START + 0.100001, START + 0.200001]),
        ([5, 0, 6], [5, None, 6]),
    ],
)
def test_one_clock_for_a_topic(tmp_path, kind, headers, stamps):
    store, first = store_of(kind), kind == "ros1"
    scans = [
        ("/scan", arrival_of(n), laser_scan(store, RANGES[n], stamp, 180.0, first))
        for n, stamp in enumerate(headers)
    ]
    points = {"x": np.ones(4, "f4"), "y": np.arange(4, dtype="f4"), "z": np.zeros(4, "f4")}
    clouds = [
        ("/points", arrival_of(n), point_cloud(store, points, stamp, first))
        for n, stamp in enumerate(headers)
    ]
    bag = write_bag(tmp_path, kind, {"/scan": SCAN, "/points": CLOUD}, scans + clouds)
    for topic in ("/scan", "/points"):
        found = [scan.stamp for scan in read(bag, topic=topic)[1]]
        assert [stamp is None for stamp in found] == [stamp is None for stamp in stamps]
        # To 1e-6 of a second, at which a float of this size still counts.
        assert found == [stamp and pytest.approx(stamp, rel=0, abs=1e-6) for stamp in stamps]


def test_a_bag_is_called_as_its_folder(tmp_path, monkeypatch):
    bag = make_bag(tmp_path, "sqlite3", RANGES)
    [file] = bag.glob("*.db3")
    assert (open_stream(bag).name, open_stream(file).name) == (bag.name, file.name)
    monkeypatch.chdir(bag)
    for path in ("metadata.yaml", ".", bag / "metadata.yaml"):
        assert open_stream(Path(path)).name == bag.name


def test_a_topic_with_a_slash_and_one_without(tmp_path):
    channels = dict.fromkeys(("/scan", "scan", "/rear"), (SCAN, "ros2msg", b"", "cdr"))
    messages = [(name, arrival_of(0), scan_bytes(row)) for name, row in zip(channels, RANGES, strict=False)]
    path = write_mcap(tmp_path / "log.mcap", channels, messages)
    for name, row in (("/scan", 0), ("scan", 1), ("/rear", 2), ("rear", 2)):
        check_scans(read(path, topic=name)[1], RANGES[[row]])


@pytest.mark.parametrize("encoding", ["", "CDR", "Cdr"])
def test_names_of_the_encoding_cdr(tmp_path, encoding):
    messages = [("/scan", arrival_of(n), scan_bytes(row)) for n, row in enumerate(RANGES)]
    path = write_mcap(tmp_path / "log.mcap", {"/scan": (SCAN, "ros2msg", b"", encoding)}, messages)
    check_scans(read(path)[1], RANGES)


def case(name):
    path = CASES / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


def test_a_foreign_topic_without_its_definition():
    stream, scans = read(case("foreign_topic.bag"))
    assert len(scans) == stream.total == 10
    assert all((scan.ranges > 0).any() and len(scan.ranges) == 1800 for scan in scans)


def test_a_maximum_range_of_0_is_unknown():
    _, scans = read(case("range_max_0.bag"))
    assert len(scans) == 40
    assert all((np.isfinite(scan.ranges) & (scan.ranges > 0)).mean() > 0.5 for scan in scans)


def test_a_laser_that_starts_slowly():
    _, scans = read(case("slow_start.bag"))
    assert [len(scan.ranges) for scan in scans] == [0, 0, 800, *[1800] * 37]
    assert all(scan.bearings.shape == scan.ranges.shape for scan in scans)


def test_a_laser_that_looks_to_the_left():
    _, scans = read(case("left_half.bag"))
    for scan in scans:
        np.testing.assert_allclose(np.rad2deg(scan.bearings), np.arange(180.0), atol=1e-3)
