"""Where a laser sits on its robot by a bag's /tf_static, and the robot's own odometry."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data.make_bag import (
    CLOUD,
    FORMATS,
    ODOMETRY,
    SCAN,
    START,
    TRANSFORMS,
    arrival_of,
    laser_scan,
    odometry,
    point_cloud,
    static_transforms,
    store_of,
    write_bag,
)
from rcnn_odom.errors import InputError
from rcnn_odom.recordings.formats import open_stream

RANGES = np.random.default_rng(0).uniform(1, 39, (12, 181))
MOUNT = {("base_link", "plate"): (0.2, 0.1, 0.5, 0, 0, 30), ("plate", "laser"): (0.3, 0, 0.1, 0, 0, 60)}
UPSIDE_DOWN = {("base_link", "laser"): (0.4, -0.1, 0.3, 180, 0, 25)}


def matrix(x, y, z, *degrees):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


def planar(pose):
    return matrix(pose[0], pose[1], 0, 0, 0, np.rad2deg(pose[2]))


def robot_at(seconds):
    """A robot that drives a circle of 3 m, its heading beyond pi after 1.2 s."""
    angle = 0.5 * np.asarray(seconds)
    return np.stack([3 * np.sin(angle), -3 * np.cos(angle), angle + np.pi - 0.6], axis=-1)


def write(
    folder, kind, transforms=None, odom=None, robot="base_link", frame="laser", scans=RANGES, slash="", **ons
):
    """A bag of scans at 10 Hz, /tf_static, and on /odom poses by their seconds after the first scan."""
    store, first = store_of(kind), kind == "ros1"
    topics, messages = {"/scan": SCAN}, []
    for number, ranges in enumerate(scans):
        message = laser_scan(store, ranges, START + 0.1 * number, 180.0, first, number, **ons)
        message.header.frame_id = slash + frame
        messages.append(("/scan", arrival_of(number), message))
    if transforms is not None:
        topics["/tf_static"] = TRANSFORMS
        for number, (pair, pose) in enumerate(transforms.items()):  # one message each
            pair = tuple(slash + name for name in pair)
            messages.append(("/tf_static", arrival_of(number), static_transforms(store, {pair: pose}, first)))
    if odom is not None:
        topics["/odom"] = ODOMETRY
        for seconds, pose in odom:
            message = odometry(store, pose, START + seconds, first, robot)
            messages.append(("/odom", START * 10**9 + round(1e9 * (seconds + 5)), message))
    return write_bag(folder, kind, topics, sorted(messages, key=lambda each: each[1]))


def read(path, **options):
    stream = open_stream(path, options)
    return stream, list(stream.scans)


# --- wheel odometry ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", FORMATS)
def test_wheel_poses_lie_between_the_messages(tmp_path, kind):
    seconds = np.arange(-0.02, 1.2, 0.04)
    bag = write(tmp_path, kind, odom=zip(seconds, robot_at(seconds), strict=True))
    stream, scans = read(bag, odom_topic="odom")
    assert all(scan.wheel_pose is None for scan in read(bag)[1])
    found = np.array([scan.wheel_pose for scan in scans])
    # A chord of 0.04 s is 0.06 m long and no farther than 0.2 mm from the circle.
    expected = robot_at(0.1 * np.arange(12))
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=3e-4)
    np.testing.assert_allclose(np.sin(found[:, 2] - expected[:, 2]), 0, atol=1e-5)
    np.testing.assert_allclose([scan.ranges for scan in scans], RANGES, rtol=1e-6)
    note = stream.notes[-1]
    assert note.startswith(
        "wheel odometry: 31 poses of /odom, taken as the laser's own: the bag has no /tf_st"
    )
    assert stream.laser_pose is None


def test_wheel_poses_far_in_time_are_unknown(tmp_path):
    times = [0.15, 0.25, 0.7, 0.95, 0.25]
    bag = write(tmp_path, "mcap", odom=[(each, (each, 0, 0)) for each in times])
    found = [scan.wheel_pose and scan.wheel_pose[0] for scan in read(bag, odom_topic="/odom")[1]]
    expected = [None, None, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, None, None]
    assert [value is None for value in found] == [value is None for value in expected]
    np.testing.assert_allclose(found[2:10], expected[2:10], atol=1e-6)
    (tmp_path / "gap").mkdir()
    bag = write(tmp_path / "gap", "mcap", odom=[(each, (each, 0, 0)) for each in (0.03, 0.87)])
    found = [scan.wheel_pose is not None for scan in read(bag, odom_topic="/odom")[1]]
    assert found == [4 <= number <= 5 for number in range(12)]


def test_poses_that_are_none_are_counted(tmp_path):
    odom = [(0.0, (0, 0, 0)), (0.1, (np.nan, 0, 0)), (0.2, (2, 0, 0))]
    stream, scans = read(write(tmp_path, "sqlite3", odom=odom), odom_topic="odom")
    np.testing.assert_allclose(scans[1].wheel_pose, [1, 0, 0], atol=1e-5)
    assert "2 poses of /odom, 1 messages could not be read" in stream.notes[-1]


@pytest.mark.parametrize("kind", FORMATS)
def test_wheel_poses_are_those_of_the_laser(tmp_path, kind):
    seconds = 0.1 * np.arange(12)
    bag = write(tmp_path, kind, MOUNT, zip(seconds, robot_at(seconds), strict=True))
    stream, scans = read(bag, odom_topic="odom")
    laser = matrix(*MOUNT["base_link", "plate"]) @ matrix(*MOUNT["plate", "laser"])
    for scan, robot in zip(scans, robot_at(seconds), strict=True):
        np.testing.assert_allclose(planar(scan.wheel_pose)[:2], (planar(robot) @ laser)[:2], atol=1e-6)
    assert stream.notes[-1] == "wheel odometry: 12 poses of /odom"
    assert stream.laser_pose is None, "the poses stay those of the laser until a base is asked for"


def test_a_laser_pose_stands_before_the_transforms(tmp_path):
    seconds = 0.1 * np.arange(12)
    bag = write(tmp_path, "mcap", MOUNT, zip(seconds, robot_at(seconds), strict=True))
    for options in ({}, {"base": "base_link"}):
        stream, scans = read(bag, odom_topic="odom", laser_pose=(1.0, 0.5, -0.25), **options)
        assert stream.laser_pose == (1.0, 0.5, -0.25)
        expected = planar(robot_at(0.3)) @ planar((1.0, 0.5, -0.25))
        np.testing.assert_allclose(planar(scans[3].wheel_pose), expected, atol=1e-6)


def test_odometry_that_is_not_there(tmp_path):
    bag = write(tmp_path, "mcap", MOUNT, [(0, (0, 0, 0))])
    for topic, says in (
        ("wheels", "no topic wheels; choose one with --odom-topic: /odom, or leave --odom-topic out"),
        ("/scan", "/scan holds sensor_msgs/msg/LaserScan; choose one with --odom-topic: /odom"),
    ):
        with pytest.raises(InputError, match=says):
            open_stream(bag, {"odom_topic": topic})
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="no topic odom; it has none with nav_msgs/msg/Odometry, or leave"):
        open_stream(write(tmp_path / "none", "mcap"), {"odom_topic": "odom"})
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no pose of /odom can be read; choose another topic"):
        open_stream(write(tmp_path / "empty", "mcap", odom=[]), {"odom_topic": "odom"})


# --- the place of the laser ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("slash", ["", "/"])
def test_the_laser_sits_where_the_chain_of_transforms_says(tmp_path, kind, slash):
    side = {("base_footprint", "base_link"): (0.1, 0, 0.2, 0, 0, -10), ("base_link", "camera"): (9,) * 6}
    stream, scans = read(write(tmp_path, kind, side | MOUNT, slash=slash), base="base_footprint")
    chain = [side["base_footprint", "base_link"], MOUNT["base_link", "plate"], MOUNT["plate", "laser"]]
    expected = np.linalg.multi_dot([matrix(*pose) for pose in chain])
    np.testing.assert_allclose(planar(stream.laser_pose)[:2, [0, 1, 3]], expected[:2, [0, 1, 3]], atol=1e-9)
    np.testing.assert_allclose([scan.ranges for scan in scans], RANGES, rtol=1e-6)
    # From a base beside the chain, upwards and down again.
    tail = {("plate", "tail"): (-1, 0, 0, 0, 0, 180)}
    (tmp_path / "tail").mkdir()
    stream, _ = read(write(tmp_path / "tail", kind, MOUNT | tail, slash=slash), base="tail")
    expected = np.linalg.inv(matrix(*tail["plate", "tail"])) @ matrix(*MOUNT["plate", "laser"])
    np.testing.assert_allclose(planar(stream.laser_pose)[:2, [0, 1, 3]], expected[:2, [0, 1, 3]], atol=1e-9)


def test_scans_in_the_frame_of_the_base_need_no_transforms(tmp_path):
    stream, scans = read(write(tmp_path, "mcap", frame="base_link"), base="/base_link")
    assert (stream.laser_pose, len(scans)) == ((0, 0, 0), 12)


@pytest.mark.parametrize(
    ("transforms", "base", "says"),
    [
        (None, "base_link", "the bag has no /tf_static, so the pose of the laser on the robot is unknown; "),
        (MOUNT, "base", "/tf_static has no frame base, only base_link, laser, plate; correct --base, or say"),
        ({("base_link", "camera"): (0,) * 6}, "base_link", "has no frame laser, only base_link, camera; "),
        (MOUNT | {("map", "arm"): (0,) * 6}, "arm", "/tf_static does not connect arm with laser; "),
        (
            {("b", "laser"): (0, 0, 1, 0, 20, 0)},
            "b",
            "laser is not mounted level on b: it is tilted by 20 de",
        ),
        ({("b", "laser"): (0, 0, 1, 90, 0, 0)}, "b", "it is tilted by 90 degrees; correct --base, or say"),
        ({("b", "laser"): (0,) * 6, ("laser", "b"): (0,) * 6}, "b", "form a loop through b; "),
    ],
)
def test_transforms_that_do_not_tell(tmp_path, transforms, base, says):
    path = write(tmp_path, "mcap", transforms)
    with pytest.raises(InputError) as refusal:
        open_stream(path, {"base": base})
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_slight_tilt_is_level(tmp_path):
    tilted = {("b", "laser"): (1, 0, 0, 2, 3, 0)}
    np.testing.assert_allclose(
        read(write(tmp_path, "mcap", tilted), base="b")[0].laser_pose, [1, 0, 0], atol=2e-3
    )


def test_a_transform_without_a_rotation_does_not_tell(tmp_path):
    store = store_of("mcap")
    message = static_transforms(store, {("b", "laser"): (0,) * 6}, False)
    message.transforms[0].transform.rotation.w = 0.0
    topics, scan = (
        {"/tf_static": TRANSFORMS, "/scan": SCAN},
        laser_scan(store, RANGES[0], START, 180.0, False),
    )
    bag = write_bag(
        tmp_path, "mcap", topics, [("/tf_static", arrival_of(0), message), ("/scan", arrival_of(1), scan)]
    )
    with pytest.raises(
        InputError, match="/tf_static has no valid rotation between b and laser; correct --base"
    ):
        open_stream(bag, {"base": "b"})


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("asked", [{"base": "base_link"}, {"odom_topic": "odom"}])
def test_a_laser_upside_down_sees_the_same_robot_frame(tmp_path, kind, asked):
    """Walls around the robot: its laser's points, moved by the told mount, are where they are."""
    mount = matrix(*UPSIDE_DOWN["base_link", "laser"])
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    ranges = 5 + np.sin(2 * angles) + angles
    seen = ranges * np.stack([np.cos(angles), np.sin(angles), 0 * angles])
    of_robot = (mount[:3, :3] @ seen + mount[:3, 3:])[:2]
    stream, [scan] = read(write(tmp_path, kind, UPSIDE_DOWN, [(0, (0, 0, 0))], scans=ranges[None]), **asked)
    points = np.stack([scan.ranges * np.cos(scan.bearings), scan.ranges * np.sin(scan.bearings)])
    laser = planar(stream.laser_pose or scan.wheel_pose)
    np.testing.assert_allclose(laser[:2, :2] @ points + laser[:2, 3:], of_robot, atol=1e-5)
    assert "the laser is mounted upside down: its bearings are mirrored" in stream.notes


def test_the_ring_of_a_cloud_upside_down(tmp_path):
    store = store_of("mcap")
    azimuth = np.deg2rad(np.tile(np.arange(-30, 90, 0.5), 3))
    level = np.repeat([-2.0, 0.0, 2.0], 240)
    arrays = {"x": 5 * np.cos(azimuth), "y": 5 * np.sin(azimuth), "z": 5 * np.tan(np.deg2rad(level))}
    fields = {name: values.astype("f4") for name, values in arrays.items()}
    fields["ring"] = np.repeat(np.arange(3), 240).astype("u2")
    topics = {"/points": CLOUD, "/tf_static": TRANSFORMS}
    messages = [
        ("/points", arrival_of(0), point_cloud(store, fields, START, False)),
        ("/tf_static", arrival_of(1), static_transforms(store, UPSIDE_DOWN, False)),
    ]
    bag = write_bag(tmp_path, "mcap", topics, messages)
    as_it_is, [scan] = read(bag)
    placed, [mirrored] = read(bag, base="base_link")
    np.testing.assert_array_equal(mirrored.bearings, -scan.bearings)
    first, covered, spacing = as_it_is.beams
    assert placed.beams == (-(first + covered), covered, spacing)
