"""Loads trained networks from checkpoints. Only plain data is loaded, so that a file cannot run code."""

import hashlib
from dataclasses import asdict
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.two_numbers import steps_of
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training.modules import OdometryModule, module_for
from rcnn_odom.training.saving import AtomicCheckpointIO

ARCHIVE = b"PK\x03\x04"
"""First bytes of every file that ``torch.save`` writes."""
GIVE = "give RUN/checkpoints/best.ckpt of a run"

OLD_PREFIXES = {
    "network.": "model.",
    "uncertainty.least_filled": "model.least_filled",
    "uncertainty.period": "model.period",
    "uncertainty.": "model.uncertainty.",
}
"""New prefixes of the names of weights of version 0.1; the first that matches is used."""


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads a checkpoint; its arrays are memory maps of the file.

    Raises:
        InputError: there is no such file, or it has other objects than tensors, numbers, strings, lists and
            dictionaries. Such objects could run code.
    """
    _check_beginning(Path(path))
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        if not isinstance(saved, dict):
            raise TypeError(f"it holds a {type(saved).__name__}")
    except Exception as error:  # A damaged or foreign file can raise any error.
        raise _checkpoint_error(path, error) from error
    return saved


def _check_beginning(path: Path) -> None:
    """Refuses a file that is clearly not a checkpoint, for which torch has only long messages.

    Raises:
        InputError: there is no such file, or it is a folder, empty, or not an archive of ``torch.save``.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(len(ARCHIVE))
    except FileNotFoundError:
        raise InputError(f"{path}: no such checkpoint; {GIVE}") from None
    except OSError as error:
        raise InputError(f"{path}: not a checkpoint that can be read ({error.strerror}); {GIVE}") from error
    if beginning != ARCHIVE:
        what = "not a checkpoint" if beginning else "empty, not a checkpoint"
        raise InputError(f"{path}: {what}; {GIVE}")


def _checkpoint_error(path: str | Path, error: Exception) -> InputError:
    """The error for a file that is not a checkpoint of this project."""
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    if isinstance(error, UnpicklingError):  # Its message tells how to load the file nevertheless.
        reason = "it holds more than numbers"
    return InputError(
        f"{path}: not a checkpoint of this project, or of an older version ({reason}); train again"
    )


def load_module(path: str | Path, variant: str | None = None, sensor: Sensor | None = None) -> OdometryModule:
    """Loads the trained module of a checkpoint, on the CPU and in evaluation mode.

    Args:
        path: a ``.ckpt`` file of a run, also of version 0.1.
        variant: the required model; None: any.
        sensor: the required sensor; None: any.

    Raises:
        InputError: there is no such file, it is not a checkpoint of this project, or it has another model or
            sensor.
    """
    saved = read_checkpoint(path)
    try:
        if "scoring" in saved["hyper_parameters"]:
            _upgrade(saved)
        settings = saved["hyper_parameters"]
        found = settings["variant"]
        module = module_for(found)(settings["model"], settings["sensor"], settings["lengths"])
        module.load_state_dict(saved["state_dict"])
    except Exception as error:  # A damaged or foreign file can raise any error.
        raise _checkpoint_error(path, error) from error
    if variant is not None and found != variant:
        raise InputError(f"{path}: a checkpoint of {found}, but {variant} is needed")
    if sensor is not None:
        _compare_sensors(path, Sensor(**settings["sensor"]), sensor)
    return module.eval()


def _compare_sensors(path: str | Path, own: Sensor, sensor: Sensor) -> None:
    """Compares the sensor of a network with that of the data.

    Args:
        path: path of the checkpoint.
        own: the sensor of the network.
        sensor: the sensor of the data.

    Raises:
        InputError: they differ; the message names the differences.
    """
    trained, given = asdict(own), asdict(sensor)
    different = [name for name in given if trained[name] != given[name]]
    if different:
        need = " ".join(f"data.sensor.{name}={trained[name]}" for name in different)
        have = " and ".join(f"{name}={given[name]}" for name in different)
        raise InputError(
            f"{path}: trained with {need}, but the data has {have}; set data.sensor as in training, or train "
            "on this data"
        )


def weights_fingerprint(path: str | Path) -> str:
    """Hash of the weights and buffers in a checkpoint; it does not depend on the file's name.

    Raises:
        InputError: see :func:`read_checkpoint`.
    """
    saved, digest = read_checkpoint(path), hashlib.sha256()
    try:
        for name, value in sorted(saved["state_dict"].items()):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.contiguous().view(-1).numpy().tobytes())
    except Exception as error:  # A damaged or foreign file can raise any error.
        raise _checkpoint_error(path, error) from error
    return digest.hexdigest()[:16]


def _upgrade(saved: dict[str, Any]) -> None:
    """Converts a checkpoint of version 0.1 to the present format, in place.

    The networks of version 0.1 estimated two numbers, distance and heading change. ``apply`` was stored
    beside the lengths of the validation drift, and there were no statistics of steps.
    """
    settings, old = saved["hyper_parameters"], saved["state_dict"]
    scoring = settings.pop("scoring")
    settings["model"] = {**settings["model"], "apply": scoring["apply"]}
    settings["model"].pop("variant")
    settings["lengths"] = scoring["lengths"]
    weights = {}
    for name, value in old.items():
        prefix = next(old for old in OLD_PREFIXES if name.startswith(old))
        weights[OLD_PREFIXES[prefix] + name.removeprefix(prefix)] = value
    mean, deviation = (old[f"network.head.{name}"].double() for name in ("mean", "deviation"))
    distance, turn = (mean.square() + deviation.square()).sqrt().tolist()
    weights["mean_step"] = torch.from_numpy(steps_of(mean.numpy(), scoring["apply"])).float()
    weights["model.typical_step"] = torch.tensor([distance, np.nan, turn])
    weights["model.uncertainty.lateral"] = torch.tensor(np.nan)
    saved["state_dict"] = weights


def calibrate(path: Path, drives: list[Drive]) -> OdometryModule:
    """Calibrates the model of a checkpoint on validation drives and saves the result in the checkpoint.

    Args:
        path: a ``.ckpt`` file of a run; it is replaced atomically.
        drives: validation drives with ground truth.

    Returns:
        The calibrated module.

    Raises:
        InputError: see :func:`load_module`.
    """
    module = load_module(path)
    module.model.calibrate(drives)
    saved = read_checkpoint(path)
    saved["state_dict"] = module.state_dict()
    AtomicCheckpointIO().save_checkpoint(saved, path)
    return module
