"""What a model is in a stream: of pairs of encoded scans, or of whole scans."""

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
    """How a network that measures residual motions is used.

    Attributes:
        resolution_deg: width of the bins that scans are drawn into; None: that of the sensor.
        passes: how often each scan is compared at most, each time with the earlier scan seen from the last
            estimate.
        settled: metres; a scan is not compared again after a correction of less than that.
        radians_a_metre: an error of the heading that counts like a metre: one over a usual range in metres.
        key_distance, key_turn_deg: metres and degrees from the key scan, with which all scans are compared,
            from which on the present scan takes its place. 0: every scan, so that each is compared with the
            one before.
    """

    resolution_deg: float | None
    passes: int
    settled: float
    radians_a_metre: float
    key_distance: float
    key_turn_deg: float

    def needs_key(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) in the frame of the key scan is far enough away for a new key."""
        x, y, heading = pose.tolist()
        is_turned = abs(heading) >= math.radians(self.key_turn_deg)
        return math.hypot(x, y) >= self.key_distance or is_turned

    def drawn(self, sensor: Sensor) -> Sensor:
        """The bins that scans of a sensor are drawn into."""
        return replace(sensor, resolution_deg=self.resolution_deg or sensor.resolution_deg)


@dataclass(frozen=True)
class Description:
    """What an odometer has to know of a model that looks at encoded scans.

    Attributes:
        sensor: the laser as the model sees it: how scans are encoded for it.
        typical_step: root mean square of the training steps' x, y (metres) and heading (radians): how wrong
            a step may be that is not known at all. nan if unknown.
        least_filled: share of bins with a return below which a scan counts as sparse; nan if unknown.
        period: usual seconds between scans in training; nan if unknown.
        typical_change: root mean square of the change of steps from scan to scan; nan if unknown.
        warping: how a network that measures residual motions is used; None: it is given pairs as they are.
    """

    sensor: Sensor
    typical_step: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    least_filled: float = np.nan
    period: float = np.nan
    warping: Warping | None = None
    typical_change: tuple[float, float, float] = (np.nan, np.nan, np.nan)

    @property
    def input_sensor(self) -> Sensor:
        """The bins of the pairs that the network itself is given."""
        return self.sensor if self.warping is None else self.warping.drawn(self.sensor)


class Stepper(Protocol):
    """A model in a stream of encoded scans: one step after the other; it carries its own state."""

    description: Description

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""

    def reset(self) -> None:
        """Forgets all earlier pairs."""


class Network(Stepper, Protocol):
    """What a network with a :class:`Warping` is beside that."""

    def forget_last(self) -> None:
        """Forgets the last pair: the next one is compared in its place."""


@dataclass(frozen=True, eq=False)
class Registered:
    """What a model in a stream makes of one more scan.

    Attributes:
        step: from the scan before. Where nothing could be estimated, the last motion, with a covariance that
            says how wrong that may be.
        notes: what the step suffers from, each with its kind before a colon; empty: nothing.
        is_estimated: the step comes from this scan, at least in part; otherwise the last motion went on.
    """

    step: Step
    notes: tuple[str, ...] = ()
    is_estimated: bool = True


class ScanTracker(Protocol):
    """A model in a stream of whole scans: it keeps what it needs of those before."""

    period: float
    """Usual seconds between scans in training; nan: any."""

    def register(self, scan: Scan, periods: int = 1, seconds: float | None = None) -> Registered:
        """The step to one more scan.

        Args:
            scan: as the laser gave it.
            periods: usual times between scans since the last one, more than 1 over a gap.
            seconds: since the last one; None: unknown.
        """

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that cannot be compared with those before: the first, or after a clock was set.

        Returns:
            Notes as in :class:`Registered`.
        """

    def reset(self) -> None:
        """Forgets everything: the next scan is the first of another laser or of another place of it."""

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""

    def returns(self) -> FloatArray:
        """Points (P, 2) in metres of the last scan in the laser's frame; empty where it was not used."""
