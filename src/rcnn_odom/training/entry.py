"""What ``rcnn-odom train`` and ``rcnn-odom evaluate`` do, as the scripts of a checkout."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig

from rcnn_odom.training.job import in_sweep, run_command, run_job

CONF = str((Path(__file__).parents[1] / "conf").resolve())
"""Hydra's groups: in a checkout the folder at its top, by a link, and in a wheel a copy of it."""


def train(cfg: DictConfig, *, reuse: bool = False) -> dict | None:
    """Everything that one run does: see :func:`rcnn_odom.training.stages.train`."""
    # Here and not above: `--help` and a mistyped option should not wait for torch.
    from rcnn_odom.training import stages
    from rcnn_odom.training.settings import plain

    return stages.train(plain(cfg), reuse=reuse)


def evaluate(cfg: DictConfig) -> dict:
    """Scores a run or a model, or measures a method on many sets of recordings: see the functions called."""
    from rcnn_odom.training import scoring

    if cfg.get("benchmark"):
        from rcnn_odom.training.benchmark.job import run_benchmark

        return run_benchmark(cfg)

    return scoring.evaluate(cfg)


@hydra.main(version_base="1.3", config_path=CONF, config_name="config")
def _train_job(cfg: DictConfig) -> float | None:
    """Runs one job; its validation drift is what a sweep would minimise."""
    metrics = run_job(partial(train, reuse=in_sweep()), cfg)
    return None if metrics is None else metrics["val"]["drift"]


@hydra.main(version_base="1.3", config_path=CONF, config_name="evaluate")
def _evaluate_job(cfg: DictConfig) -> float | None:
    """Runs one job; its test drift, if it has one."""
    metrics = run_job(evaluate, cfg)
    return metrics["test"]["drift"] if metrics and "test" in metrics else None


def run_train(arguments: Sequence[str]) -> int:
    """Trains and scores; the exit status.

    Args:
        arguments: of Hydra, such as ``model=rcnn_reg`` or ``--multirun``.
    """
    return _run(_train_job, arguments)


def run_evaluate(arguments: Sequence[str]) -> int:
    """Scores what is there already; the exit status.

    Args:
        arguments: of Hydra, such as ``run=outputs/latest``.
    """
    return _run(_evaluate_job, arguments)


def _run(job: Callable[[], object], arguments: Sequence[str]) -> int:
    sys.argv[1:] = arguments  # where Hydra reads them
    return run_command(job)
