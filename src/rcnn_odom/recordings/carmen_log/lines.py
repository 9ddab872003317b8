"""What one laser line of a CARMEN log says, and whether it agrees with itself.

The lines, one blank between fields::

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
"""Radians: by no more than this do the beams of a laser that turns all round overlap."""
NOT_RADIANS = "are its angles in degrees, not radians?"


class LaserLine(NamedTuple):
    """What one laser line says; angles in radians, lengths in metres.

    The spacing is negative where the beams run clockwise. A maximum that most readings contradict is
    doubted: it is infinite here, as an unknown one is.
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
    """A FLASER line, whose beams lie symmetrically about straight ahead.

    Raises:
        ValueError: it is broken, or its number of readings is not that of the laser.
    """
    count = _count(fields, 1)
    _need_fields(fields, 2 + count + 9, count)
    if not front.fits(count):
        raise ValueError(
            f"{count} readings, {math.degrees(front.resolution):.4g} degrees apart by the log's PARAM lines, "
            f"do not cover {math.degrees(front.field_of_view):.4g} degrees; if they do, say so with {OPTION}"
        )
    pose = _finite(fields[2 + count : 9 + count])
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
    """A ROBOTLASER1 line, which says itself where its beams lie.

    Raises:
        ValueError: it is broken, or its angles do not fit each other or its number of readings.
    """
    count = _count(fields, 8)
    _need_fields(fields, 10 + count, count, exact=False)
    remissions = int(fields[9 + count])
    _need_fields(fields, 24 + count + remissions, count)
    spacing, maximum = _spacing(fields[3], fields[4], count), float(fields[5])
    readings = np.array([float(word) for word in fields[9 : 9 + count]])
    doubted = maximum > 0 and has_most_beyond(readings, maximum)
    poses = _finite(fields[10 + count + remissions : 16 + count + remissions])
    return LaserLine(
        kind=fields[0],
        readings=readings,
        first_angle=_start_angle(fields[2]),
        spacing=spacing,
        maximum=maximum if maximum > 0 and not doubted else math.inf,
        laser=poses[:3],
        robot=poses[3:],
        stamp=_finite(fields[-3:-2])[0],
        is_maximum_doubted=doubted,
    )


PARSERS = {"FLASER": parse_flaser, "ROBOTLASER1": parse_robotlaser}


def _start_angle(word: str) -> float:
    [angle] = _finite([word])
    if abs(angle) > CIRCLE:
        raise ValueError(f"a start angle of {angle:g} is more than 2 pi; {NOT_RADIANS}")
    return angle


def _spacing(fov_word: str, resolution_word: str, count: int) -> float:
    """Radians from beam to beam, counter-clockwise, from what a line says of them.

    The sign is that of the resolution, and of the field of view only where there is no resolution.

    Raises:
        ValueError: field of view, resolution and number of readings do not fit.
    """
    field_of_view, resolution = _finite([fov_word, resolution_word])
    extent, step = (0.0 if abs(value) < PRINTED else abs(value) for value in (field_of_view, resolution))
    rounding = rounding_of(resolution_word) if step else 0.0
    if fault := _misfit(extent, step, count, rounding):
        raise ValueError(
            f"a field of view of {field_of_view:g} and a resolution of {resolution:g} do not fit {count} "
            f"readings: {fault}"
        )
    if not step:
        return even_spacing(field_of_view, count)
    if extent and not agree(extent, step, count):
        step = even_spacing(extent, count)  # too few digits of the resolution were printed
    return math.copysign(step, resolution)


def _misfit(extent: float, step: float, count: int, rounding: float) -> str:
    """Why a field of view and a resolution (radians, 0: unknown) cannot be; empty where they can."""
    covered = step * (count - 1)
    if not extent and not step:
        return "both are 0; write at least one of them"
    if extent > CIRCLE + min(step, OVERLAP):
        return f"the field of view is more than 2 pi; {NOT_RADIANS}"
    if extent and step > extent and count > 1:
        return f"the resolution is above the field of view{_unit(extent, step, count)}"
    if extent and step and not agree(extent, step, count, rounding):
        return f"{count - 1} times the resolution is {covered:g}{_unit(extent, step, count)}"
    if covered > CIRCLE + min(step, OVERLAP):
        return f"{count - 1} times the resolution is {covered:g}, more than 2 pi; {NOT_RADIANS}"
    return ""


def _unit(extent: float, step: float, count: int) -> str:
    """What was perhaps written in place of a resolution in radians."""
    if agree(extent, math.radians(step), count):
        return "; is the resolution in degrees, not radians?"
    if step in (count - 1, count, count + 1):
        return "; is it the number of readings?"
    return ""


def _count(fields: list[str], at: int) -> int:
    if len(fields) <= at:
        raise ValueError("it ends before the number of readings")
    count = int(fields[at])
    if count < 1:
        raise ValueError(f"it announces {count} readings")
    return count


def _need_fields(fields: list[str], expected: int, count: int, exact: bool = True) -> None:
    if len(fields) < expected or (exact and len(fields) != expected):
        raise ValueError(f"it announces {count} readings, so {expected} fields, but has {len(fields)}")


def _finite(words: list[str]) -> list[float]:
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise ValueError(f"not a finite number among {' '.join(words)}")
    return values
