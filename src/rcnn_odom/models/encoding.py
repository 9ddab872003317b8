"""Encodes the points of one revolution as a depth vector (paper III-A)."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.options import option
from rcnn_odom.recordings.scan import Scan


@dataclass(frozen=True)
class Sensor:
    """The layout of the depth vectors of a 2D laser.

    Attributes:
        resolution_deg: width of a bin in degrees.
        field_of_view_deg: covered angle in degrees.
        max_range: metres; ranges of this or more are no returns.
        facing_deg: direction of the middle of the field of view, in degrees counter-clockwise from ahead.

    Raises:
        InputError: the field of view is not a whole number of bins, or a value is outside its bounds.

    Example:
        >>> Sensor().bins
        3601
    """

    resolution_deg: float = option(default=0.1, above=0)
    field_of_view_deg: float = option(default=360.0, above=0)
    max_range: float = option(default=80.0, above=0)
    facing_deg: float = option(default=0.0, least=-180.0, wanted="a number of degrees from -180 to 180")

    def __post_init__(self) -> None:
        steps = self.field_of_view_deg / self.resolution_deg if self.resolution_deg > 0 else 0.0
        if not 0 < self.field_of_view_deg <= 360 or abs(steps - round(steps)) > 1e-6 or steps < 1:
            raise InputError(
                f"sensor: a field of view of {self.field_of_view_deg} degrees (at most 360) has no "
                f"whole number of bins of {self.resolution_deg} degrees; change data.sensor"
            )
        if not -180 <= self.facing_deg <= 180:
            raise InputError(f"sensor: data.sensor.facing_deg must be -180 to 180, not {self.facing_deg}")
        if not 0 < self.max_range < float("inf"):
            raise InputError(
                f"sensor: data.sensor.max_range must be positive and finite, not {self.max_range}"
            )

    @property
    def bins(self) -> int:
        """Length of the depth vector: 3601 for the paper's sensor, the last bin closing the circle."""
        return round(self.field_of_view_deg / self.resolution_deg) + 1

    @property
    def first_bin_deg(self) -> float:
        """Direction of the middle of the first bin, at the clockwise end of the field of view."""
        return self.facing_deg - self.field_of_view_deg / 2

    def encode(self, scan: Scan) -> npt.NDArray[np.float32]:
        """The depth vector (bins,) of a scan in metres, 0 without a return.

        If the scan has no bearings, its beams are assumed to cover the field of view evenly.
        """
        return encode(self.bearings_of(scan), scan.ranges, self)

    def bearings_of(self, scan: Scan) -> npt.NDArray[np.float64]:
        """Bearings (P,) of a scan's beams in radians; if unknown, even ones over the field of view."""
        if scan.bearings is not None:
            return scan.bearings
        low, high = np.deg2rad([self.first_bin_deg, self.first_bin_deg + self.field_of_view_deg]).tolist()
        return np.linspace(low, high, len(scan.ranges), endpoint=self.field_of_view_deg != 360)

    def as_dict(self) -> dict[str, Any]:
        """The attributes as plain numbers, for checkpoints and cache keys.

        ``facing_deg`` is left out if it is 0, so that keys of older versions remain valid.
        """
        return {key: value for key, value in asdict(self).items() if key != "facing_deg" or value}


def encode(angles: npt.ArrayLike, ranges: npt.ArrayLike, sensor: Sensor) -> npt.NDArray[np.float32]:
    """Computes the mean range of the returns in every bin (paper III-A).

    Bin i is centred on ``facing - field_of_view / 2 + i * resolution`` degrees from straight ahead,
    counter-clockwise. On a full circle the first and the last bin have the same direction.

    Args:
        angles: (P,) radians, 0 straight ahead; they may lie outside of one turn.
        ranges: (P,) metres. Ranges that are not finite, not positive, or at least ``sensor.max_range`` are no
            returns.
        sensor: defines the bins.

    Returns:
        The depth vector (bins,) in metres, 0 without a return.

    Example:
        >>> sensor = Sensor(resolution_deg=45.0, field_of_view_deg=90.0)
        >>> encode([0.0, 0.1, np.pi / 4], [2.0, 4.0, 5.0], sensor).tolist()
        [0.0, 3.0, 5.0]
    """
    angles = np.asarray(angles, dtype=np.float64)
    ranges = np.asarray(ranges, dtype=np.float64)
    with np.errstate(over="ignore"):  # for faulty angles that are extremely large
        degrees = np.rad2deg(angles)
    returned = (ranges > 0) & (ranges < sensor.max_range) & np.isfinite(degrees)
    # Turned so that bin 0 begins at 0; otherwise rounding could split the bin behind the laser.
    turned = degrees[returned] + (sensor.resolution_deg / 2 - sensor.first_bin_deg)
    index = np.floor((turned % 360.0) / sensor.resolution_deg + 1e-9).astype(np.int64)
    closes_circle = sensor.field_of_view_deg == 360
    distinct = sensor.bins - 1 if closes_circle else sensor.bins
    seen = index < distinct
    if closes_circle:
        index, seen = index % distinct, np.ones_like(seen)
    index, depth = index[seen], ranges[returned][seen]
    count = np.bincount(index, minlength=distinct)
    total = np.bincount(index, weights=depth, minlength=distinct)
    vector = np.zeros(sensor.bins, dtype=np.float32)
    vector[:distinct] = total / np.maximum(count, 1)
    if closes_circle:
        vector[-1] = vector[0]
    return vector


def decode(depth: npt.NDArray[np.float32], sensor: Sensor) -> npt.NDArray[np.float64]:
    """The points (P, 2) of a depth vector (bins,), in metres, in the middles of the bins with a return.

    x points ahead and y to the left.

    Example:
        >>> decode(np.array([0.0, 3.0, 0.0]), Sensor(resolution_deg=45.0, field_of_view_deg=90.0)).tolist()
        [[3.0, 0.0]]
    """
    distinct = depth[:-1] if sensor.field_of_view_deg == 360 else depth
    bins = np.flatnonzero(distinct)
    angles = np.deg2rad(bins * sensor.resolution_deg + sensor.first_bin_deg)
    return depth[bins, None] * np.column_stack([np.cos(angles), np.sin(angles)])
