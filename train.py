"""Trains and scores one variant: ``python train.py model=rcnn_reg data=kitti data.root=DIR``."""

import logging
import sys

import hydra
from omegaconf import DictConfig

from rcnn_odom.job import run_command, run_job

log = logging.getLogger("rcnn_odom")


def train(cfg: DictConfig) -> dict:
    """Everything that one run does; returns what its ``metrics.json`` holds.

    Raises:
        InputError: see its message.
        KeyboardInterrupt: stopped from the keyboard or by a signal; the log says how to go on.
    """
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from pathlib import Path

    from rcnn_odom import experiment, runs
    from rcnn_odom.settings import plain

    settings = plain(cfg)
    run = Path(settings["run_dir"])
    trainer = experiment.build_trainer(settings, run)
    datamodule = experiment.build_datamodule(settings)
    runs.start_run(run, settings)
    datamodule.load()
    runs.point_latest(Path(settings["outputs"]), run)
    try:
        metrics = experiment.train_module(settings, datamodule, trainer)
    except (KeyboardInterrupt, SystemExit):  # the latter is how Lightning ends after the former
        log.error("stopped; the same command with run_dir=%s goes on", run)
        raise KeyboardInterrupt from None
    log.info("all of it is in %s; look at it with: tensorboard --logdir %s", run, settings["outputs"])
    return metrics


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its validation drift is what a sweep would minimise."""
    metrics = run_job(train, cfg)
    return None if metrics is None else metrics["val"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
