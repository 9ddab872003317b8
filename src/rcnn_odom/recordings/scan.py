"""The input of all estimators: one revolution of a 2D laser."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class Scan:
    """One revolution of a 2D laser, as the laser measured it: not resampled and not cut.

    Attributes:
        ranges: (P,) metres. A range that is not positive or not finite is no return.
        bearings: (P,) radians, 0 ahead, counter-clockwise; any part of the circle, in either direction. None:
            the beams lie evenly over the field of view of the sensor that the estimator expects.
        times: (P,) seconds of the beams after ``stamp``; None: unknown, taken as all at once.
        stamp: seconds; None if the source has no clock.
        frame_id: name of the laser's frame; empty if unknown.
        has_all_beams: whether the scan also holds the beams without a return, which show spacing and extent
            of the beams; False for returns alone, such as the points of a cloud.
        wheel_pose: x and y in metres and heading in radians of the laser at the time of the scan, from the
            robot's own odometry and in its frame; None: unknown.
        turn_time: seconds of a whole turn of the laser; None: unknown. It does not imply ``times``: devices
            that measure all beams at once give it as well.
    """

    ranges: FloatArray
    bearings: FloatArray | None = None
    times: FloatArray | None = None
    stamp: float | None = None
    frame_id: str = ""
    has_all_beams: bool = True
    wheel_pose: tuple[float, float, float] | None = None
    turn_time: float | None = None

    def __post_init__(self) -> None:
        for values in (self.bearings, self.times):
            if self.ranges.ndim != 1 or (values is not None and values.shape != self.ranges.shape):
                raise ValueError(
                    f"a scan has ranges (P,) and as many bearings and times, not {self.ranges.shape} with "
                    f"{None if values is None else values.shape}"
                )

    @classmethod
    def from_points(
        cls,
        points: npt.ArrayLike,
        stamp: float | None = None,
        frame_id: str = "",
        times: FloatArray | None = None,
    ) -> "Scan":
        """Make a scan from the points of its returns.

        Args:
            points: (P, 2 or more) metres, x ahead and y to the left.
            stamp, frame_id, times: as in :class:`Scan`.

        Raises:
            ValueError: the points have another shape.

        >>> Scan.from_points([[0.0, 2.0]]).bearings.round(3)
        array([1.571])
        """
        values = np.asarray(points, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] < 2:
            raise ValueError(f"points are (P, 2 or more), not {values.shape}")
        x, y = values[:, 0], values[:, 1]
        return cls(np.hypot(x, y), np.arctan2(y, x), times, stamp, frame_id, has_all_beams=False)

    def points(self) -> FloatArray:
        """The returns as points (R, 2) in metres, x ahead and y to the left; other beams are left out.

        Raises:
            ValueError: the scan has no bearings.

        >>> Scan(np.array([2.0, 0.0]), np.array([np.pi / 2, 0.0])).points().round(3).tolist()
        [[0.0, 2.0]]
        """
        if self.bearings is None:
            raise ValueError("the scan has no bearings, so the directions of its beams are unknown")
        seen = (self.ranges > 0) & np.isfinite(self.ranges) & np.isfinite(self.bearings)
        ranges, bearings = self.ranges[seen], self.bearings[seen]
        return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
