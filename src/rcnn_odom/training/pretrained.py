"""The initial weights of a training, ``model.pretrained``: those of the same model or of its first stage."""

import logging
from dataclasses import fields
from typing import Any, cast

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.metrics import DRIFT, Report
from rcnn_odom.evaluation.run_folder import Settings, flat
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.trained import Recipe, TrainedModel
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.modules import OdometryModule

log = logging.getLogger(__name__)

NOT_IN_CHECKPOINT = ("variant", "first_stage", "pretrained")
"""Options that are not saved in a checkpoint, since they do not describe the network."""
LEAST_SCANS, LEAST_METRES = 2000, 200.0
"""Smallest amount of data for fine-tuning; a network overfits to less within a few epochs."""


def options_of_network(model: Settings) -> dict[str, Any]:
    """The options of ``model`` that are saved in a checkpoint.

    >>> options_of_network({"variant": "cnn_reg", "kernel_size": 3, "pretrained": None})
    {'kernel_size': 3}
    """
    return {key: value for key, value in model.items() if key not in NOT_IN_CHECKPOINT}


def read_pretrained(settings: Settings) -> OdometryModule | None:
    """Loads the network of ``model.pretrained``; None if the option is not set.

    Args:
        settings: settings of the training.

    Raises:
        InputError: there is no such checkpoint, or its model, sensor or network does not fit. The network of
            a first stage is checked later, when its weights are copied.
    """
    path, variant = settings["model"].get("pretrained"), settings["model"]["variant"]
    if not path:
        return None
    given, wanted = load_module(path), cast(type[TrainedModel], find_model(variant))
    first_stage = wanted.first_stage
    if given.variant not in (variant, first_stage):
        other = f", or of {first_stage}, its first stage" if first_stage else ""
        raise InputError(
            f"{path}: a checkpoint of {given.variant}, but {variant} is needed{other}; give one, or leave "
            "model.pretrained out"
        )
    given = load_module(path, sensor=Sensor(**settings["data"]["sensor"]))
    if given.variant == variant:
        _check_network(path, given, settings["model"])
    return given


def _check_network(path: str, given: OdometryModule, model: Settings) -> None:
    """Compares the options that determine the output of a network.

    Raises:
        InputError: some options differ; the message names both values.
    """
    free = {each.name for each in fields(Recipe)} | set(given.model.only_in_training)
    trained, wanted = (
        flat({name: value for name, value in options_of_network(options).items() if name not in free})
        for options in (given.model.options, model)
    )
    different = [name for name in wanted if name in trained and trained[name] != wanted[name]]
    if different:
        have = ", ".join(f"model.{name} is {wanted[name]}" for name in different)
        need = " ".join(f"model.{name}={trained[name]}" for name in different)
        raise InputError(f"{path}: another network, {have} here; set {need} as in that training")


def copy_weights(given: OdometryModule, module: OdometryModule, path: str) -> None:
    """Copies all weights of a trained module to another module of the same model.

    Args:
        given: the trained module.
        module: gets the weights.
        path: path of the checkpoint of ``given``, for messages.

    Raises:
        InputError: the weights have other shapes.
    """
    try:
        module.model.take_weights(given.model)
    except RuntimeError as error:  # The message of torch has a line for each weight.
        raise InputError(f"{path}: another network, its weights have other shapes; train it again") from error


def start_from_pretrained(
    given: OdometryModule, module: OdometryModule, path: str, data: OdometryDataModule
) -> Report:
    """Copies the initial weights to a module, and logs their validation drift.

    Args:
        given: the trained module of the same model.
        module: the module to be trained.
        path: path of the checkpoint of ``given``.
        data: the drives of the training.

    Returns:
        The entry ``pretrained`` of ``metrics.json``: ``path``, and ``val_drift``, the validation drift of the
        initial weights as a ratio; None if the validation drives are too short to score.

    Raises:
        InputError: see :func:`copy_weights`.
    """
    copy_weights(given, module, path)
    drift = validation_drift(module, data)
    score = "" if drift is None else f"; validation drift before training: {drift:.2%}"
    log.info("starting from the weights of %s%s", path, score)
    if not data.fresh_epochs:
        warn_if_few_data(data)
    return {"pretrained": {"path": path, "val_drift": drift}}


def validation_drift(module: OdometryModule, data: OdometryDataModule) -> float | None:
    """Mean drift of a network on the validation drives, as a ratio; None if they are too short to score."""
    module.eval()
    drives = data.drives["val"]
    each = [DRIFT.compute(drive, module.model.estimate(drive), module.lengths) for drive in drives]
    module.train()
    return DRIFT.over(each, [len(drive) - 1 for drive in drives])


def warn_if_few_data(data: OdometryDataModule) -> None:
    """Warns if the training drives are too short for fine-tuning."""
    scans = sum(map(len, data.drives["train"]))
    metres = float(sum(np.hypot(*steps[:, :2].T).sum() for steps in data.training_steps()))
    if scans < LEAST_SCANS or metres < LEAST_METRES:
        log.warning(
            "fine-tuning on %d scans and %.0f m is too little data (recommended: %d scans and %.0f m or "
            "more): the network overfits to these drives and gets worse on others; give more recordings, or "
            "use the given network without fine-tuning",
            *(scans, metres, LEAST_SCANS, LEAST_METRES),
        )


def warn_if_worse(metrics: Report) -> None:
    """Warns if fine-tuning has not lowered the validation drift of the initial weights."""
    before, after = (metrics.get("pretrained") or {}).get("val_drift"), metrics["val"]["drift"]
    if before is not None and after is not None and after >= before:
        log.warning(
            "fine-tuning has not helped: validation drift %.2f %% before, %.2f %% after; the given network "
            "is as good or better",
            *(100 * before, 100 * after),
        )
