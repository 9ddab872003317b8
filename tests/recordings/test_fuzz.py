"""Readers and encoder under random input: a clear error or a valid result, nothing else.

``make fuzz`` runs ten thousand cases and more.
"""

import json
import shutil
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data.make_bag import CLOUD, SCAN, make_bag, point_cloud, scan_bytes, store_of, write_mcap, write_ros1
from data.make_carmen import PACKINGS, make_carmen, write_log
from data.make_kitti import make_kitti, make_kitti_raw
from data.point_orders import PERMUTED, RINGED, THINNED
from odometry import ANGLES
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step
from rcnn_odom.models.contract import Description
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.pairs import LONGEST_HOLD, PairTracker
from rcnn_odom.recordings import carmen, json_lines, kitti, kitti_raw, rosbag
from rcnn_odom.recordings.beams import BeamCheck, find_beams
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.trajectory import read_kitti
from scans import beams

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

CASES: Counter[str] = Counter()
"""Cases tried, by what was tried; the summary at the end of a run prints them."""
SENSORS = [Sensor(), Sensor(1.0, 180.0, 40.0), Sensor(0.5, 360.0, 10.0)]
ODD_WORDS = [
    *("nan", "-nan", "inf", "-inf", "1e999", "1e308", "-1e308", "1e-320", "0", "-0", "-1", "0x10", "1_0"),
    *("abc", "", "null", "\uff11", "\x00", "9" * 30, "9" * 5000, "2147483648", "1.5.5", "--1", "True", "[]"),
]


def check_scan(angles, ranges):
    """Whether a scan can be encoded, and to a depth vector as it should be."""
    assert angles.shape == ranges.shape == (len(ranges),)
    for sensor in SENSORS:
        depth = encode(angles, ranges, sensor)
        assert depth.shape == (sensor.bins,)
        assert depth.dtype == np.float32
        assert np.isfinite(depth).all()
        assert (depth >= 0).all()
        assert (depth <= np.float32(sensor.max_range)).all()


def check_sequence(sequence):
    """Whether a recording is as promised, and all its frames can be read, or say why not."""
    assert len(sequence) > 0
    assert np.isfinite(sequence.poses).all()
    assert np.isfinite(sequence.stamps).all()
    for frame in range(len(sequence)):
        try:
            angles, ranges = beams(sequence.read_scan(frame))
        except InputError as error:
            check_error(error)
        else:
            check_scan(angles, ranges)


def check_error(error):
    """One line that a user can act on."""
    text = str(error)
    assert text
    assert "\n" not in text
    assert ";" in text, text


def try_all(what, function, *arguments):
    """Calls a reader; its mistakes must be clear ones. Returns None after one."""
    CASES[what] += 1
    try:
        return function(*arguments)
    except InputError as error:
        check_error(error)
        return None


@st.composite
def damaged(draw, original):
    """A file's content after a few accidents."""
    content = original
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(content)))
        accident = draw(st.sampled_from(["cut", "lose", "insert", "flip", "word", "word", "word", "repeat"]))
        if accident == "cut":
            content = content[:at]
        elif accident == "lose":
            content = content[:at] + content[at + draw(st.integers(1, 200)) :]
        elif accident == "insert":
            content = content[:at] + draw(st.binary(min_size=1, max_size=40)) + content[at:]
        elif accident == "flip" and at < len(content):
            content = content[:at] + bytes([content[at] ^ draw(st.integers(1, 255))]) + content[at + 1 :]
        elif accident == "word":
            words = content.split(b" ")
            words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(ODD_WORDS)).encode()
            content = b" ".join(words)
        elif accident == "repeat":
            content = content[:at] + content[max(0, at - 300) :]
    return content


any_float = st.floats(width=64) | st.sampled_from([0.0, 1e-320, 1e308, -1e308, 80.0, np.nextafter(80.0, 0)])


@given(
    st.lists(st.tuples(any_float, any_float), max_size=60),
    st.integers(1, 720),
    st.integers(1, 3600),
    st.floats(1e-3, 1e6),
)
def test_encoder_gives_depths_for_any_numbers(returns, parts, bins, max_range):
    CASES["scans encoded"] += 1
    angles, ranges = np.array(returns, dtype=np.float64).reshape(-1, 2).T
    check_scan(angles, ranges)
    field_of_view = parts / 2
    sensor = Sensor(field_of_view / bins, field_of_view, max_range)
    depth = encode(angles, ranges, sensor)
    assert np.isfinite(depth).all()
    assert (depth >= 0).all()
    valid = np.isfinite(angles) & (ranges > 0) & (ranges < max_range)
    assert depth.any() <= valid.any()


LASER_PARAMS = "\n".join(
    f"PARAM {name} {{}} nohost 0"
    for name in ("laser_front_laser_fov", "laser_frontlaser_resolution", "robot_front_laser_max")
)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A folder with a tiny log of each kind; their lines."""
    folder = tmp_path_factory.mktemp("logs")
    contents = {}
    for fmt in ("FLASER", "ROBOTLASER1"):
        make_carmen(folder, fmt, frames=4, beams=9, fmt=fmt)
        contents[fmt] = (folder / f"{fmt}.log").read_bytes()
    contents["PARAM"] = (LASER_PARAMS.format(3.141593, 22.5, 81.9) + "\n").encode() + contents["FLASER"]
    (folder / "PARAM.log").write_bytes(contents["PARAM"])
    return folder, contents


@given(data=st.data(), kind=st.sampled_from(["FLASER", "ROBOTLASER1", "PARAM", "bytes"]))
def test_carmen_logs(log, data, kind):
    folder, contents = log
    original = contents.get(kind)
    content = data.draw(st.binary(max_size=300) if original is None else damaged(original))
    path = folder / "damaged.log"
    path.write_bytes(content)
    sequence = try_all("CARMEN logs loaded", lambda: carmen.load("damaged", root=folder, max_range=80.0))
    if sequence is not None:
        check_sequence(sequence)
    for scan in try_all("CARMEN logs streamed", lambda: list(carmen.stream(path).scans)) or []:
        check_scan(scan.bearings, scan.ranges)


any_angle = st.sampled_from(
    ["0", "-1.570796", "3.141593", "6.283185", "180", "-90", "1", "0.5", "22.5", "0.392699", "-0.392699", "9"]
)
any_word = any_angle | any_float.map(str) | st.sampled_from(ODD_WORDS).filter(str.strip)
any_word |= st.sampled_from(["3,1416", "=", "0.0174533", "-3.141593"])


@given(
    head=st.lists(any_word, min_size=4, max_size=4),
    params=st.lists(any_word, min_size=3, max_size=3),
    lost=st.sampled_from([0, 0, 1, 4, 7]),
)
def test_what_carmen_logs_say_of_their_laser(log, head, params, lost):
    """Whatever is read has its beams within a circle, in steps that fit it, also where some get lost."""
    folder, contents = log
    lines = contents["ROBOTLASER1"].decode().splitlines()
    words = lines[-1].split()
    words[2:6] = head
    lines[-1] = " ".join(words)
    params = LASER_PARAMS.format(*params)
    *before, last = contents["FLASER"].decode().splitlines()
    words = last.split()
    words[1:] = [str(9 - lost), *words[2 + lost :]]
    for content in ("\n".join(lines), "\n".join([params, *before, " ".join(words)])):
        path = folder / "said.log"
        path.write_text(content)
        loaded = try_all("CARMEN logs loaded", lambda: carmen.load("said", root=folder))
        streamed = try_all("CARMEN logs streamed", lambda path=path: list(carmen.stream(path).scans))
        if loaded is None:
            continue
        for frame, scan in enumerate(streamed):
            np.testing.assert_array_equal(scan.ranges, loaded.read_scan(frame).ranges)
            np.testing.assert_array_equal(scan.bearings, loaded.read_scan(frame).bearings)
            assert np.ptp(scan.bearings) < 2 * np.pi + 0.11
            assert np.ptp(scan.bearings) > 0 or len(scan.bearings) < 2
            assert np.ptp(np.diff(scan.bearings)) < 1e-9
            check_scan(scan.bearings, scan.ranges)


@given(data=st.data(), suffix=st.sampled_from(sorted(PACKINGS)))
def test_packed_carmen_logs(log, data, suffix):
    folder, contents = log
    path = folder / f"packed.log.{suffix}"
    path.write_bytes(data.draw(damaged(PACKINGS[suffix](contents["FLASER"]))))
    sequence = try_all("packed CARMEN logs", lambda: carmen.load(path.name, root=folder))
    if sequence is not None:
        check_sequence(sequence)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A tiny recording in KITTI's layout, and its files."""
    root = tmp_path_factory.mktemp("kitti")
    make_kitti(root, ["00"], frames=3, rings=3, beams=24)
    return root, {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@given(data=st.data())
def test_kitti_recordings(recording, data):
    root, files = recording
    name = data.draw(st.sampled_from(sorted(files)))
    original = files[name]
    if name.suffix == ".bin":
        values = st.lists(st.floats(width=32), min_size=1, max_size=40).map(
            lambda numbers: np.array(numbers, "<f4").tobytes()
        )
        content = data.draw(damaged(original) | st.binary(max_size=64) | values)
    else:
        content = data.draw(damaged(original) | st.binary(max_size=200))
    (root / name).write_bytes(content)
    try:
        sequence = try_all("KITTI recordings", lambda: kitti.load("00", root=root))
        if sequence is not None:
            check_sequence(sequence)
        stream = try_all("KITTI streams", lambda: kitti.stream(root / "sequences" / "00"))
        for scan in (try_all("KITTI streams", lambda: list(stream.scans)) or []) if stream else []:
            check_scan(*beams(scan))
            assert np.isfinite(scan.ranges).all()
    finally:
        (root / name).write_bytes(original)


any_points = st.lists(st.floats(width=32), min_size=1, max_size=40).map(
    lambda numbers: np.array(numbers, "<f4").tobytes()
)
ORDERS = PERMUTED | THINNED | RINGED


@given(data=st.data(), order=st.sampled_from(sorted(ORDERS)), rings=st.integers(1, 5))
def test_kitti_points_in_any_order(tmp_path_factory, data, order, rings):
    root = tmp_path_factory.mktemp("orders")
    make_kitti(root, ["00"], frames=2, rings=rings, beams=data.draw(st.integers(1, 60)))
    for path in sorted((root / "sequences" / "00" / "velodyne").iterdir())[data.draw(st.integers(0, 1)) :]:
        found = np.fromfile(path, "<f4").reshape(-1, 4)
        found[:, 2] += data.draw(st.sampled_from([0.0, 0.0, 1.73, -40.0]))
        if len(found):
            found = np.ascontiguousarray(ORDERS[order](found), "<f4")
            found[:: data.draw(st.sampled_from([1, 2, 10**6]))] = data.draw(st.sampled_from([0.0, np.nan]))
            found.tofile(path)
    sequence = try_all("KITTI orders", lambda: kitti.load("00", root=root))
    if sequence is not None:
        check_sequence(sequence)
    shutil.rmtree(root)


@pytest.fixture(scope="module")
def raw_drive(tmp_path_factory):
    """A tiny drive in KITTI raw's layout, one frame of it as text, and its files."""
    root = tmp_path_factory.mktemp("kitti_raw")
    make_kitti_raw(root, frames=2)
    make_kitti_raw(root, "2011_09_28_drive_0002_sync", frames=2)
    for path in root.glob("2011_09_28/*/velodyne_points/data/*.bin"):
        np.savetxt(path.with_suffix(".txt"), np.fromfile(path, "<f4").reshape(-1, 4)[::40], fmt="%.3f")
        path.unlink()
    return root, {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@given(data=st.data())
def test_kitti_raw_drives(raw_drive, data):
    root, files = raw_drive
    name = data.draw(st.sampled_from(sorted(files)))
    drive = next((root / name.parts[0]).glob("*_drive_*"))
    (root / name).write_bytes(data.draw(damaged(files[name]) | st.binary(max_size=200) | any_points))
    try:
        recording = try_all("KITTI raw drives", lambda: kitti_raw.load(drive.name, root=root))
        if recording is not None:
            check_sequence(recording)
        stream = try_all("KITTI raw streams", lambda: kitti_raw.stream(drive))
        for scan in (try_all("KITTI raw streams", lambda: list(stream.scans)) or []) if stream else []:
            check_scan(*beams(scan))
    finally:
        (root / name).write_bytes(files[name])


@given(data=st.data())
def test_trajectories(recording, data):
    root, files = recording
    [name] = [name for name in files if name.parts[0] == "poses"]
    path = root / "trajectory.txt"
    path.write_bytes(data.draw(damaged(files[name]) | st.binary(max_size=300)))
    poses = try_all("KITTI trajectories", read_kitti, path)
    if poses is not None:
        assert np.isfinite(poses).all()


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
json_scans = st.fixed_dictionaries(
    {},
    optional={
        "ranges": st.lists(any_float | st.none(), max_size=12) | json_values,
        "points": st.lists(st.lists(any_float, min_size=2, max_size=3), max_size=6) | json_values,
        "stamp": any_float | json_values,
        "angle_min": any_float | json_values,
        "angle_increment": any_float | json_values,
        "angle_max": any_float | json_values,
        "time_increment": any_float | json_values,
        "range_min": any_float | json_values,
        "range_max": any_float | json_values,
        "header": st.fixed_dictionaries(
            {},
            optional={
                "stamp": json_values
                | st.dictionaries(st.sampled_from(["sec", "secs", "nsecs", "nanosec"]), json_values),
                "frame_id": json_values,
            },
        )
        | json_values,
    },
)
json_scans = (
    json_scans
    | st.fixed_dictionaries(
        {"op": st.sampled_from(["publish", "status"]) | json_values, "msg": json_scans},
        optional={"topic": st.sampled_from(["/scan", "/b"]) | json_values},
    )
).map(json.dumps)
GOOD_LINE = json.dumps({"ranges": [1.5, None, 2.25], "angle_min": -1.0, "angle_increment": 0.5, "stamp": 3})

LASER_SCAN = json.dumps(
    {
        "op": "publish",
        "topic": "/scan",
        "msg": {
            "header": {"stamp": {"secs": 1, "nsecs": 5}, "frame_id": "laser"},
            **{"angle_min": -1.0, "angle_max": 1.0, "angle_increment": 1.0, "time_increment": 0.001},
            **{"range_min": 0.1, "range_max": 30.0, "ranges": [1.5, None, 2.25]},
        },
    }
)


@given(data=st.data())
def test_files_of_json_lines(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "scans.jsonl"
    lines = "\n".join([GOOD_LINE, LASER_SCAN] * 2).encode()
    pack = data.draw(st.sampled_from([bytes, *PACKINGS.values()]))
    path.write_bytes(data.draw(damaged(pack(lines)) | damaged(lines).map(pack)))
    if try_all("files of JSON lines", json_lines.recognises, path):
        scans = try_all("files of JSON lines", lambda: list(json_lines.stream(path).scans))
        for scan in scans or []:
            check_scan(*beams(scan) if scan.bearings is not None else (0 * scan.ranges, scan.ranges))


@given(
    json_scans
    | st.text(max_size=80)
    | st.lists(json_scans, max_size=5).map("\n".join)
    | st.sampled_from([GOOD_LINE, LASER_SCAN])
    .flatmap(lambda line: damaged(line.encode()))
    .map(lambda content: content.decode(errors="replace")),
    st.none() | st.sampled_from(["/scan", "b", ""]),
)
def test_json_lines(line, topic):
    stream = json_lines.stream_lines(line.split("\n"), topic=topic)
    scans = try_all("JSON lines", lambda: list(stream.scans)) or []
    assert len(scans) + stream.skipped.total() == sum(
        bool(part.lstrip("\ufeff").strip()) for part in line.split("\n")
    )
    for scan in scans:
        bearings = np.zeros(len(scan.ranges)) if scan.bearings is None else scan.bearings
        check_scan(bearings, scan.ranges)


def test_an_undamaged_log_and_recording_are_read(log, recording, raw_drive, tmp_path):
    """The tests above would also pass where every file is refused."""
    folder, contents = log
    for kind in contents:
        check_sequence(carmen.load(kind, root=folder))
    root, _ = recording
    shutil.copytree(root, tmp_path / "copy")
    check_sequence(kitti.load("00", root=tmp_path / "copy"))
    for drive in raw_drive[0].glob("*/*_drive_*"):
        check_sequence(kitti_raw.load(drive.name, root=raw_drive[0]))
    for line in (GOOD_LINE, LASER_SCAN):
        [scan] = json_lines.stream_lines([line]).scans
        check_scan(*beams(scan))


lasers = st.builds(
    lambda first, spacing, count, turn: np.deg2rad(first + turn * spacing * np.arange(count)),
    st.sampled_from([-180.0, -135.0, -90.0, 0.0, 90.0, 180.0, 270.0]) | st.floats(-400, 400),
    st.sampled_from([0.1, 0.2, 0.25, 0.5, 1.0, 2.0]) | st.floats(0.05, 10),
    st.sampled_from([0, 1, 2, 91, 180, 181, 360, 361, 541, 1081, 1800]) | st.integers(0, 400),
    st.sampled_from([1.0, -1.0]),
)


def mutate_beams(draw, bearings, ranges):
    """A scan whose order, extent or unit is another, as drivers and converters make it."""
    kind = draw(st.sampled_from(["none", "degrees", "centimetres", "shuffled", "half", "doubled", "broken"]))
    if kind == "degrees":
        bearings = np.rad2deg(bearings)
    elif kind == "centimetres":
        ranges = 100 * ranges
    elif kind == "shuffled":
        order = np.random.default_rng(0).permutation(len(bearings))
        bearings, ranges = bearings[order], ranges[order]
    elif kind == "half":
        bearings, ranges = bearings[: len(bearings) // 2], ranges[: len(ranges) // 2]
    elif kind == "doubled":
        bearings = 2 * bearings
    elif kind == "broken" and len(bearings):
        bearings = bearings.copy()
        bearings[draw(st.integers(0, len(bearings) - 1))] = draw(any_float)
    return bearings, ranges


@given(
    data=st.data(),
    bearings=lasers,
    sensor=st.sampled_from(SENSORS),
    facing=st.sampled_from([0.0, 90.0, -30.0]),
)
def test_no_beam_is_dropped_in_silence(data, bearings, sensor, facing):
    """A scan that fits a sensor has, but for rounding at both ends, all its beams in the depth vector."""
    CASES["lasers compared"] += 1
    sensor = replace(sensor, facing_deg=facing)
    bearings, ranges = mutate_beams(data.draw, bearings, np.linspace(4, 6, len(bearings)))
    check, scan = BeamCheck(sensor), Scan(ranges, bearings)
    reason = check(scan)
    assert "\n" not in reason
    if reason:
        check_error(check.refusal("log", "set {}"))
        return
    if not len(ranges) or not (ranges > 0).any():
        return
    spacing = find_beams(bearings).spacing
    aside = np.abs((np.rad2deg(bearings) - facing + 180) % 360 - 180)
    assert (aside <= sensor.field_of_view_deg / 2 + 2 * (spacing + sensor.resolution_deg)).all()
    assert np.median(ranges) <= 100, "in metres"
    filled = np.count_nonzero(sensor.encode(scan)) / sensor.bins
    assert filled > 0.4, "beams at most two bins apart, on nine tenths of the sensor"


stamps = st.lists(
    st.none()
    | st.floats(0.05, 0.2).map(lambda step: ("after", step))
    | st.sampled_from([("after", 0.0), ("after", -0.05), ("after", 5.0), ("after", 1.7e9), ("at", 0.0)])
    | any_float.map(lambda stamp: ("at", stamp)),
    min_size=1,
    max_size=60,
)


class Straight:
    """A stepper that always says one metre."""

    description = Description(Sensor(1.0, 180.0, 40.0), (1.0, 0.1, 0.1), 0.0, 0.1)

    def __call__(self, pair):
        return Step(1.0, 0.0, 0.0, np.zeros((3, 3)))

    def reset(self):
        pass


@given(data=st.data(), moves=stamps)
def test_no_clock_makes_the_odometer_run_away(data, moves):
    """Whatever the stamps and frames: no error, ten held metres a gap at most, none over a set clock."""
    CASES["clocks"] += 1
    odometer, stamp, before = Odometer(PairTracker(Straight())), 1.0, 0.0
    for move in moves:
        kind, value = move or ("none", 0.0)
        stamp = stamp + value if kind == "after" else value if kind == "at" else stamp
        frame = data.draw(st.sampled_from(["laser", "laser", "laser", "rear", ""]))
        pose = odometer.step(Scan(np.full(181, 5.0), ANGLES, None, stamp if move else None, frame))
        moved = pose.x - before
        if pose.degraded.startswith(("late scan", "other frame", "clock set", "new frame")):
            assert moved == 0
        elif not pose.degraded:
            assert moved in (0, pytest.approx(1.0))
        assert 0 <= moved <= LONGEST_HOLD + 1e-6
        before = pose.x
        json.dumps(pose.as_dict(), allow_nan=True)


BAG_RANGES = np.random.default_rng(0).uniform(1, 9, (6, 9))
BAG_CLOUD = {name: np.array(values, "<f4") for name, values in zip("xyz", np.eye(3), strict=True)}
BAG_CLOUD["ring"] = np.array([0, 0, 1], "<u2")


def cloud_bytes(**changes):
    store = store_of("mcap")
    return bytes(store.serialize_cdr(point_cloud(store, BAG_CLOUD, 5.0, False, **changes), CLOUD))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A folder with a tiny bag of each kind."""
    folder = tmp_path_factory.mktemp("bags")
    sqlite = next(make_bag(folder, "sqlite3", BAG_RANGES).glob("*.db3"))
    lasers = [scan_bytes(row, ros1=True) for row in BAG_RANGES]
    ros1 = (
        [(b"/scan", b"sensor_msgs/LaserScan", b"x"), (b"/words", b"std_msgs/String", b"y")],
        [(0, 10**9 * number, laser) for number, laser in enumerate(lasers)],
    )
    channels = {"/scan": (SCAN, "ros2msg", b"x", "cdr"), "/words": ("std_msgs/msg/String", "", b"", "cdr")}
    messages = [("/scan", 10**9 * number, scan_bytes(row)) for number, row in enumerate(BAG_RANGES)]
    clouds = {"/points": (CLOUD, "ros2msg", b"x", "cdr")}, [("/points", 1, cloud_bytes())] * 3
    paths = {
        "sqlite3": sqlite,
        "ros1": write_ros1(folder / "a.bag", *ros1),
        "ros1 not closed": write_ros1(folder / "b.bag", *ros1, index=False),
        "mcap": write_mcap(folder / "a.mcap", channels, messages, chunk_size=300, enable_crcs=False),
        "mcap without chunks": write_mcap(folder / "b.mcap", channels, messages, use_chunking=False),
        "mcap of clouds": write_mcap(folder / "c.mcap", *clouds, use_chunking=False),
    }
    for kind, path in paths.items():
        path.rename(folder / kind)
    return folder


def stream_bag(path, **options):
    """The scans of a bag, those before it breaks off; None where it is refused."""
    stream = try_all("bags", lambda: rosbag.stream(path, **options))
    scans = []
    if stream is not None:
        try_all("bags read", lambda: scans.extend(stream.scans))
        for scan in scans:
            check_scan(scan.bearings, scan.ranges)
    return scans


def test_undamaged_bags_are_read(bags):
    for kind in BAG_KINDS:
        scans = stream_bag(bags / kind, height=(-2.0, 2.0) if "clouds" in kind else None)
        assert len(scans) == (3 if "clouds" in kind else 6), kind


BAG_KINDS = ("sqlite3", "ros1", "ros1 not closed", "mcap", "mcap without chunks", "mcap of clouds")


@given(data=st.data(), kind=st.sampled_from(BAG_KINDS))
def test_bags(bags, data, kind):
    path = bags / "damaged.bag"
    path.write_bytes(data.draw(damaged((bags / kind).read_bytes())))
    heights = st.none() | st.just((-2.0, 2.0)) if "clouds" in kind else st.none()
    stream_bag(path, height=data.draw(heights))


@given(
    names=st.lists(st.sampled_from(["x", "y", "z", "ring", "channel", "\u00e9", ""]), max_size=6),
    numbers=st.lists(st.sampled_from([0, 1, 2, 3, 4, 7, 8, 9, 14, 42, 255, 2**31, 2**32 - 1]), min_size=6),
    cloud=st.binary(max_size=80),
    big_endian=st.booleans(),
    ring=st.none() | st.integers(0, 3),
)
def test_point_clouds(bags, names, numbers, cloud, big_endian, ring):
    field = store_of("mcap").types["sensor_msgs/msg/PointField"]
    fields = [
        field(name, numbers[at % len(numbers)], numbers[-1 - at % len(numbers)] % 256, 1)
        for at, name in enumerate(["x", "y", "z", *names])
    ]
    sizes = dict(zip(("height", "width", "point_step", "row_step"), numbers[2:], strict=False))
    sizes |= {"data": np.frombuffer(cloud, np.uint8), "is_bigendian": big_endian}
    content = cloud_bytes(fields=fields, **sizes)
    channels = {"/points": (CLOUD, "", b"", "cdr")}
    path = write_mcap(bags / "clouds.mcap", channels, [("/points", 1, content)], use_chunking=False)
    stream_bag(path, ring=ring)


@given(
    points=st.lists(st.tuples(any_float, any_float, any_float, st.integers(0, 3)), max_size=40),
    columns=st.sampled_from([None, 1, 2]),
    with_ring=st.booleans(),
    ring=st.none() | st.integers(0, 3),
)
def test_points_of_clouds(bags, points, columns, with_ring, ring):
    if columns == 2:
        points = points[: len(points) // 2 * 2]
    values = np.array(points, "<f8").reshape(-1, 4).T
    fields = dict(zip("xyz", values, strict=False)) | ({"ring": values[3].astype("u1")} if with_ring else {})
    store = store_of("mcap")
    content = bytes(store.serialize_cdr(point_cloud(store, fields, 5.0, False, columns=columns), CLOUD))
    channels = {"/points": (CLOUD, "", b"", "cdr")}
    path = write_mcap(bags / "points.mcap", channels, [("/points", 1, content)] * 2, use_chunking=False)
    stream_bag(path, ring=ring)


METADATA = b"rosbag2_bagfile_information: {relative_file_paths: [a.mcap]}"


@given(metadata=st.binary(max_size=60) | damaged(METADATA))
def test_metadata_of_bags(bags, metadata):
    bag = bags / "folder"
    bag.mkdir(exist_ok=True)
    (bag / "a.mcap").write_bytes((bags / "mcap").read_bytes())
    (bag / "metadata.yaml").write_bytes(metadata)
    assert len(stream_bag(bag)) in (0, 6)


@given(data=st.data(), kind=st.sampled_from(["mcap", "sqlite3"]), place=st.integers(0, 2))
def test_bags_of_several_files(bags, data, kind, place):
    """Whatever becomes of one file, the others are read."""
    bag, content = bags / f"split {kind}", (bags / kind).read_bytes()
    bag.mkdir(exist_ok=True)
    for number in range(3):
        (bag / f"{number}.db3").write_bytes(content)
    (bag / f"{place}.db3").write_bytes(data.draw(damaged(content) | st.binary(max_size=300)))
    scans = stream_bag(bag, topic="/scan")
    assert len(scans) >= 12


def write_mutated(folder, kind, scans, angles, stamps, definition):
    """A recording of scans (N, P), of angles (first, increment) in radians and stamps (N,), and garbage.

    Its path. What the format does not hold, as a definition of messages, is left out.
    """
    first, step = angles
    ends = {"angle_min": first, "angle_increment": step, "angle_max": first + step * (scans.shape[1] - 1)}
    laser = {"range_max": 1e4, **ends}
    if kind == "json":
        lines = [
            {"stamp": stamp, "ranges": row.tolist(), **laser}
            for row, stamp in zip(scans, stamps, strict=True)
        ]
        return write_log(folder / "mutated.jsonl", [json.dumps(line) for line in lines])
    if kind == "ROBOTLASER1":
        head = f"0 {first:.9f} {abs(step) * scans.shape[1]:.9f} {step:.9f} 10000 0.01 0 {scans.shape[1]}"
        pose = "0 0 0 0 0 0 0 0 0.3 0.3 1e6"
        rows = [" ".join(f"{value:.3f}" for value in row) for row in scans]
        lines = [
            f"ROBOTLASER1 {head} {row} 0 {pose} {stamp:.6f} nohost 0"
            for row, stamp in zip(rows, stamps, strict=True)
        ]
        return write_log(folder / "mutated.log", lines)
    is_ros1 = kind == "ros1"
    contents = [
        scan_bytes(row, stamp, ros1=is_ros1, **laser) for row, stamp in zip(scans, stamps, strict=True)
    ]
    arrivals = [10**9 + 10**8 * number for number in range(len(scans))]
    if is_ros1:
        connections = [
            (b"/scan", b"sensor_msgs/LaserScan", definition),
            (b"/x", b"foreign/Type", definition),
        ]
        messages = [(0, *each) for each in zip(arrivals, contents, strict=True)] + [(1, 10**9, definition)]
        return write_ros1(folder / "mutated", connections, messages)
    if kind == "mcap":
        channels = {
            "/scan": (SCAN, "ros2msg", definition, "cdr"),
            "/x": ("foreign/Type", "protobuf", definition, "protobuf"),
        }
        messages = [("/scan", *each) for each in zip(arrivals, contents, strict=True)]
        return write_mcap(folder / "mutated", channels, [*messages, ("/x", 10**9, definition)])
    return write_sqlite(folder / "mutated", contents, arrivals, definition)


def write_sqlite(path, contents, arrivals, definition):
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE message_definitions(topic_type TEXT, encoded_message_definition TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        topics = [(1, "/scan", SCAN, "cdr"), (2, "/x", definition, "protobuf")]
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", topics)
        database.execute("INSERT INTO message_definitions VALUES (?, ?)", (SCAN, definition))
        rows = [(n, 1, *each) for n, each in enumerate(zip(arrivals, contents, strict=True))]
        database.executemany(
            "INSERT INTO messages VALUES (?, ?, ?, ?)", [*rows, (99, 2, arrivals[0], definition)]
        )
    return path


@given(
    data=st.data(),
    kind=st.sampled_from(["ros1", "sqlite3", "mcap", "json", "ROBOTLASER1"]),
    mutation=st.sampled_from(["none", "clockwise", "half", "left", "degrees", "centimetres"]),
    definition=st.binary(max_size=60),
    jump=st.sampled_from([0.0, 3.0, 11.0, 3600.0, -11.0, -1e6]),
    at=st.integers(1, 7),
)
def test_mutations_through_every_reader(logs_folder, data, kind, mutation, definition, jump, at):
    """Order, extent, unit and clock of scans, and foreign definitions, as they come out of each reader."""
    CASES["mutated recordings"] += 1
    scans, (first, step) = np.tile(np.linspace(2, 9, 181), (8, 1)), np.deg2rad([-90.0, 1.0])
    if mutation == "clockwise":
        first, step = -first, -step
    elif mutation == "half":
        scans = scans[:, :91]
    elif mutation == "left":
        first = 0.0
    elif mutation == "degrees":
        first, step = -90.0, 1.0
    elif mutation == "centimetres":
        scans = 100 * scans
    stamps = 2e6 + 0.1 * np.arange(8) + jump * (np.arange(8) >= at)
    path = write_mutated(logs_folder, kind, scans, (first, step), stamps.tolist(), definition)
    stream = try_all("mutated recordings opened", open_stream, path)
    assert stream is not None
    odometer, poses = Odometer(PairTracker(Straight())), []
    try:
        for scan in stream.scans:
            poses.append(odometer.step(scan if stream.has_clock else replace(scan, stamp=None)))
    except InputError as error:
        check_error(error)
        assert (kind, mutation) == ("ROBOTLASER1", "degrees"), "of the other readers nothing is refused"
        return
    assert len(poses) == 8, "no scan is lost, whatever else the recording holds"
    fits = mutation in ("none", "clockwise")
    assert all(("other laser" in pose.degraded) != fits for pose in poses)
    jumps = fits and stream.has_clock and abs(jump) > 10
    assert ("clock set" in poses[at].degraded) == (stream.has_clock and abs(jump) > 10)
    assert odometer.estimates == (0 if not fits else 6 if jumps or (stream.has_clock and jump == 3.0) else 7)
    if jumps:
        assert poses[at].x == poses[at - 1].x


@pytest.fixture(scope="module")
def logs_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("mutated")
