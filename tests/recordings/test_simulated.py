"""Simulated sequences as their users meet them: names, lengths, options, truth and scans."""

import hashlib
import os
import pickle
import subprocess
import sys
import time
from itertools import chain

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, motions_of, relative_steps
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.simulated import FRAMES, load
from rcnn_odom.recordings.velodyne import ring_starts
from scans import beams

WORLDS = ["street", "indoor"]
NAMES = [f"{number:02d}" for number in range(11)]
SHORT = 30


@pytest.fixture(scope="module")
def streets() -> list[list[FloatArray]]:
    """Points of three frames in each of some streets."""
    drives = [load("00", frames=SHORT, seed=seed) for seed in range(8)]
    return [[drive.read_scan.points(frame) for frame in (0, 15, 29)] for drive in drives]


def digest(sequence: Recording, frame: int) -> str:
    return hashlib.sha256(sequence.read_scan.points(frame).tobytes()).hexdigest()


def in_world(sequence: Recording, frame: int, pose: FloatArray | None = None) -> FloatArray:
    pose = sequence.poses[frame] if pose is None else pose
    return sequence.read_scan.points(frame)[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]


def tilt_deg(sequence: Recording) -> FloatArray:
    """Pitch and roll (N, 2) by SciPy."""
    return Rotation.from_matrix(sequence.poses[:, :3, :3]).as_euler("ZYX", degrees=True)[:, 1:]


# --- the same again, and not the same ------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
def test_scans_are_the_same_in_any_order(world: str) -> None:
    sequence = load("05", frames=SHORT, world=world)
    forwards = [digest(sequence, frame) for frame in range(SHORT)]
    shuffled = np.random.default_rng(0).permutation(SHORT)
    assert [digest(load("05", frames=SHORT, world=world), int(frame)) for frame in shuffled] == [
        forwards[frame] for frame in shuffled
    ]
    assert len(set(forwards)) == SHORT
    assert digest(sequence, -1) == forwards[-1]


def test_scans_are_the_same_in_another_process() -> None:
    here = [load("07", frames=20, world=world) for world in WORLDS]
    script = """
import hashlib, pickle, sys
from rcnn_odom.recordings.simulated import load
read = pickle.loads(sys.stdin.buffer.read())
for world, reader in read.items():
    there = load("07", frames=20, world=world)
    for one in (there.read_scan.points(11), reader.points(11), there.poses):
        print(hashlib.sha256(one.tobytes()).hexdigest())
    print(there.fingerprint)
"""
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    printed = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        input=pickle.dumps(dict(zip(WORLDS, [one.read_scan for one in here], strict=True))),
        capture_output=True,
        check=True,
    ).stdout
    expected = []
    for one in here:
        poses = hashlib.sha256(one.poses.tobytes()).hexdigest()
        expected += [digest(one, 11), digest(one, 11), poses, one.fingerprint]
    assert printed.decode().split() == expected


def test_reader_that_travels_to_a_worker_is_small() -> None:
    sequence = load("00", scale="full")
    sequence.read_scan(0)
    assert len(pickle.dumps(sequence.read_scan)) < 2000


def test_names_seeds_and_worlds_are_different() -> None:
    options = [
        {"name": "05"},
        {"name": "07"},
        {"name": "05~1"},
        {"name": "05~2"},
        {"name": "garden"},
        {"name": "05", "seed": 1},
        {"name": "05", "world": "indoor"},
    ]
    sequences = [load(frames=10, **one) for one in options]
    assert len({sequence.poses.tobytes() for sequence in sequences}) == len(options)
    assert len({digest(sequence, 3) for sequence in sequences}) == len(options)
    assert len({sequence.fingerprint for sequence in sequences}) == len(options)


@pytest.mark.parametrize("world", WORLDS)
def test_fingerprint_changes_with_whatever_changes_scans(world: str) -> None:
    shows = [{"seed": 1}, {"missing": False}, {"sensor": Sensor(0.5, 180.0, 20.0).as_dict()}]
    shows += [{"movers": False}, {"tilt": False}] if world == "street" else []
    plain = load("05", world=world, frames=SHORT)
    for one in shows:
        other = load("05", world=world, frames=SHORT, **one)
        assert other.fingerprint != plain.fingerprint, one
        assert any(digest(other, frame) != digest(plain, frame) for frame in (0, 9, 29)), one
    for one in ({"movers": False}, {"frames": SHORT + 1}):  # it may be that nobody walks in sight
        assert load("05", world=world, **{"frames": SHORT, **one}).fingerprint != plain.fingerprint
    assert load("05", world=world, frames=SHORT).fingerprint == plain.fingerprint


def test_sensor_is_given_whole_or_in_part_or_not_at_all() -> None:
    for one in (
        {},
        {"resolution_deg": 0.1, "field_of_view_deg": 360.0, "max_range": 80.0},
        Sensor().as_dict(),
    ):
        assert load("05", frames=9, sensor=one).fingerprint == load("05", frames=9).fingerprint
    assert np.hypot(*load("05", frames=9, sensor={"max_range": 20.0}).read_scan.points(3)[:, :2].T).max() < 20
    angles, _ = beams(load("05", frames=9, world="indoor", sensor={"field_of_view_deg": 90.0}).read_scan(3))
    assert np.abs(np.rad2deg(angles)).max() < 45.1


# --- names and lengths ---------------------------------------------------------------------------


def test_full_drives_are_as_long_as_kittis() -> None:
    lengths = (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201)
    assert FRAMES["full"] == dict(zip(NAMES, lengths, strict=True))
    for name in ("03", "04", "04~12"):
        assert len(load(name, scale="full")) == FRAMES["full"][name[:2]]


def test_small_drives_are_a_tenth_and_those_that_score_are_long_enough() -> None:
    for name in NAMES:
        if name in ("05", "07", "10"):
            for seed in range(5):
                steps = relative_steps(load(name, seed=seed).poses)
                assert motions_of(steps)[:, 0].sum() >= 400, (name, seed)
        else:
            assert len(load(name)) == FRAMES["small"][name]
            assert abs(FRAMES["small"][name] / FRAMES["full"][name] - 0.1) < 0.01


@pytest.mark.parametrize("world", WORLDS)
def test_fresh_worlds_are_others_of_the_same_length(world: str) -> None:
    drives = [load(name, world=world) for name in ("03", "03~1", "03~2")]
    assert {len(drive) for drive in drives} == {80}
    assert [drive.name for drive in drives] == ["03", "03~1", "03~2"]
    assert len({digest(drive, 0) for drive in drives}) == 3
    assert len(load("03~1", frames=7, world=world)) == 7


def test_only_new_worlds_are_driven_at_other_paces() -> None:
    for name, differs in (("03", False), ("03~1", True)):
        usual, other = load(name, vary_pace=False), load(name)
        assert np.array_equal(usual.poses, other.poses) != differs
        assert (usual.fingerprint == other.fingerprint) != differs
    indoors = [load("03~1", world="indoor", vary_pace=vary) for vary in (True, False)]
    np.testing.assert_array_equal(indoors[0].poses, indoors[1].poses)


def test_loading_is_cheap() -> None:
    load("00", scale="full", seed=90)  # compiles
    took = []
    for seed in range(91, 94):
        start = time.process_time()
        load("02", scale="full", seed=seed)
        took.append(time.process_time() - start)
    assert min(took) < 0.3


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"frames": 1}, "at least 2 frames, not 1; change data.frames"),
        ({"frames": 0}, "at least 2 frames, not 0; change data.frames"),
        ({"frames": -3}, "at least 2 frames"),
        ({"seed": -1}, "0 or more, not -1; change data.world_seed"),
        ({"world": "moon"}, "no world 'moon'"),
        ({"scale": "huge"}, "no scale 'huge'"),
    ],
)
def test_mistakes_are_told_in_one_line(options, says: str) -> None:
    with pytest.raises(InputError, match=f"simulated sequence 05: .*{says}") as caught:
        load("05", **options)
    assert "\n" not in str(caught.value)


def test_frames_outside_the_drive_are_refused() -> None:
    with pytest.raises(IndexError):
        load("05", frames=5).read_scan(5)


# --- truth ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
def test_poses_are_rigid_and_stamps_grow(world: str) -> None:
    sequence = load("05", frames=200, world=world)
    turns = sequence.poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    np.testing.assert_array_equal(sequence.poses[:, 3], np.tile([0, 0, 0, 1], (200, 1)))
    if world == "street":
        np.testing.assert_allclose(sequence.stamps, 0.1 * np.arange(200), atol=1e-12)
    assert np.diff(sequence.stamps).min() > 0
    assert [sequence.read_scan(frame).stamp for frame in (0, 150)] == sequence.stamps[[0, 150]].tolist()
    np.testing.assert_array_equal(sequence.camera_from_laser, FORWARD_CAMERA)


def test_robots_have_the_stamps_of_their_own_lasers() -> None:
    """A car's laser turns 10 times a second, each robot's scans 2 to 12 times."""
    drives = [load("05", frames=200, world="indoor", seed=seed) for seed in range(8)]
    periods = [np.median(np.diff(drive.stamps)) for drive in drives]
    assert len({round(period, 3) for period in periods}) == len(drives)
    assert all(1 / 12.5 < period < 1 / 1.8 for period in periods)
    for drive, period in zip(drives, periods, strict=True):
        distance = np.abs(motions_of(relative_steps(drive.poses))[:, 0])
        assert 0.35 < np.percentile(distance, 90) / period < 0.75, "half a metre a second, and drifting"


def test_cars_tilt_and_climb_unless_told_not_to() -> None:
    climbs = []
    for seed in range(5):
        hilly = load("00", frames=300, seed=seed)
        level = load("00", frames=300, seed=seed, tilt=False)
        assert tilt_deg(hilly).std(axis=0).min() > 0.2
        assert np.abs(tilt_deg(hilly)).max() < 15
        np.testing.assert_allclose(tilt_deg(level), 0, atol=1e-9)
        assert np.ptp(level.poses[:, 2, 3]) < 1e-9
        np.testing.assert_array_equal(level.poses[:, :2, 3], hilly.poses[:, :2, 3])
        climbs.append(np.ptp(hilly.poses[:, 2, 3]))
    assert np.median(climbs) > 1


def test_a_climbing_car_points_up() -> None:
    for seed in range(5):
        poses = load("00", frames=454, seed=seed).poses
        step = poses[10:, :3, 3] - poses[:-10, :3, 3]
        moving = np.hypot(*step[:, :2].T) > 2
        climb = np.arctan2(step[:, 2], np.hypot(*step[:, :2].T))[moving]
        nose_up = np.arcsin(poses[5:-5, 2, 0])[moving]
        if climb.std() > np.deg2rad(1.0):
            assert np.corrcoef(climb, nose_up)[0, 1] > 0.7
            assert 0.7 < np.polyfit(climb, nose_up, 1)[0] < 1.3


def test_a_braking_car_nods() -> None:
    slopes = []
    for seed in range(20):
        sequence, level = load("00", frames=454, seed=seed), load("00", frames=454, seed=seed, tilt=False)
        distance = motions_of(relative_steps(level.poses))[:, 0]
        speed = np.gradient(np.concatenate([[0], np.cumsum(distance)]), 0.1)
        braking = -np.gradient(np.convolve(speed, np.ones(9) / 9, "same"), 0.1)[10:-10]
        z = sequence.poses[:, 2, 3]
        climb = np.gradient(z, 0.1)[10:-10] / np.maximum(speed[10:-10], 1)
        nose_down = -np.arcsin(sequence.poses[10:-10, 2, 0]) + climb
        slopes.append(np.polyfit(braking, nose_down, 1)[0])
    assert np.median(slopes) > 0


def test_poses_that_a_caller_changes_change_no_scan() -> None:
    before = digest(load("05", frames=12), 5)
    poses = load("05", frames=12).poses
    try:
        poses[:, 0, 3] += 100.0
    except ValueError:  # they may not be written to
        return
    assert digest(load("05", frames=12), 5) == before


# --- scans ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS)
def test_scan_is_that_of_its_points(world: str) -> None:
    sequence = load("00", frames=SHORT, world=world)
    for frame in (0, 7, 29):
        points = sequence.read_scan.points(frame)
        assert points.dtype == np.float32
        assert points.shape[1] == 4
        assert points.flags.c_contiguous
        angles, ranges = beams(sequence.read_scan(frame))
        assert angles.dtype == ranges.dtype == np.float64
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        np.testing.assert_array_equal(angles, np.arctan2(y, x))
        np.testing.assert_array_equal(ranges, np.hypot(x, y))
        assert not points[:, 3].any()
        assert np.isfinite(points).all()


@pytest.mark.parametrize("world", WORLDS)
def test_points_are_one_ring_in_two_hundred_scans(world: str) -> None:
    for seed in range(5):
        sequence = load("00", frames=40, world=world, seed=seed)
        for frame in range(40):
            points = sequence.read_scan.points(frame)
            azimuth = np.arctan2(points[:, 1], points[:, 0], dtype=np.float64) % (2 * np.pi)
            assert (np.diff(azimuth) >= 0).all()
            assert len(ring_starts(points)) == 1


def test_street_is_seen_by_ring_7(streets) -> None:
    for points in chain(*streets):
        ranges = np.hypot(*points[:, :2].T.astype(np.float64))
        expected = 0.206 - np.tan(np.deg2rad(0.452)) * ranges
        np.testing.assert_allclose(points[:, 2], expected, atol=1e-5)


def test_streets_fill_as_many_bins_as_real_ones(streets) -> None:
    """Real ring 7 fills 1,750 to 1,950; single places are emptier or fuller."""
    filled = []
    for points in chain(*streets):
        x, y = points[:, :2].T.astype(np.float64)
        filled.append(np.count_nonzero(encode(np.arctan2(y, x), np.hypot(x, y), Sensor())))
    assert 1600 < np.mean(filled) < 1950
    assert min(filled) > 700
    assert max(filled) < 2150


def test_some_beams_do_not_come_back_unless_told_to(streets) -> None:
    shares = []
    for seed, (first, *_) in enumerate(streets[:5]):
        complete = load("00", frames=SHORT, seed=seed, missing=False)
        shares.append(len(first) / len(complete.read_scan.points(0)))
    assert 0.75 < np.mean(shares) < 0.97
    assert max(shares) < 0.995


def test_rooms_are_seen_by_nearly_every_beam() -> None:
    for seed in range(4):
        sequence = load("00", frames=20, world="indoor", seed=seed)
        for frame in (0, 19):
            angles, ranges = beams(sequence.read_scan(frame))
            assert 140 < len(angles) <= 181
            assert np.abs(angles).max() <= np.pi / 2 + 1e-6
            assert ((ranges > 0.1) & (ranges < 40)).all()


def test_without_movers_what_differs_is_little() -> None:
    """The same standing world: beams end where they did, but for those that met something moving."""
    same = []
    for seed in range(3):
        moving, still = (load("00", frames=10, seed=seed, movers=m, missing=False) for m in (True, False))
        np.testing.assert_array_equal(moving.poses, still.poses)
        one, other = (Sensor().encode(sequence.read_scan(4)) for sequence in (moving, still))
        both = (one > 0) & (other > 0)
        same.append(np.mean(np.abs(one - other)[both] < 0.3))
    assert min(same) > 0.8
    assert np.mean(same) < 1


@pytest.mark.parametrize("world", WORLDS)
def test_consecutive_scans_agree_in_the_world_and_only_with_the_true_motion(world: str) -> None:
    """In three dimensions; a wrong metre forwards, or three degrees, and they no longer do."""
    options = {"frames": 60, "world": world}
    gaps = {"true": [], "metre": [], "turn": [], "mirrored pitch": []}
    for seed in range(5):
        sequence = load("00", seed=seed, **options)
        for frame in (20, 45):
            tree = cKDTree(in_world(sequence, frame - 1))
            pose = sequence.poses[frame]
            metre, turn, pitch = np.eye(4), np.eye(4), np.eye(4)
            metre[:2, 3] = 1.0, 0.5
            turn[:3, :3] = Rotation.from_euler("z", 3, degrees=True).as_matrix()
            pitch[:3, :3] = Rotation.from_euler("y", 3, degrees=True).as_matrix()
            for name, wrong in zip(gaps, (np.eye(4), metre, turn, pitch), strict=True):
                gaps[name].append(np.median(tree.query(in_world(sequence, frame, pose @ wrong))[0]))
    if world == "indoor":  # a level laser: walls are met at its height whatever the pitch
        assert max(gaps["true"]) < 0.15
    assert np.median(gaps["true"]) < 0.12
    assert np.median(gaps["metre"]) > 1.5 * np.median(gaps["true"])
    assert np.median(gaps["turn"]) > 1.5 * np.median(gaps["true"])
    assert np.median(gaps["mirrored pitch"]) > 1.5 * np.median(gaps["true"])


def test_nothing_comes_back_from_below_the_road() -> None:
    """Of a level car on a plain: 80 m at 0.452 degrees come down 0.63 m from 1.94 m."""
    for seed in range(2):
        sequence = load("00", frames=10, seed=seed, tilt=False)
        assert in_world(sequence, 5)[:, 2].min() > 1.0


def test_a_laser_that_sees_nothing_near_has_empty_scans() -> None:
    sizes = [
        len(load("04", frames=10, seed=seed, sensor={"max_range": 4.0}, movers=False).read_scan.points(5))
        for seed in (4, 6, 11)
    ]
    assert min(sizes) == 0
