"""What can be measured: models that do not train, shipped or exported networks, and runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcnn_odom.deployment.shipped import find_file, shipped_models
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST
from rcnn_odom.models.contract import Description, Model, ScanTracker, Stepper, find_model
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.options import check_options
from rcnn_odom.recordings.beams import BeamCheck
from rcnn_odom.training.benchmark.sets import LoadedSet

MakeTracker = Callable[[LoadedSet], ScanTracker | None]
"""The method before its first scan of a set; None where it does not know the set's laser."""


def find_method(name: str, options: dict[str, Any], voxels: dict[str, dict[str, float]]) -> MakeTracker:
    """A method by its name.

    Args:
        name: of a model that does not train or of a shipped network, a file of ``rcnn-odom export``, or a
            run's folder.
        options: of a model that does not train.
        voxels: metres by a model's name and the kind of place, for models that need one.

    Raises:
        InputError: no such method.
    """
    if name in shipped_models() or Path(name).is_file():
        return _network(OnnxStepper(find_file(name)))
    if Path(name).is_dir():
        from rcnn_odom.training.checkpoint import load_module  # with Lightning

        return _network(load_module(Path(name) / BEST).model.stepper())
    model = find_model(name)
    if model.trains:
        raise InputError(
            f"benchmark.method={name}: a network is measured as trained; give its run, outputs/..., or "
            f"one that ships with rcnn-odom ({', '.join(shipped_models())})"
        )
    return lambda loaded: _tracker(model, options, voxels.get(name, {}), loaded)


def _network(stepper: Stepper) -> MakeTracker:
    """A network on the sets of lasers that it was trained for."""
    return lambda loaded: PairTracker(stepper) if _knows_laser(stepper.description, loaded) else None


def _knows_laser(description: Description, loaded: LoadedSet) -> bool:
    """Whether a set's laser is one that a network was trained for.

    Where scans are drawn, beams may be farther apart than the sensor's and cover a part of its field of view.
    But what has learned from lasers that turn all round is not measured on those that do not.
    """
    sensor = description.sensor
    if description.warping is None:
        return sensor == loaded.sensor
    same_kind = (sensor.field_of_view_deg == 360) == (loaded.sensor.field_of_view_deg == 360)
    return same_kind and not BeamCheck(sensor, partly=True)(loaded.scans[0])


def _tracker(
    model: type[Model], options: dict[str, Any], voxels: dict[str, float], loaded: LoadedSet
) -> ScanTracker:
    """A model that does not train, with the voxel of the set's kind of place.

    Raises:
        InputError: an option is missing, unknown or has no meaning.
    """
    place = loaded.options["place"]
    chosen = ({"voxel": voxels[place]} if place in voxels else {}) | options
    check_options(model.Options, chosen, "benchmark.options.")
    made = model(chosen, loaded.sensor)
    made.deskew = loaded.deskew
    return made.tracker()
