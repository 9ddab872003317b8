"""Trains and scores one variant: ``python train.py model=rcnn_reg data=kitti data.root=DIR``."""

import logging
import sys
from functools import partial

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import in_sweep, run_command, run_job

log = logging.getLogger("rcnn_odom")


def train(cfg: DictConfig, *, reuse: bool = False) -> dict:
    """Everything that one run does; returns what its ``metrics.json`` holds.

    Args:
        cfg: the configuration.
        reuse: as a sweep's job does, leave it at that where the run is finished already, and take the
            weights of a finished run with the very same training.

    Raises:
        InputError: see its message.
        KeyboardInterrupt: stopped from the keyboard or by a signal; the log says how to go on.
    """
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from pathlib import Path

    from rcnn_odom.errors import InputError
    from rcnn_odom.files import one_at_a_time
    from rcnn_odom.training import run_state as runs
    from rcnn_odom.training import stages as experiment
    from rcnn_odom.training.saving import Stopped
    from rcnn_odom.training.settings import plain

    if cfg.model.variant == "icp":
        raise InputError("model=icp has nothing to train; score it: python evaluate.py model=icp data=...")
    settings = plain(cfg)
    run, outputs = Path(settings["run_dir"]), Path(settings["outputs"])
    if reuse and (done := runs.finished(run, settings)):
        log.info("run %s is finished already", run)
        return done
    try:
        trainer = experiment.build_trainer(settings, run)
        datamodule = experiment.build_datamodule(settings)
        with runs.claimed(run):
            runs.start_run(run, settings)
            datamodule.load()
            runs.point_latest(outputs, run)
            fingerprint = runs.fingerprint(settings, datamodule)
            with one_at_a_time(outputs / "cache", fingerprint, "training the same"):
                metrics = experiment.train_module(settings, datamodule, trainer, reuse=reuse)
    except (KeyboardInterrupt, SystemExit, Stopped):  # Lightning ends by the second after the first
        log.error("stopped; the same command goes on from what is in %s", run)
        raise KeyboardInterrupt from None
    log.info("all of it is in %s; look at it with: tensorboard --logdir %s", run, settings["outputs"])
    return metrics


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its validation drift is what a sweep would minimise."""
    metrics = run_job(partial(train, reuse=in_sweep()), cfg)
    return None if metrics is None else metrics["val"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
