"""A ROS 2 node that turns sensor_msgs/LaserScan into nav_msgs/Odometry, for any 2D laser.

    pip install PATH_OF_THIS_REPOSITORY    # into the Python of your ROS 2
    python3 ros2_node.py --ros-args -p base_frame:=base_link -r scan:=/my_laser

Parameters: model (matcher, which is scan matching and needs no training; or all_round or half_circle, which
ship along, an exported .onnx or a .ckpt), odom_frame (odom), base_frame (empty), publish_tf (true). Publishes
/odom and the transform from odom_frame to base_frame, in the header's stamp. With base_frame, poses are those
of the robot, by the static transform from there to the laser; without it those of the laser, whose frame must
then have no other parent, or publish_tf be false. The pose has the covariance that has accumulated since the
first scan, the twist that of the last step over its time; what is unknown, and z, roll and pitch, have a
variance of 1e6. What an estimate suffers from (gaps, few returns) is logged; a scan that is passed over is
not published. The file can be imported without ROS.
"""

import math
from contextlib import suppress
from dataclasses import replace

from rcnn_odom.cli.full import need_full
from rcnn_odom.deployment.odometer import Odometer, Pose
from rcnn_odom.deployment.ros_messages import ros_covariance, velocity_of
from rcnn_odom.errors import InputError
from rcnn_odom.models.tracking import PASSED_OVER
from rcnn_odom.recordings.rosbag import convert


def fill(message, pose: Pose, seconds: float) -> None:
    """Writes a pose into an Odometry message; its last step took so many seconds."""
    message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
    message.pose.pose.orientation.z = math.sin(pose.heading / 2)
    message.pose.pose.orientation.w = math.cos(pose.heading / 2)
    fill_covariance(message.pose.covariance, pose.covariance)
    velocity, covariance = velocity_of(pose.step, seconds)  # in the child's own frame
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = velocity
    fill_covariance(message.twist.covariance, covariance)


def fill_covariance(values, covariance) -> None:
    """Writes a covariance (3, 3) of x, y and yaw among the 36 of a message."""
    values[:] = ros_covariance(covariance)


def planar(transform) -> tuple[tuple[float, float, float], bool]:
    """x, y and yaw of a Transform message, and whether the laser hangs upside down.

    Raises:
        InputError: it does not lie level.
    """
    at, q = transform.translation, transform.rotation
    up = 1 - 2 * (q.x**2 + q.y**2)
    if abs(up) < math.cos(math.radians(5)):
        raise InputError("the laser does not lie level on base_frame; correct its transform")
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return (at.x, at.y, yaw), up < 0


def load(model: str) -> Odometer:
    """An odometer of the laser, of scan matching or of a network."""
    if model == "matcher":
        return Odometer()
    if model.endswith(".ckpt"):
        need_full(f"{model}: a checkpoint")
        from rcnn_odom.training.export import load_odometer

        return load_odometer(model, threads=1)
    return Odometer.from_onnx(model)


class OdometryNode:
    """Takes scans, publishes odometry."""

    def __init__(self, node) -> None:
        from nav_msgs.msg import Odometry
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import LaserScan
        from tf2_ros import Buffer, TransformBroadcaster, TransformListener

        self.node = node
        defaults = {"model": "matcher", "odom_frame": "odom", "base_frame": "", "publish_tf": True}
        values = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
        self.odom_frame, self.base_frame = values["odom_frame"], values["base_frame"]
        self.odometer, self.last_stamp, self.is_upside_down = load(values["model"]), None, False
        self.publisher = node.create_publisher(Odometry, "odom", 10)
        self.broadcaster = TransformBroadcaster(node) if values["publish_tf"] else None
        self.buffer = Buffer() if self.base_frame else None
        self.listener = TransformListener(self.buffer, node) if self.base_frame else None
        node.create_subscription(LaserScan, "scan", self.on_scan, qos_profile_sensor_data)

    def on_scan(self, message) -> None:
        """One scan in, one message and one transform out."""
        warn = self.node.get_logger().warning
        try:
            scan = convert(message, self.node.get_clock().now().nanoseconds)
        except ValueError as error:
            return warn(f"no scan: {error}")
        if self.base_frame and self.odometer.laser_pose is None and not self.find_laser(scan.frame_id):
            return warn(f"no scan yet: no transform from {self.base_frame} to {scan.frame_id}")
        if self.is_upside_down:
            scan = replace(scan, bearings=-scan.bearings)
        pose = self.odometer.step(scan)
        if (check := self.odometer.beam_check) and check.is_for_good:
            raise check.refusal("scan", "take model:=matcher, or train a network: python train.py {}")
        if pose.degraded:
            warn(pose.degraded)
        if not pose.degraded.startswith(PASSED_OVER):
            self.publish(message.header, pose, scan.stamp - (self.last_stamp or scan.stamp))
            self.last_stamp = scan.stamp

    def find_laser(self, frame: str) -> bool:
        """Looks once where the laser sits on the robot; whether that is known by now."""
        from rclpy.time import Time

        if not self.buffer.can_transform(self.base_frame, frame, Time()):
            return False
        found = self.buffer.lookup_transform(self.base_frame, frame, Time())
        laser_pose, self.is_upside_down = planar(found.transform)
        self.odometer = Odometer(self.odometer.tracker, laser_pose)
        return True

    def publish(self, header, pose: Pose, seconds: float) -> None:
        """A pose as a message, and as a transform."""
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
            moved = TransformStamped()
            moved.header, moved.child_frame_id = odometry.header, child
            moved.transform.translation.x, moved.transform.translation.y = pose.x, pose.y
            moved.transform.rotation = odometry.pose.pose.orientation
            self.broadcaster.sendTransform(moved)


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
