"""A ROS 2 node that turns sensor_msgs/LaserScan into nav_msgs/Odometry, for any 2D laser.

    pip install PATH_OF_THIS_REPOSITORY    # into the Python of your ROS 2
    python3 ros2_node.py --ros-args -p base_frame:=base_link -r scan:=/my_laser

Parameters: model (matcher: scan matching, which needs no training; or the networks all_round for lasers that
turn all round and half_circle for 180 to 270 degrees, an exported .onnx or a .ckpt), odom_frame (odom),
base_frame (empty), publish_tf (true).
The node publishes /odom and the transform from odom_frame to base_frame, with the stamp of the scan. With
base_frame, poses are those of the robot, computed with the static transform from base_frame to the laser.
Without it, they are those of the laser, and either its frame has no other parent or publish_tf must be false.
The covariance of the pose is accumulated since the first scan; twist and its covariance are those of the last
step, divided by its duration. Unknown values, and z, roll and pitch, have a variance of 1e6. Problems (gaps,
few returns) are logged; a scan that is passed over is not published. The file can be imported without ROS.
"""

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from rcnn_odom.cli.full import need_full
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.ros_messages import ros_covariance, velocity_of
from rcnn_odom.errors import InputError
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.rosbag import convert


def fill(message: Any, pose: Pose, seconds: float) -> None:
    """Writes a pose into an Odometry message; ``seconds`` is the duration of its last step."""
    message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
    message.pose.pose.orientation.z = math.sin(pose.heading / 2)
    message.pose.pose.orientation.w = math.cos(pose.heading / 2)
    fill_covariance(message.pose.covariance, pose.covariance)
    velocity, covariance = velocity_of(pose.step, seconds)  # in the child frame
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = velocity
    fill_covariance(message.twist.covariance, covariance)


def fill_covariance(values: Any, covariance: np.ndarray) -> None:
    """Writes a covariance (3, 3) of x, y and yaw into the 36 values of a message."""
    values[:] = ros_covariance(covariance)


def read_transform(transform: Any) -> tuple[tuple[float, float, float], bool]:
    """x, y and yaw of a Transform message, and whether the laser is mounted upside down.

    Raises:
        InputError: the laser is tilted.
    """
    position, q = transform.translation, transform.rotation
    up = 1 - 2 * (q.x**2 + q.y**2)
    if abs(up) < math.cos(math.radians(5)):
        raise InputError("the laser is tilted with respect to base_frame; correct its transform")
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return (position.x, position.y, yaw), up < 0


def load(model: str) -> Odometer:
    """An odometer with scan matching or a network, for poses of the laser."""
    if model == "matcher":
        return Odometer()
    if model.endswith(".ckpt"):
        need_full(f"{model}: a checkpoint")
        from rcnn_odom.training.export import load_odometer

        return load_odometer(model, threads=1)
    return Odometer.from_onnx(model)


class OdometryNode:
    """Subscribes to scans and publishes odometry."""

    def __init__(self, node: Any) -> None:
        from nav_msgs.msg import Odometry
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import LaserScan
        from tf2_ros import Buffer, TransformBroadcaster, TransformListener

        self.node = node
        defaults = {"model": "matcher", "odom_frame": "odom", "base_frame": "", "publish_tf": True}
        values = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
        self.odom_frame, self.base_frame = values["odom_frame"], values["base_frame"]
        self.odometer, self.is_upside_down = load(values["model"]), False
        self.last_stamp: float | None = None
        self.publisher = node.create_publisher(Odometry, "odom", 10)
        self.broadcaster = TransformBroadcaster(node) if values["publish_tf"] else None
        self.buffer: Any = Buffer() if self.base_frame else None
        self.listener = TransformListener(self.buffer, node) if self.base_frame else None
        node.create_subscription(LaserScan, "scan", self.on_scan, qos_profile_sensor_data)

    def on_scan(self, message: Any) -> None:
        """Computes the pose of one scan and publishes it."""
        warn = self.node.get_logger().warning
        scan: Any  # one of ROS has a stamp and bearings
        try:
            scan = convert(message, self.node.get_clock().now().nanoseconds)
        except ValueError as error:
            return warn(f"scan ignored: {error}")
        if self.base_frame and self.odometer.laser_pose is None and not self.find_laser(scan.frame_id):
            return warn(f"scan ignored: no transform from {self.base_frame} to {scan.frame_id} yet")
        if self.is_upside_down:
            scan = replace(scan, bearings=-scan.bearings)
        pose = self.odometer.step(scan)
        if (check := self.odometer.beam_check) and check.is_another_laser:
            raise check.refusal("scan", "take model:=matcher, or train a network: python train.py {}")
        if pose.degraded:
            warn(pose.degraded)
        if not pose.degraded.startswith(PASSED_OVER):
            self.publish(message.header, pose, scan.stamp - (self.last_stamp or scan.stamp))
            self.last_stamp = scan.stamp

    def find_laser(self, frame: str) -> bool:
        """Looks up the pose of the laser on the robot; returns whether it is known."""
        from rclpy.time import Time

        if not self.buffer.can_transform(self.base_frame, frame, Time()):
            return False
        found = self.buffer.lookup_transform(self.base_frame, frame, Time())
        laser_pose, self.is_upside_down = read_transform(found.transform)
        self.odometer = Odometer(self.odometer.tracker, laser_pose)
        return True

    def publish(self, header: Any, pose: Pose, seconds: float) -> None:
        """Publishes a pose as a message and as a transform."""
        from geometry_msgs.msg import TransformStamped
        from nav_msgs.msg import Odometry

        odometry, child = Odometry(), self.base_frame or header.frame_id
        odometry.header.stamp, odometry.header.frame_id, odometry.child_frame_id = (
            header.stamp,
            self.odom_frame,
            child,
        )
        fill(odometry, pose, seconds)
        self.publisher.publish(odometry)
        if self.broadcaster:
            transform = TransformStamped()
            transform.header, transform.child_frame_id = odometry.header, child
            transform.transform.translation.x, transform.transform.translation.y = pose.x, pose.y
            transform.transform.rotation = odometry.pose.pose.orientation
            self.broadcaster.sendTransform(transform)


def main() -> None:
    """Runs the node until Ctrl-C."""
    import rclpy

    rclpy.init()
    node = rclpy.create_node("rcnn_odom")
    try:
        OdometryNode(node)
        with suppress(KeyboardInterrupt):
            rclpy.spin(node)
    except InputError as error:
        raise SystemExit(f"rcnn_odom: {error}") from None


if __name__ == "__main__":
    main()
