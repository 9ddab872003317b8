"""Scans one after the other, for an odometer: the formats behind one door, none read into memory."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray
from rcnn_odom.models.encoding import Sensor


class Scan(NamedTuple):
    """Beams or returns of one revolution: angles in radians and ranges in metres, (P,); a stamp in seconds.

    ``angles`` is None where only the sensor says them; ``ranges`` may then be points (P, 2).
    """

    ranges: FloatArray
    angles: FloatArray | None
    stamp: float | None


@dataclass
class ScanStream:
    """A recording or a live source.

    Attributes:
        name: as a user would name it.
        scans: in their order. Raises InputError where it breaks off.
        total: how many scans there are, if that is known.
        has_clock: the stamps tell of order and gaps; otherwise the order alone counts.
        beams: degrees that they cover, and degrees between them; None: as the angles of a scan say.
        camera_from_laser: (4, 4), the frame in which trajectories are written.
        notes: what the reader noticed, in words for the user.
        skipped: what could not be read and was passed over, counted while ``scans`` is read.
    """

    name: str
    scans: Iterator[Scan]
    total: int | None = None
    has_clock: bool = True
    beams: tuple[float, float] | None = None
    camera_from_laser: FloatArray = field(default_factory=FORWARD_CAMERA.copy)
    notes: tuple[str, ...] = ()
    skipped: Counter[str] = field(default_factory=Counter)


def open_stream(
    path: Path, *, topic: str | None = None, ring: int | None = None, field_of_view_deg: float = 180.0
) -> ScanStream:
    """A recording by what it looks like: KITTI sequence folder, ROS bag or CARMEN log.

    Args:
        path: of it.
        topic: of a bag's LaserScan; None: its only one.
        ring: of a KITTI sequence; None: the most level one.
        field_of_view_deg: of a CARMEN log's FLASER lines.

    Raises:
        InputError: nothing of the kind, or it cannot be read.
    """
    from rcnn_odom.recordings import carmen, kitti, rosbag

    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give a KITTI sequence, a CARMEN log or a ROS bag")
    if path.is_dir() and (path / "velodyne").is_dir():
        return kitti.stream(path, ring)
    if path.suffix in rosbag.SUFFIXES or (path / rosbag.METADATA).exists():
        return rosbag.stream(path, topic)
    if path.is_dir():
        raise InputError(
            f"{path}: neither a KITTI sequence (no velodyne/ in it; name sequences/05) nor a ROS 2 bag (no "
            f"{rosbag.METADATA})"
        )
    return carmen.stream(path, field_of_view_deg)


def need_fitting_scan(stream: ScanStream, scan: Scan, sensor: Sensor) -> None:
    """Compares the beams of a scan with what a network was trained for; points do not say theirs.

    Raises:
        InputError: they cover another part of the circle, or are too far apart or too close for its bins.
    """
    beams = stream.beams
    if beams is None and scan.ranges.ndim == 1:
        beams = _beams_of(scan, sensor)
    if beams is None:
        return
    covered, spacing = beams
    fits = abs(covered - sensor.field_of_view_deg) <= 0.1 * sensor.field_of_view_deg
    # From a third of a bin on, as 0.5 degrees for 1, to two bins, as a Velodyne's 0.18 for 0.1.
    if not (fits and 0.3 * sensor.resolution_deg < spacing < 2.05 * sensor.resolution_deg):
        raise InputError(
            f"{stream.name}: a laser of {covered:.0f} degrees, a beam every {spacing:.2g}, but the model is "
            f"for {sensor.field_of_view_deg:g} degrees with one every {sensor.resolution_deg:g}; train one "
            "for such a laser (python train.py data.sensor.field_of_view_deg=... "
            "data.sensor.resolution_deg=...)"
        )


def _beams_of(scan: Scan, sensor: Sensor) -> tuple[float, float]:
    """Degrees that the beams cover, and degrees between them; without angles they cover the sensor's."""
    count = len(scan.ranges)
    if scan.angles is None:
        return sensor.field_of_view_deg, sensor.field_of_view_deg / max(count - 1, 1)
    spacing = float(np.rad2deg(np.median(np.abs(np.diff(scan.angles))))) if count > 1 else 360.0
    return spacing * count, spacing
