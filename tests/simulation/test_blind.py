"""Places where a matcher has little to hold on to: what stands there, and how they are driven."""

import hashlib

import numpy as np
import pytest

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import relative_steps
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.simulated import load
from rcnn_odom.simulation.blind.drive import BEYOND, KINDS, kind_of
from rcnn_odom.simulation.blind.pace import CAR, ROBOT, travel
from rcnn_odom.simulation.blind.places import corridor, open_ground, tunnel
from rcnn_odom.simulation.blind.way import STEP, bending_way, straight_way
from rcnn_odom.training import stages
from rcnn_odom.training.settings import plain
from train import train

NAMES = [f"{kind}-1" for kind in KINDS]
LASER = {"kind": "hdl64"}


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_and_a_seed_are_a_drive(name) -> None:
    def digest(frame, **options):
        drive = load(name, world="blind", frames=60, laser=LASER, **options)
        return drive.fingerprint, hashlib.sha256(drive.read_scan(frame).ranges.tobytes()).hexdigest()

    assert digest(40) == digest(40)
    assert digest(40)[0] != digest(40, seed=1)[0]
    assert digest(40)[1] != digest(40, seed=1)[1]
    fresh = load(f"{name}~1", world="blind", frames=60, laser=LASER)
    assert not np.allclose(fresh.poses[-1], load(name, world="blind", frames=60, laser=LASER).poses[-1])


@pytest.mark.parametrize("name", NAMES)
def test_drives_turn_and_change_their_speed(name) -> None:
    drive = load(name, world="blind")
    steps = relative_steps(drive.poses)
    speed = np.hypot(steps[:, 0], steps[:, 1]) / np.diff(drive.stamps)
    assert len(drive) == 1800
    assert np.percentile(speed, 90) - np.percentile(speed, 10) > 0.25
    # Half a minute of the first speed would lead elsewhere than the drive.
    assert all(abs(speed[i : i + 300].mean() / speed[i : i + 300].max() - 1) > 0.05 for i in (0, 600, 1200))
    bound = ROBOT if name.startswith("corridor") else CAR
    assert (
        np.abs(np.gradient(np.convolve(speed, np.ones(10) / 10, "valid"), 0.1)).max() < bound.braking[1] + 1
    )
    assert 0.1 < np.rad2deg(np.abs(steps[:, 2])).max() < 3
    assert np.ptp(np.unwrap(np.arctan2(drive.poses[:, 1, 0], drive.poses[:, 0, 0]))) > 0.05


def test_nobody_drives_faster_than_he_has_in_mind_or_backwards() -> None:
    stamps = np.arange(3000) / 10
    for pace in (CAR, ROBOT):
        driven = travel(pace, stamps, rng())
        assert driven[0] == 0
        speed = np.diff(driven) / 0.1
        assert speed.min() >= 0
        assert speed.max() <= pace.fastest[1] * 1.08
        assert (speed < 0.01).any(), "now and then it stops"


@pytest.mark.parametrize("seed", range(5))
def test_a_way_is_smooth_and_never_tighter_than_its_radius(seed) -> None:
    way = bending_way(800.0, (40.0, 300.0), (20.0, 100.0), 0.3, rng(seed))
    np.testing.assert_allclose(np.hypot(*np.diff(way.points, axis=0).T), STEP, rtol=1e-9)
    assert np.abs(np.diff(way.directions)).max() / STEP <= 1 / 40 + 1e-9
    assert np.abs(way.directions).max() < 5.0
    # A place to the left lies squarely to the way.
    at = np.array([100.0, 250.0])
    apart = way.place(at, np.array([3.0, 3.0])) - way.place(at, np.zeros(2))
    ahead = np.stack([np.cos(way.direction(at)), np.sin(way.direction(at))], axis=1)
    np.testing.assert_allclose((apart * ahead).sum(1), 0, atol=1e-9)
    np.testing.assert_allclose(np.hypot(*apart.T), 3.0)


def test_a_tunnel_has_smooth_walls_with_something_every_25_to_60_metres() -> None:
    walls = tunnel(straight_way(2000.0), 2000.0, rng())
    y = walls.ends[:, 1::2]
    assert len(np.unique(np.sign(y), axis=0)) == 2
    half = np.median(np.abs(y))
    assert 8.5 <= 2 * half <= 10.5
    features = np.abs(np.abs(y) - half).max(1) > 0.01
    middles = np.sort(walls.ends[features][:, [0, 2]].mean(1))
    starts = middles[np.concatenate([[True], np.diff(middles) > 20])]
    gaps = np.diff(starts)
    assert 20 < gaps.min() < gaps.max() < 60 + 45 + 5
    assert np.hypot(*(walls.ends[:, 2:] - walls.ends[:, :2]).T).max() <= 1.2


def test_tunnel_walls_are_where_they_are_said_to_be_along_a_bend() -> None:
    way = bending_way(600.0, (180.0, 200.0), (100.0, 200.0), 0.0, rng(1))
    ends = tunnel(way, 600.0, rng(2)).ends
    apart = np.linalg.norm(ends[:, None, :2] - way.points[None], axis=2).min(1)
    half = np.median(apart)
    assert 4.2 < half < 5.3
    assert (np.abs(apart - half) < 0.02).mean() > 0.7, "most of it is smooth wall"


def test_corridor_doors_are_centimetres_and_5_to_15_metres_apart() -> None:
    walls = corridor(straight_way(400.0), 400.0, rng())
    left = walls.ends[walls.ends[:, 1] > 0]
    half = np.median(left[:, 1])
    assert 2.0 <= 2 * half <= 3.2
    relief = np.abs(left[:, 1] - half)
    assert 0.02 < relief.max() <= 0.06 + 1e-9
    frames = left[(relief > 0.005)][:, 0]
    doors = frames[np.concatenate([[True], np.diff(frames) > 3])]
    assert 5.0 < np.diff(doors).min() < np.diff(doors).max() < 17.0


def test_open_ground_leaves_the_track_free_and_is_nearly_bare() -> None:
    way = bending_way(500.0, (40.0, 300.0), (20.0, 100.0), 0.3, rng(3))
    ends = open_ground(way, 500.0, rng(4)).ends
    assert np.linalg.norm(ends[:, None, :2] - way.points[None], axis=2).min() > 2.0
    drive = load("posts-1", world="blind", laser={"kind": "regular"})
    shares = [np.isfinite(drive.read_scan(frame).ranges).mean() for frame in range(0, 1800, 100)]
    assert max(shares) < 0.15
    assert np.median(shares) < 0.08


def test_both_ends_of_a_corridor_are_out_of_sight() -> None:
    drive = load("corridor-2", world="blind", laser={"kind": "regular", "noise": 0.0})
    for frame in (0, 900, 1799):
        scan = drive.read_scan(frame)
        heading = np.arctan2(drive.poses[frame][1, 0], drive.poses[frame][0, 0])
        across = scan.ranges * np.sin(scan.bearings + heading)
        seen = np.isfinite(scan.ranges)
        assert seen.mean() > 0.9
        # All of it lies on the two walls, to the depth of a door.
        sides = [np.median(across[seen & (across < 0)]), np.median(across[seen & (across > 0)])]
        assert np.abs(across[seen] - np.where(across[seen] < 0, *sides)).max() < 0.1
    assert drive.poses[0, 0, 3] >= BEYOND - 1


def test_cars_lean_unless_told_otherwise() -> None:
    leaning = load("tunnel-1", world="blind", frames=50).poses[:, 2, 0]
    level = load("tunnel-1", world="blind", frames=50, tilt=False).poses[:, 2, 0]
    assert np.abs(leaning).max() > 0.001
    assert (level == 0).all()


@pytest.mark.parametrize("name", ["05", "tunnels-1", "cave-3", ""])
def test_other_names_are_told_in_one_line(name) -> None:
    with pytest.raises(InputError, match="name it like tunnel-1, corridor-1, posts-1") as told:
        load(name, world="blind")
    assert "\n" not in str(told.value)
    assert kind_of("tunnel-1~3") is KINDS["tunnel"]


def test_the_set_has_all_kinds_in_every_part_and_no_drive_twice(configure) -> None:
    settings = plain(configure("data=blind", "model=cnn_reg"))["data"]
    parts = [settings[part] for part in ("train", "val", "test")]
    assert len({name for part in parts for name in part}) == sum(map(len, parts))
    for part in parts:
        assert {name.split("-")[0] for name in part} == set(KINDS)
    drive = open_recording(settings["reader"])("posts-6")
    assert len(drive) >= 1000
    assert drive.fingerprint == load("posts-6", world="blind", laser=LASER).fingerprint
    assert settings["sensor"]["resolution_deg"] == 1.0  # of the tests; 0.1 degrees otherwise


def test_every_drive_that_is_scored_is_long_enough(configure) -> None:
    module = stages.build_datamodule(plain(configure("data=blind", "model=cnn_reg")))
    for name in (*module.names["val"], *module.names["test"]):
        steps = relative_steps(module.open_recording(name).poses)
        assert np.hypot(steps[:, 0], steps[:, 1]).sum() > 60


def test_networks_train_on_fresh_drives(configure) -> None:
    options = ["data=blind", "data.frames=40", "data.train=[tunnel-1,corridor-1]", "data.test=[tunnel-6]"]
    metrics = train(configure("model=cnn_reg", *options, "data.val=[posts-4]", "data.lengths=[10.0]"))
    assert metrics["test"]["sequences"]["tunnel-6"]["frames"] == 40
