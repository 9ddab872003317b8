"""Trained networks from disk, never trusting the file with more than numbers."""

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
"""How every file of ``torch.save`` begins."""
GIVE = "give RUN/checkpoints/best.ckpt of a run"

OLD_PLACES = {
    "network.": "model.",
    "uncertainty.least_filled": "model.least_filled",
    "uncertainty.period": "model.period",
    "uncertainty.": "model.uncertainty.",
}
"""Where weights of version 0.1 have gone, by the beginning of their names; the first that fits counts."""


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """What a checkpoint holds, its arrays as maps of the file.

    Raises:
        InputError: no such file, or it holds anything but numbers, strings, lists and dictionaries: objects
            could run a stranger's code.
    """
    _check_beginning(Path(path))
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        if not isinstance(saved, dict):
            raise TypeError(f"it holds a {type(saved).__name__}")
    except Exception as error:  # whatever the bytes of a stranger's file lead to
        raise _refusal(path, error) from error
    return saved


def _check_beginning(path: Path) -> None:
    """Refuses a file that is plainly no checkpoint, of which torch would say much.

    Raises:
        InputError: there is no such file, or it is a folder, empty, or no archive as torch writes them.
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


def _refusal(path: str | Path, error: Exception) -> InputError:
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    if isinstance(error, UnpicklingError):  # torch adds how to load it all the same
        reason = "it holds more than numbers"
    return InputError(
        f"{path}: not a checkpoint of this project, or of an older version ({reason}); train again"
    )


def load_module(path: str | Path, variant: str | None = None, sensor: Sensor | None = None) -> OdometryModule:
    """The trained module of a checkpoint, on the CPU, in evaluation mode.

    Args:
        path: a ``.ckpt`` file of a run, also of version 0.1.
        variant: the model that it must be of; None for any.
        sensor: which it must have been trained for; None for any.

    Raises:
        InputError: no such file, not a checkpoint of this project, of another model or sensor.
    """
    saved = read_checkpoint(path)
    try:
        if "scoring" in saved["hyper_parameters"]:
            _upgrade(saved)
        settings = saved["hyper_parameters"]
        found = settings["variant"]
        module = module_for(found)(settings["model"], settings["sensor"], settings["lengths"])
        module.load_state_dict(saved["state_dict"])
    except Exception as error:  # whatever a stranger's file holds
        raise _refusal(path, error) from error
    if variant is not None and found != variant:
        raise InputError(f"{path}: a checkpoint of {found}, but {variant} is needed")
    if sensor is not None:
        _compare_sensors(path, Sensor(**settings["sensor"]), sensor)
    return module.eval()


def _compare_sensors(path: str | Path, own: Sensor, sensor: Sensor) -> None:
    """Refuses a network whose sensor is another one than the data's; names what differs.

    Raises:
        InputError: it is.
    """
    theirs, ours = asdict(own), asdict(sensor)
    others = [name for name in ours if theirs[name] != ours[name]]
    if others:
        need = " ".join(f"data.sensor.{name}={theirs[name]}" for name in others)
        have = " and ".join(f"{name}={ours[name]}" for name in others)
        raise InputError(
            f"{path}: trained with {need}, but the data has {have}; set data.sensor as in training, or train "
            "on this data"
        )


def weights_fingerprint(path: str | Path) -> str:
    """Hash of the weights and scales in a checkpoint, wherever the file is.

    Raises:
        InputError: as :func:`read_checkpoint`.
    """
    saved, digest = read_checkpoint(path), hashlib.sha256()
    try:
        for name, value in sorted(saved["state_dict"].items()):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.contiguous().view(-1).numpy().tobytes())
    except Exception as error:  # whatever a stranger's file holds
        raise _refusal(path, error) from error
    return digest.hexdigest()[:16]


def _upgrade(saved: dict[str, Any]) -> None:
    """Brings a checkpoint of version 0.1 into today's form.

    There a network knew two numbers only: ``apply`` stood beside the lengths of the validation drift, and
    nothing was known of steps.
    """
    settings, old = saved["hyper_parameters"], saved["state_dict"]
    scoring = settings.pop("scoring")
    settings["model"] = {**settings["model"], "apply": scoring["apply"]}
    settings["model"].pop("variant")
    settings["lengths"] = scoring["lengths"]
    weights = {}
    for name, value in old.items():
        before = next(beginning for beginning in OLD_PLACES if name.startswith(beginning))
        weights[OLD_PLACES[before] + name.removeprefix(before)] = value
    mean, deviation = (old[f"network.head.{name}"].double() for name in ("mean", "deviation"))
    distance, turn = (mean.square() + deviation.square()).sqrt().tolist()
    weights["mean_step"] = torch.from_numpy(steps_of(mean.numpy(), scoring["apply"])).float()
    weights["model.typical_step"] = torch.tensor([distance, np.nan, turn])
    weights["model.uncertainty.lateral"] = torch.tensor(np.nan)
    saved["state_dict"] = weights


def calibrate(path: Path, drives: list[Drive]) -> OdometryModule:
    """Fits what a checkpoint's model knows of validation drives and keeps it in the checkpoint.

    Args:
        path: a ``.ckpt`` file of a run; it changes at once or not at all.
        drives: validation drives with their truth.

    Returns:
        The module, as :func:`load_module` gives it.

    Raises:
        InputError: as :func:`load_module`.
    """
    module = load_module(path)
    module.model.calibrate(drives)
    saved = read_checkpoint(path)
    saved["state_dict"] = module.state_dict()
    AtomicCheckpointIO().save_checkpoint(saved, path)
    return module
