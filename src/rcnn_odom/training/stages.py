"""The steps of one training: a first stage where the model has one, then the model, then its scores."""

import logging
import pickle
import shlex
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import lightning as L
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import ClusterEnvironment, LightningEnvironment
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import fitting_lengths
from rcnn_odom.evaluation.latency import measure
from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.run_folder import BEST, LAST, METRICS, Settings, home_of, read_metrics_file
from rcnn_odom.evaluation.run_report import report_drives
from rcnn_odom.files import one_at_a_time
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.reference import MATCHER
from rcnn_odom.recordings.trajectory import flatten
from rcnn_odom.training.averaging import Averaging
from rcnn_odom.training.checkpoint import calibrate, load_module, read_checkpoint
from rcnn_odom.training.cluster import environment_of, find_world, has_joined, share
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.machine import resolve_precision
from rcnn_odom.training.matcher_truth import MatcherTruth
from rcnn_odom.training.modules import OdometryModule, module_for, steps_per_epoch
from rcnn_odom.training.pretrained import begin_with, options_of_network, read_pretrained, warn_if_worse
from rcnn_odom.training.processes import one_line_errors
from rcnn_odom.training.run_state import (
    Fingerprints,
    State,
    check_checkpoint,
    entered,
    fingerprints,
    point_latest,
    state_of,
    write_json,
)
from rcnn_odom.training.saving import AtomicCheckpointIO, Best, Saving, Stopped, TimeUp
from rcnn_odom.training.tensorboard import Layout, log_run
from rcnn_odom.training.trainer_options import seconds_of
from rcnn_odom.training.training_log import TrainingLog

log = logging.getLogger(__name__)


def build_datamodule(settings: Settings) -> OdometryDataModule:
    """The DataModule of a configuration; nothing has been read yet."""
    data, model = settings["data"], settings["model"]
    cache = Path(settings["outputs"]) / "cache"
    recordings = open_recording(data["reader"])
    if MATCHER in (reader.get("reference") for reader in [data["reader"], *data.get("sources", {}).values()]):
        recordings = MatcherTruth(recordings, cache, data["deskew"])
    recipe = {key: model[key] for key in ("window", "batch_size", "stride", "repeat") if key in model}
    return OdometryDataModule(
        open_recording=recordings,
        train=data["train"],
        val=data["val"],
        test=data["test"],
        sensor=Sensor(**data["sensor"]),
        cache_dir=cache,
        workers=data["workers"],
        seed=settings.get("seed", 0),
        fresh_epochs=model.get("epochs", 0) if data.get("fresh_worlds") else 0,
        worlds_dir=None if data.get("keep_worlds") else Path(settings["run_dir"]) / "worlds",
        **recipe,
        **data["augment"],
    )


def build_module(settings: Settings, datamodule: OdometryDataModule) -> OdometryModule:
    """An untrained module for these data, its weights drawn from the seed."""
    data, model = settings["data"], settings["model"]
    truths = [flatten(drive.camera_poses) for drive in datamodule.drives["val"]]
    lengths = list(fitting_lengths(truths, data["lengths"]))
    if lengths != data["lengths"]:
        log.info("validation is too short for data.lengths: its drift is measured over %s m", lengths)
    L.seed_everything(settings["seed"], verbose=False)
    module = module_for(model["variant"])(options_of_network(model), data["sensor"], lengths)
    module.set_units(datamodule.training_steps())
    return module


def build_trainer(settings: Settings, run: Path | None = None) -> L.Trainer:
    """Lightning's Trainer for a run's folder; without one, a Trainer that can only test.

    Raises:
        InputError: the devices or the precision that were asked for are not to be had.
    """
    options = {name: value for name, value in settings["trainer"].items() if name != "max_time"}
    options["precision"] = resolve_precision(options["precision"], options["accelerator"])
    if options["devices"] != 1 and _has_one_process(options):
        raise InputError(
            f"trainer.devices={options['devices']}: several devices train by trainer=ddp trainer.devices=..."
        )
    if find_world():  # what ddp_spawn would start is there
        options["strategy"] = "ddp" if has_joined() else "auto"
    try:
        trainer = L.Trainer(
            **options,
            **(_training_options(settings, run) if run else {"logger": False, "enable_checkpointing": False}),
            plugins=[_environment(), AtomicCheckpointIO()],
            use_distributed_sampler=False,
            enable_model_summary=False,
            enable_progress_bar=sys.stderr.isatty(),
        )
    except (MisconfigurationException, ValueError, TypeError) as error:
        reason = " ".join(str(error).split()).split(". ")[0]
        advice = "trainer.accelerator=cpu with trainer.precision=auto runs everywhere"
        raise InputError(f"trainer: {reason}; {advice}") from error
    batch_size, devices = settings["model"]["batch_size"], trainer.world_size
    if run and batch_size % devices:
        raise InputError(
            f"model.batch_size={batch_size}: windows cannot be shared evenly among {devices} devices; set a "
            f"multiple of {devices}"
        )
    return trainer


def _environment() -> ClusterEnvironment:
    """Who starts processes: something else that has, or this one wherever it runs, also in a job of Slurm."""
    world = find_world() if has_joined() else None
    return environment_of(world) if world else LightningEnvironment()


def _builder(trainer: L.Trainer, settings: Settings) -> Callable[[], L.Trainer]:
    """Builds a Trainer like this one in another process, whatever precision its own processor has."""
    options = settings["trainer"] | {"precision": trainer.precision}
    run = Path(settings["run_dir"]) if trainer.logger else None
    return partial(build_trainer, settings | {"trainer": options}, run)


def _has_one_process(options: Settings) -> bool:
    devices = options["devices"]
    return "strategy" not in options and not (isinstance(devices, list) and len(devices) == 1)


def _training_options(settings: Settings, run: Path) -> Settings:
    max_time = settings["trainer"].get("max_time")
    saving = Saving(run / LAST, seconds_of(max_time) if max_time else None)
    decay = settings["model"].get("averaging")
    return {
        "logger": TensorBoardLogger(run, name="", version="tensorboard", default_hp_metric=False),
        "callbacks": [
            *([Averaging(decay)] if decay else []),
            Layout(),
            TrainingLog(),
            Best(run / BEST),
            saving,
        ],
        "max_epochs": settings["model"]["epochs"],
        "num_sanity_val_steps": 0,
    }


def train(settings: Settings, *, reuse: bool = False) -> Report | None:
    """Everything that one run does; returns what its ``metrics.json`` holds.

    None after ``trainer.max_time`` has stopped its first stage: the second cannot begin before the first is
    whole, and so there is nothing to score.

    Args:
        settings: its configuration, plain.
        reuse: as a sweep's job does, leave it at that where the run is finished already, and take the
            weights of a finished run with the very same training.

    Raises:
        InputError: see its message.
        KeyboardInterrupt: stopped from the keyboard or by a signal; the log says how to go on.
    """
    run, outputs = home_of(Path(settings["run_dir"])), Path(settings["outputs"])
    settings, variant = settings | {"run_dir": str(run)}, settings["model"]["variant"]
    if not find_model(variant).trains:
        raise InputError(
            f"model={variant} has nothing to train; score it: rcnn-odom evaluate model={variant} data=..."
        )
    if reuse and state_of(run, settings).state is State.FINISHED:
        log.info("run %s is finished already", run)
        return read_metrics_file(run)
    read_pretrained(settings)  # what does not fit is told before recordings are encoded
    try:
        trainer = build_trainer(settings, run)
        datamodule = build_datamodule(settings)
        with entered(run, settings):
            datamodule.load()
            point_latest(outputs, run)
            wanted = fingerprints(settings, datamodule)
            with one_at_a_time(outputs / "cache", wanted.settings, "training the same"):
                metrics = train_module(settings, datamodule, trainer, wanted, reuse=reuse)
    except (KeyboardInterrupt, SystemExit, Stopped):  # Lightning ends by the second after the first
        log.error("stopped; the same command goes on from what is in %s", shlex.quote(str(run)))
        raise KeyboardInterrupt from None
    except TimeUp:  # has been told
        return None
    look = f"tensorboard --logdir {shlex.quote(settings['outputs'])}"
    log.info("all of it is in %s; look at it with: %s", shlex.quote(str(run)), look)
    return metrics


def train_module(
    settings: Settings,
    datamodule: OdometryDataModule,
    trainer: L.Trainer,
    wanted: Fingerprints,
    *,
    reuse: bool = False,
) -> Report:
    """Trains one model, its first stage before it, and scores it on the test drives.

    A run that was stopped or killed goes on from its last checkpoint, to the very same result on a CPU.

    Args:
        settings: of the run.
        datamodule: its data, loaded.
        trainer: for its folder.
        wanted: fingerprints of this training.
        reuse: where another run among the outputs has finished the very same training (recordings,
            network, recipe, seed and code), its weights are taken instead of training once more.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        TimeUp: the first stage has not been finished in ``trainer.max_time``.
    """
    run = Path(settings["run_dir"])
    metrics: Report = {"fingerprint": wanted.settings, "code": wanted.code, "seed": settings["seed"]}
    found = state_of(run, settings, wanted, Path(settings["outputs"]) if reuse else None)
    if found.state is State.TWIN:
        metrics |= _take_weights(found.run, run)
    else:
        metrics |= _fit(settings, datamodule, trainer, wanted)
    module = calibrate(run / BEST, datamodule.drives["val"])
    metrics |= {"variant": module.variant, "data": settings["data"]["name"]}
    metrics |= score_module(module, datamodule, trainer, settings, run)
    training = metrics["training"]
    if "stopped_by" not in training:
        assert isinstance(trainer.logger, TensorBoardLogger)
        log_run(trainer.logger, settings, metrics, training["steps"])
    write_json(run / METRICS, metrics)
    if "stopped_by" in training:
        done = training["epochs"], settings["model"]["epochs"]
        log.info("stopped by trainer.max_time after %d of %d epochs; the same command goes on", *done)
    else:
        (run / LAST).unlink(missing_ok=True)
    return metrics


def _take_weights(twin: Path, run: Path) -> Report:
    """Another run's best checkpoint, and what its ``metrics.json`` says of its training."""
    metrics = read_metrics_file(twin)
    log.info("the same training has been done in %s; its weights are taken", twin)
    (run / BEST).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(twin / BEST, run / BEST)
    told = ("pretrained", "first_stage", "training", "val")
    kept: Report = {key: metrics[key] for key in told if key in metrics}
    return kept | {"same_as": metrics.get("same_as", str(twin))}


def _fit(
    settings: Settings, datamodule: OdometryDataModule, trainer: L.Trainer, wanted: Fingerprints
) -> Report:
    """Trains, for as long as ``trainer.max_time`` allows; the part of ``metrics.json`` that is about it.

    Raises:
        InputError: the checkpoint that it would go on from belongs to another training.
        TimeUp: the first stage has not been finished.
    """
    run, begun = Path(settings["run_dir"]), time.monotonic()
    last = run / LAST
    module = build_module(settings, datamodule)
    module.fingerprint, module.code = wanted
    metrics = _begin_with_trained_weights(module, settings, datamodule)
    if last.exists():
        saved = read_checkpoint(last)
        check_checkpoint(last, saved, wanted)
        log.info("going on from %s, step %d", last, saved["global_step"])
        del saved  # its maps would keep the file's place on the disk
    _saving_of(trainer).spent = time.monotonic() - begun
    stopped = {}
    try:
        with one_line_errors(trainer):
            go_on: Settings = {"ckpt_path": last if last.exists() else None, "weights_only": True}
            datamodule.trainer = trainer
            _ = datamodule.batches_per_epoch  # refuses too few windows here, not in every process
            folders = [datamodule.cache_dir, run]
            share(_builder(trainer, settings), "fit", module, datamodule, folders, **go_on)
            trainer.fit(module, datamodule=datamodule, **go_on)
    except TimeUp:
        stopped = {"stopped_by": "trainer.max_time"}
    fitted = _read_fitted(run, steps_per_epoch(settings["trainer"].get("limit_train_batches"), datamodule))
    fitted["training"] |= stopped
    fitted["val"]["lengths"] = module.lengths
    metrics |= fitted
    warn_if_worse(metrics)
    return metrics


def _read_fitted(run: Path, steps_per_epoch: int) -> Report:
    """How long a run was trained and its best validation, as its last checkpoint says.

    Training in other processes has left it there too. A run that was stopped before its first validation has
    no best weights yet, and gets its last ones for now: the first validation will choose others.
    """
    saved = read_checkpoint(run / LAST)
    (best,) = (state for name, state in saved["callbacks"].items() if name.startswith("Best"))
    if not best["best_model_path"]:
        shutil.copyfile(run / LAST, run / BEST)
    drift, steps = best["best_model_score"], saved["global_step"]
    return {
        "training": {
            "seconds": saved["training_log"]["seconds"],
            "epochs": steps // steps_per_epoch,
            "steps": steps,
        },
        "val": {"drift": None if drift is None else float(drift)},
    }


def _saving_of(trainer: L.Trainer) -> Saving:
    (saving,) = (one for one in trainer.callbacks if isinstance(one, Saving))  # type: ignore[attr-defined]
    return saving


def _begin_with_trained_weights(
    module: OdometryModule, settings: Settings, datamodule: OdometryDataModule
) -> Report:
    """Gives a model the weights of ``model.pretrained``, or a trained first stage if it has one.

    Returns:
        The part of ``metrics.json`` about them.

    Raises:
        InputError: what was given does not fit.
        TimeUp: the first stage has not been finished.
    """
    model, variant = settings["model"], module.model.first_stage
    given = read_pretrained(settings)
    if given is not None and given.variant == module.variant:
        # New worlds that the given network has not seen, nor its first stage.
        datamodule.fresh_first = given.model.options["epochs"] + model.get("first_stage", {}).get("epochs", 0)
        return begin_with(given, module, model["pretrained"], datamodule)
    if variant is None:
        return {}
    path = Path(model["pretrained"]) if given else _find_first_stage(settings, datamodule, variant)
    log.info("first stage: %s", path)
    stage = given or load_module(path, variant, Sensor(**settings["data"]["sensor"]))
    try:
        module.model.take_first_stage(stage.model)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    # An LSTM would otherwise learn from features of scans that their encoder was fitted to.
    datamodule.fresh_first = stage.model.options["epochs"]
    return {"first_stage": str(path)}


def _find_first_stage(settings: Settings, datamodule: OdometryDataModule, variant: str) -> Path:
    """Checkpoint of the first stage: found among the runs, or trained now.

    One that is found has the same recordings, network, recipe and seed, and was trained by the same code;
    only the own one of a run that was stopped is kept whatever the code, and the log says so.

    Raises:
        TimeUp: ``trainer.max_time`` has stopped its training.
    """
    model = settings["model"]
    run, outputs = Path(settings["run_dir"]) / "first_stage", Path(settings["outputs"])
    settings = {**settings, "model": {**model["first_stage"], "variant": variant}, "run_dir": str(run)}
    stage_data = build_datamodule(settings)
    stage_data.drives = datamodule.drives
    wanted = fingerprints(settings, stage_data)
    with one_at_a_time(outputs / "cache", wanted.settings, "training the first stage"):
        # The run's own comes first: it is there when the run was stopped after it.
        found = state_of(run, settings, wanted, outputs)
        if found.state not in (State.FINISHED, State.TWIN):
            log.info("first stage: no fitting %s in %s, training one", variant, outputs)
            with entered(run, settings):
                metrics = train_module(settings, stage_data, build_trainer(settings, run), wanted)
            if "stopped_by" in metrics["training"]:
                log.info("the first stage is not whole, so that the second one has to wait")
                raise TimeUp
        elif read_metrics_file(found.run).get("code") != wanted.code:
            log.info("the code has changed since the first stage of this run was trained; it is kept")
    return found.run / BEST


def score_module(
    module: OdometryModule,
    datamodule: OdometryDataModule,
    trainer: L.Trainer,
    settings: Settings,
    folder: Path,
) -> Report:
    """Estimates the test drives with a network and scores it; a trainer's TensorBoard gets the figures.

    Args:
        module: with the network.
        datamodule: with the test drives.
        trainer: tests, perhaps in other processes.
        settings: which the trainer was built with.
        folder: see :func:`rcnn_odom.evaluation.run_report.report_drives`.
    """
    with TemporaryDirectory() as shared, one_line_errors(trainer):
        # Other processes cannot hand their estimates over in memory.
        module.estimates_file = Path(shared) / "estimates" if trainer.world_size > 1 else None
        folders = [datamodule.cache_dir]
        share(_builder(trainer, settings), "test", module, datamodule, folders, verbose=False)
        trainer.test(module, datamodule=datamodule, verbose=False)
        if module.estimates_file:
            module.estimates = pickle.loads(module.estimates_file.read_bytes())
    mean_step, drives, logger = module.mean_step.double().numpy(), datamodule.drives["test"], trainer.logger
    latency = measure(module.model.stepper(), drives[0].scans)
    add_figure = logger.experiment.add_figure if isinstance(logger, TensorBoardLogger) else None
    return report_drives(
        module.variant, module.estimates, mean_step, latency, drives, settings["data"], folder, add_figure
    )
