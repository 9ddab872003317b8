"""Trained networks from disk, never trusting the file with more than numbers."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.cache import EncodedSequence
from rcnn_odom.training.modules import VARIANTS, OdometryModule
from rcnn_odom.training.saving import save_atomically


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """What a checkpoint holds, its arrays as maps of the file.

    Raises:
        InputError: no such file, or it holds anything but numbers, strings, lists and dictionaries: objects
            could run a stranger's code.
    """
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        if not isinstance(saved, dict):
            raise TypeError(f"it holds a {type(saved).__name__}")
    except FileNotFoundError:
        raise InputError(f"{path}: no such checkpoint") from None
    except Exception as error:  # whatever the bytes of a stranger's file lead to
        raise _refusal(path, error) from error
    return saved


def _refusal(path: str | Path, error: Exception) -> InputError:
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    return InputError(
        f"{path}: not a checkpoint of this project, or of an older version ({reason}); train again"
    )


def load_module(path: str | Path, variant: str | None = None, sensor: Sensor | None = None) -> OdometryModule:
    """The trained module of a checkpoint, on the CPU, in evaluation mode.

    Args:
        path: a ``.ckpt`` file of a run.
        variant: which of the four it must be; None for any.
        sensor: which it must have been trained for; None for any.

    Raises:
        InputError: no such file, not a checkpoint of this project, of another variant or sensor.
    """
    saved = read_checkpoint(path)
    try:
        settings, weights = saved["hyper_parameters"], saved["state_dict"]
        found = settings["variant"]
        module = VARIANTS[found](settings["model"], settings["sensor"], settings["scoring"])
        module.load_state_dict(weights)
    except Exception as error:  # whatever a stranger's file holds
        raise _refusal(path, error) from error
    if variant is not None and found != variant:
        raise InputError(f"{path}: a checkpoint of {found}, but {variant} is needed")
    if sensor is not None and settings["sensor"] != sensor.as_dict():
        raise InputError(
            f"{path}: trained for {Sensor(**settings['sensor'])}, but the data has {sensor}; "
            "set data.sensor as in training, or train on this data"
        )
    return module.eval()


def calibrate(path: str | Path, sequences: list[EncodedSequence]) -> OdometryModule:
    """Fits the uncertainty of a checkpoint's network on validation drives and keeps it in the checkpoint.

    Args:
        path: a ``.ckpt`` file of a run; it changes at once or not at all.
        sequences: validation drives with their truth.

    Returns:
        The module, as :func:`load_module` gives it.

    Raises:
        InputError: as :func:`load_module`.
    """
    module, path = load_module(path), Path(path)
    estimates = [module.estimate(torch.from_numpy(np.array(sequence.scans))) for sequence in sequences]
    module.uncertainty.fit(
        np.concatenate([estimate.features for estimate in estimates]),
        np.concatenate([estimate.motions for estimate in estimates]),
        np.concatenate([sequence.motions for sequence in sequences]),
        np.concatenate([(sequence.scans > 0).mean(1) for sequence in sequences]),
        np.concatenate([np.diff(sequence.stamps) for sequence in sequences]),
    )
    saved = read_checkpoint(path)
    saved["state_dict"] = module.state_dict()
    save_atomically(saved, path)
    return module
