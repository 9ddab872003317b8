"""Recordings read scan by scan: KITTI folders and CARMEN logs."""

import gzip
import shutil
from collections import deque

import numpy as np
import pytest

from conftest import SHARED
from data.make_carmen import make_carmen
from data.make_kitti import LEVEL_RING, make_kitti
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses
from rcnn_odom.recordings import carmen, kitti
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.stream import thin
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
        np.testing.assert_array_equal(scan.times, sequence.read_scan(frame).times)
        assert not scan.has_all_beams
    assert stream.is_compensated
    assert sequence.is_compensated
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
        assert scan.wheel_pose == sequence.read_scan(frame).wheel_pose
        [wheels] = planar_to_poses([scan.wheel_pose])
        np.testing.assert_allclose(wheels, sequence.wheel_odometry[frame], atol=1e-9)
    assert not sequence.has_clock
    assert not sequence.is_compensated


@pytest.mark.parametrize(("every", "frames"), [(1, range(8)), (3, [0, 3, 6]), (7, [0, 7]), (50, [0])])
def test_every_so_many_scans_of_a_stream(tmp_path, every, frames):
    make_kitti(tmp_path, ["05"], frames=8)
    scans = read(tmp_path / "sequences" / "05")[1]
    thinned = thin(open_stream(tmp_path / "sequences" / "05"), every)
    assert thinned.total == len(frames)
    assert [scan.stamp for scan in thinned.scans] == [scans[frame].stamp for frame in frames]
    make_carmen(tmp_path, "robot", frames=8)
    unknown = thin(open_stream(tmp_path / "robot.log"), every)
    assert (unknown.total, len(list(unknown.scans)), unknown.has_clock) == (None, len(frames), False)


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
    with pytest.raises(InputError, match=r"empty\.gz: is empty"):
        read(tmp_path / "empty.gz")
    with pytest.raises(InputError, match="neither a KITTI sequence"):
        open_stream(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        open_stream(tmp_path / "none")


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
