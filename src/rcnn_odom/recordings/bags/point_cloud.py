"""Reads ROS's message PointCloud2 of a laser with many beams, and cuts it to the scan of a planar laser."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from rcnn_odom.recordings.beams import Beams, find_beams
from rcnn_odom.recordings.laser_scan import checked_times
from rcnn_odom.recordings.velodyne import FARTHEST

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of fields by the numbers of sensor_msgs/msg/PointField."""
RING_FIELDS = ("ring", "channel")
"""Drivers' names of the field with the number of the laser that measured a point."""
PLANE = 1e-3
"""Metres; largest difference in z between the points of a laser with a single plane."""
TIME_FIELDS = ("time", "t", "timestamp", "offset_time", "time_stamp")
"""Drivers' names of the field with the time of a point."""
NANOSECONDS = 1e12
"""Larger times are in nanoseconds, because no clock shows so many seconds."""
LONG_AGO = 1e6
"""Seconds; larger times are those of a clock, not times after the stamp of the cloud."""
SAME_BEAM_DEG = 0.01
"""Points whose bearings differ by less are of the same beam."""
MOST_SPREAD = np.deg2rad(1.0)
"""Largest spread of a ring about its cone; it is larger if the frame is not the laser's."""
LEAST_POINTS = 30
"""Least number of gaps between points from which the spacing of beams is found."""

IN_ITS_FRAME = "publish it in its laser's frame, or choose --ring N or --height"

Points: TypeAlias = npt.NDArray[np.floating]


class Cloud(NamedTuple):
    """The returns of one revolution.

    Attributes:
        points: (P, 3) metres.
        rings: for each numbering of rings, (P,) the ring of each point: ``ring`` from the field of the
            message; ``row`` and ``column`` in a cloud that is a grid.
        times: (P,) as in the message, see :func:`seconds_after`; None: the message has no times.
    """

    points: Points
    rings: dict[str, npt.NDArray[np.integer]]
    times: npt.NDArray[Any] | None = None


Cut: TypeAlias = Callable[[Cloud], npt.NDArray[np.bool_]]
"""Gives the mask (P,) of the points of a cloud that belong to the planar scan."""


def read_cloud(message: Any) -> Cloud:
    """Read the returns of a PointCloud2 message; points that are not finite or at the origin are left out.

    Raises:
        ValueError: the message has no x, y or z, or fewer bytes than its size requires.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"it has no field {' and no '.join(missing)}, only {', '.join(fields) or 'none'}")
    ring = next((name for name in RING_FIELDS if name in fields), None)
    time = next((name for name in TIME_FIELDS if _lies_within(fields.get(name), message)), None)
    grid = _read_grid(message, [fields[name] for name in ("x", "y", "z", ring, time) if name])
    points = np.stack([grid[name] for name in "xyz"], axis=-1)  # (rows, columns, 3)
    seen = (np.abs(points) < FARTHEST).all(-1) & points.any(-1)  # False for nan
    rings = {}
    if ring:
        rings["ring"] = np.clip(np.nan_to_num(grid[ring][seen]), -1e9, 1e9).astype(np.int64)
    if len(grid) > 1:
        rings["row"], rings["column"] = np.nonzero(seen)
    return Cloud(points[seen], rings, grid[time][seen] if time else None)


def _lies_within(field: Any, message: Any) -> bool:
    """Whether an optional field exists and can be read."""
    if field is None or int(field.datatype) not in TYPES:
        return False
    size = np.dtype(TYPES[int(field.datatype)]).itemsize
    return 0 <= int(field.offset) <= int(message.point_step) - size


def seconds_after(stamp: float | None, times: npt.NDArray[Any]) -> npt.NDArray[np.float64] | None:
    """Convert the times of points to seconds after the stamp of their cloud.

    Drivers write integer nanoseconds (Ouster's ``t``, Livox's ``offset_time``) or seconds as floats
    (Velodyne's ``time``), either after the stamp or since 1970 (``timestamp``, Livox's in nanoseconds).

    Args:
        stamp: seconds; None: unknown.
        times: (P,) as in the message.

    Returns:
        (P,) seconds. None if a time is not finite or more than ten seconds from the stamp, or if all times
        are equal.

    >>> seconds_after(100.0, np.array([0, 50_000_000], dtype=np.uint32))
    array([0.  , 0.05])
    """
    if not len(times):
        return np.zeros(0)
    since = times.min()
    if not np.isfinite(since) or since == times.max():  # min is nan if any time is nan
        return None
    is_nanoseconds = times.dtype.kind in "iu" or abs(since) > NANOSECONDS
    unit = 1e-9 if is_nanoseconds else 1.0
    seconds = unit * (times - since).astype(np.float64)  # subtracted first, because the times may be large
    start = unit * float(since)
    if abs(start) > LONG_AGO:
        start = math.nan if stamp is None else start - stamp
    return checked_times(start + seconds)


def _read_grid(message: Any, fields: Sequence[Any]) -> npt.NDArray[Any]:
    """Read some fields of all points into a structured array (rows, columns).

    Raises:
        ValueError: a field has an unknown type or lies outside of a point, or bytes are missing.
    """
    rows, columns, step = int(message.height), int(message.width), int(message.point_step)
    order = ">" if message.is_bigendian else "<"
    try:
        layout = np.dtype(
            {
                "names": [field.name for field in fields],
                "formats": [order + TYPES[int(field.datatype)] for field in fields],
                "offsets": [int(field.offset) for field in fields],
                "itemsize": step,
            }
        )
    except (KeyError, ValueError) as error:
        raise ValueError("its fields are of no known type, or lie outside of a point") from error
    if rows * columns == 0:
        return np.zeros((0, 0), layout)
    # In a cloud of one row, the length of a row is not needed, and some drivers do not set it.
    row_step = step * columns if rows == 1 or message.row_step == 0 else int(message.row_step)
    content = np.ascontiguousarray(message.data, dtype=np.uint8)
    needed = (rows - 1) * row_step + columns * step
    if row_step < columns * step or needed > len(content):
        raise ValueError(
            f"{rows} x {columns} points of {step} bytes do not fit into its {len(content)} bytes"
        )
    return np.ndarray((rows, columns), layout, content.data, strides=(row_step, step))


def choose_cut(
    clouds: Sequence[Cloud], ring: int | None = None, height: tuple[float, float] | None = None
) -> tuple[Cut, str]:
    """Choose how the clouds of a recording are cut to planar scans.

    If the clouds have rings, it is the ring nearest to level (see :mod:`rcnn_odom.recordings.velodyne`),
    seen from where the beams meet, in case the clouds were shifted along z, for instance to the base of a
    robot. If they have no rings, it is the points at the elevation of the most level beam. If all points lie
    in one plane, it is all points.

    Args:
        clouds: the first clouds of the recording, each with points.
        ring: number of a ring; None: the most level one.
        height: lowest and highest z in metres in the frame of the cloud: cut a slice instead of a ring.

    Returns:
        The cut, and a note about it.

    Raises:
        ValueError: there is no such ring, no rings, or no beam near level; ring and height are both given; or
            the clouds are not in the laser's frame.
    """
    if height is not None:
        if ring is not None:
            raise ValueError("a ring and a height are two ways to cut it; give one of them")
        low, high = height
        note = f"points at heights of {low:g} to {high:g} m"
        return lambda cloud: _between(cloud.points[:, 2], low, high), note
    if ring is None and all(np.ptp(cloud.points[:, 2]) <= PLANE for cloud in clouds):
        return lambda cloud: np.ones(len(cloud.points), bool), "all points, which lie in one plane"
    if ring is None:
        _check_steepness(clouds)
    numbering = _find_numbering(clouds)
    if numbering is not None:
        return _cut_ring(clouds, numbering, ring)
    if ring is not None:
        raise ValueError("its points have no rings; leave the ring out, or cut at a height with --height")
    return _cut_elevation(clouds)


def estimate_beams(clouds: Sequence[Cloud], cut: Cut) -> Beams | None:
    """Estimate the beams of the laser from the returns of a cut.

    The spacing is found from the cut, the covered angle from all points of the clouds, because a single ring
    may have no return in a part of it.

    Returns:
        The beams; None if there are too few points.
    """
    spacings = [_spacing_deg(cloud.points[cut(cloud)]) for cloud in clouds]
    known = [spacing for spacing in spacings if spacing is not None]
    if not known:
        return None
    seen = [np.unique(np.floor(np.rad2deg(_bearings(cloud.points)))) for cloud in clouds]
    degrees = np.unique(np.concatenate(seen)) + 0.5
    try:
        found = find_beams(np.deg2rad(degrees))
    except ValueError:
        return None
    return Beams(found.first, found.covered, float(np.median(known)))


def _check_steepness(clouds: Sequence[Cloud]) -> None:
    from rcnn_odom.recordings.laser_frame import describe_steepness

    if fault := describe_steepness([cloud.points for cloud in clouds]):
        raise ValueError(f"{fault}; {IN_ITS_FRAME}")


def _between(heights: Points, low: float, high: float) -> npt.NDArray[np.bool_]:
    between: npt.NDArray[np.bool_] = (heights >= low) & (heights <= high)
    return between


def _find_numbering(clouds: Sequence[Cloud]) -> str | None:
    """Name of the clouds' numbering of rings; None if they have none.

    A ``ring`` that is equal for all points is not used. In a grid, the rings are the rows or the columns,
    whichever have the smaller spread in elevation.
    """
    if all("ring" in cloud.rings for cloud in clouds):
        numbers = np.concatenate([cloud.rings["ring"] for cloud in clouds])
        if np.ptp(numbers) > 0:
            return "ring"
    if not all("row" in cloud.rings for cloud in clouds):
        return None
    spread = {
        name: np.median([s for cloud in clouds for s in _spreads_of_rings(cloud, name)])
        for name in ("row", "column")
    }
    return min(spread, key=lambda name: float(spread[name]))


def _spreads_of_rings(cloud: Cloud, numbering: str) -> list[float]:
    """Standard deviation in radians of the elevations of each ring."""
    return [float(np.std(_elevations(points, 0.0))) for points in _rings_of(cloud, numbering).values()]


def _rings_of(cloud: Cloud, numbering: str) -> dict[int, Points]:
    """Points (Q, 3) of each ring, by its number."""
    rings = cloud.rings[numbering]
    order = np.argsort(rings, kind="stable")
    numbers, starts = np.unique(rings[order], return_index=True)
    points = np.split(cloud.points[order].astype(np.float64), starts[1:])
    return dict(zip(map(int, numbers), points, strict=True))


def _elevations(points: Points, height: float) -> Points:
    x, y, z = points.T
    elevations: Points = np.arctan2(z - height, np.hypot(x, y))
    return elevations


def _cut_ring(clouds: Sequence[Cloud], numbering: str, ring: int | None) -> tuple[Cut, str]:
    """Cut of a ring, by default the one nearest to level; and a note about it."""
    from rcnn_odom.recordings.laser_frame import cone_spread, find_rise, lower_points
    from rcnn_odom.recordings.velodyne import LEVEL, NEAR_LEVEL

    rings: dict[int, list[Points]] = {}
    for cloud in clouds:
        for number, points in _rings_of(cloud, numbering).items():
            rings.setdefault(number, []).append(points)
    rise = find_rise(points for frames in rings.values() for points in frames)
    elevations = {
        number: float(np.median([np.median(_elevations(points, rise)) for points in frames]))
        for number, frames in rings.items()
    }
    if ring is None:
        ring = min(elevations, key=lambda number: abs(elevations[number] - LEVEL))
        if abs(elevations[ring] - LEVEL) > NEAR_LEVEL:
            raise ValueError(
                f"no {numbering} is within 2 degrees of level, the nearest is {ring} at "
                f"{np.rad2deg(elevations[ring]):+.1f}; choose one with --ring, or cut at a height with "
                "--height"
            )
        spread = cone_spread([lower_points(points, rise) for points in rings[ring]])
        if spread > MOST_SPREAD:
            raise ValueError(
                f"the points of {numbering} {ring} lie {np.rad2deg(spread):.1f} degrees from their cone, so "
                f"the cloud is not in its laser's frame; {IN_ITS_FRAME}"
            )
    elif ring not in elevations:
        raise ValueError(
            f"there is no {numbering} {ring}, they are {min(elevations)} to {max(elevations)}; choose "
            "one of them"
        )
    chosen = ring

    def cut(cloud: Cloud) -> npt.NDArray[np.bool_]:
        if numbering not in cloud.rings:
            raise ValueError(f"it has no {numbering}s")
        return cloud.rings[numbering] == chosen

    seen_from = f" from {rise:+.2f} m, where the beams meet" if rise else ""
    return cut, f"{numbering} {ring}, median elevation {np.rad2deg(elevations[ring]):+.2f} degrees{seen_from}"


def _cut_elevation(clouds: Sequence[Cloud]) -> tuple[Cut, str]:
    """Cut at the elevation of the beam nearest to level; and a note about it."""
    from rcnn_odom.recordings.velodyne import are_at, find_level_beam, median_elevation, points_at

    try:
        beam = find_level_beam([cloud.points for cloud in clouds])
    except ValueError as error:
        raise ValueError(f"{error}; cut at a height with --height") from error
    elevation = np.rad2deg(median_elevation(np.concatenate([points_at(c.points, *beam) for c in clouds])))
    note = f"the beam at {elevation:+.2f} degrees is found by elevation, because the points have no rings"
    return lambda cloud: are_at(cloud.points, *beam), note


def _bearings(points: Points) -> npt.NDArray[np.float64]:
    return np.arctan2(points[:, 1], points[:, 0], dtype=np.float64)


def _spacing_deg(points: Points) -> float | None:
    """Degrees between neighbouring beams; None if there are too few points."""
    gaps = np.diff(np.sort(np.rad2deg(_bearings(points))))
    gaps = gaps[gaps > SAME_BEAM_DEG]
    return float(np.median(gaps)) if len(gaps) >= LEAST_POINTS else None
