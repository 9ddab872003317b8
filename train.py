"""Trains and scores one variant: ``python train.py model=rcnn_reg data=kitti data.root=DIR``."""

import logging
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rcnn_odom.errors import InputError

log = logging.getLogger("rcnn_odom")
failed: list[InputError] = []


def train(cfg: DictConfig) -> dict:
    """Everything that one run does; returns what its ``metrics.json`` holds.

    Raises:
        InputError: see its message.
    """
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from pathlib import Path

    from rcnn_odom import experiment, runs

    settings = experiment.plain(cfg)
    run = Path(settings["run_dir"])
    trainer = experiment.build_trainer(settings, run)
    runs.start_run(run, settings)
    runs.point_latest(Path(settings["outputs"]), run)
    datamodule = experiment.build_datamodule(settings).load()
    metrics = experiment.train_module(settings, datamodule, trainer)
    log.info("all of it is in %s; look at it with: tensorboard --logdir %s", run, settings["outputs"])
    return metrics


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; the validation drift is what a sweep would minimise."""
    cfg.run_dir = HydraConfig.get().runtime.output_dir
    try:
        return train(cfg)["val"]["drift"]
    except InputError as error:
        # Remembered rather than raised: the other jobs of a sweep go on.
        log.error("error: %s", error)
        failed.append(error)
        return None


if __name__ == "__main__":
    main()
    sys.exit(1 if failed else 0)
