"""Simulated drives with other lasers, lasers that move while they turn, and drives that are special cases."""

import hashlib

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import poses_to_planar, wrap_angle
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.simulated import LIBRARIES, load
from rcnn_odom.training.settings import plain

PINNED = [
    (
        *("05", "street", "2edcdb1a5a57086c6f9ed1d1db6d6c45b6502ebc9c874d8a1b3d4e9f2ca23d32"),
        "2c145b8dcecb6ef05dda33d3c7efda63f6ccefa6b804dd1e655814bfb1f93968",
    ),
    (
        *("05~1", "street", "082762e91f5273bc6e517ea05cf19f29e88dac013b5b67eec26274b6b171a712"),
        "832cb6e594bc1563360d83cc9d336c02a513eb16c5b8ed1e2285829227cf7318",
    ),
    (
        *("00", "indoor", "8134e14f456c797111eb83e16e13352ccd1e13828448f908b0fa0f4291c3cc35"),
        "a09350bb006ffdc7ec4921959636280b0db174ce5f630121c6dd6548d6ae4fdb",
    ),
]
"""Fingerprints and hashes of four scans, from before there were other lasers."""
PINNED_WITH = [("numpy", "2.4.6"), ("scipy", "1.17.1"), ("numba", "0.68.1")]
WORLDS = ["street", "indoor", "corridor", "few_returns", "standstill", "standstill_street"]


@pytest.mark.skipif(LIBRARIES != PINNED_WITH, reason=f"pinned with {PINNED_WITH}, here is {LIBRARIES}")
@pytest.mark.parametrize(("name", "world", "fingerprint", "digest"), PINNED)
def test_drives_of_before_are_the_same_to_the_bit(name, world, fingerprint, digest) -> None:
    drive = load(name, world=world, frames=40, seed=3)
    assert drive.fingerprint == fingerprint
    points = b"".join(drive.read_scan.points(frame).tobytes() for frame in (0, 7, 21, 39))
    assert hashlib.sha256(points).hexdigest() == digest
    assert drive.read_scan(0).times is None


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("laser", "count", "view"),
    [
        ({"kind": "sick", "spacing_deg": 0.5}, 361, (-90, 90)),
        ({"kind": "hokuyo"}, 1081, (-135, 135)),
        ({"kind": "rplidar"}, 400, (-180, 180)),
        ({"kind": "regular", "field_of_view_deg": 40.0, "facing_deg": 170.0}, 81, (150, 190)),
    ],
)
def test_lasers_give_all_beams_in_every_world(world, laser, count, view) -> None:
    scan = load("05", world=world, frames=9, laser=laser).read_scan(3)
    assert scan.has_all_beams
    assert len(scan.ranges) == len(scan.bearings) == count
    bearings = np.rad2deg(scan.bearings)
    assert view[0] - 1e-9 <= bearings.min() < view[0] + 1
    assert view[1] - 1 < bearings.max() <= view[1] + 1e-9
    assert np.all(np.isposinf(scan.ranges) | (scan.ranges > 0.1))
    assert np.isfinite(scan.ranges).any() or world == "few_returns"
    assert np.isinf(scan.ranges).any() or world in ("indoor", "standstill")


def test_the_same_world_is_seen_by_every_laser() -> None:
    """Points of every laser lie where a laser that spaces its beams by 0.05 degrees sees something."""
    fine = {"kind": "regular", "spacing_deg": 0.05, "noise": 0.0}
    for world in ("street", "indoor"):
        options = {"world": world, "frames": 9, "movers": False, "tilt": False, "seed": 2}
        tree = cKDTree(load("05", laser=fine, missing=False, **options).read_scan.points(4)[:, :2])
        for kind in ("sick", "hokuyo", "rplidar"):
            points = load("05", laser={"kind": kind, "noise": 0.0}, **options).read_scan.points(4)
            assert np.median(tree.query(points[:, :2])[0]) < 0.05, (world, kind)


def test_interlaced_scans_change_with_every_frame() -> None:
    drive = load("05", world="indoor", frames=9, laser={"kind": "sick", "interlaced": True})
    assert [len(drive.read_scan(frame).ranges) for frame in (0, 1, 2, -1, -2)] == [181, 180, 181, 181, 180]
    gaps = np.rad2deg(drive.read_scan(1).bearings - drive.read_scan(0).bearings[:-1])
    np.testing.assert_allclose(gaps, 0.5)


def test_fingerprints_tell_lasers_and_rates_apart() -> None:
    options = [{}, {"skew": True}, {"scan_rate_hz": 5.0}, {"turn_rate_deg_s": 90.0}]
    options += [{"laser": {"kind": kind}} for kind in ("hdl64", "sick", "hokuyo", "rplidar", "regular")]
    options += [{"laser": {"kind": "sick", "phase_deg": 0.1}}, {"laser": {"kind": "sick"}, "skew": True}]
    options += [{"laser": {"kind": "sick", "rate_hz": 10.0}, "skew": True}]
    found = [load("05", world="indoor", frames=9, **one).fingerprint for one in options]
    assert len(set(found)) == len(options)
    assert load("05", frames=9, laser={"kind": "hdl64"}).fingerprint == load("05", frames=9).fingerprint
    assert load("05", frames=9, laser={"kind": None}).fingerprint == load("05", frames=9).fingerprint


# --- a laser that moves while it turns ------------------------------------------------------------


def by_hand(drive, frame, scan):
    """Points in the world (P, 2) of a level scan's returns, each from where the laser was at its time."""
    met = np.isfinite(scan.ranges)
    moments = drive.stamps[frame] + scan.times[met]
    x, y, heading = poses_to_planar(drive.poses).T
    place = [np.interp(moments, drive.stamps, column) for column in (x, y, np.unwrap(heading))]
    direction = place[2] + scan.bearings[met]
    return np.stack(
        [
            place[0] + scan.ranges[met] * np.cos(direction),
            place[1] + scan.ranges[met] * np.sin(direction),
        ],
        axis=1,
    )


@pytest.mark.parametrize("kind", ["rplidar", "regular", "hokuyo"])
def test_scans_of_a_robot_that_turns_fit_together_only_by_the_times_of_their_beams(kind) -> None:
    """Against scans at once of the same drive, that are exact in the world by its poses alone."""
    laser = {"kind": kind, "noise": 0.0, "rate_hz": 5.0}
    options = {"world": "indoor", "movers": False, "turn_rate_deg_s": 90.0, "scan_rate_hz": 5.0, "seed": 4}
    at_once = load("00", frames=200, laser=laser, **options)
    skewed = load("00", frames=200, laser=laser, skew=True, **options)
    np.testing.assert_array_equal(at_once.poses, skewed.poses)
    assert (at_once.is_compensated, skewed.is_compensated) == (True, False)
    turns = np.abs(wrap_angle(np.diff(poses_to_planar(skewed.poses)[:, 2])))
    turning = np.flatnonzero(turns > np.deg2rad(12))[:8]
    assert len(turning) >= 4
    by_times, by_stamp = [], []
    for frame in turning:
        seen = at_once.read_scan.points(frame)[:, :2] @ at_once.poses[frame, :2, :2].T
        tree = cKDTree(seen + at_once.poses[frame, :2, 3])
        scan = skewed.read_scan(frame)
        by_times.append(np.median(tree.query(by_hand(skewed, frame, scan))[0]))
        raw = skewed.read_scan.points(frame)[:, :2] @ skewed.poses[frame, :2, :2].T
        by_stamp.append(np.median(tree.query(raw + skewed.poses[frame, :2, 3])[0]))
    assert np.median(by_times) < 0.03
    assert np.median(by_stamp) > 3 * np.median(by_times)


def test_an_hdl64_that_turns_is_stamped_when_it_looks_ahead() -> None:
    drive = load("05", frames=30, skew=True, laser={"kind": "hdl64"})
    scan = drive.read_scan(20)
    assert not scan.has_all_beams
    np.testing.assert_allclose(scan.times, -wrap_angle(scan.bearings) / (2 * np.pi * 10), atol=1e-6)
    assert load("05", frames=30, skew=True).fingerprint == drive.fingerprint
    # Ahead the pose is that of the stamp, so that returns there are where they are without skew.
    ahead = np.abs(scan.bearings) < np.deg2rad(1)
    still = load("05", frames=30).read_scan(20)
    for bearing, seen in zip(scan.bearings[ahead], scan.ranges[ahead], strict=True):
        near = np.abs(wrap_angle(still.bearings - bearing)) < np.deg2rad(0.2)
        assert np.abs(still.ranges[near] - seen).min(initial=np.inf) < 0.3


def test_a_mirror_takes_a_small_part_of_the_frame_time() -> None:
    scan = load("05", frames=9, world="indoor", skew=True).read_scan(5)
    assert len(scan.ranges) == 181
    np.testing.assert_allclose(scan.times[[0, 90, 180]], [0, 1 / 300, 1 / 150], atol=1e-9)
    whole = load("05", frames=9, world="corridor", skew=True, laser={"kind": "regular"}).read_scan(5)
    np.testing.assert_allclose(whole.times[[0, 360]], [0, 0.05], atol=1e-9)


def test_the_last_scan_is_taken_on_the_move_too() -> None:
    drive = load("05", frames=9, world="corridor", skew=True, laser={"kind": "rplidar", "noise": 0.0})
    first, last = drive.read_scan(0), drive.read_scan(8)
    np.testing.assert_array_equal(first.times, last.times)
    assert np.isfinite(last.ranges).sum() > 300


# --- rates ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [5.0, 10.0])
def test_a_robot_turns_and_scans_as_fast_as_it_is_told(rate) -> None:
    fastest = []
    for seed in range(4):
        options = {"world": "indoor", "frames": 300, "seed": seed, "scan_rate_hz": rate}
        for turn_rate in (None, 90.0):
            drive = load("00", turn_rate_deg_s=turn_rate, **options)
            times = np.diff(drive.stamps)
            assert abs(np.median(times) * rate - 1) < 0.05
            turns = np.rad2deg(wrap_angle(np.diff(poses_to_planar(drive.poses)[:, 2])))
            path = np.hypot(*np.diff(drive.poses[:, :2, 3], axis=0).T)
            assert np.percentile(path / times, 99) < 0.8
            # Its own rate is up to 55 degrees a second, and its pace drifts.
            if turn_rate is None:
                assert np.percentile(np.abs(turns) / times, 99) < 80
            else:
                fastest.append(np.percentile(np.abs(turns) / times, 99))
    assert 85 < np.median(fastest) < 125


# --- special cases --------------------------------------------------------------------------------


@pytest.mark.parametrize("world", WORLDS[2:])
@pytest.mark.parametrize("rate", [None, 5.0])
def test_special_cases_last_a_minute(world, rate) -> None:
    if world == "standstill_street" and rate:
        pytest.skip("a car's laser has its own rate")
    drive = load("05", world=world, scan_rate_hz=rate)
    assert len(drive) == 60 * (rate or 10) + 1
    assert drive.stamps[-1] == pytest.approx(60)
    other = load("06", world=world, scan_rate_hz=rate)
    assert other.read_scan.points(0).tobytes() != drive.read_scan.points(0).tobytes()


def test_a_corridor_is_two_lines_without_an_end() -> None:
    drive = load("a", world="corridor", laser={"kind": "regular", "noise": 0.0})
    np.testing.assert_allclose(poses_to_planar(drive.poses)[[0, -1]], [[0, 0, 0], [60, 0, 0]], atol=1e-9)
    sides = []
    for frame in (0, 300, 600):
        scan = drive.read_scan(frame)
        met = np.isfinite(scan.ranges)
        across = scan.ranges[met] * np.sin(scan.bearings[met])
        sides.append((np.median(across[across < 0]), np.median(across[across > 0])))
        # Plaster is rough by 3 mm along the beam.
        assert np.abs(across - np.where(across < 0, *sides[-1])).max() < 0.02
        assert np.isinf(scan.ranges[np.abs(scan.bearings) < np.deg2rad(0.3)]).all()
    assert np.ptp(sides, axis=0).max() < 0.003
    assert 1.6 <= sides[0][1] - sides[0][0] <= 3.0


@pytest.mark.parametrize("world", ["standstill", "standstill_street"])
def test_at_rest_only_noise_differs(world) -> None:
    drive = load("a", world=world, movers=False, laser={"kind": "sick"})
    assert (drive.poses == drive.poses[0]).all()
    scans = np.array([drive.read_scan(frame).ranges for frame in range(0, 600, 20)])
    seen = np.isfinite(scans).all(0)
    assert seen.mean() > 0.1
    # Hedges are rough by centimetres.
    assert 0.004 < np.median(scans[:, seen].std(0, ddof=1)) < 0.15
    assert len(np.unique(scans[:, seen], axis=0)) == len(scans)


def test_few_returns_are_few() -> None:
    drive = load("a", world="few_returns", laser={"kind": "hokuyo"})
    counts = [np.isfinite(drive.read_scan(frame).ranges).sum() for frame in range(0, 601, 50)]
    assert min(counts) >= 1
    assert max(counts) < 120
    assert load("a", world="few_returns").read_scan(300).ranges.size < 30


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ["data.laser={kind: sick, spacing_deg: 0.5}"],
        ["data.laser.kind=sick", "data.laser.spacing_deg=0.5"],
    ],
)
@pytest.mark.parametrize("data", ["simulated", "indoor"])
def test_lasers_are_chosen_on_the_command_line(configure, overrides, data) -> None:
    settings = plain(configure(f"data={data}", "data.frames=9", *overrides))
    drive = open_recording(settings["data"]["reader"])("05")
    scan = drive.read_scan(3)
    assert len(scan.ranges) == 361
    assert Sensor(**settings["data"]["sensor"]).encode(scan).any()
    world = "indoor" if data == "indoor" else "street"
    sensor = settings["data"]["sensor"]
    laser = {"kind": "sick", "spacing_deg": 0.5}
    same = load("05", world=world, frames=9, laser=laser, sensor=sensor)
    assert drive.fingerprint == same.fingerprint


def test_settings_without_a_laser_are_the_drives_of_before(configure) -> None:
    for data, world in (("simulated", "street"), ("indoor", "indoor")):
        settings = plain(configure(f"data={data}", "data.frames=9"))["data"]
        drive = open_recording(settings["reader"])("05")
        assert drive.fingerprint == load("05", world=world, frames=9, sensor=settings["sensor"]).fingerprint


def test_skew_and_rates_are_chosen_on_the_command_line(configure) -> None:
    options = ["data=indoor", "data.frames=9", "data.realism.skew=true", "data.laser.kind=rplidar"]
    options += ["data.turn_rate_deg_s=90", "data.scan_rate_hz=5", "data.laser.rate_hz=5"]
    drive = open_recording(plain(configure(*options))["data"]["reader"])("05")
    assert drive.read_scan(2).times[-1] == pytest.approx(0.2 * 399 / 400)
    assert abs(np.median(np.diff(drive.stamps)) - 0.2) < 0.05


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("data.laser.kind=kinect", "data.laser.kind=kinect: choose one of hdl64"),
        ("data.laser={kind: sick, spacing_deg: 5}", "data.laser.spacing_deg=5"),
        ("data.laser=sick", "data.laser=sick: is a group; set its members, for instance data.laser.kind=..."),
        ("data.realism.skew=maybe", "data.realism.skew=maybe"),
        ("data.scan_rate_hz=0", "data.scan_rate_hz=0"),
        ("data.turn_rate_deg_s=-3", "data.turn_rate_deg_s=-3"),
        ("data.world=moon", "data.world=moon: choose one of street"),
    ],
)
def test_wrong_settings_are_told_in_one_line(configure, override, told) -> None:
    with pytest.raises(InputError, match=told) as caught:
        plain(configure("data=indoor", override))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"world": "moon"}, "data.world is street, indoor, corridor"),
        ({"world": "street", "scan_rate_hz": 5.0}, "data.scan_rate_hz"),
        ({"world": "corridor", "turn_rate_deg_s": 5.0}, "data.turn_rate_deg_s"),
        ({"world": "indoor", "scan_rate_hz": -1.0}, "data.scan_rate_hz=-1"),
        ({"world": "street", "laser": {"kind": "regular", "max_range": 90.0}}, "lower data.laser.max_range"),
        ({"world": "indoor", "laser": {"kind": "lidar"}}, "data.laser.kind=lidar"),
    ],
)
def test_wrong_options_are_told_in_one_line(options, told) -> None:
    with pytest.raises(InputError, match=told) as caught:
        load("05", frames=9, **options)
    assert "\n" not in str(caught.value)
