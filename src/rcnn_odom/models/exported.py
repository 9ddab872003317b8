"""A trained network as it runs on a robot, a shipped one or an exported file, scored like any model."""

from dataclasses import dataclass
from typing import Any, ClassVar

from rcnn_odom.geometry import Steps
from rcnn_odom.models.contract import Model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.models.shipped_files import find_file
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.options import option
from rcnn_odom.recordings.recording import Drive


@dataclass(frozen=True)
class ExportedOptions:
    """What ``conf/model/exported.yaml`` sets.

    Attributes:
        network: a network that ships with the project, or a file of ``rcnn-odom export``.
    """

    network: str = option(
        default="all_round",
        fits=lambda network: bool(network.strip()),
        wanted="a network that ships along, or a file of rcnn-odom export",
    )


class Exported(Model):
    """A network in ONNX Runtime, on whole scans, which its own sensor encodes.

    Raises:
        InputError: no such network, or not one of ``rcnn-odom export``.
    """

    name = "exported"
    Options = ExportedOptions
    uses_depth_vectors: ClassVar[bool] = False

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self._stepper = OnnxStepper(find_file(ExportedOptions(**options).network))

    def tracker(self) -> PairTracker:
        """The same in a stream."""
        return PairTracker(self._stepper)

    def estimate(self, drive: Drive) -> Steps:
        """The steps of one whole drive, those that ``rcnn-odom run --model`` gives."""
        return estimate_by_tracking(self.tracker(), drive.raw_scans())
