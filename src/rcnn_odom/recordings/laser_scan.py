"""Converts ROS's message LaserScan, from a bag, a live node or rosbridge, to a scan."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.scan import Scan

ANGLES_AGREE = 2.0
"""Beam spacings by which angle_max may be off: drivers count the last beam differently."""
LONGEST_SCAN = 10.0
"""Seconds; longer times within a scan are taken to be wrong."""
NO_RETURN_CODE = 0.98
"""Readings above this part of the largest one are the constant that a laser writes for no return."""


def from_laser_scan(
    ranges: npt.ArrayLike,
    angle_min: float,
    angle_increment: float,
    angle_max: float = math.nan,
    range_min: float = 0.0,
    range_max: float = math.inf,
    time_increment: float = 0.0,
    scan_time: float = 0.0,
    stamp: float | None = None,
    frame_id: str = "",
) -> Scan:
    """Make a scan from the fields of a LaserScan message; angles have the same convention (REP 103).

    Some drivers leave a limit at 0 or nan, so impossible limits are ignored. A maximum range is ignored as
    well if most readings lie beyond it.

    Args:
        ranges: (P,) metres; nan and readings below ``range_min`` are no returns (REP 117).
        angle_min, angle_increment: radians, angle of the first beam and from one beam to the next; the
            increment of a laser that turns clockwise is negative.
        angle_max: radians, angle of the last beam; used if the increment is 0 or nan.
        range_min, range_max: metres. A reading at or beyond ``range_max`` is no return and becomes infinite.
            A maximum that is nan or not above the minimum is unknown.
        time_increment: seconds from one beam to the next; not positive: unknown.
        scan_time: seconds from one scan to the next, see :func:`assume_even_turn`; not positive, or more
            than ten: unknown.
        stamp: seconds; None if there is no clock.
        frame_id: name of the laser's frame.

    Raises:
        ValueError: the directions of the beams do not follow from the angles.

    >>> from_laser_scan([1.0, 9.0, 0.0], 0.0, 0.5, range_max=8.0).ranges
    array([ 1., inf,  0.])
    """
    with np.errstate(over="ignore", invalid="ignore"):  # encoders omit bearings that are not finite
        values = np.array(ranges, dtype=np.float64)
        beam = np.arange(len(values), dtype=np.float64)
        spacing = _compute_spacing(angle_min, angle_increment, angle_max, len(values))
        bearings = angle_min + spacing * beam
    # Comparisons with nan are false.
    if range_max > max(range_min, 0.0) and not has_most_beyond(values, range_max):
        values[values >= range_max] = np.inf
    if 0.0 < range_min < np.inf:
        values[values < range_min] = 0.0
    values[np.isnan(values)] = 0.0
    return Scan(
        ranges=values,
        bearings=bearings,
        times=checked_times(time_increment * beam) if 0 < time_increment < math.inf else None,
        stamp=stamp,
        frame_id=frame_id,
        turn_time=scan_time if 0 < scan_time <= LONGEST_SCAN else None,
    )


def compare_angles(angle_min: float, angle_increment: float, angle_max: float, count: int) -> str:
    """Check that the angles of a message agree.

    Args:
        angle_min, angle_increment, angle_max: radians; an angle_max of 0 or nan was not set.
        count: number of readings.

    Returns:
        A message about the contradiction; empty if the angles agree.

    >>> compare_angles(0.0, 0.5, 1.0, 3)
    ''
    """
    covered, extent = angle_increment * (count - 1), angle_max - angle_min
    if count < 2 or not angle_increment or not angle_max:
        return ""
    if not abs(covered - extent) > ANGLES_AGREE * abs(angle_increment):  # False for nan
        return ""
    return (
        f"its angle_max says that the beams cover {math.degrees(extent):.4g} degrees, its angle_increment "
        f"and {count} readings say {math.degrees(covered):.4g}; angle_max is not used"
    )


def has_most_beyond(ranges: FloatArray, limit: float) -> bool:
    """Whether more than half of the readings (P,) are beyond a limit in metres.

    Readings near the largest one are left out of the count, because many lasers write it for no return.

    >>> has_most_beyond(np.array([3.0, 9.0, 9.5, 81.0, 81.0]), limit=8.0)
    True
    """
    given = ranges[(ranges > 0) & np.isfinite(ranges)]
    measured = given[given < NO_RETURN_CODE * given.max(initial=0.0)]
    return bool(np.count_nonzero(measured > limit) > len(measured) / 2)


def assume_even_turn(scan: Scan) -> Scan:
    """Give the beams of a scan the times of a steady turn, if only the time of a whole turn is known.

    Use it only if the user says that the laser turns. Drivers of such lasers write ``time_increment``. A
    source with only ``scan_time`` is mostly a depth camera, a merger of scans or a slice of a cloud, whose
    beams were measured at once or in another order. A laser with a field of view below 360 degrees spends
    only a part of the turn on its beams.

    >>> scan = from_laser_scan([1.0] * 4, 0.0, math.pi / 2, scan_time=0.2)
    >>> scan.times is None, assume_even_turn(scan).times.round(3).tolist()
    (True, [0.0, 0.05, 0.1, 0.15])
    """
    if scan.times is not None or scan.turn_time is None or scan.bearings is None or len(scan.bearings) < 2:
        return scan
    part_of_turn = abs(scan.bearings[1] - scan.bearings[0]) / (2 * math.pi)
    return replace(scan, times=checked_times(scan.turn_time * part_of_turn * np.arange(len(scan.bearings))))


def checked_times(times: FloatArray) -> FloatArray | None:
    """Check the times of beams.

    Args:
        times: (P,) seconds after the stamp of the scan.

    Returns:
        The times; None if one is nan or above ``LONGEST_SCAN``.
    """
    return times if bool((np.abs(times) <= LONGEST_SCAN).all()) else None


def _compute_spacing(angle_min: float, angle_increment: float, angle_max: float, count: int) -> float:
    """Radians from beam to beam; taken from the angle of the last beam if the increment is missing."""
    if not math.isfinite(angle_min):
        raise ValueError(f"its angle_min is {angle_min}")
    if count < 2 or (math.isfinite(angle_increment) and angle_increment != 0):
        return angle_increment if math.isfinite(angle_increment) else 0.0
    extent = angle_max - angle_min
    if not math.isfinite(extent) or extent == 0:
        raise ValueError(f"its angle_increment is {angle_increment:g} and its angle_max {angle_max:g}")
    return extent / (count - 1)
