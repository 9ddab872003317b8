"""The common parts of the peers: a peer gets a scan and returns its pose, from which the step follows."""

from abc import abstractmethod
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Protocol

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray, Step, Steps, poses_to_planar
from rcnn_odom.models.contract import Model, Registered
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan

FEWEST_POINTS = 10
"""Scans with fewer points are not matched; without any points, some peers would end the process."""


class Aligner(Protocol):
    """A peer with its map or its earlier scans."""

    def add(self, scan: Scan, points: FloatArray) -> FloatArray:
        """Takes one more scan.

        Args:
            scan: as the laser gave it.
            points: (P, 3) returns of the scan in the laser's frame, in metres, with z = 0.

        Returns:
            The peer's estimate of the laser's pose (4, 4), in a frame that does not change.
        """


@dataclass(frozen=True)
class PeerOptions:
    """The options of the peers in ``conf/model``.

    Attributes:
        voxel: metres; size of the peer's cells, which is the resolution of its points and its map.
    """

    voxel: float = option(above=0)


class Peer(Model):
    """Base class for matchers of other projects.

    The covariances of their steps are unknown, and scans are not corrected for the motion during the scan.

    Attributes:
        package: name of the package for ``pip``.
    """

    Options = PeerOptions
    uses_depth_vectors: ClassVar[bool] = False
    package: ClassVar[str]

    @abstractmethod
    def aligner(self) -> Aligner:
        """The peer before its first scan, on one thread.

        Raises:
            InputError: its package is not installed.
        """

    def tracker(self) -> "PeerTracker":
        """The peer in a stream."""
        return PeerTracker(self)

    def estimate(self, drive: Drive) -> Steps:
        """The steps of a whole drive."""
        return estimate_by_tracking(self.tracker(), drive.raw_scans())

    def imported(self, module: str) -> Any:
        """Imports a module of the peer's package.

        Raises:
            InputError: the package is not installed.
        """
        try:
            return import_module(module)
        except ImportError as error:
            raise InputError(
                f"model {self.name}: needs the package {self.package}; pip install 'rcnn-odom[peers]'"
            ) from error


class PeerTracker:
    """A :class:`rcnn_odom.models.streaming.ScanTracker` for a peer.

    Notes are of these kinds:

    - *no match*: the scan has too few returns; the last motion goes on.
    - *error*: the peer raised an error or returned nan; the last motion goes on, and the peer is reset.

    Args:
        peer: makes the aligner.
    """

    period = float("nan")

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._aligner = self._peer.aligner()
        self._pose: FloatArray = np.eye(4)
        self._last = Step(0.0, 0.0, 0.0)
        self._points: FloatArray = np.empty((0, 3))
        self._has_seen = False

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan that the next one can be compared with."""
        return self._has_seen

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan."""
        return self._points[:, :2]

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that cannot be compared with those before."""
        self.reset()
        return self.register(scan).notes

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan; the class lists the notes."""
        self._points = points_of(scan, self._peer.sensor)
        if len(self._points) < FEWEST_POINTS:
            note = f"no match: {len(self._points)} returns, {FEWEST_POINTS} are needed"
            return Registered(self._last, (note,), is_estimated=False)
        try:
            pose = self._aligner.add(scan, self._points)
            if not np.isfinite(pose).all():
                raise ValueError("its pose is not finite")
        except Exception as error:  # the code of another project can raise any error
            self._aligner, self._pose, self._has_seen = self._peer.aligner(), np.eye(4), False
            note = f"error: {self._peer.name}: {type(error).__name__}: {error}"
            return Registered(self._last, (note,), is_estimated=False)
        step = poses_to_planar((np.linalg.inv(self._pose) @ pose)[None])[0]
        first, self._pose, self._has_seen = not self._has_seen, pose, True
        self._last = Step(0.0, 0.0, 0.0) if first else Step(*step.tolist())
        return Registered(self._last)


def points_of(scan: Scan, sensor: Sensor) -> FloatArray:
    """The returns (P, 3) of a scan in metres, x ahead and y to the left, z = 0.

    Args:
        scan: as the laser gave it.
        sensor: ranges of its ``max_range`` or more are no returns; its field of view gives the bearings if
            the scan has none.

    Example:
        >>> points_of(Scan(np.array([1.0, 90.0]), np.array([0.0, 0.5])), Sensor(max_range=80.0)).tolist()
        [[1.0, 0.0, 0.0]]
    """
    bearings = sensor.bearings_of(scan)
    seen = (scan.ranges > 0) & (scan.ranges < sensor.max_range) & np.isfinite(bearings)
    ranges, bearings = scan.ranges[seen], bearings[seen]
    return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings), np.zeros(len(ranges))])
