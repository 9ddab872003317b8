"""ROS's message LaserScan, from a bag, a live node or rosbridge, as a scan."""

import numpy as np
import numpy.typing as npt

from rcnn_odom.recordings.scan import Scan


def from_laser_scan(
    ranges: npt.ArrayLike,
    angle_min: float,
    angle_increment: float,
    range_min: float = 0.0,
    range_max: float = float("inf"),
    time_increment: float = 0.0,
    stamp: float | None = None,
    frame_id: str = "",
) -> Scan:
    """The scan of a LaserScan message, whose angles count as ours do (REP 103).

    Some drivers leave a limit at 0 or write nan: a limit that no laser can have limits nothing.

    Args:
        ranges: (P,) metres; nan, and below ``range_min`` no return (REP 117).
        angle_min, angle_increment: radians, of the first beam and from one beam to the next; a negative
            increment is a laser that turns clockwise.
        range_min, range_max: metres. At ``range_max`` or beyond it a reading is no return, and infinite here.
            A maximum that is nan or not above the minimum is unknown.
        time_increment: seconds from one beam to the next; not positive: unknown.
        stamp: seconds; None where there is no clock.
        frame_id: name of the laser's frame.

    >>> from_laser_scan([1.0, 9.0, 0.0], 0.0, 0.5, range_max=8.0).ranges
    array([ 1., inf,  0.])
    """
    values = np.array(ranges, dtype=np.float64)
    beam = np.arange(len(values), dtype=np.float64)
    if range_max > max(range_min, 0.0):  # not so of nan
        values[values >= range_max] = np.inf
    if 0.0 < range_min < np.inf:
        values[values < range_min] = 0.0
    values[np.isnan(values)] = 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # encoders leave out bearings that are no numbers
        bearings = angle_min + angle_increment * beam
    return Scan(
        ranges=values,
        bearings=bearings,
        times=time_increment * beam if 0 < time_increment < np.inf else None,
        stamp=stamp,
        frame_id=frame_id,
    )
