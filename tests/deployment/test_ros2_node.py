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
from rcnn_odom.geometry import Step
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
    limits = {"range_min": 0.1, "range_max": 40.0, "time_increment": 0.0}
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
    assert len(FILE.read_text().splitlines()) < 80
    assert "--ros-args" in example.__doc__


def test_a_message_of_a_pose(example):
    message = Message()
    covariance = np.arange(9.0).reshape(3, 3) / 100
    example.fill(message, Pose(1.0, 2.0, -3.0, np.pi / 2, Step(0.5, 0.2, 0.1, covariance)), seconds=0.1)
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (2.0, -3.0)
    assert message.pose.pose.orientation.z == pytest.approx(np.sqrt(0.5))
    twist = message.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == pytest.approx((5.0, 2.0, 1.0))
    got = np.reshape(message.twist.covariance, (6, 6))
    np.testing.assert_allclose(got[np.ix_([0, 1, 5], [0, 1, 5])], 100 * covariance)
    assert not got[2:5].any()
    assert not got[:, 2:5].any()
    unknown = Message()
    example.fill(unknown, Pose(step=Step(0.0, 0.0, 0.0)), seconds=0.1)
    assert unknown.twist.covariance == [0.0] * 36
    heading_only = np.full((3, 3), np.nan)
    heading_only[2, 2] = 0.0004
    example.fill(unknown, Pose(step=Step(0.0, 0.0, 0.0, heading_only)), seconds=0.1)
    assert unknown.twist.covariance == [0.0] * 35 + [pytest.approx(0.04)]


def test_the_node_on_stand_ins(example, tmp_path, monkeypatch):
    write(to_onnx(build(), "fp32"), tmp_path / "tiny.onnx")
    published, warnings, handlers = [], [], []
    values = {"model": str(tmp_path / "tiny.onnx")}
    node = SimpleNamespace(
        declare_parameter=lambda name, default: SimpleNamespace(value=values.get(name, default)),
        create_publisher=lambda kind, topic, depth: SimpleNamespace(publish=published.append),
        create_subscription=lambda kind, topic, handler, profile: handlers.append(handler),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=10**9)),
        get_logger=lambda: SimpleNamespace(warning=warnings.append),
    )
    modules = {
        "rclpy": {"init": lambda: None, "create_node": lambda name: node, "spin": lambda node: None},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "nav_msgs.msg": {"Odometry": Message},
        "sensor_msgs.msg": {"LaserScan": Message},
    }
    for name, content in modules.items():
        stand_in = ModuleType(name)
        vars(stand_in).update(content)
        monkeypatch.setitem(sys.modules, name, stand_in)
    example.main()
    scans, odometer = random_scans(4), Odometer.from_onnx(tmp_path / "tiny.onnx")
    handlers[0](scan_message([], 98.0))  # an empty scan says nothing of the laser
    assert (published.pop().pose.pose.position.x, warnings.pop()) == (0.0, "no returns: none yet")
    for number in range(4):
        handlers[0](scan_message(scans[0][:90], 99.0 + 0.1 * number))
        assert "other laser: its beams lie from -90 to -1 degrees" in warnings.pop()
    with pytest.raises(InputError, match=r"its beams lie .*; train a model for such a laser"):
        handlers[0](scan_message(scans[0][:90], 99.4))
    broken = scan_message(scans[0], 99.5)
    broken.angle_min = float("nan")
    handlers[0](broken)
    assert warnings.pop() == "no scan: its angle_min is nan"
    published.clear()
    for number, scan in enumerate([*scans, np.zeros(181), np.zeros(181)]):
        handlers[0](scan_message(scan, 100.0 + 0.1 * number))
    handlers[0](scan_message(scans[0], 100.2))
    expected = [odometer.step(scan, 100.0 + 0.1 * number) for number, scan in enumerate(scans)]
    got = [(m.pose.pose.position.x, m.twist.twist.linear.x) for m in published[1:4]]
    np.testing.assert_allclose(got, [(pose.x, pose.step.x / 0.1) for pose in expected[1:]], atol=1e-5)
    assert (published[0].header.frame_id, published[0].child_frame_id) == ("odom", "laser")
    held = [m.twist.twist.linear.x for m in published[3:]]
    np.testing.assert_allclose(held, held[:1] * 3, rtol=1e-4, err_msg="the last speed goes on")
    assert warnings[:2] == ["no returns: the last motion goes on"] * 2
    assert warnings[2].startswith("late scan")
    assert len(published) == 6, "a late scan is not published"
