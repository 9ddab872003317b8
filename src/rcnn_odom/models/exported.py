"""An exported network as it runs on a robot, as a model that can be evaluated like any other."""

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
    """The options of ``conf/model/exported.yaml``.

    Attributes:
        network: name of a network that ships with the project, or path of a file that ``rcnn-odom export``
            has written.

    Example:
        >>> ExportedOptions()
        ExportedOptions(network='all_round')
    """

    network: str = option(
        default="all_round",
        fits=lambda network: bool(network.strip()),
        wanted="the name of a shipped network, or a file that rcnn-odom export has written",
    )


class Exported(Model):
    """A network in ONNX Runtime, whose own sensor encodes the scans.

    Raises:
        InputError: there is no such network, or ``rcnn-odom export`` has not written its file.
    """

    name = "exported"
    Options = ExportedOptions
    uses_depth_vectors: ClassVar[bool] = False

    def __init__(self, options: dict[str, Any], sensor: Sensor) -> None:
        super().__init__(options, sensor)
        self._stepper = OnnxStepper(find_file(ExportedOptions(**options).network))

    def tracker(self) -> PairTracker:
        """The tracker for a stream of scans."""
        return PairTracker(self._stepper)

    def estimate(self, drive: Drive) -> Steps:
        """The steps of a whole drive, which equal those of ``rcnn-odom run --model``."""
        return estimate_by_tracking(self.tracker(), drive.raw_scans())
