"""Trains and scores one model: ``python train.py model=rcnn_reg data=kitti data.root=DIR``."""

import sys
from functools import partial

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import in_sweep, run_command, run_job


def train(cfg: DictConfig, *, reuse: bool = False) -> dict | None:
    """Everything that one run does: see :func:`rcnn_odom.training.stages.train`."""
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from rcnn_odom.training import stages
    from rcnn_odom.training.settings import plain

    return stages.train(plain(cfg), reuse=reuse)


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its validation drift is what a sweep would minimise."""
    metrics = run_job(partial(train, reuse=in_sweep()), cfg)
    return None if metrics is None else metrics["val"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
