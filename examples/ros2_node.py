"""A ROS 2 node that turns sensor_msgs/LaserScan into nav_msgs/Odometry with a trained network.

    pip install PATH_OF_THIS_REPOSITORY    # into the Python of your ROS 2
    python3 ros2_node.py --ros-args -p model:=rcnn_small -r scan:=/my_laser

Parameters: model (rcnn_small, an exported .onnx or a .ckpt), odom_frame (odom). Publishes /odom: the pose of
the laser where its first scan is the origin, and as twist the last step over its time with the network's
covariance. No TF is sent, since a robot's laser has a parent already. What an estimate suffers from (gaps,
few returns) is logged; a scan that is passed over is not published. The file can be imported without ROS.
"""

import math
from contextlib import suppress
from itertools import product

from rcnn_odom.deployment.odometer import PASSED_OVER, Odometer, Pose
from rcnn_odom.recordings.rosbag import convert

AXES = (0, 1, 5)  # x, y and yaw among the six of a twist's covariance


def fill(message, pose: Pose, seconds: float) -> None:
    """Writes a pose into an Odometry message; its last step took so many seconds."""
    message.pose.pose.position.x, message.pose.pose.position.y = pose.x, pose.y
    message.pose.pose.orientation.z = math.sin(pose.heading / 2)
    message.pose.pose.orientation.w = math.cos(pose.heading / 2)
    if seconds > 0:
        step, twist = pose.step, message.twist.twist
        twist.linear.x, twist.linear.y = step.x / seconds, step.y / seconds
        twist.angular.z = step.heading / seconds
        for i, j in product(range(3), repeat=2):  # unknown ones stay 0
            if not math.isnan(step.covariance[i, j]):
                message.twist.covariance[6 * AXES[i] + AXES[j]] = step.covariance[i, j] / seconds**2


def main() -> None:
    """Runs the node until Ctrl-C."""
    import rclpy
    from nav_msgs.msg import Odometry
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import LaserScan

    rclpy.init()
    node = rclpy.create_node("rcnn_odom")
    model = node.declare_parameter("model", "rcnn_small").value
    frame = node.declare_parameter("odom_frame", "odom").value
    if model.endswith(".ckpt"):
        from rcnn_odom.training.export import load_odometer

        odometer = load_odometer(model, threads=1)
    else:
        odometer = Odometer.from_onnx(model)
    publisher, last = node.create_publisher(Odometry, "odom", 10), []

    def on_scan(message) -> None:
        try:
            scan = convert(message, node.get_clock().now().nanoseconds)
        except ValueError as error:
            return node.get_logger().warning(f"no scan: {error}")
        pose = odometer.step(scan)
        if odometer.beam_check.is_for_good:
            raise odometer.beam_check.refusal("scan", "train a model for such a laser: python train.py {}")
        if pose.degraded:
            node.get_logger().warning(pose.degraded)
        if pose.degraded.startswith(PASSED_OVER):
            return
        odometry = Odometry(header=message.header, child_frame_id=message.header.frame_id)
        odometry.header.frame_id = frame
        fill(odometry, pose, scan.stamp - last[0] if last else 0.0)
        last[:] = [scan.stamp]
        publisher.publish(odometry)

    node.create_subscription(LaserScan, "scan", on_scan, qos_profile_sensor_data)
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
