"""Readers and encoder under random input: a clear error or a valid result, nothing else.

``make fuzz`` runs ten thousand cases and more.
"""

import bz2
import gzip
import json
import shutil
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data.make_carmen import make_carmen
from data.make_kitti import make_kitti
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings import carmen, json_lines, kitti
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


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A folder with a tiny log of each kind; their lines."""
    folder = tmp_path_factory.mktemp("logs")
    contents = {}
    for fmt in ("FLASER", "ROBOTLASER1"):
        make_carmen(folder, fmt, frames=4, beams=9, fmt=fmt)
        contents[fmt] = (folder / f"{fmt}.log").read_bytes()
    return folder, contents


@given(data=st.data(), kind=st.sampled_from(["FLASER", "ROBOTLASER1", "bytes"]))
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


@given(data=st.data(), pack=st.sampled_from([(gzip.compress, "gz"), (bz2.compress, "bz2")]))
def test_packed_carmen_logs(log, data, pack):
    folder, contents = log
    compress, suffix = pack
    path = folder / f"packed.log.{suffix}"
    path.write_bytes(data.draw(damaged(compress(contents["FLASER"]))))
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
    },
).map(json.dumps)
GOOD_LINE = json.dumps({"ranges": [1.5, None, 2.25], "angle_min": -1.0, "angle_increment": 0.5, "stamp": 3})


@given(
    json_scans | st.text(max_size=80) | damaged(GOOD_LINE.encode()).map(lambda b: b.decode(errors="replace"))
)
def test_json_lines(line):
    CASES["JSON lines"] += 1
    stream = json_lines.stream(line.split("\n"))
    scans = list(stream.scans)
    assert len(scans) + stream.skipped.total() == sum(bool(part.strip()) for part in line.split("\n"))
    for scan in scans:
        bearings = np.zeros(len(scan.ranges)) if scan.bearings is None else scan.bearings
        check_scan(bearings, scan.ranges)


def test_an_undamaged_log_and_recording_are_read(log, recording, tmp_path):
    """The tests above would also pass where every file is refused."""
    folder, contents = log
    for kind in contents:
        check_sequence(carmen.load(kind, root=folder))
    root, _ = recording
    shutil.copytree(root, tmp_path / "copy")
    check_sequence(kitti.load("00", root=tmp_path / "copy"))
    [scan] = json_lines.stream([GOOD_LINE]).scans
    check_scan(*beams(scan))
