"""Scores a finished run again, also on other data: ``python evaluate.py run=outputs/latest``.

Or a model that does not train and so has no run: ``python evaluate.py model=icp data=simulated``.
"""

import sys

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import run_command, run_job


def evaluate(cfg: DictConfig) -> dict:
    """Scores a run or a model: see :func:`rcnn_odom.training.scoring.evaluate`."""
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from rcnn_odom.training import scoring

    return scoring.evaluate(cfg)


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(cfg: DictConfig) -> float | None:
    """Runs one job; its test drift."""
    metrics = run_job(evaluate, cfg)
    return None if metrics is None else metrics["test"]["drift"]


if __name__ == "__main__":
    sys.exit(run_command(main))
