"""Finds the pose of the laser on its robot in a bag, and adds the robot's own odometry to the scans."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses
from rcnn_odom.recordings.bags.files import Bag
from rcnn_odom.recordings.bags.transforms import Mount, find_mount
from rcnn_odom.recordings.bags.wheels import Planar, WheelOdometry, read_wheels
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream


@dataclass(frozen=True)
class RobotOptions:
    """The user's options for the robot; false if none is set.

    Attributes:
        odom_topic: topic of the robot's own odometry.
        base: the robot's frame, in which /tf_static gives the pose of the laser.
        laser_pose: x and y in metres and heading in radians of the laser on the robot, instead of /tf_static.
    """

    odom_topic: str | None = None
    base: str | None = None
    laser_pose: Planar | None = None

    def __bool__(self) -> bool:
        return self != RobotOptions()


def place_on_robot(stream: ScanStream, path: Path, bag: Bag, frame: str, wanted: RobotOptions) -> ScanStream:
    """Add the laser's pose on the robot to a stream, and the robot's own odometry to its scans.

    Args:
        stream: the stream of the bag's scans.
        path: path of the bag, for errors.
        bag: the bag that the stream reads.
        frame: frame of the scans.
        wanted: the user's options, at least one.

    Raises:
        InputError: /tf_static does not give the pose of the laser in ``base``, the laser is not level, or
            the bag has no such odometry.
    """
    mount = _find_mount_on_base(path, bag, frame, wanted)
    laser_pose, beams, notes = mount and mount.pose, stream.beams, list(stream.notes)
    wheels = None
    if wanted.odom_topic:
        wheels = read_wheels(path, bag, wanted.odom_topic)
        mount, mount_note = _find_mount_on_wheels(wheels, bag, frame, wanted, mount)
        notes.append(f"wheel odometry: {wheels.note}{mount_note}")
    assert mount is not None
    if mount.is_upside_down:
        notes.append("the laser is mounted upside down: its bearings are mirrored")
        beams = beams and Beams(-(beams.first + beams.covered), beams.covered, beams.spacing)
    scans = _place_scans(stream.scans, mount, wheels)
    return replace(stream, scans=scans, laser_pose=laser_pose, beams=beams, notes=tuple(notes))


def _place_scans(scans: Iterator[Scan], mount: Mount, wheels: WheelOdometry | None) -> Iterator[Scan]:
    """Mirror the scans of a laser that is upside down, and add wheel odometry."""
    laser = planar_to_poses([mount.pose])[0]
    for scan in scans:
        if mount.is_upside_down and scan.bearings is not None:
            scan = replace(scan, bearings=-np.asarray(scan.bearings))
        yield scan if wheels is None else replace(scan, wheel_pose=wheels.at(scan.stamp, laser))


def _find_mount_on_base(path: Path, bag: Bag, frame: str, wanted: RobotOptions) -> Mount | None:
    if wanted.laser_pose is not None:
        return Mount(wanted.laser_pose)
    if not wanted.base:
        return None
    try:
        return find_mount(bag, wanted.base, frame)
    except ValueError as error:
        raise InputError(
            f"{path}: {error}; correct --base, or say where the laser sits by --laser-pose X Y HEADING"
        ) from error


def _find_mount_on_wheels(
    wheels: WheelOdometry, bag: Bag, frame: str, wanted: RobotOptions, mount: Mount | None
) -> tuple[Mount, str]:
    """The mount of the laser in the odometry's frame, and a note if it is unknown."""
    if wanted.laser_pose is not None or (mount and not wheels.frame):
        assert mount is not None
        return mount, ""
    try:
        if not wheels.frame:
            raise ValueError("its messages have no child_frame_id")
        return find_mount(bag, wheels.frame, frame), ""
    except ValueError as error:
        return mount or Mount(), f", taken as the laser's own: {error}"
