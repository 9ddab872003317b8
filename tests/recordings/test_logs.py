"""Recordings of any format that streams, opened to train on, and their truth from trajectory files."""

import pickle

import numpy as np
import pytest

from data.make_bag import make_bag
from data.make_carmen import make_carmen
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, change_frame, planar_to_poses, relative_steps
from rcnn_odom.recordings import carmen, logs
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.parts import cut, trusted_pieces
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.reference import find_trajectory, in_laser_frame, strip_endings
from rcnn_odom.recordings.trajectory import write_kitti, write_tum

PLANAR = np.column_stack([np.linspace(0, 3, 12), np.linspace(0, 0.5, 12), np.linspace(0, 0.4, 12)])


@pytest.fixture
def bag(tmp_path):
    """Twelve scans at 10 Hz of a room that gets smaller."""
    ranges = np.linspace(3.0, 2.0, 12)[:, None] * np.ones(181)
    return make_bag(tmp_path, "ros1", ranges)


def camera(planar):
    return change_frame(planar_to_poses(planar), FORWARD_CAMERA)


def stamps_of(path):
    return np.array([scan.stamp for scan in open_stream(path).scans])


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_scans_are_those_of_the_stream(tmp_path, kind):
    path = make_bag(tmp_path, kind, np.random.default_rng(0).uniform(1, 5, (7, 181)))
    recording = logs.load(path.name, root=tmp_path, reference="matcher")
    expected = list(open_stream(path).scans)
    assert len(recording) == len(expected) == 7
    for frame, scan in enumerate(expected):
        np.testing.assert_array_equal(recording.read_scan(frame).ranges, scan.ranges)
        np.testing.assert_array_equal(recording.read_scan(frame).bearings, scan.bearings)
        assert recording.stamps[frame] == scan.stamp
    assert recording.has_clock
    assert np.isnan(recording.poses).all()
    assert recording.read_scan(5).bearings is recording.read_scan(4).bearings, "kept once"
    again = pickle.loads(pickle.dumps(recording.read_scan))
    np.testing.assert_array_equal(again(3).ranges, expected[3].ranges)


def test_a_carmen_log_has_the_scans_of_the_reader_for_carmen(tmp_path):
    make_carmen(tmp_path, "robot", frames=20, compress="gz")
    recording = logs.load("robot.log.gz", root=tmp_path, reference="matcher")
    other = carmen.load("robot", root=tmp_path, reference="matcher")
    assert not recording.has_clock
    assert np.isnan(other.poses).all()
    np.testing.assert_allclose(recording.wheel_odometry, other.wheel_odometry, atol=1e-12)
    for frame in range(20):
        np.testing.assert_array_equal(recording.read_scan(frame).ranges, other.read_scan(frame).ranges)


def test_names_are_relative_to_the_root_or_absolute(tmp_path, bag, monkeypatch):
    assert len(logs.load(str(bag), root="elsewhere", reference="matcher")) == 12
    monkeypatch.setenv("HOME", str(tmp_path))
    assert len(logs.load(f"~/{bag.name}", root="elsewhere", reference="matcher")) == 12
    with pytest.raises(InputError, match="no such file"):
        logs.load("missing.bag", root=tmp_path, reference="matcher")


def test_the_fingerprint_changes_with_a_scan(tmp_path):
    ranges = np.full((3, 181), 2.0)
    prints = set()
    for number in range(3):
        ranges[-1, number] += number  # once without a change
        folder = tmp_path / str(number)
        folder.mkdir()
        path = make_bag(folder, "ros1", ranges)
        prints.add(logs.load(path.name, root=folder, reference="matcher").fingerprint)
    assert len(prints) == 3
    assert logs.load(path.name, root=folder, reference="matcher").fingerprint in prints


def test_without_a_reference_it_is_refused_with_both_ways_out(tmp_path, bag):
    with pytest.raises(
        InputError, match=r"data\.reference=matcher.*data\.reference=FOLDER.*log\.tum"
    ) as told:
        logs.load(bag.name, root=tmp_path)
    assert "\n" not in str(told.value)


# --- trajectories --------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["log.tum", "log.bag.tum", "log/trajectory.tum"])
def test_poses_are_found_by_their_stamps(tmp_path, bag, place):
    path = tmp_path / "poses" / place
    path.parent.mkdir(parents=True)
    # Without the third and the last scan: between two poses, and after all of them.
    kept = [0, 1, 3, 4, 5, 6, 7, 8, 9, 10]
    write_tum(path, stamps_of(bag)[kept], camera(PLANAR[kept]))
    recording = logs.load(bag.name, root=tmp_path, reference=tmp_path / "poses")
    np.testing.assert_allclose(recording.poses[:11], planar_to_poses(PLANAR[:11]), atol=1e-6)
    assert np.isnan(recording.poses[11]).all()
    assert "truth: " + place.split("/")[-1] + ", in the camera's frame" in recording.notes
    assert "1 scans without truth" in recording.notes
    drive = cut({recording.name: Drive.unencoded(recording)}, recording.name)
    assert len(drive) == 11


def test_a_line_for_each_scan_needs_no_stamps(tmp_path, bag):
    write_kitti(tmp_path / "log.txt", camera(PLANAR))
    recording = logs.load(bag.name, root=tmp_path, reference=tmp_path)
    np.testing.assert_allclose(relative_steps(recording.poses), relative_steps(planar_to_poses(PLANAR)))
    write_kitti(tmp_path / "log.txt", camera(PLANAR[:-1]))
    with pytest.raises(InputError, match="11 poses, but the recording has 12 scans"):
        logs.load(bag.name, root=tmp_path, reference=tmp_path)


def test_a_trajectory_of_another_time_or_none_is_refused(tmp_path, bag):
    with pytest.raises(InputError, match=r"no trajectory of log\.bag in it; put log\.tum"):
        logs.load(bag.name, root=tmp_path, reference=tmp_path)
    write_tum(tmp_path / "log.tum", np.arange(12.0), camera(PLANAR))
    with pytest.raises(InputError, match="no poses near the stamps"):
        logs.load(bag.name, root=tmp_path, reference=tmp_path)


@pytest.mark.parametrize(
    "planar",
    [
        PLANAR,
        PLANAR * [1, 0, 0],  # straight ahead
        PLANAR * [0, 0, 1],  # on the spot
        PLANAR + np.array([5, -2, 2.0]),  # from elsewhere
    ],
)
def test_the_frame_of_a_trajectory_is_told_from_how_it_turns(planar):
    poses = planar_to_poses(planar)
    for given in (poses, change_frame(poses, FORWARD_CAMERA)):
        found, _ = in_laser_frame(given, FORWARD_CAMERA)
        np.testing.assert_allclose(relative_steps(found), relative_steps(poses), atol=1e-12)


def test_names_of_trajectories(tmp_path):
    assert strip_endings("a/b.c.mcap.zstd") == "b.c"
    assert strip_endings("folder") == "folder"
    for name in ("a_b.bag.txt", "b.tum"):
        (tmp_path / name).touch()
    assert find_trajectory(tmp_path, "a/b.bag", has_clock=True).name == "a_b.bag.txt"
    assert find_trajectory(tmp_path, "c/b.bag", has_clock=True).name == "b.tum"
    (tmp_path / "b.txt").touch()
    assert find_trajectory(tmp_path, "c/b.bag", has_clock=False).name == "b.txt"


# --- pieces that can be trusted ------------------------------------------------------------------


def drive_of(trusted):
    count = len(trusted)
    return Drive(
        name="a",
        key="a",
        scans=np.zeros((count, 3), np.float32),
        poses=planar_to_poses(np.zeros((count, 3))),
        stamps=np.arange(float(count)),
        camera_from_laser=FORWARD_CAMERA,
        trusted=np.array(trusted),
    )


def test_a_drive_falls_to_pieces_at_doubted_steps(caplog):
    caplog.set_level("INFO")
    drive = drive_of([True] * 5 + [False] + [True] * 3 + [False, False] + [True] * 4)
    pieces = trusted_pieces(drive, 2)
    assert [(piece.name, len(piece)) for piece in pieces] == [("a:0-4", 5), ("a:5-8", 4), ("a:10-14", 5)]
    assert "a: 14 of 15 scans to train on, in 3 pieces" in caplog.text
    assert [piece.name for piece in trusted_pieces(drive.part(3, 12), 2)] == ["a:3-4", "a:5-8", "a:10-11"]
    with pytest.raises(InputError, match="no 6 scans in a row are without a doubtful true step"):
        trusted_pieces(drive, 6)
    sure = drive_of([False, True, True])  # there is no step to the first scan
    assert trusted_pieces(sure, 2) == [sure]


@pytest.mark.parametrize("every", [1, 2, 3, 5])
def test_a_thinned_step_is_trusted_if_all_its_parts_are(every):
    trusted = np.random.default_rng(1).random(23) > 0.2
    thinned = drive_of(trusted).thin(every)
    expected = [trusted[max(0, at - every + 1) : at + 1].all() for at in range(0, 23, every)]
    assert thinned.trusted.tolist() == expected
    assert len(thinned.trusted) == len(thinned)
