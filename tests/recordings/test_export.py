"""Simulated sequences in KITTI's layout: read back the same, complete or absent."""

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import motions_of, planar_to_poses, relative_steps
from rcnn_odom.recordings import kitti
from rcnn_odom.recordings.kitti_writer import export_kitti
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.trajectory import read_kitti
from rcnn_odom.recordings.workers import CHUNK

FRAMES = CHUNK + 5
EMPTY = 7
"""A frame in which nothing came back; not one of those of which `kitti.load` takes the elevation."""


@dataclass(frozen=True)
class Reader:
    """Uneven azimuths and random ranges, in the order of the simulator's."""

    broken: int = -1
    killing: int = -1
    slow: float = 0.0

    def points(self, frame):
        if frame == self.killing:
            os.kill(os.getpid(), signal.SIGKILL)
        if frame == self.broken:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        time.sleep(self.slow)
        rng = np.random.default_rng(frame)
        azimuth = np.sort(rng.uniform(0, 2 * np.pi, 0 if frame == EMPTY else rng.integers(1, 50)))
        ranges = rng.uniform(0.5, 80, len(azimuth))
        height = 0.02 * ranges * np.sin(azimuth)
        columns = [ranges * np.cos(azimuth), ranges * np.sin(azimuth), height, np.zeros_like(ranges)]
        return np.stack(columns, axis=1).astype(np.float32)

    def __call__(self, frame):
        return Scan.from_points(self.points(frame))


def make_sequence(name="00", frames=FRAMES, **options):
    """A climbing, pitching drive that begins far from the origin of its world."""
    time = np.arange(frames)
    poses = planar_to_poses(np.stack([1500 + time, -900 + 3 * np.sin(time / 9), 1.0 + time / 50], axis=1))
    poses[:, 2, 3] = 0.03 * time
    pitch = np.tile(np.eye(4), (frames, 1, 1))
    pitch[:, 0, 0] = pitch[:, 2, 2] = np.cos(0.02 * np.sin(time))
    pitch[:, 0, 2] = np.sin(0.02 * np.sin(time))
    pitch[:, 2, 0] = -pitch[:, 0, 2]
    return Recording(name, poses @ pitch, 0.1 * time, Reader(**options), "print")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("out") / "deep" / "kitti"
    export_kitti(make_sequence(), root)
    return root


def everything_in(root):
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


def test_read_back_the_same(written):
    made, read = make_sequence(), kitti.load("00", root=written)
    np.testing.assert_array_equal(read.camera_from_laser, made.camera_from_laser)
    np.testing.assert_allclose(read.stamps, made.stamps, atol=1e-6)
    np.testing.assert_allclose(
        motions_of(relative_steps(read.poses)), motions_of(relative_steps(made.poses)), atol=1e-9
    )
    assert "ring 0 " in read.notes[1]
    for frame in range(FRAMES):
        ours, theirs = made.read_scan(frame), read.read_scan(frame)
        np.testing.assert_array_equal(theirs.bearings, ours.bearings)
        np.testing.assert_array_equal(theirs.ranges, ours.ranges)


def test_layout_is_that_of_kitti(written):
    names = [f"sequences/00/velodyne/{frame:06d}.bin" for frame in range(FRAMES)]
    texts = ["poses/00.txt", "sequences/00/calib.txt", "sequences/00/times.txt"]
    assert everything_in(written) == sorted(names + texts)
    points = np.fromfile(written / "sequences/00/velodyne/000003.bin", dtype="<f4").reshape(-1, 4)
    np.testing.assert_array_equal(points, Reader().points(3))
    rows = [line.split() for line in (written / "sequences/00/calib.txt").read_text().splitlines()]
    assert [row[0] for row in rows] == ["P0:", "P1:", "P2:", "P3:", "Tr:"]
    assert all(len(row) == 13 for row in rows)
    assert (written / "sequences/00/times.txt").read_text().splitlines()[12] == "1.200000e+00"


def test_poses_are_the_cameras_from_the_first(written):
    camera = read_kitti(written / "poses" / "00.txt")
    np.testing.assert_allclose(camera[0], np.eye(4), atol=1e-12)
    laser = make_sequence().poses
    # Laser x forward, y left, z up: camera z, -x, -y.
    step = (np.linalg.inv(laser[0]) @ laser[5])[:3, 3]
    np.testing.assert_allclose(camera[5, :3, 3], [-step[1], -step[2], step[0]], atol=1e-9)


def test_a_frame_without_a_return_is_one_point_that_is_not_finite(written):
    points = np.fromfile(written / f"sequences/00/velodyne/{EMPTY:06d}.bin", dtype="<f4")
    np.testing.assert_array_equal(points, [np.nan, np.nan, np.nan, 0])


def test_does_not_overwrite(written):
    with pytest.raises(InputError, match=r"sequences/00: is there already; remove it"):
        export_kitti(make_sequence(broken=0), written)


def test_does_not_overwrite_poses(tmp_path):
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "00.txt").write_text("mine")
    with pytest.raises(InputError, match=r"poses/00.txt: is there already"):
        export_kitti(make_sequence(), tmp_path)
    assert everything_in(tmp_path) == ["poses/00.txt"]


def test_a_full_disk_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r"sequence 00 cannot be written \(No space left on device\)"):
        export_kitti(make_sequence(broken=FRAMES - 1), tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["poses", "sequences"]


def test_killed_worker_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r"was killed.*; free some and write sequence 00 again"):
        export_kitti(make_sequence(killing=FRAMES - 1), tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["poses", "sequences"]


@pytest.mark.parametrize("name", ["a/b", "", ".", "..", ".hidden", "/tmp", "a/"])
def test_a_name_is_that_of_a_folder(tmp_path, name):
    with pytest.raises(InputError, match="must be the name of a folder"):
        export_kitti(make_sequence(name), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_out_is_a_file(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: sequence 00 cannot be written \(Not a directory\)"):
        export_kitti(make_sequence(), tmp_path / "file")


def test_ctrl_c_leaves_nothing(tmp_path):
    # A job in a shell's background inherits a deaf ear for Ctrl-C.
    code = f"""
import signal, sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_export import export_kitti, make_sequence
export_kitti(make_sequence(frames=3000, slow=0.01), Path({str(tmp_path)!r}))
"""
    process = subprocess.Popen([sys.executable, "-c", code], start_new_session=True, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 30
    while not any(tmp_path.rglob("*.bin")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=10)
    assert process.returncode != 0
    assert stderr.count(b"KeyboardInterrupt") == 1  # the parent's; a worker is silent
    assert everything_in(tmp_path) == []
