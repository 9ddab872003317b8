"""A network's step as the prior of the matcher's match: each where the other knows little."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rcnn_odom.geometry import FloatArray, Step, Steps, wrap_angle
from rcnn_odom.models.contract import Model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.matcher import MatcherTracker
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.models.prior import LastMotion, Prior, PriorSource
from rcnn_odom.models.shipped_files import find_file
from rcnn_odom.models.streaming import Stepper
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive, wants_deskew
from rcnn_odom.recordings.scan import Scan

HELD = "held"
"""In place of a network: the matcher's own last motion, which pulls by its covariance."""
INFLATION = 2.0
"""Times a network's deviations: they were fitted on places like those of its training, and its errors of
scans in a row are alike."""
LEAST_DISTANCE, LEAST_TURN = 0.01, 0.002
"""Metres and radians by which a network is off at least, beside what it says."""
COMPARED = 50.0
"""Matches over which the network's errors are averaged, while they need no prior."""
STANDS = "the network tells it"
NO_PRIOR = "no prior"
"""Kind of trouble."""


@dataclass(frozen=True)
class FusedOptions:
    """What ``conf/model/fused.yaml`` sets.

    Attributes:
        network: a network that ships with the project, a file of ``rcnn-odom export``, or ``held``.
    """

    network: str = option(
        default="all_round",
        fits=lambda network: bool(network.strip()),
        wanted="a network that ships along, a file of rcnn-odom export, or held",
    )


class NetworkPrior:
    """The steps of a network of pairs of scans as a :class:`rcnn_odom.models.prior.PriorSource`.

    A step whose covariance is unknown, nan, is only where the match begins. Otherwise it pulls, and the last
    motion has the say in what the network itself does not know. Where the network gives no step, for
    instance since the scans are of another laser than its own, the matcher goes on alone, and says so
    (*no prior*).

    Args:
        stepper: the network, at its start.

    Attributes:
        period: seconds between scans in its training.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._tracker = PairTracker(stepper)
        self.period = self._tracker.period
        self._forget()

    def reset(self) -> None:
        """Forgets everything."""
        self._tracker.reset()
        self._forget()

    def _forget(self) -> None:
        self._told: Step | None = None
        self._errors = np.ones(3)  # mean squares of its errors over the variances that it told

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that is not compared with those before; why the network cannot."""
        self._told = None
        notes = self._tracker.begin(scan)
        return () if self.has_seen else _without_prior(notes)

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""
        return self._tracker.has_seen

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, held: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The network's step, or the last motion where it has none."""
        if not self.has_seen:
            return held, self.begin(scan)
        found = self._tracker.register(scan, periods, seconds)
        if not found.is_estimated:
            self._told = None
            return held, _without_prior(found.notes)
        self._told = _widen(found.step)
        larger = np.sqrt(np.maximum(self._errors, 1.0))
        x, y, heading = found.step.array().tolist()
        told = Step(x, y, heading, self._told.covariance * np.outer(larger, larger))
        return make_prior(told, held), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """Learns from a match that needs no prior how far off the network is in this place."""
        if self._told is None or not (is_determined and np.isfinite(self._told.covariance).all()):
            return
        off = step - self._told.array()
        off[2] = wrap_angle(off[2])
        self._errors += (off**2 / np.diag(self._told.covariance) - self._errors) / COMPARED


def _widen(step: Step) -> Step:
    """A network's step with deviations that fit other places than those of its training."""
    least = np.diag(np.square([LEAST_DISTANCE, LEAST_DISTANCE, LEAST_TURN]))
    return Step(step.x, step.y, step.heading, INFLATION**2 * step.covariance + least)


def make_prior(told: Step, held: Prior) -> Prior:
    """A measured step as a prior: the mean of it and of the last motion, each by its weight.

    Args:
        told: the step; where its covariance is nan, it is only where the match begins.
        held: the last motion.
    """
    off = told.array() - held.step
    off[2] = wrap_angle(off[2])
    if not np.isfinite(told.covariance).all():
        spread = held.covariance + np.diag(off**2)
        return Prior(held.step + off, spread, None, STANDS, comes_from_scan=True)
    gain = held.covariance @ np.linalg.inv(held.covariance + told.covariance)
    rest = np.eye(3) - gain
    covariance = rest @ held.covariance @ rest.T + gain @ told.covariance @ gain.T
    return Prior(held.step + gain @ off, covariance, told.covariance, STANDS, comes_from_scan=True)


def _without_prior(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Why there is no step of the network, in one note."""
    return (f"{NO_PRIOR}: {', '.join(notes)}, and scan matching goes on alone",)


class FusedTracker(MatcherTracker):
    """The matcher with the steps of a network as its priors.

    Args:
        source: of the priors.
        deskew: as of :class:`rcnn_odom.models.matcher.MatcherTracker`.
    """

    def __init__(self, source: PriorSource, deskew: bool = True) -> None:
        super().__init__(deskew=deskew, source=source)
        self.period = getattr(source, "period", self.period)


def fused_tracker(network: str, deskew: bool = True, threads: int = 1) -> FusedTracker:
    """The matcher with a network's steps as priors.

    Args:
        network, deskew: as of :class:`FusedOptions` and :class:`FusedTracker`.
        threads: of the network's computation.

    Raises:
        InputError: no such file, or none of ``rcnn-odom export``.
    """
    source = LastMotion(is_measured=True) if network == HELD else _load(network, threads)
    return FusedTracker(source, deskew)


def _load(network: str, threads: int) -> NetworkPrior:
    return NetworkPrior(OnnxStepper(find_file(network), threads))


class Fused(Model):
    """The matcher with the steps of a trained network as its priors."""

    name = "fused"
    Options = FusedOptions
    uses_depth_vectors: ClassVar[bool] = False

    def __init__(self, options: dict[str, str], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        if (network := options["network"]) != HELD:
            find_file(network)  # before any recording is read

    def tracker(self) -> FusedTracker:
        """The same in a stream."""
        return fused_tracker(self.options["network"], self.deskew != "off")

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive, those that ``rcnn-odom run --model fused`` gives."""
        deskew = wants_deskew(self.deskew, drive.is_compensated)
        return estimate_by_tracking(fused_tracker(self.options["network"], deskew), drive.raw_scans())
