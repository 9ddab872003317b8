"""Weights that a training begins with, ``model.pretrained``: of the same model, or of its first stage."""

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

NOT_OF_THE_NETWORK = ("variant", "first_stage", "pretrained")
"""Options that a checkpoint does not keep: it says what a network is, not where its weights came from."""
LEAST_SCANS, LEAST_METRES = 2000, 200.0
"""Of drives to fine-tune on; a network knows fewer of them by heart after a few epochs."""


def options_of_network(model: Settings) -> dict[str, Any]:
    """Those of the options ``model`` that a checkpoint keeps."""
    return {key: value for key, value in model.items() if key not in NOT_OF_THE_NETWORK}


def read_pretrained(settings: Settings) -> OdometryModule | None:
    """The trained network that a training begins with; None: ``model.pretrained`` names none.

    Args:
        settings: of the training.

    Raises:
        InputError: there is no such checkpoint, or it is of a model, a sensor or a network that does not fit.
            Whether a first stage has the right network is seen when it is taken.
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
    """Compares the options that say what a network computes.

    Raises:
        InputError: some differ; they are named with both values.
    """
    free = {each.name for each in fields(Recipe)} | set(given.model.only_in_training)
    theirs, ours = (
        flat({name: value for name, value in options_of_network(options).items() if name not in free})
        for options in (given.model.options, model)
    )
    others = [name for name in ours if name in theirs and theirs[name] != ours[name]]
    if others:
        have = ", ".join(f"model.{name} is {ours[name]}" for name in others)
        need = " ".join(f"model.{name}={theirs[name]}" for name in others)
        raise InputError(f"{path}: another network, {have} here; set {need} as in that training")


def take_weights(given: OdometryModule, module: OdometryModule, path: str) -> None:
    """Gives a module all weights of a trained one of the same model.

    Raises:
        InputError: they have other shapes.
    """
    try:
        module.model.take_weights(given.model)
    except RuntimeError as error:  # what torch says of shapes takes many lines
        raise InputError(f"{path}: another network, its weights have other shapes; train it again") from error


def begin_with(given: OdometryModule, module: OdometryModule, path: str, data: OdometryDataModule) -> Report:
    """Gives a module the weights that its training begins with, and says what the training may expect.

    Args:
        given: trained, of the same model.
        module: to be trained.
        path: of the checkpoint ``given``.
        data: its drives.

    Returns:
        What ``metrics.json`` says of it: ``path``, and ``val_drift`` of the weights as given, a ratio; None
        where the validation drives are too short to score.

    Raises:
        InputError: as :func:`take_weights`.
    """
    take_weights(given, module, path)
    drift = validation_drift(module, data)
    told = "" if drift is None else f"; validation drift before training: {drift:.2%}"
    log.info("going on from the weights of %s%s", path, told)
    if not data.fresh_epochs:
        warn_of_little(data)
    return {"pretrained": {"path": path, "val_drift": drift}}


def validation_drift(module: OdometryModule, data: OdometryDataModule) -> float | None:
    """Mean drift, a ratio, of the validation drives as a network estimates them now."""
    module.eval()
    drives = data.drives["val"]
    each = [DRIFT.compute(drive, module.model.estimate(drive), module.lengths) for drive in drives]
    module.train()
    return DRIFT.over(each, [len(drive) - 1 for drive in drives])


def warn_of_little(data: OdometryDataModule) -> None:
    """Warns where the training drives are too short to fine-tune a network on."""
    scans = sum(map(len, data.drives["train"]))
    metres = float(np.hypot(*data.training_steps()[:, :2].T).sum())
    if scans < LEAST_SCANS or metres < LEAST_METRES:
        log.warning(
            "fine-tuning on %d scans and %.0f m, too little to learn from (at least %d scans and %.0f m): "
            "the network learns these drives by heart and gets worse on others; give more recordings, or use "
            "the given network as it is",
            *(scans, metres, LEAST_SCANS, LEAST_METRES),
        )


def warn_if_worse(metrics: Report) -> None:
    """Warns where a fine-tuning has no better validation than the weights that it began with."""
    before, after = (metrics.get("pretrained") or {}).get("val_drift"), metrics["val"]["drift"]
    if before is not None and after is not None and after >= before:
        log.warning(
            "fine-tuning has not helped: validation drift %.2f %% before, %.2f %% after; the given network "
            "is as good or better",
            *(100 * before, 100 * after),
        )
