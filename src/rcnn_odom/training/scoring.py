"""The job of ``evaluate.py``: scores the network of a run, or a model without training."""

import logging
import os
import shlex
from itertools import islice
from pathlib import Path

from omegaconf import DictConfig

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.latency import FRAMES, measure, measure_tracker
from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import BEST, METRICS, Settings, home_of, read_settings
from rcnn_odom.evaluation.run_report import report_drives
from rcnn_odom.models.constant import mean_step
from rcnn_odom.models.contract import Model, find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.run_state import write_config, write_json
from rcnn_odom.training.settings import plain
from rcnn_odom.training.stages import build_datamodule, build_trainer, score_module
from rcnn_odom.training.trainer_options import refuse_options_of_training

log = logging.getLogger(__name__)


def evaluate(cfg: DictConfig) -> Report:
    """Scores the best checkpoint of a run, or a model without training.

    Args:
        cfg: the configuration of ``evaluate.py``.

    Returns:
        The content of ``metrics.json``.

    Raises:
        InputError: the configuration, the run or the recordings are invalid.
    """
    variant = cfg.model.variant if cfg.get("model") else None
    if variant and find_model(variant).trains:
        raise InputError(
            f"model={variant}: a trained network is scored by its run, run=outputs/...; leave out model="
        )
    if variant and not cfg.get("data"):
        raise InputError(
            f"model={variant} needs recordings: add data=simulated, indoor, kitti, kitti_raw, carmen or logs"
        )
    chosen = plain(cfg)
    refuse_options_of_training(chosen["trainer"])
    settings, metrics = _score_model(chosen) if variant else _score_run(chosen)
    folder = Path(chosen["run_dir"])
    write_config(folder, settings)
    write_json(folder / METRICS, metrics)
    log.info("all results are in %s", shlex.quote(str(folder)))
    return metrics


def _score_run(chosen: Settings) -> tuple[Settings, Report]:
    """Scores the network of a run on its own test drives, or on those of ``data``; settings and metrics."""
    run, folder = Path(chosen["run"]), Path(chosen["run_dir"])
    settings = read_settings(run)
    settings |= {key: chosen[key] for key in ("data", "trainer", "outputs") if chosen.get(key)}
    trainer = build_trainer(settings)
    module = load_module(run / BEST, sensor=Sensor(**settings["data"]["sensor"]))
    apply = settings["data"]["apply"]
    if (trained := module.model.options.get("apply", apply)) != apply:
        raise InputError(
            f"data.apply={apply}: the network was trained with {trained}; set data.apply={trained}"
        )
    datamodule = build_datamodule(settings).load(("test",))
    scores = score_module(module, datamodule, trainer, settings, folder)
    names = {
        "run": os.path.relpath(home_of(run)),
        "variant": module.variant,
        "data": settings["data"]["name"],
    }
    return settings, {**names, **scores}


def _score_model(chosen: Settings) -> tuple[Settings, Report]:
    """Scores a model without training on the test drives of ``data``; settings and metrics."""
    data, options = chosen["data"], dict(chosen["model"])
    variant = options.pop("variant")
    model = find_model(variant)(options, Sensor(**data["sensor"]))
    model.deskew = data.get("deskew", "auto")
    datamodule = build_datamodule(chosen).load(("test",), encode=model.uses_depth_vectors)
    drives = datamodule.drives["test"]
    steps = {drive.name: model.estimate(drive) for drive in drives}
    mean = mean_step(datamodule.open_recording, data["train"]) if data["train"] else None
    latency = _latency(model, drives[0])
    scores = report_drives(variant, steps, mean, latency, drives, data, Path(chosen["run_dir"]))
    metrics: Report = {"variant": variant, "data": data["name"], **scores}
    settings = {key: value for key, value in chosen.items() if key not in ("run", "trainer")}
    return settings, metrics


def _latency(model: Model, drive: Drive) -> Report:
    """Measures the computing time per frame on a drive, from depth vectors or from whole scans."""
    if model.uses_depth_vectors:
        return measure(model.stepper(), drive.scans)
    return measure_tracker(model.tracker(), list(islice(drive.raw_scans(), FRAMES + 1)))
