"""ROS's message LaserScan, from a bag, a live node or rosbridge, as a scan."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.scan import Scan

ANGLES_AGREE = 2.0
"""Beams by which angle_max may be off: drivers count the last one differently."""
LONGEST_SCAN = 10.0
"""Seconds: what claims to take longer says nothing about its beams."""
NO_RETURN_CODE = 0.98
"""Of the largest reading: what lies above is at the constant that a laser writes where nothing came back."""


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
    """The scan of a LaserScan message, whose angles count as ours do (REP 103).

    Some drivers leave a limit at 0 or write nan: a limit that no laser can have limits nothing. Nor does a
    maximum that most readings contradict.

    Args:
        ranges: (P,) metres; nan, and below ``range_min`` no return (REP 117).
        angle_min, angle_increment: radians, of the first beam and from one beam to the next; a negative
            increment is a laser that turns clockwise.
        angle_max: radians, of the last beam; where the increment is 0 or nan, the beams are even up to it.
        range_min, range_max: metres. At ``range_max`` or beyond it a reading is no return, and infinite here.
            A maximum that is nan or not above the minimum is unknown.
        time_increment: seconds from one beam to the next; not positive: unknown.
        scan_time: seconds from one scan to the next, see :func:`assume_even_turn`; not positive, or more
            than ten: unknown.
        stamp: seconds; None where there is no clock.
        frame_id: name of the laser's frame.

    Raises:
        ValueError: the angles do not say where the beams lie.

    >>> from_laser_scan([1.0, 9.0, 0.0], 0.0, 0.5, range_max=8.0).ranges
    array([ 1., inf,  0.])
    """
    with np.errstate(over="ignore", invalid="ignore"):  # encoders leave out bearings that are no numbers
        values = np.array(ranges, dtype=np.float64)
        beam = np.arange(len(values), dtype=np.float64)
        spacing = _spacing(angle_min, angle_increment, angle_max, len(values))
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
    """What a message's angles (radians) say against each other, for a user; empty where they agree.

    An angle_max of 0 or nan was not set.
    """
    covered, said = angle_increment * (count - 1), angle_max - angle_min
    if count < 2 or not angle_increment or not angle_max:
        return ""
    if not abs(covered - said) > ANGLES_AGREE * abs(angle_increment):  # not so of nan
        return ""
    return (
        f"its angle_max says that the beams cover {math.degrees(said):.4g} degrees, its angle_increment and "
        f"{count} readings {math.degrees(covered):.4g}; the latter count"
    )


def has_most_beyond(ranges: FloatArray, limit: float) -> bool:
    """Whether more than half of the readings (P,) are beyond a limit in metres.

    Readings at the largest one do not count, on either side: lasers write it where nothing came back.
    """
    given = ranges[(ranges > 0) & np.isfinite(ranges)]
    measured = given[given < NO_RETURN_CODE * given.max(initial=0.0)]
    return bool(np.count_nonzero(measured > limit) > len(measured) / 2)


def assume_even_turn(scan: Scan) -> Scan:
    """The scan, its beams one after the other as the laser turns, where only the time of a turn is known.

    Not so unless a user says it: drivers of lasers that turn write ``time_increment``; what writes only
    ``scan_time`` is mostly a depth camera, a merger of scans or a cut through a cloud, whose beams were shot
    at once or in another order. A laser of less than 360 degrees turns on unseen: its beams take only their
    part of the turn.

    >>> scan = from_laser_scan([1.0] * 4, 0.0, math.pi / 2, scan_time=0.2)
    >>> scan.times is None, assume_even_turn(scan).times.round(3).tolist()
    (True, [0.0, 0.05, 0.1, 0.15])
    """
    if scan.times is not None or scan.turn_time is None or scan.bearings is None or len(scan.bearings) < 2:
        return scan
    part_of_turn = abs(scan.bearings[1] - scan.bearings[0]) / (2 * math.pi)
    return replace(scan, times=checked_times(scan.turn_time * part_of_turn * np.arange(len(scan.bearings))))


def checked_times(times: FloatArray) -> FloatArray | None:
    """Seconds (P,) of beams after their scan's stamp; None where one is more than ten or no number."""
    return times if bool((np.abs(times) <= LONGEST_SCAN).all()) else None


def _spacing(angle_min: float, angle_increment: float, angle_max: float, count: int) -> float:
    """Radians from beam to beam; some drivers leave it out, and the last beam's angle tells it."""
    if not math.isfinite(angle_min):
        raise ValueError(f"its angle_min is {angle_min}")
    if count < 2 or (math.isfinite(angle_increment) and angle_increment != 0):
        return angle_increment if math.isfinite(angle_increment) else 0.0
    extent = angle_max - angle_min
    if not math.isfinite(extent) or extent == 0:
        raise ValueError(f"its angle_increment is {angle_increment:g} and its angle_max {angle_max:g}")
    return extent / (count - 1)
