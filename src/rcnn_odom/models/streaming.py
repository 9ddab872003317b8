"""The interfaces of a model in a stream of pairs of encoded scans, or of whole scans."""

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray, Step
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.scan import Scan


@dataclass(frozen=True)
class Warping:
    """How a network that measures residual motions is used in a stream.

    Attributes:
        resolution_deg: width of the bins into which scans are rendered, in degrees; None: that of the sensor.
        passes: maximum number of comparisons of each scan; each renders the key scan from the last estimate.
        settled: metres; a scan is not compared again if the last comparison changed its pose by less.
        radians_a_metre: heading error in radians that counts as much as an error of one metre, i.e. one
            divided by a typical range in metres.
        key_distance, key_turn_deg: metres and degrees. Scans are compared with a key scan. A scan that is so
            far from the key scan becomes the new key scan. With 0, each scan is compared with the one before.
    """

    resolution_deg: float | None
    passes: int
    settled: float
    radians_a_metre: float
    key_distance: float
    key_turn_deg: float

    def needs_key(self, pose: FloatArray) -> bool:
        """Whether a scan with this pose (3,) in the frame of the key scan becomes the new key scan."""
        x, y, heading = pose.tolist()
        is_turned = abs(heading) >= math.radians(self.key_turn_deg)
        return math.hypot(x, y) >= self.key_distance or is_turned

    def drawn(self, sensor: Sensor) -> Sensor:
        """The sensor with the bins into which its scans are rendered."""
        return replace(sensor, resolution_deg=self.resolution_deg or sensor.resolution_deg)


@dataclass(frozen=True)
class Description:
    """The description of a model of encoded scans that an odometer needs.

    Attributes:
        sensor: defines how scans are encoded for the model.
        typical_step: root mean square of the training steps' x, y (metres) and heading (radians), which is
            used as the standard deviation of a step without an estimate; nan if unknown.
        least_filled: fraction of bins with a return; scans with less are noted as *few returns*. nan if
            unknown.
        period: median time in seconds between scans in training; nan if unknown.
        warping: how a network that measures residual motions is used; None for other networks, which get
            pairs of encoded scans without changes.
        typical_change: root mean square of the difference between consecutive training steps, in metres,
            metres and radians; nan if unknown.
    """

    sensor: Sensor
    typical_step: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    least_filled: float = np.nan
    period: float = np.nan
    warping: Warping | None = None
    typical_change: tuple[float, float, float] = (np.nan, np.nan, np.nan)

    @property
    def input_sensor(self) -> Sensor:
        """The sensor with the bins of the network's input: those of rendered scans if there is a warping."""
        return self.sensor if self.warping is None else self.warping.drawn(self.sensor)


class Stepper(Protocol):
    """A model in a stream of encoded scans, which estimates one step after the other and keeps its state."""

    description: Description

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""

    def reset(self) -> None:
        """Forgets all earlier pairs."""


class Network(Stepper, Protocol):
    """The additional interface of a network with a :class:`Warping`."""

    def forget_last(self) -> None:
        """Restores the state before the last pair, which the next pair replaces."""


@dataclass(frozen=True, eq=False)
class Registered:
    """The result of a model in a stream for one more scan.

    Attributes:
        step: the step from the scan before; the last motion, with a larger covariance, if there is no
            estimate.
        notes: messages about faults, each with its kind before a colon; empty without a fault.
        is_estimated: whether the step was estimated from this scan, at least in part; otherwise the last
            motion goes on.
    """

    step: Step
    notes: tuple[str, ...] = ()
    is_estimated: bool = True


class ScanTracker(Protocol):
    """A model in a stream of whole scans, which keeps its own state."""

    period: float
    """Usual seconds between scans in training; nan if the model suits any period."""

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan.

        Args:
            scan: as the laser gave it.
            periods: number of usual periods since the last scan, more than 1 over a gap.
            seconds: time since the last scan; None if unknown.
        """

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that cannot be compared with those before: the first one, or one after a clock jump.

        Returns:
            Notes as in :class:`Registered`.
        """

    def reset(self) -> None:
        """Forgets everything: the next scan is the first one, or the laser or its mounting has changed."""

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame; empty if it was not used."""
