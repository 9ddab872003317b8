"""Scan matching with a network's steps as priors: the network adds what the scans do not determine."""

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
from rcnn_odom.models.streaming import Description, Stepper
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive, wants_deskew
from rcnn_odom.recordings.scan import Scan

HELD = "held"
"""Option that uses the matcher's last motion, weighted by its covariance, in place of a network."""
INFLATION = 2.0
"""Factor of a network's standard deviations.

They were fitted on places like those of the training, and the errors of consecutive scans are correlated.
"""
LEAST_DISTANCE, LEAST_TURN = 0.01, 0.002
"""Metres and radians; minimal errors of a network, which are added to its own standard deviations."""
AVERAGED_MATCHES = 50.0
"""Number of recent matches over which the network's errors are averaged."""
NETWORK_STEP = "the network's step is used"
"""What happens where the scan does not determine the motion; notes on the scan contain this."""
NO_PRIOR = "no prior"
"""Kind of fault, with which the note begins."""


@dataclass(frozen=True)
class FusedOptions:
    """The options of ``conf/model/fused.yaml``.

    Attributes:
        network: name of a network that ships with the project, path of a file that ``rcnn-odom export`` has
            written, or ``held`` for the matcher's last motion.

    Example:
        >>> FusedOptions()
        FusedOptions(network='all_round')
    """

    network: str = option(
        default="all_round",
        fits=lambda network: bool(network.strip()),
        wanted="the name of a shipped network, a file that rcnn-odom export has written, or held",
    )


class NetworkPrior:
    """A :class:`rcnn_odom.models.prior.PriorSource` that takes the steps of a network of pairs of scans.

    The prior is the weighted mean of the network's step and the last motion. A step with unknown covariance
    (nan) is only the initial guess of the match. If the network gives no step, for instance because the scans
    are not from its laser, the matcher continues without it, with the note *no prior*.

    Args:
        stepper: the network, without earlier scans.

    Attributes:
        description: that of the network.
        period: seconds between scans in its training.
    """

    def __init__(self, stepper: Stepper) -> None:
        self._tracker = PairTracker(stepper)
        self.description, self.period = self._tracker.description, self._tracker.period
        self._forget()

    def reset(self) -> None:
        """Forgets everything."""
        self._tracker.reset()
        self._forget()

    def _forget(self) -> None:
        self._step: Step | None = None
        self._errors = np.ones(3)  # means of the network's squared errors divided by its variances

    def begin(self, scan: Scan) -> tuple[str, ...]:
        """Takes a scan that is not compared with those before; returns a note if it cannot be used."""
        self._step = None
        notes = self._tracker.begin(scan)
        return () if self.has_seen else _without_prior(notes)

    @property
    def has_seen(self) -> bool:
        """Whether there is a scan with returns that the next one can be compared with."""
        return self._tracker.has_seen

    def expect(
        self, scan: Scan, periods: int, seconds: float | None, last_motion: Prior
    ) -> tuple[Prior, tuple[str, ...]]:
        """The prior from the network's step and the last motion, or the last motion alone; and notes."""
        if not self.has_seen:
            return last_motion, self.begin(scan)
        found = self._tracker.register(scan, periods, seconds)
        # A step after scans without returns begins at the pose that the network predicted, not the matcher.
        if not found.is_estimated or self._tracker.corrects_prediction:
            self._step = None
            return last_motion, _without_prior(found.notes)
        self._step = _inflate(found.step)
        factors = np.sqrt(np.maximum(self._errors, 1.0))
        x, y, heading = found.step.array().tolist()
        measured = Step(x, y, heading, self._step.covariance * np.outer(factors, factors))
        return make_prior(measured, last_motion), ()

    def compare(self, step: FloatArray, is_determined: bool) -> None:
        """Updates the network's mean errors in this environment from a match that needed no prior."""
        if self._step is None or not (is_determined and np.isfinite(self._step.covariance).all()):
            return
        difference = step - self._step.array()
        difference[2] = wrap_angle(difference[2])
        self._errors += (difference**2 / np.diag(self._step.covariance) - self._errors) / AVERAGED_MATCHES


def _inflate(step: Step) -> Step:
    """A network's step with a larger covariance, which also suits places unlike those of its training."""
    least = np.diag(np.square([LEAST_DISTANCE, LEAST_DISTANCE, LEAST_TURN]))
    return Step(step.x, step.y, step.heading, INFLATION**2 * step.covariance + least)


def make_prior(measured: Step, last_motion: Prior) -> Prior:
    """The prior from a measured step and the last motion: their mean, weighted by their covariances.

    Args:
        measured: the step; with an unknown covariance (nan) it is only the initial guess of the match.
        last_motion: the prior from the last motion.

    Example:
        Both have the same covariance, so that the prior lies in the middle:

        >>> last_motion = Prior(np.array([1.0, 0.0, 0.0]), np.eye(3))
        >>> make_prior(Step(2.0, 0.0, 0.0, np.eye(3)), last_motion).step.tolist()
        [1.5, 0.0, 0.0]
    """
    difference = measured.array() - last_motion.step
    difference[2] = wrap_angle(difference[2])
    if not np.isfinite(measured.covariance).all():
        spread = last_motion.covariance + np.diag(difference**2)
        return Prior(last_motion.step + difference, spread, None, NETWORK_STEP, comes_from_scan=True)
    gain = last_motion.covariance @ np.linalg.inv(last_motion.covariance + measured.covariance)
    rest = np.eye(3) - gain
    covariance = rest @ last_motion.covariance @ rest.T + gain @ measured.covariance @ gain.T
    return Prior(
        last_motion.step + gain @ difference,
        covariance,
        measured.covariance,
        NETWORK_STEP,
        comes_from_scan=True,
    )


def _without_prior(notes: tuple[str, ...]) -> tuple[str, ...]:
    """The note that there is no step of the network, with the notes on the scan as its reasons."""
    return (f"{NO_PRIOR}: {', '.join(notes)}, and scan matching goes on alone",)


class FusedTracker(MatcherTracker):
    """The matcher with priors from another source, usually a network.

    Args:
        source: source of the priors.
        deskew: as in :class:`rcnn_odom.models.matcher.MatcherTracker`.

    Attributes:
        period: seconds between scans in the training of the source; nan without one.
        description: that of the source's network; None without one.
    """

    def __init__(self, source: PriorSource, deskew: bool = True) -> None:
        super().__init__(deskew=deskew, source=source)
        self.period = getattr(source, "period", self.period)
        self.description: Description | None = getattr(source, "description", None)


def fused_tracker(network: str, deskew: bool = True, threads: int = 1) -> FusedTracker:
    """Makes the matcher with a network's steps as priors.

    Args:
        network: as in :class:`FusedOptions`.
        deskew: as in :class:`FusedTracker`.
        threads: number of threads for the network.

    Raises:
        InputError: the file does not exist, or ``rcnn-odom export`` has not written it.
    """
    source = LastMotion(is_measured=True) if network == HELD else _load_network(network, threads)
    return FusedTracker(source, deskew)


def _load_network(network: str, threads: int) -> NetworkPrior:
    return NetworkPrior(OnnxStepper(find_file(network), threads))


class Fused(Model):
    """Scan matching with the steps of a trained network as its priors.

    Raises:
        InputError: there is no such network.
    """

    name = "fused"
    Options = FusedOptions
    uses_depth_vectors: ClassVar[bool] = False

    def __init__(self, options: dict[str, str], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        if (network := options["network"]) != HELD:
            find_file(network)  # reports a missing file before any recording is read

    def tracker(self) -> FusedTracker:
        """The tracker for a stream of scans, with the same options."""
        return fused_tracker(self.options["network"], self.deskew != "off")

    def estimate(self, drive: Drive) -> Steps:
        """The steps of a whole drive, which equal those of ``rcnn-odom run --model fused``.

        Raises:
            InputError: ``rcnn-odom export`` has not written the network's file.
        """
        deskew = wants_deskew(self.deskew, drive.is_compensated)
        return estimate_by_tracking(fused_tracker(self.options["network"], deskew), drive.raw_scans())
