"""Methods of the benchmark: models without training, shipped or exported networks, and runs."""

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
"""Creates the tracker of a method for a set; None if the method was not trained for the laser of the set."""


def find_method(name: str, options: dict[str, Any], voxels: dict[str, dict[str, float]]) -> MakeTracker:
    """Finds a method by its name.

    Args:
        name: name of a model without training or of a shipped network, a file of ``rcnn-odom export``, or the
            folder of a run.
        options: options of a model without training.
        voxels: voxel sizes in metres by the name of a model and the kind of place.

    Returns:
        A function that creates the tracker for a set.

    Raises:
        InputError: there is no such method.
    """
    if name in shipped_models() or Path(name).is_file():
        return _network(OnnxStepper(find_file(name)))
    if Path(name).is_dir():
        from rcnn_odom.training.checkpoint import load_module  # Imports Lightning.

        return _network(load_module(Path(name) / BEST).model.stepper())
    model = find_model(name)
    if model.trains:
        raise InputError(
            f"benchmark.method={name}: this network needs training; give a run, outputs/..., or "
            f"one that ships with rcnn-odom ({', '.join(shipped_models())})"
        )
    return lambda loaded: _tracker(model, options, voxels.get(name, {}), loaded)


def _network(stepper: Stepper) -> MakeTracker:
    """Trackers of a network, for the sets whose laser it was trained for."""
    return lambda loaded: PairTracker(stepper) if _is_trained_for_laser(stepper.description, loaded) else None


def _is_trained_for_laser(description: Description, loaded: LoadedSet) -> bool:
    """Whether a network was trained for the laser of a set.

    A network that renders scans accepts beams that are farther apart than those of its sensor, or cover only
    a part of its field of view. But a network for lasers with 360 degrees is only measured with such lasers.
    """
    sensor = description.sensor
    if description.warping is None:
        return sensor == loaded.sensor
    same_kind = (sensor.field_of_view_deg == 360) == (loaded.sensor.field_of_view_deg == 360)
    return same_kind and not BeamCheck(sensor, partly=True)(loaded.scans[0])


def _tracker(
    model: type[Model], options: dict[str, Any], voxels: dict[str, float], loaded: LoadedSet
) -> ScanTracker:
    """The tracker of a model without training, with the voxel size for the set's kind of place.

    Raises:
        InputError: an option is missing, unknown or invalid.
    """
    place = loaded.options["place"]
    chosen = ({"voxel": voxels[place]} if place in voxels else {}) | options
    check_options(model.Options, chosen, "benchmark.options.")
    made = model(chosen, loaded.sensor)
    made.deskew = loaded.deskew
    return made.tracker()
