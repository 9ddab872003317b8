"""A warning if a network that was trained on lasers that turn all round gets a laser that does not."""

import numpy as np

from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.shipped import find_file, shipped_models
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.streaming import Description
from rcnn_odom.recordings.beams import PATIENCE, Beams, compare_beams, find_beams
from rcnn_odom.recordings.scan import Scan

FULL_CIRCLE = 360.0
"""Degrees."""


class LaserViewCheck:
    """Looks at the first scans of a run for a laser that sees only a part of the circle.

    A network that draws its scans as surfaces accepts lasers that see only a part of its sensor's field of
    view (``partly`` in :func:`rcnn_odom.recordings.beams.compare_beams`). This is right for ``half_circle``,
    which was trained on lasers of 180 to 270 degrees, but a network for 360 degrees was trained only on
    lasers that turn all round.

    Args:
        odometer: its model; only a network is checked, also one that gives the matcher its priors.
        model: name of the model for the warning.
        beams: of the laser, if the recording describes them; None: they are found in the scans.
    """

    def __init__(self, odometer: Odometer, model: str, beams: Beams | None) -> None:
        self._model, self._beams = model, beams
        self._is_prior = odometer.sensor is None
        self._is_decided = not _expects_full_circle(odometer.network)
        self._partial = self._full = 0  # scans in a row

    def add(self, scan: Scan) -> str:
        """Returns a warning, once, after five scans in a row that see a part of the circle; otherwise "".

        A laser that is starting up may have few beams in its first scans.
        """
        if self._is_decided:
            return ""
        beams = self._beams or _find_beams(scan)
        if beams is None:
            return ""
        is_full = beams.covered == FULL_CIRCLE
        self._full, self._partial = (self._full + 1, 0) if is_full else (0, self._partial + 1)
        self._is_decided = max(self._full, self._partial) >= PATIENCE
        return self._warning(beams) if self._is_decided and not is_full else ""

    def _warning(self, beams: Beams) -> str:
        network = f"the network of --model {self._model}" if self._is_prior else self._model
        option = "--network" if self._is_prior else "--model"
        advice = "--model matcher works with any laser"
        if fitting := find_shipped_network(beams):
            advice = f"{option} {fitting} was trained on lasers that see a part of the circle"
        return (
            f"{network} has a sensor that turns all round, but the beams of this laser lie {beams}; {advice}"
        )


def find_shipped_network(beams: Beams) -> str:
    """Finds the network that ships with the project for a laser that sees a part of the circle.

    Args:
        beams: of the laser.

    Returns:
        Its name; empty if none fits these beams.
    """
    for name in shipped_models():
        description = OnnxStepper(find_file(name)).description
        if not _expects_full_circle(description) and not compare_beams(
            beams, description.sensor, partly=description.warping is not None
        ):
            return name
    return ""


def _expects_full_circle(network: Description | None) -> bool:
    """Whether a network was trained on lasers that turn all round, and yet accepts others."""
    return (
        network is not None
        and network.warping is not None
        and network.sensor.field_of_view_deg == FULL_CIRCLE
    )


def _find_beams(scan: Scan) -> Beams | None:
    """The beams of a scan; None if it has no return, or does not say where all its beams lie."""
    if scan.bearings is None or not scan.has_all_beams or len(scan.ranges) < 2:
        return None
    if not ((scan.ranges > 0) & np.isfinite(scan.ranges)).any():
        return None
    try:
        return find_beams(scan.bearings)
    except ValueError:  # the network's own check refuses such a scan
        return None
