"""The steps of a run: train the first stage if the model has one, train the model, score it."""

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
from rcnn_odom.training.cluster import environment_of, find_world, has_joined, start_in_others
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.machine import resolve_precision
from rcnn_odom.training.matcher_truth import MatcherTruth
from rcnn_odom.training.modules import OdometryModule, module_for, steps_per_epoch
from rcnn_odom.training.pretrained import (
    options_of_network,
    read_pretrained,
    start_from_pretrained,
    warn_if_worse,
)
from rcnn_odom.training.processes import one_line_errors
from rcnn_odom.training.run_card import describe_run, find_command
from rcnn_odom.training.run_state import (
    Fingerprints,
    State,
    check_checkpoint,
    fingerprints,
    link_latest,
    open_run,
    state_of,
    write_json,
)
from rcnn_odom.training.saving import AtomicCheckpointIO, Best, Saving, Stopped, TimeUp
from rcnn_odom.training.tensorboard import (
    Dashboard,
    OneFileLogger,
    log_figure,
    log_results,
    log_run,
    log_start,
)
from rcnn_odom.training.trainer_options import max_time_in_seconds
from rcnn_odom.training.training_log import TrainingLog

log = logging.getLogger(__name__)


def build_datamodule(settings: Settings) -> OdometryDataModule:
    """Builds the DataModule of a configuration; it does not read recordings yet."""
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
    """Builds an untrained module for these data; its weights are drawn from the seed."""
    data, model = settings["data"], settings["model"]
    truths = [flatten(drive.camera_poses) for drive in datamodule.drives["val"]]
    lengths = list(fitting_lengths(truths, data["lengths"]))
    if lengths != data["lengths"]:
        log.info(
            "the validation drives are too short for data.lengths: their drift uses segments of %s m", lengths
        )
    L.seed_everything(settings["seed"], verbose=False)
    module = module_for(model["variant"])(options_of_network(model), data["sensor"], lengths)
    module.set_units(datamodule.training_steps())
    return module


def build_trainer(settings: Settings, run: Path | None = None) -> L.Trainer:
    """Builds Lightning's Trainer.

    Args:
        settings: settings of the run.
        run: folder of the run; None: the Trainer can only test.

    Raises:
        InputError: the requested devices or precision are not available, or the batch size is not a multiple
            of the number of devices.
    """
    options = {name: value for name, value in settings["trainer"].items() if name != "max_time"}
    options["precision"] = resolve_precision(options["precision"], options["accelerator"])
    if options["devices"] != 1 and _has_one_process(options):
        raise InputError(
            f"trainer.devices={options['devices']}: several devices train by trainer=ddp trainer.devices=..."
        )
    if find_world():  # torchrun or Slurm has already started what ddp_spawn would start.
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
    """Lightning's environment: torchrun or Slurm if one has started the processes, else a local one."""
    world = find_world() if has_joined() else None
    return environment_of(world) if world else LightningEnvironment()


def _trainer_builder(trainer: L.Trainer, settings: Settings) -> Callable[[], L.Trainer]:
    """A picklable function that builds the same Trainer in another process, with the same precision."""
    options = settings["trainer"] | {"precision": trainer.precision}
    run = Path(settings["run_dir"]) if trainer.logger else None
    return partial(build_trainer, settings | {"trainer": options}, run)


def _has_one_process(options: Settings) -> bool:
    """Whether the options of the Trainer mean a single process."""
    devices = options["devices"]
    return "strategy" not in options and not (isinstance(devices, list) and len(devices) == 1)


def _training_options(settings: Settings, run: Path) -> Settings:
    """Options of the Trainer that only a training needs: logger, callbacks, number of epochs."""
    max_time = settings["trainer"].get("max_time")
    saving = Saving(run / LAST, max_time_in_seconds(max_time) if max_time else None)
    decay = settings["model"].get("averaging")
    return {
        "logger": OneFileLogger(run, name="", version="tensorboard", default_hp_metric=False),
        "callbacks": [
            *([Averaging(decay)] if decay else []),
            Dashboard(settings),
            TrainingLog(),
            Best(run / BEST),
            saving,
        ],
        "max_epochs": settings["model"]["epochs"],
        "num_sanity_val_steps": 0,
    }


def train(settings: Settings, *, reuse: bool = False) -> Report | None:
    """Trains and scores one run.

    Args:
        settings: the configuration as plain values.
        reuse: as in the jobs of a sweep: return the metrics of a run that is already finished, and take the
            weights of another finished run with exactly the same training.

    Returns:
        The content of ``metrics.json``; None if ``trainer.max_time`` has stopped the first stage, since the
        second stage needs a complete first stage.

    Raises:
        InputError: the configuration, the run's folder or the recordings are invalid.
        KeyboardInterrupt: the run was stopped by Ctrl-C or a signal; the log says how to continue.
    """
    run, outputs = home_of(Path(settings["run_dir"])), Path(settings["outputs"])
    settings, variant = settings | {"run_dir": str(run)}, settings["model"]["variant"]
    if not find_model(variant).trains:
        raise InputError(
            f"model={variant} has nothing to train; score it: rcnn-odom evaluate model={variant} data=..."
        )
    if reuse and state_of(run, settings).state is State.FINISHED:
        log.info("run %s is already finished", run)
        return read_metrics_file(run)
    read_pretrained(settings)  # An unsuitable checkpoint is refused before recordings are encoded.
    try:
        trainer = build_trainer(settings, run)
        datamodule = build_datamodule(settings)
        with open_run(run, settings):
            datamodule.load()
            link_latest(outputs, run)
            wanted = fingerprints(settings, datamodule)
            with one_at_a_time(outputs / "cache", wanted.settings, "training the same"):
                metrics = train_module(settings, datamodule, trainer, wanted, reuse=reuse)
    except (KeyboardInterrupt, SystemExit, Stopped):  # Lightning turns KeyboardInterrupt into SystemExit.
        log.error("stopped; the same command continues the run in %s", shlex.quote(str(run)))
        raise KeyboardInterrupt from None
    except TimeUp:  # The log already says so.
        return None
    viewer = f"tensorboard --logdir {shlex.quote(settings['outputs'])}"
    log.info("all results are in %s; look at them with: %s", shlex.quote(str(run)), viewer)
    return metrics


def train_module(
    settings: Settings,
    datamodule: OdometryDataModule,
    trainer: L.Trainer,
    wanted: Fingerprints,
    *,
    reuse: bool = False,
) -> Report:
    """Trains one model, with its first stage, and scores it on the test drives.

    A run that was stopped or killed continues from its last checkpoint; on a CPU the result is exactly the
    same.

    Args:
        settings: settings of the run.
        datamodule: the data of the run, loaded.
        trainer: Trainer for the run's folder.
        wanted: fingerprints of this training.
        reuse: whether to take the weights of another run in ``outputs`` that has finished exactly the same
            training (recordings, network, recipe, seed and code).

    Returns:
        The content of ``metrics.json``.

    Raises:
        TimeUp: the first stage was not finished within ``trainer.max_time``.
    """
    run = Path(settings["run_dir"])
    metrics: Report = {"fingerprint": wanted.settings, "code": wanted.code, "seed": settings["seed"]}
    found = state_of(run, settings, wanted, Path(settings["outputs"]) if reuse else None)
    if found.state is State.TWIN:
        metrics |= _take_weights(found.run, run)
    else:
        metrics |= _fit(settings, datamodule, trainer, wanted)
    module = calibrate(run / BEST, datamodule.drives["val"])
    assert isinstance(trainer.logger, TensorBoardLogger)
    if found.state is State.TWIN:  # Nothing was trained, so the callback has not written the card.
        card = describe_run(settings, find_command(), trainer, module, datamodule, metrics["same_as"])
        log_start(trainer.logger, card)
    metrics |= {"variant": module.variant, "data": settings["data"]["name"]}
    training = metrics["training"]
    metrics |= score_module(module, datamodule, trainer, settings, run, training["steps"])
    log_results(trainer.logger, settings, metrics)
    if "stopped_by" not in training:
        log_run(trainer.logger, settings, metrics)
    trainer.logger.experiment.close()
    write_json(run / METRICS, metrics)
    if "stopped_by" in training:
        done = training["epochs"], settings["model"]["epochs"]
        log.info("stopped by trainer.max_time after %d of %d epochs; the same command continues it", *done)
    else:
        (run / LAST).unlink(missing_ok=True)
    return metrics


def _take_weights(twin: Path, run: Path) -> Report:
    """Copies the best checkpoint of another run; returns what its ``metrics.json`` says about training."""
    metrics = read_metrics_file(twin)
    log.info("run %s has finished the same training; its weights are used", twin)
    (run / BEST).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(twin / BEST, run / BEST)
    names = ("pretrained", "first_stage", "training", "val")
    kept: Report = {key: metrics[key] for key in names if key in metrics}
    return kept | {"same_as": metrics.get("same_as", str(twin))}


def _fit(
    settings: Settings, datamodule: OdometryDataModule, trainer: L.Trainer, wanted: Fingerprints
) -> Report:
    """Trains, at most for ``trainer.max_time``.

    Returns:
        The entries of ``metrics.json`` about training.

    Raises:
        InputError: the last checkpoint belongs to another training.
        TimeUp: the first stage was not finished in time.
    """
    run, start = Path(settings["run_dir"]), time.monotonic()
    last = run / LAST
    module = build_module(settings, datamodule)
    module.fingerprint, module.code = wanted
    metrics = _set_initial_weights(module, settings, datamodule)
    if last.exists():
        saved = read_checkpoint(last)
        check_checkpoint(last, saved, wanted)
        log.info("continuing from %s, step %d", last, saved["global_step"])
        del saved  # Its memory maps would keep the space of the file on the disk.
    _saving_of(trainer).spent = time.monotonic() - start
    stopped = {}
    try:
        with one_line_errors(trainer):
            resume: Settings = {"ckpt_path": last if last.exists() else None, "weights_only": True}
            datamodule.trainer = trainer
            _ = datamodule.batches_per_epoch  # Refuses too few windows here, not in every process.
            folders = [datamodule.cache_dir, run]
            start_in_others(_trainer_builder(trainer, settings), "fit", module, datamodule, folders, **resume)
            trainer.fit(module, datamodule=datamodule, **resume)
    except TimeUp:
        stopped = {"stopped_by": "trainer.max_time"}
    fitted = _read_fitted(run, steps_per_epoch(settings["trainer"].get("limit_train_batches"), datamodule))
    fitted["training"] |= stopped
    fitted["val"]["lengths"] = module.lengths
    metrics |= fitted
    warn_if_worse(metrics)
    return metrics


def _read_fitted(run: Path, steps_per_epoch: int) -> Report:
    """Reads the length of a training and its best validation drift from its last checkpoint.

    The checkpoint has them also if other processes have trained. A run that was stopped before its first
    validation has no best checkpoint yet; it gets a copy of the last one, which the first validation
    replaces.
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
    """The callback of a Trainer that saves checkpoints."""
    (saving,) = (one for one in trainer.callbacks if isinstance(one, Saving))  # type: ignore[attr-defined]
    return saving


def _set_initial_weights(
    module: OdometryModule, settings: Settings, datamodule: OdometryDataModule
) -> Report:
    """Gives a model the weights of ``model.pretrained``, or those of a trained first stage.

    Returns:
        The entries of ``metrics.json`` about them.

    Raises:
        InputError: the given network does not fit.
        TimeUp: the first stage was not finished in time.
    """
    model, variant = settings["model"], module.model.first_stage
    given = read_pretrained(settings)
    if given is not None and given.variant == module.variant:
        # New worlds that neither the given network nor its first stage was trained on.
        datamodule.fresh_first = given.model.options["epochs"] + model.get("first_stage", {}).get("epochs", 0)
        return start_from_pretrained(given, module, model["pretrained"], datamodule)
    if variant is None:
        return {}
    path = Path(model["pretrained"]) if given else _find_first_stage(settings, datamodule, variant)
    log.info("first stage: %s", path)
    stage = given or load_module(path, variant, Sensor(**settings["data"]["sensor"]))
    try:
        module.model.take_first_stage(stage.model)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    # Otherwise the LSTM would learn from features of scans that the encoder was trained on.
    datamodule.fresh_first = stage.model.options["epochs"]
    return {"first_stage": str(path)}


def _find_first_stage(settings: Settings, datamodule: OdometryDataModule, variant: str) -> Path:
    """Finds the checkpoint of the first stage among the runs, or trains it.

    A first stage of another run is used if it has the same recordings, network, recipe, seed and code. A
    first stage in this run's own folder is also used if the code has changed, and the log says so.

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
        # The run's own first stage is preferred. It exists if the run was stopped after it.
        found = state_of(run, settings, wanted, outputs)
        if found.state not in (State.FINISHED, State.TWIN):
            log.info("first stage: no suitable %s in %s, training one", variant, outputs)
            with open_run(run, settings):
                metrics = train_module(settings, stage_data, build_trainer(settings, run), wanted)
            if "stopped_by" in metrics["training"]:
                log.info("the first stage is not finished, so the second one cannot start")
                raise TimeUp
        elif read_metrics_file(found.run).get("code") != wanted.code:
            log.info(
                "the code has changed since the first stage of this run was trained; it is used nevertheless"
            )
    return found.run / BEST


def score_module(
    module: OdometryModule,
    datamodule: OdometryDataModule,
    trainer: L.Trainer,
    settings: Settings,
    folder: Path,
    step: int = 0,
) -> Report:
    """Scores a network on the test drives. The Trainer's TensorBoard logger, if any, gets the figures.

    Args:
        module: the trained module.
        datamodule: has the test drives.
        trainer: runs the test, possibly in other processes.
        settings: settings with which the Trainer was built.
        folder: gets the trajectories and figures.
        step: number of training steps, for TensorBoard.

    Returns:
        See :func:`rcnn_odom.evaluation.run_report.report_drives`.
    """
    with TemporaryDirectory() as shared, one_line_errors(trainer):
        # Other processes cannot return their estimates in memory.
        module.estimates_file = Path(shared) / "estimates" if trainer.world_size > 1 else None
        folders = [datamodule.cache_dir]
        start_in_others(
            _trainer_builder(trainer, settings), "test", module, datamodule, folders, verbose=False
        )
        trainer.test(module, datamodule=datamodule, verbose=False)
        if module.estimates_file:
            module.estimates = pickle.loads(module.estimates_file.read_bytes())
    mean_step, drives, logger = module.mean_step.double().numpy(), datamodule.drives["test"], trainer.logger
    latency = measure(module.model.stepper(), drives[0].scans)
    add_figure = partial(log_figure, logger, step) if isinstance(logger, TensorBoardLogger) else None
    return report_drives(
        module.variant, module.estimates, mean_step, latency, drives, settings["data"], folder, add_figure
    )
