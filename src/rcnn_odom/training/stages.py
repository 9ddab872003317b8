"""The steps of one experiment, as ``train.py`` and ``evaluate.py`` call them."""

import json
import logging
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import lightning as L
from hydra.utils import instantiate
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import fitting_lengths
from rcnn_odom.evaluation.run_report import Estimates, report_test
from rcnn_odom.evaluation.scores import Report
from rcnn_odom.files import one_at_a_time
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.trajectory import flatten
from rcnn_odom.training.checkpoint import calibrate, load_module, read_checkpoint
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.machine import resolve_precision
from rcnn_odom.training.modules import VARIANTS, CNNClassification, OdometryModule, RecurrentModule
from rcnn_odom.training.processes import one_line_errors
from rcnn_odom.training.run_state import BEST, LAST, METRICS, find_run, fingerprint, start_run, write_json
from rcnn_odom.training.saving import AtomicCheckpointIO, Best, Saving
from rcnn_odom.training.settings import Settings
from rcnn_odom.training.tensorboard import Layout, log_run
from rcnn_odom.training.training_log import TrainingLog

log = logging.getLogger(__name__)


def build_datamodule(settings: Settings) -> OdometryDataModule:
    """The DataModule of a configuration; nothing has been read yet."""
    data, model = settings["data"], settings["model"]
    return OdometryDataModule(
        # Plain values travel to the workers; Hydra's own containers would bring all of Hydra along.
        read=instantiate({**data["reader"], "_partial_": True, "_convert_": "all"}),
        train=data["train"],
        val=data["val"],
        test=data["test"],
        sensor=Sensor(**data["sensor"]),
        cache_dir=Path(settings["outputs"]) / "cache",
        window=model["window"],
        batch_size=model["batch_size"],
        workers=data["workers"],
        seed=settings["seed"],
        fresh_epochs=model["epochs"] if data.get("fresh_worlds") else 0,
        # An LSTM would otherwise learn from features of scans that their encoder was fitted to.
        fresh_first=model["first_stage"]["epochs"] if "first_stage" in model else 0,
        worlds_dir=None if data.get("keep_worlds") else Path(settings["run_dir"]) / "worlds",
        **data["augment"],
    )


def build_module(settings: Settings, datamodule: OdometryDataModule) -> OdometryModule:
    """An untrained module for these data, its weights drawn from the seed."""
    data = settings["data"]
    truths = [flatten(sequence.camera_poses) for sequence in datamodule.sequences["val"]]
    lengths = list(fitting_lengths(truths, data["lengths"]))
    if lengths != data["lengths"]:
        log.info("validation is too short for data.lengths: its drift is measured over %s m", lengths)
    # A checkpoint tells what the network is, not where its first stage came from.
    model = {
        key: value for key, value in settings["model"].items() if key not in ("first_stage", "pretrained")
    }
    L.seed_everything(settings["seed"], verbose=False)
    module = VARIANTS[model["variant"]](model, data["sensor"], {"lengths": lengths, "apply": data["apply"]})
    module.set_motion_statistics(*datamodule.motion_statistics())
    return module


def build_trainer(settings: Settings, run: Path | None = None) -> L.Trainer:
    """Lightning's Trainer for a run's folder; without one, a Trainer that can only test.

    Raises:
        InputError: the devices or the precision that were asked for are not to be had.
    """
    options = dict(settings["trainer"])
    options["precision"] = resolve_precision(options["precision"], options["accelerator"])
    if options["devices"] != 1 and "strategy" not in options:
        raise InputError(
            f"trainer.devices={options['devices']}: several devices train by trainer=ddp trainer.devices=..."
        )
    try:
        trainer = L.Trainer(
            **options,
            **(_training_options(settings, run) if run else {"logger": False, "enable_checkpointing": False}),
            # Processes are started by this one wherever it runs, also in a job of Slurm.
            plugins=[LightningEnvironment(), AtomicCheckpointIO()],
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


def _training_options(settings: Settings, run: Path) -> Settings:
    return {
        "logger": TensorBoardLogger(run, name="", version="tensorboard", default_hp_metric=False),
        "callbacks": [Layout(), TrainingLog(), Best(run / BEST), Saving(run / LAST)],
        "max_epochs": settings["model"]["epochs"],
        "num_sanity_val_steps": 0,
    }


def train_module(
    settings: Settings, datamodule: OdometryDataModule, trainer: L.Trainer, *, reuse: bool = False
) -> Report:
    """Trains one module, a recurrent one's first stage before it, and scores it on the test sequences.

    A run that was stopped or killed goes on from its last checkpoint, to the very same result on a CPU.

    Args:
        settings: of the run.
        datamodule: its data, loaded.
        trainer: for its folder.
        reuse: where another run among the outputs has finished the very same training (recordings,
            network, recipe and seed), its weights are taken instead of training once more.

    Returns:
        What ``metrics.json`` holds.
    """
    run = Path(settings["run_dir"])
    metrics: Report = {"fingerprint": fingerprint(settings, datamodule), "seed": settings["seed"]}
    twin = find_run(Path(settings["outputs"]), metrics["fingerprint"]) if reuse else None
    if twin:
        metrics |= _take_weights(twin, run)
    else:
        metrics |= _fit(settings, datamodule, trainer, metrics["fingerprint"])
    metrics |= finish_run(settings, datamodule, trainer, run)
    assert isinstance(trainer.logger, TensorBoardLogger)
    log_run(trainer.logger, settings, metrics, settings["model"]["epochs"] * datamodule.batches_per_epoch)
    write_json(run / METRICS, metrics)
    (run / LAST).unlink(missing_ok=True)
    return metrics


def _take_weights(twin: Path, run: Path) -> Report:
    """Another run's best checkpoint, and what its ``metrics.json`` says of its training."""
    told = json.loads((twin.parents[1] / METRICS).read_text())
    log.info("the same training has been done in %s; its weights are taken", twin.parents[1])
    (run / BEST).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(twin, run / BEST)
    kept = {key: told[key] for key in ("first_stage", "training", "val") if key in told}
    return {**kept, "same_as": told.get("same_as", str(twin.parents[1]))}


def _fit(settings: Settings, datamodule: OdometryDataModule, trainer: L.Trainer, wanted: str) -> Report:
    """Trains; the part of ``metrics.json`` that is about it.

    Raises:
        InputError: the checkpoint that it would go on from belongs to another training.
    """
    metrics: Report = {}
    last = Path(settings["run_dir"]) / LAST
    module = build_module(settings, datamodule)
    module.fingerprint = wanted
    if isinstance(module, RecurrentModule):
        path, cnn = first_stage(settings, datamodule)
        module.load_first_stage(cnn)
        metrics["first_stage"] = str(path)
    if last.exists():
        saved = read_checkpoint(last)
        if saved.get("fingerprint") != wanted:
            raise InputError(
                f"{last}: saved by a training on other recordings or with another version of rcnn_odom; "
                "choose another run_dir, or remove it to begin again"
            )
        log.info("going on from %s, step %d", last, saved["global_step"])
        del saved  # its maps would keep the file's place on the disk
    with one_line_errors(trainer):
        trainer.fit(
            module, datamodule=datamodule, ckpt_path=last if last.exists() else None, weights_only=True
        )
    saved = read_checkpoint(last)  # where training in other processes has left it too
    (best,) = (state for name, state in saved["callbacks"].items() if name.startswith("Best"))
    drift = best["best_model_score"]
    return {
        **metrics,
        "training": {"seconds": saved["training_log"]["seconds"], "epochs": settings["model"]["epochs"]},
        "val": {"drift": None if drift is None else float(drift), "lengths": module.scoring["lengths"]},
    }


def finish_run(settings: Settings, datamodule: OdometryDataModule, trainer: L.Trainer, run: Path) -> Report:
    """Scores the checkpoint with the best validation drift on the test sequences.

    Before that its uncertainty is fitted on the validation sequences.
    """
    module = calibrate(run / BEST, datamodule.sequences["val"])
    estimates = estimate_test(module, datamodule, trainer)
    logger = trainer.logger
    assert isinstance(logger, TensorBoardLogger)
    return {
        "variant": module.variant,
        "data": settings["data"]["name"],
        **report_test(module, estimates, datamodule.sequences["test"], settings["data"], run, logger),
    }


def estimate_test(module: OdometryModule, datamodule: OdometryDataModule, trainer: L.Trainer) -> Estimates:
    """What a network makes of the test sequences."""
    with TemporaryDirectory() as folder, one_line_errors(trainer):
        # Other processes cannot hand their estimates over in memory.
        module.estimates_file = Path(folder) / "estimates.npz" if trainer.world_size > 1 else None
        trainer.test(module, datamodule=datamodule, verbose=False)
        if module.estimates_file:
            module.load_estimates()
    drives = {s.name: module.estimates[number] for number, s in enumerate(datamodule.sequences["test"])}
    motions = {name: drive.motions for name, drive in drives.items()}
    deviations = {name: drive.deviations for name, drive in drives.items()}
    return Estimates(motions, deviations=deviations if module.uncertainty.fitted else {})


def first_stage(settings: Settings, datamodule: OdometryDataModule) -> tuple[Path, CNNClassification]:
    """Checkpoint and CNN that a recurrent variant starts from: given, found among the runs, or trained now.

    One that is found has the same recordings, network, recipe and seed.

    Raises:
        InputError: the one that was given is of another variant, sensor or network.
    """
    model = settings["model"]
    path = model["pretrained"] and Path(model["pretrained"])
    if not path:
        run = Path(settings["run_dir"]) / "first_stage"
        cnn_settings = {**settings, "model": model["first_stage"], "run_dir": str(run)}
        cnn_data = build_datamodule(cnn_settings)
        cnn_data.sequences = datamodule.sequences
        wanted = fingerprint(cnn_settings, cnn_data)
        outputs = Path(settings["outputs"])
        with one_at_a_time(outputs / "cache", wanted, "training the first stage"):
            # The run's own comes first: it is there when the run was stopped after it.
            path = find_run(run, wanted) or find_run(outputs, wanted)
            if path is None:
                log.info("first stage: no fitting cnn_cls in %s, training one", outputs)
                start_run(run, cnn_settings)
                train_module(cnn_settings, cnn_data, build_trainer(cnn_settings, run))
                path = run / BEST
    log.info("first stage: %s", path)
    cnn = load_module(path, "cnn_cls", Sensor(**settings["data"]["sensor"]))
    for key in ("kernel_size", "pooling", "rotation_classes"):
        if cnn.model[key] != model[key]:
            raise InputError(
                f"{path}: trained with {key}={cnn.model[key]}, but model.{key} is {model[key]}; "
                "set it as in that training, or leave model.pretrained out"
            )
    assert isinstance(cnn, CNNClassification)
    return path, cnn
