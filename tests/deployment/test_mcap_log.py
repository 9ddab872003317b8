"""``rcnn-odom run --mcap``: read back by other readers, and compared with what the run itself wrote."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from data.make_bag import make_bag
from data.make_carmen import make_carmen
from data.make_kitti import make_kitti
from matching.rooms import cast, circle
from outputs import START, STEP, Ahead, breaks_off, room_scans, stream_of
from rcnn_odom.cli import main
from rcnn_odom.deployment.mcap_log import McapLog
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.ros_messages import has_even_beams, ros_covariance
from rcnn_odom.deployment.run import run
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.rosbag import stream as read_bag
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.trajectory import read_tum

STORE = get_typestore(Stores.LATEST)
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


def messages_in(path):
    """By topic: (nanoseconds of the log, message), by the reader of mcap's own project; types are checked."""
    found = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            value = STORE.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


def values(messages):
    return [message for _, message in messages]


def seconds(header):
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def heading(quaternion):
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w]).as_euler("xyz")[2]


def steps_in(folder):
    return [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]


def same_angle(a, b):
    np.testing.assert_allclose(np.exp(1j * np.array(a)), np.exp(1j * np.array(b)), atol=1e-9)


def test_every_field_is_what_the_run_itself_wrote(tmp_path):
    """Of scan matching, in a room: steps.jsonl and trajectory.tum beside the messages."""
    bearings = circle(1.0)
    poses = [(0.05 * n, 0.0, 0.01 * n) for n in range(30)]
    scans = [Scan(cast(p, bearings), bearings, stamp=START + 0.1 * n) for n, p in enumerate(poses)]
    out, path = tmp_path / "out", tmp_path / "out.mcap"
    run(Odometer(), stream_of(scans), "matcher", out, outputs=[McapLog(path)])
    steps, found = steps_in(out), messages_in(path)
    assert {topic: len(each) for topic, each in found.items()} == {
        "/odometry": 30,
        "/tf": 30,
        "/scan": 30,
        "/path": 2,
        "/local_map": 1,
    }
    for (logged, message), step in zip(found["/odometry"], steps, strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "laser")
        assert seconds(message.header) == pytest.approx(step["stamp"], abs=1e-6)
        assert logged == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        position = message.pose.pose.position
        assert (position.x, position.y, position.z) == (step["x"], step["y"], 0.0)
        same_angle(heading(message.pose.pose.orientation), step["heading"])
        covariance = message.pose.covariance.reshape(6, 6)
        np.testing.assert_array_equal(covariance[PLANAR], np.array(step["pose_covariance"], dtype=float))
        np.testing.assert_array_equal(np.diag(covariance)[2:5], 1e6)
    check_twists(found["/odometry"], steps)
    stamps, camera_poses = read_tum(out / "trajectory.tum")
    whole = values(found["/path"])[-1]
    np.testing.assert_allclose([seconds(each.header) for each in whole.poses], stamps, atol=1e-6)
    # x ahead is z of a camera that looks ahead, y to the left its -x.
    places = [(each.pose.position.y, each.pose.position.x) for each in whole.poses]
    np.testing.assert_allclose(places, camera_poses[:, [0, 2], 3] * [-1, 1], atol=1e-8)


def check_twists(messages, steps):
    """Velocities in the frame of mid-turn, worked out by numbers: the covariance by differences."""
    for number, (_, message) in enumerate(messages):
        step, twist = steps[number], message.twist.twist
        got = np.array([twist.linear.x, twist.linear.y, twist.angular.z])
        covariance = message.twist.covariance.reshape(6, 6)
        if number == 0:
            assert not got.any()
            np.testing.assert_array_equal(covariance, 1e6 * np.eye(6))
            continue
        passed = step["stamp"] - steps[number - 1]["stamp"]

        def velocity(values, passed=passed):
            x, y, turn = values
            turned = (x + 1j * y) * np.exp(-0.5j * turn)
            return np.array([turned.real, turned.imag, turn]) / passed

        at, small = np.array(step["step"]), 1e-6
        np.testing.assert_allclose(got, velocity(at), rtol=1e-5, atol=1e-7)
        moved = [velocity(at + small * axis) - velocity(at - small * axis) for axis in np.eye(3)]
        jacobian = np.array(moved).T / (2 * small)
        expected = jacobian @ np.array(step["covariance"], dtype=float) @ jacobian.T
        np.testing.assert_allclose(covariance[PLANAR], expected, rtol=1e-4, atol=1e-12)


def test_transforms_and_scans_of_a_robot_lead_to_the_walls(tmp_path):
    laser_pose, path = (0.3, -0.2, np.pi / 2), tmp_path / "out.mcap"
    odometer = Odometer(Ahead(), laser_pose)
    run(odometer, stream_of(room_scans(4, frame_id="/front")), "ahead", outputs=[McapLog(path)])
    found = messages_in(path)
    [(_, static)] = found["/tf_static"]
    [on_robot] = static.transforms
    assert (on_robot.header.frame_id, on_robot.child_frame_id) == ("base_link", "front")
    assert (on_robot.transform.translation.x, on_robot.transform.translation.y) == laser_pose[:2]
    same_angle(heading(on_robot.transform.rotation), laser_pose[2])
    [last] = values(found["/tf"])[-1].transforms
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    scan, message = values(found["/scan"])[-1], values(found["/odometry"])[-1]
    assert (scan.header.frame_id, message.child_frame_id) == ("front", "base_link")
    assert last.transform.translation.x == message.pose.pose.position.x

    def matrix(transform):
        angle, at = heading(transform.rotation), transform.translation
        return np.array(
            [[np.cos(angle), -np.sin(angle), at.x], [np.sin(angle), np.cos(angle), at.y], [0, 0, 1]]
        )

    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    seen = np.stack([scan.ranges * np.cos(angles), scan.ranges * np.sin(angles), np.ones(len(angles))])
    placed = (matrix(last.transform) @ matrix(on_robot.transform) @ seen)[:2].T
    np.testing.assert_allclose(placed, odometer.returns(), atol=1e-5)


def test_the_robots_frame_by_another_name_and_frames_that_would_be_their_own_parents(tmp_path):
    for frame, child in (("chassis", "laser"), ("odom", "laser"), ("", "laser"), ("lidar", "lidar")):
        path, odometer = tmp_path / f"of_{frame}.mcap", Odometer(Ahead(), (0.1, 0.0, 0.0))
        log = McapLog(path, base="chassis")
        run(odometer, stream_of(room_scans(2, frame_id=frame)), "ahead", outputs=[log])
        [static] = values(messages_in(path)["/tf_static"])
        [only] = static.transforms
        assert (only.header.frame_id, only.child_frame_id) == ("chassis", child)


def test_the_scans_come_back_as_they_were(tmp_path):
    """By this project's own reader of bags, and the poses from them are the same."""
    rng, bearings = np.random.default_rng(0), np.deg2rad(np.arange(120.0, -121.0, -1.5))  # clockwise
    scans = []
    for number in range(12):
        ranges = rng.uniform(1, 20, len(bearings))
        ranges[rng.random(len(bearings)) < 0.2] = 0.0
        ranges[rng.random(len(bearings)) < 0.1] = np.inf
        scans.append(
            Scan(
                ranges,
                bearings,
                1e-4 * np.arange(len(bearings)),
                START + 0.1 * number,
                "laser",
                turn_time=0.1,
            )
        )
    path = tmp_path / "out.mcap"
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[McapLog(path)])
    for got, given in zip(read_bag(path).scans, scans, strict=True):
        np.testing.assert_allclose(got.ranges, given.ranges, rtol=1e-6)
        np.testing.assert_allclose(got.bearings, given.bearings, atol=1e-5)
        np.testing.assert_allclose(got.times, given.times, atol=1e-8)
        assert got.stamp == pytest.approx(given.stamp, abs=1e-6)
        assert (got.frame_id, got.turn_time) == ("laser", pytest.approx(0.1))


def test_beams_that_are_not_even_are_a_cloud(tmp_path):
    rng = np.random.default_rng(0)
    bearings = np.sort(rng.uniform(-np.pi, np.pi, 90))
    ranges = np.where(np.arange(90) % 9 == 0, 0.0, 5.0)
    scans = [Scan(ranges, bearings, stamp=START + 0.1 * n, frame_id="ring") for n in range(3)]
    path = tmp_path / "out.mcap"
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[McapLog(path)])
    found = messages_in(path)
    assert "/scan" not in found
    for (_, cloud), scan in zip(found["/points"], scans, strict=True):
        assert (cloud.header.frame_id, cloud.height, cloud.width, cloud.point_step) == ("ring", 1, 80, 12)
        assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
            ("x", 0, 7, 1),
            ("y", 4, 7, 1),
            ("z", 8, 7, 1),
        ]
        points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 3)
        seen = scan.ranges > 0
        expected = np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=1) * ranges[:, None]
        np.testing.assert_allclose(points, expected[seen], atol=1e-5)
    for got, given in zip(read_bag(path, topic="/points").scans, scans, strict=True):
        np.testing.assert_allclose(got.points(), given.points(), atol=1e-5)


@pytest.mark.parametrize(
    ("bearings", "is_even"),
    [
        (np.linspace(-1, 1, 50), True),
        (np.linspace(1, -1, 50), True),
        ((np.linspace(0, 2, 50) + 2.5) % (2 * np.pi) - np.pi, True),  # across the seam behind the laser
        (np.linspace(-1, 1, 50) + 1e-4 * np.sin(np.arange(50)), True),
        (np.linspace(-1, 1, 50) + 1e-2 * np.sin(np.arange(50)), False),
        (np.linspace(-1, 1, 50) ** 3, False),
        (np.zeros(50), False),
        (np.full(50, np.inf), False),
        (np.array([0.3]), True),
        (np.empty(0), True),
    ],
)
def test_even_beams(bearings, is_even):
    scan = Scan(np.ones(len(bearings)), bearings)
    assert has_even_beams(scan) is is_even
    assert not has_even_beams(replace(scan, has_all_beams=False))


def test_what_is_unknown_has_a_large_variance_and_no_covariances():
    covariance = np.arange(1.0, 10.0).reshape(3, 3)
    covariance[0] = covariance[:, 0] = np.nan
    expected = np.diag([1e6, 5.0, 1e6, 1e6, 1e6, 9.0])
    expected[1, 5], expected[5, 1] = 6.0, 8.0
    np.testing.assert_array_equal(ros_covariance(covariance), expected.ravel())
    np.testing.assert_array_equal(ros_covariance(np.full((3, 3), np.nan)), 1e6 * np.eye(6).ravel())


def test_an_unknown_step_leaves_no_nan_in_the_file(tmp_path):
    path = tmp_path / "out.mcap"
    run(Odometer(Ahead(unknown_at=2)), stream_of(room_scans(5)), "ahead", outputs=[McapLog(path)])
    variances = [
        np.diag(each.pose.covariance.reshape(6, 6)) for each in values(messages_in(path)["/odometry"])
    ]
    assert [bool((each[[0, 1, 5]] == 1e6).all()) for each in variances] == [False, False, True, True, True]


def test_stamps_of_the_period_where_there_are_none(tmp_path):
    for period, expected in ((float("nan"), 0.1), (0.05, 0.05)):
        path, tracker = tmp_path / f"{expected}.mcap", Ahead()
        tracker.period = period
        scans = [replace(scan, stamp=None) for scan in room_scans(5)]
        run(Odometer(tracker), stream_of(scans), "ahead", outputs=[McapLog(path)])
        messages = values(messages_in(path)["/odometry"])
        stamps = [seconds(each.header) for each in messages]
        np.testing.assert_allclose(stamps, expected * np.arange(1, 6), atol=1e-9)
        for message in messages:  # nobody knows the time that a step took
            assert_unknown(message.twist)


def assert_unknown(twist):
    """Zero and finite, with the large variances that mark what is unknown."""
    assert (twist.twist.linear.x, twist.twist.linear.y, twist.twist.angular.z) == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(twist.covariance, 1e6 * np.eye(6).ravel())


def test_a_twist_needs_the_stamps_of_both_its_scans(tmp_path):
    """Others are a period apart only by assumption; over a clock that was set no time is known."""
    path = tmp_path / "out.mcap"
    given = [None, 0.0, 0.1, None, 0.3, 0.5, 0.0, 0.6, 100.0, 100.2]
    stamps = [None if each is None else START + each for each in given]
    stamps[6] = 0.0  # of a driver that has no time
    scans = [replace(scan, stamp=stamp) for scan, stamp in zip(room_scans(10), stamps, strict=True)]
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[McapLog(path)])
    twists = [each.twist for each in values(messages_in(path)["/odometry"])]
    known = {2: 0.1, 5: 0.2, 9: 0.2}
    for number, twist in enumerate(twists):
        if number in known:
            assert twist.twist.angular.z == pytest.approx(STEP.heading / known[number], rel=1e-5)
            assert twist.covariance[0] < 1
        else:
            assert_unknown(twist)


def test_a_clock_that_goes_back_or_is_set_leaves_the_order_of_the_file(tmp_path):
    path = tmp_path / "out.mcap"
    times = START + np.array([0.0, 0.1, 0.2, 0.15, 0.3, 0.4, -5000.0, -4999.9, -4999.8, 9000.0, 9000.1])
    scans = [replace(scan, stamp=time) for scan, time in zip(room_scans(len(times)), times, strict=True)]
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[McapLog(path)])
    found = messages_in(path)
    stamps = [seconds(each.header) for each in values(found["/odometry"])]
    np.testing.assert_allclose(stamps, np.delete(times, 3), atol=1e-6, err_msg="the late scan is passed over")
    logged = np.array([time for time, _ in found["/odometry"]]) / 1e9 - START
    assert (np.diff(logged) > 0).all()
    np.testing.assert_allclose(logged[:5], np.delete(times, 3)[:5] - START, atol=1e-6)
    assert logged[5] == pytest.approx(0.5, abs=1e-6), "one period on"
    words = [each.msg for each in values(found["/rosout"])]
    assert words[0].startswith("late scan: ")
    assert any(each.startswith("clock set: ") for each in words)


def test_remarks_are_a_log(tmp_path):
    path, notes = tmp_path / "out.mcap", {3: ("poor match: it does not fit",), 4: ("poor match: again",)}
    run(Odometer(Ahead(notes=notes)), stream_of(room_scans(20)), "ahead", outputs=[McapLog(path)])
    logs = values(messages_in(path)["/rosout"])
    assert [(each.level, each.name, each.msg) for each in logs] == [
        (30, "rcnn_odom", "poor match: it does not fit"),
        (20, "rcnn_odom", "poor match: over, 2 scans marked from scan 4 to scan 5"),
    ]
    assert seconds(SimpleHeader(logs[0].stamp)) == pytest.approx(START + 0.3, abs=1e-6)


class SimpleHeader:
    def __init__(self, stamp):
        self.stamp = stamp


def test_the_path_is_short_however_long_the_way(tmp_path, monkeypatch):
    monkeypatch.setattr("rcnn_odom.deployment.mcap_log.PATH_POSES", 50)
    path = tmp_path / "out.mcap"
    run(Odometer(Ahead()), stream_of(room_scans(730)), "ahead", outputs=[McapLog(path)])
    found = messages_in(path)
    paths, places = values(found["/path"]), values(found["/odometry"])
    assert len(paths) == 9, "at the 1st, 101st, 201st ... and at the last scan"
    assert max(len(each.poses) for each in paths) <= 51
    expected = {seconds(each.header): each.pose.pose.position.x for each in places}
    for each in paths:
        stamps = [seconds(pose.header) for pose in each.poses]
        assert (np.diff(stamps) > 0).all()
        assert [pose.pose.position.x for pose in each.poses] == [expected[stamp] for stamp in stamps]
    assert seconds(paths[-1].poses[-1].header) == pytest.approx(START + 72.9)


def test_a_stream_that_breaks_off_leaves_a_whole_file(tmp_path):
    path, scans = tmp_path / "new" / "out.mcap", breaks_off(room_scans(7), InputError("breaks off; mend it"))
    with pytest.raises(InputError, match="breaks off"):
        run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[McapLog(path)])
    assert len(messages_in(path)["/odometry"]) == 7
    assert len(values(messages_in(path)["/path"])[-1].poses) == 7
    assert [each.name for each in path.parent.iterdir()] == ["out.mcap"]
    with path.open("rb") as file:
        [metadata] = make_reader(file).iter_metadata()
    assert "- out.mcap\n" in metadata.metadata["serialized_metadata"]


def test_nothing_is_left_where_no_scan_can_be_used(tmp_path):
    blind = [replace(scan, ranges=np.zeros(len(scan.ranges))) for scan in room_scans(9)]
    for folder in ("a", "a/b"):
        path = tmp_path / folder / "out.mcap"
        with pytest.raises(InputError, match="has a return"):
            run(Odometer(Ahead()), stream_of(blind), "ahead", tmp_path / "a" / "out", outputs=[McapLog(path)])
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="no scan in it"):
        run(Odometer(Ahead()), stream_of([]), "ahead", outputs=[McapLog(path)])
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_vanishes_is_one_line(tmp_path, monkeypatch):
    log = McapLog(tmp_path / "out.mcap")
    monkeypatch.setattr(Path, "rename", lambda *paths: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(InputError, match=r"out.mcap: cannot be written \(No space left\); choose another"):
        run(Odometer(Ahead()), stream_of(room_scans(2)), "ahead", outputs=[log])
    assert list(tmp_path.iterdir()) == []


def test_by_the_command_of_a_bag_and_of_a_log(tmp_path, capsys):
    ranges = np.array([scan.ranges for scan in room_scans(6)])
    bag = str(make_bag(tmp_path, "ros1", ranges, field_of_view_deg=358.0))
    made = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    assert main(["run", bag, "--mcap", str(made[0])]) == 0
    make_carmen(tmp_path, "robot", frames=12)
    log, out = str(tmp_path / "robot.log"), tmp_path / "out"
    command = ["run", log, "--laser-pose", "0.2", "0", "0", "--mcap", str(made[1]), "--out", str(out)]
    assert main(command) == 0
    assert [len(messages_in(path)["/odometry"]) for path in made] == [6, 12]
    stamps = [seconds(each.header) for each in values(messages_in(made[1])["/odometry"])]
    np.testing.assert_allclose(stamps, [step["stamp"] for step in steps_in(out)], atol=1e-6)
    assert values(messages_in(made[1])["/odometry"])[0].child_frame_id == "base_link"
    assert main(["run", bag, "--mcap", str(made[0])]) == 1
    assert "a.mcap: exists already; choose another --mcap" in capsys.readouterr().err
    assert main(["run", str(made[0]), "--out", str(tmp_path / "again")]) == 0, "it is a recording itself"


def test_a_drive_of_kitti_whose_clock_begins_at_zero(tmp_path):
    make_kitti(tmp_path, ["05"], frames=6)
    out, path = tmp_path / "out", tmp_path / "out.mcap"
    assert main(["run", str(tmp_path / "sequences" / "05"), "--mcap", str(path), "--out", str(out)]) == 0
    found, steps = messages_in(path), steps_in(out)
    assert steps[0]["stamp"] == 0.0
    assert len(found["/points"]) == 6
    check_twists(found["/odometry"], steps)
    np.testing.assert_allclose(
        [seconds(each.header) for each in values(found["/odometry"])],
        [step["stamp"] for step in steps],
        atol=1e-6,
    )


def test_ranges_whose_bearings_the_network_knows(tmp_path):
    """Of JSON lines without angles: they spread over the sensor's field of view."""
    odometer = Odometer(Ahead())
    type(odometer).sensor, kept = property(lambda self: Sensor(1.0, 180.0, 40.0)), type(odometer).sensor
    try:
        log = McapLog(tmp_path / "out.mcap")
        log.open(stream_of([]), odometer)
        scan = Scan(np.full(181, 5.0), stamp=START)
        log.add(odometer.step(replace(scan, bearings=np.zeros(181))), scan)
        log.finish(keep=True)
    finally:
        type(odometer).sensor = kept
    [message] = values(messages_in(tmp_path / "out.mcap")["/scan"])
    assert (message.angle_min, message.angle_max) == pytest.approx((-np.pi / 2, np.pi / 2))


def live(path, count):
    """A live run of so many scans, its standard input still open."""
    command = [sys.executable, "-m", "rcnn_odom.cli", "run", "--live", "--mcap", str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    line = {"ranges": [5.0, 4.0] * 500, "angle_min": -1.0, "angle_increment": 0.002}
    for number in range(count):
        process.stdin.write(json.dumps({"stamp": START + 0.1 * number, **line}) + "\n")
        process.stdin.flush()
        assert "pose_covariance" in process.stdout.readline()  # its pose comes at once
    return process


def test_live(tmp_path):
    path = tmp_path / "out.mcap"
    process = live(path, 5)
    assert path.exists()
    process.stdin.close()
    assert process.wait(timeout=60) == 0
    assert len(messages_in(path)["/scan"]) == 5


def test_a_killed_run_leaves_a_file_that_can_be_mended(tmp_path):
    """Without its index, complete up to the last chunk of a megabyte."""
    path = tmp_path / "out.mcap"
    process = live(path, 400)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    assert [each.name for each in tmp_path.iterdir()] == ["out.mcap"]
    kinds = []
    with path.open("rb") as file, pytest.raises(McapError):  # where it ends
        kinds.extend(type(record).__name__ for record in StreamReader(file).records)
    assert kinds.count("Message") > 200


@pytest.mark.slow
def test_memory_is_constant_over_a_long_stream(tmp_path, monkeypatch):
    import tracemalloc

    monkeypatch.setattr("rcnn_odom.deployment.run.MAP_SCANS", 100)
    monkeypatch.setattr("rcnn_odom.deployment.run.LATENCIES", 100)
    monkeypatch.setattr("rcnn_odom.deployment.mcap_log.PATH_POSES", 100)
    [scan], used, sizes, path = room_scans(1), [], [], tmp_path / "out.mcap"

    def scans():
        for number in range(12_001):
            if number % 4000 == 0:
                used.append(tracemalloc.get_traced_memory()[0])
                sizes.append(path.stat().st_size if number else 0)
            yield replace(scan, stamp=START + 0.1 * number)

    tracemalloc.start()
    run(Odometer(Ahead()), stream_of(scans()), "ahead", outputs=[McapLog(path)])
    tracemalloc.stop()
    assert used[3] - used[2] < 1_200_000, "of which a megabyte is the chunk that is being filled"
    assert sizes[3] - sizes[2] < 1.3 * (sizes[2] - sizes[1]), "its size grows evenly"
