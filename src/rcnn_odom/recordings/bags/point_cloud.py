"""ROS's message PointCloud2 of a laser with many beams, cut to what one planar laser sees."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from rcnn_odom.recordings.beams import Beams, find_beams
from rcnn_odom.recordings.laser_scan import checked_times
from rcnn_odom.recordings.velodyne import FARTHEST

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Of fields, by the numbers of sensor_msgs/msg/PointField."""
RING_FIELDS = ("ring", "channel")
"""Names under which drivers write which of their lasers saw a point."""
PLANE = 1e-3
"""Metres between the lowest and the highest point of a laser that has a single plane."""
TIME_FIELDS = ("time", "t", "timestamp", "offset_time", "time_stamp")
"""Names under which drivers write when a point was seen."""
NANOSECONDS = 1e12
"""Seconds that no clock shows: such numbers are nanoseconds."""
LONG_AGO = 1e6
"""Seconds: such times are not after the stamp of a cloud, but of a clock."""
SAME_BEAM_DEG = 0.01
"""Bearings closer than this are of one beam, seen twice."""
MOST_SPREAD = np.deg2rad(1.0)
"""Of a ring about its cone: in another frame than its laser's it is wider."""
LEAST_POINTS = 30
"""Of a cut cloud, to tell the spacing of its beams."""

IN_ITS_FRAME = "publish it in its laser's frame, or choose --ring N or --height"

Points: TypeAlias = npt.NDArray[np.floating]


class Cloud(NamedTuple):
    """The returns of one revolution.

    Attributes:
        points: (P, 3) metres.
        rings: by name of the numbering, (P,) the number of the ring of each point: ``ring`` as the message
            has it; ``row`` and ``column`` of a cloud that lies in a grid.
        times: (P,) as the message has them, see :func:`seconds_after`; None: it has none.
    """

    points: Points
    rings: dict[str, npt.NDArray[np.integer]]
    times: npt.NDArray[Any] | None = None


Cut: TypeAlias = Callable[[Cloud], npt.NDArray[np.bool_]]
"""Which points (P,) of a cloud a planar laser sees."""


def read_cloud(message: Any) -> Cloud:
    """The returns of a message PointCloud2; what is not finite, or lies in the laser itself, is none.

    Raises:
        ValueError: it has no x, y or z, or fewer bytes than it promises.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"it has no field {' and no '.join(missing)}, only {', '.join(fields) or 'none'}")
    ring = next((name for name in RING_FIELDS if name in fields), None)
    time = next((name for name in TIME_FIELDS if _lies_within(fields.get(name), message)), None)
    grid = _grid(message, [fields[name] for name in ("x", "y", "z", ring, time) if name])
    points = np.stack([grid[name] for name in "xyz"], axis=-1)  # (rows, columns, 3)
    seen = (np.abs(points) < FARTHEST).all(-1) & points.any(-1)  # not so of nan
    rings = {}
    if ring:
        rings["ring"] = np.clip(np.nan_to_num(grid[ring][seen]), -1e9, 1e9).astype(np.int64)
    if len(grid) > 1:
        rings["row"], rings["column"] = np.nonzero(seen)
    return Cloud(points[seen], rings, grid[time][seen] if time else None)


def _lies_within(field: Any, message: Any) -> bool:
    """Whether a field is there and can be read: points without times are points all the same."""
    if field is None or int(field.datatype) not in TYPES:
        return False
    size = np.dtype(TYPES[int(field.datatype)]).itemsize
    return 0 <= int(field.offset) <= int(message.point_step) - size


def seconds_after(stamp: float | None, times: npt.NDArray[Any]) -> npt.NDArray[np.float64] | None:
    """Seconds (P,) of points after the stamp of their cloud.

    Drivers write whole numbers of nanoseconds (Ouster's ``t``, Livox's ``offset_time``) or seconds as a
    fraction (Velodyne's ``time``), after the stamp or since 1970 (``timestamp``, Livox's in nanoseconds).

    Args:
        stamp: seconds; None: unknown.
        times: (P,) as they are in the message.

    Returns:
        None where a point is more than ten seconds away or its time no number, and where all are the same.
    """
    if not len(times):
        return np.zeros(0)
    since = times.min()
    if not np.isfinite(since) or since == times.max():  # min is nan where one is
        return None
    is_nanoseconds = times.dtype.kind in "iu" or abs(since) > NANOSECONDS
    unit = 1e-9 if is_nanoseconds else 1.0
    seconds = unit * (times - since).astype(np.float64)  # of large numbers the small difference
    start = unit * float(since)
    if abs(start) > LONG_AGO:
        start = math.nan if stamp is None else start - stamp
    return checked_times(start + seconds)


def _grid(message: Any, fields: Sequence[Any]) -> npt.NDArray[Any]:
    """Some fields of the points, (rows, columns)."""
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
    # In a cloud of one row the length of a row says nothing, and some drivers leave it out.
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
    """What makes a planar laser's points of each cloud of a recording, and words about it.

    That is the ring nearest to level (see :mod:`rcnn_odom.recordings.velodyne`), told from where the beams
    meet if the clouds were raised, as to the base of a robot; of clouds that do not say
    rings, the points at the elevation of the most level beam; of clouds in one plane all.

    Args:
        clouds: the first of the recording, each with points.
        ring: another one than the most level one.
        height: metres from and to, in the frame of the cloud: cuts a slice instead.

    Raises:
        ValueError: there is no such ring, no rings, or no beam near level; ring and height are given; or the
            clouds are not in the laser's frame.
    """
    if height is not None:
        if ring is not None:
            raise ValueError("a ring and a height are two ways to cut it; give one of them")
        low, high = height
        about = f"points at heights of {low:g} to {high:g} m"
        return lambda cloud: _between(cloud.points[:, 2], low, high), about
    if ring is None and all(np.ptp(cloud.points[:, 2]) <= PLANE for cloud in clouds):
        return lambda cloud: np.ones(len(cloud.points), bool), "all points, which lie in one plane"
    if ring is None:
        _check_steepness(clouds)
    numbering = _find_numbering(clouds)
    if numbering is not None:
        return _cut_ring(clouds, numbering, ring)
    if ring is not None:
        raise ValueError("its points do not say rings; leave the ring out, or cut at a height with --height")
    return _cut_elevation(clouds)


def estimate_beams(clouds: Sequence[Cloud], cut: Cut) -> Beams | None:
    """The beams of which these points are the remaining returns; None: the points do not tell.

    What the laser covers is told by all points of the clouds, since one ring may have no return in a part.
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
    """Which numbering of rings the clouds have; None: none.

    Rings that are all the same are none. A grid's rings are its rows or its columns, whichever are more
    level.
    """
    if all("ring" in cloud.rings for cloud in clouds):
        numbers = np.concatenate([cloud.rings["ring"] for cloud in clouds])
        if np.ptp(numbers) > 0:
            return "ring"
    if not all("row" in cloud.rings for cloud in clouds):
        return None
    spread = {
        name: np.median([s for cloud in clouds for s in _of_rings(cloud, name, np.std).values()])
        for name in ("row", "column")
    }
    return min(spread, key=lambda name: float(spread[name]))


def _of_rings(cloud: Cloud, numbering: str, function: Callable[[Points], Any]) -> dict[int, float]:
    """A function of the elevations (P,) in radians of each ring."""
    rings = _rings_of(cloud, numbering)
    return {number: float(function(_elevations(points, 0.0))) for number, points in rings.items()}


def _rings_of(cloud: Cloud, numbering: str) -> dict[int, Points]:
    """The points (P, 3) of each ring."""
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
    from rcnn_odom.recordings.laser_frame import cone_spread, find_rise, lowered
    from rcnn_odom.recordings.velodyne import LEVEL, NEAR_LEVEL

    rings: dict[int, list[Points]] = {}
    for cloud in clouds:
        for number, points in _rings_of(cloud, numbering).items():
            rings.setdefault(number, []).append(points)
    rise = find_rise(points for of_ring in rings.values() for points in of_ring)
    elevations = {
        number: float(np.median([np.median(_elevations(points, rise)) for points in of_ring]))
        for number, of_ring in rings.items()
    }
    if ring is None:
        ring = min(elevations, key=lambda number: abs(elevations[number] - LEVEL))
        if abs(elevations[ring] - LEVEL) > NEAR_LEVEL:
            raise ValueError(
                f"no {numbering} is within 2 degrees of level, the nearest is {ring} at "
                f"{np.rad2deg(elevations[ring]):+.1f}; choose one with --ring, or cut at a height with "
                "--height"
            )
        spread = cone_spread([lowered(points, rise) for points in rings[ring]])
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
    from rcnn_odom.recordings.velodyne import are_at, find_level_beam, median_elevation, points_at

    try:
        beam = find_level_beam([cloud.points for cloud in clouds])
    except ValueError as error:
        raise ValueError(f"{error}; cut at a height with --height") from error
    elevation = np.rad2deg(median_elevation(np.concatenate([points_at(c.points, *beam) for c in clouds])))
    about = f"the beam at {elevation:+.2f} degrees is taken by elevation, since the points say no rings"
    return lambda cloud: are_at(cloud.points, *beam), about


def _bearings(points: Points) -> npt.NDArray[np.float64]:
    return np.arctan2(points[:, 1], points[:, 0], dtype=np.float64)


def _spacing_deg(points: Points) -> float | None:
    """Degrees between neighbouring beams; None: there are too few."""
    gaps = np.diff(np.sort(np.rad2deg(_bearings(points))))
    gaps = gaps[gaps > SAME_BEAM_DEG]
    return float(np.median(gaps)) if len(gaps) >= LEAST_POINTS else None
