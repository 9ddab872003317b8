"""The generated city, the drive through it and the laser that looks at it."""

import hashlib
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from rcnn_odom.datasets.sequence import Sequence
from rcnn_odom.datasets.simulated import BEAMS, MAX_RANGE, cast_rays, load
from rcnn_odom.errors import InputError
from rcnn_odom.motion import FloatArray, relative_motions
from rcnn_odom.scan import Sensor, encode

NAMES = ["00", "02", "03", "04", "05", "06", "07", "08", "09", "10"]


@pytest.fixture(scope="module")
def drives() -> dict[str, Sequence]:
    return {name: load(name) for name in NAMES}


def digest(sequence: Sequence, index: int) -> str:
    return hashlib.sha256(b"".join(part.tobytes() for part in sequence.read_scan(index))).hexdigest()


def points_in_world(sequence: Sequence, index: int) -> FloatArray:
    angles, ranges = sequence.read_scan(index)
    pose = sequence.poses[index]
    return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], 1) @ pose[:2, :2].T + pose[:2, 3]


def brute_force_depth(segments: FloatArray, pose: FloatArray, angles: FloatArray) -> FloatArray:
    """Every beam against every segment: origin + depth * ray = start + share * (end - start)."""
    nearest = np.full(len(angles), np.inf)
    for beam, azimuth in enumerate(angles + pose[2]):
        system = np.empty((len(segments), 2, 2))
        system[:, :, 0] = np.cos(azimuth), np.sin(azimuth)
        system[:, :, 1] = segments[:, :2] - segments[:, 2:]
        crosses = np.abs(np.linalg.det(system)) > 1e-12
        target = segments[crosses, :2] - pose[:2]
        depth, share = np.linalg.solve(system[crosses], target[:, :, None])[:, :, 0].T
        met = depth[(depth > 0) & (depth < MAX_RANGE) & (share >= 0) & (share <= 1)]
        nearest[beam] = met.min(initial=np.inf)
    return nearest


def distance_to_segments(point: FloatArray, segments: FloatArray) -> FloatArray:
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    share = np.clip(((point - start) * along).sum(1) / (along**2).sum(1), 0, 1)
    return np.hypot(*(start + share[:, None] * along - point).T)


def test_same_seed_gives_same_scans_in_any_order() -> None:
    first, second = load("05", frames=30), load("05", frames=30)
    forwards = [digest(first, index) for index in range(30)]
    backwards = [digest(second, index) for index in reversed(range(30))]
    assert forwards == backwards[::-1]
    assert len(set(forwards)) == 30
    np.testing.assert_array_equal(first.poses, second.poses)


def test_same_seed_gives_same_scans_in_another_process() -> None:
    script = (
        "import hashlib; from rcnn_odom.datasets.simulated import load; s = load('07', frames=20);"
        "print(hashlib.sha256(b''.join(p.tobytes() for p in s.read_scan(11))).hexdigest(), s.fingerprint)"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    printed = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()
    here = load("07", frames=20)
    assert printed == [digest(here, 11), here.fingerprint]


def test_reader_survives_pickling() -> None:
    sequence = load("05", frames=5)
    copy = pickle.loads(pickle.dumps(sequence.read_scan))
    np.testing.assert_array_equal(copy(3), sequence.read_scan(3))


def test_frames_outside_the_drive_are_refused() -> None:
    with pytest.raises(IndexError):
        load("05", frames=5).read_scan(5)


def test_names_and_seeds_have_worlds_of_their_own(drives: dict[str, Sequence]) -> None:
    variants = [*drives.values(), load("05", seed=1), load("garden")]
    assert len({variant.read_scan.segments[:100].tobytes() for variant in variants}) == len(variants)
    assert len({variant.poses.tobytes() for variant in variants}) == len(variants)
    assert len({variant.fingerprint for variant in variants}) == len(variants)


def test_fingerprint_knows_the_length_of_the_drive() -> None:
    assert load("05", frames=20).fingerprint != load("05", frames=21).fingerprint


def test_longer_drive_begins_like_the_shorter() -> None:
    short, long = load("05", frames=50), load("05", frames=200)
    np.testing.assert_allclose(long.poses[:50], short.poses, atol=1e-9)
    assert digest(long, 20) == digest(short, 20)


@pytest.mark.parametrize(("name", "index"), [("00", 100), ("05", 222), ("07", 599)])
def test_depth_equals_brute_force_in_the_street(drives: dict[str, Sequence], name: str, index: int) -> None:
    reader = drives[name].read_scan
    pose = reader.planar[index]
    angles = 0.3 + 2 * np.pi / BEAMS * np.arange(BEAMS)
    # Facades are at most 25 m long, so none whose end is farther than 120 m comes within 80 m.
    near = np.hypot(*(reader.segments[:, :2] - pose[:2]).T) < 120
    depth, hit = cast_rays(reader.segments, pose, angles)
    some = slice(index % 7, None, 7)
    expected = brute_force_depth(reader.segments[near], pose, angles[some])
    np.testing.assert_allclose(depth[some], expected, rtol=1e-9)
    seen = np.flatnonzero(np.isfinite(depth))[::50]
    for beam in seen:
        azimuth = angles[beam] + pose[2]
        point = pose[:2] + depth[beam] * np.array([np.cos(azimuth), np.sin(azimuth)])
        assert distance_to_segments(point, reader.segments[hit[beam]][None])[0] < 1e-6


def test_depth_equals_brute_force_among_random_segments() -> None:
    """Segments at every turn of the circle, some of them close to the laser or far longer than the room."""
    rng = np.random.default_rng(3)
    start = rng.uniform(-30, 30, (300, 2))
    segments = np.concatenate(
        [start, start + rng.normal(0, 1, (300, 2)) * rng.choice([0.3, 5, 200], (300, 1))], 1
    )
    for _ in range(5):
        pose = np.append(rng.uniform(-25, 25, 2), rng.uniform(-10, 10))
        angles = rng.uniform(-np.pi, np.pi) + 2 * np.pi / 360 * np.arange(360)
        depth, _ = cast_rays(segments, pose, angles)
        np.testing.assert_allclose(depth, brute_force_depth(segments, pose, angles), rtol=1e-7)


def test_depth_of_a_wall_behind_the_laser() -> None:
    angles = 2 * np.pi / 8 * np.arange(8)
    depth, hit = cast_rays(np.array([[-5.0, -6.0, -5.0, 6.0]]), np.zeros(3), angles)
    expected = [np.inf] * 3 + [5 * np.sqrt(2), 5.0, 5 * np.sqrt(2)] + [np.inf] * 2
    np.testing.assert_allclose(depth, expected)
    assert (hit == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_vehicle_touches_nothing(drives: dict[str, Sequence], name: str) -> None:
    reader = drives[name].read_scan
    for x, y, _ in reader.planar[::4]:
        ends = np.abs(reader.segments[:, :2] - [x, y]).max(1)
        assert distance_to_segments(np.array([x, y]), reader.segments[ends < 40]).min() > 1.2


@pytest.mark.parametrize("name", NAMES)
def test_motion_resembles_a_car_in_a_town(drives: dict[str, Sequence], name: str) -> None:
    drive = drives[name]
    distance, turn = relative_motions(drive.poses).T
    turn_deg = np.abs(np.rad2deg(turn))
    assert distance.sum() >= 420
    assert 0.85 < distance.mean() < 1.1
    assert distance.min() > -1e-6
    assert distance.max() < 1.4
    assert np.abs(np.diff(distance)).max() / 0.1**2 < 2.3
    assert np.mean(distance < 0.02) <= 0.05
    assert np.mean(turn_deg < 0.5) > 0.6
    assert 1.5 < turn_deg.max() < 4.5
    np.testing.assert_allclose(np.diff(drive.stamps), 0.1)


def test_motion_stays_plausible_for_many_seeds() -> None:
    stops = []
    for seed in range(1, 21):
        distance, turn = relative_motions(load("05", seed=seed).poses).T
        assert distance.sum() >= 420
        assert np.rad2deg(np.abs(turn)).max() < 5.6
        stops.append(np.mean(distance < 0.02))
    assert max(stops) <= 0.05
    assert min(stops) == 0 < max(stops)


def test_laser_slips_sideways_in_turns(drives: dict[str, Sequence]) -> None:
    """It rides 0.8 m ahead of the axle: sideways speed is 0.8 m times the rate of turning."""
    poses = drives["05"].poses
    turn = relative_motions(poses)[:, 1]
    aside = (np.linalg.inv(poses[:-1]) @ poses[1:])[:, 1, 3]
    forward = (np.linalg.inv(poses[:-1]) @ poses[1:])[:, 0, 3]
    np.testing.assert_allclose(aside - forward * turn / 2, 0.8 * turn, atol=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_scans_fill_as_many_bins_as_real_ones(drives: dict[str, Sequence], name: str) -> None:
    scans = [drives[name].read_scan(index) for index in range(0, 600, 20)]
    filled = [np.count_nonzero(encode(*scan, Sensor())) for scan in scans]
    assert 1650 < np.mean(filled) < 1950
    assert min(filled) > 1200
    for angles, ranges in scans:
        assert angles.shape == ranges.shape == (len(angles),)
        assert (angles >= -np.pi).all()
        assert (angles < np.pi).all()
        assert (ranges > 1).all()
        assert (ranges < MAX_RANGE).all()


def test_consecutive_scans_agree_in_the_world(drives: dict[str, Sequence]) -> None:
    for name, index in [("00", 150), ("05", 300), ("07", 60), ("10", 500)]:
        earlier, later = (points_in_world(drives[name], at) for at in (index - 1, index))
        gap = np.hypot(*(later[::5, None] - earlier[None]).transpose(2, 0, 1)).min(1)
        assert np.median(gap) < 0.15


def test_wrong_motion_makes_scans_disagree(drives: dict[str, Sequence]) -> None:
    drive = drives["05"]
    earlier, later = (points_in_world(drive, at) for at in (299, 300))
    shifted = later + 1.0 * drive.poses[300, :2, 1]
    gap = np.hypot(*(shifted[::5, None] - earlier[None]).transpose(2, 0, 1)).min(1)
    assert np.median(gap) > 0.3


@pytest.mark.parametrize("frames", [1, 0, -3])
def test_too_few_frames_are_the_users_mistake(frames: int) -> None:
    with pytest.raises(InputError, match=r"simulated sequence 05.*frames"):
        load("05", frames=frames)


def test_negative_seed_is_the_users_mistake() -> None:
    with pytest.raises(InputError, match="seed"):
        load("05", seed=-1)
