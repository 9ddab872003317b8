"""Scan matching (stub that holds still; the algorithm follows)."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rcnn_odom.geometry import FloatArray, Step, Steps
from rcnn_odom.models.contract import Model, Registered
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan


@dataclass(frozen=True)
class MatcherOptions:
    """What ``conf/model/matcher.yaml`` sets."""

    wheels: bool = False


class MatcherTracker:
    """Registers each scan against a map of those before."""

    period = float("nan")

    def __init__(self, wheels: bool = False, deskew: bool = True) -> None:
        self.wheels, self.deskew = wheels, deskew
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._points: FloatArray = np.empty((0, 2))
        self.has_seen = False

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """The first scan."""
        self.has_seen = bool((scan.ranges > 0).any())
        return ()

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan."""
        return Registered(Step(0.0, 0.0, 0.0, np.eye(3)))

    def returns(self) -> FloatArray:
        """Points (P, 2) of the last scan."""
        return self._points


class Matcher(Model):
    """Odometry by scan matching, for any 2D laser, without training."""

    name = "matcher"
    Options = MatcherOptions
    uses_depth_vectors: ClassVar[bool] = False

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)

    def tracker(self) -> MatcherTracker:
        """The same in a stream."""
        return MatcherTracker(**self.options)

    def stepper(self) -> Any:
        """There is none: it looks at whole scans."""
        raise NotImplementedError

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive."""
        raise NotImplementedError
