"""The ROS 2 node, without ROS: its parts alone, and all of it on stand-ins for ROS's modules."""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from conftest import ROOT
from odometry import build, random_scans
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step, planar_to_poses, poses_to_planar
from rcnn_odom.models.contract import Registered
from rcnn_odom.training.onnx_graph import to_onnx, write

FILE = ROOT / "examples" / "ros2_node.py"


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("ros2_node", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def scan_message(ranges, stamp):
    header = SimpleNamespace(
        frame_id="laser", stamp=SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
    )
    spacing = np.deg2rad(1.0)
    limits = {"range_min": 0.1, "range_max": 40.0, "time_increment": 0.0, "scan_time": 0.0}
    return SimpleNamespace(
        header=header,
        ranges=list(ranges),
        angle_min=-np.pi / 2,
        angle_max=0.0,
        angle_increment=spacing,
        **limits,
    )


class Message(SimpleNamespace):
    """Makes the parts of a message that are asked for."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        value = [0.0] * 36 if name == "covariance" else Message()
        setattr(self, name, value)
        return value


def test_it_is_short_and_documented(example):
    assert len(FILE.read_text().splitlines()) < 170
    assert "--ros-args" in example.__doc__


def in_plane(covariance):
    """The part of x, y and yaw of the 36 values; the others must be unknown."""
    values = np.reshape(covariance, (6, 6))
    expected = np.zeros((6, 6))
    expected[[2, 3, 4], [2, 3, 4]] = 1e6
    np.testing.assert_array_equal(values[2:5], expected[2:5])
    np.testing.assert_array_equal(values[:, 2:5], expected[:, 2:5])
    return values[np.ix_([0, 1, 5], [0, 1, 5])]


def test_a_message_of_a_pose(example):
    message = Message()
    covariance, of_pose = np.diag([4.0, 1.0, 0.5]) / 100, np.arange(9.0).reshape(3, 3)
    straight = Step(0.5, 0.2, 0.0, covariance)
    example.fill(message, Pose(1.0, 2.0, -3.0, np.pi / 2, straight, of_pose), seconds=0.1)
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (2.0, -3.0)
    assert message.pose.pose.orientation.z == pytest.approx(np.sqrt(0.5))
    np.testing.assert_array_equal(in_plane(message.pose.covariance), of_pose)
    twist = message.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == pytest.approx((5.0, 2.0, 0.0))
    got = in_plane(message.twist.covariance)
    lever = np.array([[1, 0, 0.1], [0, 1, -0.25], [0, 0, 1]])
    np.testing.assert_allclose(got, 100 * lever @ covariance @ lever.T, err_msg="the frame turns by half")


def test_the_twist_is_told_in_the_frame_of_the_laser_itself(example):
    """On a circle of 2 m, a quarter of it in a second: no part of its speed is sideways."""
    message = Message()
    example.fill(message, Pose(step=Step(2.0, 2.0, np.pi / 2, np.eye(3))), seconds=1.0)
    assert message.twist.twist.linear.x == pytest.approx(np.sqrt(8))
    assert message.twist.twist.linear.y == pytest.approx(0)


def test_what_is_unknown_has_a_variance_that_no_filter_trusts(example):
    unknown = Message()
    example.fill(unknown, Pose(step=Step(0.0, 0.0, 0.0)), seconds=0.1)
    np.testing.assert_array_equal(in_plane(unknown.twist.covariance), 1e6 * np.eye(3))
    heading_only = np.full((3, 3), np.nan)
    heading_only[2, 2] = 0.0004
    example.fill(unknown, Pose(step=Step(0.0, 0.0, 0.0, heading_only)), seconds=0.1)
    np.testing.assert_allclose(in_plane(unknown.twist.covariance), np.diag([1e6, 1e6, 0.04]))
    first = Message()
    example.fill(first, Pose(), seconds=0.0)
    np.testing.assert_array_equal(in_plane(first.twist.covariance), 1e6 * np.eye(3))


class AnyLaser:
    """A model for any laser that always says the same, and no matcher."""

    period = float("nan")
    step = Step(0.3, 0.1, 0.2, np.diag([0.02, 0.01, 0.005]) ** 2)

    def reset(self):
        self.has_seen = False

    def begin(self, scan):
        self.has_seen = True
        return ()

    def register(self, scan, periods=1, seconds=None):
        return Registered(self.step)


class Ros:
    """Stand-ins for ROS's modules.

    Attributes:
        published, sent, warnings: messages, transforms, and what was logged.
        values: parameters; others have their defaults.
        transforms: (parent, child) -> Transform.
    """

    def __init__(self, monkeypatch, **values):
        self.published, self.sent, self.warnings, self.handlers = [], [], [], []
        self.values, self.transforms = values, {}
        node = SimpleNamespace(
            declare_parameter=lambda name, default: SimpleNamespace(value=values.get(name, default)),
            create_publisher=lambda kind, topic, depth: SimpleNamespace(publish=self.published.append),
            create_subscription=lambda kind, topic, handler, profile: self.handlers.append(handler),
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=10**9)),
            get_logger=lambda: SimpleNamespace(warning=self.warnings.append),
        )
        buffer = SimpleNamespace(
            can_transform=lambda parent, child, time: (parent, child) in self.transforms,
            lookup_transform=lambda parent, child, time: self.transforms[parent, child],
        )
        modules = {
            "rclpy": {"init": lambda: None, "create_node": lambda name: node, "spin": lambda node: None},
            "rclpy.qos": {"qos_profile_sensor_data": None},
            "rclpy.time": {"Time": lambda: None},
            "nav_msgs.msg": {"Odometry": Message},
            "geometry_msgs.msg": {"TransformStamped": Message},
            "sensor_msgs.msg": {"LaserScan": Message},
            "tf2_ros": {
                "Buffer": lambda: buffer,
                "TransformListener": lambda buffer, node: None,
                "TransformBroadcaster": lambda node: SimpleNamespace(sendTransform=self.sent.append),
            },
        }
        for name, content in modules.items():
            stand_in = ModuleType(name)
            vars(stand_in).update(content)
            monkeypatch.setitem(sys.modules, name, stand_in)

    def scan(self, ranges, stamp):
        """One message comes in."""
        self.handlers[0](scan_message(ranges, stamp))


def test_the_node_with_a_network(example, tmp_path, monkeypatch):
    write(to_onnx(build(), "fp32"), tmp_path / "tiny.onnx")
    ros = Ros(monkeypatch, model=str(tmp_path / "tiny.onnx"), publish_tf=False)
    published, warnings = ros.published, ros.warnings
    example.main()
    scans, odometer = random_scans(4), Odometer.from_onnx(tmp_path / "tiny.onnx")
    ros.scan([], 98.0)  # an empty scan says nothing of the laser
    assert (published.pop().pose.pose.position.x, warnings.pop()) == (0.0, "no returns: none yet")
    for number in range(4):
        ros.scan(scans[0][:90], 99.0 + 0.1 * number)
        assert "other laser: its beams lie from -90 to -1 degrees" in warnings.pop()
    with pytest.raises(InputError, match=r"its beams lie .*; take model:=matcher, or train a network"):
        ros.scan(scans[0][:90], 99.4)
    broken = scan_message(scans[0], 99.5)
    broken.angle_min = float("nan")
    ros.handlers[0](broken)
    assert warnings.pop() == "scan ignored: its angle_min is nan"
    published.clear()
    for number, scan in enumerate([*scans, np.zeros(181), np.zeros(181)]):
        ros.scan(scan, 100.0 + 0.1 * number)
    ros.scan(scans[0], 100.2)
    expected = [odometer.step(scan, 100.0 + 0.1 * number) for number, scan in enumerate(scans)]
    got = [(m.pose.pose.position.x, m.twist.twist.angular.z) for m in published[1:4]]
    np.testing.assert_allclose(got, [(pose.x, pose.step.heading / 0.1) for pose in expected[1:]], atol=1e-5)
    np.testing.assert_allclose(
        in_plane(published[3].pose.covariance), expected[3].covariance, rtol=1e-4, atol=1e-9
    )
    assert (published[0].header.frame_id, published[0].child_frame_id) == ("odom", "laser")
    held = [m.twist.twist.linear.x for m in published[3:]]
    np.testing.assert_allclose(held, held[:1] * 3, rtol=1e-4, err_msg="the last speed goes on")
    assert warnings[:2] == ["no returns: the last motion goes on"] * 2
    assert warnings[2].startswith("late scan")
    assert len(published) == 6, "a late scan is not published"
    assert ros.sent == []


def test_the_node_takes_any_laser_and_sends_its_transform(example, monkeypatch):
    monkeypatch.setattr("rcnn_odom.models.matcher.MatcherTracker", AnyLaser)
    ros = Ros(monkeypatch, odom_frame="world")
    example.main()
    for number in range(3):
        ros.scan(np.full(70 + number, 5.0), 100.0 + 0.1 * number)
    assert ros.warnings == []
    assert len(ros.sent) == len(ros.published) == 3
    message, moved = ros.published[-1], ros.sent[-1]
    assert (moved.header.frame_id, moved.child_frame_id, message.child_frame_id) == (
        "world",
        "laser",
        "laser",
    )
    assert moved.header.stamp.nanosec == 200_000_000
    pose = planar_to_poses([AnyLaser.step.array()])[0]
    x, y, heading = poses_to_planar([pose @ pose])[0]
    assert (moved.transform.translation.x, moved.transform.translation.y) == pytest.approx((x, y))
    assert message.pose.pose.position.x == pytest.approx(x)
    assert moved.transform.rotation.z == pytest.approx(np.sin(heading / 2))


def test_what_a_user_can_mend_is_one_line(example, monkeypatch):
    Ros(monkeypatch, model="none.onnx")
    with pytest.raises(SystemExit, match=r"^rcnn_odom: none.onnx: no such file"):
        example.main()


def transform(x, y, quaternion):
    rotation = SimpleNamespace(**dict(zip("xyzw", quaternion, strict=True)))
    return SimpleNamespace(
        transform=SimpleNamespace(translation=SimpleNamespace(x=x, y=y, z=0.3), rotation=rotation)
    )


def test_the_node_tells_of_the_robot_once_it_knows_where_its_laser_sits(example, monkeypatch):
    monkeypatch.setattr("rcnn_odom.models.matcher.MatcherTracker", AnyLaser)
    ros = Ros(monkeypatch, base_frame="base_link")
    example.main()
    ros.scan(np.full(70, 5.0), 100.0)
    assert ros.warnings == ["scan ignored: no transform from base_link to laser yet"]
    assert ros.published == []
    ros.transforms["base_link", "laser"] = transform(0.4, 0.1, (0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    ros.scan(np.full(70, 5.0), 100.1)
    ros.scan(np.full(70, 5.1), 100.2)
    on_robot, step = planar_to_poses([[0.4, 0.1, np.pi / 2], AnyLaser.step.array()])
    x, y, heading = poses_to_planar([on_robot @ step @ np.linalg.inv(on_robot)])[0]
    message = ros.published[-1]
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == pytest.approx((x, y))
    assert ros.sent[-1].child_frame_id == message.child_frame_id == "base_link"
    assert message.twist.twist.angular.z == pytest.approx(heading / 0.1)


def test_a_laser_that_hangs_upside_down_or_is_tilted(example, monkeypatch):
    seen = []
    monkeypatch.setattr(AnyLaser, "begin", lambda self, scan: seen.append(scan.bearings) or ())
    monkeypatch.setattr("rcnn_odom.models.matcher.MatcherTracker", AnyLaser)
    for tilt, is_refused in ((180, False), (0, False), (30, True)):
        ros = Ros(monkeypatch, base_frame="base_link")
        half = np.deg2rad(tilt / 2)
        ros.transforms["base_link", "laser"] = transform(0, 0, (np.sin(half), 0, 0, np.cos(half)))
        example.main()
        if is_refused:
            with pytest.raises(
                InputError, match="is tilted with respect to base_frame; correct its transform"
            ):
                ros.scan(np.full(70, 5.0), 100.0)
        else:
            ros.scan(np.full(70, 5.0), 100.0)
    np.testing.assert_allclose(seen[0], -seen[1])
    assert seen[1][0] == pytest.approx(-np.pi / 2)
