"""Parses the laser lines of a CARMEN log and checks that their fields are consistent.

The format of the lines, one blank between fields::

    FLASER n [n ranges] x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp
    ROBOTLASER1 laser_type start_angle field_of_view resolution maximum_range accuracy remission_mode
        n [n ranges] m [m remissions] laser_x y theta robot_x y theta tv rv forward_safety side_safety
        turn_axis ipc_timestamp host logger_timestamp
"""

import math
from typing import NamedTuple

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.carmen_log.front_laser import (
    CIRCLE,
    PRINTED,
    FrontLaser,
    agree,
    even_spacing,
    rounding_of,
)
from rcnn_odom.recordings.carmen_log.params import OPTION
from rcnn_odom.recordings.laser_scan import has_most_beyond

OVERLAP = 0.1
"""Radians; largest overlap of the beams of a laser that turns all round."""
NOT_RADIANS = "are its angles in degrees, not radians?"


class LaserLine(NamedTuple):
    """The content of one laser line; angles in radians, lengths in metres.

    Attributes:
        kind: ``FLASER`` or ``ROBOTLASER1``.
        readings: (P,) ranges.
        first_angle: direction of the first beam, counter-clockwise from straight ahead.
        spacing: angle from beam to beam; negative if the beams run clockwise.
        maximum: maximum range; infinite if it is unknown, or if most readings lie beyond it.
        stamp: seconds.
        laser, robot: [x, y, heading] of the laser's pose, and of the robot's odometry pose.
        is_maximum_doubted: whether the line's maximum range is not used because most readings lie beyond it.
    """

    kind: str
    readings: FloatArray
    first_angle: float
    spacing: float
    maximum: float
    stamp: float
    laser: list[float]
    robot: list[float]
    is_maximum_doubted: bool = False


def parse_flaser(fields: list[str], front: FrontLaser) -> LaserLine:
    """Parse a FLASER line; its beams lie symmetrically about straight ahead.

    Args:
        fields: words of the line.
        front: the laser's parameters.

    Raises:
        ValueError: the line is broken, or its number of readings does not fit the laser.
    """
    count = _parse_count(fields, 1)
    _need_fields(fields, 2 + count + 9, count)
    if not front.fits(count):
        raise ValueError(
            f"{count} readings, {math.degrees(front.resolution):.4g} degrees apart by the log's PARAM lines, "
            f"do not cover {math.degrees(front.field_of_view):.4g} degrees; if they do, set {OPTION}"
        )
    pose = _parse_finite(fields[2 + count : 9 + count])
    return LaserLine(
        kind=fields[0],
        readings=np.array([float(word) for word in fields[2 : 2 + count]]),
        first_angle=-front.field_of_view / 2,
        spacing=front.spacing(count),
        maximum=front.maximum,
        laser=pose[:3],
        robot=pose[3:6],
        stamp=pose[6],
    )


def parse_robotlaser(fields: list[str], _: FrontLaser) -> LaserLine:
    """Parse a ROBOTLASER1 line, which holds the directions of its beams itself.

    Args:
        fields: words of the line.

    Raises:
        ValueError: the line is broken, or its angles contradict each other or its number of readings.
    """
    count = _parse_count(fields, 8)
    _need_fields(fields, 10 + count, count, exact=False)
    remissions = int(fields[9 + count])
    _need_fields(fields, 24 + count + remissions, count)
    spacing, maximum = _compute_spacing(fields[3], fields[4], count), float(fields[5])
    readings = np.array([float(word) for word in fields[9 : 9 + count]])
    doubted = maximum > 0 and has_most_beyond(readings, maximum)
    poses = _parse_finite(fields[10 + count + remissions : 16 + count + remissions])
    return LaserLine(
        kind=fields[0],
        readings=readings,
        first_angle=_parse_start_angle(fields[2]),
        spacing=spacing,
        maximum=maximum if maximum > 0 and not doubted else math.inf,
        laser=poses[:3],
        robot=poses[3:],
        stamp=_parse_finite(fields[-3:-2])[0],
        is_maximum_doubted=doubted,
    )


PARSERS = {"FLASER": parse_flaser, "ROBOTLASER1": parse_robotlaser}


def _parse_start_angle(word: str) -> float:
    [angle] = _parse_finite([word])
    if abs(angle) > CIRCLE:
        raise ValueError(f"a start angle of {angle:g} is more than 2 pi; {NOT_RADIANS}")
    return angle


def _compute_spacing(fov_word: str, resolution_word: str, count: int) -> float:
    """Radians from beam to beam, counter-clockwise, by the fields of a line.

    The sign is that of the resolution, or that of the field of view if the resolution is 0.

    Raises:
        ValueError: the field of view, the resolution and the number of readings contradict each other.
    """
    field_of_view, resolution = _parse_finite([fov_word, resolution_word])
    extent, step = (0.0 if abs(value) < PRINTED else abs(value) for value in (field_of_view, resolution))
    rounding = rounding_of(resolution_word) if step else 0.0
    if fault := _find_misfit(extent, step, count, rounding):
        raise ValueError(
            f"a field of view of {field_of_view:g} and a resolution of {resolution:g} do not fit {count} "
            f"readings: {fault}"
        )
    if not step:
        return even_spacing(field_of_view, count)
    if extent and not agree(extent, step, count):
        step = even_spacing(extent, count)  # too few digits of the resolution were printed
    return math.copysign(step, resolution)


def _find_misfit(extent: float, step: float, count: int, rounding: float) -> str:
    """Why a field of view and a resolution (radians, 0: unknown) cannot be right; empty if they can."""
    covered = step * (count - 1)
    if not extent and not step:
        return "both are 0; write at least one of them"
    if extent > CIRCLE + min(step, OVERLAP):
        return f"the field of view is more than 2 pi; {NOT_RADIANS}"
    if extent and step > extent and count > 1:
        return f"the resolution is above the field of view{_guess_mistake(extent, step, count)}"
    if extent and step and not agree(extent, step, count, rounding):
        return f"{count - 1} times the resolution is {covered:g}{_guess_mistake(extent, step, count)}"
    if covered > CIRCLE + min(step, OVERLAP):
        return f"{count - 1} times the resolution is {covered:g}, more than 2 pi; {NOT_RADIANS}"
    return ""


def _guess_mistake(extent: float, step: float, count: int) -> str:
    """A guess at what was written in place of a resolution in radians; empty if there is none."""
    if agree(extent, math.radians(step), count):
        return "; is the resolution in degrees, not radians?"
    if step in (count - 1, count, count + 1):
        return "; is it the number of readings?"
    return ""


def _parse_count(fields: list[str], at: int) -> int:
    if len(fields) <= at:
        raise ValueError("it ends before the number of readings")
    count = int(fields[at])
    if count < 1:
        raise ValueError(f"it announces {count} readings")
    return count


def _need_fields(fields: list[str], expected: int, count: int, exact: bool = True) -> None:
    if len(fields) < expected or (exact and len(fields) != expected):
        raise ValueError(f"it announces {count} readings, so {expected} fields, but has {len(fields)}")


def _parse_finite(words: list[str]) -> list[float]:
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError(f"not a finite number among {' '.join(words)}")
    return values
