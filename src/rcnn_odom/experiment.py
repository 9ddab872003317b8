"""The steps of one experiment, as ``train.py`` and ``evaluate.py`` call them."""

import hashlib
import json
import logging
import os
import re
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import yaml
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcnn_odom.baselines.constant import held_motion, mean_motion
from rcnn_odom.cache import EncodedSequence
from rcnn_odom.checkpoint import load_module
from rcnn_odom.datamodule import OdometryDataModule
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation import Report, camera_trajectory, percent, score_all, table
from rcnn_odom.figures import motion_figure, trajectory_figure
from rcnn_odom.machine import keep_freed_memory, resolve_precision
from rcnn_odom.metrics.drift import fitting_lengths
from rcnn_odom.modules import VARIANTS, CNNClassification, OdometryModule
from rcnn_odom.motion import change_frame, compose, relative_motions
from rcnn_odom.scan import Sensor
from rcnn_odom.trajectory import flatten, write_kitti, write_tum

log = logging.getLogger(__name__)

Settings = dict[str, Any]
BEST, LAST = "checkpoints/best.ckpt", "checkpoints/last.ckpt"
PACKAGES = ("torch", "lightning", "hydra-core", "torchmetrics", "numpy", "rcnn-odom")


def plain(cfg: DictConfig) -> Settings:
    """A configuration as plain numbers, strings, lists and dictionaries.

    Raises:
        InputError: a value that the user must give is missing.
    """
    try:
        settings = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise InputError(f"{error.full_key}: {str(error).splitlines()[0]}; set it on the command line") from None
    assert isinstance(settings, dict)
    return settings  # type: ignore[return-value]


def start_run(settings: Settings) -> Path:
    """The run's folder with the resolved configuration; ``latest`` points to it.

    Raises:
        InputError: the folder holds a finished run, or one with other settings.
    """
    run, outputs = Path(settings["run_dir"]), Path(settings["outputs"])
    run.mkdir(parents=True, exist_ok=True)
    config = run / "config.yaml"
    if (run / "metrics.json").exists():
        raise InputError(f"{run}: holds a finished run; choose another run_dir")
    if config.exists() and yaml.safe_load(config.read_text()) != settings:
        raise InputError(f"{run}: was begun with other settings, see its config.yaml; choose another run_dir")
    config.write_text(yaml.safe_dump(settings, sort_keys=False))
    link = outputs / f".latest.{os.getpid()}"
    link.symlink_to(os.path.relpath(run, outputs))
    link.replace(outputs / "latest")
    log.info("run %s, seed %d", run, settings["seed"])
    return run


def build_datamodule(settings: Settings) -> OdometryDataModule:
    """The DataModule of a configuration; nothing has been read yet."""
    data, model = settings["data"], settings["model"]
    reader = instantiate({**data["reader"], "_partial_": True})
    return OdometryDataModule(
        read=reader,
        train=data["train"],
        val=data["val"],
        test=data["test"],
        sensor=Sensor(**data["sensor"]),
        cache_dir=Path(settings["outputs"]) / "cache",
        window=model["window"],
        batch_size=model["batch_size"],
        workers=data["workers"],
        seed=settings["seed"],
        **data["augment"],
    )


def build_module(settings: Settings, datamodule: OdometryDataModule) -> OdometryModule:
    """An untrained module for these data."""
    data = settings["data"]
    truths = [flatten(change_frame(s.poses, s.camera_from_laser)) for s in datamodule.sequences["val"]]
    lengths = list(fitting_lengths(truths, data["lengths"]))
    if lengths != data["lengths"]:
        log.info("validation is too short for data.lengths: its drift is measured over %s m", lengths)
    scoring = {"lengths": lengths, "apply": data["apply"]}
    model = {key: value for key, value in settings["model"].items() if key not in ("first_stage", "pretrained")}
    L.seed_everything(settings["seed"], verbose=False)
    module = VARIANTS[model["variant"]](model, data["sensor"], scoring)
    module.set_motion_statistics(*datamodule.motion_statistics())
    return module


class EpochLines(Callback):
    """A line for each epoch, where a progress bar would fill a log with control characters."""

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Starts the clock."""
        self.start = time.monotonic()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Validation has been run: Lightning calls this last."""
        values = {name: float(value) for name, value in trainer.callback_metrics.items()}
        log.info(
            "epoch %2d/%d  loss %.4f  validation: drift %s %%, errors a frame %.3f m %.3f deg  %4.0f s",
            trainer.current_epoch + 1,
            trainer.max_epochs,
            values["train/loss_epoch"],
            percent(values.get("val/drift")),
            values["val/distance_mae_m"],
            values["val/heading_mae_deg"],
            time.monotonic() - self.start,
        )


def build_trainer(settings: Settings, run: Path | None = None) -> L.Trainer:
    """Lightning's Trainer; without a run's folder one that only tests.

    Raises:
        InputError: the devices or the precision that were asked for are not to be had.
    """
    options = dict(settings["trainer"])
    options["precision"] = resolve_precision(options["precision"], options["accelerator"])
    keep_freed_memory()
    training: Settings = {"logger": False, "enable_checkpointing": False}
    if run is not None:
        folder = run / Path(BEST).parent
        best = ModelCheckpoint(folder, "best", "val/drift", save_weights_only=True, enable_version_counter=False)
        last = ModelCheckpoint(folder, "last", enable_version_counter=False)
        training = {
            "logger": TensorBoardLogger(run, name="", version="tensorboard", default_hp_metric=False),
            "callbacks": [best, last, EpochLines()],
            "max_epochs": settings["model"]["epochs"],
            "num_sanity_val_steps": 0,
            "log_every_n_steps": 10,
        }
    try:
        return L.Trainer(
            **options,
            **training,
            enable_model_summary=False,
            enable_progress_bar=sys.stderr.isatty(),
        )
    except (MisconfigurationException, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"trainer: {reason}; this machine can run trainer.accelerator=cpu") from error


def fit(trainer: L.Trainer, module: OdometryModule, datamodule: OdometryDataModule, run: Path) -> OdometryModule:
    """Trains, going on where a stopped run left off; gives the module with the best validation drift."""
    last = run / LAST
    if last.exists():
        log.info("going on from %s", last)
    trainer.fit(
        module, datamodule=datamodule, ckpt_path=last if last.exists() else None, weights_only=True
    )
    if trainer.interrupted:
        raise InputError(f"stopped; the same command with run_dir={run} goes on from the last whole epoch")
    best = load_module(run / BEST)
    best.trainer = trainer
    return best


def first_stage(settings: Settings, datamodule: OdometryDataModule) -> CNNClassification:
    """The CNN that a recurrent variant starts from: given, found among the runs, or trained now.

    One fits when data, network, recipe and seed are the same.
    """
    model = settings["model"]
    sensor = Sensor(**settings["data"]["sensor"])
    path = model["pretrained"] and Path(model["pretrained"])
    if not path:
        cnn_settings = {**settings, "model": model["first_stage"]}
        cnn_settings["run_dir"] = str(Path(settings["run_dir"]) / "first_stage")
        cnn_data = build_datamodule(cnn_settings)
        cnn_data.sequences = datamodule.sequences
        path = find_run(Path(settings["outputs"]), fingerprint(cnn_settings, cnn_data))
        if path is None:
            log.info("first stage: no fitting cnn_cls among the runs, training one")
            path = _train_first_stage(cnn_settings, cnn_data)
    log.info("first stage: %s", path)
    cnn = load_module(path, "cnn_cls", sensor)
    assert isinstance(cnn, CNNClassification)
    _check_first_stage(path, cnn, model)
    return cnn


def _train_first_stage(settings: Settings, datamodule: OdometryDataModule) -> Path:
    run = Path(settings["run_dir"])
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    trainer = build_trainer(settings, run)
    module = fit(trainer, build_module(settings, datamodule), datamodule, run)
    finish_run(settings, trainer, module, datamodule, run)
    return run / BEST


def _check_first_stage(path: Path, cnn: CNNClassification, model: Settings) -> None:
    for key in ("kernel_size", "pooling", "rotation_classes"):
        if cnn.model[key] != model[key]:
            raise InputError(
                f"{path}: trained with {key}={cnn.model[key]}, but model.{key} is {model[key]}; "
                "set it as in training, or leave model.pretrained out"
            )


def fingerprint(settings: Settings, datamodule: OdometryDataModule) -> str:
    """Hash of everything that decides what a training gives: data, network, recipe, seed."""
    data = settings["data"]
    recordings = [
        (sequence.key, sequence.name, hashlib.sha256(sequence.poses.tobytes()).hexdigest())
        for split in ("train", "val")
        for sequence in datamodule.sequences[split]
    ]
    options = {key: data[key] for key in ("augment", "lengths", "apply", "rotation_classes", "sensor")}
    trainer = settings["trainer"]
    parts = [recordings, options, settings["model"], trainer, settings["seed"]]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def find_run(outputs: Path, wanted: str) -> Path | None:
    """The best checkpoint of a finished run with this fingerprint, the newest if there are several."""
    found = []
    for metrics in outputs.rglob("metrics.json"):
        try:
            if json.loads(metrics.read_text())["fingerprint"] == wanted and (metrics.parent / BEST).exists():
                found.append(metrics)
        except (ValueError, KeyError, OSError):
            continue
    newest = max(found, key=lambda path: path.stat().st_mtime, default=None)
    return newest and newest.parent / BEST


def test_report(
    trainer: L.Trainer, module: OdometryModule, datamodule: OdometryDataModule, settings: Settings
) -> tuple[dict[str, Report], dict[str, np.ndarray]]:
    """Scores of the network and of the baselines on the test sequences, and the network's motions."""
    data, sequences = settings["data"], datamodule.sequences["test"]
    trainer.test(module, datamodule=datamodule, verbose=False)
    motions = {s.name: module.estimates[number] for number, s in enumerate(sequences)}
    training = np.concatenate([s.motions for s in datamodule.sequences["train"]])
    methods = {module.variant: motions}
    for name, baseline in (("mean_motion", mean_motion(training)), ("held_motion", held_motion())):
        methods[name] = {s.name: baseline.estimate(s.scans) for s in sequences}
    if all(s.wheel_odometry is not None for s in sequences):
        methods["wheel_odometry"] = {s.name: relative_motions(s.wheel_odometry) for s in sequences}
    reports = {
        name: score_all(sequences, estimate, data["lengths"], data["apply"])
        for name, estimate in methods.items()
    }
    return reports, motions


def finish_run(
    settings: Settings,
    trainer: L.Trainer,
    module: OdometryModule,
    datamodule: OdometryDataModule,
    run: Path,
) -> Report:
    """Tests, writes all that a run leaves behind, and removes the optimiser's state.

    Returns:
        What ``metrics.json`` holds.
    """
    best = trainer.checkpoint_callbacks[0].best_model_score  # type: ignore[union-attr]
    val_drift = None if best is None else float(best)
    reports, motions = test_report(trainer, module, datamodule, settings)
    write_estimates(run, module, datamodule.sequences["test"], motions, settings, reports[module.variant])
    metrics: Report = {
        "fingerprint": fingerprint(settings, datamodule),
        "variant": module.variant,
        "data": settings["data"]["name"],
        "seed": settings["seed"],
        "val": {"drift": val_drift, "lengths": module.scoring["lengths"]},
        "test": reports.pop(module.variant),
        "baselines": reports,
        "versions": {package: version(package) for package in PACKAGES},
    }
    parameters = {key: value for key, value in _flat(settings).items() if not key.startswith("run_dir")}
    scores = {"val/drift": val_drift, "test/drift": metrics["test"]["drift"]}
    trainer.logger.log_hyperparams(parameters, {k: v for k, v in scores.items() if v is not None})
    write_json(run / "metrics.json", metrics)
    (run / LAST).unlink(missing_ok=True)
    log.info("\n%s\n", table({module.variant: metrics["test"], **reports}))
    return metrics


def _flat(settings: Settings, prefix: str = "") -> Settings:
    flat: Settings = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def write_estimates(
    run: Path,
    module: OdometryModule,
    sequences: list[EncodedSequence],
    motions: dict[str, np.ndarray],
    settings: Settings,
    report: Report,
) -> None:
    """Trajectories in KITTI and TUM format and the paper's figures, into the run's folder."""
    apply = settings["data"]["apply"]
    for folder in ("trajectories", "figures"):
        (run / folder).mkdir(exist_ok=True)
    for sequence in sequences:
        name = re.sub(r"[^\w.-]+", "_", sequence.name).strip("_")
        estimate = motions[sequence.name]
        poses = camera_trajectory(sequence, estimate, apply)
        write_kitti(run / "trajectories" / f"{name}.txt", poses)
        write_tum(run / "trajectories" / f"{name}.tum", sequence.stamps, poses)
        drift = percent(report["sequences"][sequence.name]["drift"]["t_err"])
        title = f"{module.variant} on {settings['data']['name']} {sequence.name}: drift {drift} %"
        figures = {
            "trajectory": trajectory_figure(title, sequence.poses, compose(estimate, apply)),
            "motion": motion_figure(title, sequence.motions, estimate),
        }
        for kind, figure in figures.items():
            figure.savefig(run / "figures" / f"{name}_{kind}.png", dpi=120)
            if module.trainer.logger is not None:
                module.trainer.logger.experiment.add_figure(f"{name}/{kind}", figure)


def write_json(path: Path, content: Report) -> None:
    """Writes at once or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(json.dumps(content, indent=2) + "\n")
    partial.replace(path)
